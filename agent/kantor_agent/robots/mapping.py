"""A robot that explores an unknown map: one pure state machine.

A step: take in the inbox and the observation; decide on what is known to all in contact; add the scan to
the own layer; move; publish. What the scan of this step shows is published with it, so that the next
decision of everybody rests on the same knowledge, one step old, as the supervisor's does.
"""

import math

import numpy as np

from kantor_agent.coordination.assignment import (
    CELL,
    TARGET,
    Assignment,
    ProgressMonitor,
    order_in,
    register_of,
    visible_team,
)
from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.mapping.navigation import Navigator
from kantor_agent.planners.map_base import Member, Task
from kantor_agent.vehicles import LATER_NS, VEHICLES
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
from kantor_protocol.replication.occupancy_log import OccupancyLog, dead_frontier, entries
from kantor_protocol.scenario.schema import Scenario

_SURE_STEPS = 3
"""So many steps in a row without a frontier end the mission of a robot."""
_PROGRESS_CELLS = 0.25
"""A robot gets on when its way gets shorter by as much."""


class MappingRobot:
    """A robot of a scenario with a map. `step` is its only entrance."""

    def __init__(
        self,
        me: ParticipantId,
        scenario: Scenario,
        seed: int,
        body: Body,
        frame: Frame,
    ) -> None:
        """body: what it takes over. frame: how the cells lie, not what is in them."""
        self._me = scenario.roster.index(me)
        self._frame = frame
        self._robots = scenario.robots.count
        self._replica = build_replica(me, scenario, None, entries(frame), body.incarnation)
        self._radio = Gossip(me, scenario, body.incarnation)
        self._fused_map = FusedMap(frame, self._replica.origins)
        self._cost_map = CostMap(scenario, self._fused_map)
        self._evidence = OccupancyLog(frame, scenario.sensor, ranges=scenario.learns_ranges)
        self._dispatch = Assignment(scenario, self._cost_map, seed, self._me)
        self._navigator = Navigator(self._cost_map)
        self._vehicle = VEHICLES[scenario.vehicle.name](scenario.vehicle)
        self._clearance_cells = 2.0 * scenario.vehicle.radius_m / frame.resolution_m
        self._supervisor = scenario.robots.count if scenario.centralized else None
        self._period_ns = scenario.period_ns
        self._counting_on = ProgressMonitor.of(scenario, scenario.period_ns)
        self._patience = scenario.planner.patience
        # Who takes over a body on its way does not know when that moved last, and holds for a step.
        self._now_ns = 0 if body.step == 0 else LATER_NS
        self._step, self._pose = body.step, body.pose
        self._unsure_until = body.step + _SURE_STEPS
        self._scanned_step = -1
        self._scanned_pose: Pose | None = None
        self._task, self._since, self._arrived = Task(), 0, False
        self._progressed, self._left_cells = body.step, math.inf
        self._without = 0
        self._resting = False

    def step(self, inputs: Inputs, /) -> Outputs:
        """One step; see the module."""
        self._radio.receive(inputs.inbox, self._replica.merge)
        self._locate(inputs.observation)
        elapsed_ns = max(0, min(inputs.now_ns - self._now_ns, self._period_ns))
        self._now_ns, self._step = inputs.now_ns, self._step + 1
        self._fused_map.fold(self._replica)
        self._give_up()
        if not self._resting:
            self._decide()
        self._look(inputs.observation)
        if not self._resting:
            self._move(elapsed_ns * 1e-9)
        return self._publish()

    @property
    def _tick(self) -> int:
        return self._now_ns // self._period_ns

    def _locate(self, observation: Observation) -> None:
        """Take the pose that the world accepted. A late word on an older step changes nothing."""
        if observation.step == self._step:
            self._pose = observation.pose

    # Deciding.

    def _give_up(self) -> None:
        """Tell of a target that showed or led to nothing, before there is another target."""
        target = self._task.target
        in_vain = self._arrived and self._fused_map.is_frontier(target)
        stuck = not self._arrived and self._step - self._progressed > self._patience
        if target != NOWHERE and not self._fused_map.void[target] and (in_vain or stuck):
            self._replica.append(np.array([dead_frontier(self._frame, target)]))
            self._progressed = self._step

    def _decide(self) -> None:
        """Take a new task, if there is one; rest when no frontier can be reached."""
        registers = self._replica.registers
        supervisor = None if self._supervisor is None else registers.newest(self._supervisor)
        if (
            supervisor is not None
            and 0 <= registers.age_steps(supervisor) <= self._counting_on.contact_steps
        ):
            self._obey(order_in(registers.values[supervisor], self._me, self._frame.cells))
        elif registers.stamps[registers.me] > 0:
            self._choose()
        self._without = 0 if self._may_go_on() else self._without + 1
        self._resting = self._without >= _SURE_STEPS

    def _obey(self, target: int) -> None:
        if target != self._task.target:
            self._adopt(Task(target))

    def _choose(self) -> None:
        registers = self._replica.registers
        group, absent = visible_team(
            registers, self._robots, self._frame, self._tick, self._counting_on
        )
        task = self._dispatch.decide(group, absent, self._tick).get(self._me)
        if task is not None:
            self._adopt(task)

    def _adopt(self, task: Task) -> None:
        if task.target != self._task.target:
            self._arrived = False
            self._progressed, self._left_cells = self._step, math.inf
        self._task, self._since = task, self._tick

    def _may_go_on(self) -> bool:
        """Whether there may still be something for this robot to do."""
        if self._step <= self._unsure_until:
            return True
        frontiers = self._fused_map.frontiers
        if not frontiers.size:
            return False
        if self._task.target != NOWHERE and self._fused_map.is_frontier(self._task.target):
            return True
        cell = self._frame.cell_of(self._pose.x_m, self._pose.y_m)
        return bool(np.isfinite(self._cost_map.travel(cell)[frontiers]).any())

    # Acting.

    def _look(self, observation: Observation) -> None:
        """Add the scan to the own layer, once."""
        if observation.step != self._scanned_step:
            self._scanned_step = observation.step
            moved = observation.pose != self._scanned_pose
            self._scanned_pose = observation.pose
            self._replica.append(
                self._evidence.observe(observation.scan, observation.pose, moved=moved)
            )
        self._arrived = self._task.target != NOWHERE and self._is_at(self._task.target)

    def _is_at(self, cell: int) -> bool:
        """In the cell itself: from beside it, what lies behind it may be hidden."""
        return self._frame.cell_of(self._pose.x_m, self._pose.y_m) == cell

    def _move(self, dt_s: float) -> None:
        if self._task.target == NOWHERE or self._arrived or self._queues():
            return
        place = self._navigator.head(self._pose, self._task.target)
        if place is None:
            return
        if self._navigator.left_cells < self._left_cells - _PROGRESS_CELLS:
            self._progressed, self._left_cells = self._step, self._navigator.left_cells
        self._pose = self._vehicle.drive(self._pose, *place, dt_s)

    def _queues(self) -> bool:
        """Whether a lower robot on the way to the same target is too close: it goes first.

        Bodies do not merge. Points would, at the next bend, and could never be told apart again.
        """
        if self._clearance_cells == 0.0:
            return False
        registers = self._replica.registers
        told = registers.values
        here = int(told[registers.me, CELL]) - 1
        return any(
            told[slot, TARGET] == self._task.target + 1
            and self._cost_map.cells_between(int(told[slot, CELL]) - 1, here)
            <= self._clearance_cells
            for slot in map(registers.newest, range(self._me))
        )

    def _publish(self) -> Outputs:
        if self._resting:
            self._task = Task()
        cell = self._frame.cell_of(self._pose.x_m, self._pose.y_m)
        me = Member(self._me, cell, self._task, self._since, self._arrived)
        self._replica.registers.write(register_of(me, resting=self._resting))
        envelope = self._radio.compose(self._replica, self._step, self._pose)
        self._replica.end_step()
        target = self._task.target
        return Outputs(
            step=self._step,
            pose=self._pose,
            goal=None if target == NOWHERE else self._frame.centre_of(target),
            outbox=(envelope,),
            state=State.FINISHED if self._resting else State.EXPLORING,
            refused=self._radio.refused,
        )
