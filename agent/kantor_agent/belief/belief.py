"""The belief of a robot about a density: how much weight is left on which sample, and where the samples are."""

import operator
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
from kantor_protocol.base.kernels import kernel, typed
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.base.varint import pack_pairs
from kantor_protocol.replication.registers import Registers
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import (
    LOWERED,
    NO_INDEX,
    ReplicaArrays,
    ReplicaConfig,
    spend,
)
from kantor_protocol.wire.weights import Units, Weights

_NO_SKIP = np.zeros(0, dtype=np.int64)


class _Shipment(NamedTuple):
    """Scratch and output of one plan of Proposition 1, for the kernels."""

    best: npt.NDArray[np.float64]
    """(1,) scratch of `nearest`."""
    near: npt.NDArray[np.int64]
    """(1,) scratch of `nearest`."""
    sample: npt.NDArray[np.int64]
    """(most,) samples that the point filled, nearest first."""
    units: npt.NDArray[np.int64]
    """(most,) units shipped to each."""


@kernel
def ship(
    grid: SampleIndex,
    store: ReplicaArrays,
    config: ReplicaConfig,
    x: float,
    y: float,
    point: int,
    shipment: _Shipment,
) -> int:
    """Ship one robot point from (x, y) by Proposition 1, log it, and drop emptied samples.

    Fills the nearest sample that has weight with min(n, m), again and again until m is 0 or no weight
    is left. Returns how many samples were filled; they are in shipment.sample, shipment.units.
    """
    count = 0
    left = point
    while left > 0 and nearest(grid, x, y, _NO_SKIP, shipment.best, shipment.near) > 0:
        j = shipment.near[0]
        units = min(left, store.weights[j])
        spend(store, config, j, units)
        if store.weights[j] <= 0:
            remove(grid, j)
        shipment.sample[count] = j
        shipment.units[count] = units
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
    """`ship` for calls from Python: bytes of packed pairs in `out`, or -1 if the log has no space left."""
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
    # Of the configuration, spending reads only whose log it is and whether it is a ledger.
    config = ReplicaConfig(me, ledger != 0, False, False, False, 0, 0, 0, 0, 0, 0, 0, False)
    count = ship(grid, store, config, x, y, point, _Shipment(best, near, sample, units))
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
    """Take the samples that this step has emptied out of the index."""
    grid = SampleIndex(xy_m, order, cell, first, alive, frame, levels)
    read: int = remove_empty(grid, weights, lowered[: counters[LOWERED]])
    return read


class Belief:
    """A replica of the spending of all participants, with the samples in space.

    The attributes say which others they agree with; that holds after `advance` and after `spend`, and
    `validate` asserts it. Between a message that the replica takes in and the next `advance`, the index
    may still have samples that the message emptied.
    """

    def __init__(self, random_walk: RandomWalk, units: Units, replica: Replica) -> None:
        """random_walk: moves the samples. units: of the mission that the replica belongs to."""
        self.replica = replica
        """Has the weights: of every sample from 0 to its first weight, `Units.sample`."""
        self.grid = index_over(random_walk.xy_m, replica.weights)
        """The samples by position, those of the random walk; alive are exactly those whose weight is positive."""
        self._random_walk = random_walk
        self._units = units
        # Every sample that one point fills takes at least one unit.
        most = min(units.point, replica.weights.shape[0])
        self._shipment = _Shipment(
            best=np.zeros(1, dtype=np.float64),
            near=np.zeros(1, dtype=np.int64),
            sample=np.zeros(most, dtype=np.int64),
            units=np.zeros(most, dtype=np.int64),
        )
        self._packed = np.zeros(20 * most, dtype=np.uint8)
        store = replica.store
        self._to_drop = (*self.grid, store.weights, store.lowered, store.counters)
        """Arguments of `_drop_empty`: the arrays of `grid` and of the replica's store, which keeps these three."""
        self._follow_store()

        self._ship = typed(_ship_packed, *self._to_ship, 0.0, 0.0)
        self._drop_empty = typed(_drop_empty, *self._to_drop)

    def _follow_store(self) -> None:
        """Take the arrays of the replica's store, which are replaced when logs grow or incarnations come."""
        store, config = self.replica.store, self.replica.config
        self._store = store
        """The replica's store, from which `_to_ship` and `to_choose` are taken."""
        self._to_ship: tuple[Any, ...] = (
            *(*self.grid, *store, *self._shipment, self._packed),
            *(config.me, int(config.ledger), self._units.point),
        )
        """Arguments of `_ship_packed`: the arrays of `grid` and of `_store`, then scratch and settings."""
        self.to_choose: tuple[Any, ...] = (
            *self.grid,
            store.weights,
            store.claims,
            store.counters,
            np.zeros(self.replica.origins, dtype=np.int64),
            config.me if config.claims else NO_INDEX,
        )
        """Arguments of a planner's kernel (see `kernels.kernel`): the arrays of `grid`; weights, claims and
        counters of `_store`; scratch for one claim of each incarnation; the own incarnation id, or NO_INDEX
        in a mission without claims."""

    def validate(self) -> None:
        """Assert what the attributes say of one another, see the class. The replica has a `validate` of its own."""
        weights, grid, store = self.weights, self.grid, self.replica.store
        assert ((weights >= 0) & (weights <= self._units.sample)).all()
        assert grid.xy_m is self._random_walk.xy_m
        grid.validate(weights)
        assert self._store is store
        dropped = (*grid, store.weights, store.lowered, store.counters)
        chosen = (*grid, store.weights, store.claims, store.counters)
        assert all(map(operator.is_, self._to_drop, dropped))
        assert all(map(operator.is_, self._to_ship, (*grid, *store)))
        assert all(map(operator.is_, self.to_choose, chosen))
        assert self.to_choose[len(chosen)].shape == (self.replica.origins,)

    @property
    def weights(self) -> Weights:
        """(N,) units left, in this robot's view."""
        return self.replica.weights

    @property
    def registers(self) -> Registers:
        """Registers of integers that planners share."""
        return self.replica.registers

    @property
    def random_walk_steps(self) -> int:
        """Steps of the random walk that the samples have made."""
        return self._random_walk.steps

    @property
    def empty(self) -> bool:
        """Whether no sample has weight left."""
        return self.grid.alive.item(0) == 0

    def nearest(self, x_m: float, y_m: float, count: int) -> npt.NDArray[np.int64]:
        """Samples with weight that are nearest to a place, nearest first; at most `count`. World frame."""
        near = np.zeros(count, dtype=np.int64)
        found = nearest(self.grid, x_m, y_m, _NO_SKIP, np.zeros(count), near)
        return near[:found]

    def advance(self, now_ns: int) -> None:
        """Move the samples to their positions at `now_ns`, and drop those that messages have emptied."""
        if self._store is not self.replica.store:  # the replica has grown
            self._follow_store()
        if self._random_walk.advance(now_ns):
            build(self.grid, self.weights)
            return
        if self.replica.fell:
            self._drop_empty(*self._to_drop)

    def spend(self, x_m: float, y_m: float) -> bytes:
        """Ship one robot point from here (Prop. 1); packed pairs (sample, units), nearest first."""
        used: int = self._ship(*self._to_ship, x_m, y_m)
        if used < 0:
            self.replica.reserve(self._shipment.sample.shape[0])
            self._follow_store()
            used = self._ship(*self._to_ship, x_m, y_m)
        return self._packed[:used].tobytes()
