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
from typing import Any

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE, NOWHERE, OCCUPIED, Frame, next_cell
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
def _touch(cell: int, evidence: int, votes: np.ndarray, touched: np.ndarray, count: int) -> int:
    """Add the evidence of one beam to a cell; the number of cells in `touched`."""
    if votes[cell] == 0:
        touched[count] = cell
        count += 1
        votes[cell] = 1  # sums of HIT and PASS are multiples of 5: a touched cell is never at 0
    votes[cell] += evidence
    return count


@kernel
def _follow_beam(
    u: float,
    v: float,
    angle_rad: float,
    reach: float,
    tolerance: float,
    rows: int,
    columns: int,
    votes: np.ndarray,
    touched: np.ndarray,
    count: int,
) -> int:
    """Touch the cells of one beam. reach, tolerance: in cells; negative tolerance: nothing was met.

    A wall's face is a border of cells, and the beam ended at it, give or take the tolerance. If it enters just one
    cell there, this one is occupied; if it enters several, as at a corner, it is no evidence for any of them. Cells
    that it entered before are free.
    """
    column, row = int(u), int(v)
    du, dv = math.cos(angle_rad), math.sin(angle_rad)
    count = _touch(row * columns + column, PASS, votes, touched, count)  # the robot stands here
    wall, entered = NOWHERE, 0
    while True:
        row, column, share = next_cell(row, column, u, v, du, dv)
        if not share <= reach + max(0.0, tolerance):
            break
        entered += share >= reach - tolerance
        if not (0 <= row < rows and 0 <= column < columns):
            return count
        wall = row * columns + column
        if entered == 0:
            count = _touch(wall, PASS, votes, touched, count)
    return _touch(wall, HIT, votes, touched, count) if entered == 1 else count


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
    votes: np.ndarray,
    touched: np.ndarray,
    odds: np.ndarray,
    kinds: np.ndarray,
    changed: np.ndarray,
) -> int:
    """Add one scan; how many cells changed their kind, as entries in `changed`."""
    if not (0.0 <= u < columns and 0.0 <= v < rows):
        return 0
    count, beams = 0, codes.shape[0]
    for beam in range(beams):
        angle_rad = beam_rad(heading_rad, field_of_view_rad, beams, beam)
        reach, margin = range_cells, -1.0
        if codes[beam] <= CODES:
            reach, margin = codes[beam] / CODES * range_cells, tolerance
        count = _follow_beam(u, v, angle_rad, reach, margin, rows, columns, votes, touched, count)
    changes = 0
    for i in range(count):
        cell = touched[i]
        step = HIT if votes[cell] > 1 else PASS
        votes[cell] = 0
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
        self._frame = frame
        self._beams = sensor.beams
        self._ranges = ranges
        range_cells = sensor.range_m / frame.resolution_m
        noise_cells = min(3.0 * sensor.noise_m / frame.resolution_m, _NOISE_CELLS_MAX)
        self._sensor = (
            math.radians(sensor.field_of_view_deg),
            range_cells,
            range_cells / CODES + noise_cells,
            frame.rows,
            frame.columns,
        )
        self._scans = 0
        self._votes = np.zeros(cells, dtype=np.int32)
        self._touched = np.zeros(cells, dtype=np.int64)
        self._changed = np.zeros(cells, dtype=np.int64)

    def observe(self, scan: bytes, pose: Pose, *, moved: bool) -> npt.NDArray[np.int64]:
        """Add a scan made at a pose: (k,) entries for the log, rising. A scan of the wrong size is dropped.

        moved: since the scan before; ranges from a place that it has measured at already are not shared again.
        """
        if len(scan) != 2 * self._beams:
            return np.zeros(0, dtype=np.int64)
        codes = np.frombuffer(scan, dtype="<u2")
        count = _integrate(
            codes,
            *self._frame.uv(pose.x_m, pose.y_m),
            pose.heading_rad,
            *self._sensor,
            self._votes,
            self._touched,
            self.odds,
            self.kinds,
            self._changed,
        )
        self._scans += 1
        changes = np.sort(self._changed[:count])
        if self._ranges and moved:
            changes = np.concatenate((changes, self._ranges_in(codes)))
        return changes

    def _ranges_in(self, codes: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """(k,) entries of the measured ranges of a few beams, other ones in each scan."""
        stride = max(1, self._beams // _SHARED_BEAMS)
        some = codes[self._scans % stride :: stride].astype(np.int64)
        bins = np.minimum(some * RANGE_BINS // CODES, RANGE_BINS - 1)
        return np.sort(bins) + 3 * self._frame.cells
