"""The map that a participant has of the unknown: everybody's layers, fused (Burgard et al., eq. 1-3).

Every origin (an incarnation of a robot) has a layer of its own, folded from its log alone (`evidence.py`). The fused log odds of a
cell are the sum over the layers, each counted as certain as evidence gets, and the sum is clamped once
more. A cell is explored once any layer knows it, whatever its probability.
"""

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.base.kernels import kernel
from kantor_protocol.replication.occupancy_log import CERTAIN, RANGE_BINS
from kantor_protocol.replication.replica import Replica

_P_OCC = 1.0 / (1.0 + np.exp(-np.array([-1.0, 0.0, 1.0]) * CERTAIN / 100.0))


@kernel
def _fold(
    log: np.ndarray,
    first: int,
    length: int,
    layer: np.ndarray,
    votes: np.ndarray,
    cells: np.ndarray,
    void: np.ndarray,
    ranges: np.ndarray,
) -> bool:
    """Apply the entries log[first:length] of one origin; whether any is about a cell. cells: (n,) fused."""
    count = cells.shape[0]
    news = False
    for i in range(first, length):
        entry = log[i, 0]
        if entry >= 3 * count:
            ranges[min(entry - 3 * count, ranges.shape[0] - 1)] += 1
            continue
        news = True
        if entry >= 2 * count:
            void[entry - 2 * count] = True
        elif entry >= 0:
            cell, kind = entry // 2, OCCUPIED if entry & 1 else FREE
            votes[cell] += (1 if kind == OCCUPIED else -1) - (
                0 if layer[cell] == UNKNOWN else 1 if layer[cell] == OCCUPIED else -1
            )
            layer[cell] = kind
            cells[cell] = FREE if votes[cell] < 0 else OCCUPIED  # in doubt there is a wall
    return news


@kernel
def _find_frontiers(cells: np.ndarray, void: np.ndarray, columns: int, out: np.ndarray) -> int:
    count = 0
    total = cells.shape[0]
    for cell in range(total):
        if cells[cell] != FREE or void[cell]:
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
    """The fused map of one participant."""

    def __init__(self, frame: Frame, origins: int) -> None:
        """origins: incarnations that may have a layer; there may come more."""
        self.frame = frame
        self.cells = np.zeros(frame.cells, dtype=np.uint8)
        """(cells,) UNKNOWN, FREE or OCCUPIED."""
        self.ranges = np.zeros(RANGE_BINS, dtype=np.int64)
        """Measured ranges of all robots so far, from 0 to the sensor's range."""
        self.void = np.zeros(frame.cells, dtype=np.bool_)
        """(cells,) frontiers at which somebody stood and saw nothing new."""
        self.revision = 0
        """Rises whenever a cell may have changed."""
        self._layers = np.zeros((origins, frame.cells), dtype=np.uint8)
        self._votes = np.zeros(frame.cells, dtype=np.int16)
        self._folded = np.zeros(origins, dtype=np.int64)
        self._room = np.zeros(frame.cells, dtype=np.int64)
        self._frontiers = self._room[:0]
        self._frontiers_of = -1

    def fold(self, replica: Replica) -> bool:
        """Take in what the logs hold by now; whether a cell may have changed."""
        if replica.origins > self._folded.shape[0]:
            self._widen(replica.origins)
        lengths = replica.store.length
        before = self.revision
        for origin in np.flatnonzero(lengths > self._folded).tolist():
            news = _fold(
                replica.store.logs[origin],
                int(self._folded[origin]),
                int(lengths[origin]),
                self._layers[origin],
                self._votes,
                self.cells,
                self.void,
                self.ranges,
            )
            self._folded[origin] = lengths[origin]
            self.revision = before + 1 if news else self.revision
        return self.revision > before

    def _widen(self, origins: int) -> None:
        """Make room for the layers of new incarnations."""
        layers, folded = self._layers, self._folded
        self._layers = np.zeros((origins, self.frame.cells), dtype=np.uint8)
        self._layers[: layers.shape[0]] = layers
        self._folded = np.zeros(origins, dtype=np.int64)
        self._folded[: folded.shape[0]] = folded

    @property
    def frontiers(self) -> npt.NDArray[np.int64]:
        """Known free cells with an unknown 4-neighbour, rising; do not change them."""
        if self._frontiers_of != self.revision:
            count = _find_frontiers(self.cells, self.void, self.frame.columns, self._room)
            self._frontiers = self._room[:count].copy()
            self._frontiers_of = self.revision
        return self._frontiers

    def is_frontier(self, cell: int) -> bool:
        """Whether a cell is among the frontiers."""
        frontiers = self.frontiers
        at = int(np.searchsorted(frontiers, cell))
        return at < frontiers.shape[0] and int(frontiers[at]) == cell

    def p_occ(self) -> npt.NDArray[np.float64]:
        """(cells,) probability of a wall, 0.5 where nothing is known."""
        return np.asarray(_P_OCC[np.sign(self._votes) + 1])

    def explored(self) -> npt.NDArray[np.bool_]:
        """(cells,) known to anybody."""
        return np.asarray(self.cells != UNKNOWN)
