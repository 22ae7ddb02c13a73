"""The kernels of KME on any map, compared with the equations in plain Python."""

import itertools
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners import kmeans
from kantor_agent.planners.kmeans import NO_REGION, PARTS, KMeans, Regions, blocked
from kantor_agent.planners.map_base import Situation
from kantor_protocol.base.grid import FREE, NOWHERE, OCCUPIED, UNKNOWN
from support.grounds import exploration
from support.references.plain_kmeans import PlainKMeans, plain_cluster, plain_line, visible_team
from support.strategies import examples
from support.teams.floors import Floor, member

SCENARIO = exploration("planner.name=kmeans")
MEMOS = st.one_of(
    st.just(()),
    st.tuples(st.integers(-1, 3), st.integers(-9, 200), st.integers(-9, 200)),
    st.lists(st.integers(-(2**52), 2**52), max_size=4).map(tuple),
)


@st.composite
def situations(draw: st.DrawFn) -> Situation:
    """Any map up to 9 x 9 with up to five robots, perhaps inside walls, and any memos."""
    rows, columns = draw(st.integers(1, 9)), draw(st.integers(1, 9))
    mixture = draw(st.sampled_from([(FREE, UNKNOWN), (FREE, UNKNOWN, OCCUPIED, FREE, FREE)]))
    n = rows * columns
    kinds = draw(st.lists(st.sampled_from(mixture), min_size=n, max_size=n))
    grid = np.array(kinds, dtype=np.uint8).reshape(rows, columns)
    range_m = draw(st.sampled_from([0.5, 1.0, 2.5, 4.0]))
    cost_map = Floor(grid, f"sensor.range_m={range_m}").cost_map
    cells, targets = st.integers(0, n - 1), st.integers(NOWHERE, n - 1)
    robots = draw(st.lists(st.tuples(cells, targets, MEMOS), min_size=1, max_size=5))
    team = [member(i, cell, target, memo) for i, (cell, target, memo) in enumerate(robots)]
    due = [draw(st.booleans()) for _ in team] if draw(st.booleans()) else [True] * len(team)
    members = tuple(m for m, now in zip(team, due, strict=True) if now) or tuple(team)
    others = tuple(m for m in team if m not in members)
    absent = tuple(draw(st.lists(cells, max_size=2)))
    return Situation(cost_map, cost_map.fused_map.frontiers, members, others, absent, 3)


@examples(300)
@given(situations(), st.integers(0, 2**63 - 1))
def test_assignments_are_those_of_the_equations(situation: Situation, seed: int) -> None:
    plain = PlainKMeans(situation, seed)
    assert KMeans(SCENARIO, seed, None).assign(situation) == plain.assign()
    if plain.frontiers:
        # Eq. 4-5: no other assignment of regions has a smaller sum of distances.
        rows, k = plain.measured, len(plain.measured[0])
        every = itertools.permutations(range(len(rows)), k)
        sums = [sum(rows[i][j][0] for j, i in enumerate(owners)) for owners in every]
        assert math.isclose(plain.least, min(sums), rel_tol=1e-9, abs_tol=1e-9)


@examples(100)
@given(situations(), st.integers(0, 2**63 - 1))
def test_no_robot_that_can_reach_a_frontier_idles(situation: Situation, seed: int) -> None:
    tasks = KMeans(SCENARIO, seed, None).assign(situation)
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
    plain = PlainKMeans(situation._replace(members=tuple(visible_team(situation)), others=()), seed)
    if not plain.frontiers:
        return
    plain.assign()
    starts = np.array([plain.start(m) for m in plain.team])
    cells = np.array([m.cell for m in plain.team])
    travel = np.array([[plain.travel(m, f) for f in plain.frontiers] for m in plain.team])
    regions = Regions(situation.cost_map, situation.frontiers, cells, starts, travel)
    distance, nearest, accessible = zip(*itertools.chain(*plain.measured), strict=True)
    assert regions.distance.ravel().tolist() == list(distance)
    assert regions.nearest.ravel().tolist() == list(nearest)
    assert regions.accessible.ravel().tolist() == list(accessible)


@st.composite
def partitions(draw: st.DrawFn) -> tuple[list[int], int, list[tuple[int, int]]]:
    """Points, columns, and initial centroids, at most as many as points, some in one place."""
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
