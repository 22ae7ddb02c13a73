"""The plan for what is left: feasible, so never below the exact cost; and soon close to it."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_worldsim.observers.metrics.wasserstein_bounds import Auction
from kantor_worldsim.observers.metrics.wasserstein_exact import w1
from support.strategies import SEEDS, examples

Array = npt.NDArray[np.float64]


def rest(seed: int, robots: int, samples: int) -> tuple[Array, Array, npt.NDArray[np.int64]]:
    """Robots and samples anywhere, and what is left on the samples, on some nothing."""
    random = np.random.default_rng(seed)
    left = random.integers(0, 6, samples)
    left[0] = 1
    return random.uniform(0, 100, (samples, 2)), random.uniform(0, 100, (robots, 2)), left


def exact(xy_m: Array, robots_m: Array, left: npt.NDArray[np.int64]) -> float:
    """The least cost when every robot ships an equal share."""
    shares = np.ones(robots_m.shape[0])
    return w1(robots_m, shares, xy_m, left.astype(np.float64)) * float(left.sum())


def even(xy_m: Array, robots_m: Array, left: npt.NDArray[np.int64]) -> float:
    """The cost when every robot ships an equal share of every sample's rest."""
    ways_m = np.linalg.norm(xy_m[:, None] - robots_m[None], axis=2)
    return float((left[:, None] * ways_m).sum() / robots_m.shape[0])


@examples(60)
@given(SEEDS, st.integers(1, 8), st.integers(1, 40), st.integers(0, 5))
def test_a_plan_costs_no_less_than_the_best_and_no_more_than_the_even_split(
    seed: int, robots: int, samples: int, rounds: int
) -> None:
    """At any prices, whatever was left and wherever robots were before."""
    auction = Auction(robots, samples, every=1)
    for earlier in range(rounds):
        auction.cost(*rest(seed + earlier, robots, samples))
    now = rest(seed, robots, samples)

    cost = auction.cost(*now)

    assert exact(*now) * (1.0 - 1e-9) <= cost <= even(*now) * (1.0 + 1e-9)


def test_plans_come_close_to_the_best() -> None:
    """Five robots and 2000 samples, as in section VI-A: within a tenth after the first rounds."""
    ratios = []
    for seed in range(10):
        now = rest(seed, 5, 2000)
        ratios.append(Auction(5, 2000, every=1).cost(*now) / exact(*now))

    assert max(ratios) < 1.1


def test_one_robot_has_one_plan() -> None:
    now = rest(1, 1, 30)

    assert Auction(1, 30, every=1).cost(*now) == pytest.approx(even(*now), rel=1e-12)


def test_nothing_left_costs_nothing() -> None:
    xy_m, robots_m, left = rest(1, 3, 30)

    assert Auction(3, 30, every=1).cost(xy_m, robots_m, np.zeros_like(left)) == 0.0
