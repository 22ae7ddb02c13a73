"""The map that a participant has: the evidence layers of all robots, fused (Burgard et al., eq. 1-3).

Every origin (an incarnation of a robot) has a layer of its own, folded from its log alone
(`occupancy_log.py`). The fused log odds of a cell are the sum over the layers, each counted as certain as
evidence gets, and the sum is clamped once more. A cell is explored once any layer knows it, whatever its
probability. Where a robot has bumped there is a wall, whatever the layers say.

A frontier that robots have given up as often as they have tried it again, or less, is a frontier. So a robot
that has nothing else to do may try each once more, and those that do so at the same time do no harm.
"""

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.base.kernels import kernel
from kantor_protocol.replication.occupancy_log import CERTAIN, RANGE_BINS
from kantor_protocol.replication.replica import Replica

_P_OCC = 1.0 / (1.0 + np.exp(-np.array([-1.0, 0.0, 1.0]) * CERTAIN / 100.0))
"""Probability of occupancy where more layers say free, as many say either, or more say occupied."""

LIVE, GIVEN_UP = 0, 1
"""Frontiers that robots head for, and those that they have given up."""


@kernel
def _fold(
    log: np.ndarray,
    first: int,
    length: int,
    layer: np.ndarray,
    votes: np.ndarray,
    cells: np.ndarray,
    dead_frontiers: np.ndarray,
    given_up: np.ndarray,
    bumps: np.ndarray,
    ranges: np.ndarray,
) -> bool:
    """Apply the entries log[first:length] of one origin; whether any is about a cell. cells: (n,) fused."""
    count = cells.shape[0]
    beyond = 3 * count + ranges.shape[0]
    changed = False
    for i in range(first, length):
        entry = log[i, 0]
        if 3 * count <= entry < beyond:
            ranges[entry - 3 * count] += 1
            continue
        changed = True
        if entry >= beyond + 2 * count:
            cell = entry - beyond - 2 * count
            bumps[cell] = True
            cells[cell] = OCCUPIED
        elif entry >= beyond + count:
            given_up[entry - beyond - count] -= 1
        elif entry >= beyond:
            given_up[entry - beyond] += 1
        elif entry >= 2 * count:
            dead_frontiers[entry - 2 * count] = True
        elif entry >= 0:
            cell, kind = entry // 2, OCCUPIED if entry & 1 else FREE
            votes[cell] += (1 if kind == OCCUPIED else -1) - (
                0 if layer[cell] == UNKNOWN else 1 if layer[cell] == OCCUPIED else -1
            )
            layer[cell] = kind
            free = votes[cell] < 0 and not bumps[cell]
            cells[cell] = FREE if free else OCCUPIED  # in doubt there is a wall
    return changed


@kernel
def _find_frontiers(
    cells: np.ndarray,
    dead_frontiers: np.ndarray,
    given_up: np.ndarray,
    columns: int,
    wanted: int,
    out: np.ndarray,
) -> int:
    """Write frontiers into out (cells,), rising; returns how many there are.

    wanted: GIVEN_UP for those that are given up, LIVE for the others.
    """
    count = 0
    total = cells.shape[0]
    for cell in range(total):
        if cells[cell] != FREE or dead_frontiers[cell] or (given_up[cell] > 0) != wanted:
            continue
        column = cell % columns
        if (
            (column > 0 and cells[cell - 1] == UNKNOWN)
            or (column + 1 < columns and cells[cell + 1] == UNKNOWN)
            or (cell >= columns and cells[cell - columns] == UNKNOWN)
            or (cell + columns < total and cells[cell + columns] == UNKNOWN)
        ):
            out[count] = cell
            count += 1
    return count


class FusedMap:
    """The fused map of one participant.

    The attributes say which others they agree with; that holds after `fold`, and `validate` asserts it.
    """

    def __init__(self, frame: Frame, origins: int) -> None:
        """origins: incarnations that may have a layer; `fold` adds layers when there are more."""
        self.frame = frame
        self.cells = np.zeros(frame.cells, dtype=np.uint8)
        """(cells,) OCCUPIED where a robot has bumped; elsewhere UNKNOWN where no layer knows the cell, FREE
        where more layers say free than occupied, OCCUPIED otherwise."""
        self.ranges = np.zeros(RANGE_BINS, dtype=np.int64)
        """(bins,) measured ranges from 0 to the sensor's range, as the folded entries of all logs count them."""
        self.dead_frontiers = np.zeros(frame.cells, dtype=np.bool_)
        """(cells,) cells that a folded entry of any log calls a dead frontier."""
        self._given_up = np.zeros(frame.cells, dtype=np.int32)
        """(cells,) how often folded entries give a frontier up, less how often they try it again."""
        self.bumps = np.zeros(frame.cells, dtype=np.bool_)
        """(cells,) cells in which a folded entry tells of a wall that a robot has met."""
        self.revision = 0
        """Rises with every fold that reads an entry about a cell."""
        self._layers = np.zeros((origins, frame.cells), dtype=np.uint8)
        """(origins, cells) what the last folded entry of each log says of each cell, or UNKNOWN."""
        self._votes = np.zeros(frame.cells, dtype=np.int16)
        """(cells,) layers that say occupied, less those that say free."""
        self._folded = np.zeros(origins, dtype=np.int64)
        """(origins,) entries of each log that have been folded: at most as many as the log has."""
        self._found = np.zeros(frame.cells, dtype=np.int64)
        """(cells,) output of `_find_frontiers`."""
        self._frontiers = self._found[:0]
        """The frontiers, by the arrays above, while `_frontiers_of` is `revision`, else out of date."""
        self._frontiers_of = -1

    def validate(self, replica: Replica) -> None:
        """Assert what the attributes say of one another and of the logs. replica: the one that was folded."""
        shape, cells = (self.frame.rows, self.frame.columns), self.frame.cells
        dead_frontiers, ranges = np.zeros_like(self.dead_frontiers), np.zeros_like(self.ranges)
        beyond = 3 * cells + RANGE_BINS
        tallies = np.zeros((3, cells), dtype=np.int64)
        for origin, length in enumerate(self._folded.tolist()):
            assert length <= replica.store.length[origin]
            entries = replica.store.logs[origin, :length, 0].astype(np.int64)
            kinds = entries[(entries >= 0) & (entries < 2 * cells)]
            layer = np.full(cells, UNKNOWN)
            layer[kinds // 2] = np.where(kinds & 1, OCCUPIED, FREE)  # of one cell, the last counts
            assert np.array_equal(self._layers[origin], layer)
            dead_frontiers[entries[(entries >= 2 * cells) & (entries < 3 * cells)] - 2 * cells] = (
                True
            )
            bins = entries[(entries >= 3 * cells) & (entries < beyond)] - 3 * cells
            ranges += np.bincount(bins, minlength=RANGE_BINS)
            others = entries[entries >= beyond] - beyond
            tallies += np.bincount(others, minlength=3 * cells).reshape(3, cells)
        given_up, tried_again, bumps = tallies
        assert np.array_equal(self._given_up, given_up - tried_again)
        assert np.array_equal(self.bumps, bumps > 0)
        assert np.array_equal(self.dead_frontiers, dead_frontiers)
        assert np.array_equal(self.ranges, ranges)
        votes = (self._layers == OCCUPIED).sum(axis=0) - (self._layers == FREE).sum(axis=0)
        assert np.array_equal(self._votes, votes)
        fused = np.where(votes < 0, FREE, OCCUPIED)
        fused[(self._layers == UNKNOWN).all(axis=0)] = UNKNOWN
        fused[self.bumps] = OCCUPIED
        assert np.array_equal(self.cells, fused)
        if self._frontiers_of == self.revision:
            unknown = np.pad((fused == UNKNOWN).reshape(shape), 1)
            beside = unknown[1:-1, :-2] | unknown[1:-1, 2:] | unknown[:-2, 1:-1] | unknown[2:, 1:-1]
            given_up_now = dead_frontiers | (self._given_up > 0)
            found = np.flatnonzero((fused == FREE) & beside.ravel() & ~given_up_now)
            assert np.array_equal(self._frontiers, found)

    def fold(self, replica: Replica) -> bool:
        """Take in the entries that the logs have gained; whether a cell may have changed."""
        if replica.origins > self._folded.shape[0]:
            self._widen(replica.origins)
        lengths = replica.store.length
        before = self.revision
        for origin in np.flatnonzero(lengths > self._folded).tolist():
            changed = _fold(
                replica.store.logs[origin],
                int(self._folded[origin]),
                int(lengths[origin]),
                self._layers[origin],
                self._votes,
                self.cells,
                self.dead_frontiers,
                self._given_up,
                self.bumps,
                self.ranges,
            )
            self._folded[origin] = lengths[origin]
            self.revision = before + 1 if changed else self.revision
        return self.revision > before

    def _widen(self, origins: int) -> None:
        """Add layers for new incarnations."""
        layers, folded = self._layers, self._folded
        self._layers = np.zeros((origins, self.frame.cells), dtype=np.uint8)
        self._layers[: layers.shape[0]] = layers
        self._folded = np.zeros(origins, dtype=np.int64)
        self._folded[: folded.shape[0]] = folded

    @property
    def frontiers(self) -> npt.NDArray[np.int64]:
        """Known free cells with an unknown 4-neighbour that are neither dead nor given up, rising.

        Do not change the array.
        """
        if self._frontiers_of != self.revision:
            self._frontiers = self._find(LIVE)
            self._frontiers_of = self.revision
        return self._frontiers

    def given_up_frontiers(self) -> npt.NDArray[np.int64]:
        """Frontiers that are given up and not dead, rising."""
        return self._find(GIVEN_UP)

    def _find(self, wanted: int) -> npt.NDArray[np.int64]:
        masks = (self.cells, self.dead_frontiers, self._given_up)
        count = _find_frontiers(*masks, self.frame.columns, wanted, self._found)
        return self._found[:count].copy()

    def is_abandoned(self, cell: int) -> bool:
        """Whether a cell is a dead frontier, or one that is given up."""
        return bool(self.dead_frontiers[cell] or self._given_up[cell] > 0)

    def is_frontier(self, cell: int) -> bool:
        """Whether a cell is among the frontiers."""
        frontiers = self.frontiers
        at = int(np.searchsorted(frontiers, cell))
        return at < frontiers.shape[0] and int(frontiers[at]) == cell

    def p_occ(self) -> npt.NDArray[np.float64]:
        """(cells,) probability of occupancy, 0.5 where nothing is known."""
        return np.asarray(np.where(self.bumps, _P_OCC[2], _P_OCC[np.sign(self._votes) + 1]))

    def explored(self) -> npt.NDArray[np.bool_]:
        """(cells,) whether any layer knows the cell."""
        return np.asarray(self.cells != UNKNOWN)
