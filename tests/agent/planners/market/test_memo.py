"""Memos: any register is read as one, any memo fits into one, and no robot depends on what others announce."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners.map_base import Task
from kantor_agent.planners.market.memo import Memo, packed, unpacked
from kantor_agent.planners.market.planner import Market
from kantor_agent.planners.market.rules import MarketRules
from kantor_protocol.replication.registers import NUMBER_MAX
from support.strategies import examples
from support.teams.floors import member
from support.teams.markets import CORRIDOR, cost_map_of, mission, situation

NUMBERS = st.integers(-NUMBER_MAX, NUMBER_MAX)


@given(st.lists(NUMBERS | st.integers(-2, 30), max_size=88))
@examples(200)
def test_any_register_is_read_as_a_valid_memo(numbers: list[int]) -> None:
    """Any numbers: cells are on the map, successors in the team; packed again, the memo is the same."""
    memo = unpacked(numbers, 3, 20)

    assert memo.clock >= 0
    assert -1 <= memo.offered < 20
    assert len(memo.acknowledged) == len(memo.bids) == 3
    assert all(0 <= goal < 20 and -1 <= successor < 3 for goal, successor in memo.tour)
    numbers = list(packed(memo))
    while numbers and numbers[-1] == 0:
        numbers.pop()
    assert unpacked(numbers, 3, 20) == memo


@pytest.mark.parametrize("robots", [1, 2, 8, 1000])
def test_longest_memo_fits_into_a_register(robots: int) -> None:
    """A full tour, the offers of all others answered, an offer of its own."""
    scenario = mission(f"robots.count={robots}")
    tour = tuple((cell, robots - 1) for cell in range(MarketRules(scenario, 0).capacity))
    memo = Memo(9, 7, 5, 3, (1,) * robots, (1,) * robots, tour)

    assert len(tour) >= 28
    assert len(packed(memo)) <= scenario.register_width - 4


@given(st.lists(st.lists(NUMBERS | st.integers(-2, 30), max_size=88), min_size=3, max_size=3))
@examples(50)
def test_robot_survives_any_announcement(announced: list[list[int]]) -> None:
    """The robot has a target, and its own memo fits."""
    cost_map, scenario = cost_map_of(CORRIDOR), mission()
    market, task = Market(scenario, 0, 1), Task()
    for tick, memo in enumerate(announced):
        others = [member(robot, 5, 4, tuple(memo)) for robot in (0, 2)]
        [task] = market.assign(situation(cost_map, [member(1, 7 + tick, *task)], others, tick))

        assert task.target in (4, 15)
        assert len(task.memo) <= scenario.register_width - 4
        assert all(abs(number) <= NUMBER_MAX for number in task.memo)
