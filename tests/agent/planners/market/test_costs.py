"""Costs of tours: insertions, savings, distances between goals, and prices."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners.market.costs import Costs, price_of, separate
from kantor_protocol.base.grid import FREE, OCCUPIED
from kantor_protocol.replication.registers import NUMBER_MAX
from support.strategies import examples
from support.teams.markets import TOURS, cost_map_of, scattered_walls, tour_length


@given(st.integers(0, 30), TOURS, st.integers(0, 399))
@examples(60)
def test_insertion_is_the_cheapest_of_all_places(seed: int, tour: list[int], goal: int) -> None:
    """Against tours written out; among equals the first; no insertion shortens a tour."""
    cost_map = scattered_walls(seed)
    here = int(np.flatnonzero(cost_map.fused_map.cells == FREE)[0])
    field = cost_map.optimistic(here)
    tour = [cell for cell in tour if field[cell] < math.inf]
    costs = Costs(cost_map, [field], [*tour, goal])
    tours = [[*tour[:i], goal, *tour[i:]] for i in range(len(tour) + 1)]
    longer = [tour_length(costs, 0, one) - tour_length(costs, 0, tour) for one in tours]

    cost, before = costs.insertion(0, tour, goal)

    if field[goal] == math.inf:
        assert (cost, before) == (math.inf, len(tour))
    else:
        assert cost == pytest.approx(min(longer), abs=1e-9)
        assert longer[before] == pytest.approx(cost, abs=1e-9)
        assert cost >= -1e-9


@given(st.integers(0, 30), TOURS, st.data())
@examples(40)
def test_saving_is_what_the_tour_gets_shorter(
    seed: int, tour: list[int], data: st.DataObject
) -> None:
    """Against tours written out."""
    cost_map = scattered_walls(seed)
    field = cost_map.optimistic(int(np.flatnonzero(cost_map.fused_map.cells == FREE)[0]))
    tour = [cell for cell in tour if field[cell] < math.inf]
    if not tour:
        return
    goal = data.draw(st.sampled_from(tour))
    costs = Costs(cost_map, [field], tour)
    rest = [cell for cell in tour if cell != goal]

    saved = tour_length(costs, 0, tour) - tour_length(costs, 0, rest)

    assert costs.saving(0, tour, goal) == pytest.approx(saved, abs=1e-9)


def test_saving_of_an_unreachable_goal_is_infinite() -> None:
    """A robot that gets there may have it."""
    cost_map = cost_map_of("..#???..")
    costs = Costs(cost_map, [cost_map.optimistic(0)], [4, 5])

    assert costs.saving(0, [4, 5], 4) == math.inf


@given(st.integers(0, 30), TOURS, st.integers(1, 3))
@examples(40)
def test_distances_between_goals_are_a_metric_and_no_way_is_shorter(
    seed: int, goals: list[int], places: int
) -> None:
    """The kernel against a plain reference; the triangle inequality; a bound on the true ways."""
    cost_map = scattered_walls(seed)
    free = np.flatnonzero(cost_map.fused_map.cells == FREE)[:places].tolist()
    fields = [cost_map.optimistic(cell) for cell in free]
    cells = np.array(goals, dtype=np.int64)
    between = np.zeros((cells.size, cells.size))
    separate(np.array([field[cells] for field in fields]), cells, 20, between)

    for (i, a), (j, b) in itertools.product(enumerate(goals), repeat=2):
        reached = [(f[a], f[b]) for f in fields if min(f[a], f[b]) < math.inf]
        plain = max([cost_map.cells_between(a, b), *(abs(p - q) for p, q in reached)])
        assert between[i, j] == plain
        if cost_map.fused_map.cells[a] != OCCUPIED:
            assert plain <= cost_map.optimistic(a)[b] + 1e-9
        for k in range(cells.size):
            assert between[i, j] <= between[i, k] + between[k, j] + 1e-9


def test_prices_are_bounded() -> None:
    """An unreachable goal costs a lot; parts of a cell count."""
    assert price_of(math.inf) < NUMBER_MAX
    assert price_of(2.5) == 40
