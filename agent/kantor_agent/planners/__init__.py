"""The planners on densities by name; those on maps are in `allocators.py`. One file each, none imports another."""

from collections.abc import Callable

from kantor_agent.planners.base import Goal, Planner
from kantor_agent.planners.spectral import Spectral
from kantor_agent.planners.transport import Transport
from kantor_protocol.scenario import Scenario

PLANNERS: dict[str, Callable[[Scenario], Planner]] = {
    "transport": lambda scenario: Transport(scenario.planner.horizon),
    "spectral": Spectral,
}
"""One robot's next goal."""

__all__ = ["PLANNERS", "Goal", "Planner"]
