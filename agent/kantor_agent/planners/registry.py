"""Planners on densities, by name. Planners on maps are in `map_registry.py`: a robot on a density loads none of them."""

from collections.abc import Callable

from kantor_agent.planners.base import Planner
from kantor_agent.planners.spectral import Spectral
from kantor_agent.planners.transport import Transport
from kantor_protocol.scenario.schema import Scenario

PLANNERS: dict[str, Callable[[Scenario], Planner]] = {
    "transport": lambda scenario: Transport(scenario.planner.horizon),
    "spectral": Spectral,
}
"""One robot's next goal."""
