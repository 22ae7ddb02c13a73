"""The truth: poses of robots and targets, energy that was spent, and targets that were found."""

import math
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.grid import FREE, NOWHERE, free_way
from kantor_protocol.base.kernels import typed
from kantor_protocol.base.machine import SUPERVISOR, Body, Observation, Outputs, ParticipantId, Pose
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.base.varint import sum_pairs
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.file_names import path_of
from kantor_protocol.scenario.schema import Domain, Scenario
from kantor_protocol.wire.weights import Units
from kantor_worldsim.world.density import doubts_about_images, samples_of, starts_of, targets_of
from kantor_worldsim.world.feasibility import doubts_of_density, doubts_of_map
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.sensors import RangeFinder, sense_targets, sense_targets_in_sight

Found = tuple[int, float, float]
"""A target (index) with the position (x, y) where it was found."""

SPEED_TOLERANCE = 1e-6
"""Relative tolerance on the length of one move, for rounding alone."""

_ROUNDINGS = 4.0
"""Coordinates are rounded so often from one pose to the next. Far from the origin that can be more than a move."""

STANDOFF_CELLS = 1 / 64
"""Distance, in cells along its way, at which a robot stops before a wall."""


class WorldSetup(NamedTuple):
    """Initial truth of a mission, from scenario and seed. World frame, metres."""

    samples_m: npt.NDArray[np.float64]
    """(N, 2)"""
    targets_m: npt.NDArray[np.float64]
    """(T, 2)"""
    starts_m: npt.NDArray[np.float64]
    """(n, 2)"""

    ground: Ground | None = None
    """The true map, if the robots explore one. There are no samples then."""
    warnings: tuple[str, ...] = ()
    """Doubts about the files that it was read from and about the scenario, one line each."""

    @classmethod
    def of(cls, scenario: Scenario, seed: int) -> "WorldSetup":
        """Draw and read everything that a scenario starts from. Raises ScenarioError for an unusable file."""
        if scenario.mapping:
            return cls._of_map(scenario, seed)
        samples_m = samples_of(scenario, seed)
        doubts = (*doubts_about_images(scenario), *doubts_of_density(scenario, samples_m))
        targets_m, starts_m = targets_of(scenario, seed), starts_of(scenario, seed)
        return cls(samples_m, targets_m, starts_m, warnings=doubts)

    @classmethod
    def _of_map(cls, scenario: Scenario, seed: int) -> "WorldSetup":
        from kantor_worldsim.world.starts import starts_on  # noqa: PLC0415  only where there is a map

        ground, warnings = ground_of(scenario)
        starts = scenario.starts
        starts_m = starts_on(
            ground,
            poses_m=starts.poses_m,
            random=starts.random,
            spread=starts.spread,
            spots=starts.spots,
            count=scenario.robots.count,
            seed=seed,
        )
        left_m, right_m, bottom_m, top_m = ground.frame.extent_m
        over_map = Domain(min_m=(left_m, bottom_m), max_m=(right_m, top_m))
        targets_m = targets_of(msgspec.structs.replace(scenario, domain=over_map), seed)
        warnings += doubts_about_images(scenario)
        warnings += doubts_of_map(scenario, ground, starts_m)
        return cls(np.zeros((0, 2)), targets_m, starts_m, ground, tuple(warnings))

    def poses(self, scenario: Scenario) -> dict[ParticipantId, Pose]:
        """Pose of every participant at time 0."""
        robots = zip(scenario.robot_ids, self.starts_m.tolist(), strict=True)
        poses = {name: Pose(x_m, y_m) for name, (x_m, y_m) in robots}
        if scenario.centralized:
            poses[SUPERVISOR] = Pose(*scenario.supervisor_m)
        return poses


def ground_of(scenario: Scenario) -> tuple[Ground, list[str]]:
    """The true map of a scenario that has one, and warnings about its file. Raises ScenarioError."""
    from kantor_worldsim.world.layouts import layout  # noqa: PLC0415  only where there is a map
    from kantor_worldsim.world.maps import read  # noqa: PLC0415

    options = scenario.map
    assert options is not None
    if options.file is not None:
        return read(path_of(options.file), options.resolution_m)
    assert options.layout is not None
    return layout(options.layout, options.size_m, options.resolution_m, options.seed), []


def doubts_about(scenario: Scenario) -> list[str]:
    """Warnings about the files of a scenario, which are the same for every seed. Raises ScenarioError."""
    of_map = ground_of(scenario)[1] if scenario.mapping else []
    return [*of_map, *doubts_about_images(scenario)]


def units_of(scenario: Scenario, samples: int) -> Units:
    """Units of mass of a run with a number of samples; none in a mission with a map."""
    return Units(0, 0, 0) if scenario.mapping else Units.of(scenario.energy.points, samples)


class StepVerdict(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The world's verdict on a step."""

    pose: Pose
    """The true pose after the step."""
    found: tuple[Found, ...] = ()
    violations: tuple[str, ...] = ()
    """Rules that the step broke: `step`, `speed`, `energy`, `units`. That part of the step has no effect."""
    bumped: bool = False
    """The move ended at a wall, which breaks no rule."""


class _Body:
    """The true state of a participant."""

    def __init__(self, pose: Pose) -> None:
        self.pose = pose
        self.step = 0
        self.incarnation = 0
        self.moved_ns = 0
        self.energy_spent = 0
        self.found: tuple[int, ...] = ()
        self.scan = b""
        self.bumped = False


class World:
    """Accepts the steps of participants, as far as the rules of motion and energy allow."""

    def __init__(self, scenario: Scenario, seed: int, setup: WorldSetup) -> None:
        self.found = np.zeros(setup.targets_m.shape[0], dtype=bool)
        self._targets = RandomWalk(
            setup.targets_m,
            scenario.targets.diffusion_m,
            scenario.period_ns,
            seed,
            Purpose.TARGET_WALK,
        )
        self._units = units_of(scenario, setup.samples_m.shape[0])
        self._samples = setup.samples_m.shape[0]
        self._budget = scenario.steps_per_robot
        self._speed_m_s = scenario.vehicle.speed_m_s
        self._room = np.zeros(setup.targets_m.shape[0], dtype=np.int64)
        self._bodies = {name: _Body(pose) for name, pose in setup.poses(scenario).items()}
        self._ground = setup.ground
        self._sum_pairs = typed(sum_pairs, b"", self._samples)
        self._to_look: tuple[Any, ...] = (
            *(self._targets.xy_m, self.found),
            *(scenario.sensor.range_m, self._room),
        )
        """Arguments of `_look`, which end with a place."""
        look: Any = sense_targets
        if setup.ground is not None:
            frame, cells = setup.ground
            self._to_look = (cells, *frame.origin_m, frame.resolution_m, *self._to_look)
            look = sense_targets_in_sight
        self._look = typed(look, *self._to_look, 0.0, 0.0)
        if setup.ground is not None:
            self._range_finder = RangeFinder(scenario.sensor, setup.ground, seed)
            self._places = {name: i for i, name in enumerate(scenario.robot_ids)}
            for name in scenario.robot_ids:
                self._enter(name, self._bodies[name])

    def pose(self, name: ParticipantId) -> Pose:
        """True pose of a participant."""
        return self._bodies[name].pose

    def first_look(self) -> dict[ParticipantId, tuple[Found, ...]]:
        """Targets that robots detect at time 0, before the first step."""
        return {name: self._sense(name) for name in self._bodies if name != SUPERVISOR}

    def observe(self, name: ParticipantId) -> Observation:
        """Observation of a participant after its last step, or at the start."""
        body = self._bodies[name]
        return Observation(body.step, body.pose, body.found, body.scan, body.bumped)

    def body(self, name: ParticipantId) -> Body:
        """State of a participant that a process needs to take it over."""
        body = self._bodies[name]
        return Body(body.pose, body.step, body.energy_spent, body.incarnation)

    def begin(self, name: ParticipantId, incarnation: int) -> bool:
        """Set the incarnation that acts from now on; returns whether it is a new one."""
        body = self._bodies[name]
        is_new, body.incarnation = incarnation != body.incarnation, incarnation
        return is_new

    def accept(self, name: ParticipantId, now_ns: int, outputs: Outputs) -> StepVerdict:
        """Check a step that was made at `now_ns`, and apply the parts that break no rule."""
        body = self._bodies[name]
        if outputs.step <= body.step or now_ns < body.moved_ns:
            return StepVerdict(pose=body.pose, violations=("step",))
        body.bumped, body.found = False, ()
        violations = [] if self._moves(name, body, now_ns, outputs.pose) else ["speed"]
        if outputs.spent:
            violations += self._spend(body, outputs.spent)
        body.step, body.moved_ns = outputs.step, now_ns
        self._targets.advance(now_ns)
        if name == SUPERVISOR:
            return StepVerdict(body.pose, (), tuple(violations))
        if self._ground is not None:
            body.scan = self._range_finder.scan(self._places[name], body.step, body.pose)
        return StepVerdict(body.pose, self._sense(name), tuple(violations), body.bumped)

    def validate(self) -> None:
        """Assert the invariants of every participant's true state."""
        for body in self._bodies.values():
            assert body.step >= 0
            assert body.moved_ns >= 0
            assert body.incarnation >= 0
            assert 0 <= body.energy_spent <= self._budget
            assert math.isfinite(body.pose.x_m)
            assert math.isfinite(body.pose.y_m)
            assert all(self.found[target] for target in body.found)

    def _moves(self, name: ParticipantId, body: _Body, now_ns: int, pose: Pose) -> bool:
        limit_m = 0.0 if name == SUPERVISOR else self._speed_m_s * (now_ns - body.moved_ns) * 1e-9
        start = body.pose
        way_m = math.hypot(pose.x_m - start.x_m, pose.y_m - start.y_m)
        if limit_m > 0.0:
            limit_m *= 1.0 + SPEED_TOLERANCE
            if way_m > limit_m:
                limit_m += rounding_m(start)
        if not way_m <= limit_m:  # also for a pose that is not finite
            return False
        body.pose = pose
        if self._ground is not None and name != SUPERVISOR:
            body.pose, body.bumped = stopped(self._ground, start, pose)
        return True

    def _enter(self, name: ParticipantId, body: _Body) -> None:
        """Check that a robot starts in a free cell, and take its first scan."""
        assert self._ground is not None
        x_m, y_m = body.pose.x_m, body.pose.y_m
        if not is_free(self._ground, x_m, y_m):
            raise ScenarioError(f"starts: {name} at ({x_m:g}, {y_m:g}) is in no free cell; move it")
        body.scan = self._range_finder.scan(self._places[name], 0, body.pose)

    def _spend(self, body: _Body, spent: bytes) -> list[str]:
        if not 0 < self._sum_pairs(spent, self._samples) <= self._units.point:
            return ["units"]
        if body.energy_spent >= self._budget:
            return ["energy"]
        body.energy_spent += 1
        return []

    def _sense(self, name: ParticipantId) -> tuple[Found, ...]:
        if not self.found.size:
            return ()
        body, targets_m = self._bodies[name], self._targets.xy_m
        count = self._look(*self._to_look, body.pose.x_m, body.pose.y_m)
        if not count:
            return ()
        indices = self._room[:count].tolist()
        body.found += tuple(indices)
        return tuple((i, float(targets_m[i, 0]), float(targets_m[i, 1])) for i in indices)


def rounding_m(pose: Pose) -> float:
    """What the rounding of coordinates may add to the length of a move from a pose."""
    return _ROUNDINGS * math.ulp(max(abs(pose.x_m), abs(pose.y_m)))


def is_free(ground: Ground, x_m: float, y_m: float) -> bool:
    """Whether a position lies in a free cell."""
    cell = ground.frame.cell_of(x_m, y_m)
    return cell != NOWHERE and bool(ground.cells.flat[cell] == FREE)


def stopped(ground: Ground, start: Pose, end: Pose) -> tuple[Pose, bool]:
    """Pose at the end of a straight move from a free cell, and whether a wall ended it.

    A robot that meets a wall stops STANDOFF_CELLS before it, or stays where it was; it has turned.
    """
    frame, cells = ground
    dx, dy = end.x_m - start.x_m, end.y_m - start.y_m
    share = free_way(cells, FREE, *frame.uv(start.x_m, start.y_m), *frame.uv(end.x_m, end.y_m))
    if share >= 1.0 and is_free(ground, end.x_m, end.y_m):
        return end, False
    share -= STANDOFF_CELLS * frame.resolution_m / math.hypot(dx, dy)
    x_m, y_m = start.x_m + share * dx, start.y_m + share * dy
    if share <= 0.0 or not is_free(ground, x_m, y_m):
        x_m, y_m = start.x_m, start.y_m
    return Pose(x_m, y_m, end.heading_rad, 0.0), True
