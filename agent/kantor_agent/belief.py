"""What a robot believes: how much weight is left on which sample, and where the samples are."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from kantor_agent.field import Grid, build, grid_over, nearest, remove, remove_empty
from kantor_protocol.messages import News
from kantor_protocol.packing import Pairs
from kantor_protocol.replica import Manner, Replica, Store, spend
from kantor_protocol.walk import Walk
from kantor_protocol.weights import Units, Weights

_NO_SKIP = np.zeros(0, dtype=np.int64)


class _Room(NamedTuple):
    """Scratch for one plan of Proposition 1."""

    best: npt.NDArray[np.float64]
    near: npt.NDArray[np.int64]
    sample: npt.NDArray[np.int64]
    units: npt.NDArray[np.int64]


@njit(cache=True)
def ship(
    grid: Grid, store: Store, manner: Manner, x: float, y: float, point: int, room: _Room
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
        spend(store, manner, j, units)
        if store.weights[j] <= 0:
            remove(grid, j)
        room.sample[count] = j
        room.units[count] = units
        left -= units
        count += 1
    return count


class Belief:
    """The replica of everybody's spending, with the samples in space.

    Invariant: exactly the samples whose weight is positive are in the grid.
    """

    def __init__(self, walk: Walk, units: Units, replica: Replica) -> None:
        """walk: the samples, which it moves."""
        self.replica = replica
        self.grid = grid_over(walk.xy_m, replica.weights)
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
        self._pairs = Pairs()

    @property
    def weights(self) -> Weights:
        """(N,) units left, in this robot's view."""
        return self.replica.weights

    @property
    def empty(self) -> bool:
        """Whether no sample has weight left."""
        return bool(self.grid.alive[0] == 0)

    def nearest(self, x_m: float, y_m: float, count: int) -> npt.NDArray[np.int64]:
        """The samples with weight that are nearest to a place, nearest first; at most `count`."""
        near = np.zeros(count, dtype=np.int64)
        found = nearest(self.grid, x_m, y_m, _NO_SKIP, np.zeros(count), near)
        return near[:found]

    def learn(self, source: int, news: News) -> bool:
        """Take in what another participant sent; False when it is malformed."""
        return self.replica.learn(source, news.have, news.logs, news.claims)

    def advance(self, now_ns: int) -> None:
        """Bring walking samples to `now_ns` and drop those that messages have emptied."""
        if self._walk.advance(now_ns):
            build(self.grid, self.weights)
        else:
            remove_empty(self.grid, self.weights, self.replica.lowered())

    def spend(self, x_m: float, y_m: float) -> bytes:
        """Ship one robot point from here (Prop. 1); packed pairs (sample, units), nearest first."""
        self.replica.reserve(self._room.sample.shape[0])
        count = ship(
            self.grid,
            self.replica.store,
            self.replica.manner,
            x_m,
            y_m,
            self._units.point,
            self._room,
        )
        return self._pairs.encode(self._room.sample, self._room.units, count)

    def lowered(self) -> bytes:
        """Packed pairs (sample, units left) of what fell in this step."""
        index = self.replica.lowered()
        return self._pairs.encode(index, self.weights[index], index.shape[0])
