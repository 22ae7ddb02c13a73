"""What a robot believes: how much weight is left on which sample, and where the samples are."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_agent.belief.sample_index import (
    SampleIndex,
    build,
    index_over,
    nearest,
    remove,
    remove_empty,
)
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.base.varint import pack_pairs
from kantor_protocol.replication.registers import Registers
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import (
    LOWERED,
    NOBODY,
    ReplicaArrays,
    ReplicaConfig,
    spend,
)
from kantor_protocol.wire.weights import Units, Weights

_NO_SKIP = np.zeros(0, dtype=np.int64)


class _Room(NamedTuple):
    """Scratch for one plan of Proposition 1."""

    best: npt.NDArray[np.float64]
    near: npt.NDArray[np.int64]
    sample: npt.NDArray[np.int64]
    units: npt.NDArray[np.int64]


@kernel
def ship(
    grid: SampleIndex,
    store: ReplicaArrays,
    config: ReplicaConfig,
    x: float,
    y: float,
    point: int,
    room: _Room,
) -> int:
    """Ship one robot point from (x, y) by Proposition 1, log it, and drop emptied samples.

    Fills the nearest sample that has weight with min(n, m), again and again until m is 0 or nothing
    is left. Returns how many samples got something; they are in room.sample, room.units.
    """
    count = 0
    left = point
    while left > 0 and nearest(grid, x, y, _NO_SKIP, room.best, room.near) > 0:
        j = room.near[0]
        units = min(left, store.weights[j])
        spend(store, config, j, units)
        if store.weights[j] <= 0:
            remove(grid, j)
        room.sample[count] = j
        room.units[count] = units
        left -= units
        count += 1
    return count


@kernel
def _ship_packed(
    xy_m: np.ndarray,
    order: np.ndarray,
    cell: np.ndarray,
    first: np.ndarray,
    alive: np.ndarray,
    frame: np.ndarray,
    levels: int,
    weights: np.ndarray,
    logs: np.ndarray,
    length: np.ndarray,
    known: np.ndarray,
    sending: np.ndarray,
    claims: np.ndarray,
    lowered: np.ndarray,
    mark: np.ndarray,
    counters: np.ndarray,
    best: np.ndarray,
    near: np.ndarray,
    sample: np.ndarray,
    units: np.ndarray,
    out: np.ndarray,
    me: int,
    ledger: int,
    point: int,
    x: float,
    y: float,
) -> int:
    """`ship` for calls from Python: bytes of packed pairs in `out`, or -1 if the log has no room."""
    if length[me] + sample.shape[0] > logs.shape[1]:
        return -1
    grid = SampleIndex(xy_m, order, cell, first, alive, frame, levels)
    store = ReplicaArrays(
        weights,
        logs,
        length,
        known,
        sending,
        claims,
        lowered,
        mark,
        counters,
    )
    # Of the manner, spending reads only whose log it is and what an entry means.
    config = ReplicaConfig(me, ledger != 0, False, False, False, 0, 0, 0, 0)
    count = ship(grid, store, config, x, y, point, _Room(best, near, sample, units))
    used: int = pack_pairs(sample, units, count, out)
    return used


@kernel
def _drop_empty(
    xy_m: np.ndarray,
    order: np.ndarray,
    cell: np.ndarray,
    first: np.ndarray,
    alive: np.ndarray,
    frame: np.ndarray,
    levels: int,
    weights: np.ndarray,
    lowered: np.ndarray,
    counters: np.ndarray,
) -> int:
    """Take the samples that this step has emptied out of the grid."""
    grid = SampleIndex(xy_m, order, cell, first, alive, frame, levels)
    read: int = remove_empty(grid, weights, lowered[: counters[LOWERED]])
    return read


class Belief:
    """The replica of everybody's spending, with the samples in space.

    Invariant: exactly the samples whose weight is positive are in the grid.
    """

    def __init__(self, walk: RandomWalk, units: Units, replica: Replica) -> None:
        """walk: the samples, which it moves."""
        self.replica = replica
        self.grid = index_over(walk.xy_m, replica.weights)
        self._walk = walk
        self._units = units
        # Every sample that one point fills takes at least one unit.
        most = min(units.point, replica.weights.shape[0])
        self._room = _Room(
            best=np.zeros(1, dtype=np.float64),
            near=np.zeros(1, dtype=np.int64),
            sample=np.zeros(most, dtype=np.int64),
            units=np.zeros(most, dtype=np.int64),
        )
        self._packed = np.zeros(20 * most, dtype=np.uint8)
        store = replica.store
        self._to_drop = (*self.grid, store.weights, store.lowered, store.counters)
        self._follow_store()

    def _follow_store(self) -> None:
        """Have kernels work on the store as it is: it moves when logs grow or origins come."""
        store, config = self.replica.store, self.replica.config
        self._store = store
        self._to_ship: tuple[Any, ...] = (
            *(*self.grid, *store, *self._room, self._packed),
            *(config.me, int(config.ledger), self._units.point),
        )
        self.to_choose: tuple[Any, ...] = (
            *self.grid,
            store.weights,
            store.claims,
            store.counters,
            np.zeros(self.replica.origins, dtype=np.int64),
            config.me if config.claims else NOBODY,
        )
        """Grid, weights and claims as arguments of a planner's kernel; see `kernels.kernel`."""

    @property
    def weights(self) -> Weights:
        """(N,) units left, in this robot's view."""
        return self.replica.weights

    @property
    def registers(self) -> Registers:
        """What planners tell one another."""
        return self.replica.registers

    @property
    def walked(self) -> int:
        """Steps that the samples have walked."""
        return self._walk.steps

    @property
    def empty(self) -> bool:
        """Whether no sample has weight left."""
        return self.grid.alive.item(0) == 0

    def nearest(self, x_m: float, y_m: float, count: int) -> npt.NDArray[np.int64]:
        """The samples with weight that are nearest to a place, nearest first; at most `count`."""
        near = np.zeros(count, dtype=np.int64)
        found = nearest(self.grid, x_m, y_m, _NO_SKIP, np.zeros(count), near)
        return near[:found]

    def advance(self, now_ns: int) -> None:
        """Bring walking samples to `now_ns` and drop those that messages have emptied."""
        if self._store is not self.replica.store:  # it has learned more than there was room for
            self._follow_store()
        if self._walk.advance(now_ns):
            build(self.grid, self.weights)
            return
        if self.replica.fell:
            _drop_empty(*self._to_drop)

    def spend(self, x_m: float, y_m: float) -> bytes:
        """Ship one robot point from here (Prop. 1); packed pairs (sample, units), nearest first."""
        used = _ship_packed(*self._to_ship, x_m, y_m)
        if used < 0:
            self.replica.reserve(self._room.sample.shape[0])
            self._follow_store()
            used = _ship_packed(*self._to_ship, x_m, y_m)
        return self._packed[:used].tobytes()
