"""Yamauchi's frontier-based exploration: every robot drives to the nearest frontier that it can reach."""

import math

from kantor_agent.planners.team import Situation, Task
from kantor_protocol.scenario import Scenario


class Frontier:
    """Nobody coordinates with anybody; what robots share is the map."""

    negotiates = False

    def __init__(self, scenario: Scenario, seed: int, me: int | None) -> None:
        """me: the robot that asks, or None for the supervisor."""

    def assign(self, situation: Situation, /) -> list[Task]:
        """Each member's cheapest frontier."""
        tasks = []
        for member in situation.members:
            travel = situation.terrain.travel(member.cell)[situation.frontiers]
            best = int(travel.argmin()) if travel.size else 0
            reached = travel.size and math.isfinite(travel[best])
            tasks.append(Task(int(situation.frontiers[best])) if reached else Task())
        return tasks
