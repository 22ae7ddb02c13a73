"""The truth: where robots and targets are, who has energy left, what was consumed and found."""

import math
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_protocol.keyed import Purpose
from kantor_protocol.machine import SUPERVISOR, Observation, Outputs, ParticipantId, Pose
from kantor_protocol.packing import sum_pairs
from kantor_protocol.scenario import Scenario
from kantor_protocol.walk import Walk
from kantor_protocol.weights import Units
from kantor_worldsim.density import samples_of, starts_of, targets_of
from kantor_worldsim.maps import Ground
from kantor_worldsim.sensors import sense_targets

Found = tuple[int, float, float]
"""A target with the place where it was found."""

SPEED_TOLERANCE = 1e-6
"""Relative, on the length of one move: rounding, no more."""


class Site(NamedTuple):
    """What a mission starts from, drawn from scenario and seed. All in the world frame, metres."""

    samples_m: npt.NDArray[np.float64]
    """(N, 2)"""
    targets_m: npt.NDArray[np.float64]
    """(T, 2)"""
    starts_m: npt.NDArray[np.float64]
    """(n, 2)"""
    ground: Ground | None = None
    """The true map, in a mission with one."""

    @classmethod
    def of(cls, scenario: Scenario, seed: int) -> "Site":
        """Raises ScenarioError for a file that is no use."""
        return cls(
            samples_of(scenario, seed), targets_of(scenario, seed), starts_of(scenario, seed)
        )


class Ruling(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """What the world made of a participant's step."""

    pose: Pose
    """Where it now truly is."""
    found: tuple[Found, ...] = ()
    violations: tuple[str, ...] = ()
    """Rules it broke: `step`, `speed`, `energy`, `units`. The offending part had no effect."""
    bumps: int = 0
    """On a map: whether the move ended at a wall."""


class _Body:
    """A participant as the world knows it."""

    def __init__(self, pose: Pose) -> None:
        self.pose = pose
        self.step = 0
        self.moved_ns = 0
        self.energy_spent = 0
        self.found: list[int] = []


class World:
    """Accepts what participants do, as far as the rules allow."""

    def __init__(self, scenario: Scenario, seed: int, site: Site) -> None:
        self.found = np.zeros(site.targets_m.shape[0], dtype=bool)
        self._targets = Walk(
            site.targets_m,
            scenario.targets.diffusion_m,
            scenario.period_ns,
            seed,
            Purpose.TARGET_WALK,
        )
        self._units = Units.of(scenario.energy.points, site.samples_m.shape[0])
        self._samples = site.samples_m.shape[0]
        self._budget = scenario.steps_per_robot
        self._speed_m_s = scenario.vehicle.speed_m_s
        self._range_m = scenario.sensor.range_m
        self._room = np.zeros(site.targets_m.shape[0], dtype=np.int64)
        self._bodies = {
            name: _Body(Pose(float(x), float(y)))
            for name, (x, y) in zip(scenario.robot_ids, site.starts_m, strict=True)
        }
        if scenario.centralized:
            self._bodies[SUPERVISOR] = _Body(Pose(*scenario.supervisor_m))

    def pose(self, name: ParticipantId) -> Pose:
        """Where a participant truly is."""
        return self._bodies[name].pose

    def first_look(self) -> dict[ParticipantId, tuple[Found, ...]]:
        """What the robots see at time 0, before anybody moves."""
        return {name: self._sense(name) for name in self._bodies if name != SUPERVISOR}

    def observe(self, name: ParticipantId) -> Observation:
        """What the world tells a participant; its finds are told once."""
        body = self._bodies[name]
        found, body.found = tuple(body.found), []
        return Observation(step=body.step, pose=body.pose, detected=found)

    def accept(self, name: ParticipantId, now_ns: int, outputs: Outputs) -> Ruling:
        """Judge a step that was made at `now_ns` and let its sound parts happen."""
        body = self._bodies[name]
        if outputs.step <= body.step or now_ns < body.moved_ns:
            return Ruling(pose=body.pose, violations=("step",))
        violations = [] if self._moves(name, body, now_ns, outputs.pose) else ["speed"]
        if outputs.spent:
            violations += self._spend(body, outputs.spent)
        body.step, body.moved_ns = outputs.step, now_ns
        self._targets.advance(now_ns)
        found = self._sense(name) if name != SUPERVISOR else ()
        return Ruling(pose=body.pose, found=found, violations=tuple(violations))

    def _moves(self, name: ParticipantId, body: _Body, now_ns: int, pose: Pose) -> bool:
        limit_m = 0.0 if name == SUPERVISOR else self._speed_m_s * (now_ns - body.moved_ns) * 1e-9
        way_m = math.hypot(pose.x_m - body.pose.x_m, pose.y_m - body.pose.y_m)
        if not way_m <= limit_m * (1.0 + SPEED_TOLERANCE):  # nor to nowhere
            return False
        body.pose = pose
        return True

    def _spend(self, body: _Body, spent: bytes) -> list[str]:
        if not 0 < sum_pairs(spent, self._samples) <= self._units.point:
            return ["units"]
        if body.energy_spent >= self._budget:
            return ["energy"]
        body.energy_spent += 1
        return []

    def _sense(self, name: ParticipantId) -> tuple[Found, ...]:
        body = self._bodies[name]
        targets_m = self._targets.xy_m
        count = sense_targets(
            targets_m, self.found, body.pose.x_m, body.pose.y_m, self._range_m, self._room
        )
        if not count:
            return ()
        indices = self._room[:count].tolist()
        body.found += indices
        return tuple((i, float(targets_m[i, 0]), float(targets_m[i, 1])) for i in indices)
