"""Pursuit of a target: when a robot that gets no nearer gives it up, and what it learns when a wall stops it."""

import math

from kantor_protocol.base.grid import NOWHERE, Frame, next_cell
from kantor_protocol.base.machine import Pose

_PROGRESS_CELLS = 0.25
"""A robot makes progress when its way gets shorter by as much."""
_TURN_RAD = 1e-6
"""A robot that turns by more at a wall will head elsewhere."""
_TOUCH_CELLS = 1 / 16
"""How near a robot is to the wall that has stopped it, at most."""


class Pursuit:
    """The effort that a robot has spent on its target since it last got nearer.

    A cell that it drives is an effort of one, whatever its speed and its period, and so is a step in which it
    drives against a wall, or knows no way. To stand still, to turn and to wait for another robot is none.
    """

    def __init__(self, patience: int) -> None:
        self._patience = patience
        self.begin()

    def begin(self) -> None:
        """Begin with another target."""
        self._effort = 0.0
        self._least_cells = math.inf
        """The shortest way that was left so far."""
        self._most_cells = 0.0
        """The longest that was left since then: a detour has to be driven before it leads nearer."""

    def drive(self, cells: float, turned_rad: float, *, bumped: bool) -> None:
        """Note a step: how far the robot got, by how much it turned, and whether a wall has stopped it."""
        held = bumped and abs(turned_rad) < _TURN_RAD
        self._effort += 1.0 if held else min(1.0, cells)

    def miss(self) -> None:
        """Note a step without a way to the target."""
        self._effort += 1.0

    def follow(self, left_cells: float) -> None:
        """Note the length of the way that is left."""
        if left_cells < self._least_cells - _PROGRESS_CELLS:
            self._effort, self._least_cells, self._most_cells = 0.0, left_cells, 0.0
        self._most_cells = max(self._most_cells, left_cells)

    @property
    def is_vain(self) -> bool:
        """Whether the robot should give the target up. Not before it has had it for as many steps as its patience."""
        return self._effort > self._patience + self._most_cells


def wall_met(frame: Frame, start: Pose, end: Pose, stop: Pose) -> int:
    """The cell of the wall that stopped a straight move, or NOWHERE: at a corner it may be one of several.

    start, end: of the move that was wanted. stop: where it ended, just before the wall.
    """
    du, dv = end.x_m - start.x_m, end.y_m - start.y_m
    way_m = math.hypot(du, dv)
    cell = frame.cell_of(stop.x_m, stop.y_m)
    if way_m == 0.0 or cell == NOWHERE:
        return NOWHERE
    du, dv = du / way_m, dv / way_m
    (u, v), (row, column) = frame.uv(stop.x_m, stop.y_m), divmod(cell, frame.columns)
    across = next_cell(row, column, u, v, du, 0.0)
    up = next_cell(row, column, u, v, 0.0, dv)
    row, column, near = min(across, up, key=lambda entered: entered[2])
    inside = 0 <= row < frame.rows and 0 <= column < frame.columns
    if near > _TOUCH_CELLS or max(across[2], up[2]) <= _TOUCH_CELLS or not inside:
        return NOWHERE
    return int(row * frame.columns + column)
