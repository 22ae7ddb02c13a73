"""KME: regions of unknown cells, their robots, and targets on the way (Puig, Garcia, Wu)."""

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from kantor_agent.planners import kmeans
from kantor_agent.planners.kmeans import NO_REGION, PARTS, KMeans, Regions, choose
from kantor_agent.planners.map_base import Situation, Task
from kantor_fleet.execution.in_process_team import play, team
from kantor_protocol.base.grid import FREE, NOWHERE, OCCUPIED, UNKNOWN
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.starts import observable
from kantor_worldsim.world.world import WorldSetup, ground_of
from support.references.plain_kmeans import SETTLED
from support.teams.floors import drawn, member

MISSION = """
name = "regions"
robots = { count = 4 }
starts = { random = true, spots = 15 }
map = { layout = "blank" }
clock = { period_s = 1.0 }
vehicle = { speed_m_s = 1.0 }
sensor = { range_m = 3.0, beams = 64 }
planner = { name = "kmeans", cost = "length" }
"""


def mission(*overrides: str) -> Scenario:
    return parse(MISSION, "regions", overrides)


def situation_of(
    *rows: str, memos: tuple[tuple[int, ...], ...] = (), dead: int = NOWHERE
) -> Situation:
    """Row 0 first: free floor, #, ?, and robots a, b, c … on free floor. dead: a dead frontier."""
    floor = drawn([re.sub("[a-z]", ".", row) for row in rows])
    if dead != NOWHERE:
        floor.find_dead(dead)
    marks = "".join(rows)
    cells = [marks.index(mark) for mark in sorted(filter(str.isalpha, marks))]
    memo_of = [*memos, *[()] * len(cells)]
    members = [member(i, cell, memo=memo_of[i]) for i, cell in enumerate(cells)]
    return floor.situation(members)._replace(tick=7)


def assign(situation: Situation, seed: int = 1) -> list[Task]:
    return KMeans(mission(), seed, None).assign(situation)


def targets_of(situation: Situation) -> list[int]:
    return [task.target for task in assign(situation)]


def regions_of(situation: Situation, *columns: int) -> Regions:
    """The regions if centroids begin in these columns of row 0."""
    starts = np.array([(0, PARTS * column) for column in columns])
    cells = np.array([m.cell for m in situation.members])
    travel = np.stack(
        [situation.cost_map.travel(m.cell)[situation.frontiers] for m in situation.members]
    )
    return Regions(situation.cost_map, situation.frontiers, cells, starts, travel)


# Equations 1 to 5: robots and regions.


def test_an_accessible_region_is_as_far_as_the_way_to_a_frontier_beside_it() -> None:
    regions = regions_of(situation_of("a.#?", "...?"), 3)
    assert regions.accessible.all()
    # A diagonal step and a straight one to (1, 2); as the crow flies (0, 3) would be at 3.
    assert regions.distance.tolist() == [[1.0 + math.sqrt(2.0)]]
    assert regions.nearest.tolist() == [[7]]


def test_of_contour_cells_equally_far_the_first_is_the_nearest() -> None:
    assert regions_of(situation_of("##?", ".a.", "?##"), 1).nearest.tolist() == [[2]]


def test_an_inaccessible_region_is_as_far_as_the_straight_line() -> None:
    regions = regions_of(situation_of("ab??????"), 2, 6)
    # Columns 1 to 4, and 5 to 7; of the second only column 5 is on the edge.
    assert regions.accessible.tolist() == [[True, False], [True, False]]
    assert regions.distance.tolist() == [[1.0, 5.0], [0.0, 4.0]]
    assert regions.nearest.tolist() == [[2, 5], [2, 5]]


def test_a_known_obstacle_on_the_line_to_an_inaccessible_region_costs_the_diagonal() -> None:
    regions = regions_of(situation_of("a.#?????", "b..?????"), 4, 7)
    assert regions.accessible.tolist() == [[True, False], [True, False]]
    diagonal = math.sqrt(2**2 + 8**2)
    assert regions.diagonal == diagonal
    assert regions.distance[:, 1].tolist() == [6.0 + diagonal, 6.0]
    assert regions.nearest[:, 1].tolist() == [6, 14]


def test_unknown_cells_are_no_obstacle() -> None:
    regions = regions_of(situation_of("a.??????", "b..?????"), 4, 7)
    assert regions.distance[:, 1].tolist() == [5.0, 5.0]


def test_a_region_is_inaccessible_to_a_robot_that_cannot_reach_its_frontiers() -> None:
    regions = regions_of(situation_of("a#b.??"), 4, 5)
    assert regions.accessible[:, 0].tolist() == [False, True]
    assert regions.distance[0, 0] == 4.0 + regions.diagonal
    assert regions.distance[1, 0] == 1.0


def test_a_region_of_frontiers_alone_is_its_own_contour() -> None:
    # Column 2, and column 5 with the unknown cell beyond it.
    regions = regions_of(situation_of("?.ab.?"), 1, 5)
    assert regions.distance.tolist() == [[1.0, 2.0], [2.0, 1.0]]
    kinds = np.array([[FREE, FREE, UNKNOWN, FREE, FREE]])
    cells, region = kinds.ravel().astype(np.uint8), np.array([0, 1, 0, 0, 0])
    inside, contour = np.zeros(2, np.int64), np.zeros(4, np.int64)
    points = np.array([1, 2, 3])
    assert kmeans.find_contour(cells, 5, region, points, inside, contour) == 2
    assert contour[:2].tolist() == [1, 2]
    distance, nearest = np.full((1, 2), np.inf), np.full((1, 2), NOWHERE)
    travel = np.array([[1.0, np.inf]])
    frontiers = np.array([1, 3])
    kmeans.measure_accessible(cells, 5, region, inside, frontiers, travel, distance, nearest)
    assert distance.tolist() == [[1.0, 1.0]]
    assert nearest.tolist() == [[2, 1]]


def test_robots_get_regions_so_that_the_sum_of_the_distances_is_least() -> None:
    # The first robot is nearer to both, but the second has the longer way to the right one.
    regions = regions_of(situation_of("??.b.a...??"), 0, 10)
    assert regions.owned.tolist() == [1, 0]


# Equations 6 and 7: targets.


def chosen(  # the wall stands between the frontier (0, 4) and the contour cell (0, 6)
    *,
    wall: bool = False,
    taken: tuple[bool, bool] = (False, False),
    travel: tuple[float, float] = (2.0, 4.0),
    eligible: tuple[bool, bool] = (True, True),
    contour_cell: int = 6,
) -> int:
    cells = np.full(3 * 9, FREE, np.uint8)
    if wall:
        cells[5] = OCCUPIED
    frontiers = np.array([2 * 9 + 3, 4])  # 3.6 and 2.0 cells from the contour cell
    flags = (np.array(eligible), np.array(taken))
    return choose(cells, 9, frontiers, *flags, np.array(travel), contour_cell, 10.0)


def test_a_target_is_near_and_near_the_region() -> None:
    assert chosen() == 0  # 2 + 3.6 against 4 + 2
    assert chosen(travel=(2.5, 4.0)) == 1


def test_an_obstacle_between_frontier_and_region_costs_the_diagonal() -> None:
    assert chosen(travel=(13.0, 4.0)) == 1
    assert chosen(travel=(12.0, 4.0), wall=True) == 0  # 12 + 3.6 against 4 + 2 + 10
    assert chosen(travel=(13.0, 4.0), wall=True) == 1


@pytest.mark.parametrize(("wall", "target"), [(2, 1), (3, 0)])
def test_a_line_runs_from_the_frontier_to_the_region(wall: int, target: int) -> None:
    # From (0, 0) to (2, 1) it crosses (1, 0); the other way round it would cross (1, 1).
    cells = np.full(3 * 2, FREE, np.uint8)
    cells[wall] = OCCUPIED
    flags = np.ones(2, np.bool_), np.zeros(2, np.bool_)
    assert choose(cells, 2, np.array([0, 5]), *flags, np.array([0.0, 5.0]), 5, 10.0) == target


def test_a_taken_frontier_costs_two_diagonals() -> None:
    assert chosen(taken=(True, False)) == 1
    assert chosen(taken=(True, False), travel=(2.0, 23.0)) == 1  # 25.6 against 25
    assert chosen(taken=(True, False), travel=(2.0, 24.0)) == 0
    assert chosen(taken=(True, True)) == 0


def test_an_unreachable_frontier_is_no_target() -> None:
    assert chosen(travel=(math.inf, 99.0), taken=(False, True), wall=True) == 1
    assert chosen(travel=(math.inf, math.inf)) == -1
    assert chosen(eligible=(False, False)) == -1


def test_without_a_region_only_the_way_and_taken_frontiers_count() -> None:
    assert chosen(contour_cell=NOWHERE, travel=(5.0, 4.0)) == 1
    assert chosen(contour_cell=NOWHERE, travel=(5.0, 4.0), taken=(False, True)) == 0


def test_of_equal_targets_the_first_is_taken() -> None:
    assert chosen(contour_cell=NOWHERE, travel=(4.0, 4.0)) == 0


@pytest.mark.parametrize("accessible", [True, False])
def test_a_robot_that_cannot_get_to_its_region_yet_chooses_first(*, accessible: bool) -> None:
    situation = situation_of("?..ab....?")
    regions = SimpleNamespace(
        owned=np.array([0, 1]),
        accessible=np.array([[True, True], [True, accessible]]),
        nearest=np.zeros((2, 2), np.int64),
        diagonal=10.0,
    )
    travel = np.array([[2.0, 5.0], [3.0, 4.0]])
    targets = kmeans.choose_targets(situation, regions, travel, [0, 1])
    assert targets == ({0: 1, 1: 8} if accessible else {0: 8, 1: 1})


def test_frontiers_are_spaced_by_the_sensor_range_cheapest_first() -> None:
    frontiers, costs = np.array([0, 1, 3, 4, 7]), np.array([5.0, 2.0, 9.0, 1.0, math.inf])
    spaced = np.zeros(5, np.bool_)
    order = np.argsort(costs, kind="stable")
    kmeans.space(frontiers, 9, costs, order, 3.0, np.zeros(5, np.int64), spaced)
    # 4 first; 1 is three cells away; 0 and 3 are too near to those; 7 is out of reach.
    assert spaced.tolist() == [False, True, False, True, False]


# Empty regions, few frontiers, and robots that keep their targets.


def test_an_empty_region_gets_the_farthest_point() -> None:
    twice = ((SETTLED, 0, 7 * PARTS), (SETTLED, 0, 7 * PARTS))
    tasks = assign(situation_of("ab??????", memos=twice))
    # From {1} and {2 … 7} Lloyd goes on to {1, 2, 3} and {4 … 7}.
    assert {task.memo for task in tasks} == {(SETTLED, 0, 2 * PARTS), (SETTLED, 0, 11 * PARTS // 2)}


def test_with_fewer_cells_than_robots_some_have_no_region_but_all_a_target() -> None:
    situation = situation_of("abc.?")
    assert regions_of(situation, 0, 1, 2).owned.tolist().count(NO_REGION) == 1
    assert targets_of(situation) == [3, 3, 3]


def test_a_robot_without_a_region_keeps_its_centroid() -> None:
    memos = ((SETTLED, 0, 5), (SETTLED, 0, 6), (SETTLED, 0, 7))
    situation = situation_of("abc.?", memos=memos)
    lacks = regions_of(situation, 0, 1, 2).owned.tolist().index(NO_REGION)
    assert assign(situation)[lacks].memo == memos[lacks]


def test_unknown_cells_enclosed_by_walls_belong_to_no_region() -> None:
    situation = situation_of("......##", "a..?.#?#", "......##")
    assert regions_of(situation, 6).places == [[PARTS, 3 * PARTS]]


def test_an_unknown_part_without_a_frontier_belongs_to_no_region() -> None:
    # A robot stood before the right one and saw nothing new.
    situation = situation_of("?..a..?", dead=5)
    assert regions_of(situation, 6).places == [[0, PARTS // 2]]
    assert targets_of(situation) == [1]


@pytest.mark.parametrize("rows", [("a.#?",), ("a.#.?",)])
def test_without_a_frontier_in_reach_there_is_no_target(rows: tuple[str, ...]) -> None:
    assert targets_of(situation_of(*rows)) == [NOWHERE]


def test_without_frontiers_regions_are_kept() -> None:
    assert assign(situation_of("a.#?", memos=((2, 3, 4),))) == [Task(NOWHERE, (2, 3, 4))]


def test_no_robot_idles_where_targets_are_fewer_than_robots() -> None:
    assert targets_of(situation_of("abcd..?")) == [5, 5, 5, 5]


def test_no_robot_idles_because_its_frontiers_lie_near_cheaper_ones_of_others() -> None:
    assert targets_of(situation_of("a.?.b")) == [1, 3]


def test_a_robot_behind_walls_gets_no_target_and_others_theirs() -> None:
    tasks = assign(situation_of("a#b..??", "#######"))
    assert [task.target for task in tasks] == [NOWHERE, 4]


def test_targets_of_robots_that_keep_theirs_are_taken() -> None:
    situation = situation_of("?..a.....?")
    assert targets_of(situation) == [1]
    keeps = (member(1, 4, target=1),)
    assert targets_of(situation._replace(others=keeps)) == [8]
    idle = (member(1, 4),)
    assert targets_of(situation._replace(others=idle, absent=(1,))) == [8]


def test_a_target_stands_for_the_frontiers_within_a_sensor_range() -> None:
    situation = situation_of("?..a.....?")
    assert targets_of(situation._replace(absent=(3,))) == [8]  # 2 cells from 1, 5 from 8
    assert targets_of(situation._replace(absent=(4,))) == [1]


def test_there_are_as_many_regions_as_robots_in_contact() -> None:
    """The others keep their regions when only one robot needs a target."""
    memos = ((SETTLED, 0, 0), (SETTLED, 0, 9 * PARTS))
    both = situation_of("??.a.b.???", memos=memos)
    first, second = both.members
    only_second = both._replace(members=(second,), others=(first,))
    assert assign(only_second) == assign(both)[1:]


# Memos, and what an assignment depends on.


def test_centroids_are_drawn_twice_then_they_stay() -> None:
    def memos(seed: int, count: int) -> list[tuple[int, ...]]:
        before = ((count, 3, 5 * PARTS), (count, 2, 6 * PARTS)) if count else ()
        situation = situation_of("ab" + 40 * "?", *[42 * "?"] * 20, memos=before)
        return [task.memo for task in assign(situation, seed)]

    assert all(memo[0] == 1 for memo in memos(1, 0))
    assert all(memo[0] == SETTLED for memo in memos(1, 1) + memos(1, 2))
    pairs = [memos(seed, count) for seed in (1, 2, 3) for count in (0, 1)]
    assert len({str([memo[1:] for memo in pair]) for pair in pairs}) > 1
    assert memos(1, 2) == memos(2, 2) == memos(3, 2)


def test_a_settled_partition_stays() -> None:
    situation = situation_of("ab" + 10 * "?", 12 * "?")
    tasks = assign(situation)
    for _ in range(4):
        members = zip(situation.members, tasks, strict=True)
        situation = situation._replace(members=tuple(m._replace(task=t) for m, t in members))
        before, tasks = tasks, assign(situation)
    assert tasks == before


def test_a_memo_that_lost_its_last_zeros_is_the_same() -> None:
    whole = situation_of("ab??????", memos=((SETTLED, 0, 0), (SETTLED, 0, 96)))
    short = situation_of("ab??????", memos=((SETTLED,), (SETTLED, 0, 96)))
    assert assign(whole) == assign(short)


def test_robots_that_know_the_same_come_to_the_same_assignment() -> None:
    situation = situation_of("??.a.b.???", "...c.d..??", "?????????.")
    assigned = [KMeans(mission(), 5, me).assign(situation) for me in (None, 0, 1, 2, 3)]
    assert all(tasks == assigned[0] for tasks in assigned)


def test_an_assignment_does_not_depend_on_earlier_ones() -> None:
    one, other = situation_of("??.a.b.???"), situation_of("ab??????")
    planner = KMeans(mission(), 5, None)
    first = planner.assign(one)
    planner.assign(other)
    assert planner.assign(one) == first


# Whole missions.


@pytest.mark.parametrize("layout", ["blank", "unstructured", "cityblock"])
@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
def test_four_robots_explore_all_observable_cells(layout: str, coordination: str) -> None:
    scenario = mission(
        f"map.layout={layout}",
        "map.size_m=[48.0, 48.0]",
        f"coordination={coordination}",
        "sensor.range_m=8.0",
    )
    setup = WorldSetup.of(scenario, 3)
    machines = team(scenario, 3, setup)
    assert play(scenario, 3, setup, (), machines=machines) == "done"
    ground, _ = ground_of(scenario)
    seen = observable(ground, setup.starts_m).ravel()
    known = machines["r1"]._fused_map.explored()
    assert known[seen].mean() > 0.99
