"""When robots on a map get new targets, and which participant assigns them: one set of rules for all.

Theory of operation
-------------------
1. In every step each robot writes its state into its register, and the supervisor the targets of all
   robots into its own (`registers.py`):

       robot         cell + 1, ARRIVED | RESTING, target + 1, since, the task's memo
       supervisor    0, 0, 0, tick, then the target + 1 of every robot

2. From the registers that it holds, a participant knows its visible team: the robots in contact. Of a robot
   that has been out of contact for a while it still counts the target as taken.
3. A member needs a target when it has none, has arrived, or heads for a cell that is a frontier no more. Then
   the planner is asked, for the whole team or for those members alone, and not more often than `replan_gap` says.
4. Without a supervisor every robot asks for its visible team and takes its own task from the answer. Robots
   that know the same come to the same assignment.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners.map_base import Situation, Task, TeamMember, past_or_long_ago
from kantor_agent.planners.map_registry import ALLOCATORS
from kantor_protocol.base.grid import NOWHERE, Frame
from kantor_protocol.replication.gossip import CONTACT_PERIODS
from kantor_protocol.replication.registers import Registers
from kantor_protocol.scenario.schema import Scenario

ARRIVED, RESTING = 1, 2
"""Flags of a robot's register."""
CELL, FLAGS, TARGET, SINCE, MEMO = 0, 1, 2, 3, 4
"""Places in a register; a supervisor's targets begin at MEMO."""


class ContactLimits(NamedTuple):
    """How long a participant relies on the register of another, in its own steps."""

    contact_timeout_steps: int
    """A robot whose register has not been renewed for longer is out of contact."""
    remember_steps: int
    """The target of a robot out of contact counts as taken while its register is no older."""

    @classmethod
    def of(cls, scenario: Scenario, period_ns: int) -> "ContactLimits":
        """The limits of a participant that steps once in period_ns."""
        return cls(
            CONTACT_PERIODS * scenario.period_ns // period_ns,
            round(scenario.planner.remember_s * 1e9) // period_ns,
        )


def robot_register(member: TeamMember, *, resting: bool) -> list[int]:
    """The numbers of a robot's register."""
    flags = ARRIVED * member.arrived | RESTING * resting
    return [member.cell + 1, flags, member.task.target + 1, member.since, *member.task.memo]


def read_member(
    robot: int, register: npt.NDArray[np.int64], cells: int, tick: int
) -> TeamMember | None:
    """The robot that a register describes; None if it is resting, or the register empty or malformed.

    cells: of the map. tick: now; a later `since` is of a wrong clock.
    """
    cell, flags, target, since = register[:MEMO].tolist()
    if not (1 <= cell <= cells and 0 <= target <= cells) or flags & RESTING:
        return None
    used = register.nonzero()[0]
    memo = tuple(register[MEMO : used[-1] + 1].tolist())  # registers lose zeros at the end too
    since, arrived = past_or_long_ago(since, tick), bool(flags & ARRIVED)
    return TeamMember(robot, cell - 1, Task(target - 1, memo), since, arrived=arrived)


def visible_team(
    registers: Registers, robots: int, frame: Frame, tick: int, limits: ContactLimits
) -> tuple[list[TeamMember], list[int]]:
    """The robots in contact, in roster order, as all others know them; the targets of robots out of contact."""
    team, absent = [], []
    for robot in range(robots):
        origin = registers.newest(robot)
        member = read_member(robot, registers.values[origin], frame.cells, tick)
        if member is None:
            continue
        age = 0 if origin == registers.me else registers.age_steps(origin)
        if age <= limits.contact_timeout_steps:
            team.append(member)
        elif age <= limits.remember_steps and member.task.target != NOWHERE:
            absent.append(member.task.target)
    return team, absent


def supervisor_register(tasks: Mapping[int, Task], robots: int, tick: int) -> list[int]:
    """The numbers of the supervisor's register. tasks: by robot; the others have no target."""
    targets = [tasks[robot].target + 1 if robot in tasks else 0 for robot in range(robots)]
    return [0, 0, 0, tick, *targets]


def assigned_target(register: npt.NDArray[np.int64], robot: int, cells: int) -> int:
    """The target of a robot in the supervisor's register, or NOWHERE. cells: of the map."""
    target = int(register[MEMO + robot]) - 1
    return target if 0 <= target < cells else NOWHERE


class Assignment:
    """Asks the planner for tasks when robots need them."""

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
        """By robot in contact: the revision of the fused map when a target for it was last asked for."""

    def decide(
        self, team: Sequence[TeamMember], absent: Sequence[int], tick: int
    ) -> dict[int, Task]:
        """New tasks, by robot, for those that get one now.

        team: all robots in contact, in roster order. absent: targets of robots out of contact.
        """
        # A robot that was out of contact has no target any more: it gets one though the map is the same.
        known = self._asked
        self._asked = {m.robot: known[m.robot] for m in team if m.robot in known}
        members, others = self._split(team, tick)
        if not members:
            return {}
        self._asked |= dict.fromkeys((m.robot for m in members), self._cost_map.fused_map.revision)
        situation = Situation(
            self._cost_map, self._frontiers(team), members, others, tuple(absent), tick
        )
        tasks = self._allocator.assign(situation)
        return {member.robot: task for member, task in zip(members, tasks, strict=True)}

    def _split(
        self, team: Sequence[TeamMember], tick: int
    ) -> tuple[tuple[TeamMember, ...], tuple[TeamMember, ...]]:
        """The members that get a target now, and those that keep the one they have."""
        if self._allocator.negotiates:
            mine = tuple(m for m in team if self._me in (None, m.robot))
            return mine, tuple(m for m in team if m not in mine)
        needs = [self._needs_target(member) for member in team]
        gap_over = [m.since + self._gap <= tick for m in team]
        if self._whole_team:
            return (tuple(team), ()) if any(needs) and all(gap_over) else ((), ())
        due = [need and over for need, over in zip(needs, gap_over, strict=True)]
        return (
            tuple(m for m, now in zip(team, due, strict=True) if now),
            tuple(m for m, now in zip(team, due, strict=True) if not now),
        )

    def _needs_target(self, member: TeamMember) -> bool:
        fused_map, target = self._cost_map.fused_map, member.task.target
        if target == NOWHERE:
            return self._asked.get(member.robot) != fused_map.revision
        if member.arrived or fused_map.is_abandoned(target):
            return True
        return self._on_events and not fused_map.is_frontier(target)

    def _frontiers(self, team: Sequence[TeamMember]) -> npt.NDArray[np.int64]:
        """All frontiers but those at which a member stands and has looked around."""
        frontiers = self._cost_map.fused_map.frontiers
        looked = [m.task.target for m in team if m.arrived]
        return frontiers[~np.isin(frontiers, looked)] if looked else frontiers
