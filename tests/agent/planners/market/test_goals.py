"""Goals in unexplored space: from a quadtree, greedily, or at random."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners.market.goals import (
    clear_disc,
    greedy_goals,
    quadtree_goals,
    random_goals,
)
from kantor_protocol.base.counter_rng import Purpose, uniform
from support.strategies import examples
from support.teams.markets import cost_map_of


def test_quadtree_splits_until_leaves_are_two_ranges_long() -> None:
    """8 x 8 cells, range 1: sixteen leaves of 2 x 2, and a goal in the middle of each."""
    cost_map = cost_map_of(*["?" * 8] * 8, range_m=1.0)

    assert quadtree_goals(cost_map) == [
        8 * row + column for row in (1, 3, 5, 7) for column in (1, 3, 5, 7)
    ]


def test_quadtree_leaf_of_two_ranges_is_not_split() -> None:
    """8 x 8 cells, range 4: the whole map is one leaf."""
    assert quadtree_goals(cost_map_of(*["?" * 8] * 8)) == [8 * 4 + 4]


def test_quadtree_proposes_nothing_where_three_quarters_are_known() -> None:
    """Range 1, leaves of 2 x 2: one of four cells is too little, and so are 4 of 16."""
    assert quadtree_goals(cost_map_of("....", ".???", "??..", "??..", range_m=1.0)) == [7, 13]
    assert quadtree_goals(cost_map_of("....", ".?.?", "?...", "?...", range_m=1.0)) == []


def test_quadtree_centre_that_is_known_is_no_goal() -> None:
    """A goal is given up when its cell is known, so this one would be given up at once."""
    assert quadtree_goals(cost_map_of("??", "?.", range_m=1.0)) == []


def test_quadtree_ends_when_ranges_are_tiny() -> None:
    """With a range below half a cell every unknown cell is a goal."""
    assert quadtree_goals(cost_map_of("?.?", range_m=0.01)) == [0, 2]


def test_greedy_takes_the_cheapest_a_range_apart() -> None:
    """From cell 2, range 4: cell 3 costs 1, then 7 and 11 are the next at least 4 away."""
    cost_map = cost_map_of("...????????????")
    field = cost_map.optimistic(2)

    assert greedy_goals(cost_map, field, [], 5) == [3, 7, 11]
    assert greedy_goals(cost_map, field, [], 2) == [3, 7]


def test_greedy_leaves_out_cells_within_half_a_range_of_a_held_goal() -> None:
    """Goal 4 is held: 3 and up to 6 are as good as taken; 7 is not."""
    cost_map = cost_map_of("...????????????")

    assert greedy_goals(cost_map, cost_map.optimistic(2), [4], 5) == [7, 11]


def test_greedy_of_equals_takes_the_lowest_cell() -> None:
    """Both sides of the robot are as near."""
    cost_map = cost_map_of("??.??")

    assert greedy_goals(cost_map, cost_map.optimistic(2), [], 1) == [1]


def test_greedy_does_not_propose_cells_enclosed_by_walls() -> None:
    """All cells behind the wall are unknown, and stay so."""
    cost_map = cost_map_of("..#???")

    assert greedy_goals(cost_map, cost_map.optimistic(0), [], 5) == []


def test_random_goals_are_keyed_draws_without_known_cells() -> None:
    """Cells anywhere, by seed, robot and tick; the known and repeated ones are left out."""
    cost_map = cost_map_of("????????........")
    drawn = [int(uniform(3, Purpose.MARKET, 1, 20, i) * 16) for i in range(64)]
    left = [cell for cell in dict.fromkeys(drawn) if cell < 8]

    assert random_goals(cost_map, 3, 1, 20, 64) == left
    assert random_goals(cost_map, 3, 1, 21, 64) != left


@given(st.integers(0, 99), st.floats(0.1, 30.0), st.integers(1, 10))
@examples(50)
def test_cleared_disc_is_the_cells_nearer_than_its_radius(
    cell: int, radius_cells: float, columns: int
) -> None:
    """The kernel against plain distances."""
    cell %= 10 * columns
    values = np.zeros(10 * columns)
    clear_disc(values, columns, cell, radius_cells)

    for other in range(10 * columns):
        rows, across = other // columns - cell // columns, other % columns - cell % columns
        inside = math.hypot(rows, across) < radius_cells or other == cell
        assert (values[other] == math.inf) == inside
