"""The planners by name: one file each, none imports another."""

from collections.abc import Callable

from kantor_agent.planners.base import Goal, Planner
from kantor_agent.planners.spectral import Spectral
from kantor_agent.planners.transport import Transport
from kantor_protocol.scenario import Scenario

PLANNERS: dict[str, Callable[[Scenario], Planner]] = {
    "transport": lambda scenario: Transport(scenario.planner.horizon),
    "spectral": Spectral,
}

__all__ = ["PLANNERS", "Goal", "Planner"]
