"""Costs are those of the plain rules, however often and wherever the map has changed before they are read."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.mapping.routes import iterate_once
from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.replication.occupancy_log import entries
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.load import parse
from support.strategies import examples
from support.teams.floors import Floor

FRAME = Frame(0.5, (0.0, 0.0), 7, 9)
RULES = (
    ("planner.cost=length",),
    ("planner.smoothing_cells=0",),
    ("planner.smoothing_cells=1",),
    ("planner.smoothing_cells=2.5", "planner.occupied_from=0.7"),
)
MISSION = """
name = "costs"
map = { layout = "blank", size_m = [4, 4] }
robots = { count = 1 }
starts = { random = true }
planner = { name = "burgard" }
"""
BELOW = [*range(2 * FRAME.cells), *range(5 * FRAME.cells + 32, 6 * FRAME.cells + 32)]
"""Entries about cells, and bumps."""


@pytest.mark.parametrize("overrides", RULES)
@examples(40)
@given(
    logs=st.lists(st.lists(st.sampled_from(BELOW), max_size=40), min_size=2, max_size=2),
    cuts=st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40), st.booleans()), max_size=4),
)
def test_costs_in_parts_are_the_plain_costs(
    overrides: tuple[str, ...], logs: list[list[int]], cuts: list[tuple[int, int, bool]]
) -> None:
    """`validate` compares them to the last bit, after folds of which some are not followed by a question."""
    scenario = parse(MISSION, "costs", overrides)
    held = Replica(0, 2, entries(FRAME), None, ledger=True, claims=False)
    for origin, log in enumerate(logs):
        held.reserve(len(log))
        held.store.logs[origin, : len(log), 0] = log
    fused_map = FusedMap(FRAME, 2)
    cost_map = CostMap(scenario, fused_map)
    for *lengths, asked in [*cuts, (40, 40, True)]:
        for origin, length in enumerate(lengths):
            grown = min(length, len(logs[origin]))
            held.store.length[origin] = max(grown, held.store.length[origin])
        fused_map.fold(held)
        if asked:
            fused_map.validate(held)
            cost_map.validate()
            cost_map.optimistic(0)


def test_a_robot_that_noise_has_put_into_a_wall_gets_out_of_it() -> None:
    """Its cell is open for its own ways, and a wall again afterwards."""
    floor = Floor(np.array([[FREE, OCCUPIED, FREE]], dtype=np.uint8))
    ways = floor.cost_map.travel(1, np.array([0, 2]))

    assert ways.tolist() == [1.0, 1.0]
    assert floor.cost_map.travel(0, np.array([2])).tolist() == [math.inf]
    floor.validate()


def test_robots_that_know_otherwise_are_not_answered_from_memory() -> None:
    """The same question over other costs is another one."""
    open_, walled = np.full((1, 5), FREE, dtype=np.uint8), np.full((1, 5), FREE, dtype=np.uint8)
    walled[0, 2] = OCCUPIED
    to = np.array([4])
    floors = [Floor(open_), Floor(walled), Floor(open_)]

    assert [floor.cost_map.travel(0, to).item() for floor in floors] == [4.0, math.inf, 4.0]


def test_values_at_targets_are_those_of_the_whole_map() -> None:
    """The spread ends with the last target, which changes no value."""
    draws = np.random.default_rng(7)
    cells = np.where(draws.random((20, 30)) < 0.75, FREE, OCCUPIED).astype(np.uint8)
    cells[0, 0] = FREE
    floor = Floor(cells)
    to = np.flatnonzero(draws.random(600) < 0.1)
    whole = floor.cost_map.travel(0)

    assert floor.cost_map.travel(0, to).tolist() == whole[to].tolist()
    cost = np.where(cells == FREE, 1.0, np.inf)
    assert iterate_once(cost, whole.reshape(20, 30), 0).ravel().tolist() == whole.tolist()


@pytest.mark.parametrize("between", [FREE, OCCUPIED])
def test_a_frontier_is_reached_only_by_a_way(between: int) -> None:
    """A frontier behind a wall does not count."""
    cells = np.array([[FREE, between, FREE, UNKNOWN]], dtype=np.uint8)

    assert Floor(cells).cost_map.reaches_frontier(0) == (between == FREE)
