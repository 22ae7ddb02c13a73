"""Rules of both forms of the market: which goals a robot proposes, and to which frontier it drives."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners.market.rules import MarketRules
from kantor_protocol.base.grid import FREE, NOWHERE, UNKNOWN
from support.strategies import examples
from support.teams.floors import member
from support.teams.markets import CORRIDOR, cost_map_of, mission, scattered_walls, situation


@pytest.mark.parametrize("rule", ["random", "greedy", "quadtree"])
@given(seed=st.integers(0, 99))
@examples(20)
def test_proposed_goals_are_unknown_reachable_apart_and_not_too_many(rule: str, seed: int) -> None:
    """Every rule: at most goal_count, none within half a range of another or of a held goal."""
    cost_map = scattered_walls(seed)
    here = int(np.flatnonzero(cost_map.fused_map.cells == FREE)[0])
    held = [int(cell) for cell in np.flatnonzero(cost_map.fused_map.cells == UNKNOWN)[::50]]
    field = cost_map.optimistic(here)
    rules = MarketRules(mission(f"planner.goals={rule}"), seed)

    goals = rules.propose(cost_map, field, 0, 7, held)

    assert len(goals) <= 5
    assert [field[goal] for goal in goals] == sorted(field[goal] for goal in goals)
    for goal in goals:
        assert cost_map.fused_map.cells[goal] == UNKNOWN
        assert field[goal] < math.inf
        assert all(cost_map.cells_between(goal, h) > 2.0 for h in {*held, *goals} - {goal})


def test_robot_drives_to_the_frontier_on_the_way_to_its_goal() -> None:
    """The nearest frontier is at the left end, the goal at the right."""
    cost_map = cost_map_of(CORRIDOR)
    rules = MarketRules(mission(), 0)
    asked = situation(cost_map, [member(0, 6)])

    assert rules.heading(asked, asked.members[0], 17) == 15
    assert rules.heading(asked, asked.members[0], NOWHERE) == 4


def test_way_to_a_goal_leads_round_known_walls() -> None:
    """As the crow flies the frontier at the wall is nearest to the goal, but it leads the long way."""
    cost_map = cost_map_of(
        "????????",
        "########",
        "........",
        "......##",
        "....##??",
        "....##??",
        "??....??",
    )
    rules = MarketRules(mission(), 0)
    asked = situation(cost_map, [member(0, 8 * 2)])

    assert rules.heading(asked, asked.members[0], 8 * 5 + 7) == 8 * 6 + 5


def test_without_a_way_to_any_frontier_there_is_no_target() -> None:
    """A goal changes nothing about it."""
    cost_map = cost_map_of("..#...??")
    rules = MarketRules(mission(), 0)
    asked = situation(cost_map, [member(0, 0)])

    assert rules.heading(asked, asked.members[0], 7) == NOWHERE
    assert rules.heading(asked, asked.members[0], NOWHERE) == NOWHERE
