"""What range scans say about the cells of a map (Burgard et al., eq. 1-3, in log odds), and how it travels.

A scan gives every cell that a beam passes or ends in one piece of evidence: against or for a wall. Sums
are clamped, so that no cell is ever certain. What a robot tells others is the sign of its sum: an entry
in its log whenever a cell becomes free or occupied to it. The log is append-only and its robot alone
writes it, so that it is replicated as every other log (`replica.py`), and nobody merges merged maps.

Entries of a log, for a map of n cells
    2 cell          the cell is free        2 cell + 1     the cell is occupied
    2 n + cell      the robot stood at this frontier and saw nothing new: it is none
    3 n + bin       one measured range, of RANGE_BINS bins from 0 to the sensor's range
Beams that found nothing count in the last bin. A few beams of each scan are enough to learn by.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from kantor_protocol.grid import FREE, NOWHERE, OCCUPIED, Frame, next_cell
from kantor_protocol.kernels import kernel
from kantor_protocol.machine import Pose
from kantor_protocol.scenario import Sensor

RANGE_BINS = 32
NO_RETURN = 65535
"""In a scan: the beam met nothing within range."""
CODES = 65534
"""A range is told in so many parts of the sensor's range."""

HIT, PASS, CERTAIN = 85, -40, 294
"""Evidence in 1/100 of log odds: +0.85, -0.40, and at most ln 19 in size (P within [0.05, 0.95])."""

_LEARNT_BEAMS = 8
_PASSED, _HIT = 0, 1


def entries(frame: Frame) -> int:
    """Every entry of a log is below this."""
    return 3 * frame.cells + RANGE_BINS


def void(frame: Frame, cell: int) -> int:
    """The entry that says a frontier is none."""
    return 2 * frame.cells + cell


@kernel
def beam_rad(heading_rad: float, field_of_view_rad: float, beams: int, beam: int) -> float:
    """The direction of a beam in the world: evenly over the field of view, centred on the heading."""
    return heading_rad + field_of_view_rad * ((beam + 0.5) / beams - 0.5)


@kernel
def _touch(
    cell: int, kind: int, scan: int, mark: np.ndarray, touched: np.ndarray, count: int
) -> int:
    """Note that a beam passed or hit a cell; a hit outweighs any number of passes of the same scan."""
    if mark[cell] < 2 * scan:
        touched[count] = cell
        count += 1
    mark[cell] = max(mark[cell], 2 * scan + kind)
    return count


@kernel
def _nearest_border(u: float, v: float, du: float, dv: float, reach: float) -> float:
    """How far along a beam it leaves a cell, as near as possible to where it ended. All in cells."""
    column, row, before = int(u), int(v), -math.inf
    while True:
        row, column, share = next_cell(row, column, u, v, du, dv)
        if not share < reach:
            return before if reach - before <= share - reach else share
        before = share


@kernel
def _follow_beam(
    u: float,
    v: float,
    angle_rad: float,
    reach: float,
    returned: bool,
    tolerance: float,
    rows: int,
    columns: int,
    scan: int,
    mark: np.ndarray,
    touched: np.ndarray,
    count: int,
) -> int:
    """Touch the cells of one beam. reach, tolerance: in cells; an infinite tolerance stands for noise.

    A wall's face is a border of cells, and the beam ended at it, give or take the tolerance. If it enters
    just one cell there, this is the wall; if it enters several, as at a corner, it says nothing of
    them. What it entered before is free. With noise the face is the border nearest to where it ended.
    """
    du, dv = math.cos(angle_rad), math.sin(angle_rad)
    if not (0.0 <= u < columns and 0.0 <= v < rows):
        return count
    if not returned:
        tolerance = 0.0
    elif tolerance == math.inf:
        reach, tolerance = _nearest_border(u, v, du, dv, reach), 0.0
    column, row = int(u), int(v)
    count = _touch(row * columns + column, _PASSED, scan, mark, touched, count)  # it stands here
    wall, entered = NOWHERE, 0
    while True:
        row, column, share = next_cell(row, column, u, v, du, dv)
        inside = 0 <= row < rows and 0 <= column < columns
        if not (inside and share <= reach + tolerance):
            break
        cell = row * columns + column
        if share < reach - tolerance or not returned:
            count = _touch(cell, _PASSED, scan, mark, touched, count)
        else:
            wall, entered = cell, entered + 1
    if entered == 1 and not share <= reach + tolerance:
        count = _touch(wall, _HIT, scan, mark, touched, count)
    return count


@kernel
def _integrate(
    codes: np.ndarray,
    u: float,
    v: float,
    heading_rad: float,
    field_of_view_rad: float,
    range_cells: float,
    tolerance: float,
    rows: int,
    columns: int,
    scan: int,
    mark: np.ndarray,
    touched: np.ndarray,
    odds: np.ndarray,
    kinds: np.ndarray,
    changed: np.ndarray,
) -> int:
    """Add one scan; how many cells changed their kind, as entries in `changed`."""
    count = 0
    for beam in range(codes.shape[0]):
        angle_rad = beam_rad(heading_rad, field_of_view_rad, codes.shape[0], beam)
        returned = codes[beam] <= CODES
        reach = codes[beam] / CODES * range_cells if returned else range_cells
        count = _follow_beam(
            u, v, angle_rad, reach, returned, tolerance, rows, columns, scan, mark, touched, count
        )
    changes = 0
    for i in range(count):
        cell = touched[i]
        step = HIT if mark[cell] == 2 * scan + _HIT else PASS
        odds[cell] = min(CERTAIN, max(-CERTAIN, odds[cell] + step))
        kind = kinds[cell]
        if odds[cell] > 0:
            kind = OCCUPIED
        elif odds[cell] < 0:
            kind = FREE
        if kind != kinds[cell]:
            kinds[cell] = kind
            changed[changes] = 2 * cell + (1 if kind == OCCUPIED else 0)
            changes += 1
    return changes


class Evidence:
    """What one robot has seen itself: a layer of the map, and the entries that tell of it."""

    def __init__(self, frame: Frame, sensor: Sensor, *, ranges: bool) -> None:
        """ranges: measured ranges are entries as well, for planners that learn from them."""
        cells = frame.cells
        self.odds = np.zeros(cells, dtype=np.int16)
        """(cells,) in 1/100."""
        self.kinds = np.zeros(cells, dtype=np.uint8)
        """(cells,) UNKNOWN, FREE or OCCUPIED."""
        self._frame = frame
        self._beams = sensor.beams
        self._ranges = ranges
        range_cells = sensor.range_m / frame.resolution_m
        exact = sensor.noise_m == 0.0
        self._sensor = (
            math.radians(sensor.field_of_view_deg),
            range_cells,
            range_cells / CODES if exact else math.inf,
            frame.rows,
            frame.columns,
        )
        self._scans = 0
        self._mark = np.full(cells, -1, dtype=np.int64)
        self._touched = np.zeros(cells, dtype=np.int64)
        self._changed = np.zeros(cells, dtype=np.int64)

    def take(self, scan: bytes, pose: Pose, *, moved: bool) -> npt.NDArray[np.int64]:
        """Add a scan made at a pose: (k,) entries for the log, rising. A scan of the wrong size is void.

        moved: since the scan before; from a place that it knows a robot learns nothing of ranges.
        """
        if len(scan) != 2 * self._beams:
            return np.zeros(0, dtype=np.int64)
        codes = np.frombuffer(scan, dtype="<u2")
        x_m, y_m = self._frame.origin_m
        u, v = (
            (pose.x_m - x_m) / self._frame.resolution_m,
            (pose.y_m - y_m) / self._frame.resolution_m,
        )
        count = _integrate(
            codes,
            u,
            v,
            pose.heading_rad,
            *self._sensor,
            self._scans,
            self._mark,
            self._touched,
            self.odds,
            self.kinds,
            self._changed,
        )
        self._scans += 1
        news = np.sort(self._changed[:count])
        if self._ranges and moved:
            news = np.concatenate((news, self._learnt(codes)))
        return news

    def _learnt(self, codes: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        stride = max(1, self._beams // _LEARNT_BEAMS)
        some = codes[self._scans % stride :: stride].astype(np.int64)
        bins = np.minimum(some * RANGE_BINS // CODES, RANGE_BINS - 1)
        return np.sort(bins) + 3 * self._frame.cells
