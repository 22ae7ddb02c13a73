"""An upper bound on the cost of shipping the mass that is left: a feasible plan, found in one pass.

Theorem 2 (Kabir & Lee, eq. 11) ships the whole rest once for every robot. When no sample was filled
twice, every robot has the same share of it to ship, and any plan in which each ships its share gives a
bound. The plan here is an auction's: a sample goes to the robot that is nearest less its price, a robot
that gets more than its share passes the excess on to those that got less, and prices then move with
the excess. One round for every row keeps them close to the best, as robots move little in between.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel

_RATE = 0.05
"""The step of a price, as a share of the mean distance, for an excess of one share."""
_BLOCK = 512
"""Samples whose distances to all robots are taken at a time."""
_TOGETHER = 8
"""Robots whose sums are added to at a time."""
_ROUNDS_FIRST = 50
_PAIRS = 5_000_000
"""Robot-sample distances that one plan may cost."""


@kernel
def measure(x_m: np.ndarray, y_m: np.ndarray, place_m: np.ndarray, way_m: np.ndarray) -> None:
    """Distances from a place (2,) to samples, of which the coordinates come apart: many at a time."""
    for j in range(way_m.shape[0]):
        dx = x_m[j] - place_m[0]
        dy = y_m[j] - place_m[1]
        way_m[j] = math.sqrt(dx * dx + dy * dy)


@kernel
def gather(xy_m: np.ndarray, left: np.ndarray, first: int, xyu: np.ndarray) -> tuple[int, int]:
    """Collect samples with units left, from `first` on, until the room is full.

    xyu: (3, B) room for x, y and units. Returns how many there are, and where to go on.
    """
    count = 0
    while first < left.shape[0] and count < xyu.shape[1]:
        xyu[0, count], xyu[1, count], xyu[2, count] = xy_m[first, 0], xy_m[first, 1], left[first]
        count += left[first] > 0
        first += 1
    return count, first


@kernel
def _compare(
    way_m: np.ndarray, price_m: float, robot: int, least_m: np.ndarray, best: np.ndarray
) -> None:
    """Samples choose this robot if it is the nearest so far. Without a branch: many at a time."""
    for j in range(way_m.shape[0]):
        net_m = way_m[j] - price_m
        nearer = net_m < least_m[j]
        least_m[j] = net_m if nearer else least_m[j]
        best[j] = robot if nearer else best[j]


class _Room(NamedTuple):
    """Room for one block of B samples and n robots."""

    xyu: npt.NDArray[np.float64]
    """(3, B)"""
    least_m: npt.NDArray[np.float64]
    """(B,)"""
    best: npt.NDArray[np.int64]
    """(B,)"""
    block_m: npt.NDArray[np.float64]
    """(n, B)"""


@kernel
def _bid(
    xy_m: np.ndarray,
    robots_m: np.ndarray,
    left: np.ndarray,
    prices_m: np.ndarray,
    loads: np.ndarray,
    ways: np.ndarray,
    fields: tuple[Any, ...],
) -> None:
    """Let every sample with mass left choose its robot.

    Fills loads (n,), the units that chose a robot, and ways (n, n): ways[k, q] is units times distance to
    robot k, of the samples that chose q. fields: those of a _Room.
    """
    room = _Room(*fields)
    xyu, least_m, best, block_m = room
    loads[:] = 0.0
    ways[:] = 0.0
    first = 0
    while first < left.shape[0]:
        count, first = gather(xy_m, left, first, xyu)
        least_m[:count] = math.inf
        best[:count] = 0
        for k in range(robots_m.shape[0]):
            way_m = block_m[k, :count]
            measure(xyu[0], xyu[1], robots_m[k], way_m)
            _compare(way_m, prices_m[k], k, least_m, best)
        for k in range(0, robots_m.shape[0], _TOGETHER):
            _add_ways(room, count, k, loads, ways)


@kernel
def _add_ways(room: _Room, count: int, first: int, loads: np.ndarray, ways: np.ndarray) -> None:
    """Add the samples of a block to the sums of a few robots: each sum waits for its last term, so several go on at once."""
    for j in range(count):
        chosen, units = room.best[j], room.xyu[2, j]
        if first == 0:
            loads[chosen] += units
        for k in range(first, min(first + _TOGETHER, ways.shape[0])):
            ways[k, chosen] += units * room.block_m[k, j]


@kernel
def _settle(loads: np.ndarray, ways: np.ndarray, prices_m: np.ndarray) -> float:
    """The cost of the plan, or of the even split if that is cheaper; and the next prices."""
    robots = loads.shape[0]
    share = loads.sum() / robots
    if share <= 0.0:
        return 0.0
    lacking = 0.0
    for k in range(robots):
        lacking += max(0.0, share - loads[k])
    cost = 0.0
    even = 0.0
    for k in range(robots):
        kept = 1.0 if loads[k] <= share else share / loads[k]
        cost += kept * ways[k, k]
        for q in range(robots):
            even += ways[q, k] / robots
            if kept < 1.0 and loads[q] < share:
                cost += (1.0 - kept) * (share - loads[q]) / lacking * ways[q, k]
    mean_m = even / (share * robots)
    for k in range(robots):
        prices_m[k] += _RATE * mean_m * (share - loads[k]) / share
    return min(cost, even)


class Auction:
    """The plan for what is left, kept up while robots move and samples empty."""

    def __init__(self, robots: int, samples: int, every: int) -> None:
        """every: periods between two plans; the longer, the more rounds a plan takes."""
        self._prices_m = np.zeros(robots)
        self._loads = np.zeros(robots)
        self._ways = np.zeros((robots, robots))
        room = _Room(
            xyu=np.zeros((3, _BLOCK)),
            least_m=np.zeros(_BLOCK),
            best=np.zeros(_BLOCK, dtype=np.int64),
            block_m=np.zeros((robots, _BLOCK)),
        )
        self._room = tuple(room)
        affordable = max(1, _PAIRS // (robots * samples))
        self._rounds = min(_ROUNDS_FIRST, affordable)
        self._rounds_later = min(every, _ROUNDS_FIRST, affordable)

    @property
    def ways(self) -> npt.NDArray[np.float64]:
        """(n,) units times metres to ship all that was left at the last plan by each robot alone."""
        ways: npt.NDArray[np.float64] = self._ways.sum(axis=1)
        return ways

    def cost(
        self,
        xy_m: npt.NDArray[np.float64],
        robots_m: npt.NDArray[np.float64],
        left: npt.NDArray[np.int64],
    ) -> float:
        """Units times metres to ship `left` (N,) from the robots (n, 2) to the samples (N, 2)."""
        cost = math.inf
        for _ in range(self._rounds):
            _bid(xy_m, robots_m, left, self._prices_m, self._loads, self._ways, self._room)
            cost = min(cost, _settle(self._loads, self._ways, self._prices_m))
        self._rounds = self._rounds_later
        return cost
