"""Samples in space: the nearest ones that still have weight, found and used up in microseconds.

A bucket grid holds the samples of each cell, those with weight in front; above it a pyramid counts
them, so that a search skips what is empty. A query begins in the cell of the point and climbs the
pyramid: on every level it searches the three siblings, each from the nearest cell on, unless they are
empty or further away than what it has, and it ends when nothing outside can be nearer. The cost stays
flat in N and does not grow when most samples are used up.

All orders are by (squared distance, index), which makes every answer unique: it equals a full scan.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel

_PER_CELL = 2.0
"""Samples in a cell on average."""
_LEVELS_MAX = 11
_SLACK = 1e-9
"""Share of the extent by which a cell's box is taken larger than it is, against rounding."""

# Slots of Grid.frame.
_X, _Y, _CELL_M, _MARGIN_M = 0, 1, 2, 3


class SampleIndex(NamedTuple):
    """The index over N samples, for the kernels. C = 4^(levels - 1) cells, `side` in a row."""

    xy_m: npt.NDArray[np.float64]
    """(N, 2) world frame."""
    order: npt.NDArray[np.int32]
    """(N,) samples by cell, those with weight first."""
    cell: npt.NDArray[np.int32]
    """(N,) the cell of each sample."""
    first: npt.NDArray[np.int32]
    """(C + 1,) where each cell begins in `order`."""
    alive: npt.NDArray[np.int32]
    """Samples with weight: per node, level by level from the root, row by row in each."""
    frame: npt.NDArray[np.float64]
    """Lower left corner (x, y), edge of a cell, margin; metres."""
    levels: int


@kernel
def _level_start(level: int) -> int:
    return ((1 << (2 * level)) - 1) // 3


@kernel
def _cell_of(grid: SampleIndex, x: float, y: float) -> tuple[int, int]:
    side = 1 << (grid.levels - 1)
    column = int((x - grid.frame[_X]) / grid.frame[_CELL_M])
    row = int((y - grid.frame[_Y]) / grid.frame[_CELL_M])
    return min(max(column, 0), side - 1), min(max(row, 0), side - 1)


@kernel
def build(grid: SampleIndex, weights: np.ndarray) -> None:
    """Sort all samples into cells by their present places, and count those with weight."""
    side = 1 << (grid.levels - 1)
    leaves = _level_start(grid.levels - 1)
    grid.alive[:] = 0
    grid.first[:] = 0
    for j in range(grid.xy_m.shape[0]):
        column, row = _cell_of(grid, grid.xy_m[j, 0], grid.xy_m[j, 1])
        grid.cell[j] = row * side + column
        grid.first[grid.cell[j] + 1] += 1
    for c in range(side * side):
        grid.first[c + 1] += grid.first[c]
    # Those with weight first, so that they are in front. The dead count only while they are placed.
    for with_weight in (True, False):
        for j in range(grid.xy_m.shape[0]):
            if (weights[j] > 0) == with_weight:
                c = grid.cell[j]
                grid.order[grid.first[c] + grid.alive[leaves + c]] = j
                grid.alive[leaves + c] += 1
    for j in range(grid.xy_m.shape[0]):
        if weights[j] <= 0:
            grid.alive[leaves + grid.cell[j]] -= 1
    for level in range(grid.levels - 2, -1, -1):
        width = 1 << level
        here, below = _level_start(level), _level_start(level + 1)
        for row in range(width):
            for column in range(width):
                child = below + 4 * row * width + 2 * column
                grid.alive[here + row * width + column] = (
                    grid.alive[child]
                    + grid.alive[child + 1]
                    + grid.alive[child + 2 * width]
                    + grid.alive[child + 2 * width + 1]
                )


@kernel
def remove(grid: SampleIndex, j: int) -> None:
    """Take a sample out of the search. A sample that is out already stays out."""
    leaf = grid.levels - 1
    c = grid.cell[j]
    start = grid.first[c]
    end = start + grid.alive[_level_start(leaf) + c]
    slot = start
    while slot < end and grid.order[slot] != j:
        slot += 1
    if slot == end:
        return
    grid.order[slot], grid.order[end - 1] = grid.order[end - 1], j
    row, column = c >> leaf, c & ((1 << leaf) - 1)
    for level in range(leaf, -1, -1):
        grid.alive[_level_start(level) + (row << level) + column] -= 1
        row >>= 1
        column >>= 1


@kernel
def _reach_for(grid: SampleIndex, samples: np.ndarray) -> int:
    """Read what `remove` reads of each: memory answers many at once when none waits for another.

    Returns a sum that means nothing, but for which the compiler must read.
    """
    leaves = _level_start(grid.levels - 1)
    read = 0
    for i in range(samples.shape[0]):
        c = grid.cell[samples[i]]
        read += grid.order[grid.first[c]] + grid.alive[leaves + c]
    return read


@kernel
def remove_empty(grid: SampleIndex, weights: np.ndarray, lowered: np.ndarray) -> int:
    """Take those of the lowered samples out that have no weight left; see `_reach_for`."""
    read: int = _reach_for(grid, lowered)
    for i in range(lowered.shape[0]):
        if weights[lowered[i]] <= 0:
            remove(grid, lowered[i])
    return read


@kernel
def _scan_cell(
    grid: SampleIndex,
    c: int,
    x: float,
    y: float,
    skip: np.ndarray,
    best: np.ndarray,
    near: np.ndarray,
) -> None:
    """Insert the cell's samples with weight into the k best, ordered by (distance, index)."""
    k = near.shape[0]
    start = grid.first[c]
    for i in range(start, start + grid.alive[_level_start(grid.levels - 1) + c]):
        j = grid.order[i]
        dx = grid.xy_m[j, 0] - x
        dy = grid.xy_m[j, 1] - y
        d2 = dx * dx + dy * dy
        if d2 > best[k - 1] or (d2 == best[k - 1] and near[k - 1] >= 0 and j > near[k - 1]):
            continue
        skipped = False
        for s in range(skip.shape[0]):
            skipped = skipped or skip[s] == j
        if skipped:
            continue
        at = k - 1
        while at > 0 and (d2 < best[at - 1] or (d2 == best[at - 1] and j < near[at - 1])):
            best[at] = best[at - 1]
            near[at] = near[at - 1]
            at -= 1
        best[at] = d2
        near[at] = j


@kernel
def _box_d2(grid: SampleIndex, level: int, row: int, column: int, x: float, y: float) -> float:
    """No sample of the node is nearer than this, squared. Border cells reach to infinity."""
    width = 1 << level
    edge = grid.frame[_CELL_M] * (1 << (grid.levels - 1 - level))
    left = grid.frame[_X] + column * edge - grid.frame[_MARGIN_M]
    right = grid.frame[_X] + (column + 1) * edge + grid.frame[_MARGIN_M]
    low = grid.frame[_Y] + row * edge - grid.frame[_MARGIN_M]
    high = grid.frame[_Y] + (row + 1) * edge + grid.frame[_MARGIN_M]
    dx = 0.0
    if x < left and column > 0:
        dx = left - x
    elif x > right and column < width - 1:
        dx = x - right
    dy = 0.0
    if y < low and row > 0:
        dy = low - y
    elif y > high and row < width - 1:
        dy = y - high
    return dx * dx + dy * dy


@kernel
def _reach_d2(grid: SampleIndex, level: int, row: int, column: int, x: float, y: float) -> float:
    """From (x, y) in a node, all that is nearer than this, squared, lies in the node too."""
    width = 1 << level
    edge = grid.frame[_CELL_M] * (1 << (grid.levels - 1 - level))
    reach: float = math.inf
    if column > 0:
        reach = min(reach, x - (grid.frame[_X] + column * edge))
    if column < width - 1:
        reach = min(reach, grid.frame[_X] + (column + 1) * edge - x)
    if row > 0:
        reach = min(reach, y - (grid.frame[_Y] + row * edge))
    if row < width - 1:
        reach = min(reach, grid.frame[_Y] + (row + 1) * edge - y)
    reach = max(reach - grid.frame[_MARGIN_M], 0.0)
    return reach * reach


@kernel
def _nearest_quarter(below: int, row: int, column: int, home_row: int, home_column: int) -> int:
    """Which quarter of a node, 2 * upper + right, lies towards the home cell.

    below: levels from the quarters down to the cells.
    """
    upper = home_row >= (2 * row + 1) << below
    right = home_column >= (2 * column + 1) << below
    return 2 * upper + right


@kernel
def nearest(
    grid: SampleIndex, x: float, y: float, skip: np.ndarray, best: np.ndarray, near: np.ndarray
) -> int:
    """The k nearest samples with weight that are not in `skip`; how many there are.

    best: (k,) float64 room for squared distances; near: (k,) int64 room for the samples, nearest
    first.
    """
    k = near.shape[0]
    best[:] = np.inf
    near[:] = -1
    leaf = grid.levels - 1
    home_column, home_row = _cell_of(grid, x, y)
    level, row, column = leaf, home_row, home_column
    _scan_cell(grid, (row << leaf) + column, x, y, skip, best, near)
    while level > 0:
        below = leaf - level
        at_home = home_row >> below == row and home_column >> below == column
        if at_home and best[k - 1] < _reach_d2(grid, level, row, column, x, y):
            break
        # Four siblings in turn: the one towards home, the two beside it, the one opposite. Then up.
        home = _nearest_quarter(below, row >> 1, column >> 1, home_row, home_column)
        turn = (2 * (row & 1) + (column & 1)) ^ home
        if turn == 3:
            level, row, column = level - 1, row >> 1, column >> 1
            continue
        quarter = (turn + 1) ^ home
        row, column = (row & ~1) + (quarter >> 1), (column & ~1) + (quarter & 1)
        # Down to the nearest cell of the sibling, while there can be something in it.
        while (
            grid.alive[_level_start(level) + (row << level) + column] > 0
            and _box_d2(grid, level, row, column, x, y) <= best[k - 1]
        ):
            if level == leaf:
                _scan_cell(grid, (row << leaf) + column, x, y, skip, best, near)
                break
            quarter = _nearest_quarter(leaf - level - 1, row, column, home_row, home_column)
            level, row, column = level + 1, 2 * row + (quarter >> 1), 2 * column + (quarter & 1)
    found = 0
    while found < k and near[found] >= 0:
        found += 1
    return found


def index_over(xy_m: npt.NDArray[np.float64], weights: npt.NDArray[np.int64]) -> SampleIndex:
    """The index over samples (N, 2).

    It keeps and reads `xy_m` itself: samples may be moved in place and sorted in anew by `build`.
    """
    count = xy_m.shape[0]
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    extent = float(max(high[0] - low[0], high[1] - low[1], 1e-9))
    levels = 1 + math.ceil(math.log(max(count / _PER_CELL, 1.0), 4.0))
    levels = min(max(levels, 2), _LEVELS_MAX)
    side = 1 << (levels - 1)
    grid = SampleIndex(
        xy_m=xy_m,
        order=np.zeros(count, dtype=np.int32),
        cell=np.zeros(count, dtype=np.int32),
        first=np.zeros(side * side + 1, dtype=np.int32),
        alive=np.zeros((4**levels - 1) // 3, dtype=np.int32),
        frame=np.array(
            [low[0], low[1], extent / side, _SLACK * (extent + float(np.abs(xy_m).max()))]
        ),
        levels=levels,
    )
    build(grid, weights)
    return grid
