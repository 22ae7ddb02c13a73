"""Optimal-transport exploration (Kabir & Lee, eq. 2-3).

The goal is the first sample of the best order through the h nearest that still have weight. The paper
enumerates all h! orders. Held and Karp's recursion over subsets finds the same optimum: the cost of a
step into a sample depends on the sample before and on that sample alone.
"""

import math
from collections.abc import Callable

import numpy as np

from kantor_agent.belief.belief import Belief
from kantor_agent.belief.sample_index import SampleIndex, nearest
from kantor_agent.planners.base import Goal
from kantor_protocol.base.kernels import kernel, typed
from kantor_protocol.base.machine import Pose
from kantor_protocol.replication.replica_kernels import NO_INDEX, claim, claimed_by_others


@kernel
def first_of_best_order(
    xy_m: np.ndarray,
    weights: np.ndarray,
    x: float,
    y: float,
    near: np.ndarray,
    count: int,
    cost_to_go: np.ndarray,
) -> int:
    """The index in near[:count] of the sample that begins the cheapest order by eq. 2; of equal ones the nearer.

    cost_to_go: (2^h, h) float64 scratch; [s, j] is the least cost of what follows when the set s of
    samples is still to be visited and the robot is at sample j.
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
    all_samples = (1 << count) - 1
    for at in range(count):
        dx = xy_m[near[at], 0] - x
        dy = xy_m[near[at], 1] - y
        cost = math.sqrt(dx * dx + dy * dy) / weights[near[at]]
        cost += cost_to_go[all_samples ^ (1 << at), at]
        if cost < best:
            best, first = cost, at
    return first


@kernel
def choose_sample(
    grid: SampleIndex,
    weights: np.ndarray,
    x: float,
    y: float,
    skip: np.ndarray,
    best: np.ndarray,
    near: np.ndarray,
    cost_to_go: np.ndarray,
) -> int:
    """The goal of eq. 2-3 among samples that are not in `skip`, or NO_INDEX."""
    count = nearest(grid, x, y, skip, best, near)
    if count == 0:
        return NO_INDEX
    return near[first_of_best_order(grid.xy_m, weights, x, y, near, count, cost_to_go)]


@kernel
def _choose(
    xy_m: np.ndarray,
    order: np.ndarray,
    cell: np.ndarray,
    first: np.ndarray,
    alive: np.ndarray,
    frame: np.ndarray,
    levels: int,
    weights: np.ndarray,
    claims: np.ndarray,
    counters: np.ndarray,
    held: np.ndarray,
    me: int,
    best: np.ndarray,
    near: np.ndarray,
    cost_to_go: np.ndarray,
    x: float,
    y: float,
    now_ns: int,
) -> tuple[int, float, float]:
    """The goal and its position, for calls from Python; see `Transport.choose`.

    held: scratch for the samples that others have claimed. me: NO_INDEX in a mission without claims.
    """
    grid = SampleIndex(xy_m, order, cell, first, alive, frame, levels)
    skip = held[: claimed_by_others(claims, counters, me, held) if me != NO_INDEX else 0]
    sample = choose_sample(grid, weights, x, y, skip, best, near, cost_to_go)
    if sample == NO_INDEX and skip.shape[0] > 0:
        sample = choose_sample(grid, weights, x, y, skip[:0], best, near, cost_to_go)
    if me != NO_INDEX:
        claim(claims, counters, me, sample, now_ns)
    if sample == NO_INDEX:
        return NO_INDEX, x, y
    return sample, xy_m[sample, 0], xy_m[sample, 1]


class Transport:
    """The planner `transport` of Algorithms 1-3, with claims if the mission has them."""

    def __init__(self, horizon: int) -> None:
        """horizon: h, samples in one plan."""
        self._scratch = (
            np.zeros(horizon, dtype=np.float64),
            np.zeros(horizon, dtype=np.int64),
            np.zeros((1 << horizon, horizon), dtype=np.float64),
        )
        self._choose: Callable[..., tuple[int, float, float]] | None = None
        """`_choose` for a robot's belief, from the first choice on."""

    def choose(self, belief: Belief, pose: Pose, now_ns: int, /) -> Goal | None:
        """The first sample of the best order; one that another robot has claimed only if all are claimed."""
        arguments = (*belief.to_choose, *self._scratch, pose.x_m, pose.y_m, now_ns)
        if self._choose is None:
            self._choose = typed(_choose, *arguments)
        sample, x_m, y_m = self._choose(*arguments)
        return None if sample == NO_INDEX else Goal(x_m, y_m, sample)
