"""Ways over an occupancy map: the cost of getting from one cell to every other, and the way itself.

The value function of Burgard et al. (2000), section 2.2.1, over the eight neighbours n of a cell x:

    V(source) = 0,  V(x) = min over n of V(n) + |x - n| cost(n)

A step is charged by the cell that it leaves. A cell is passable if its cost is finite and above 0. Only
passable cells are entered, and a diagonal step needs both cells beside it, so that no way cuts a
corner. With cost 1 everywhere V is the length of the way, in cells.

The paper iterates until nothing changes. Here every cell is settled once, by buckets (Dial 1969) hardly
narrower than the shortest step: no cell in the lowest bucket can improve another one in it, so that a
bucket needs no order. Both end in the same numbers, to the last bit. Where costs differ by more than
the ring of buckets holds, a binary heap settles the cells, with the same numbers again.
"""

import itertools
import math
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import CELLS_MAX
from kantor_protocol.base.kernels import kernel

UNKNOWN = 0.5
"""The probability of occupancy of a cell that no robot has seen."""
COST_MIN = 0.05
"""The least cost of a passable cell: at 0 there would be plateaus."""
TRUNCATE = 3.0
"""Standard deviations after which the smoothing kernel ends."""

_SLANT = math.sqrt(2.0)
_SLANTED = 0b10100101
"""The diagonal ones of the eight steps, a bit for each. Steps are in the order of the cells that they lead to."""
_RING = 256
"""Number of buckets: a power of two."""
RATIO_MAX = _RING / _SLANT - 2.0
"""The ratio of the highest to the lowest cost up to which the ring is wide enough."""
_LEAST, _MOST = 1e-200, 1e200
"""Costs in between can be divided by one another without overflow."""
_NARROWER = 1.0 - 2.0**-16
"""A bucket's width in shortest steps: rounding lets no step end in the bucket where it began, on any map
of up to `CELLS_MAX` cells."""
_ENTRIES = 8
"""Entries of one cell in all buckets: every neighbour improves it once at most."""
_REMEMBERED_CELLS = 1 << 18
"""The largest map of which answers are remembered."""
_NO_CELL = np.zeros(0, dtype=np.int64)
_LOWEST_BIT = np.array([0] + [(byte & -byte).bit_length() - 1 for byte in range(1, 256)])
"""Number of the lowest bit that is set, for each byte; 0 for 0."""


@kernel
def widened(box: np.ndarray, cells: int, rows: int, columns: int) -> tuple[int, int, int, int]:
    """A box, (4,) rows and columns from and below, and so many cells around it, as far as the map has them."""
    return (
        max(0, box[0] - cells),
        min(rows, box[1] + cells),
        max(0, box[2] - cells),
        min(columns, box[3] + cells),
    )


@kernel
def possible_moves(
    cost: np.ndarray,
    rows: int,
    columns: int,
    boxes: np.ndarray,
    reach: int,
    passable: np.ndarray,
    moves: np.ndarray,
) -> tuple[float, float]:
    """Find the steps that can be taken, after costs have changed; the lowest and the highest cost there.

    cost: (rows * columns,) float64. They have changed in boxes (n, 4) and as far around as `reach`. Outputs: passable,
    (rows + 2, columns + 2) bytes with a margin of zeros; moves, (rows * columns,) bytes with a bit for every step.
    """
    least, most = math.inf, 0.0
    for i in range(boxes.shape[0]):
        bottom, top, left, right = widened(boxes[i], reach, rows, columns)
        for row in range(bottom, top):
            for column in range(left, right):
                here = cost[row * columns + column]
                good = 0.0 < here < math.inf
                passable[row + 1, column + 1] = good
                least = min(least, here if good else math.inf)
                most = max(most, here if good else 0.0)
    for i in range(boxes.shape[0]):
        bottom, top, left, right = widened(boxes[i], reach + 1, rows, columns)
        for row in range(bottom, top):
            for column in range(left, right):
                down, up = passable[row, column + 1], passable[row + 2, column + 1]
                west, east = passable[row + 1, column], passable[row + 1, column + 2]
                moves[row * columns + column] = (
                    (down & west & passable[row, column])
                    | down << 1
                    | (down & east & passable[row, column + 2]) << 2
                    | west << 3
                    | east << 4
                    | (up & west & passable[row + 2, column]) << 5
                    | up << 6
                    | (up & east & passable[row + 2, column + 2]) << 7
                )
    return least, most


@kernel
def _mark(targets: np.ndarray, enough: int, wanted: np.ndarray) -> int:
    """Mark targets in `wanted` (cells,), where others may be already; how many wanted cells are to be settled."""
    count = 0
    for i in range(targets.shape[0]):
        if 0 <= targets[i] < wanted.shape[0] and not wanted[targets[i]]:
            wanted[targets[i]] = True
            count += 1
    return min(count, enough) if count > 0 else enough


@kernel
def _unmark(targets: np.ndarray, wanted: np.ndarray) -> None:
    for i in range(targets.shape[0]):
        if 0 <= targets[i] < wanted.shape[0]:
            wanted[targets[i]] = False


@kernel
def spread_by_buckets(
    price: np.ndarray,
    moves: np.ndarray,
    offsets: np.ndarray,
    source: int,
    targets: np.ndarray,
    enough: int,
    least: float,
    value: np.ndarray,
    around: np.ndarray,
    wanted: np.ndarray,
    heads: np.ndarray,
    links: np.ndarray,
    members: np.ndarray,
) -> tuple[int, int, int]:
    """Settle all cells, or as many targets as are enough.

    The lowest and the highest cell that was reached, and how many targets more would have been enough.

    `value` is infinite before, and the source passable. wanted: (cells,) further targets, which no target is.

    around: the memory of `value` with a margin at both ends, columns + 1 wide, so that all eight
    neighbours can be compared without first testing which of them exist: one branch that is hard to
    predict instead of sixteen.

    A bucket is a linked list of entries: `heads` has its first, `links` the one after an entry, `members`
    an entry's cell. When a cell moves to a lower bucket its entry stays in the higher one, and is skipped
    there.
    """
    per = 1.0 / (least * _NARROWER)
    margin = (around.shape[0] - value.shape[0]) >> 1
    heads[:] = -1
    heads[0], links[0], members[0] = 0, -1, source
    value[source] = 0.0
    queued, used, spare, bucket = 1, 1, -1, 0
    lowest, highest, left = source, source, _mark(targets, enough, wanted)
    while queued > 0:
        entry = heads[bucket & (_RING - 1)]
        if entry < 0:
            bucket += 1
            continue
        heads[bucket & (_RING - 1)] = links[entry]
        links[entry] = spare
        spare = entry
        queued -= 1
        cell = int(members[entry])
        if int(value[cell] * per) != bucket:
            continue
        if wanted[cell]:
            left -= 1
            if left == 0:
                break
        straight, slant = value[cell] + price[cell], value[cell] + _SLANT * price[cell]
        better = 0
        for step in range(8):
            offer = slant if (_SLANTED >> step) & 1 else straight
            better |= int(offer < around[margin + cell + offsets[step]]) << step
        better &= int(moves[cell])
        while better != 0:
            step = _LOWEST_BIT[better]
            better &= better - 1
            n = cell + offsets[step]
            offer = slant if (_SLANTED >> step) & 1 else straight
            before = value[n]
            value[n] = offer
            lowest, highest = min(lowest, n), max(highest, n)
            new = int(offer * per)
            if before < math.inf and int(before * per) == new:
                continue
            if spare >= 0:
                entry, spare = spare, links[spare]
            else:
                entry, used = used, used + 1
            members[entry] = n
            links[entry] = heads[new & (_RING - 1)]
            heads[new & (_RING - 1)] = entry
            queued += 1
    _unmark(targets, wanted)
    return lowest, highest, left


@kernel
def _rise(value: np.ndarray, heap: np.ndarray, place: np.ndarray, cell: int, at: int) -> None:
    """Sift a cell up: put it where it belongs between the heap's top and the free place `at`."""
    while at > 0 and value[cell] < value[heap[(at - 1) >> 1]]:
        above = (at - 1) >> 1
        heap[at] = heap[above]
        place[heap[at]] = at
        at = above
    heap[at] = cell
    place[cell] = at


@kernel
def _pop_least(value: np.ndarray, heap: np.ndarray, place: np.ndarray, size: int) -> int:
    """Take the cell of the lowest value from a heap of `size` cells."""
    first, last = heap[0], heap[size - 1]
    at, below, end = 0, 1, size - 1
    while below < end:
        if below + 1 < end and value[heap[below + 1]] < value[heap[below]]:
            below += 1
        if value[last] <= value[heap[below]]:
            break
        heap[at] = heap[below]
        place[heap[at]] = at
        at, below = below, 2 * below + 1
    heap[at] = last
    place[last] = at
    return int(first)


@kernel
def spread_by_heap(
    price: np.ndarray,
    moves: np.ndarray,
    offsets: np.ndarray,
    source: int,
    targets: np.ndarray,
    enough: int,
    value: np.ndarray,
    wanted: np.ndarray,
    heap: np.ndarray,
    place: np.ndarray,
) -> tuple[int, int, int]:
    """`spread_by_buckets` for any costs.

    heap, place: (cells,) scratch: the cell at each place of the heap, and the place of each cell.
    """
    value[source] = 0.0
    heap[0], place[source], size = source, 0, 1
    lowest, highest, left = source, source, _mark(targets, enough, wanted)
    while size > 0:
        cell = _pop_least(value, heap, place, size)
        size -= 1
        if wanted[cell]:
            left -= 1
            if left == 0:
                break
        straight, slant = value[cell] + price[cell], value[cell] + _SLANT * price[cell]
        for step in range(8):
            if not (moves[cell] >> step) & 1:
                continue
            n = cell + offsets[step]
            offer = slant if (_SLANTED >> step) & 1 else straight
            if offer >= value[n]:
                continue
            if value[n] == math.inf:
                place[n] = size
                size += 1
            value[n] = offer
            lowest, highest = min(lowest, n), max(highest, n)
            _rise(value, heap, place, n, place[n])
    _unmark(targets, wanted)
    return lowest, highest, left


@kernel
def trace(
    price: np.ndarray,
    moves: np.ndarray,
    offsets: np.ndarray,
    source: int,
    target: int,
    value: np.ndarray,
    way: np.ndarray,
) -> int:
    """Write the cells from the target back to the source into way (cells,); returns how many, 0 without a way.

    The predecessor of a cell is the neighbour that gave it its value; of several the one of the lowest
    value, then of the lowest index.
    """
    if not (0 <= target < value.shape[0] and value[target] < math.inf):
        return 0
    cell = target
    for count in range(way.shape[0]):
        way[count] = cell
        if cell == source:
            return count + 1
        best, lowest = -1, value[cell]
        for step in range(8):
            if not (moves[cell] >> step) & 1:
                continue
            n = cell + offsets[step]
            length = _SLANT if (_SLANTED >> step) & 1 else 1.0
            if value[n] < lowest and value[n] + length * price[n] == value[cell]:
                best, lowest = n, value[n]
        if best < 0:
            return 0
        cell = best
    return 0


Answers = dict[tuple[int, bytes], npt.NDArray[np.float64]]
"""By source and targets, the values of these; read them only."""


class Scratch:
    """What a spread works with. Memory that no spread has needed is not touched."""

    def __init__(self, rows: int, columns: int) -> None:
        cells = rows * columns
        self.around = np.full(cells + 2 * (columns + 1), np.inf)
        self.value = self.around[columns + 1 : -(columns + 1)]
        """(cells,) infinite but between the two cells of `reached`."""
        self.reached = (0, -1)
        self.wanted = np.zeros(cells, dtype=np.bool_)
        self.heads = np.empty(_RING, dtype=np.int32)
        self.links = np.empty(_ENTRIES * cells, dtype=np.int32)
        self.members = np.empty(_ENTRIES * cells, dtype=np.int32)
        self.way = np.empty(cells, dtype=np.int32)
        self._cost = np.zeros(0)
        self._answers: Answers = {}
        """Over `_cost`."""

    def answers(self, cost: npt.NDArray[np.float64]) -> Answers:
        """What was asked before over exactly these costs, by any participant of this process, to be added to.

        Robots in contact know the same, and each asks the same of it. A large map is not remembered.
        """
        if cost.shape[0] > _REMEMBERED_CELLS:
            return {}
        if not np.array_equal(self._cost, cost):
            self._cost, self._answers = cost.copy(), {}
        return self._answers

    def clear(self) -> None:
        """Make all values infinite."""
        lowest, highest = self.reached
        self.value[lowest : highest + 1] = np.inf
        self.reached = (0, -1)


@lru_cache(maxsize=1)
def shared_scratch(rows: int, columns: int) -> Scratch:
    """For all in one process whose values nobody reads after the next spread of another."""
    return Scratch(rows, columns)


class Routes:
    """The value function over one grid, and the ways by it."""

    def __init__(self, rows: int, columns: int, scratch: Scratch | None = None) -> None:
        """scratch: by default of its own. Raises ValueError if there is no cell, or more than `CELLS_MAX`."""
        if rows < 1 or columns < 1 or rows * columns > CELLS_MAX:
            raise ValueError(f"a grid of {rows} x {columns} cells: 1 to {CELLS_MAX} are possible")
        self.rows, self.columns, self.cells = rows, columns, rows * columns
        self.cost = np.zeros(self.cells)
        """(cells,) of crossing a cell, row by row; not passable unless it is finite and above 0."""
        self._least, self._most = math.inf, 0.0
        """No cost is lower, and none higher, of cells that are passable."""
        self._source = -1
        self._passable = np.zeros((rows + 2, columns + 2), dtype=np.uint8)
        self._moves = np.zeros(self.cells, dtype=np.uint8)
        across = (-1, 0, 1)
        steps = [columns * i + j for i in across for j in across if (i, j) != (0, 0)]
        self._offsets = np.array(steps, dtype=np.int64)
        self._scratch = scratch or Scratch(rows, columns)

    def renew(self, boxes: npt.NDArray[np.int64], reach: int = 0) -> None:
        """Take in that costs have changed in boxes (n, 4), rows and columns from and below, and around them."""
        grid = (self.cost, self.rows, self.columns, boxes, reach)
        least, most = possible_moves(*grid, self._passable, self._moves)
        self._least, self._most = min(self._least, least), max(self._most, most)

    def spread(
        self, cost: npt.NDArray[np.float64], source: int, *, until: int = -1
    ) -> npt.NDArray[np.float64]:
        """`spread_from` with other costs (cells,): up to one cell, or to all.

        Raises ValueError if there are not as many costs as cells.
        """
        if cost.shape != (self.cells,):
            raise ValueError(f"costs of shape {cost.shape} for {self.cells} cells")
        self.cost[:] = cost
        self._least, self._most = math.inf, 0.0
        self.renew(np.array([[0, self.rows, 0, self.columns]]))
        return self.spread_from(source, np.array([until]))

    def spread_from(self, source: int, targets: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """(cells,) the value function: the cost of the way from the source to every cell, inf without a way.

        targets: stop as soon as the values of these cells are final; others may be too high. Cells that are not on
        the map do not count, and without any all values are final. If the source is no passable cell, no cell is
        reached, not even the source.

        The array belongs to the scratch: read it only, the next spread overwrites it.
        """
        self._spread(source, targets, self._scratch.wanted, CELLS_MAX)
        return self._scratch.value

    def reaches(self, source: int, wanted: npt.NDArray[np.bool_]) -> bool:
        """Whether a way leads from the source to any of the wanted cells (cells,)."""
        return self._spread(source, _NO_CELL, wanted, 1) == 0

    def _spread(
        self,
        source: int,
        targets: npt.NDArray[np.int64],
        wanted: npt.NDArray[np.bool_],
        enough: int,
    ) -> int:
        """Compute values; how many more wanted cells would have been enough."""
        scratch, source = self._scratch, int(source)
        self._source = source
        scratch.clear()
        if not (0 <= source < self.cells and 0.0 < self.cost[source] < math.inf):
            return enough
        graph = (self.cost, self._moves, self._offsets, source, targets, enough)
        room = (scratch.links, scratch.members)
        least, most = self._least, self._most
        if most <= RATIO_MAX * least and least >= _LEAST and most <= _MOST:
            values = (scratch.value, scratch.around, wanted, scratch.heads)
            lowest, highest, left = spread_by_buckets(*graph, least, *values, *room)
        else:
            lowest, highest, left = spread_by_heap(*graph, scratch.value, wanted, *room)
        scratch.reached = lowest, highest
        return int(left)

    def way(self, target: int) -> npt.NDArray[np.int64]:
        """The cells of the way from the source of the last `spread` to the target, both ends included.

        The way is empty if the target was not reached, and also where costs are so small beside the value
        that their sum does not grow. Of ways that cost the same it is, seen from the target, the one whose
        last cells have the lowest value, then the lowest index.
        """
        scratch = self._scratch
        graph = (self.cost, self._moves, self._offsets, self._source, target)
        count = trace(*graph, scratch.value, scratch.way)
        return scratch.way[:count][::-1].astype(np.int64)


def iterate_once(
    cost: npt.NDArray[np.float64], value: npt.NDArray[np.float64], source: int
) -> npt.NDArray[np.float64]:
    """(rows, columns) one iteration of the paper's update on all cells at once, of which V is the fixed point.

    cost, value: (rows, columns). Slow and plain: for assertions.
    """
    rows, columns = cost.shape
    price = np.pad(cost, 1, constant_values=np.inf)
    before = np.pad(value, 1, constant_values=np.inf)
    passable = np.isfinite(price) & (price > 0.0)

    def shifted(array: npt.NDArray[Any], up: int, right: int) -> npt.NDArray[Any]:
        return array[1 + up : 1 + up + rows, 1 + right : 1 + right + columns]

    least = np.full((rows, columns), np.inf)
    for up, right in itertools.product((-1, 0, 1), repeat=2):
        can = shifted(passable, up, right) & shifted(passable, up, 0) & shifted(passable, 0, right)
        step = math.sqrt(2.0) if up and right else 1.0
        offer = shifted(before, up, right) + step * shifted(price, up, right)
        if (up, right) != (0, 0):
            least = np.where(can & shifted(passable, 0, 0), np.fmin(least, offer), least)
    if 0 <= source < value.size and shifted(passable, 0, 0).flat[source]:
        least.flat[source] = 0.0
    return least


def length_cost(passable: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """(cells,) costs with which V is the length of the way in cells. passable: (rows, columns)."""
    return np.where(passable, 1.0, np.inf).ravel()


def gaussian(sigma_cells: float) -> npt.NDArray[np.float64]:
    """(reach + 1,) weights of a Gaussian that ends after `TRUNCATE` standard deviations, from its middle."""
    reach = int(TRUNCATE * sigma_cells + 0.5)
    if reach == 0:
        return np.ones(1)
    bell = np.exp(-0.5 / (sigma_cells * sigma_cells) * np.arange(-reach, reach + 1) ** 2)
    return np.asarray((bell / bell.sum())[reach:])


def _smoothed_rows(
    table: npt.NDArray[np.float64], weights: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(rows, columns) a table smoothed across its rows; it goes on beyond its border as it is there."""
    reach, rows = weights.shape[0] - 1, table.shape[0]
    around = np.pad(table, ((reach, reach), (0, 0)), mode="edge")
    smooth: npt.NDArray[np.float64] = table * weights[0]
    for k in range(reach, 0, -1):
        both = around[reach - k : reach - k + rows] + around[reach + k : reach + k + rows]
        smooth += both * weights[k]
    return smooth


def smoothed_cost(
    p_occ: npt.NDArray[np.float64],
    explored: npt.NDArray[np.bool_],
    *,
    sigma_cells: float,
    p_max: float,
) -> npt.NDArray[np.float64]:
    """(cells,) costs of Burgard et al. (2000), section 2.2.1: the occupancy, smoothed by a Gaussian.

    p_occ: (rows, columns) probability that a cell is occupied; explored: the same shape. A cell that is not
    explored counts as `UNKNOWN`, the map goes on beyond its border as it is there, the Gaussian ends after
    `TRUNCATE` standard deviations, and the costs are at least `COST_MIN`. A cell is passable if it is
    explored and its occupancy is below `p_max` before smoothing: a step is charged by the cell that it
    leaves, so that it would be cheap to step into a wall. Slow and plain: `cost_map.py` renews costs in part.
    """
    smooth, weights = np.where(explored, p_occ, UNKNOWN), gaussian(sigma_cells)
    for _ in range(2):  # rows, then columns
        smooth = _smoothed_rows(smooth, weights).T
    passable = explored & (p_occ < p_max)
    return np.where(passable, np.maximum(smooth, COST_MIN), np.inf).ravel()
