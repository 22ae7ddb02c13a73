"""The supervisor of a mission with a map: it gathers all layers and gives every robot its target.

It is one more participant. Robots hear of one another's layers through it, and drive by their own charts.
"""

from kantor_agent.coordination.assignment import (
    Assignment,
    ProgressMonitor,
    orders_of,
    visible_team,
)
from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.planners.map_base import Member, Task, past
from kantor_protocol.base.grid import Frame
from kantor_protocol.base.machine import Body, Inputs, Outputs, ParticipantId, State
from kantor_protocol.replication.gossip import Gossip, build_replica
from kantor_protocol.replication.occupancy_log import entries
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.scenario.schema import Scenario


class MappingSupervisor:
    """The supervisor of a scenario with a map. `step` is its only entrance."""

    def __init__(
        self, me: ParticipantId, scenario: Scenario, seed: int, body: Body, frame: Frame
    ) -> None:
        """body: what it takes over. frame: how the cells lie, not what is in them."""
        self._frame = frame
        self._robots = scenario.robots.count
        self._replica = build_replica(me, scenario, None, entries(frame), body.incarnation)
        self._radio = Gossip(me, scenario, body.incarnation)
        self._fused_map = FusedMap(frame, self._replica.origins)
        self._dispatch = Assignment(scenario, CostMap(scenario, self._fused_map), seed, None)
        self._tasks: dict[int, Task] = {}
        self._since: dict[int, int] = {}
        self._step, self._pose = body.step, body.pose
        self._period_ns = scenario.period_ns
        self._counting_on = ProgressMonitor.of(scenario, step_clocks(scenario, seed)[me].period_ns)

    def step(self, inputs: Inputs, /) -> Outputs:
        """Take in what the robots sent, give targets, tell everybody what they lack."""
        self._step += 1
        self._radio.receive(inputs.inbox, self._replica.merge)
        self._fused_map.fold(self._replica)
        tick = inputs.now_ns // self._period_ns
        for robot, task in self._dispatch.decide(*self._roll_call(tick), tick).items():
            self._tasks[robot], self._since[robot] = task, tick
        self._replica.registers.write(orders_of(self._tasks, self._robots, tick))
        outputs = Outputs(
            step=self._step,
            pose=self._pose,
            outbox=(self._radio.compose(self._replica, self._step, self._pose),),
            state=State.EXPLORING,
            refused=self._radio.refused,
        )
        self._replica.end_step()
        return outputs

    def _roll_call(self, tick: int) -> tuple[list[Member], list[int]]:
        """The robots in contact with the tasks that they have been given; the targets of the others."""
        told, absent = visible_team(
            self._replica.registers, self._robots, self._frame, tick, self._counting_on
        )
        self._tasks = {member.robot: self._tasks.get(member.robot, Task()) for member in told}
        return [self._as_ordered(member, tick) for member in told], absent

    def _as_ordered(self, told: Member, tick: int) -> Member:
        task = self._tasks[told.robot]
        since = past(self._since.get(told.robot, 0), tick)
        arrived = told.arrived and told.task.target == task.target
        return told._replace(task=task, since=since, arrived=arrived)
