"""The cheapest assignment of robots to frontiers, against all assignments."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners.hungarian import Hungarian, cheapest_pairs, spread_out
from kantor_agent.planners.map_base import Situation
from kantor_protocol.base.grid import NOWHERE
from support.strategies import SEEDS, examples
from support.teams.floors import Floor, crowded, drawn, member

CORRIDOR = ["  ........  "]
"""Frontiers are 2 and 9, and the sensor reaches 3 cells."""


def targets(floor: Floor, situation: Situation) -> list[int]:
    """What the planner chooses."""
    return [task.target for task in Hungarian(floor.scenario, 0, None).assign(situation)]


def test_the_total_cost_is_least() -> None:
    """Both are nearer to 2. Of 1 + 4 and 3 + 6 cells the first is less."""
    floor = drawn(CORRIDOR)

    assert targets(floor, floor.situation([member(0, 3), member(1, 5)])) == [2, 9]
    assert targets(floor, floor.situation([member(0, 5), member(1, 3)])) == [9, 2]


@pytest.mark.parametrize("taken", ["others", "absent"])
def test_no_robot_is_sent_where_others_head_for(taken: str) -> None:
    """Nor half a sensor range around, while there is something else."""
    floor = drawn(CORRIDOR)
    others = [member(1, 5, 3)] if taken == "others" else []
    absent = [3] if taken == "absent" else []

    assert targets(floor, floor.situation([member(0, 4)], others, absent)) == [9]
    assert targets(floor, floor.situation([member(0, 4)], others, [*absent, 9])) == [2]


def test_robots_without_a_frontier_of_their_own_take_thecheapest_pairs() -> None:
    """Three robots and two frontiers: the one in the middle is left over."""
    floor = drawn(CORRIDOR)

    assert targets(floor, floor.situation([member(0, 3), member(1, 5), member(2, 8)])) == [2, 2, 9]


def test_frontiers_side_by_side_are_one_to_choose_from() -> None:
    """Cells 11 to 15 are an opening of five cells: two robots fit, 1.5 cells apart at least."""
    floor = drawn(["#######", "#.....#", "#.....#", "       "][::-1])
    found = targets(floor, floor.situation([member(0, 15), member(1, 16), member(2, 17)]))

    assert found[0] == 8
    assert min(abs(a - b) for a, b in itertools.combinations(found, 2)) >= 2


def test_a_robot_that_reaches_no_frontier_gets_no_target() -> None:
    """And takes nothing from those who do."""
    floor = drawn(["###.... ", "#.#####."])

    assert targets(floor, floor.situation([member(0, 9), member(1, 0), member(2, 3)])) == [
        NOWHERE,
        NOWHERE,
        6,
    ]
    sealed = drawn(["#.#"])
    assert targets(sealed, sealed.situation([member(0, 1), member(1, 1)])) == [NOWHERE] * 2


@examples(200)
@given(
    seed=SEEDS,
    robots=st.integers(1, 4),
    spots=st.integers(0, 5),
    closed=st.sampled_from([0.0, 0.3, 0.8]),
)
def test_no_assignment_is_cheaper(seed: int, robots: int, spots: int, closed: float) -> None:
    """As many pairs as are possible, and of those the least sum; against all assignments."""
    dice = np.random.default_rng(seed)
    travel = dice.integers(0, 20, (robots, spots)).astype(float)
    travel[dice.random((robots, spots)) < closed] = math.inf
    pairs = cheapest_pairs(travel)

    def rated(choice: tuple[int | None, ...]) -> tuple[int, float]:
        costs = [travel[i, spot] for i, spot in enumerate(choice) if spot is not None]
        return -len(costs), sum(costs)

    free = [*range(spots), *[None] * robots]
    choices = (c for c in itertools.permutations(free, robots) if math.isfinite(rated(c)[1]))
    chosen = dict(pairs)
    assert len(set(chosen.values())) == len(pairs) == len(chosen)
    assert rated(tuple(chosen.get(i) for i in range(robots))) == min(map(rated, choices))


@examples(150)
@given(
    seed=SEEDS,
    columns=st.integers(1, 15),
    taken=st.integers(0, 3),
    apart=st.sampled_from([0.0, 1.0, 1.5, 2.0, 5.0]),
)
def test_spots_lie_apart(seed: int, columns: int, taken: int, apart: float) -> None:
    """From one another and from what is taken, the first come first; against plain loops."""
    dice = np.random.default_rng(seed)
    frontiers = np.flatnonzero(dice.random(10 * columns) < 0.3)
    order, held = dice.permutation(frontiers.size), dice.integers(0, 10 * columns, taken)
    kept = np.zeros_like(order)
    count = spread_out(frontiers, order, held, apart, columns, kept)

    expected: list[int] = []
    for place in order.tolist():
        rivals = [*held.tolist(), *(int(frontiers[p]) for p in expected)]
        cell = int(frontiers[place])
        away = [math.dist(divmod(cell, columns), divmod(rival, columns)) for rival in rivals]
        if all(d >= apart for d in away):
            expected.append(place)
    assert kept[:count].tolist() == expected


@examples(150)
@given(data=st.data())
def test_every_robot_that_can_reach_a_frontier_gets_one(data: st.DataObject) -> None:
    """Its cheapest frontier, or one that lies half a sensor range from all that is taken."""
    floor, situation = data.draw(crowded())
    held = [other.task.target for other in situation.others if other.task.target != NOWHERE]
    taken = [*held, *situation.absent]
    for asked, target in zip(situation.members, targets(floor, situation), strict=True):
        travel = floor.cost_map.travel(asked.cell)[situation.frontiers]
        if not np.isfinite(travel).any():
            assert target == NOWHERE
            continue
        assert np.isfinite(travel[situation.frontiers == target]).all()
        away = min((floor.cost_map.cells_between(target, cell) for cell in taken), default=math.inf)
        assert target == situation.frontiers[travel.argmin()] or away >= 1.5
