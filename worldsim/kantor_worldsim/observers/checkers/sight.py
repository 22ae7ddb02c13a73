"""Walls between two places, and what the radio's options make of them, for the checkers.

The radio has its own way to count walls (`walls_between`); this one shares no code with it.
"""

import math

import numpy as np

from kantor_protocol.base.grid import FREE, Frame
from kantor_protocol.base.kernels import kernel
from kantor_protocol.scenario.schema import RadioOptions

Place = tuple[float, float]
"""World frame, metres."""


@kernel
def count_walls(cells: np.ndarray, u: float, v: float, to_u: float, to_v: float) -> int:
    """Count the walls that a straight line crosses: runs of cells that are not free.

    cells: (rows, columns). Coordinates in cells, column axis first. Everything outside the map is one wall.
    The line is followed from its left end, or from its lower one if it is upright, or from the end that is
    on the map; it meets the lines of the grid in turn, and of two that it meets in one point the upright one
    first.
    """
    rows, columns = cells.shape
    inside = 0.0 <= u < columns and 0.0 <= v < rows
    ends_inside = 0.0 <= to_u < columns and 0.0 <= to_v < rows
    if not (inside or ends_inside):
        return 1
    if not inside or (ends_inside and (u > to_u or (u == to_u and v > to_v))):
        u, to_u, v, to_v = to_u, u, to_v, v
    right, up = (1 if to_u > u else -1), (1 if to_v > v else -1)
    first_column, first_row = math.floor(u), math.floor(v)
    upright, level = 0, 0  # lines of the grid that were crossed
    walls, before = 0, True
    while True:
        column, row = first_column + right * upright, first_row + up * level
        outside = not (0 <= column < columns and 0 <= row < rows)
        free = not outside and cells[row, column] == FREE
        walls += before and not free
        before = free
        if outside:
            return walls
        next_u = column + (1 if right > 0 else 0)
        next_v = row + (1 if up > 0 else 0)
        share_u = (next_u - u) / (to_u - u) if to_u != u else math.inf
        share_v = (next_v - v) / (to_v - v) if to_v != v else math.inf
        if not min(share_u, share_v) < 1.0:
            return walls
        if share_u <= share_v:
            upright += 1
        else:
            level += 1


class Sight:
    """The walls of a map as they stand between participants."""

    def __init__(
        self, radio: RadioOptions, frame: Frame | None = None, cells: np.ndarray | None = None
    ) -> None:
        """cells: (rows, columns), the true map; without one there are no walls."""
        self._blocks, self._loss_m = radio.line_of_sight, radio.wall_loss_m
        self._frame, self._cells = frame, cells
        self.counts = cells is not None and (self._blocks or self._loss_m > 0.0)
        """Whether walls matter at all."""

    def walls(self, here_m: Place, there_m: Place) -> int:
        """Count the walls between two places; 0 where they do not matter."""
        if not self.counts or self._frame is None or self._cells is None:
            return 0
        ends = (*self._frame.uv(*here_m), *self._frame.uv(*there_m))
        return int(count_walls(self._cells, *ends))

    def reaches(self, here_m: Place, there_m: Place, range_m: float, walls: int) -> bool:
        """Whether a radio with so much range is heard through so many walls."""
        if self._blocks and walls:
            return False
        range_m -= walls * self._loss_m
        dx_m, dy_m = there_m[0] - here_m[0], there_m[1] - here_m[1]
        return range_m >= 0.0 and dx_m * dx_m + dy_m * dy_m <= range_m * range_m
