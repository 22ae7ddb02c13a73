"""The planners on maps by name. They stand apart from the others: a robot on a density needs none of them."""

from collections.abc import Callable

from kantor_agent.planners.burgard import Burgard
from kantor_agent.planners.frontier import Frontier
from kantor_agent.planners.hungarian import Hungarian
from kantor_agent.planners.kmeans import KMeans
from kantor_agent.planners.map_base import Allocator
from kantor_agent.planners.market.planner import Market
from kantor_protocol.scenario.schema import Scenario

ALLOCATORS: dict[str, Callable[[Scenario, int, int | None], Allocator]] = {
    "frontier": Frontier,
    "burgard": Burgard,
    "hungarian": Hungarian,
    "kmeans": KMeans,
    "market": Market,
}
"""Targets for a group. Scenario, seed, and the robot that asks or None."""
