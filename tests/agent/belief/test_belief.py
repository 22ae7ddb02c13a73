"""The belief: shipping a point exactly (Kabir & Lee, Prop. 1), samples that move."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from kantor_agent.belief.belief import Belief
from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.base.varint import Pairs
from kantor_protocol.replication.replica import Replica
from kantor_protocol.wire.weights import Units
from support.replication.replicas import entries
from support.strategies import Points, crowds, examples, scattered

Plan = list[tuple[int, int]]
"""(sample, units), nearest first."""


def belief_over(
    samples_m: Points,
    points: int,
    *,
    me: int = 0,
    origins: int = 1,
    ledger: bool = True,
    diffusion_m: float = 0.0,
) -> Belief:
    """A robot's belief before any spending."""
    units = Units.of(points, samples_m.shape[0])
    random_walk = RandomWalk(samples_m, diffusion_m, 1, 1, Purpose.SAMPLE_WALK)
    replica = Replica(me, origins, samples_m.shape[0], units, ledger=ledger, claims=False)
    return Belief(random_walk, units, replica)


def spend(belief: Belief, x_m: float, y_m: float) -> Plan:
    """Ship one point from a place, and what went where."""
    arrays = Pairs().decode(belief.spend(x_m, y_m), belief.weights.shape[0])

    assert arrays is not None
    return list(zip(arrays[0].tolist(), arrays[1].tolist(), strict=True))


def distances(samples_m: Points, x_m: float, y_m: float) -> list[float]:
    """From a place to every sample."""
    return [math.hypot(x - x_m, y - y_m) for x, y in samples_m.tolist()]


def cost(plan: Plan, samples_m: Points, x_m: float, y_m: float) -> float:
    """W~ of eq. 5 in units times metres."""
    way_m = distances(samples_m, x_m, y_m)
    return math.fsum(units * way_m[sample] for sample, units in plan)


def least_cost(weights: list[int], mass: int, samples_m: Points, x_m: float, y_m: float) -> float:
    """The linear program of eq. 5: the cheapest way to ship `mass` into what samples can take."""
    solution = linprog(
        distances(samples_m, x_m, y_m),
        A_eq=np.ones((1, len(weights))),
        b_eq=[mass],
        bounds=[(0, weight) for weight in weights],
    )

    assert solution.success
    return float(solution.fun)


def in_grid(belief: Belief) -> set[int]:
    """The samples that the search can find."""
    alive = belief.grid.alive[-(belief.grid.first.shape[0] - 1) :].tolist()
    return {
        int(belief.grid.order[int(belief.grid.first[c]) + i])
        for c, count in enumerate(alive)
        for i in range(count)
    }


PLACES_M = st.tuples(st.floats(-50.0, 150.0), st.floats(-50.0, 150.0))


@examples(40)
@given(
    count=st.integers(1, 7),
    points=st.integers(1, 20),
    places_m=st.lists(PLACES_M, min_size=1, max_size=6),
    seed=st.integers(0, 1000),
)
def test_shipping_solves_the_linear_program(
    count: int, points: int, places_m: list[tuple[float, float]], seed: int
) -> None:
    """Prop. 1: filling the nearest samples first is optimal for eq. 5, at every step."""
    samples_m = scattered(count, seed)
    belief = belief_over(samples_m, points)
    units = Units.of(points, count)
    for x_m, y_m in places_m:
        before = belief.weights.tolist()
        mass = min(units.point, sum(before))
        plan = spend(belief, x_m, y_m)

        assert cost(plan, samples_m, x_m, y_m) == pytest.approx(
            least_cost(before, mass, samples_m, x_m, y_m), rel=1e-7, abs=1e-7
        )


@examples(60)
@given(
    samples_m=crowds(),
    points=st.integers(1, 300),
    places_m=st.lists(PLACES_M, min_size=1, max_size=8),
)
def test_point_ships_all_it_has_and_no_sample_gives_more_than_it_has(
    samples_m: Points, points: int, places_m: list[tuple[float, float]]
) -> None:
    """Eq. 4: the nearest sample gives min(n, m), then the next; total min(point, what is left)."""
    belief = belief_over(samples_m, points)
    units = Units.of(points, samples_m.shape[0])
    for x_m, y_m in places_m:
        before = belief.weights.tolist()
        plan = spend(belief, x_m, y_m)
        spent = dict(plan)
        after = [weight - spent.get(sample, 0) for sample, weight in enumerate(before)]
        order = [
            # Products, as the field takes them: pow() may round the last digit elsewhere.
            ((x - x_m) * (x - x_m) + (y - y_m) * (y - y_m), j)
            for j, (x, y) in enumerate(samples_m.tolist())
        ]

        assert len(spent) == len(plan)
        assert belief.weights.tolist() == after
        assert min(after) >= 0
        assert sum(spent.values()) == min(units.point, sum(before))
        assert [after[sample] for sample, _ in plan[:-1]] == [0] * (len(plan) - 1)
        assert [sample for sample, _ in plan] == [j for _, j in sorted(order) if before[j]][
            : len(plan)
        ]


@pytest.mark.parametrize(
    ("points", "count"), [(5, 2), (12, 30), (30, 12), (7, 7), (1, 9), (9, 1), (1500, 7)]
)
@pytest.mark.parametrize("ledger", [True, False], ids=["ledger", "min"])
def test_energy_exhausts_the_mass_exactly(*, points: int, count: int, ledger: bool) -> None:
    """M points ship the whole mass, each its full 1/M, and then nothing is left; no residue."""
    belief = belief_over(scattered(count), points, ledger=ledger)
    units = Units.of(points, count)
    places_m = scattered(points, seed=3).tolist()
    shipped = []
    for x_m, y_m in places_m:
        assert not belief.empty
        shipped.append(sum(units for _, units in spend(belief, x_m, y_m)))

    assert shipped == [units.point] * points
    assert belief.weights.tolist() == [0] * count
    assert belief.empty
    assert spend(belief, 0.0, 0.0) == []


def test_last_point_ships_what_is_left() -> None:
    """A point that finds less than it could ship leaves nothing behind."""
    one, other = (belief_over(scattered(1), 5, me=me, origins=2) for me in range(2))
    for _ in range(4):
        spend(other, 0.0, 0.0)
    version_vector, logs, claims = other.replica.compose(0)
    one.replica.merge(1, version_vector, logs, claims)
    one.advance(0)

    assert one.weights.tolist() == [1]
    assert spend(one, 0.0, 0.0) == [(0, 1)]
    assert one.empty


@pytest.mark.parametrize("ledger", [True, False], ids=["ledger", "min"])
def test_belief_stays_exact_when_logs_outgrow_their_arrays(*, ledger: bool) -> None:
    """A long log of one's own and a long one that comes in at once: nothing is lost of either."""
    one, other = (
        belief_over(scattered(5), 2000, me=me, origins=2, ledger=ledger) for me in range(2)
    )
    shipped: list[Plan] = [[], []]
    for x_m, y_m in scattered(700, seed=3).tolist():
        for plan, belief in zip(shipped, (one, other), strict=True):
            plan.extend(spend(belief, x_m if belief is one else 100.0 - x_m, y_m))
            belief.advance(0)
            belief.replica.end_step()
    version_vector, logs, claims = other.replica.compose(0)
    assert one.replica.merge(1, version_vector, logs, claims)
    one.advance(0)
    left = [min(a, b) for a, b in zip(one.weights.tolist(), other.weights.tolist(), strict=True)]
    if ledger:
        left = [400] * 5
        for sample, units in shipped[0] + shipped[1]:
            left[sample] -= units

    assert one.weights.tolist() == [max(0, weight) for weight in left]
    plan = spend(one, 50.0, 50.0)
    assert entries(one.replica, 0)[-1][0] == plan[-1][0]
    assert sum(one.weights.tolist()) == sum(max(0, weight) for weight in left) - 1


@examples(60)
@given(
    count=st.integers(1, 12),
    ledger=st.booleans(),
    diffusion_m=st.sampled_from([0.0, 30.0]),
    actions=st.lists(
        st.tuples(st.sampled_from(["spend", "other spends", "message", "time"]), PLACES_M),
        max_size=25,
    ),
)
def test_exactly_the_samples_with_weight_can_be_found(
    *,
    count: int,
    ledger: bool,
    diffusion_m: float,
    actions: list[tuple[str, tuple[float, float]]],
) -> None:
    """The invariants of a belief, through spending, messages, and samples that move."""
    belief, other = (
        belief_over(scattered(count), 10, me=me, origins=2, ledger=ledger, diffusion_m=diffusion_m)
        for me in range(2)
    )
    for now_ns, (action, (x_m, y_m)) in enumerate(actions):
        if action == "spend":
            belief.spend(x_m, y_m)
        elif action == "other spends":
            other.spend(x_m, y_m)
        elif action == "message":
            version_vector, logs, claims = other.replica.compose(0)
            belief.replica.merge(1, version_vector, logs, claims)
        belief.advance(now_ns)
        alive = {j for j, weight in enumerate(belief.weights.tolist()) if weight > 0}

        belief.validate()
        assert in_grid(belief) == alive
        assert belief.empty == (not alive)
        belief.replica.end_step()
        other.replica.end_step()


def test_nearest_samples_are_those_with_weight() -> None:
    """Nearest first, at most as many as asked for, and none that is used up."""
    samples_m = np.array([[float(x), 0.0] for x in range(6)])
    belief = belief_over(samples_m, 6)
    before = belief.nearest(2.1, 0.0, 3).tolist()
    spend(belief, 2.1, 0.0)

    assert before == [2, 3, 1]
    assert belief.nearest(2.1, 0.0, 3).tolist() == [3, 1, 4]
    assert belief.nearest(2.1, 0.0, 9).tolist() == [3, 1, 4, 0, 5]


def test_search_follows_samples_that_walk() -> None:
    """Eq. 14: weight is spent where samples are now, not where they were."""
    walk = RandomWalk(scattered(50), 30.0, 1, 1, Purpose.SAMPLE_WALK)
    walk.advance(5)
    order = np.argsort(np.hypot(*(walk.xy_m - [50.0, 50.0]).T))
    belief = belief_over(scattered(50), 50, diffusion_m=30.0)
    belief.advance(5)
    found = [spend(belief, 50.0, 50.0) for _ in range(10)]

    assert found == [[(int(sample), 1)] for sample in order[:10]]


@examples(40)
@given(places_m=st.lists(PLACES_M, max_size=12), ledger=st.booleans())
def test_lowered_entries_are_the_difference_of_the_vectors(
    *, places_m: list[tuple[float, float]], ledger: bool
) -> None:
    """What a robot publishes of a step is exactly what fell in it."""
    belief = belief_over(scattered(6), 14, ledger=ledger)
    rebuilt = belief.weights.tolist()
    for x_m, y_m in places_m:
        before = belief.weights.tolist()
        belief.spend(x_m, y_m)
        arrays = Pairs().decode(belief.replica.packed_lowered(), 6)
        assert arrays is not None
        for sample, left in zip(arrays[0].tolist(), arrays[1].tolist(), strict=True):
            assert left < before[sample]
            rebuilt[sample] = left

        assert rebuilt == belief.weights.tolist()
        belief.replica.end_step()
