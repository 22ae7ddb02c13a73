"""The interface of planners on maps: an assignment of targets to robots, from what they know together.

The same planner runs in the supervisor, for all robots, and in every robot, for those it is in contact
with. It is a function of the situation and its own memory of earlier ones, so that robots which know the
same come to the same assignment.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.cost_map import CostMap
from kantor_protocol.base.grid import NOWHERE

_LONG_AGO = -(1 << 40)


def past_or_long_ago(since: int, tick: int) -> int:
    """A past tick as it is. A later one than now is of a wrong clock and counts as long ago: no robot waits for it."""
    return since if since <= tick else _LONG_AGO


class Task(NamedTuple):
    """What a robot is to do."""

    target: int = NOWHERE
    """The cell to drive to."""
    memo: tuple[int, ...] = ()
    """Integers of the planner that all robots in contact get to know, such as the robot's region; at most
    `Scenario.register_width` - 4 of them, each below 2^52 in size."""


class TeamMember(NamedTuple):
    """A robot of the visible team, as every other robot of the team knows it."""

    robot: int
    """Its place in the roster; members are in this order."""
    cell: int
    """The cell in which it is."""
    task: Task
    """Its present task."""
    since: int
    """The tick in which it got that task."""
    arrived: bool
    """It stands on its target and has looked around."""


class Situation(NamedTuple):
    """What all members of a visible team know when targets are assigned."""

    cost_map: CostMap
    frontiers: npt.NDArray[np.int64]
    """Cells to choose from, rising."""
    members: tuple[TeamMember, ...]
    """The robots that get a target now."""
    others: tuple[TeamMember, ...]
    """The robots in contact that keep the target they have."""
    absent: tuple[int, ...]
    """The last known targets of robots that are out of contact."""
    tick: int
    """Periods since the start."""


class Allocator(Protocol):
    """A planner on a map. It is made with the scenario, the seed, and the robot that asks, or None (supervisor)."""

    negotiates: bool
    """Whether it is asked in every step, not only when a robot needs a target; in a robot then for that robot alone."""

    def assign(self, situation: Situation, /) -> Sequence[Task]:
        """A task for each of the situation's members, in their order."""
        ...
