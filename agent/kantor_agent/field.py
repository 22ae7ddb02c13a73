"""Samples in space: the nearest ones that still have weight, found and used up in microseconds.

A bucket grid holds the samples of each cell, those with weight in front; above it a pyramid counts
them, so that a search skips what is empty. A query looks at the 3 x 3 cells around the point first.
Where those do not settle it, it descends the pyramid and prunes by distance: the cost stays flat in N
and does not grow when most samples are used up.

All orders are by (squared distance, index), which makes every answer unique: it equals a full scan.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

_PER_CELL = 2.0
"""Samples in a cell on average."""
_LEVELS_MAX = 11
_SLACK = 1e-9
"""Share of the extent by which a cell's box is taken larger than it is, against rounding."""

# Slots of Grid.frame.
_X, _Y, _CELL_M, _MARGIN_M = 0, 1, 2, 3


class Grid(NamedTuple):
    """The index over N samples, for the kernels. C = 4^(levels - 1) cells, `side` in a row."""

    xy_m: npt.NDArray[np.float64]
    """(N, 2) world frame."""
    order: npt.NDArray[np.int32]
    """(N,) samples by cell, those with weight first."""
    slot: npt.NDArray[np.int32]
    """(N,) where each sample is in `order`."""
    cell: npt.NDArray[np.int32]
    """(N,) the cell of each sample."""
    first: npt.NDArray[np.int32]
    """(C + 1,) where each cell begins in `order`."""
    alive: npt.NDArray[np.int32]
    """Samples with weight: per node, level by level from the root, row by row in each."""
    frame: npt.NDArray[np.float64]
    """Lower left corner (x, y), edge of a cell, margin; metres."""
    levels: int


@njit(cache=True)
def _level_start(level: int) -> int:
    return ((1 << (2 * level)) - 1) // 3


@njit(cache=True)
def _cell_of(grid: Grid, x: float, y: float) -> tuple[int, int]:
    side = 1 << (grid.levels - 1)
    column = int((x - grid.frame[_X]) / grid.frame[_CELL_M])
    row = int((y - grid.frame[_Y]) / grid.frame[_CELL_M])
    return min(max(column, 0), side - 1), min(max(row, 0), side - 1)


@njit(cache=True)
def build(grid: Grid, weights: np.ndarray) -> None:
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
    # Two passes keep the samples with weight in front: alive counts from the start, dead from the end.
    for j in range(grid.xy_m.shape[0]):
        if weights[j] > 0:
            c = grid.cell[j]
            grid.order[grid.first[c] + grid.alive[leaves + c]] = j
            grid.slot[j] = grid.first[c] + grid.alive[leaves + c]
            grid.alive[leaves + c] += 1
    dead = np.zeros(side * side, dtype=np.int32)
    for j in range(grid.xy_m.shape[0]):
        if weights[j] <= 0:
            c = grid.cell[j]
            dead[c] += 1
            grid.order[grid.first[c + 1] - dead[c]] = j
            grid.slot[j] = grid.first[c + 1] - dead[c]
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


@njit(cache=True)
def remove(grid: Grid, j: int) -> None:
    """Take a sample out of the search. A sample that is out already stays out."""
    c = grid.cell[j]
    leaf = _level_start(grid.levels - 1) + c
    last = grid.first[c] + grid.alive[leaf] - 1
    if grid.slot[j] > last:
        return
    other = grid.order[last]
    grid.order[grid.slot[j]], grid.order[last] = other, j
    grid.slot[other], grid.slot[j] = grid.slot[j], last
    side = 1 << (grid.levels - 1)
    row, column = c // side, c % side
    for level in range(grid.levels - 1, -1, -1):
        grid.alive[_level_start(level) + row * (1 << level) + column] -= 1
        row >>= 1
        column >>= 1


@njit(cache=True)
def remove_empty(grid: Grid, weights: np.ndarray, lowered: np.ndarray) -> None:
    """Take those of the lowered samples out that have no weight left."""
    for i in range(lowered.shape[0]):
        if weights[lowered[i]] <= 0:
            remove(grid, lowered[i])


@njit(cache=True)
def _scan_cell(
    grid: Grid, c: int, x: float, y: float, skip: np.ndarray, best: np.ndarray, near: np.ndarray
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


@njit(cache=True)
def _box_d2(grid: Grid, level: int, row: int, column: int, x: float, y: float) -> float:
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


@njit(cache=True)
def nearest(
    grid: Grid, x: float, y: float, skip: np.ndarray, best: np.ndarray, near: np.ndarray
) -> int:
    """The k nearest samples with weight that are not in `skip`; how many there are.

    best: (k,) float64 room for squared distances; near: (k,) int64 room for the samples, nearest
    first.
    """
    k = near.shape[0]
    best[:] = np.inf
    near[:] = -1
    leaf_level = grid.levels - 1
    side = 1 << leaf_level
    leaves = _level_start(leaf_level)
    home_column, home_row = _cell_of(grid, x, y)
    low_row, high_row = max(home_row - 1, 0), min(home_row + 1, side - 1)
    low_column, high_column = max(home_column - 1, 0), min(home_column + 1, side - 1)
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            if grid.alive[leaves + row * side + column] > 0:
                _scan_cell(grid, row * side + column, x, y, skip, best, near)
    # Distance to what lies outside the block: no cell beyond a border.
    reach = np.inf
    edge = grid.frame[_CELL_M]
    if low_column > 0:
        reach = min(reach, x - (grid.frame[_X] + low_column * edge))
    if high_column < side - 1:
        reach = min(reach, grid.frame[_X] + (high_column + 1) * edge - x)
    if low_row > 0:
        reach = min(reach, y - (grid.frame[_Y] + low_row * edge))
    if high_row < side - 1:
        reach = min(reach, grid.frame[_Y] + (high_row + 1) * edge - y)
    reach -= grid.frame[_MARGIN_M]
    if not (near[k - 1] >= 0 and reach > 0.0 and best[k - 1] < reach * reach):
        _descend(grid, x, y, skip, best, near, low_row, high_row, low_column, high_column)
    found = 0
    while found < k and near[found] >= 0:
        found += 1
    return found


@njit(cache=True)
def _descend(
    grid: Grid,
    x: float,
    y: float,
    skip: np.ndarray,
    best: np.ndarray,
    near: np.ndarray,
    low_row: int,
    high_row: int,
    low_column: int,
    high_column: int,
) -> None:
    """Search the whole pyramid, nearest node first, but for the block of leaves already seen."""
    k = near.shape[0]
    stack = np.empty(4 * _LEVELS_MAX, dtype=np.int64)
    bounds = np.empty(4 * _LEVELS_MAX, dtype=np.float64)
    stack[0] = 0
    bounds[0] = 0.0
    top = 1
    child_d2 = np.empty(4, dtype=np.float64)
    child_node = np.empty(4, dtype=np.int64)
    while top > 0:
        top -= 1
        if bounds[top] > best[k - 1]:
            continue
        level = stack[top] >> 48
        row = (stack[top] >> 24) & 0xFFFFFF
        column = stack[top] & 0xFFFFFF
        if level == grid.levels - 1:
            if not (low_row <= row <= high_row and low_column <= column <= high_column):
                _scan_cell(grid, row * (1 << level) + column, x, y, skip, best, near)
            continue
        below = level + 1
        start = _level_start(below)
        count = 0
        for q in range(4):
            child_row, child_column = 2 * row + (q >> 1), 2 * column + (q & 1)
            if grid.alive[start + child_row * (1 << below) + child_column] <= 0:
                continue
            d2 = _box_d2(grid, below, child_row, child_column, x, y)
            if d2 > best[k - 1]:
                continue
            at = count
            while at > 0 and child_d2[at - 1] < d2:
                child_d2[at] = child_d2[at - 1]
                child_node[at] = child_node[at - 1]
                at -= 1
            child_d2[at] = d2
            child_node[at] = (below << 48) | (child_row << 24) | child_column
            count += 1
        for i in range(count):
            bounds[top] = child_d2[i]
            stack[top] = child_node[i]
            top += 1


def grid_over(xy_m: npt.NDArray[np.float64], weights: npt.NDArray[np.int64]) -> Grid:
    """The index over samples (N, 2).

    It keeps and reads `xy_m` itself: samples may be moved in place and sorted in anew by `build`.
    """
    count = xy_m.shape[0]
    low, high = xy_m.min(axis=0), xy_m.max(axis=0)
    extent = float(max(high[0] - low[0], high[1] - low[1], 1e-9))
    levels = 1 + math.ceil(math.log(max(count / _PER_CELL, 1.0), 4.0))
    levels = min(max(levels, 2), _LEVELS_MAX)
    side = 1 << (levels - 1)
    grid = Grid(
        xy_m=xy_m,
        order=np.zeros(count, dtype=np.int32),
        slot=np.zeros(count, dtype=np.int32),
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
