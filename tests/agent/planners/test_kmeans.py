"""KME: regions of unknown cells, their robots, and targets on the way (Puig, Garcia, Wu)."""

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import label
from scipy.optimize import linear_sum_assignment

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners import kmeans
from kantor_agent.planners.kmeans import NO_REGION, PARTS, ROUNDS, KMeans, Regions, blocked, choose
from kantor_agent.planners.map_base import Situation, Task, TeamMember
from kantor_fleet.execution.in_process_team import play, team
from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.grid import FREE, NOWHERE, OCCUPIED, UNKNOWN
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.starts import observable
from kantor_worldsim.world.world import WorldSetup, ground_of
from support.floors import Floor
from support.strategies import examples

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
KINDS = {".": FREE, "#": OCCUPIED, "?": UNKNOWN}
WARM = 2


def mission(*overrides: str) -> Scenario:
    return parse(MISSION, "regions", overrides)


def cost_map_of(kinds: np.ndarray, range_m: float = 3.0) -> CostMap:
    """The cost map of these kinds, (rows, columns), for a sensor of this range; cells of a metre."""
    return Floor(kinds, f"sensor.range_m={range_m}").cost_map


def scene(*rows: str, memos: tuple[tuple[int, ...], ...] = (), dead: int = NOWHERE) -> Situation:
    """Row 0 first: free floor, #, ?, and robots a, b, c … on free floor. dead: a dead frontier."""
    drawn = np.array([list(row) for row in rows])
    floor = Floor(np.vectorize(lambda sign: KINDS.get(sign, FREE))(drawn))
    if dead != NOWHERE:
        floor.find_dead(dead)
    cost_map = floor.cost_map
    signs = sorted(set(drawn.ravel()) - set(KINDS))
    cells = [int(np.flatnonzero(drawn.ravel() == sign)[0]) for sign in signs]
    memo_of = [*memos, *[()] * len(cells)]
    members = tuple(member(i, cell, memo=memo_of[i]) for i, cell in enumerate(cells))
    return Situation(cost_map, cost_map.fused_map.frontiers, members, (), (), 7)


def member(
    robot: int, cell: int, target: int = NOWHERE, memo: tuple[int, ...] = (), since: int = 0
) -> TeamMember:
    return TeamMember(robot, cell, Task(target, memo), since, arrived=False)


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


def test_to_an_accessible_region_it_is_as_far_as_the_way_to_a_frontier_beside_it() -> None:
    regions = regions_of(scene("a.#?", "...?"), 3)
    assert regions.accessible.all()
    # A diagonal step and a straight one to (1, 2); as the crow flies (0, 3) would be at 3.
    assert regions.distance.tolist() == [[1.0 + math.sqrt(2.0)]]
    assert regions.nearest.tolist() == [[7]]


def test_of_contour_cells_equally_far_the_first_is_the_nearest() -> None:
    assert regions_of(scene("##?", ".a.", "?##"), 1).nearest.tolist() == [[2]]


def test_to_an_inaccessible_region_it_is_as_far_as_the_crow_flies() -> None:
    regions = regions_of(scene("ab??????"), 2, 6)
    # Columns 1 to 4, and 5 to 7; of the second only column 5 is on the edge.
    assert regions.accessible.tolist() == [[True, False], [True, False]]
    assert regions.distance.tolist() == [[1.0, 5.0], [0.0, 4.0]]
    assert regions.nearest.tolist() == [[2, 5], [2, 5]]


def test_a_known_obstacle_on_the_line_to_an_inaccessible_region_costs_the_diagonal() -> None:
    regions = regions_of(scene("a.#?????", "b..?????"), 4, 7)
    assert regions.accessible.tolist() == [[True, False], [True, False]]
    diagonal = math.sqrt(2**2 + 8**2)
    assert regions.diagonal == diagonal
    assert regions.distance[:, 1].tolist() == [6.0 + diagonal, 6.0]
    assert regions.nearest[:, 1].tolist() == [6, 14]


def test_what_is_unknown_is_no_obstacle() -> None:
    regions = regions_of(scene("a.??????", "b..?????"), 4, 7)
    assert regions.distance[:, 1].tolist() == [5.0, 5.0]


def test_a_frontier_that_a_robot_cannot_get_to_leaves_a_region_inaccessible_to_it() -> None:
    regions = regions_of(scene("a#b.??"), 4, 5)
    assert regions.accessible[:, 0].tolist() == [False, True]
    assert regions.distance[0, 0] == 4.0 + regions.diagonal
    assert regions.distance[1, 0] == 1.0


def test_a_region_of_frontiers_alone_is_its_own_contour() -> None:
    # Column 2, and column 5 with what is unknown beyond it.
    regions = regions_of(scene("?.ab.?"), 1, 5)
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


def test_regions_are_shared_out_so_that_the_sum_of_the_distances_is_least() -> None:
    # The first robot is nearer to both, but the second has the longer way to the right one.
    regions = regions_of(scene("??.b.a...??"), 0, 10)
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


def test_what_cannot_be_reached_is_no_target() -> None:
    assert chosen(travel=(math.inf, 99.0), taken=(False, True), wall=True) == 1
    assert chosen(travel=(math.inf, math.inf)) == -1
    assert chosen(eligible=(False, False)) == -1


def test_without_a_region_only_the_way_and_others_count() -> None:
    assert chosen(contour_cell=NOWHERE, travel=(5.0, 4.0)) == 1
    assert chosen(contour_cell=NOWHERE, travel=(5.0, 4.0), taken=(False, True)) == 0


def test_of_equal_targets_the_first_is_taken() -> None:
    assert chosen(contour_cell=NOWHERE, travel=(4.0, 4.0)) == 0


@pytest.mark.parametrize("accessible", [True, False])
def test_a_robot_that_cannot_get_to_its_region_yet_chooses_first(*, accessible: bool) -> None:
    situation = scene("?..ab....?")
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


# Guards.


def test_an_empty_region_gets_the_farthest_point() -> None:
    twice = ((WARM, 0, 7 * PARTS), (WARM, 0, 7 * PARTS))
    tasks = assign(scene("ab??????", memos=twice))
    # From {1} and {2 … 7} Lloyd goes on to {1, 2, 3} and {4 … 7}.
    assert {task.memo for task in tasks} == {(WARM, 0, 2 * PARTS), (WARM, 0, 11 * PARTS // 2)}


def test_with_fewer_cells_than_robots_some_have_no_region_but_all_a_target() -> None:
    situation = scene("abc.?")
    assert regions_of(situation, 0, 1, 2).owned.tolist().count(NO_REGION) == 1
    assert targets_of(situation) == [3, 3, 3]


def test_a_robot_without_a_region_keeps_its_centroid() -> None:
    memos = ((WARM, 0, 5), (WARM, 0, 6), (WARM, 0, 7))
    situation = scene("abc.?", memos=memos)
    lacks = regions_of(situation, 0, 1, 2).owned.tolist().index(NO_REGION)
    assert assign(situation)[lacks].memo == memos[lacks]


def test_what_walls_enclose_belongs_to_no_region() -> None:
    situation = scene("......##", "a..?.#?#", "......##")
    assert regions_of(situation, 6).places == [[PARTS, 3 * PARTS]]


def test_an_unknown_part_without_a_frontier_belongs_to_no_region() -> None:
    # A robot stood before the right one and saw nothing new.
    situation = scene("?..a..?", dead=5)
    assert regions_of(situation, 6).places == [[0, PARTS // 2]]
    assert targets_of(situation) == [1]


@pytest.mark.parametrize("rows", [("a.#?",), ("a.#.?",)])
def test_without_a_frontier_in_reach_there_is_no_target(rows: tuple[str, ...]) -> None:
    assert targets_of(scene(*rows)) == [NOWHERE]


def test_without_frontiers_regions_are_kept() -> None:
    assert assign(scene("a.#?", memos=((2, 3, 4),))) == [Task(NOWHERE, (2, 3, 4))]


def test_no_robot_idles_where_targets_are_fewer_than_robots() -> None:
    assert targets_of(scene("abcd..?")) == [5, 5, 5, 5]


def test_no_robot_idles_because_its_frontiers_lie_near_cheaper_ones_of_others() -> None:
    assert targets_of(scene("a.?.b")) == [1, 3]


def test_a_robot_behind_walls_gets_no_target_and_others_theirs() -> None:
    tasks = assign(scene("a#b..??", "#######"))
    assert [task.target for task in tasks] == [NOWHERE, 4]


def test_targets_of_robots_that_keep_theirs_are_taken() -> None:
    situation = scene("?..a.....?")
    assert targets_of(situation) == [1]
    keeps = (member(1, 4, target=1),)
    assert targets_of(situation._replace(others=keeps)) == [8]
    idle = (member(1, 4),)
    assert targets_of(situation._replace(others=idle, absent=(1,))) == [8]


def test_a_target_stands_for_the_frontiers_within_a_sensor_range() -> None:
    situation = scene("?..a.....?")
    assert targets_of(situation._replace(absent=(3,))) == [8]  # 2 cells from 1, 5 from 8
    assert targets_of(situation._replace(absent=(4,))) == [1]


def test_there_are_as_many_regions_as_robots_in_contact() -> None:
    """Also if only one of them needs a target: the regions of the others stay theirs."""
    memos = ((WARM, 0, 0), (WARM, 0, 9 * PARTS))
    everybody = scene("??.a.b.???", memos=memos)
    first, second = everybody.members
    alone = everybody._replace(members=(second,), others=(first,))
    assert assign(alone) == assign(everybody)[1:]


# What is shared, and what is remembered.


def test_centroids_are_drawn_twice_then_they_stay() -> None:
    def memos(seed: int, count: int) -> list[tuple[int, ...]]:
        before = ((count, 3, 5 * PARTS), (count, 2, 6 * PARTS)) if count else ()
        situation = scene("ab" + 40 * "?", *[42 * "?"] * 20, memos=before)
        return [task.memo for task in assign(situation, seed)]

    assert all(memo[0] == 1 for memo in memos(1, 0))
    assert all(memo[0] == WARM for memo in memos(1, 1) + memos(1, 2))
    drawn = [memos(seed, count) for seed in (1, 2, 3) for count in (0, 1)]
    assert len({str([memo[1:] for memo in pair]) for pair in drawn}) > 1
    assert memos(1, 2) == memos(2, 2) == memos(3, 2)


def test_a_settled_partition_stays() -> None:
    situation = scene("ab" + 10 * "?", 12 * "?")
    tasks = assign(situation)
    for _ in range(4):
        members = zip(situation.members, tasks, strict=True)
        situation = situation._replace(members=tuple(m._replace(task=t) for m, t in members))
        before, tasks = tasks, assign(situation)
    assert tasks == before


def test_a_memo_that_lost_its_last_zeros_is_the_same() -> None:
    whole = scene("ab??????", memos=((WARM, 0, 0), (WARM, 0, 96)))
    short = scene("ab??????", memos=((WARM,), (WARM, 0, 96)))
    assert assign(whole) == assign(short)


def test_robots_that_know_the_same_come_to_the_same_assignment() -> None:
    situation = scene("??.a.b.???", "...c.d..??", "?????????.")
    assigned = [KMeans(mission(), 5, me).assign(situation) for me in (None, 0, 1, 2, 3)]
    assert all(tasks == assigned[0] for tasks in assigned)


def test_an_assignment_does_not_depend_on_earlier_ones() -> None:
    one, other = scene("??.a.b.???"), scene("ab??????")
    planner = KMeans(mission(), 5, None)
    first = planner.assign(one)
    planner.assign(other)
    assert planner.assign(one) == first


# Any chart: the kernels beside the equations written out plainly.


def plain_line(one: tuple[int, int], other: tuple[int, int]) -> list[tuple[int, int]]:
    """Bresenham's line, by the error against the true line in doubled integers."""
    (row, column), (to_row, to_column) = one, other
    high, wide = abs(to_row - row), abs(to_column - column)
    line, error = [one], wide - high
    while (row, column) != other:
        across, along = 2 * error > -high, 2 * error < wide
        column += (1 if to_column > column else -1) if across else 0
        row += (1 if to_row > row else -1) if along else 0
        error += (wide if along else 0) - (high if across else 0)
        line.append((row, column))
    return line


def plain_cluster(
    points: list[int], columns: int, centroids: list[tuple[int, ...]]
) -> tuple[dict[int, int], list[tuple[int, ...]]]:
    """Lloyd's rounds: the region of each point, and the centroids."""
    places = {p: tuple(PARTS * x for x in divmod(p, columns)) for p in points}
    ks = range(len(centroids))

    def away(p: int, k: int) -> int:
        return sum((x - c) ** 2 for x, c in zip(places[p], centroids[k], strict=True))

    for _ in range(ROUNDS):
        region = {p: min(ks, key=lambda k, p=p: away(p, k)) for p in points}
        for k in ks:
            sizes = [list(region.values()).count(its) for its in ks]
            if not sizes[k]:
                shared = [p for p in points if sizes[region[p]] > 1]
                region[max(shared, key=lambda p: away(p, region[p]))] = k
        before, centroids = centroids, []
        for k in ks:
            own = [places[p] for p in points if region[p] == k]
            sums = [sum(axis) for axis in zip(*own, strict=True)]
            centroids.append(tuple((2 * s + len(own)) // (2 * len(own)) for s in sums))
        if centroids == before:
            break
    return region, centroids


class Plain:
    """The assignment with lists and dicts."""

    def __init__(self, situation: Situation, seed: int) -> None:
        self.situation, self.seed = situation, seed
        frame = situation.cost_map.frame
        self.shape = (frame.rows, frame.columns)
        self.kinds = situation.cost_map.fused_map.cells.reshape(self.shape)
        self.diagonal = math.sqrt(frame.rows**2 + frame.columns**2)
        self.frontiers = situation.frontiers.tolist()
        self.group = plain_group(situation)

    def at(self, cell: int) -> tuple[int, int]:
        return divmod(cell, self.shape[1])

    def beside(self, cell: int) -> list[int]:
        row, column = self.at(cell)
        around = [(row - 1, column), (row, column - 1), (row, column + 1), (row + 1, column)]
        inside = [(r, c) for r, c in around if 0 <= r < self.shape[0] and 0 <= c < self.shape[1]]
        return [r * self.shape[1] + c for r, c in inside]

    def unknown(self, cell: int) -> bool:
        return bool(self.kinds[self.at(cell)] == UNKNOWN)

    def squared(self, one: int, other: int) -> int:
        (row, column), (to_row, to_column) = self.at(one), self.at(other)
        return (row - to_row) ** 2 + (column - to_column) ** 2

    def walled(self, one: int, other: int) -> bool:
        line = plain_line(self.at(one), self.at(other))
        return any(self.kinds[place] == OCCUPIED for place in line)

    def travel(self, robot: TeamMember, cell: int) -> float:
        return float(self.situation.cost_map.travel(robot.cell)[cell])

    def points(self) -> list[int]:
        labels, _ = label(self.kinds == UNKNOWN)
        labels = labels.ravel()
        open_parts = {labels[n] for f in self.frontiers for n in self.beside(f)} - {0}
        return sorted({*self.frontiers, *np.flatnonzero(np.isin(labels, list(open_parts)))})

    def start(self, robot: TeamMember) -> tuple[int, int]:
        count, row, column = (*robot.task.memo, 0, 0, 0)[:3]
        edge = [PARTS * (side - 1) for side in self.shape]
        if count >= WARM:
            return min(max(row, 0), edge[0]), min(max(column, 0), edge[1])
        key = (self.seed, Purpose.CENTROIDS, robot.robot, max(count, 0))
        return round(uniform(*key, 0) * edge[0]), round(uniform(*key, 1) * edge[1])

    def region_distance(self, robot: TeamMember, k: int) -> tuple[float, int, bool]:
        """Eq. 1-3: how far, to which contour cell, and whether it is accessible."""
        own = [p for p in self.region if self.region[p] == k]
        hidden = [p for p in own if self.unknown(p)]
        contour = [p for p in hidden if any(n not in hidden for n in self.beside(p))] or own
        ways = [
            (self.travel(robot, f), c)
            for c in contour
            for f in ([c] if not hidden else self.beside(c))
            if f in self.frontiers and math.isfinite(self.travel(robot, f))
        ]
        if ways:
            return (*min(ways), True)
        flights = [
            (
                math.sqrt(self.squared(robot.cell, c))
                + (self.diagonal if self.walled(robot.cell, c) else 0.0),
                c,
            )
            for c in contour
        ]
        return (*min(flights), False)

    def spaced(self, robots: list[TeamMember]) -> list[int]:
        cheapest = {f: min(self.travel(m, f) for m in robots) for f in self.frontiers}
        far, kept = self.situation.cost_map.sensor_cells**2, []
        for f in sorted(self.frontiers, key=lambda f: (cheapest[f], f)):
            if math.isfinite(cheapest[f]) and all(self.squared(f, k) >= far for k in kept):
                kept.append(f)
        return sorted(kept)

    def assign(self) -> list[Task]:
        members = self.situation.members
        if not self.frontiers:
            return [Task(NOWHERE, m.task.memo) for m in members]
        points = self.points()
        starts = [self.start(robot) for robot in self.group][: len(points)]
        self.region, centroids = plain_cluster(points, self.shape[1], starts)
        measured = [
            [self.region_distance(robot, k) for k in range(len(centroids))] for robot in self.group
        ]
        owners, theirs = linear_sum_assignment([[d for d, _, _ in row] for row in measured])
        self.least = sum(measured[i][k][0] for i, k in zip(owners, theirs, strict=True))
        self.measured = measured
        own = {
            self.group[i].robot: (measured[i][k][1:], centroids[k])
            for i, k in zip(owners, theirs, strict=True)
        }
        taken = [m.task.target for m in self.situation.others] + list(self.situation.absent)
        taken = [target for target in taken if target != NOWHERE]
        spaced, targets = self.spaced(list(members)), {}
        for m in sorted(members, key=lambda m: m.robot not in own or own[m.robot][0][1]):
            cc = own[m.robot][0][0] if m.robot in own else None
            offers = [
                min((self.cost(m, f, cc, taken), f) for f in some) if some else (math.inf, NOWHERE)
                for some in (spaced, self.frontiers)
            ]
            finite = [f for cost, f in offers if math.isfinite(cost)]
            targets[m.robot] = finite[0] if finite else NOWHERE
            taken += finite[:1]
        return [
            Task(
                targets[m.robot],
                (
                    min(max(0, *m.task.memo[:1], 0) + 1, WARM),
                    *(own[m.robot][1] if m.robot in own else self.start(m)),
                ),
            )
            for m in members
        ]

    def cost(self, robot: TeamMember, f: int, cc: int | None, taken: list[int]) -> float:
        """Eq. 6."""
        cost = self.travel(robot, f)
        if cc is not None:
            cost += math.sqrt(self.squared(f, cc))
            cost += self.diagonal if self.walled(f, cc) else 0.0
        far = self.situation.cost_map.sensor_cells**2
        if any(f == t or self.squared(f, t) < far for t in taken):
            cost += 2.0 * self.diagonal
        return cost


def plain_group(situation: Situation) -> list[TeamMember]:
    return sorted((*situation.members, *situation.others), key=lambda m: m.robot)


MEMOS = st.one_of(
    st.just(()),
    st.tuples(st.integers(-1, 3), st.integers(-9, 200), st.integers(-9, 200)),
    st.lists(st.integers(-(2**52), 2**52), max_size=4).map(tuple),
)


@st.composite
def situations(draw: st.DrawFn) -> Situation:
    """Any chart up to 9 x 9 with up to five robots, who may stand in walls, and what they were told."""
    rows, columns = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    crowded = draw(st.sampled_from([(FREE, UNKNOWN), (FREE, UNKNOWN, OCCUPIED, FREE, FREE)]))
    n = rows * columns
    kinds = draw(st.lists(st.sampled_from(crowded), min_size=n, max_size=n))
    grid = np.array(kinds, dtype=np.uint8).reshape(rows, columns)
    cost_map = cost_map_of(grid, draw(st.sampled_from([0.5, 1.0, 2.5, 4.0])))
    cells, targets = st.integers(0, n - 1), st.integers(NOWHERE, n - 1)
    robots = draw(st.lists(st.tuples(cells, targets, MEMOS), min_size=1, max_size=5))
    group = [member(i, cell, target, memo) for i, (cell, target, memo) in enumerate(robots)]
    due = [draw(st.booleans()) for _ in group] if draw(st.booleans()) else [True] * len(group)
    members = tuple(m for m, now in zip(group, due, strict=True) if now) or tuple(group)
    others = tuple(m for m in group if m not in members)
    absent = tuple(draw(st.lists(cells, max_size=2)))
    return Situation(cost_map, cost_map.fused_map.frontiers, members, others, absent, 3)


@examples(300)
@given(situations(), st.integers(0, 2**63 - 1))
def test_the_kernels_do_what_the_equations_say(situation: Situation, seed: int) -> None:
    plain = Plain(situation, seed)
    assert KMeans(mission(), seed, None).assign(situation) == plain.assign()
    if plain.frontiers:
        # Eq. 4-5: no other way to share out the regions is shorter.
        rows, k = plain.measured, len(plain.measured[0])
        every = itertools.permutations(range(len(rows)), k)
        sums = [sum(rows[i][j][0] for j, i in enumerate(owners)) for owners in every]
        assert math.isclose(plain.least, min(sums), rel_tol=1e-9, abs_tol=1e-9)


@examples(100)
@given(situations(), st.integers(0, 2**63 - 1))
def test_no_robot_that_can_reach_a_frontier_idles(situation: Situation, seed: int) -> None:
    tasks = KMeans(mission(), seed, None).assign(situation)
    for m, task in zip(situation.members, tasks, strict=True):
        reached = np.isfinite(situation.cost_map.travel(m.cell)[situation.frontiers])
        assert (task.target != NOWHERE) == reached.any()
        assert task.target in {NOWHERE, *situation.frontiers[reached].tolist()}


@examples(100)
@given(situations(), st.data())
def test_distances_and_contour_cells_are_those_of_the_equations(
    situation: Situation, data: st.DataObject
) -> None:
    seed = data.draw(st.integers(0, 2**63 - 1))
    plain = Plain(situation._replace(members=tuple(plain_group(situation)), others=()), seed)
    if not plain.frontiers:
        return
    plain.assign()
    starts = np.array([plain.start(m) for m in plain.group])
    cells = np.array([m.cell for m in plain.group])
    travel = np.array([[plain.travel(m, f) for f in plain.frontiers] for m in plain.group])
    regions = Regions(situation.cost_map, situation.frontiers, cells, starts, travel)
    distance, nearest, accessible = zip(*itertools.chain(*plain.measured), strict=True)
    assert regions.distance.ravel().tolist() == list(distance)
    assert regions.nearest.ravel().tolist() == list(nearest)
    assert regions.accessible.ravel().tolist() == list(accessible)


@st.composite
def partitions(draw: st.DrawFn) -> tuple[list[int], int, list[tuple[int, int]]]:
    """Points, columns, and where as many centroids as points or fewer begin, some in one place."""
    columns = draw(st.integers(1, 12))
    points = sorted(draw(st.sets(st.integers(0, 12 * columns - 1), min_size=1, max_size=40)))
    places = st.tuples(st.integers(0, 12 * PARTS), st.integers(0, 12 * PARTS))
    few = draw(st.lists(places, min_size=1, max_size=8))
    starts = draw(st.lists(st.sampled_from(few), min_size=1, max_size=min(8, len(points))))
    return points, columns, starts


@examples(300)
@given(partitions())
def test_k_means_is_exact_and_leaves_no_region_empty(
    case: tuple[list[int], int, list[tuple[int, int]]],
) -> None:
    points, columns, starts = case
    centroids = np.array(starts, dtype=np.float64)
    region = np.full(12 * columns, NO_REGION)
    kmeans.divide(np.array(points), columns, centroids, region)
    regions, places = plain_cluster(points, columns, starts)
    assert {p: int(region[p]) for p in points} == regions
    assert centroids.tolist() == [list(place) for place in places]
    assert set(regions.values()) == set(range(len(starts)))
    assert (region != NO_REGION).sum() == len(points)


@examples(60)
@given(
    st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(
        lambda shape: st.tuples(
            st.just(shape[1]), *[st.integers(0, shape[0] * shape[1] - 1)] * 2, st.just(shape)
        )
    )
)
def test_a_line_is_blocked_by_the_cells_on_it(
    case: tuple[int, int, int, tuple[int, int]],
) -> None:
    columns, one, other, (rows, _) = case
    cells = np.full(rows * columns, UNKNOWN, np.uint8)
    assert not blocked(cells, columns, one, other)
    blocking = []
    for wall in range(rows * columns):
        cells[wall] = OCCUPIED
        if blocked(cells, columns, one, other):
            blocking.append(divmod(wall, columns))
        cells[wall] = UNKNOWN
    ends = divmod(one, columns), divmod(other, columns)
    assert blocking == sorted(plain_line(*ends))
    assert len(blocking) == 1 + max(abs(a - b) for a, b in zip(*ends, strict=True))


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
