"""KME: every robot explores a region of its own (Puig, Garcia, Wu, section IV).

The steps of an assignment:

1. K-means divides the unknown cells and the frontiers into as many regions as robots are in contact;
2. robots get regions so that the sum of the distances is least (eq. 1-5);
3. a robot that needs a target gets a frontier that lies near, and on the way to its region (eq. 6-7).

Distances are in cells. A centroid is in sixteenths of a cell, whole numbers, so that K-means ends alike
in every process. The memo of a robot's task is the count of its assignments, up to two, and its region's
centroid (row, column): where K-means begins the next time.
"""

import math

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.planners.map_base import Situation, Task, TeamMember
from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.grid import NOWHERE, OCCUPIED, UNKNOWN, Frame, neighbour
from kantor_protocol.base.kernels import kernel
from kantor_protocol.scenario.schema import Scenario

PARTS = 16
"""Centroids are whole numbers of this fraction of a cell."""
RANDOM_ASSIGNMENTS = 2
"""Assignments for which a robot's centroid is drawn; from then on that of its region is taken."""
ROUNDS = 20
"""Rounds of K-means, at most; the next assignment goes on from there."""
NO_REGION = -1

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@kernel
def squared(one: int, other: int, columns: int) -> int:
    """The squared distance of two cells."""
    rows = one // columns - other // columns
    across = one % columns - other % columns
    return rows * rows + across * across


@kernel
def blocked(cells: np.ndarray, columns: int, one: int, other: int) -> bool:
    """Whether a known obstacle lies on Bresenham's line from one cell to another."""
    row, column = one // columns, one % columns
    to_row, to_column = other // columns, other % columns
    high, wide = abs(to_row - row), abs(to_column - column)
    up = 1 if to_row > row else -1
    right = 1 if to_column > column else -1
    error = wide - high
    while True:
        if cells[row * columns + column] == OCCUPIED:
            return True
        if row == to_row and column == to_column:
            return False
        twice = 2 * error
        if twice > -high:
            error -= high
            column += right
        if twice < wide:
            error += wide
            row += up


# 1. Regions.


@kernel
def gather(
    cells: np.ndarray,
    columns: int,
    frontiers: np.ndarray,
    region: np.ndarray,
    stack: np.ndarray,
    points: np.ndarray,
) -> int:
    """Write the points, frontiers and unknown cells connected to one, into points (cells,); returns how many.

    Unknown cells enclosed by walls are left out. region: (cells,) NO_REGION, and 0 afterwards at each point.
    stack: (cells,) scratch.
    """
    count = cells.shape[0]
    for j in range(frontiers.shape[0]):
        region[frontiers[j]] = 0
    for j in range(frontiers.shape[0]):
        stack[0], size = frontiers[j], 1
        while size > 0:
            size -= 1
            cell = stack[size]
            for side in range(4):
                n = neighbour(cell, side, columns, count)
                if n >= 0 and cells[n] == UNKNOWN and region[n] == NO_REGION:
                    region[n] = 0
                    stack[size] = n
                    size += 1
    found = 0
    for cell in range(count):
        if region[cell] != NO_REGION:
            points[found] = cell
            found += 1
    return found


@kernel
def _label(
    at: np.ndarray, centroids: np.ndarray, regions: int, label: np.ndarray, away: np.ndarray
) -> None:
    """Label every point with its nearest centroid, of equal ones the first; written to become SIMD code."""
    for k in range(regions):
        row, column = centroids[k, 0], centroids[k, 1]
        for i in range(at.shape[1]):
            rows, across = at[0, i] - row, at[1, i] - column
            distance = rows * rows + across * across
            nearer = k == 0 or distance < away[i]
            away[i] = distance if nearer else away[i]
            label[i] = k if nearer else label[i]


@kernel
def _fill_empty(regions: int, label: np.ndarray, away: np.ndarray, sizes: np.ndarray) -> None:
    """Give every empty region the point that is farthest from its centroid, of equal ones the first."""
    sizes[:] = 0
    for i in range(label.shape[0]):
        sizes[label[i]] += 1
    for k in range(regions):
        if sizes[k] > 0:
            continue
        farthest = NOWHERE
        for i in range(label.shape[0]):
            if sizes[label[i]] > 1 and (farthest < 0 or away[i] > away[farthest]):
                farthest = i
        if farthest < 0:
            return
        sizes[label[farthest]] -= 1
        label[farthest], sizes[k] = k, 1


@kernel
def _move_centroids(
    at: np.ndarray,
    label: np.ndarray,
    regions: int,
    sizes: np.ndarray,
    sums: np.ndarray,
    centroids: np.ndarray,
) -> bool:
    """Move centroids to the mean of their points, rounded; whether any moved."""
    sums[:, :] = 0
    for i in range(label.shape[0]):
        sums[label[i], 0] += int(at[0, i])
        sums[label[i], 1] += int(at[1, i])
    moved = False
    for k in range(regions):
        if sizes[k] == 0:
            continue
        for axis in range(2):
            middle = (2 * sums[k, axis] + sizes[k]) // (2 * sizes[k])
            moved = moved or middle != centroids[k, axis]
            centroids[k, axis] = middle
    return moved


@kernel
def cluster(
    points: np.ndarray,
    columns: int,
    centroids: np.ndarray,
    at: np.ndarray,
    label: np.ndarray,
    away: np.ndarray,
    sizes: np.ndarray,
    sums: np.ndarray,
    region: np.ndarray,
) -> None:
    """Lloyd's algorithm from given centroids, which it moves; writes every point's region into region (cells,).

    points: (n,) cells, n >= regions. centroids: (regions, 2) row and column, whole numbers of 1/PARTS of a
    cell. Scratch: at (2, n), label (n,), away (n,), sizes (regions,), sums (regions, 2).
    """
    regions = centroids.shape[0]
    for i in range(points.shape[0]):
        at[0, i] = PARTS * (points[i] // columns)
        at[1, i] = PARTS * (points[i] % columns)
    for _ in range(ROUNDS):
        _label(at, centroids, regions, label, away)
        _fill_empty(regions, label, away, sizes)
        if not _move_centroids(at, label, regions, sizes, sums, centroids):
            break
    for i in range(points.shape[0]):
        region[points[i]] = label[i]


@kernel
def find_contour(
    cells: np.ndarray,
    columns: int,
    region: np.ndarray,
    points: np.ndarray,
    inside: np.ndarray,
    contour: np.ndarray,
) -> int:
    """Write the unknown cells on the edge of each region into contour, rising; returns how many.

    A region without unknown cells is all contour. inside: (regions,) zeros, and its unknown cells afterwards.
    """
    for i in range(points.shape[0]):
        if cells[points[i]] == UNKNOWN:
            inside[region[points[i]]] += 1
    edges = 0
    for i in range(points.shape[0]):
        cell, its = points[i], region[points[i]]
        edge = cells[cell] != UNKNOWN and inside[its] == 0
        if cells[cell] == UNKNOWN:
            for side in range(4):
                n = neighbour(cell, side, columns, cells.shape[0])
                edge = edge or (n >= 0 and (region[n] != its or cells[n] != UNKNOWN))
        if edge:
            contour[edges] = cell
            edges += 1
    return edges


# 2. Robots and regions.


@kernel
def measure_accessible(
    cells: np.ndarray,
    columns: int,
    region: np.ndarray,
    inside: np.ndarray,
    frontiers: np.ndarray,
    travel: np.ndarray,
    distance: np.ndarray,
    nearest: np.ndarray,
) -> None:
    """Eq. 1 and 3: the least cost of the way to a frontier beside a contour cell, and this cell.

    travel: (robots, frontiers). distance: (robots, regions) infinite, and still so afterwards where a
    region is inaccessible; nearest: the same shape.
    """
    for j in range(frontiers.shape[0]):
        for side in range(5):
            c = frontiers[j]
            if side < 4:
                c = neighbour(c, side, columns, cells.shape[0])
                if c < 0 or cells[c] != UNKNOWN or region[c] == NO_REGION:
                    continue
            elif inside[region[c]] > 0:
                continue
            k = region[c]
            for i in range(travel.shape[0]):
                offer = travel[i, j]
                nearer = offer < distance[i, k]
                if nearer or (offer == distance[i, k] < math.inf and c < nearest[i, k]):
                    distance[i, k], nearest[i, k] = offer, c


@kernel
def measure_inaccessible(
    cells: np.ndarray,
    columns: int,
    region: np.ndarray,
    contour: np.ndarray,
    robots: np.ndarray,
    accessible: np.ndarray,
    diagonal: float,
    distance: np.ndarray,
    nearest: np.ndarray,
) -> None:
    """Eq. 2 and 3: the straight line, and the map's diagonal if a known obstacle is on it."""
    for e in range(contour.shape[0]):
        c = contour[e]
        k = region[c]
        for i in range(robots.shape[0]):
            if accessible[i, k]:
                continue
            offer = math.sqrt(squared(robots[i], c, columns))
            if offer < distance[i, k] and blocked(cells, columns, robots[i], c):
                offer += diagonal
            if offer < distance[i, k]:
                distance[i, k], nearest[i, k] = offer, c


# 3. Targets.


@kernel
def space(
    frontiers: np.ndarray,
    columns: int,
    costs: np.ndarray,
    order: np.ndarray,
    range_cells: float,
    kept: np.ndarray,
    spaced: np.ndarray,
) -> None:
    """F_M: take frontiers in this order, unless one that is taken lies nearer than the sensor's range.

    kept: (frontiers,) scratch. spaced: (frontiers,) False, and whether each is taken afterwards. Those of
    infinite cost are not.
    """
    count = 0
    for o in range(order.shape[0]):
        j = order[o]
        good = costs[j] < math.inf
        for m in range(count):
            if not good:
                break
            good = squared(frontiers[j], kept[m], columns) >= range_cells * range_cells
        if good:
            spaced[j] = True
            kept[count] = frontiers[j]
            count += 1


@kernel
def mark_taken(
    frontiers: np.ndarray, columns: int, target: int, range_cells: float, taken: np.ndarray
) -> None:
    """Mark the frontiers that are nearer to a target than the sensor's range as taken."""
    if target == NOWHERE:
        return
    for j in range(frontiers.shape[0]):
        near = squared(frontiers[j], target, columns) < range_cells * range_cells
        taken[j] = taken[j] or near


@kernel
def choose(
    cells: np.ndarray,
    columns: int,
    frontiers: np.ndarray,
    eligible: np.ndarray,
    taken: np.ndarray,
    travel: np.ndarray,
    contour_cell: int,
    diagonal: float,
) -> int:
    """Eq. 6-7: the index in `frontiers` of a robot's target, of equal ones the first; -1 without any.

    travel: (frontiers,) of this robot. contour_cell: the nearest of its region, or NOWHERE.
    """
    best, least = -1, math.inf
    for j in range(frontiers.shape[0]):
        if not (eligible[j] and travel[j] < least):
            continue
        cost = travel[j]
        if contour_cell != NOWHERE:
            cost += math.sqrt(squared(frontiers[j], contour_cell, columns))
            if cost < least and blocked(cells, columns, frontiers[j], contour_cell):
                cost += diagonal
        if taken[j]:
            cost += 2.0 * diagonal
        if cost < least:
            best, least = j, cost
    return best


class KMeans:
    """The planner `kmeans`: regions for all robots in contact, and targets on the way to them."""

    negotiates = False

    def __init__(self, _scenario: Scenario, seed: int, _me: int | None) -> None:
        """seed: of the mission, for the draws of the first centroids."""
        self._seed = seed

    def assign(self, situation: Situation, /) -> list[Task]:
        """Every member's target, with its region as a memo. Without frontiers memos stay as they are."""
        cost_map, frontiers, members, others, _, _ = situation
        if not (members and frontiers.size):
            return [Task(NOWHERE, member.task.memo) for member in members]
        team = sorted((*members, *others), key=lambda member: member.robot)
        cells = np.array([member.cell for member in team])
        starts = np.array([self._start(member, cost_map.frame) for member in team])
        travel = np.stack([cost_map.travel(member.cell, frontiers) for member in team])
        regions = Regions(cost_map, frontiers, cells, starts, travel)
        mine = [team.index(member) for member in members]
        targets = choose_targets(situation, regions, travel, mine)
        return [Task(targets[i], (_assignments(team[i], 1), *regions.places[i])) for i in mine]

    def _start(self, member: TeamMember, frame: Frame) -> tuple[int, int]:
        """The initial centroid of a robot: that of its region, or drawn from the whole map."""
        row, column = PARTS * (frame.rows - 1), PARTS * (frame.columns - 1)
        count = _assignments(member)
        if count == RANDOM_ASSIGNMENTS:
            _, last_row, last_column = (*member.task.memo, 0, 0)[:3]
            return min(max(last_row, 0), row), min(max(last_column, 0), column)
        key = (self._seed, int(Purpose.CENTROIDS), member.robot, count)
        return round(uniform(*key, 0) * row), round(uniform(*key, 1) * column)


def _assignments(member: TeamMember, more: int = 0) -> int:
    """Assignments that a robot has had, and `more`, up to RANDOM_ASSIGNMENTS."""
    before = max(0, member.task.memo[0]) if member.task.memo else 0
    return min(before + more, RANDOM_ASSIGNMENTS)


class Regions:
    """A partition of the unknown cells, and the robot of each part (sections IV.A and IV.B)."""

    def __init__(
        self, cost_map: CostMap, frontiers: Ints, robots: Ints, starts: Ints, travel: Floats
    ) -> None:
        """robots: (n,) their cells. starts: (n, 2) centroids. travel: (n, frontiers)."""
        frame, cells = cost_map.frame, cost_map.fused_map.cells
        region = np.full(frame.cells, NO_REGION)
        points = _points(cost_map.fused_map, frontiers, region)
        count = min(robots.shape[0], points.shape[0])
        centroids = starts[:count].astype(np.float64)
        divide(points, frame.columns, centroids, region)
        self.diagonal = math.sqrt(frame.rows**2 + frame.columns**2)
        """The map's diagonal, l, in cells."""
        self.distance = np.full((robots.shape[0], count), np.inf)
        """(n, regions) eq. 3."""
        self.nearest = np.full((robots.shape[0], count), NOWHERE)
        """(n, regions) the contour cell at that distance."""
        grid, measured = (cells, frame.columns, region), (self.distance, self.nearest)
        inside, contour = np.zeros(count, np.int64), np.empty_like(points)
        edges = find_contour(*grid, points, inside, contour)
        measure_accessible(*grid, inside, frontiers, travel, *measured)
        self.accessible = np.isfinite(self.distance)
        """(n, regions) whether the robot can get to the region."""
        rest = (robots, self.accessible, self.diagonal)
        measure_inaccessible(*grid, contour[:edges], *rest, *measured)
        from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  20 MB that other planners do without

        owners, theirs = linear_sum_assignment(self.distance)
        self.owned = np.full(robots.shape[0], NO_REGION)
        """(n,) each robot's region by eq. 4-5; NO_REGION for some if there are fewer regions than robots."""
        self.owned[owners] = theirs
        places = starts.copy()
        places[owners] = centroids[theirs]
        self.places: list[list[int]] = places.tolist()
        """(n, 2) the centroid of each robot's region, or its initial one without a region."""


def _points(fused_map: FusedMap, frontiers: Ints, region: Ints) -> Ints:
    """The cells that are to be divided into regions, rising."""
    stack, points = np.empty_like(region), np.empty_like(region)
    count = gather(fused_map.cells, fused_map.frame.columns, frontiers, region, stack, points)
    return points[:count]


def divide(points: Ints, columns: int, centroids: Floats, region: Ints) -> None:
    """`cluster` with its scratch arrays."""
    n, count = points.shape[0], centroids.shape[0]
    per_point = (np.empty((2, n)), np.empty(n, np.int64), np.empty(n))
    sums = (np.empty(count, np.int64), np.empty((count, 2), np.int64))
    cluster(points, columns, centroids, *per_point, *sums, region)


def choose_targets(
    situation: Situation, regions: Regions, travel: Floats, mine: list[int]
) -> dict[int, int]:
    """Targets by index in the team (section IV.C): first for robots that cannot get to their region yet.

    travel: (n, frontiers). mine: indices in the team of the robots that get a target.
    """
    cost_map, frontiers = situation.cost_map, situation.frontiers
    columns, range_cells = cost_map.frame.columns, cost_map.sensor_cells
    costs = travel[mine].min(axis=0)
    spaced, taken = np.zeros((2, frontiers.shape[0]), np.bool_)
    order = np.argsort(costs, kind="stable")
    space(frontiers, columns, costs, order, range_cells, np.empty_like(frontiers), spaced)
    kept = (*(other.task.target for other in situation.others), *situation.absent)
    for target in kept:
        mark_taken(frontiers, columns, target, range_cells, taken)
    targets = dict.fromkeys(mine, NOWHERE)
    for i in sorted(mine, key=lambda i: _has_way(regions, i)):
        for eligible in (
            spaced,
            np.ones_like(spaced),
        ):  # one that is too near to another is better than none
            its = (eligible, taken, travel[i], _contour_cell(regions, i), regions.diagonal)
            j = choose(cost_map.fused_map.cells, columns, frontiers, *its)
            if j >= 0:
                targets[i] = int(frontiers[j])
                mark_taken(frontiers, columns, targets[i], range_cells, taken)
                break
    return targets


def _has_way(regions: Regions, i: int) -> bool:
    """Whether a robot can get to its region, or has no region."""
    k = regions.owned[i]
    return bool(k == NO_REGION or regions.accessible[i, k])


def _contour_cell(regions: Regions, i: int) -> int:
    """The nearest contour cell of a robot's region, or NOWHERE."""
    k = regions.owned[i]
    return NOWHERE if k == NO_REGION else int(regions.nearest[i, k])
