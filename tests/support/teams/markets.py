"""Scenarios of the planner `market`, drawn maps, situations on them, and tours."""

import itertools
from collections.abc import Sequence

import numpy as np
from hypothesis import strategies as st

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners.map_base import Situation, TeamMember
from kantor_agent.planners.market.costs import Costs
from kantor_protocol.base.grid import NOWHERE
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from support.teams.floors import Floor, drawn

_MISSION = """
name = "market"
robots = { count = 3 }
starts = { random = true }
map = { layout = "blank" }
clock = { period_s = 1.0 }
sensor = { range_m = 4.0 }
planner = { name = "market", cost = "length" }
"""

CORRIDOR = "????............????"
"""A map of one row with goals at 2 and 17."""

TOURS = st.lists(st.integers(0, 399), min_size=1, max_size=7, unique=True)
"""Up to seven different cells of `scattered_walls`."""


def mission(*overrides: str) -> Scenario:
    """Three robots that see 4 cells far; a step takes a second, a lease five."""
    return parse(_MISSION, "market", overrides)


def floor_of(*rows: str, range_m: float = 4.0) -> Floor:
    """A map as it is drawn, row 0 first: `?` unknown, `.` free, `#` wall."""
    return drawn(rows, f"sensor.range_m={range_m}")


def cost_map_of(*rows: str, range_m: float = 4.0) -> CostMap:
    """The cost map of a floor."""
    return floor_of(*rows, range_m=range_m).cost_map


def scattered_walls(seed: int) -> CostMap:
    """20 x 20 cells, a quarter of them walls, half of them unknown."""
    rng = np.random.default_rng(seed)
    return cost_map_of(*["".join(rng.choice(list("??.#"), 20)) for _ in range(20)])


def situation(
    cost_map: CostMap,
    members: Sequence[TeamMember],
    others: Sequence[TeamMember] = (),
    tick: int = 10,
) -> Situation:
    """A situation with all frontiers to choose from and no robot out of contact."""
    return Situation(
        cost_map, cost_map.fused_map.frontiers, tuple(members), tuple(others), (), tick
    )


def tour_length(costs: Costs, place: int, tour: Sequence[int]) -> float:
    """The length of a tour from a robot's place, leg by leg."""
    before = [NOWHERE, *tour]
    return sum(costs.leg(place, one, other) for one, other in itertools.pairwise(before))
