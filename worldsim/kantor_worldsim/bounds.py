"""What it takes at most to ship the mass that is left: a feasible plan, found in one pass.

Theorem 2 (Kabir & Lee, eq. 11) ships the whole rest once for every robot. When no sample was filled
twice, every robot has the same share of it to ship, and any plan in which each ships its share gives a
bound. The plan here is an auction's: a sample goes to the robot that is nearest less its price, a robot
that gets more than its share passes the excess on to those that got less, and prices then move with
the excess. One round for every row keeps them close to the best, as robots move little in between.
"""

import math

import numpy as np
import numpy.typing as npt

from kantor_protocol.kernels import kernel

_RATE = 0.05
"""How far a price moves, as a share of the mean distance, for an excess of one share."""
_BLOCK = 512
"""Samples whose distances to all robots are taken at a time."""
_ROUNDS_FIRST = 50
_PAIRS = 5_000_000
"""Robot-sample distances that one plan may cost."""


@kernel
def measure(samples_m: np.ndarray, x_m: float, y_m: float, way_m: np.ndarray) -> None:
    """Distances from a place to samples. Two plain loops, since the compiler then takes many at a time."""
    for j in range(samples_m.shape[0]):
        dx = samples_m[j, 0] - x_m
        dy = samples_m[j, 1] - y_m
        way_m[j] = dx * dx + dy * dy
    for j in range(samples_m.shape[0]):
        way_m[j] = math.sqrt(way_m[j])


@kernel
def _bid(
    xy_m: np.ndarray,
    robots_m: np.ndarray,
    left: np.ndarray,
    prices_m: np.ndarray,
    loads: np.ndarray,
    ways: np.ndarray,
    block_m: np.ndarray,
) -> None:
    """Let every sample with mass left choose its robot.

    Fills loads (n,), the units that chose a robot, and ways (n, n): of those, units times distance to
    each robot. block_m: (n, B) room for the distances of one block of samples.
    """
    robots = robots_m.shape[0]
    for k in range(robots):
        loads[k] = 0.0
        for q in range(robots):
            ways[k, q] = 0.0
    for first in range(0, xy_m.shape[0], block_m.shape[1]):
        last = min(first + block_m.shape[1], xy_m.shape[0])
        for k in range(robots):
            measure(xy_m[first:last], robots_m[k, 0], robots_m[k, 1], block_m[k])
        for j in range(first, last):
            if left[j] <= 0:
                continue
            best = 0
            least_m = math.inf
            for k in range(robots):
                net_m = block_m[k, j - first] - prices_m[k]
                if net_m < least_m:
                    best, least_m = k, net_m
            loads[best] += left[j]
            for k in range(robots):
                ways[best, k] += left[j] * block_m[k, j - first]


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
            even += ways[k, q] / robots
            if kept < 1.0 and loads[q] < share:
                cost += (1.0 - kept) * (share - loads[q]) / lacking * ways[k, q]
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
        self._block_m = np.zeros((robots, _BLOCK))
        affordable = max(1, _PAIRS // (robots * samples))
        self._rounds = min(_ROUNDS_FIRST, affordable)
        self._rounds_later = min(every, _ROUNDS_FIRST, affordable)

    def cost(
        self,
        xy_m: npt.NDArray[np.float64],
        robots_m: npt.NDArray[np.float64],
        left: npt.NDArray[np.int64],
    ) -> float:
        """Units times metres to ship `left` (N,) from the robots (n, 2) to the samples (N, 2)."""
        cost = math.inf
        for _ in range(self._rounds):
            _bid(xy_m, robots_m, left, self._prices_m, self._loads, self._ways, self._block_m)
            cost = min(cost, _settle(self._loads, self._ways, self._prices_m))
        self._rounds = self._rounds_later
        return cost
