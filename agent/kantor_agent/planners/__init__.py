"""The planners by name: one file each, none imports another."""

from collections.abc import Callable

from kantor_agent.planners.base import Goal, Planner
from kantor_agent.planners.burgard import Burgard
from kantor_agent.planners.frontier import Frontier
from kantor_agent.planners.hungarian import Hungarian
from kantor_agent.planners.kmeans import KMeans
from kantor_agent.planners.market import Market
from kantor_agent.planners.spectral import Spectral
from kantor_agent.planners.team import Allocator
from kantor_agent.planners.transport import Transport
from kantor_protocol.scenario import Scenario

PLANNERS: dict[str, Callable[[Scenario], Planner]] = {
    "transport": lambda scenario: Transport(scenario.planner.horizon),
    "spectral": Spectral,
}
"""Those that explore a density: one robot's next goal."""

ALLOCATORS: dict[str, Callable[[Scenario, int, int | None], Allocator]] = {
    "frontier": Frontier,
    "burgard": Burgard,
    "hungarian": Hungarian,
    "kmeans": KMeans,
    "market": Market,
}
"""Those that explore a map: targets for a group. Scenario, seed, and the robot that asks or None."""

__all__ = ["ALLOCATORS", "PLANNERS", "Allocator", "Goal", "Planner"]
