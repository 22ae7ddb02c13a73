"""The interface of planners on densities: a choice of a goal from what the robot believes."""

from typing import Protocol

import msgspec

from kantor_agent.belief.belief import Belief
from kantor_protocol.base.machine import Pose


class Goal(msgspec.Struct, frozen=True, gc=False):
    """A place to head for, in the world frame."""

    x_m: float
    y_m: float
    sample: int
    """The sample at that place, or -1."""


class Planner(Protocol):
    """A planner on a density. It never knows which vehicle drives, and reads no clock."""

    def choose(self, belief: Belief, pose: Pose, now_ns: int, /) -> Goal | None:
        """The next goal from the present pose, at simulated time now_ns; None to stay."""
        ...
