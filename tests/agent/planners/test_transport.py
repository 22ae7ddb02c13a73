"""The optimal-transport planner (Kabir & Lee, III-A, eq. 2-3), against its literal enumeration."""

import math
from itertools import pairwise, permutations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.belief.belief import Belief
from kantor_agent.planners.registry import PLANNERS
from kantor_agent.planners.transport import Transport, first_of_best_order
from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.machine import Pose
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.replication.replica import Replica
from kantor_protocol.wire.weights import Units
from support.strategies import Points, crowds, examples, mission, scattered

Place = tuple[float, float]
PLACES_M = st.tuples(st.floats(-50.0, 150.0), st.floats(-50.0, 150.0))
LATTICE_M = st.tuples(st.integers(-2, 2).map(float), st.integers(-2, 2).map(float))


def way(a: Place, b: Place) -> float:
    """The distance, rounded as the planner rounds it."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    return math.sqrt(dx * dx + dy * dy)


def literal_first(candidates: list[tuple[Place, int]], x: float, y: float) -> int:
    """Eq. 2-3 by all h! orders in lexicographic order; the first of the cheapest begins the plan.

    Costs are summed from the end of an order to its beginning, so that rounding is the same.
    """
    best, first = math.inf, 0
    for order in permutations(range(len(candidates))):
        cost = 0.0
        for before, after in reversed(list(pairwise(order))):
            place, weight = candidates[after]
            cost = way(candidates[before][0], place) / weight + cost
        place, weight = candidates[order[0]]
        cost = way((x, y), place) / weight + cost
        if cost < best:
            best, first = cost, order[0]
    return first


def planned_first(candidates: list[tuple[Place, int]], x: float, y: float) -> int:
    """The same question to the recursion."""
    h = len(candidates)
    return int(
        first_of_best_order(
            np.array([place for place, _ in candidates]),
            np.array([weight for _, weight in candidates], dtype=np.int64),
            x,
            y,
            np.arange(h, dtype=np.int64),
            h,
            np.zeros((1 << h, h)),
        )
    )


def belief_over(
    samples_m: Points, weights: list[int], *, me: int = 0, origins: int = 1, claims: bool = False
) -> Belief:
    """A belief in which each sample has the given weight of at most 5."""
    units = Units(whole=5 * samples_m.shape[0], sample=5, point=5)
    replica = Replica(me, origins, samples_m.shape[0], units, ledger=True, claims=claims)
    replica.weights[:] = weights
    return Belief(RandomWalk(samples_m, 0.0, 1, 1, Purpose.SAMPLE_WALK), units, replica)


def ranked(samples_m: Points, weights: list[int], x: float, y: float) -> list[int]:
    """Samples with weight by (squared distance, index)."""
    keys = [
        ((px - x) * (px - x) + (py - y) * (py - y), j)
        for j, (px, py) in enumerate(samples_m.tolist())
        if weights[j] > 0
    ]
    return [j for _, j in sorted(keys)]


def choose(belief: Belief, horizon: int, x: float, y: float, now_ns: int = 1) -> int:
    """The goal's sample, or -1; a goal stands where its sample stands."""
    goal = Transport(horizon).choose(belief, Pose(x, y), now_ns)
    if goal is None:
        return -1

    assert [goal.x_m, goal.y_m] == belief.grid.xy_m[goal.sample].tolist()
    return goal.sample


def claimed_by_another(belief: Belief, origin: int, sample: int, since_ns: int = 0) -> None:
    """Let the belief know of a claim."""
    numbers = bytes([origin, 1, sample + 1, since_ns])
    origins = belief.replica.store.length.shape[0]

    assert belief.replica.merge(origin, bytes(2 * origins), b"", numbers)


@examples(120)
@given(
    candidates=st.lists(st.tuples(PLACES_M, st.integers(1, 9)), min_size=1, max_size=6),
    at=PLACES_M,
)
def test_recursion_equals_the_literal_enumeration(
    candidates: list[tuple[Place, int]], at: Place
) -> None:
    """III-A, eq. 2-3: the minimum over all h! orders, to the last bit, for h up to 6."""
    assert planned_first(candidates, *at) == literal_first(candidates, *at)


@examples(120)
@given(
    candidates=st.lists(st.tuples(LATTICE_M, st.sampled_from([1, 2])), min_size=1, max_size=6),
    at=LATTICE_M,
)
def test_ties_are_broken_as_in_the_enumeration(
    candidates: list[tuple[Place, int]], at: Place
) -> None:
    """Equal costs (papers, 2.3): the order that comes first lexicographically in the ranking."""
    assert planned_first(candidates, *at) == literal_first(candidates, *at)


@examples(120)
@given(
    data=st.data(),
    samples_m=crowds().filter(lambda xy_m: xy_m.shape[0] <= 25),
    horizon=st.integers(1, 5),
)
def test_goal_begins_the_best_order_through_the_nearest(
    data: st.DataObject, samples_m: Points, horizon: int
) -> None:
    """The candidates are the h nearest samples that have weight; all of them if fewer remain."""
    count = samples_m.shape[0]
    weights = data.draw(st.lists(st.integers(0, 5), min_size=count, max_size=count))
    at = data.draw(PLACES_M)
    near = ranked(samples_m, weights, *at)[:horizon]
    places = [(float(x), float(y)) for x, y in samples_m]
    candidates = [(places[j], weights[j]) for j in near]
    expected = near[literal_first(candidates, *at)] if near else -1

    assert choose(belief_over(samples_m, weights), horizon, *at) == expected


def test_heavier_sample_is_cheaper() -> None:
    """Eq. 2 divides the way by the weight: the robot turns first to where much is left."""
    samples_m = np.array([[10.0, 0.0], [12.0, 0.0]])

    assert choose(belief_over(samples_m, [1, 5]), 2, 0.0, 0.0) == 1
    assert choose(belief_over(samples_m, [5, 5]), 2, 0.0, 0.0) == 0


@pytest.mark.parametrize("horizon", range(1, 13))
def test_every_horizon_that_a_scenario_allows_runs(horizon: int) -> None:
    """From h = 1 to 12; with one sample left every horizon chooses it."""
    samples_m = scattered(40)
    weights = [(3 * j) % 6 for j in range(40)]
    planner = PLANNERS["transport"](mission(f"planner.horizon={horizon}"))
    goal = planner.choose(belief_over(samples_m, weights), Pose(50.0, 50.0), 1)

    assert goal is not None
    assert weights[goal.sample] > 0
    assert goal.sample in ranked(samples_m, weights, 50.0, 50.0)[:horizon]
    assert choose(belief_over(samples_m, [0] * 39 + [1]), horizon, 0.0, 0.0) == 39


def test_horizon_of_1_heads_for_the_nearest() -> None:
    """Greedy, for h = 1, whatever the weights."""
    samples_m = scattered(40)
    weights = [1 + j % 5 for j in range(40)]

    assert (
        choose(belief_over(samples_m, weights), 1, 50.0, 50.0)
        == ranked(samples_m, weights, 50.0, 50.0)[0]
    )


def test_without_weight_there_is_no_goal() -> None:
    """Nothing to head for."""
    assert choose(belief_over(scattered(4), [0] * 4), 3, 0.0, 0.0) == -1


@examples(60)
@given(
    taken=st.sets(st.integers(0, 7), min_size=1, max_size=3),
    horizon=st.integers(1, 4),
    at=PLACES_M,
)
def test_claimed_samples_are_left_to_those_who_claimed_them(
    taken: set[int], horizon: int, at: Place
) -> None:
    """The plan is the one that would be made if the others' samples were not there."""
    samples_m = scattered(8)
    belief = belief_over(samples_m, [5] * 8, me=3, origins=4, claims=True)
    for origin, sample in enumerate(sorted(taken)):
        claimed_by_another(belief, origin, sample)
    without = [0 if j in taken else 5 for j in range(8)]

    assert choose(belief, horizon, *at) == choose(belief_over(samples_m, without), horizon, *at)


def test_when_all_is_claimed_a_goal_is_still_found() -> None:
    """Better two at one sample than one idle."""
    belief = belief_over(scattered(3), [5] * 3, me=3, origins=4, claims=True)
    for sample in range(3):
        claimed_by_another(belief, sample, sample)

    assert choose(belief, 3, 50.0, 50.0) == choose(
        belief_over(scattered(3), [5] * 3), 3, 50.0, 50.0
    )


def test_goal_is_claimed_and_a_claim_of_equals_is_settled_by_id() -> None:
    """Two newcomers at one sample: r1 keeps it, r2 plans again without it."""
    samples_m = np.array([[10.0, 0.0], [20.0, 0.0]])
    first = belief_over(samples_m, [5, 5], me=0, origins=2, claims=True)
    second = belief_over(samples_m, [5, 5], me=1, origins=2, claims=True)
    alone = [choose(belief, 1, 0.0, 0.0, now_ns=100) for belief in (first, second)]
    words = [belief.replica.compose() for belief in (first, second)]
    first.replica.merge(1, *words[1])
    second.replica.merge(0, *words[0])
    together = [choose(belief, 1, 0.0, 0.0, now_ns=200) for belief in (first, second)]

    assert (alone, together) == ([0, 0], [0, 1])


def test_without_claims_nothing_is_claimed() -> None:
    """Without claims the planner leaves no trace in what the robot tells."""
    belief = belief_over(scattered(3), [5] * 3, origins=2)
    before = [array.tolist() for array in belief.replica.store]
    choose(belief, 3, 50.0, 50.0)

    assert [array.tolist() for array in belief.replica.store] == before


@examples(40)
@given(at=PLACES_M, horizon=st.integers(1, 6), seed=st.integers(0, 100))
def test_same_belief_same_goal(at: Place, horizon: int, seed: int) -> None:
    """A planner that has planned before plans as a new one does."""
    samples_m: npt.NDArray[np.float64] = scattered(20, seed)
    planner = Transport(horizon)
    belief = belief_over(samples_m, [5] * 20)
    planner.choose(belief, Pose(0.0, 0.0), 1)

    assert planner.choose(belief, Pose(*at), 2) == Transport(horizon).choose(belief, Pose(*at), 2)
