"""The supervisor of a mission on a map: it gathers all layers and gives every robot its target.

It is one more participant. Robots get one another's layers through it, and drive by their own fused maps.
"""

from kantor_agent.coordination.assignment import (
    MEMO,
    Assignment,
    ContactLimits,
    supervisor_register,
    visible_team,
)
from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.planners.map_base import Task, TeamMember, past_or_long_ago
from kantor_protocol.base.grid import Frame
from kantor_protocol.base.machine import Body, Inputs, Outputs, ParticipantId, State
from kantor_protocol.replication.gossip import Gossip, build_replica
from kantor_protocol.replication.occupancy_log import entries
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Identities


class MappingSupervisor:
    """The supervisor of a scenario with a map. `step` is its only entrance."""

    def __init__(
        self,
        me: ParticipantId,
        scenario: Scenario,
        seed: int,
        body: Body,
        frame: Frame,
        identities: Identities | None = None,
    ) -> None:
        """body: the one that the supervisor takes over. frame: how the cells lie, not what is in them.

        identities: see Gossip.
        """
        self._frame = frame
        self._robots = scenario.robots.count
        self._replica = build_replica(me, scenario, None, entries(frame), body.incarnation)
        self._gossip = Gossip(me, scenario, body.incarnation, identities)
        self._fused_map = FusedMap(frame, self._replica.origins)
        """Of `_replica`, as far as its logs have been folded."""
        self._cost_map = CostMap(scenario, self._fused_map)
        self._assignment = Assignment(scenario, self._cost_map, seed, None)
        self._tasks: dict[int, Task] = {}
        """By robot that was in contact in the last step; the own register has the same targets."""
        self._since: dict[int, int] = {}
        """By robot: the tick in which it got its last task; every robot in `_tasks` with a target has one."""
        self._step, self._pose = body.step, body.pose
        self._period_ns = scenario.period_ns
        self._contact_limits = ContactLimits.of(scenario, step_clocks(scenario, seed)[me].period_ns)

    def step(self, inputs: Inputs, /) -> Outputs:
        """Take in what the robots sent, assign targets, send every robot what it lacks."""
        self._step += 1
        self._gossip.receive(inputs.inbox, self._replica)
        self._fused_map.fold(self._replica)
        tick = inputs.now_ns // self._period_ns
        for robot, task in self._assignment.decide(*self._visible_team(tick), tick).items():
            self._tasks[robot], self._since[robot] = task, tick
        self._replica.registers.write(supervisor_register(self._tasks, self._robots, tick))
        outputs = Outputs(
            step=self._step,
            pose=self._pose,
            outbox=(self._gossip.compose(self._replica, self._step, self._pose),),
            state=State.EXPLORING,
            refused=self._gossip.refused,
        )
        self._replica.end_step()
        return outputs

    def validate(self) -> None:
        """Assert what the parts say of themselves and of one another; true between two steps."""
        self._replica.validate()
        self._gossip.validate(self._replica)
        self._fused_map.validate(self._replica)
        self._cost_map.validate()
        registers = self._replica.registers
        expected = supervisor_register(self._tasks, self._robots, 0)[MEMO:]
        assert registers.values[registers.me, MEMO : MEMO + self._robots].tolist() == expected
        assert {robot for robot, task in self._tasks.items() if task != Task()} <= set(self._since)

    def _visible_team(self, tick: int) -> tuple[list[TeamMember], list[int]]:
        """The robots in contact with the tasks that they have been given; the targets of the others."""
        team, absent = visible_team(
            self._replica.registers, self._robots, self._frame, tick, self._contact_limits
        )
        self._tasks = {member.robot: self._tasks.get(member.robot, Task()) for member in team}
        return [self._as_assigned(member, tick) for member in team], absent

    def _as_assigned(self, member: TeamMember, tick: int) -> TeamMember:
        """A member with its assigned task: what its register says of another task does not count."""
        task = self._tasks[member.robot]
        since = past_or_long_ago(self._since.get(member.robot, 0), tick)
        arrived = member.arrived and member.task.target == task.target
        return member._replace(task=task, since=since, arrived=arrived)
