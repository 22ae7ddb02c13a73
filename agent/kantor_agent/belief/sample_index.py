"""Spatial index over samples: finds the nearest ones that still have weight, in microseconds.

A bucket grid holds the samples of each cell, those with weight in front; above it a pyramid counts
them, so that a search skips empty nodes. A query begins in the cell of the point and climbs the
pyramid: on every level it searches the three siblings, each from the nearest cell on, unless they are
empty or further away than the k-th best so far, and it ends when nothing outside can be nearer. The
cost stays flat in N and does not grow when most samples are used up.

All orders are by (squared distance, index), which makes every answer unique: it equals a full scan.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel

_PER_CELL = 2.0
"""Samples in a cell, on average."""
_LEVELS_MAX = 11
_SLACK = 1e-9
"""Share of the extent by which a cell's box is taken larger than it is, against rounding."""

# Places in `SampleIndex.frame`.
_X, _Y, _CELL_M, _MARGIN_M = 0, 1, 2, 3


class SampleIndex(NamedTuple):
    """The index over N samples, as kernels take it. C = 4^(levels - 1) cells.

    What the attributes say of one another, and of the weights, holds after `build`, `remove` and
    `remove_empty`; `validate` asserts it.
    """

    xy_m: npt.NDArray[np.float64]
    """(N, 2) positions of the samples, world frame."""
    order: npt.NDArray[np.int32]
    """(N,) every sample once, cell by cell; in each cell those with weight come first."""
    cell: npt.NDArray[np.int32]
    """(N,) the cell in which `xy_m` lies, by `frame`; beyond the frame, the nearest at its border."""
    first: npt.NDArray[np.int32]
    """(C + 1,) where the samples of each cell begin in `order`; the last entry is N."""
    alive: npt.NDArray[np.int32]
    """(nodes,) samples with weight, level by level from the root to the cells, row by row in each: a
    cell counts those in front in its part of `order`, any other node the sum of its four children."""
    frame: npt.NDArray[np.float64]
    """(4,) lower left corner (x, y), edge of a cell, margin; metres."""
    levels: int
    """From the root to the cells; a row of cells has 2^(levels - 1)."""

    def validate(self, weights: npt.NDArray[np.int64] | npt.NDArray[np.int32]) -> None:
        """Assert what the attributes say of one another and of the weights (N,)."""
        count, side = self.xy_m.shape[0], 1 << (self.levels - 1)
        place = (self.xy_m - self.frame[:2]) / self.frame[_CELL_M]
        column, row = np.clip(place, 0, side - 1).astype(np.int64).T
        assert np.array_equal(self.cell, row * side + column)
        assert np.array_equal(np.sort(self.order), np.arange(count))
        assert self.first[0] == 0
        assert self.first[-1] == count
        sizes = np.diff(self.first)
        assert np.array_equal(self.cell[self.order], np.repeat(np.arange(side * side), sizes))
        rank = np.arange(count) - np.repeat(self.first[:-1], sizes)
        in_front = rank < np.repeat(self.alive[-side * side :], sizes)
        assert np.array_equal(in_front, weights[self.order] > 0)
        here = 0
        for level in range(self.levels - 1):
            nodes = 4**level
            below = self.alive[here + nodes : here + 5 * nodes].reshape(
                1 << level, 2, 1 << level, 2
            )
            assert np.array_equal(self.alive[here : here + nodes], below.sum(axis=(1, 3)).ravel())
            here += nodes


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
    """Sort all samples into cells by their present positions, and count those with weight."""
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
    # Those with weight first, so that they are in front. The others count only while they are placed.
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
    """Take a sample out of the search; one that is out already stays out."""
    leaf = grid.levels - 1
    c = grid.cell[j]
    start = grid.first[c]
    end = start + grid.alive[_level_start(leaf) + c]
    at = start
    while at < end and grid.order[at] != j:
        at += 1
    if at == end:
        return
    grid.order[at], grid.order[end - 1] = grid.order[end - 1], j
    row, column = c >> leaf, c & ((1 << leaf) - 1)
    for level in range(leaf, -1, -1):
        grid.alive[_level_start(level) + (row << level) + column] -= 1
        row >>= 1
        column >>= 1


@kernel
def _prefetch(grid: SampleIndex, samples: np.ndarray) -> int:
    """Prefetch what `remove` reads of each sample: loads that do not depend on one another overlap.

    Returns a sum without meaning, which keeps the compiler from dropping the loads.
    """
    leaves = _level_start(grid.levels - 1)
    read = 0
    for i in range(samples.shape[0]):
        c = grid.cell[samples[i]]
        read += grid.order[grid.first[c]] + grid.alive[leaves + c]
    return read


@kernel
def remove_empty(grid: SampleIndex, weights: np.ndarray, lowered: np.ndarray) -> int:
    """Take out those of the lowered samples that have no weight left; returns the sum of `_prefetch`."""
    read: int = _prefetch(grid, lowered)
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
    """Insert the samples with weight of a cell into the k best, ordered by (distance, index)."""
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
    """Squared lower bound on the distance to the samples of a node; border cells reach to infinity."""
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
    """Squared radius around (x, y), in a node, within which all samples lie in the node too."""
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
    """The quarter of a node, 2 * upper + right, that lies towards the home cell.

    below: levels from the quarters down to the cells.
    """
    upper = home_row >= (2 * row + 1) << below
    right = home_column >= (2 * column + 1) << below
    return 2 * upper + right


@kernel
def nearest(
    grid: SampleIndex, x: float, y: float, skip: np.ndarray, best: np.ndarray, near: np.ndarray
) -> int:
    """Find the k nearest samples with weight that are not in `skip`; returns how many there are.

    best: (k,) float64 output, squared distances; near: (k,) int64 output, the samples, nearest first.
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
    """Build the index over samples (N, 2) with weights (N,).

    It keeps `xy_m` itself: samples may be moved in place and sorted in anew by `build`.
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
