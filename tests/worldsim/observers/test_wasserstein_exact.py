"""The exact distance: right against independent solvers, and never above what claims to bound it."""

from collections.abc import Callable
from itertools import product
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.stats import wasserstein_distance

from kantor_protocol.scenario.schema import MAP_PLANNERS, PlannerName
from kantor_worldsim.observers.checkers.checker import Checker
from kantor_worldsim.observers.metrics.density import DensityMetrics, DensityRow
from kantor_worldsim.observers.metrics.wasserstein_exact import w1
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.record.records import Record
from support.strategies import SEEDS, examples

Play = Callable[..., tuple[Record, ...]]

MERGES = {"ledger": ("merge=ledger",), "min": ("merge=min", "claims=false")}
ORDERS = ("turn", "concurrent")
COORDINATIONS = ("centralized", "decentralized")


@examples(20)
@given(SEEDS, st.integers(1, 30))
def test_between_equal_numbers_it_is_the_best_assignment(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    here_m, there_m = random.uniform(0.0, 100.0, (2, count, 2))
    cost = np.hypot(*(here_m[:, None] - there_m[None]).T).T

    distance = w1(here_m, np.ones(count), there_m, np.ones(count))

    assert distance == pytest.approx(cost[linear_sum_assignment(cost)].mean(), rel=1e-9)


@examples(20)
@given(SEEDS, st.integers(1, 30), st.integers(1, 30))
def test_on_a_line_it_is_the_area_between_the_distributions(seed: int, n: int, m: int) -> None:
    """Any masses, zero included."""
    random = np.random.default_rng(seed)
    here, there = random.uniform(0.0, 100.0, n), random.uniform(0.0, 100.0, m)
    here_mass, there_mass = random.integers(0, 4, n) + 0.0, random.integers(0, 4, m) + 0.0
    here_mass[0] = there_mass[0] = 1.0

    distance = w1(
        np.column_stack((here, np.zeros(n))),
        here_mass,
        np.column_stack((there, np.zeros(m))),
        there_mass,
    )

    expected = wasserstein_distance(here, there, here_mass, there_mass)
    assert distance == pytest.approx(expected, rel=1e-9, abs=1e-9)


def judged(records: tuple[Record, ...], every: int) -> tuple[list[DensityRow], Checker]:
    """The rows of a record with exact distances, and a checker that has seen them."""
    metrics, checker = DensityMetrics(every), Checker()
    pipeline = Pipeline(metrics)
    for record in records:
        pipeline.observe(record)
    for row in metrics.rows:
        checker.observe_row(row)
    return metrics.rows, checker


@pytest.mark.parametrize("planner", sorted(set(get_args(PlannerName)) - MAP_PLANNERS))
@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize(("order", "coordination"), [*product(ORDERS, COORDINATIONS)])
def test_no_bound_lies_below_it(
    played: Play, planner: str, merge: str, order: str, coordination: str
) -> None:
    """Theorems 1-3, wherever they claim to hold: no sample filled twice, samples stand."""
    claimed = 0
    for seed in range(6):
        overrides = (
            f"planner={planner}",
            f"clock.order={order}",
            f"coordination={coordination}",
            "metrics.every=1",
        )
        rows, checker = judged(played(*MERGES[merge], *overrides, seed=seed), every=5)
        claimed += sum(row.w1_exact is not None and row.w_ub_tight is not None for row in rows)

        assert checker.violations == []
    assert claimed >= 6  # at the start at least it claims to hold


def test_of_one_robot_at_the_start_the_bound_is_exact(played: Play) -> None:
    """Theorem 1: all mass is where the robot stands, and there is one way to ship it."""
    one = ("robots.count=1", "starts.random=true", "energy.points=90", "energy.steps=90")
    rows, _ = judged(played(*one, "metrics.every=1"), every=10)

    assert rows[0].w1_exact == pytest.approx(rows[0].w_ub_tight, rel=1e-9)
    assert rows[0].w_ub_tight == pytest.approx(rows[0].w_ub_paper, rel=1e-12)


def test_it_is_computed_when_asked_for(played: Play) -> None:
    records = played("metrics.every=1")

    def ticks(every: int | None) -> list[int]:
        metrics = DensityMetrics(every)
        pipeline = Pipeline(metrics)
        for record in records:
            pipeline.observe(record)
        return [row.tick for row in metrics.rows if row.w1_exact is not None]

    last = judged(records, every=0)[0][-1].tick
    assert ticks(None) == []
    assert ticks(0) == [last]
    assert ticks(7) == sorted({*range(0, last + 1, 7), last})


def test_walking_samples_have_no_bound_but_a_distance(played: Play) -> None:
    """What was shipped to where a sample stood says nothing about where it stands now."""
    rows, _ = judged(played("samples.diffusion_m=2"), every=0)

    assert {row.w_ub_tight for row in rows} == {None}
    assert rows[-1].w1_exact is not None


@pytest.mark.parametrize("form", ["w_ub_tight", "w_ub_paper"])
def test_checker_tells_of_a_bound_below_it(played: Play, form: str) -> None:
    rows, _ = judged(played("clock.order=turn", "metrics.every=1"), every=0)
    row = rows[0]._replace(w1_exact=1.0, w_ub_tight=1.0, w_ub_paper=1.0)
    checker = Checker()

    checker.observe_row(row._replace(**{form: 0.999}))

    assert [line.partition(":")[0] for line in checker.violations] == ["bound"]
    checker.observe_row(row._replace(w_ub_tight=None, w_ub_paper=0.1))  # it does not claim to hold
    assert checker.count == 1
