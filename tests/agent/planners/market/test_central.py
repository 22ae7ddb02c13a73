"""The market of a supervisor, which knows all tours and trades for all robots at once."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners.map_base import Task
from kantor_agent.planners.market.costs import Costs
from kantor_agent.planners.market.goals import quadtree_goals
from kantor_agent.planners.market.planner import Market
from kantor_protocol.base.grid import FREE
from support.strategies import examples
from support.teams.floors import member
from support.teams.markets import (
    CORRIDOR,
    TOURS,
    cost_map_of,
    mission,
    scattered_walls,
    situation,
    tour_length,
)


def central_market(*overrides: str, **tours: list[int]) -> Market:
    """A supervisor's market with tours, by `r0`, `r1`, …"""
    market = Market(mission(*overrides), 0, None)
    market.form.tours = {int(name[1:]): tour for name, tour in tours.items()}
    return market


def test_goals_go_to_the_robot_that_reaches_them_cheapest() -> None:
    """Robots at 5 and 14 hold the far ends. 17 costs r0 12, r1 bids 3 + 15 - 12 = 6; then 2 costs r1 15, r0 3."""
    market = central_market(r0=[17], r1=[2])

    tasks = market.assign(situation(cost_map_of(CORRIDOR), [member(0, 5), member(1, 14)]))

    assert market.form.tours == {0: [2], 1: [17]}
    assert [task.target for task in tasks] == [4, 15]
    assert not market.negotiates


def test_without_a_better_bid_the_seller_keeps_its_goal() -> None:
    """An equal bid is none: from 9 and 9 both ways are as long."""
    market = central_market(r0=[17], r1=[2])

    market.assign(situation(cost_map_of(CORRIDOR), [member(0, 9), member(1, 9)]))

    assert market.form.tours == {0: [17], 1: [2]}


def test_of_equal_bids_the_lowest_place_wins() -> None:
    """r0 is far; r1 and r2 stand side by side."""
    market = central_market(r0=[17], r1=[2], r2=[2])

    market.assign(situation(cost_map_of(CORRIDOR), [member(0, 5), member(1, 14), member(2, 14)]))

    assert 17 in market.form.tours[1]
    assert 17 not in market.form.tours[2]


def test_goals_are_auctioned_again_as_positions_change() -> None:
    """The robots have changed sides; so do the goals."""
    market = central_market(r0=[2], r1=[17])

    market.assign(situation(cost_map_of(CORRIDOR), [member(0, 14), member(1, 5)]))

    assert market.form.tours == {0: [17], 1: [2]}


def test_robots_together_hold_every_unknown_leaf_once() -> None:
    """No robot proposes a goal that another holds."""
    cost_map = cost_map_of(*["?" * 24] * 11, "?" * 10 + "...." + "?" * 10, *["?" * 24] * 12)
    market = Market(mission("planner.goal_count=8"), 0, None)

    market.assign(situation(cost_map, [member(i, 24 * 11 + 11) for i in range(3)]))

    tours = market.form.tours
    assert sorted(goal for tour in tours.values() for goal in tour) == quadtree_goals(cost_map)
    assert all(tours.values())


def test_goals_that_are_known_or_unreachable_are_given_up() -> None:
    """Cell 8 is known; 18 lies behind a wall."""
    market = central_market(r0=[2, 8, 18], r1=[])

    market.assign(situation(cost_map_of("????........#..????"), [member(0, 6), member(1, 7)]))

    assert market.form.tours[0] == [2]


def test_goals_of_a_robot_out_of_contact_are_free() -> None:
    """A robot that is left proposes its goals anew."""
    market = central_market(r0=[2], r1=[17])

    market.assign(situation(cost_map_of(CORRIDOR), [member(0, 5)]))

    assert market.form.tours == {0: [2]}


def test_robots_that_keep_their_targets_trade_as_well() -> None:
    """Only r0 is given a target, but all robots trade."""
    market = central_market(r0=[17], r1=[2])

    tasks = market.assign(situation(cost_map_of(CORRIDOR), [member(0, 5)], [member(1, 14)]))

    assert market.form.tours == {0: [2], 1: [17]}
    assert [task.target for task in tasks] == [4]


def test_idle_robot_drives_to_the_nearest_frontier() -> None:
    """Too few cells are unknown for a goal; without this the mission would never end."""
    cost_map = cost_map_of("..................?.")
    [task] = Market(mission(), 0, None).assign(situation(cost_map, [member(0, 3)]))

    assert task == Task(17)


@given(st.integers(0, 30), st.lists(TOURS, min_size=3, max_size=3))
@examples(40)
def test_every_sale_shortens_the_tours(seed: int, tours: list[list[int]]) -> None:
    """A pass never makes the sum longer, and loses and doubles nothing."""
    cost_map = scattered_walls(seed)
    free = np.flatnonzero(cost_map.fused_map.cells == FREE)[:3].tolist()
    fields = [cost_map.optimistic(cell) for cell in free]
    reached = [cell for cell in range(400) if all(field[cell] < math.inf for field in fields)]
    taken: set[int] = set()
    market = central_market(r0=[], r1=[], r2=[])
    for robot, tour in enumerate(tours):
        goals = [cell for cell in tour if cell in reached and cell not in taken]
        market.form.tours[robot] = goals
        taken.update(goals)
    costs = Costs(cost_map, fields, taken)
    before = sum(tour_length(costs, i, tour) for i, tour in market.form.tours.items())

    market.form.sell(costs, [0, 1, 2])

    after = sum(tour_length(costs, i, tour) for i, tour in market.form.tours.items())
    assert after <= before + 1e-9
    assert sorted(g for tour in market.form.tours.values() for g in tour) == sorted(taken)
