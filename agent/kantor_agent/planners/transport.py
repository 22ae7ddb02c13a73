"""Optimal-transport exploration (Kabir & Lee, eq. 2-3).

The goal is the first sample of the best order through the h nearest that still have weight. The paper walks through all h! orders. Held and Karp's recursion over subsets finds the same optimum:
the cost of a step into a sample depends on where it comes from and on that sample alone.
"""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from kantor_agent.belief import Belief
from kantor_agent.field import Grid, nearest
from kantor_agent.planners.base import Goal
from kantor_protocol.machine import Pose
from kantor_protocol.replica import NOBODY


@njit(cache=True)
def first_of_best_order(
    xy_m: np.ndarray,
    weights: np.ndarray,
    x: float,
    y: float,
    near: np.ndarray,
    count: int,
    cost_to_go: np.ndarray,
) -> int:
    """Which of near[:count] begins the cheapest order by eq. 2. Equal costs: the nearer one.

    cost_to_go: (2^h, h) float64 room; [s, j] is the least cost of what follows when the set s of
    samples is still to be visited and the robot stands on j.
    """
    for remaining in range(1 << count):
        for at in range(count):
            if remaining >> at & 1:
                continue
            least = 0.0 if remaining == 0 else math.inf
            for following in range(count):
                if remaining >> following & 1:
                    dx = xy_m[near[following], 0] - xy_m[near[at], 0]
                    dy = xy_m[near[following], 1] - xy_m[near[at], 1]
                    step = math.sqrt(dx * dx + dy * dy) / weights[near[following]]
                    least = min(least, step + cost_to_go[remaining ^ (1 << following), following])
            cost_to_go[remaining, at] = least
    best, first = math.inf, 0
    everything = (1 << count) - 1
    for at in range(count):
        dx = xy_m[near[at], 0] - x
        dy = xy_m[near[at], 1] - y
        cost = math.sqrt(dx * dx + dy * dy) / weights[near[at]]
        cost += cost_to_go[everything ^ (1 << at), at]
        if cost < best:
            best, first = cost, at
    return first


@njit(cache=True)
def choose_sample(
    grid: Grid,
    weights: np.ndarray,
    x: float,
    y: float,
    skip: np.ndarray,
    best: np.ndarray,
    near: np.ndarray,
    cost_to_go: np.ndarray,
) -> int:
    """The goal of eq. 2-3 among samples that are not in `skip`, or NOBODY."""
    count = nearest(grid, x, y, skip, best, near)
    if count == 0:
        return NOBODY
    return near[first_of_best_order(grid.xy_m, weights, x, y, near, count, cost_to_go)]


class Transport:
    """The planner of Algorithms 1-3, with claims if the mission has them."""

    def __init__(self, horizon: int) -> None:
        """horizon: h, samples in one plan."""
        self._best = np.zeros(horizon, dtype=np.float64)
        self._near = np.zeros(horizon, dtype=np.int64)
        self._cost_to_go = np.zeros((1 << horizon, horizon), dtype=np.float64)

    def choose(self, belief: Belief, pose: Pose, now_ns: int, /) -> Goal | None:
        """The first sample of the best order; one that another robot holds only if all are held."""
        taken = belief.replica.taken()
        sample = self._first(belief, pose, taken)
        if sample == NOBODY and taken.size:
            sample = self._first(belief, pose, taken[:0])
        if belief.replica.manner.claims:
            belief.replica.claim(sample, now_ns)
        if sample == NOBODY:
            return None
        return Goal(
            x_m=float(belief.grid.xy_m[sample, 0]),
            y_m=float(belief.grid.xy_m[sample, 1]),
            sample=sample,
        )

    def _first(self, belief: Belief, pose: Pose, skip: npt.NDArray[np.int64]) -> int:
        return int(
            choose_sample(
                belief.grid,
                belief.weights,
                pose.x_m,
                pose.y_m,
                skip,
                self._best,
                self._near,
                self._cost_to_go,
            )
        )
