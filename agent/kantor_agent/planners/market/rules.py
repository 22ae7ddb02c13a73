"""Rules that buyers and sellers share: which goals are proposed, and when one is done."""

import math

import numpy as np

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners.map_base import Member, Situation
from kantor_agent.planners.market.costs import Cells, DistanceField, near
from kantor_agent.planners.market.goals import greedy_goals, quadtree_goals, random_goals
from kantor_agent.planners.market.memo import HEAD
from kantor_protocol.base.grid import NOWHERE, UNKNOWN
from kantor_protocol.scenario.schema import Scenario


class MarketRules:
    """What both forms of the market have in common."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        planner, robots = scenario.planner, scenario.robots.count
        self._seed = seed
        self._rule = planner.goals
        self._count = planner.goal_count
        self.capacity = (scenario.register_width - 4 - HEAD - 2 * robots) // 2
        """Goals of a tour that a memo has room for."""

    def propose(
        self, cost_map: CostMap, field: DistanceField, robot: int, tick: int, held: Cells
    ) -> list[int]:
        """New goals of a robot, the cheapest first, none within half a range of another or a held one."""
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

    def heading(self, situation: Situation, member: Member, goal: int) -> int:
        """The reachable frontier on the best way to a goal, or the nearest (NOWHERE); the lowest of equals."""
        cost_map, frontiers = situation.cost_map, situation.frontiers
        totals = cost_map.travel(member.cell)[frontiers]
        if goal != NOWHERE:
            towards = totals + cost_map.optimistic(goal, until=member.cell)[frontiers]
            totals = towards if np.isfinite(towards).any() else totals
        best = int(totals.argmin()) if totals.size else 0
        reached = totals.size and math.isfinite(totals[best])
        return int(frontiers[best]) if reached else NOWHERE


def is_open(cost_map: CostMap, goal: int) -> bool:
    """Whether there is still something to explore at a goal."""
    return bool(cost_map.fused_map.cells[goal] == UNKNOWN)


def is_reachable(field: DistanceField, goal: int) -> bool:
    """Whether a way may lead to a goal."""
    return bool(field[goal] < math.inf)


def task_is_stale(situation: Situation, member: Member) -> bool:
    """Whether a member's target is no frontier any more."""
    frontiers = situation.frontiers
    at = int(np.searchsorted(frontiers, member.task.target))
    return at >= frontiers.size or int(frontiers[at]) != member.task.target
