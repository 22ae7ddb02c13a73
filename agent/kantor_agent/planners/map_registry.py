"""Planners on maps, by the name that `planner.name` has in a scenario.

To add one: a module or folder of its own in this folder, with a class as `map_base.Allocator` describes it; an entry
in `ALLOCATORS`; its name in `PlannerName` and `MAP_PLANNERS` in `kantor_protocol/scenario/schema.py`; and a test.
Options are fields of `PlannerOptions` there. No planner imports another (`docs/planners.md`).

Planners on densities are in `registry.py`, apart from these: a robot on a density loads none of them.
"""

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
"""Makes a planner from the scenario, the seed, and the robot that asks, or None for the supervisor."""
