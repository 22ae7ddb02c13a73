"""CPU time of one planner step: choose, order, move, consume.

The work of a robot in a step of Algorithm 1: the goal by its belief, a step of the first-order
vehicle, one point shipped by Proposition 1 and logged. The robot runs a real mission on section VI-A's density with M = 2.5 N.

It is compared, from the same state, with the literal algorithm of the paper in numpy: distances to all
samples that have weight, the h nearest, all h! orders, and the linear program by repeated search for
the nearest. Both must choose the same goals.
"""

import itertools
import statistics
import time
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from tables import Table, verdict

from kantor_agent.belief.belief import Belief
from kantor_agent.planners.registry import PLANNERS
from kantor_agent.vehicles import VEHICLES
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.machine import Pose
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.replication.gossip import build_replica
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.weights import Units
from kantor_worldsim.world.density import samples_of, starts_of

SIZES = (2_000, 20_000, 200_000, 1_000_000)
SIZES_QUICK = (2_000, 200_000)
TARGETS = {2_000: 30.0, 20_000: 250.0, 200_000: 2_500.0, 1_000_000: 14_000.0}
"""By N: so many times as fast as the literal algorithm."""
FLAT_MAX = 2.0
"""The most expensive cell of the table may cost so many times the cheapest."""
PHASES = (0.0, 0.5, 0.9)
"""Shares of the mission done when measuring begins."""
CHUNK = 50
"""Steps between two readings of the clock."""
CHUNKS = 80


class Literal:
    """Algorithm 1 as printed, for one robot; N float weights in units."""

    def __init__(self, xy_m: npt.NDArray[np.float64], weights: npt.NDArray[np.int64]) -> None:
        """The arrays are not written to."""
        self._xy_m = xy_m
        self._weights = weights.astype(np.float64)

    def step(self, pose: Pose, horizon: int, stride_m: float, point: int) -> tuple[int, Pose]:
        """Eq. 2-3, 16 and Proposition 1: the goal's sample and the new pose."""
        at = np.array([pose.x_m, pose.y_m])
        near = self._nearest(at, horizon)
        goal = min(itertools.permutations(near.tolist()), key=lambda order: self._cost(at, order))[
            0
        ]
        way = self._xy_m[goal] - at
        distance_m = float(np.linalg.norm(way))
        at = self._xy_m[goal] if distance_m <= stride_m else at + stride_m / distance_m * way
        left = float(point)
        while left > 0.0 and self._weights.any():
            sample = self._nearest(at, 1)[0]
            shipped = min(left, self._weights[sample])
            self._weights[sample] -= shipped
            left -= shipped
        return goal, Pose(float(at[0]), float(at[1]))

    def _nearest(self, at: npt.NDArray[np.float64], count: int) -> npt.NDArray[np.int64]:
        alive = np.flatnonzero(self._weights > 0.0)
        distances = np.linalg.norm(self._xy_m[alive] - at, axis=1)
        count = min(count, alive.size)
        some = np.argpartition(distances, count - 1)[:count]
        return alive[some[np.argsort(distances[some])]]

    def _cost(self, at: npt.NDArray[np.float64], order: tuple[int, ...]) -> float:
        cost = 0.0
        for sample in order:
            cost += float(np.linalg.norm(self._xy_m[sample] - at)) / self._weights[sample]
            at = self._xy_m[sample]
        return cost


class Mission:
    """A mission of one robot by the work that a robot does between its messages."""

    def __init__(self, scenario: Scenario, samples_m: npt.NDArray[np.float64]) -> None:
        """samples_m: (N, 2) world frame."""
        count = samples_m.shape[0]
        self.units = Units.of(scenario.energy.points, count)
        self.replica = build_replica("r1", scenario, self.units, count)
        walk = RandomWalk(samples_m, 0.0, scenario.period_ns, 0, Purpose.SAMPLE_WALK)
        self.belief = Belief(walk, self.units, self.replica)
        self.planner = PLANNERS[scenario.planner.name](scenario)
        self.pose = Pose(*starts_of(scenario, 0)[0].tolist())
        self._vehicle = VEHICLES["first-order"](scenario.vehicle)
        self._dt_s = scenario.clock.period_s
        self._period_ns = scenario.period_ns
        self._now_ns = 0

    def advance(self, steps: int) -> None:
        """Planner steps without messages."""
        belief, replica, pose, now_ns = self.belief, self.replica, self.pose, self._now_ns
        choose, drive, dt_s = self.planner.choose, self._vehicle.drive, self._dt_s
        for _ in range(steps):
            now_ns += self._period_ns
            goal = choose(belief, pose, now_ns)
            if goal is not None:
                pose = drive(pose, goal.x_m, goal.y_m, dt_s)
            belief.spend(pose.x_m, pose.y_m)
            replica.end_step()
        self.pose, self._now_ns = pose, now_ns


class Beside(NamedTuple):
    """The literal algorithm from the same state."""

    us: float
    steps: int
    same: int
    """Steps with the same goal."""


def measure(*, quick: bool) -> Table:
    """CPU microseconds per step by N and by the share of the mission that is done."""
    rows, costs, met = [], [], True
    for count in SIZES_QUICK if quick else SIZES:
        scenario = _scenario(count, claims=False)
        samples_m = samples_of(scenario, 0)
        medians = _phases(scenario, samples_m)
        with_claims = _phases(_scenario(count, claims=True), samples_m, PHASES[:1])[0]
        beside = _beside(scenario, samples_m)
        target, ratio = TARGETS[count], beside.us / medians[0]
        costs += medians
        reached = ratio >= target
        met = met and reached and beside.same == beside.steps
        rows.append(
            (
                f"{count:,}",
                *(f"{cost:.2f}" for cost in medians),
                f"{with_claims:.2f}",
                f"{beside.us:,.0f}",
                f"{ratio:,.0f}",
                f"{target:,.0f}",
                verdict(met=reached),
                f"{beside.same}/{beside.steps}",
            )
        )
    flat = max(costs) / min(costs)
    return Table(
        "planner: CPU us per step (choose, order, move, consume), medians",
        (
            "N",
            "fresh",
            "half used up",
            "90 % used up",
            "fresh, claims",
            "literal numpy",
            "ratio",
            "target",
            "",
            "same goals",
        ),
        rows,
        (f"dearest / cheapest: {flat:.2f}, target {FLAT_MAX:g}: {verdict(met=flat <= FLAT_MAX)}",),
        met and flat <= FLAT_MAX,
    )


def _scenario(count: int, *, claims: bool) -> Scenario:
    overrides = (
        f"samples.count={count}",
        f"energy.points={count * 5 // 2}",
        "merge=ledger",
        f"claims={str(claims).lower()}",
        "planner.horizon=3",
    )
    return find("paper-single", overrides)


def _phases(
    scenario: Scenario, samples_m: npt.NDArray[np.float64], phases: tuple[float, ...] = PHASES
) -> list[float]:
    """The median over chunks in each phase; a short mission is run several times."""
    chunks: list[list[float]] = [[] for _ in phases]
    each = min(CHUNKS, scenario.energy.points // 20 // CHUNK)
    warm = Mission(scenario, samples_m)
    warm.advance(CHUNK)
    while len(chunks[0]) < CHUNKS:
        mission, done = Mission(scenario, samples_m), 0
        for phase, costs in zip(phases, chunks, strict=True):
            begin = round(phase * scenario.energy.points)
            mission.advance(begin - done)
            costs += [_cpu_us(mission) for _ in range(each)]
            done = begin + each * CHUNK
    return [statistics.median(costs) for costs in chunks]


def _cpu_us(mission: Mission) -> float:
    start_ns = time.process_time_ns()
    mission.advance(CHUNK)
    return (time.process_time_ns() - start_ns) / CHUNK / 1e3


def _beside(scenario: Scenario, samples_m: npt.NDArray[np.float64]) -> Beside:
    """The literal algorithm's first steps compared with kantor's."""
    steps = 100 if samples_m.shape[0] <= 20_000 else 5
    mission = Mission(scenario, samples_m)
    literal = Literal(samples_m, mission.belief.weights)
    stride_m = scenario.vehicle.speed_m_s * scenario.clock.period_s
    same, costs, pose = 0, [], mission.pose
    for _ in range(steps):
        ours = mission.planner.choose(mission.belief, mission.pose, 0)
        start_ns = time.process_time_ns()
        goal, pose = literal.step(pose, scenario.planner.horizon, stride_m, mission.units.point)
        costs.append((time.process_time_ns() - start_ns) / 1e3)
        same += ours is not None and goal == ours.sample
        mission.advance(1)
    return Beside(statistics.median(costs), steps, same)
