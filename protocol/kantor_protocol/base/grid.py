"""Occupancy maps: the frame of their cells in the world, and the cells that a straight line crosses.

A map is an array (rows, columns) of UNKNOWN, FREE or OCCUPIED; row 0 is lowest (y up), column 0 is
leftmost. Where one number names a cell it is row * columns + column.
"""

import math
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from kantor_protocol.base.kernels import kernel

UNKNOWN, FREE, OCCUPIED = 0, 1, 2

CELLS_MAX = 16_000_000
"""The most cells of one map: 4000 x 4000."""

NOWHERE = -1
"""Instead of a cell: outside the map."""


class Frame(msgspec.Struct, frozen=True, array_like=True):
    """The frame of a map: how its cells lie in the world."""

    resolution_m: Annotated[float, Meta(gt=0.0)]
    """The side of a cell."""
    origin_m: tuple[float, float]
    """World frame: the lower left corner of the map."""
    rows: Annotated[int, Meta(ge=1)]
    columns: Annotated[int, Meta(ge=1)]

    @property
    def cells(self) -> int:
        """The number of cells."""
        return self.rows * self.columns

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """World frame: left, right, bottom, top, in the order of matplotlib."""
        x, y = self.origin_m
        return x, x + self.columns * self.resolution_m, y, y + self.rows * self.resolution_m

    @property
    def diagonal_m(self) -> float:
        """The distance from corner to corner."""
        return math.hypot(self.rows, self.columns) * self.resolution_m

    def uv(self, x_m: float, y_m: float) -> tuple[float, float]:
        """A place in the world in cells from the lower left corner, column axis first."""
        return (
            (x_m - self.origin_m[0]) / self.resolution_m,
            (y_m - self.origin_m[1]) / self.resolution_m,
        )

    def cell_of(self, x_m: float, y_m: float) -> int:
        """The cell at a place in the world, or NOWHERE."""
        u, v = self.uv(x_m, y_m)
        if 0.0 <= u < self.columns and 0.0 <= v < self.rows:  # false for NaN
            return int(v) * self.columns + int(u)
        return NOWHERE

    def centre_of(self, cell: int) -> tuple[float, float]:
        """World frame, metres: the middle of a cell."""
        row, column = divmod(cell, self.columns)
        return (
            self.origin_m[0] + (column + 0.5) * self.resolution_m,
            self.origin_m[1] + (row + 0.5) * self.resolution_m,
        )


@kernel
def neighbour(cell: int, side: int, columns: int, cells: int) -> int:
    """One of the four neighbours of a cell, or NOWHERE where the map ends.

    side: 0 below, 1 left, 2 right, 3 above. cells: how many the map has.
    """
    if side == 0:
        return cell - columns if cell >= columns else NOWHERE
    if side == 1:
        return cell - 1 if cell % columns > 0 else NOWHERE
    if side == 2:
        return cell + 1 if (cell + 1) % columns > 0 else NOWHERE
    return cell + columns if cell + columns < cells else NOWHERE


@kernel
def next_cell(
    row: int, column: int, u: float, v: float, du: float, dv: float
) -> tuple[int, int, float]:
    """The cell that a ray enters when it leaves (row, column), and how far along the ray that is.

    (u, v): where the ray begins, in cells (column axis, row axis); (du, dv): its direction. The distance
    is in lengths of (du, dv). At a corner the column changes first. A ray without direction stays.
    """
    across = math.inf
    if du > 0.0:
        across = (column + 1 - u) / du
    elif du < 0.0:
        across = (column - u) / du
    up = math.inf
    if dv > 0.0:
        up = (row + 1 - v) / dv
    elif dv < 0.0:
        up = (row - v) / dv
    if across == math.inf and up == math.inf:
        return row, column, math.inf
    if across <= up:
        return row, column + (1 if du > 0.0 else -1), across
    return row + (1 if dv > 0.0 else -1), column, up


@kernel
def free_way(
    cells: np.ndarray,
    passable: int,
    u: float,
    v: float,
    to_u: float,
    to_v: float,
    margin: float = 0.0,
) -> float:
    """The share in [0, 1] of the way from (u, v) to (to_u, to_v) until a cell that is not `passable`.

    cells: (rows, columns). Coordinates in cells, column axis first; what lies outside is not passable.
    1.0: the way is free. At a corner both cells beside it must be passable; margin: how near a corner
    counts, in cells, for callers that must not be off by a rounding error.
    """
    rows, columns = cells.shape
    column, row = math.floor(u), math.floor(v)
    du, dv = to_u - u, to_v - v
    near = margin / math.hypot(du, dv) if margin > 0.0 else 0.0
    while True:
        last_row, last_column = row, column
        row, column, share = next_cell(row, column, u, v, du, dv)
        if share >= 1.0:
            return 1.0
        if not (0 <= row < rows and 0 <= column < columns) or cells[row, column] != passable:
            return max(0.0, share)
        if du == 0.0 or dv == 0.0:
            continue
        beside_row, _, up = next_cell(last_row, last_column, u, v, 0.0, dv)
        _, beside_column, across = next_cell(last_row, last_column, u, v, du, 0.0)
        if abs(up - across) > near or max(up, across) > 1.0:
            continue
        if not (0 <= beside_row < rows and 0 <= beside_column < columns):
            return max(0.0, share)
        if cells[beside_row, last_column] != passable or cells[last_row, beside_column] != passable:
            return max(0.0, share)
