"""Navigation: from a target cell to the next place to head for, round the known walls."""

import math

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.cost_map import CostMap
from kantor_protocol.base.grid import FREE, NOWHERE, free_way
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import Pose

_MARGIN_CELLS = 1e-3
"""Distance that a way keeps from corners, so that rounding does not lead it into a wall."""
_LOOKAHEAD_CELLS = 64
"""Length of the way, in cells, over which a robot looks for a shortcut."""


@kernel
def _farthest_in_sight(
    cells: np.ndarray, way: np.ndarray, first: int, u: float, v: float, margin: float
) -> int:
    """The last place along the way to which a straight line is free, or -1; cells: (rows, columns)."""
    columns = cells.shape[1]
    last = -1
    for i in range(first, min(way.shape[0], first + _LOOKAHEAD_CELLS)):
        row, column = way[i] // columns, way[i] % columns
        if free_way(cells, FREE, u, v, column + 0.5, row + 0.5, margin) < 1.0:
            break
        last = i
    return last


@kernel
def _measure_rest(way: np.ndarray, columns: int, beyond: np.ndarray) -> None:
    """Write the length of the way from each of its cells to the last into beyond (way,), in cells."""
    rest = 0.0
    for i in range(way.shape[0] - 1, -1, -1):
        if i + 1 < way.shape[0]:
            slanted = way[i] // columns != way[i + 1] // columns and (
                way[i] % columns != way[i + 1] % columns
            )
            rest += math.sqrt(2.0) if slanted else 1.0
        beyond[i] = rest


class Navigator:
    """Keeps the way to the target, and takes a shortcut where a straight line is free."""

    def __init__(self, cost_map: CostMap) -> None:
        self._cost_map = cost_map
        self._frame = cost_map.frame
        self._target = NOWHERE
        self._way: npt.NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        """The cells of the way to `_target`."""
        self._beyond: npt.NDArray[np.float64] = np.zeros(0)
        """For each cell of `_way` the length of the way from there to its end, in cells."""
        self._passed = 0
        """The place in `_way` that the robot headed for last."""
        self.left_cells = math.inf
        """Length of the way that is left; never rises while the robot keeps to a way."""

    def head(self, pose: Pose, target: int) -> tuple[float, float] | None:
        """The next place to head for, world frame; None if no way is known."""
        cell = self._frame.cell_of(pose.x_m, pose.y_m)
        if cell == NOWHERE:
            return None
        ahead = self._look_ahead(pose) if target == self._target else -1
        if ahead < 0:
            self._target, self._passed = target, 0
            self._way = self._cost_map.way(cell, target)
            self._beyond = np.empty(self._way.shape[0])
            _measure_rest(self._way, self._frame.columns, self._beyond)
            ahead = self._look_ahead(pose)
        if ahead < 0:  # the robot stands beside a corner
            ahead = self._look_ahead(pose, 0.0)
        if ahead < 0:
            self._target = NOWHERE
            return None
        self._passed = ahead
        place_m = self._frame.centre_of(int(self._way[ahead]))
        away_m = math.dist(place_m, (pose.x_m, pose.y_m))
        self.left_cells = away_m / self._frame.resolution_m + float(self._beyond[ahead])
        return place_m

    def _look_ahead(self, pose: Pose, margin_cells: float = _MARGIN_CELLS) -> int:
        frame = self._frame
        return int(
            _farthest_in_sight(
                self._cost_map.fused_map.cells.reshape(frame.rows, frame.columns),
                self._way,
                self._passed,
                *frame.uv(pose.x_m, pose.y_m),
                margin_cells,
            )
        )
