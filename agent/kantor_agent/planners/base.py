"""What every planner is: a choice of a goal from what the robot believes."""

from typing import Protocol

import msgspec

from kantor_agent.belief.belief import Belief
from kantor_protocol.base.machine import Pose


class Goal(msgspec.Struct, frozen=True, gc=False):
    """Where to head, in the world frame."""

    x_m: float
    y_m: float
    sample: int
    """The sample that stands there, or -1."""


class Planner(Protocol):
    """A strategy. It never knows which vehicle drives."""

    def choose(self, belief: Belief, pose: Pose, now_ns: int, /) -> Goal | None:
        """The next goal; None when there is nothing to head for."""
        ...
