"""Yamauchi's frontier-based exploration: every robot drives to the nearest frontier that it can reach.

A robot never returns to a frontier where it has been while there is another. A frontier towards which it
makes no progress becomes a dead frontier (`robots/mapping.py`) for all robots: the paper's list of
inaccessible frontiers.

Robots do not coordinate. Robots side by side choose the same target, and do so again and again.
"""

import numpy as np

from kantor_agent.planners.map_base import Situation, Task, TeamMember
from kantor_protocol.scenario.schema import Scenario


class Frontier:
    """The planner `frontier`: robots share the map and nothing else."""

    negotiates = False

    def __init__(self, _scenario: Scenario, _seed: int, me: int | None) -> None:
        """me: the robot that asks, for itself alone, or None for the supervisor."""
        self._me = me
        self._visited: dict[int, list[int]] = {}
        """By robot: the targets at which it has arrived."""

    def assign(self, situation: Situation, /) -> list[Task]:
        """Each member's cheapest frontier; of equal ones the lowest cell. A robot chooses for itself alone."""
        return [
            self._nearest(member, situation) if self._me in (None, member.robot) else member.task
            for member in situation.members
        ]

    def _nearest(self, member: TeamMember, situation: Situation) -> Task:
        visited = self._visited.setdefault(member.robot, [])
        if member.arrived and member.task.target not in visited:
            visited.append(member.task.target)
        frontiers = situation.frontiers
        travel = situation.cost_map.travel(member.cell, frontiers)
        fresh = np.where(np.isin(frontiers, visited), np.inf, travel)
        for costs in (fresh, travel):
            if np.isfinite(costs).any():
                return Task(int(frontiers[costs.argmin()]))
        return Task()
