"""Table 1 of Burgard et al.: worked by hand, against a literal reference, and every option of it."""

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners.burgard import Burgard, coverage, discount, in_sight
from kantor_agent.planners.map_base import Situation, Task
from kantor_protocol.base.grid import NOWHERE, OCCUPIED
from kantor_protocol.replication.occupancy_log import RANGE_BINS
from support.strategies import examples
from support.teams.floors import Floor, crowded, drawn, member

CORRIDOR = ["  ........  "]
"""Frontiers are 2 and 9, and the sensor reaches 3 cells."""
ROOMS = [
    " ......... ",
    "###########",
    " ......... ",
]
"""Frontiers are 1, 9, 23 and 31."""
OPTIONS = st.fixed_dictionaries(
    {
        "coordinated": st.booleans().map(lambda yes: str(yes).lower()),
        "beta": st.sampled_from(["0", "0.3", "1", "10"]),
        "coverage": st.sampled_from(["histogram", "linear", "disc"]),
        "discount": st.sampled_from(["multiply", "subtract"]),
        "sight": st.booleans().map(lambda yes: str(yes).lower()),
    }
).map(lambda options: tuple(f"planner.{key}={value}" for key, value in options.items()))


def targets(floor: Floor, situation: Situation) -> list[int]:
    """What the planner chooses."""
    return [task.target for task in Burgard(floor.scenario, 0, None).assign(situation)]


# By hand.


def test_the_best_pair_comes_first_and_the_other_robot_turns_away() -> None:
    """U - V is 2/3 for robot 0 and cell 2. That leaves robot 1 cell 9: 1 - 4/3 is more than 0 - 1."""
    floor = drawn(CORRIDOR)
    both = [member(0, 3), member(1, 5)]

    assert targets(floor, floor.situation(both)) == [2, 9]


def test_uncoordinated_robots_take_their_cheapest_frontier() -> None:
    """Robot 1 has 3 cells to go to 2, and 4 to 9."""
    floor = drawn(CORRIDOR, "planner.coordinated=false")
    situation = floor.situation([member(0, 3), member(1, 5)], [member(2, 3, 2)], [2])

    assert targets(floor, situation) == [2, 2]


def test_the_better_pair_wins_whatever_the_order_of_robots() -> None:
    """The robot that is nearer gets it, not the one with the lower place."""
    floor = drawn(CORRIDOR)

    assert targets(floor, floor.situation([member(0, 5), member(1, 3)])) == [9, 2]


def test_of_equal_pairs_it_is_the_shorter_way_then_the_robot_then_the_cell() -> None:
    """With a sensor of 4 cells, 0 - 1/4 equals 1 - 5/4: the way to 2 is shorter than that to 8."""
    floor = drawn(["  .......  "], "sensor.range_m=4.0")
    others = [member(2, 5, 2)]
    assert targets(floor, floor.situation([member(0, 3)], others)) == [2]

    assert targets(floor, floor.situation([member(0, 3), member(1, 3)])) == [2, 2]
    assert targets(floor, floor.situation([member(0, 4), member(1, 4)])) == [2, 8]
    assert targets(floor, floor.situation([member(0, 5)])) == [2]


def test_with_more_robots_than_frontiers_every_robot_gets_one() -> None:
    """A worth of 0 is still something to go for."""
    floor = drawn(CORRIDOR)

    assert sorted(targets(floor, floor.situation([member(i, 5 + i % 2) for i in range(5)]))) == [
        2,
        2,
        2,
        9,
        9,
    ]


def test_a_robot_that_reaches_no_frontier_gets_no_target() -> None:
    """Behind a wall, in a wall, or when there is no frontier at all."""
    floor = drawn(["###.....", "#.#####."])
    sealed, inside, free = member(0, 9), member(1, 0), member(2, 7)
    assert targets(floor, floor.situation([sealed, inside, free])) == [NOWHERE] * 3

    floor = drawn(["###.... ", "#.#####."])
    assert targets(floor, floor.situation([sealed, inside, member(2, 3)])) == [NOWHERE, NOWHERE, 6]

    uncoordinated = drawn(["###.... ", "#.#####."], "planner.coordinated=false")
    found = targets(uncoordinated, uncoordinated.situation([sealed, inside, member(2, 3)]))
    assert found == [NOWHERE, NOWHERE, 6]


@pytest.mark.parametrize("taken", ["others", "absent"])
def test_targets_of_others_reduce_utilities_before_the_first_choice(taken: str) -> None:
    """From 4 it is 2 cells to 2, but somebody is on the way there; who stands there stays all the same."""
    floor = drawn(["  ......  "])
    others = [member(1, 5, 2)] if taken == "others" else []
    absent = [2] if taken == "absent" else []
    situation = floor.situation([member(0, 4)], others, absent)

    assert targets(floor, situation) == [7]
    assert targets(floor, floor.situation([member(0, 2)], others, absent)) == [2]
    assert targets(floor, floor.situation([member(0, 4)], [member(1, 5)])) == [2]


# The options.


def utilities(*chosen: int, subtract: bool, shares: Sequence[float] = ()) -> list[float]:
    """U of the cells 0 to 6 in a row after targets were chosen, with a sensor of 4 cells."""
    utility = np.ones(7)
    row, cells = np.arange(7), np.ones(7, dtype=np.uint8)
    for target in chosen:
        discount(
            utility, row, target, 4.0, np.array(shares, dtype=float), subtract, False, cells, 7
        )
    return utility.tolist()


def test_utilities_are_multiplied_or_lessened() -> None:
    """With P(d) = 1 - d / 4; to subtract can leave less than nothing."""
    assert utilities(0, subtract=False) == [0.0, 0.25, 0.5, 0.75, 1.0, 1.0, 1.0]
    assert utilities(0, subtract=True) == [0.0, 0.25, 0.5, 0.75, 1.0, 1.0, 1.0]
    assert utilities(0, 2, subtract=False) == [0.0, 0.0625, 0.0, 0.1875, 0.5, 0.75, 1.0]
    assert utilities(0, 2, subtract=True) == [-0.5, -0.5, -0.5, 0.0, 0.5, 0.75, 1.0]
    assert utilities(3, subtract=False, shares=[1.0]) == [0.0] * 7
    assert utilities(0, subtract=False, shares=[1.0]) == [0.0] * 5 + [1.0, 1.0]


def test_coverage_is_learned_from_measured_ranges() -> None:
    """Eq. 4: three of four were at least as long as bin 10, two came back from the end or not at all."""
    floor = drawn(CORRIDOR)
    floor.measure(0, 10, RANGE_BINS - 1, RANGE_BINS - 1)
    shares = Burgard(floor.scenario, 0, None).shares(floor.fused_map.ranges)
    ten = 10 / RANGE_BINS

    assert coverage(0.0, 1.0, shares) == 1.0
    assert coverage(ten, 1.0, shares) == coverage(ten / 2, 1.0, shares) == 0.75
    assert coverage(ten + 0.1, 1.0, shares) == coverage(1.0, 1.0, shares) == 0.5
    assert coverage(1.0 + 1e-9, 1.0, shares) == 0.0


def test_where_nothing_was_measured_coverage_falls_evenly() -> None:
    """The same as without learning."""
    floor = drawn(CORRIDOR)
    shares = Burgard(floor.scenario, 0, None).shares(floor.fused_map.ranges)

    assert [coverage(d, 4.0, shares) for d in (0.0, 1.0, 4.0, 5.0)] == [1.0, 0.75, 0.0, 0.0]


@pytest.mark.parametrize(("kind", "at_2"), [("linear", 1 / 3), ("disc", 1.0)])
def test_coverage_that_is_not_learned(kind: str, at_2: float) -> None:
    """Whatever was measured."""
    floor = drawn(CORRIDOR, f"planner.coverage={kind}")
    floor.measure(*[0] * 7)
    shares = Burgard(floor.scenario, 0, None).shares(floor.fused_map.ranges)

    assert coverage(2.0, 3.0, shares) == pytest.approx(at_2)
    assert coverage(3.1, 3.0, shares) == 0.0


def test_a_wall_in_between_keeps_the_utility_behind_it() -> None:
    """Cell 23 is 2 cells from a target at 1: worth 0 in the disc, unless sight counts."""
    options = ("planner.coverage=disc", "planner.beta=0.5")
    blind, seeing = drawn(ROOMS, *options), drawn(ROOMS, *options, "planner.sight=true")
    below = member(0, 25)

    assert targets(blind, blind.situation([below], absent=[1])) == [31]
    assert targets(seeing, seeing.situation([below], absent=[1])) == [23]


@pytest.mark.parametrize(("beta", "chosen"), [("0", [2, 9]), ("1", [2, 9]), ("100", [2, 2])])
def test_beta_weighs_cost_against_worth(beta: str, chosen: list[int]) -> None:
    """A dear way makes robots take what is near even if it is worth nothing any more."""
    floor = drawn(CORRIDOR, f"planner.beta={beta}")

    assert targets(floor, floor.situation([member(0, 3), member(1, 5)])) == chosen


# Against references.


@examples(150)
@given(data=st.data(), options=OPTIONS)
def test_one_robot_needs_no_coordination(data: st.DataObject, options: tuple[str, ...]) -> None:
    """To the last bit the cheapest frontier, whatever the options; of equal ones the lowest."""
    floor, situation = data.draw(crowded(*options))
    alone = situation._replace(members=situation.members[:1], others=(), absent=())
    travel = floor.cost_map.travel(alone.members[0].cell)[alone.frontiers]
    nearest = int(alone.frontiers[travel.argmin()]) if np.isfinite(travel).any() else NOWHERE

    assert targets(floor, alone) == [nearest]


@examples(300)
@given(data=st.data(), options=OPTIONS, ranges=st.lists(st.integers(0, 9), max_size=RANGE_BINS))
def test_the_assignment_is_that_of_the_table(
    data: st.DataObject, options: tuple[str, ...], ranges: list[int]
) -> None:
    """On any floor, to the last bit: the kernel against the paper's loop in plain numbers."""
    floor, situation = data.draw(crowded(*options))
    floor.measure(*np.repeat(np.arange(len(ranges)), ranges).tolist())

    assert targets(floor, situation) == by_the_table(floor, situation)


def by_the_table(floor: Floor, situation: Situation) -> list[int]:
    """Table 1, literally."""
    planner, columns = floor.scenario.planner, floor.fused_map.frame.columns
    reach = floor.cost_map.sensor_cells
    frontiers, robots = situation.frontiers.tolist(), range(len(situation.members))
    cost = {
        (i, t): float(floor.cost_map.travel(situation.members[i].cell)[t]) / reach
        for i in robots
        for t in frontiers
    }
    pairs = {pair for pair, v in cost.items() if v < math.inf}
    if not planner.coordinated:
        own = [[t for j, t in pairs if j == i] for i in robots]
        return [
            min(ts, key=lambda t, i=i: (cost[i, t], t)) if ts else NOWHERE
            for i, ts in enumerate(own)
        ]
    worth = dict.fromkeys(frontiers, 1.0)

    def lessen(target: int) -> None:
        for t in frontiers:
            rise, run = t // columns - target // columns, t % columns - target % columns
            d = math.sqrt(rise * rise + run * run)  # hypot may differ in the last bit
            seen = not planner.sight or sees(floor, target, t)
            p = share_of(floor, d, reach) if seen else 0.0
            worth[t] = worth[t] - p if planner.discount == "subtract" else worth[t] * (1.0 - p)

    for other in situation.others:
        if other.task != Task():
            lessen(other.task.target)
    for target in situation.absent:
        lessen(target)
    chosen = {}
    while pairs:
        i, t = max(
            pairs, key=lambda p: (worth[p[1]] - planner.beta * cost[p], -cost[p], -p[0], -p[1])
        )
        chosen[i] = t
        pairs = {pair for pair in pairs if pair[0] != i}
        lessen(t)
    return [chosen.get(i, NOWHERE) for i in robots]


def share_of(floor: Floor, d: float, reach: float) -> float:
    """P(d)."""
    counts, kind = floor.fused_map.ranges.tolist(), floor.scenario.planner.coverage
    if d > reach:
        return 0.0
    if kind == "disc":
        return 1.0
    if kind == "linear" or sum(counts) == 0:
        return 1.0 - d / reach
    bin_of_d = min(math.floor(d / reach * RANGE_BINS), RANGE_BINS - 1)
    return sum(counts[bin_of_d:]) / sum(counts)


def sees(floor: Floor, one: int, other: int) -> bool:
    """Whether the line between two cells' middles touches no wall, its border included, in exact numbers."""
    columns = floor.fused_map.frame.columns
    half = Fraction(1, 2)
    places = [(Fraction(c // columns) + half, Fraction(c % columns) + half) for c in (one, other)]
    for wall in np.flatnonzero(floor.fused_map.cells == OCCUPIED).tolist():
        enter, leave = Fraction(0), Fraction(1)
        for axis, low in enumerate((wall // columns, wall % columns)):
            start, step = places[0][axis], places[1][axis] - places[0][axis]
            if step == 0:
                if not low <= start <= low + 1:
                    leave = Fraction(-1)
                continue
            first, last = sorted(((low - start) / step, (low + 1 - start) / step))
            enter, leave = max(enter, first), min(leave, last)
        if enter <= leave and wall != one:  # where the line begins does not count
            return False
    return True


@examples(200)
@given(data=st.data())
def test_sight_is_exact(data: st.DataObject) -> None:
    """A line that touches a wall, were it with a corner, is blocked; either end may ask."""
    floor, _ = data.draw(crowded())
    cells = floor.fused_map.cells
    open_floor = np.flatnonzero(cells != OCCUPIED).tolist()
    if not open_floor:
        return
    one, other = (data.draw(st.sampled_from(open_floor)) for _ in range(2))
    columns = floor.fused_map.frame.columns

    assert in_sight(cells, columns, one, other) == sees(floor, one, other)
    assert in_sight(cells, columns, other, one) == sees(floor, one, other)
