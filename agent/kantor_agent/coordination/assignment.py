"""When robots on a map get new targets, and from whom: the same rules in the supervisor and in a robot.

What a robot tells of itself, and the supervisor of all robots, are registers (`registers.py`):

    robot         cell + 1, ARRIVED | RESTING, target + 1, since, the task's memo
    supervisor    0, 0, 0, tick, then the target + 1 of every robot
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners.map_base import Member, Situation, Task, past
from kantor_agent.planners.map_registry import ALLOCATORS
from kantor_protocol.base.grid import NOWHERE, Frame
from kantor_protocol.replication.gossip import CONTACT_PERIODS
from kantor_protocol.replication.registers import Registers
from kantor_protocol.scenario.schema import Scenario

ARRIVED, RESTING = 1, 2
CELL, FLAGS, TARGET, SINCE, MEMO = 0, 1, 2, 3, 4


class ProgressMonitor(NamedTuple):
    """How long a participant counts on what it was told, in its own steps."""

    contact_steps: int
    """Whoever's register was not renewed for longer is out of contact."""
    remember_steps: int
    """The target of a robot out of contact counts as taken for so long."""

    @classmethod
    def of(cls, scenario: Scenario, period_ns: int) -> "ProgressMonitor":
        """For a participant that steps once in period_ns."""
        return cls(
            CONTACT_PERIODS * scenario.period_ns // period_ns,
            round(scenario.planner.remember_s * 1e9) // period_ns,
        )


def register_of(member: Member, *, resting: bool) -> list[int]:
    """What a robot tells of itself."""
    flags = ARRIVED * member.arrived | RESTING * resting
    return [member.cell + 1, flags, member.task.target + 1, member.since, *member.task.memo]


def member_of(robot: int, register: npt.NDArray[np.int64], cells: int, tick: int) -> Member | None:
    """What a robot has told of itself; None while it has told nothing sound, or rests."""
    cell, flags, target, since = register[:MEMO].tolist()
    if not (1 <= cell <= cells and 0 <= target <= cells) or flags & RESTING:
        return None
    used = register.nonzero()[0]
    memo = tuple(register[MEMO : used[-1] + 1].tolist())  # registers lose zeros at the end too
    return Member(
        robot, cell - 1, Task(target - 1, memo), past(since, tick), arrived=bool(flags & ARRIVED)
    )


def visible_team(
    registers: Registers, robots: int, frame: Frame, tick: int, patience: ProgressMonitor
) -> tuple[list[Member], list[int]]:
    """Who is in contact, by place, as all others know them; and where those were heading who are not."""
    group, absent = [], []
    for robot in range(robots):
        slot = registers.newest(robot)
        member = member_of(robot, registers.values[slot], frame.cells, tick)
        if member is None:
            continue
        age = 0 if slot == registers.me else registers.age_steps(slot)
        if age <= patience.contact_steps:
            group.append(member)
        elif age <= patience.remember_steps and member.task.target != NOWHERE:
            absent.append(member.task.target)
    return group, absent


def orders_of(tasks: Mapping[int, Task], robots: int, tick: int) -> list[int]:
    """What the supervisor tells."""
    targets = [tasks[robot].target + 1 if robot in tasks else 0 for robot in range(robots)]
    return [0, 0, 0, tick, *targets]


def order_in(register: npt.NDArray[np.int64], robot: int, cells: int) -> int:
    """The target that the supervisor has given a robot, or NOWHERE."""
    target = int(register[MEMO + robot]) - 1
    return target if 0 <= target < cells else NOWHERE


class Assignment:
    """Asks the strategy when somebody needs a target."""

    def __init__(self, scenario: Scenario, cost_map: CostMap, seed: int, me: int | None) -> None:
        """me: the robot that asks, or None for the supervisor."""
        planner = scenario.planner
        self._cost_map = cost_map
        self._me = me
        self._allocator = ALLOCATORS[planner.name](scenario, seed, me)
        self._on_events = planner.replan_on == "events"
        self._whole_team = planner.replan_whose == "team"
        self._gap = planner.replan_gap
        self._asked: dict[int, int] = {}
        """For each robot in contact the revision of the chart when a target for it was last asked for."""

    def decide(self, group: Sequence[Member], absent: Sequence[int], tick: int) -> dict[int, Task]:
        """New tasks by robot, for those who get one now. group: everybody in contact, by place."""
        # Whoever was out of contact has no target any more: it gets one though the chart is as it was.
        known = self._asked
        self._asked = {m.robot: known[m.robot] for m in group if m.robot in known}
        members, others = self._chosen(group, tick)
        if not members:
            return {}
        self._asked |= dict.fromkeys((m.robot for m in members), self._cost_map.fused_map.revision)
        situation = Situation(
            self._cost_map, self._frontiers(group), members, others, tuple(absent), tick
        )
        tasks = self._allocator.assign(situation)
        return {member.robot: task for member, task in zip(members, tasks, strict=True)}

    def _chosen(
        self, group: Sequence[Member], tick: int
    ) -> tuple[tuple[Member, ...], tuple[Member, ...]]:
        """Who gets a target now, and who keeps the one it has."""
        if self._allocator.negotiates:
            mine = tuple(m for m in group if self._me in (None, m.robot))
            return mine, tuple(m for m in group if m not in mine)
        due = [self._needs(member) for member in group]
        if self._whole_team:
            rested = all(m.since + self._gap <= tick for m in group)
            return (tuple(group), ()) if any(due) and rested else ((), ())
        ripe = [need and m.since + self._gap <= tick for m, need in zip(group, due, strict=True)]
        return (
            tuple(m for m, now in zip(group, ripe, strict=True) if now),
            tuple(m for m, now in zip(group, ripe, strict=True) if not now),
        )

    def _needs(self, member: Member) -> bool:
        fused_map, target = self._cost_map.fused_map, member.task.target
        if target == NOWHERE:
            return self._asked.get(member.robot) != fused_map.revision
        if member.arrived or fused_map.void[target]:
            return True
        return self._on_events and not fused_map.is_frontier(target)

    def _frontiers(self, group: Sequence[Member]) -> npt.NDArray[np.int64]:
        """All but those at which somebody stands that has looked around."""
        frontiers = self._cost_map.fused_map.frontiers
        looked = [m.task.target for m in group if m.arrived]
        return frontiers[~np.isin(frontiers, looked)] if looked else frontiers
