"""Who may be in range of whom: participants by place, so that a ruling costs by neighbours and not by pairs.

Square cells, none smaller than the range, hold the participants; whoever is in range is in one of the nine cells around.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel

_RUNS = 10
"""Of candidates in ascending order, at most: one in each of nine cells, and the supervisor."""
_SLACK = 1e-9
"""Share by which a cell is larger than the range, against rounding."""
_LEAST_M = 1e-100
"""An edge whose square is not 0."""

_LEFT_M, _BOTTOM_M, _EDGE_M = 0, 1, 2


class Neighbourhood(NamedTuple):
    """Room for n participants by place."""

    side: int
    """Cells along each side."""
    first: npt.NDArray[np.int64]
    """(side^2 + 1,) where the participants of each cell, row by row, begin in `order`; the last entry is their number."""
    order: npt.NDArray[np.int64]
    """(n + 1,) participants with a place, cell by cell, in each by index; the last is the supervisor."""
    near: npt.NDArray[np.int64]
    """(n,) candidates of one participant."""
    runs: npt.NDArray[np.int64]
    """(_RUNS, 2) scratch: where the next of each run is in `order`, and where the run ends."""
    frame: npt.NDArray[np.float64]
    """(3,) left, bottom, edge of a cell; metres."""

    @classmethod
    def of(cls, participants: int) -> "Neighbourhood":
        """Room for so many."""
        side = max(1, math.isqrt(participants))
        return cls(
            side,
            np.zeros(side * side + 1, dtype=np.int64),
            np.zeros(participants + 1, dtype=np.int64),
            np.zeros(participants, dtype=np.int64),
            np.zeros((_RUNS, 2), dtype=np.int64),
            np.zeros(3),
        )


@kernel
def _cell_along(at_m: float, from_m: float, around: Neighbourhood) -> int:
    return min(max(int((at_m - from_m) / around.frame[_EDGE_M]), 0), around.side - 1)


@kernel
def _cell(xy_m: np.ndarray, one: int, around: Neighbourhood) -> int:
    """The cell of a participant; -1 without a place."""
    x, y = xy_m[one, 0], xy_m[one, 1]
    if not (math.isfinite(x) and math.isfinite(y)):
        return -1
    row = _cell_along(y, around.frame[_BOTTOM_M], around)
    cell: int = row * around.side + _cell_along(x, around.frame[_LEFT_M], around)
    return cell


@kernel
def sort_by_place(xy_m: np.ndarray, range_m: float, supervisor: int, around: Neighbourhood) -> None:
    """Sort all participants but the supervisor (an index, or -1) into cells. xy_m: (n, 2); range_m: finite."""
    left, bottom, right, top = math.inf, math.inf, -math.inf, -math.inf
    for i in range(xy_m.shape[0]):
        x, y = xy_m[i, 0], xy_m[i, 1]
        if math.isfinite(x) and math.isfinite(y):
            left, right = min(left, x), max(right, x)
            bottom, top = min(bottom, y), max(top, y)
    extent = max(right - left, top - bottom, 0.0)
    around.frame[_LEFT_M], around.frame[_BOTTOM_M] = left, bottom
    around.frame[_EDGE_M] = max(range_m, extent / around.side, _LEAST_M) * (1.0 + _SLACK)
    first, order = around.first, around.order
    first[:] = 0
    for i in range(xy_m.shape[0]):
        cell = _cell(xy_m, i, around)
        if cell >= 0 and i != supervisor:
            first[cell] += 1
    total = 0
    for cell in range(first.shape[0]):
        total += first[cell]
        first[cell] = total
    for i in range(xy_m.shape[0] - 1, -1, -1):
        cell = _cell(xy_m, i, around)
        if cell >= 0 and i != supervisor:
            first[cell] -= 1
            order[first[cell]] = i
    order[order.shape[0] - 1] = supervisor


@kernel
def candidates(xy_m: np.ndarray, one: int, around: Neighbourhood) -> int:
    """Write who may be in range of a participant, itself included, into `near`, by index; their number.

    After `sort_by_place`. The supervisor is always one of them.
    """
    runs, order, near = around.runs, around.order, around.near
    last = order.shape[0] - 1
    many = 0
    if order[last] >= 0:
        runs[0, 0], runs[0, 1] = last, last + 1
        many = 1
    cell = _cell(xy_m, one, around)
    if cell >= 0:
        row, column = cell // around.side, cell % around.side
        for there in range(max(row - 1, 0), min(row + 2, around.side)):
            for beside in range(max(column - 1, 0), min(column + 2, around.side)):
                begin = around.first[there * around.side + beside]
                end = around.first[there * around.side + beside + 1]
                if begin < end:
                    runs[many, 0], runs[many, 1] = begin, end
                    many += 1
    count = 0
    while many > 0:
        least = 0
        for run in range(1, many):
            if order[runs[run, 0]] < order[runs[least, 0]]:
                least = run
        near[count] = order[runs[least, 0]]
        count += 1
        runs[least, 0] += 1
        if runs[least, 0] == runs[least, 1]:
            many -= 1
            runs[least, 0], runs[least, 1] = runs[many, 0], runs[many, 1]
    return count
