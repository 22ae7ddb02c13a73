"""Occupancy evidence from range scans (Burgard et al., eq. 1-3, in log odds), and the log by which it is replicated.

A scan gives every cell that a beam passes or ends in one piece of evidence: for or against an obstacle, whichever
its beams say in sum. Sums are clamped, so that no cell is ever certain. A robot shares the sign of its sum: an entry
in its log whenever a cell becomes free or occupied to it. The log is append-only and its robot alone writes it, so
that it is replicated as every other log (`replica.py`). Logs are merged, maps never are.

Entries of a log, for a map of n cells
    2 cell          the cell is free        2 cell + 1     the cell is occupied
    2 n + cell      a dead frontier: the robot stood at it and saw nothing new
    3 n + bin       one measured range, of RANGE_BINS bins from 0 to the sensor's range
With m = 3 n + RANGE_BINS:
    m + cell        a frontier given up: the robot could not get there
    m + n + cell    a frontier tried again that any robot has given up
    m + 2 n + cell  a bump: the robot was stopped by a wall in the cell, whatever scans say of it
Beams that met nothing count in the last bin. A few beams of each scan are enough to learn by.
"""

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE, OCCUPIED, Frame
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import Pose
from kantor_protocol.scenario.schema import SensorOptions

RANGE_BINS = 32
NO_RETURN = 65535
"""In a scan: the beam met nothing within range."""
CODES = 65534
"""A range is encoded in so many parts of the sensor's range."""

HIT, PASS, CERTAIN = 85, -40, 294
"""Evidence in 1/100 of log odds: +0.85, -0.40, and at most ln 19 in size (P within [0.05, 0.95])."""

_SHARED_BEAMS = 4
"""Beams of one scan whose ranges become entries."""
_NOISE_CELLS_MAX = 0.5
"""An obstacle is looked for this far around where a noisy beam ended, at most: further, and there are always
several cells to choose from."""
_CELLS_KEPT = 1 << 18
"""Cells of scans whose evidence is kept, for whoever reads the same scan in this process."""


def entries(frame: Frame) -> int:
    """The number of different entries; every entry of a log is below it."""
    return 6 * frame.cells + RANGE_BINS


def dead_frontier(frame: Frame, cell: int) -> int:
    """The entry that declares a frontier dead."""
    return 2 * frame.cells + cell


def given_up_frontier(frame: Frame, cell: int) -> int:
    """The entry that gives a frontier up."""
    return 3 * frame.cells + RANGE_BINS + cell


def retried_frontier(frame: Frame, cell: int) -> int:
    """The entry by which a frontier that was given up is tried again."""
    return 4 * frame.cells + RANGE_BINS + cell


def bump(frame: Frame, cell: int) -> int:
    """The entry that tells of a wall into which the robot has driven."""
    return 5 * frame.cells + RANGE_BINS + cell


@kernel
def beam_rad(heading_rad: float, field_of_view_rad: float, beams: int, beam: int) -> float:
    """The direction of a beam in the world: evenly over the field of view, centred on the heading."""
    return heading_rad + field_of_view_rad * ((beam + 0.5) / beams - 0.5)


@kernel
def border_share(at: float, direction: float, cell: int) -> float:
    """How far along a ray it leaves a row or a column of cells, as `next_cell` tells it; inf if it never does.

    at, direction: of the ray on this axis. cell: the row or column.
    """
    if direction > 0.0:
        return (cell + 1 - at) / direction
    if direction < 0.0:
        return (cell - at) / direction
    return math.inf


@kernel
def _touch(sums: np.ndarray, row: int, column: int, evidence: int) -> None:
    """Add the evidence of a beam to a cell. A sum is doubled, so that the lowest bit says that there is one."""
    sums[row, column] = (sums[row, column] + 2 * evidence) | 1


@kernel
def _follow_beam(
    u: float,
    v: float,
    angle_rad: float,
    reach: float,
    tolerance: float,
    rows: int,
    columns: int,
    sums: np.ndarray,
    bottom: int,
    left: int,
) -> None:
    """Touch the cells of one beam, but the first. reach, tolerance: in cells; negative tolerance: nothing was met.

    sums: of a window of the map, from a row and a column on, that has all cells within reach.

    A wall's face is a border of cells, and the beam ended at it, give or take the tolerance. If it enters just one
    cell there, this one is occupied; if it enters several, as at a corner, it is no evidence for any of them. Cells
    that it entered before are free.
    """
    column, row = int(u), int(v)
    du, dv = math.cos(angle_rad), math.sin(angle_rad)
    right, above = (1 if du > 0.0 else -1), (1 if dv > 0.0 else -1)
    across, up = border_share(u, du, column), border_share(v, dv, row)
    limit, entered = reach + max(0.0, tolerance), 0
    while True:
        share = min(across, up)
        if not share <= limit:
            break
        if across <= up:
            column += right
            if not 0 <= column < columns:
                return
            across = border_share(u, du, column)
        else:
            row += above
            if not 0 <= row < rows:
                return
            up = border_share(v, dv, row)
        entered += share >= reach - tolerance
        if entered == 0:
            _touch(sums, row - bottom, column - left, PASS)
    if entered == 1:
        _touch(sums, row - bottom, column - left, HIT)


@kernel
def _read_scan(
    codes: np.ndarray,
    u: float,
    v: float,
    heading_rad: float,
    field_of_view_rad: float,
    range_cells: float,
    tolerance: float,
    rows: int,
    columns: int,
    sums: np.ndarray,
    evidence: np.ndarray,
) -> int:
    """Write what a scan is evidence of into `evidence`, as `ScanReader.read` does; how many cells these are.

    sums: (high, wide) zeros, and so afterwards: of a window of the map around the robot.
    """
    if not (0.0 <= u < columns and 0.0 <= v < rows):
        return 0
    high, wide = sums.shape
    bottom = max(0, min(int(v) - high // 2, rows - high))
    left = max(0, min(int(u) - wide // 2, columns - wide))
    beams = codes.shape[0]
    _touch(sums, int(v) - bottom, int(u) - left, PASS * beams)  # the robot stands here
    for beam in range(beams):
        angle_rad = beam_rad(heading_rad, field_of_view_rad, beams, beam)
        reach, margin = range_cells, -1.0
        if codes[beam] <= CODES:
            reach, margin = codes[beam] / CODES * range_cells, tolerance
        _follow_beam(u, v, angle_rad, reach, margin, rows, columns, sums, bottom, left)
    count = 0
    for row in range(high):
        for column in range(wide):
            sum_ = sums[row, column]
            if sum_ != 0:
                sums[row, column] = 0
                cell = (bottom + row) * columns + left + column
                evidence[count] = 2 * cell + (1 if sum_ > 1 else 0)
                count += 1
    return count


@kernel
def _add(
    evidence: np.ndarray,
    codes: np.ndarray,
    first: int,
    stride: int,
    odds: np.ndarray,
    kinds: np.ndarray,
    out: np.ndarray,
) -> int:
    """Add the evidence of a scan, and write entries into `out`: cells that changed, then ranges. How many these are.

    The ranges of every stride-th beam are shared, beginning with the first.
    """
    count = 0
    for i in range(evidence.shape[0]):
        cell = evidence[i] >> 1
        before = odds[cell]
        after = min(CERTAIN, max(-CERTAIN, before + (HIT if evidence[i] & 1 else PASS)))
        if after == before:
            continue
        odds[cell] = after
        kind = kinds[cell]
        if after != 0:
            kind = OCCUPIED if after > 0 else FREE
        if kind != kinds[cell]:
            kinds[cell] = kind
            out[count] = 2 * cell + (1 if kind == OCCUPIED else 0)
            count += 1
    ranges = count
    for beam in range(first, codes.shape[0], stride):
        bin_ = min(np.int64(codes[beam]) * RANGE_BINS // CODES, RANGE_BINS - 1)
        entry, at = 3 * kinds.shape[0] + bin_, count
        while at > ranges and out[at - 1] > entry:
            out[at] = out[at - 1]
            at -= 1
        out[at] = entry
        count += 1
    return count


class ScanReader:
    """Reads the scans of one kind of sensor on one map: of which cells they are evidence."""

    def __init__(self, frame: Frame, sensor: SensorOptions) -> None:
        self._frame = frame
        range_cells = sensor.range_m / frame.resolution_m
        noise_cells = min(3.0 * sensor.noise_m / frame.resolution_m, _NOISE_CELLS_MAX)
        tolerance = range_cells / CODES + noise_cells
        self._sensor = (
            math.radians(sensor.field_of_view_deg),
            range_cells,
            tolerance,
            frame.rows,
            frame.columns,
        )
        side = 2 * math.ceil(min(range_cells + tolerance, frame.rows + frame.columns)) + 5
        self._sums = np.zeros((min(side, frame.rows), min(side, frame.columns)), dtype=np.int32)
        """(high, wide) scratch: all cells that a scan can tell of."""
        self._found = np.empty(self._sums.size, dtype=np.int32)
        self.read = lru_cache(_CELLS_KEPT // self._sums.size)(self._read)
        """As `_read`. Whoever follows the record of a robot in its process reads the same scan again."""

    @property
    def cells_max(self) -> int:
        """The most cells that a scan is evidence of."""
        return self._sums.size

    def _read(self, scan: bytes, pose: Pose) -> npt.NDArray[np.int32]:
        """(k,) 2 cell + 1 for evidence that a cell is occupied, 2 cell that it is free, rising. Do not change it."""
        count = _read_scan(
            np.frombuffer(scan, dtype="<u2"),
            *self._frame.uv(pose.x_m, pose.y_m),
            pose.heading_rad,
            *self._sensor,
            self._sums,
            self._found,
        )
        return self._found[:count].copy()


@lru_cache(maxsize=1)
def scan_reader(frame: Frame, sensor: SensorOptions) -> ScanReader:
    """The reader of a mission, which all its robots in one process share."""
    return ScanReader(frame, sensor)


class OccupancyLog:
    """The evidence layer of one robot, from its own scans, and the log entries that share it."""

    def __init__(self, frame: Frame, sensor: SensorOptions, *, ranges: bool) -> None:
        """A layer without evidence.

        ranges: measured ranges are entries as well, for planners that learn from them.
        """
        cells = frame.cells
        self.odds = np.zeros(cells, dtype=np.int16)
        """(cells,) evidence in 1/100 of log odds."""
        self.kinds = np.zeros(cells, dtype=np.uint8)
        """(cells,) UNKNOWN, FREE or OCCUPIED."""
        self._beams = sensor.beams
        self._ranges = ranges
        self._stride = max(1, self._beams // _SHARED_BEAMS)
        self._scans = 0
        self._reader = scan_reader(frame, sensor)
        self._entries = np.empty(self._reader.cells_max + self._beams, dtype=np.int64)

    def observe(self, scan: bytes, pose: Pose, *, moved: bool) -> npt.NDArray[np.int64]:
        """Add a scan made at a pose: (k,) entries for the log, rising. A scan of the wrong size is dropped.

        moved: since the scan before; ranges from a place that it has measured at already are not shared again.
        """
        if len(scan) != 2 * self._beams:
            return np.zeros(0, dtype=np.int64)
        self._scans += 1
        shares = self._ranges and moved
        count = _add(
            self._reader.read(scan, pose),
            np.frombuffer(scan, dtype="<u2"),
            self._scans % self._stride if shares else self._beams,
            self._stride,
            self.odds,
            self.kinds,
            self._entries,
        )
        return self._entries[:count].copy()
