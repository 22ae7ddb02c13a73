"""The robot that explores an unknown map: one pure state machine.

A step: take in the inbox and the observation; decide on what is known to all in contact; add the scan to
the own layer; move; publish. What the scan of this step shows is published with it, so that the next
decision of every robot rests on the same knowledge, one step old, as the supervisor's does.
"""

import math

import numpy as np

from kantor_agent.coordination.assignment import (
    CELL,
    TARGET,
    Assignment,
    ContactLimits,
    assigned_target,
    robot_register,
    visible_team,
)
from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.mapping.navigation import Navigator
from kantor_agent.mapping.pursuit import Pursuit, wall_met
from kantor_agent.planners.map_base import Task, TeamMember
from kantor_agent.vehicles import VEHICLES, StepTimer
from kantor_protocol.base.grid import NOWHERE, Frame
from kantor_protocol.base.machine import (
    Body,
    Inputs,
    Observation,
    Outputs,
    ParticipantId,
    Pose,
    State,
)
from kantor_protocol.replication.gossip import Gossip, build_replica
from kantor_protocol.replication.occupancy_log import (
    OccupancyLog,
    bump,
    dead_frontier,
    entries,
    given_up_frontier,
    retried_frontier,
)
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Identities

_REST_STEPS, _NOISY_REST_STEPS = 3, 30
"""Steps in a row without a frontier that can be reached, after which a robot rests."""
_NOISY_LOOKS = 10
"""Scans at a target after which a robot that sees badly has looked around; one that sees well needs one."""
_SHARP_CELLS = 1 / 6
"""The noise up to which a robot sees well: three times as much is half a cell, which scans allow for."""


class MappingRobot:
    """A robot of a scenario with a map. `step` is its only entrance."""

    def __init__(
        self,
        me: ParticipantId,
        scenario: Scenario,
        seed: int,
        body: Body,
        frame: Frame,
        identities: Identities | None = None,
    ) -> None:
        """body: the one that the robot takes over. frame: how the cells lie, not what is in them.

        identities: see Gossip.
        """
        self._me = scenario.roster.index(me)
        self._frame = frame
        self._robots = scenario.robots.count
        self._replica = build_replica(me, scenario, None, entries(frame), body.incarnation)
        self._gossip = Gossip(me, scenario, body.incarnation, identities)
        self._fused_map = FusedMap(frame, self._replica.origins)
        """Of `_replica`, as far as its logs have been folded."""
        self._cost_map = CostMap(scenario, self._fused_map)
        self._occupancy = OccupancyLog(frame, scenario.sensor, ranges=scenario.learns_ranges)
        self._assignment = Assignment(scenario, self._cost_map, seed, self._me)
        self._navigator = Navigator(self._cost_map)
        self._vehicle = VEHICLES[scenario.vehicle.name](scenario.vehicle)
        self._clearance_cells = 2.0 * scenario.vehicle.radius_m / frame.resolution_m
        self._supervisor = scenario.robots.count if scenario.centralized else None
        self._period_ns = scenario.period_ns
        self._contact_limits = ContactLimits.of(scenario, scenario.period_ns)
        self._timer = StepTimer(scenario.period_ns, body)
        self._now_ns = 0
        self._step, self._pose = body.step, body.pose
        sharp = scenario.sensor.noise_m <= _SHARP_CELLS * frame.resolution_m
        self._rest_steps = _REST_STEPS if sharp else _NOISY_REST_STEPS
        self._looks_needed = 1 if sharp else _NOISY_LOOKS
        self._looks = 0
        """Scans in a row that were made at the target."""
        self._explores_until = body.step + self._rest_steps
        """A new incarnation knows nothing yet and does not rest before this step."""
        self._scanned_step = -1
        self._scanned_pose: Pose | None = None
        self._task, self._since, self._arrived = Task(), 0, False
        """The present task, its tick, and whether the robot stands on its target and has looked around.

        After a step the own register says the same. The task of a robot that rests has no target.
        """
        self._departed = body.pose
        """The pose that world-sim accepted last, from which the last step drove off to `_pose`."""
        self._pursuit = Pursuit(scenario.planner.patience)
        """Of the target of `_task`."""
        self._tried_again: set[int] = set()
        """Frontiers that were given up and that this robot has tried again; each once."""
        self._idle_steps = 0
        """Steps in a row in which no frontier could be reached."""
        self._resting = False

    def step(self, inputs: Inputs, /) -> Outputs:
        """One step; see the module."""
        self._gossip.receive(inputs.inbox, self._replica)
        self._locate(inputs.observation)
        elapsed_s = self._timer.elapsed_s(inputs.now_ns)
        self._now_ns, self._step = inputs.now_ns, self._step + 1
        self._fused_map.fold(self._replica)
        self._give_up()
        if not self._resting:
            self._decide()
        self._look(inputs.observation)
        if not self._resting:
            self._move(elapsed_s)
        return self._publish()

    @property
    def replica(self) -> Replica:
        """What it knows of all participants; for reading."""
        return self._replica

    def validate(self) -> None:
        """Assert what the parts say of themselves and of one another; true between two steps."""
        self._replica.validate()
        self._gossip.validate(self._replica)
        self._fused_map.validate(self._replica)
        self._cost_map.validate()
        assert not (self._resting and self._task.target != NOWHERE)
        assert self._resting or not self._arrived or self._is_at(self._task.target)
        registers = self._replica.registers
        if registers.stamps[registers.me] > 0:
            numbers = self._own_register()
            assert registers.values[registers.me, : len(numbers)].tolist() == numbers
            assert not registers.values[registers.me, len(numbers) :].any()

    @property
    def _tick(self) -> int:
        return self._now_ns // self._period_ns

    def _locate(self, observation: Observation) -> None:
        """Take the pose that world-sim accepted. A late observation, of an older step, changes nothing."""
        if observation.step != self._step:
            return
        start, stop = self._departed, observation.pose
        moved_m = math.hypot(stop.x_m - start.x_m, stop.y_m - start.y_m)
        turned_rad = stop.heading_rad - start.heading_rad
        cells = moved_m / self._frame.resolution_m
        self._pursuit.drive(cells, turned_rad, bumped=observation.bumped)
        if observation.bumped:
            self._tell_of_wall(stop)
        self._pose = self._departed = stop

    def _tell_of_wall(self, stop: Pose) -> None:
        """Log the wall that has stopped the last move."""
        wall = wall_met(self._frame, self._departed, self._pose, stop)
        if wall != NOWHERE and not self._fused_map.bumps[wall]:
            self._replica.append(np.array([bump(self._frame, wall)]))

    # Deciding.

    def _give_up(self) -> None:
        """Log a target that showed nothing new as a dead frontier; give one up to which the robot does not get."""
        target = self._task.target
        if target == NOWHERE or self._fused_map.is_abandoned(target):
            return
        if self._arrived and self._fused_map.is_frontier(target):
            self._replica.append(np.array([dead_frontier(self._frame, target)]))
        elif not self._arrived and self._pursuit.is_vain:
            self._replica.append(np.array([given_up_frontier(self._frame, target)]))
            self._pursuit.begin()

    def _decide(self) -> None:
        """Take a new task, from the supervisor if it is in contact; rest when no frontier can be reached."""
        registers = self._replica.registers
        supervisor = None if self._supervisor is None else registers.newest(self._supervisor)
        if (
            supervisor is not None
            and 0 <= registers.age_steps(supervisor) <= self._contact_limits.contact_timeout_steps
        ):
            self._follow(assigned_target(registers.values[supervisor], self._me, self._frame.cells))
        elif registers.stamps[registers.me] > 0:
            self._assign()
        self._idle_steps = 0 if self._may_go_on() else self._idle_steps + 1
        if self._idle_steps >= self._rest_steps and self._try_again():
            self._idle_steps = 0
        self._resting = self._idle_steps >= self._rest_steps

    def _try_again(self) -> bool:
        """Try the frontiers that were given up and to which there is a way now; whether there are any."""
        frontiers = self._fused_map.given_up_frontiers()
        cell = self._frame.cell_of(self._pose.x_m, self._pose.y_m)
        reachable = frontiers[np.isfinite(self._cost_map.travel(cell, frontiers))]
        again = [each for each in reachable.tolist() if each not in self._tried_again]
        self._tried_again.update(again)
        if again:
            self._replica.append(np.array([retried_frontier(self._frame, each) for each in again]))
        return bool(again)

    def _follow(self, target: int) -> None:
        """Take the target that the supervisor has assigned."""
        if target != self._task.target:
            self._adopt(Task(target))

    def _assign(self) -> None:
        """Assign tasks to the visible team and take the own one."""
        registers = self._replica.registers
        team, absent = visible_team(
            registers, self._robots, self._frame, self._tick, self._contact_limits
        )
        task = self._assignment.decide(team, absent, self._tick).get(self._me)
        if task is not None:
            self._adopt(task)

    def _adopt(self, task: Task) -> None:
        if task.target != self._task.target:
            self._arrived, self._looks = False, 0
            self._pursuit.begin()
        self._task, self._since = task, self._tick

    def _may_go_on(self) -> bool:
        """Whether there may still be a frontier for this robot."""
        if self._step <= self._explores_until:
            return True
        if self._task.target != NOWHERE and self._fused_map.is_frontier(self._task.target):
            return True
        cell = self._frame.cell_of(self._pose.x_m, self._pose.y_m)
        return self._cost_map.reaches_frontier(cell)

    # Acting.

    def _look(self, observation: Observation) -> None:
        """Add the scan to the own log, once; it is folded into the map in the next step."""
        if observation.step != self._scanned_step:
            self._scanned_step = observation.step
            moved = observation.pose != self._scanned_pose
            self._scanned_pose = observation.pose
            self._replica.append(
                self._occupancy.observe(observation.scan, observation.pose, moved=moved)
            )
        at_target = self._task.target != NOWHERE and self._is_at(self._task.target)
        self._looks = self._looks + 1 if at_target else 0
        self._arrived = self._looks >= self._looks_needed

    def _is_at(self, cell: int) -> bool:
        """Whether the robot is in the cell itself: from beside it, what lies behind it may be hidden."""
        return self._frame.cell_of(self._pose.x_m, self._pose.y_m) == cell

    def _move(self, dt_s: float) -> None:
        if self._task.target == NOWHERE or self._arrived or self._gives_way():
            return
        place = self._navigator.head(self._pose, self._task.target)
        if place is None:
            self._pursuit.miss()
            return
        self._pursuit.follow(self._navigator.left_cells)
        self._pose = self._vehicle.drive(self._pose, *place, dt_s)

    def _gives_way(self) -> bool:
        """Whether a robot in contact of a lower place, on the way to the same target, is too close: it goes first.

        Bodies do not merge. Points would, at the next bend, and would then move as one for ever.
        """
        if self._clearance_cells == 0.0:
            return False
        registers = self._replica.registers
        values = registers.values
        here = int(values[registers.me, CELL]) - 1
        return any(
            values[origin, TARGET] == self._task.target + 1
            and registers.age_steps(origin) <= self._contact_limits.contact_timeout_steps
            and self._cost_map.cells_between(int(values[origin, CELL]) - 1, here)
            <= self._clearance_cells
            for origin in map(registers.newest, range(self._me))
        )

    def _publish(self) -> Outputs:
        if self._resting:
            self._task = Task()
        self._replica.registers.write(self._own_register())
        envelope = self._gossip.compose(self._replica, self._step, self._pose, final=self._resting)
        self._replica.end_step()
        target = self._task.target
        return Outputs(
            step=self._step,
            pose=self._pose,
            goal=None if target == NOWHERE else self._frame.centre_of(target),
            outbox=(envelope,),
            state=State.FINISHED if self._resting else State.EXPLORING,
            refused=self._gossip.refused,
        )

    def _own_register(self) -> list[int]:
        cell = self._frame.cell_of(self._pose.x_m, self._pose.y_m)
        me = TeamMember(self._me, cell, self._task, self._since, self._arrived)
        return robot_register(me, resting=self._resting)
