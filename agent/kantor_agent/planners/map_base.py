"""What every planner on a map is: an assignment of targets to robots, from what they know together.

The same strategy runs in the supervisor, for all robots, and in every robot, for those it is in contact
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


def past(since: int, tick: int) -> int:
    """A tick that has been. One to come is of a clock that runs wrong: nobody must wait for it."""
    return since if since <= tick else _LONG_AGO


class Task(NamedTuple):
    """What a robot is to do."""

    target: int = NOWHERE
    """The cell to drive to."""
    memo: tuple[int, ...] = ()
    """What the strategy wants everybody in contact to know of this robot, such as its region; at most
    `Scenario.register_width` - 4 integers, each below 2^52 in size."""


class Member(NamedTuple):
    """A robot of the group, as everybody in it knows it."""

    robot: int
    """Its place in the roster; members are in this order."""
    cell: int
    """Where it is."""
    task: Task
    """What it does now."""
    since: int
    """The tick in which it got that task."""
    arrived: bool
    """It stands on its target and has looked around."""


class Situation(NamedTuple):
    """What is known to all members of a group."""

    cost_map: CostMap
    frontiers: npt.NDArray[np.int64]
    """Cells to choose from, rising."""
    members: tuple[Member, ...]
    """Who gets a target now."""
    others: tuple[Member, ...]
    """Who is in contact, and keeps the one it has."""
    absent: tuple[int, ...]
    """Targets of robots that are out of contact, as they were told last."""
    tick: int
    """Periods since the start."""


class Allocator(Protocol):
    """A strategy."""

    negotiates: bool
    """It is asked in every step, not only when a robot needs a target; in a robot then for that robot alone."""

    def assign(self, situation: Situation, /) -> Sequence[Task]:
        """A task for each of the situation's members, in their order."""
        ...
