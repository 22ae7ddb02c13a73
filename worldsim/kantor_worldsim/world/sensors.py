"""Sensing from a pose: targets, ranges, and the walls between two places."""

import math

import numpy as np

from kantor_protocol.base.counter_rng import Purpose, philox, to_unit
from kantor_protocol.base.grid import FREE, next_cell
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import Pose
from kantor_protocol.replication.occupancy_log import CODES, NO_RETURN, beam_rad, border_share
from kantor_protocol.scenario.schema import SensorOptions
from kantor_worldsim.world.maps import Ground


@kernel
def sense_targets(
    targets_m: np.ndarray, found: np.ndarray, range_m: float, out: np.ndarray, x: float, y: float
) -> int:
    """Mark the targets within range that were not found yet; returns their number, with their indices in `out`.

    targets_m: (T, 2) world frame; found: (T,) bool; out: (T,) int64 room.
    """
    count = 0
    for i in range(targets_m.shape[0]):
        if not found[i]:
            dx = targets_m[i, 0] - x
            dy = targets_m[i, 1] - y
            if dx * dx + dy * dy <= range_m * range_m:
                found[i] = True
                out[count] = i
                count += 1
    return count


@kernel
def sense_targets_in_sight(
    cells: np.ndarray,
    left_m: float,
    bottom_m: float,
    resolution_m: float,
    targets_m: np.ndarray,
    found: np.ndarray,
    range_m: float,
    out: np.ndarray,
    x: float,
    y: float,
) -> int:
    """As `sense_targets`, on a map: a target in a cell that is not free, or behind one, is not seen."""
    rows, columns = cells.shape
    u, v = (x - left_m) / resolution_m, (y - bottom_m) / resolution_m
    count = 0
    for i in range(targets_m.shape[0]):
        if found[i]:
            continue
        dx, dy = targets_m[i, 0] - x, targets_m[i, 1] - y
        if not dx * dx + dy * dy <= range_m * range_m:
            continue
        to_u = (targets_m[i, 0] - left_m) / resolution_m
        to_v = (targets_m[i, 1] - bottom_m) / resolution_m
        if not (0.0 <= to_u < columns and 0.0 <= to_v < rows):
            continue
        if cells[int(to_v), int(to_u)] == FREE and walls_between(cells, u, v, to_u, to_v) == 0:
            found[i] = True
            out[count] = i
            count += 1
    return count


@kernel
def walls_between(cells: np.ndarray, u: float, v: float, to_u: float, to_v: float) -> int:
    """Number of walls that a straight line crosses: runs of cells that are not free; all outside is one.

    cells: (rows, columns). Coordinates in cells, column axis first. The same from either end: the line
    is followed from the left, or from the end that is on the map. A line to nowhere (nan) crosses nothing.
    """
    rows, columns = cells.shape
    here = 0.0 <= u < columns and 0.0 <= v < rows
    there = 0.0 <= to_u < columns and 0.0 <= to_v < rows
    if not here and not there:
        return 1
    if not here or (there and (to_u < u or (to_u == u and to_v < v))):
        u, v, to_u, to_v = to_u, to_v, u, v
    column, row, walls, inside_wall = int(u), int(v), 0, False
    while 0 <= row < rows and 0 <= column < columns:
        wall = cells[row, column] != FREE
        walls += wall and not inside_wall
        inside_wall = wall
        row, column, share = next_cell(row, column, u, v, to_u - u, to_v - v)
        if share >= 1.0:
            return walls
    return walls + (not inside_wall)


@kernel
def way_to_wall(
    cells: np.ndarray, u: float, v: float, angle_rad: float, range_cells: float
) -> float:
    """Distance from (u, v), in cells, at which a beam enters a cell that is not free; inf beyond the range.

    cells: (rows, columns); cells outside are not free. 0 for a beam that begins there.
    """
    rows, columns = cells.shape
    if not (0.0 <= u < columns and 0.0 <= v < rows):
        return 0.0
    column, row, way = int(u), int(v), 0.0
    du, dv = math.cos(angle_rad), math.sin(angle_rad)
    right, above = (1 if du > 0.0 else -1), (1 if dv > 0.0 else -1)
    across, up = border_share(u, du, column), border_share(v, dv, row)
    while cells[row, column] == FREE:
        way = min(across, up)
        if not way <= range_cells:
            return math.inf
        if across <= up:
            column += right
            if not 0 <= column < columns:
                break
            across = border_share(u, du, column)
        else:
            row += above
            if not 0 <= row < rows:
                break
            up = border_share(v, dv, row)
    return max(0.0, way)


@kernel
def _noise(seed: int, robot: int, step: int, beam: int) -> float:
    """A draw from the standard normal distribution (Box & Muller)."""
    word_0, word_1 = philox(seed, Purpose.SCAN.value, robot, step, beam)
    radius = math.sqrt(-2.0 * math.log(1.0 - to_unit(word_0)))
    return radius * math.cos(2.0 * math.pi * to_unit(word_1))


@kernel
def _scan(
    cells: np.ndarray,
    u: float,
    v: float,
    heading_rad: float,
    field_of_view_rad: float,
    range_cells: float,
    noise_cells: float,
    seed: int,
    robot: int,
    step: int,
    codes: np.ndarray,
) -> None:
    """Fill codes, one for each beam."""
    beams = codes.shape[0]
    for beam in range(beams):
        angle_rad = beam_rad(heading_rad, field_of_view_rad, beams, beam)
        way = way_to_wall(cells, u, v, angle_rad, range_cells)
        if way == math.inf:
            codes[beam] = NO_RETURN
            continue
        if noise_cells > 0.0:
            way += noise_cells * _noise(seed, robot, step, beam)
            way = min(range_cells, max(0.0, way))
        codes[beam] = int(np.rint(way / range_cells * CODES))


class RangeFinder:
    """Scans the true map; the rules by which robots read a scan are in `occupancy_log.py`."""

    def __init__(self, sensor: SensorOptions, ground: Ground, seed: int) -> None:
        self._ground = ground
        self._sensor = (
            math.radians(sensor.field_of_view_deg),
            sensor.range_m / ground.frame.resolution_m,
            sensor.noise_m / ground.frame.resolution_m,
            seed,
        )
        self._codes = np.zeros(sensor.beams, dtype="<u2")

    def scan(self, robot: int, step: int, pose: Pose) -> bytes:
        """The scan of a robot, by its place in the roster, at its step: a little-endian uint16 a beam."""
        frame, cells = self._ground
        u, v = frame.uv(pose.x_m, pose.y_m)
        _scan(cells, u, v, pose.heading_rad, *self._sensor, robot, step, self._codes)
        return self._codes.tobytes()
