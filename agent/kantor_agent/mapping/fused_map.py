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

from kantor_protocol.base.grid import FREE, NOWHERE, OCCUPIED, UNKNOWN, Frame, neighbour
from kantor_protocol.base.kernels import kernel
from kantor_protocol.replication.occupancy_log import CERTAIN, RANGE_BINS
from kantor_protocol.replication.replica import Replica

P_OCC = 1.0 / (1.0 + np.exp(-np.array([-1.0, 0.0, 1.0]) * CERTAIN / 100.0))
"""Probability of occupancy where more layers say free, as many say either, or more say occupied."""

NO_BOX = (1 << 31, 0, 1 << 31, 0)
"""A box without cells: rows and columns from and below."""


@kernel
def _is_beside_unknown(cells: np.ndarray, cell: int, columns: int) -> bool:
    column = cell % columns
    return bool(
        (column > 0 and cells[cell - 1] == UNKNOWN)
        or (column + 1 < columns and cells[cell + 1] == UNKNOWN)
        or (cell >= columns and cells[cell - columns] == UNKNOWN)
        or (cell + columns < cells.shape[0] and cells[cell + columns] == UNKNOWN)
    )


@kernel
def _vote(kind: int) -> int:
    """What a layer says of a cell: 1 that it is occupied, -1 that it is free, or 0."""
    return (kind == OCCUPIED) - (kind == FREE)


@kernel
def _renew_frontier(
    cells: np.ndarray,
    columns: int,
    cell: int,
    dead_frontiers: np.ndarray,
    given_up: np.ndarray,
    live: np.ndarray,
) -> None:
    """Note whether a cell is a frontier that is neither dead nor given up."""
    open_ = cells[cell] == FREE and not dead_frontiers[cell] and given_up[cell] <= 0
    live[cell] = open_ and _is_beside_unknown(cells, cell, columns)


@kernel
def _fold(
    logs: np.ndarray,
    lengths: np.ndarray,
    folded: np.ndarray,
    columns: int,
    layers: np.ndarray,
    votes: np.ndarray,
    cells: np.ndarray,
    dead_frontiers: np.ndarray,
    given_up: np.ndarray,
    bumps: np.ndarray,
    ranges: np.ndarray,
    live: np.ndarray,
    boxes: np.ndarray,
) -> bool:
    """Apply the entries of every log that were not folded yet; whether any is about a cell."""
    count = cells.shape[0]
    beyond = 3 * count + ranges.shape[0]
    changed = False
    for origin in range(lengths.shape[0]):
        box = boxes[origin]
        for i in range(folded[origin], lengths[origin]):
            entry = logs[origin, i, 0]
            if 3 * count <= entry < beyond:
                ranges[entry - 3 * count] += 1
                continue
            changed = True
            if entry >= beyond + 2 * count:
                cell, kind = entry - beyond - 2 * count, OCCUPIED
                bumps[cell] = True
            elif entry >= 2 * count:
                cell = (entry if entry < 3 * count else entry - beyond) % count
                if entry < 3 * count:
                    dead_frontiers[cell] = True
                else:
                    given_up[cell] += 1 if entry < beyond + count else -1
                _renew_frontier(cells, columns, cell, dead_frontiers, given_up, live)
                continue
            else:
                cell, kind = entry >> 1, OCCUPIED if entry & 1 else FREE
                votes[cell] += _vote(kind) - _vote(layers[origin, cell])
                layers[origin, cell] = kind
                free = votes[cell] < 0 and not bumps[cell]
                kind = FREE if free else OCCUPIED  # in doubt there is a wall
            before, cells[cell] = cells[cell], kind
            row, column = cell // columns, cell % columns
            box[0], box[1] = min(box[0], row), max(box[1], row + 1)
            box[2], box[3] = min(box[2], column), max(box[3], column + 1)
            if before != kind:
                _renew_frontier(cells, columns, cell, dead_frontiers, given_up, live)
            if before == UNKNOWN:
                for side in range(4):
                    n = neighbour(cell, side, columns, count)
                    if n != NOWHERE:
                        _renew_frontier(cells, columns, n, dead_frontiers, given_up, live)
        folded[origin] = lengths[origin]
    return changed


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
        self.is_live = np.zeros(frame.cells, dtype=np.bool_)
        """(cells,) whether a cell is among the `frontiers`."""
        self._frontiers: npt.NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        """The places in `_live` while `_frontiers_of` is `revision`, else out of date."""
        self._frontiers_of = -1
        self._no_boxes = np.tile(NO_BOX, (origins, 1))
        self._boxes = self._no_boxes.copy()
        """(origins, 4) rows and columns from and below: where entries of each log have changed cells since
        `take_boxes`."""

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
        unknown = np.pad((fused == UNKNOWN).reshape(shape), 1)
        beside = unknown[1:-1, :-2] | unknown[1:-1, 2:] | unknown[:-2, 1:-1] | unknown[2:, 1:-1]
        given_up_now = dead_frontiers | (self._given_up > 0)
        live = (fused == FREE) & beside.ravel() & ~given_up_now
        assert np.array_equal(self.is_live, live)
        if self._frontiers_of == self.revision:
            assert np.array_equal(self._frontiers, np.flatnonzero(live))

    def fold(self, replica: Replica) -> bool:
        """Take in the entries that the logs have gained; whether a cell may have changed."""
        if replica.origins > self._folded.shape[0]:
            self._widen(replica.origins)
        changed: bool = _fold(
            replica.store.logs,
            replica.store.length,
            self._folded,
            self.frame.columns,
            self._layers,
            self._votes,
            self.cells,
            self.dead_frontiers,
            self._given_up,
            self.bumps,
            self.ranges,
            self.is_live,
            self._boxes,
        )
        self.revision += changed
        return changed

    def take_boxes(self) -> npt.NDArray[np.int64]:
        """(n, 4) rows and columns, from and below, in which cells have changed since this was last asked; `NO_BOX`es."""
        boxes, self._boxes = self._boxes, self._no_boxes.copy()
        return boxes

    def _widen(self, origins: int) -> None:
        """Add layers for new incarnations."""
        layers, folded, boxes = self._layers, self._folded, self._boxes
        self._layers = np.zeros((origins, self.frame.cells), dtype=np.uint8)
        self._layers[: layers.shape[0]] = layers
        self._folded = np.zeros(origins, dtype=np.int64)
        self._folded[: folded.shape[0]] = folded
        self._no_boxes = np.tile(NO_BOX, (origins, 1))
        self._boxes = self._no_boxes.copy()
        self._boxes[: boxes.shape[0]] = boxes

    @property
    def evidence(
        self,
    ) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int16], npt.NDArray[np.bool_]]:
        """`cells`, the layers that say occupied less those that say free, and `bumps`, (cells,) each."""
        return self.cells, self._votes, self.bumps

    @property
    def frontiers(self) -> npt.NDArray[np.int64]:
        """Known free cells with an unknown 4-neighbour that are neither dead nor given up, rising.

        Do not change the array.
        """
        if self._frontiers_of != self.revision:
            self._frontiers = np.flatnonzero(self.is_live)
            self._frontiers_of = self.revision
        return self._frontiers

    def given_up_frontiers(self) -> npt.NDArray[np.int64]:
        """Frontiers that are given up and not dead, rising."""
        columns, out = self.frame.columns, np.flatnonzero(self._given_up > 0)
        would_be = [
            self.cells[cell] == FREE
            and not self.dead_frontiers[cell]
            and _is_beside_unknown(self.cells, cell, columns)
            for cell in out.tolist()
        ]
        return out[np.array(would_be, dtype=np.bool_)]

    def is_abandoned(self, cell: int) -> bool:
        """Whether a cell is a dead frontier, or one that is given up."""
        return bool(self.dead_frontiers[cell] or self._given_up[cell] > 0)

    def is_frontier(self, cell: int) -> bool:
        """Whether a cell is among the frontiers."""
        return 0 <= cell < self.frame.cells and bool(self.is_live[cell])

    def p_occ(self) -> npt.NDArray[np.float64]:
        """(cells,) probability of occupancy, 0.5 where nothing is known."""
        return np.asarray(np.where(self.bumps, P_OCC[2], P_OCC[np.sign(self._votes) + 1]))

    def explored(self) -> npt.NDArray[np.bool_]:
        """(cells,) whether any layer knows the cell."""
        return np.asarray(self.cells != UNKNOWN)
