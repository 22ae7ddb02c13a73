"""Yamauchi's frontiers: the nearest that a robot can reach and has not visited, whatever others do."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.coordination.assignment import Assignment
from kantor_agent.planners.frontier import Frontier
from kantor_agent.planners.map_base import Situation, TeamMember
from kantor_protocol.base.grid import NOWHERE
from support.strategies import examples
from support.teams.floors import Floor, crowded, drawn, member

CORRIDOR = [" ....... "]
"""Frontiers are 1 and 7."""


def targets(planner: Frontier, situation: Situation) -> list[int]:
    """What the planner chooses."""
    return [task.target for task in planner.assign(situation)]


def explorer(floor: Floor, me: int | None = None) -> Frontier:
    """A new planner."""
    return Frontier(floor.scenario, 0, me)


@examples(100)
@given(data=st.data())
def test_every_robot_takes_the_cheapest_frontier(data: st.DataObject) -> None:
    """Of equal ones the lowest; targets of other robots do not count."""
    floor, situation = data.draw(crowded())
    expected = []
    for asked in situation.members:
        travel = floor.cost_map.travel(asked.cell)
        reached = [(travel[t], t) for t in situation.frontiers.tolist() if np.isfinite(travel[t])]
        expected.append(min(reached)[1] if reached else NOWHERE)

    assert targets(explorer(floor), situation) == expected


def test_robots_side_by_side_choose_the_same_for_ever() -> None:
    """It is the method's, and the reason for all the others."""
    floor = drawn(CORRIDOR)
    planner = explorer(floor)
    for cell, target in ((3, 1), (5, 7), (4, 1)):
        situation = floor.situation([member(i, cell) for i in range(3)])
        assert targets(planner, situation) == [target] * 3


def test_a_frontier_that_was_visited_is_not_chosen_again() -> None:
    """By that robot, while there is another; another robot does not know of it."""
    floor = drawn(CORRIDOR)
    planner = explorer(floor)
    arrived = member(0, 1, 1, arrived=True)

    assert targets(planner, floor.situation([arrived], but=[1])) == [7]
    assert targets(planner, floor.situation([member(0, 2, 7), member(1, 2)])) == [7, 1]


def test_a_target_that_was_not_reached_may_be_chosen_again() -> None:
    """Visited is where the robot has arrived."""
    floor = drawn(CORRIDOR)
    planner = explorer(floor)
    targets(planner, floor.situation([member(0, 2, 1)]))

    assert targets(planner, floor.situation([member(0, 2, 7)])) == [1]


def test_when_all_were_visited_the_nearest_of_them_is_better_than_none() -> None:
    """A mission ends when nothing is left, not when somebody has been everywhere."""
    floor = drawn(CORRIDOR)
    planner = explorer(floor)
    targets(planner, floor.situation([member(0, 1, 1, arrived=True)], but=[1]))

    assert targets(planner, floor.situation([member(0, 7, 7, arrived=True)], but=[7])) == [1]
    assert targets(planner, floor.situation([member(0, 5)])) == [7]
    assert targets(planner, floor.situation([member(0, 7, 7, arrived=True)], but=[1, 7])) == [
        NOWHERE
    ]


def test_a_robot_asks_for_itself_alone() -> None:
    """What others do follows from nothing that it knows; their visits are theirs."""
    floor = drawn(CORRIDOR)
    mine = explorer(floor, me=1)
    situation = floor.situation([member(0, 1, 1, arrived=True), member(1, 2)])

    assert targets(mine, situation) == [1, 1]
    assert targets(mine, floor.situation([member(0, 2, 7), member(1, 6)])) == [7, 7]


@pytest.mark.parametrize("replan_on", ["events", "arrivals"])
def test_an_inaccessible_frontier_is_left_for_another(replan_on: str) -> None:
    """It is dead as soon as a robot has made no progress for a while: no robot heads for it any more."""
    floor = drawn(CORRIDOR, "planner=frontier", f"planner.replan_on={replan_on}")
    assignment = Assignment(floor.scenario, floor.cost_map, 0, None)
    stuck = member(0, 2, 1)
    assert assignment.decide([stuck], (), 10) == {}
    floor.find_dead(1)

    assert assignment.decide([stuck], (), 10)[0].target == 7
    floor.find_dead(7)
    assert assignment.decide([stuck], (), 20)[0].target == NOWHERE


def test_a_robot_visits_every_frontier_before_it_returns_to_one() -> None:
    """Four frontiers that stay what they are, and a robot that arrives at one after the other."""
    floor = drawn(["## ##", "##.##", " ... ", "##.##", "## ##"], "planner=frontier")
    assignment = Assignment(floor.scenario, floor.cost_map, 0, 0)
    visitor, visits = member(0, 12), []
    for tick in range(10, 60, 10):
        task = assignment.decide([visitor], (), tick)[0]
        visits.append(task.target)
        visitor = TeamMember(0, task.target, task, tick, arrived=True)

    assert visits == [7, 11, 13, 17, 7]
