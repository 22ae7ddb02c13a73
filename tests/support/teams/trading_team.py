"""Robots that trade goals by memos, over a radio that a test chooses."""

import itertools
from collections.abc import Callable, Sequence

from kantor_agent.planners.map_base import TeamMember
from kantor_agent.planners.market.memo import Memo, unpacked
from kantor_agent.planners.market.planner import Market
from kantor_agent.planners.market.trader import Holding
from support.teams.floors import Floor, member
from support.teams.markets import mission, situation

Radio = Callable[[int, int, int], Sequence[int]]
"""Source, receiver and step to the delays, in steps, with which a memo arrives; none: it is lost."""


def perfect_radio(_source: int, _receiver: int, _step: int) -> Sequence[int]:
    """A radio without faults."""
    return (1,)


class TradingTeam:
    """Robots that receive one another's registers: late, twice or not at all; the newest counts."""

    def __init__(self, floor: Floor, cells: Sequence[int], *overrides: str) -> None:
        self.robots = len(cells)
        scenario = mission(f"robots.count={self.robots}", *overrides)
        self.floors = [floor] * self.robots
        self.markets = [Market(scenario, 0, robot) for robot in range(self.robots)]
        self.members = [member(robot, cell) for robot, cell in enumerate(cells)]
        self.received: list[dict[int, tuple[int, int, TeamMember]]] = [{} for _ in cells]
        self.under_way: list[tuple[int, int, int, TeamMember]] = []
        self.step = 0

    def play(self, steps: int, radio: Radio = perfect_radio) -> None:
        """Let every robot step; in between, memos are under way."""
        for _ in range(steps):
            self.step += 1
            self._deliver()
            self.members = [self._assigned(robot) for robot in range(self.robots)]
            for source, receiver in itertools.permutations(range(self.robots), 2):
                for delay in radio(source, receiver, self.step):
                    due = self.step + delay
                    self.under_way.append((due, receiver, self.step, self.members[source]))

    def move(self, *cells: int) -> None:
        """Put the robots into other cells."""
        self.members = [
            one._replace(cell=cell) for one, cell in zip(self.members, cells, strict=True)
        ]

    def _deliver(self) -> None:
        for due, receiver, stamp, sender in self.under_way:
            received = self.received[receiver]
            if due <= self.step and stamp > received.get(sender.robot, (0,))[0]:
                received[sender.robot] = (stamp, self.step, sender)
        self.under_way = [copy for copy in self.under_way if copy[0] > self.step]

    def _assigned(self, robot: int) -> TeamMember:
        own = self.members[robot]
        others = [
            sender
            for _, (_, at, sender) in sorted(self.received[robot].items())
            if at + 8 >= self.step
        ]
        own_situation = situation(self.floors[robot].cost_map, [own], others, self.step)
        [task] = self.markets[robot].assign(own_situation)
        return own._replace(task=task)

    def give(self, robot: int, *goals: int) -> None:
        """Let a robot hold goals, and no others."""
        self.markets[robot].form.tour = [Holding(goal) for goal in goals]

    def memo(self, robot: int) -> Memo:
        """The memo that a robot announces."""
        return unpacked(
            self.members[robot].task.memo, self.robots, self.floors[robot].fused_map.frame.cells
        )

    def tour(self, robot: int) -> list[int]:
        """The goals that a robot holds."""
        return [goal for goal, _successor in self.memo(robot).tour]

    def holders(self, goal: int) -> list[int]:
        """The robots that hold a goal."""
        return [robot for robot in range(self.robots) if goal in self.tour(robot)]

    def until(
        self, rule: Callable[[], bool], radio: Radio = perfect_radio, steps: int = 40
    ) -> None:
        """Play until a rule holds."""
        for _ in range(steps):
            if rule():
                return
            self.play(1, radio)
        raise AssertionError(f"the rule never held in {steps} steps")
