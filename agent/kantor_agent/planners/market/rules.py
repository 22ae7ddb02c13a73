"""Rules of both forms of the market: which goals are proposed, and when one is given up."""

import math
from collections.abc import Sequence

import numpy as np

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners.map_base import Situation, TeamMember
from kantor_agent.planners.market.costs import DistanceField, near
from kantor_agent.planners.market.goals import greedy_goals, quadtree_goals, random_goals
from kantor_agent.planners.market.memo import HEAD
from kantor_protocol.base.grid import NOWHERE, UNKNOWN
from kantor_protocol.scenario.schema import Scenario


class MarketRules:
    """The options of a market, and the decisions that both of its forms take alike."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        planner, robots = scenario.planner, scenario.robots.count
        self._seed = seed
        self._rule = planner.goals
        self._count = planner.goal_count
        self.capacity = (scenario.register_width - 4 - HEAD - 2 * robots) // 2
        """The largest number of goals in a tour: more do not fit into a memo."""

    def propose(
        self, cost_map: CostMap, field: DistanceField, robot: int, tick: int, held: Sequence[int]
    ) -> list[int]:
        """New goals for a robot, the cheapest first, none within half a range of another or of a held one.

        field: of the robot. held: goals of the tours that are known.
        """
        count = min(self._count, self.capacity)
        if self._rule == "greedy":
            return greedy_goals(cost_map, field, held, count)
        if self._rule == "random":
            cells = random_goals(cost_map, self._seed, robot, tick, count)
        else:
            cells = quadtree_goals(cost_map)
        goals: list[int] = []
        for cell in sorted(cells, key=lambda cell: (field[cell], cell)):
            if (
                len(goals) < count
                and field[cell] < math.inf
                and not near(cost_map, cell, (*held, *goals))
            ):
                goals.append(cell)
        return goals

    def heading(self, situation: Situation, member: TeamMember, goal: int) -> int:
        """The target of a member with a goal: the reachable frontier on the best way to it.

        goal: NOWHERE for the nearest frontier. Of equal ones the lowest cell; NOWHERE if none can be reached.
        """
        cost_map, frontiers = situation.cost_map, situation.frontiers
        totals = cost_map.travel(member.cell, frontiers)
        if goal != NOWHERE:
            towards = totals + cost_map.optimistic(goal, until=member.cell)[frontiers]
            totals = towards if np.isfinite(towards).any() else totals
        best = int(totals.argmin()) if totals.size else 0
        reached = totals.size and math.isfinite(totals[best])
        return int(frontiers[best]) if reached else NOWHERE


def is_open(cost_map: CostMap, goal: int) -> bool:
    """Whether a goal is still unexplored."""
    return bool(cost_map.fused_map.cells[goal] == UNKNOWN)


def is_reachable(field: DistanceField, goal: int) -> bool:
    """Whether a way may lead to a goal. field: of the robot."""
    return bool(field[goal] < math.inf)


def task_is_stale(situation: Situation, member: TeamMember) -> bool:
    """Whether a member's target is a frontier no more."""
    frontiers = situation.frontiers
    at = int(np.searchsorted(frontiers, member.task.target))
    return at >= frontiers.size or int(frontiers[at]) != member.task.target
