"""Ways over a map: every value equals the paper's iteration, and no way touches a wall."""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from kantor_agent.mapping import routes
from kantor_agent.mapping.routes import COST_MIN, Routes, length_cost, smoothed_cost
from kantor_protocol.base.grid import CELLS_MAX
from support.strategies import SEEDS, examples

Values = npt.NDArray[np.float64]

STEPS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
"""(rows, columns), by the index of the cell that they lead to."""


class Floor(NamedTuple):
    """A map and where to start on it."""

    cost: Values
    """(rows, columns)"""
    source: int


def iterated(cost: Values, source: int) -> Values:
    """The reference: the paper's update of all cells at once, until nothing changes."""
    rows, columns = cost.shape
    price = np.pad(cost, 1, constant_values=np.inf)
    passable = np.isfinite(price) & (price > 0.0)
    value = np.full(price.shape, np.inf)
    if not (0 <= source < cost.size and passable[1:-1, 1:-1].ravel()[source]):
        return np.full(cost.size, np.inf)
    start = 1 + source // columns, 1 + source % columns
    value[start] = 0.0
    while True:
        before = value.copy()
        for i, j in STEPS:
            here = (slice(1, rows + 1), slice(1, columns + 1))
            there = (slice(1 + i, rows + 1 + i), slice(1 + j, columns + 1 + j))
            beside = (slice(1 + i, rows + 1 + i), here[1]), (here[0], slice(1 + j, columns + 1 + j))
            can = passable[here] & passable[there] & passable[beside[0]] & passable[beside[1]]
            offer = before[there] + (math.sqrt(2.0) if i and j else 1.0) * price[there]
            value[here] = np.where(can, np.fmin(value[here], offer), value[here])
        value[start] = 0.0
        if (value == before).all():
            return value[1:-1, 1:-1].ravel()


def drawn(seed: int, rows: int, columns: int, walls: float, lowest: float, highest: float) -> Floor:
    """Walls here and there and costs in between; every cost is 1 if they are to be the same."""
    draws = np.random.default_rng(seed)
    cost = draws.uniform(lowest, highest, (rows, columns)) if lowest < highest else None
    cost = np.full((rows, columns), lowest) if cost is None else cost
    source = int(draws.integers(rows * columns))
    cost[draws.random((rows, columns)) < walls] = np.inf
    cost.ravel()[source] = lowest
    return Floor(cost, source)


FLOORS = st.builds(
    drawn,
    SEEDS,
    st.integers(1, 14),
    st.integers(1, 14),
    st.sampled_from([0.0, 0.2, 0.4]),
    st.sampled_from([0.05, 1.0]),
    st.sampled_from([0.95, 1.0]),
)
ROUGH = st.builds(
    drawn,
    SEEDS,
    st.integers(1, 10),
    st.integers(1, 10),
    st.sampled_from([0.0, 0.3]),
    st.sampled_from([1e-4, 1e-3, 0.01]),
    st.sampled_from([0.5, 100.0]),
)
"""Costs too far apart for the buckets, or nearly."""


def spread(floor: Floor) -> tuple[Routes, Values]:
    """Spread over a fresh object, and a copy of the values."""
    made = Routes(*floor.cost.shape)
    return made, made.spread(floor.cost.ravel(), floor.source).copy()


def check_way(floor: Floor, value: Values, way: list[int], target: int) -> None:
    """It leads from the source to the target over passable cells, and costs what the value says."""
    columns = floor.cost.shape[1]
    passable = np.isfinite(floor.cost)
    paid = 0.0

    assert way[0] == floor.source
    assert way[-1] == target
    for here, there in itertools.pairwise(way):
        (row, column), (to_row, to_column) = divmod(here, columns), divmod(there, columns)
        step = (to_row - row, to_column - column)
        assert step in STEPS
        assert passable[row, column]
        assert passable[to_row, column]
        assert passable[row, to_column]
        assert passable[to_row, to_column]
        paid += math.hypot(*step) * floor.cost[row, column]
        assert value[there] > value[here]
    assert paid == pytest.approx(value[target], rel=1e-12, abs=1e-12)


@given(FLOORS | ROUGH)
@examples(300)
def test_values_are_those_of_the_papers_iteration(floor: Floor) -> None:
    """To the last bit: both add the same numbers in the same order along the same ways."""
    assert spread(floor)[1].tolist() == iterated(*floor).tolist()


@given(FLOORS)
@examples(100)
def test_buckets_and_heap_settle_the_same(floor: Floor) -> None:
    """Which of the two is used cannot be seen from the values."""
    _, value = spread(floor)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(routes, "RATIO_MAX", 0.0)
        assert spread(floor)[1].tolist() == value.tolist()


def test_costs_as_far_apart_as_the_buckets_hold_are_settled_by_them() -> None:
    """At the limit of the ratio the longest step comes just before the ring's beginning."""
    draws = np.random.default_rng(3)
    cost = draws.choice([1.0, routes.RATIO_MAX], (40, 40))
    cost[0, 0] = 1.0

    assert spread(Floor(cost, 0))[1].tolist() == iterated(cost, 0).tolist()


@given(FLOORS | ROUGH)
@examples(150)
def test_every_way_pays_its_value_and_keeps_off_walls(floor: Floor) -> None:
    """To every cell that is reached, and to no other."""
    made, value = spread(floor)
    for target in range(value.shape[0]):
        way = made.way(target).tolist()
        if math.isinf(value[target]):
            assert way == []
        else:
            check_way(floor, value, way, target)


@given(FLOORS | ROUGH, st.data())
@examples(150)
def test_a_spread_that_stops_at_a_cell_has_its_value_and_way(
    floor: Floor, data: st.DataObject
) -> None:
    """Others are at most too high."""
    made, value = spread(floor)
    until = data.draw(st.integers(0, value.shape[0] - 1))
    way = made.way(until).tolist()
    partial = made.spread(floor.cost.ravel(), floor.source, until=until)

    assert partial[until] == value[until]
    assert (partial >= value).all()
    assert made.way(until).tolist() == way


def test_a_spread_stops_early() -> None:
    """Next door is settled long before the far corner is met."""
    made = Routes(50, 50)

    assert np.isinf(made.spread(np.ones(2500), 0, until=1)[-1])


def test_of_ways_that_cost_the_same_the_last_steps_leave_the_lowest_value_then_index() -> None:
    """On open floor the diagonal step comes last or first; here last, as it leaves the lower value."""
    made = Routes(3, 4)
    made.spread(np.ones(12), 0)

    assert made.way(6).tolist() == [0, 1, 6]
    assert made.way(11).tolist() == [0, 1, 6, 11]
    assert made.way(9).tolist() == [0, 4, 9]


@given(FLOORS)
@examples(50)
def test_an_object_used_before_answers_as_a_fresh_one(floor: Floor) -> None:
    """Nothing of an earlier call is left, even of one that stopped half-way."""
    rows, columns = floor.cost.shape
    made = Routes(rows, columns)
    made.spread(np.ones(rows * columns), 0, until=rows * columns // 2)

    assert made.spread(floor.cost.ravel(), floor.source).tolist() == spread(floor)[1].tolist()


def test_a_way_does_not_change_with_costs_that_are_changed_later() -> None:
    """The costs are kept as they were."""
    cost = np.ones(9)
    made = Routes(3, 3)
    made.spread(cost, 0)
    cost[:] = np.inf

    assert made.way(8).tolist() == [0, 4, 8]


def test_no_way_slips_through_a_diagonal_gap() -> None:
    """Two walls that touch at a corner are a wall."""
    cost = np.ones((4, 4))
    cost[0, 1] = cost[1, 0] = np.inf
    made, value = spread(Floor(cost, 0))

    assert np.isinf(value[1:]).all()
    assert made.way(5).tolist() == []


def test_a_corner_is_walked_around() -> None:
    """Beside a single wall the diagonal is two straight steps."""
    cost = np.ones((2, 2))
    cost[0, 1] = np.inf

    assert spread(Floor(cost, 0))[1].tolist() == [0.0, math.inf, 1.0, 2.0]


def test_a_step_is_charged_by_the_cell_that_it_leaves() -> None:
    """As printed in the paper, so that there and back differ."""
    cost = np.array([[0.1, 0.9]])

    assert spread(Floor(cost, 0))[1].tolist() == [0.0, 0.1]
    assert spread(Floor(cost, 1))[1].tolist() == [0.9, 0.0]


def test_rows_are_not_joined_at_their_ends() -> None:
    """The last cell of a row and the first of the next are far apart."""
    cost = np.ones((3, 5))
    cost[:, 2] = np.inf

    assert np.isinf(spread(Floor(cost, 4))[1].reshape(3, 5)[:, :2]).all()


@pytest.mark.parametrize("source", [-1, -(10**6), 9, 10**6])
def test_from_outside_nothing_is_reached(source: int) -> None:
    """A source that is no cell is no error."""
    made = Routes(3, 3)

    assert np.isinf(made.spread(np.ones(9), source)).all()
    assert made.way(4).tolist() == []


@pytest.mark.parametrize("wall", [math.nan, math.inf, -math.inf, -1.0, 0.0, -0.0])
def test_what_is_no_positive_cost_is_a_wall(wall: float) -> None:
    """From it and beyond it nothing is reached."""
    cost = np.array([[1.0, wall, 1.0]])

    assert spread(Floor(cost, 0))[1].tolist() == [0.0, math.inf, math.inf]
    assert np.isinf(spread(Floor(cost, 1))[1]).all()


@given(
    st.lists(
        st.floats(allow_subnormal=True) | st.sampled_from([5e-324, 1e-308, 1e308, 1.0]),
        min_size=12,
        max_size=12,
    ),
    st.integers(-20, 20),
    st.integers(-20, 20),
)
@example([5e-324] * 12, 0, -1)
@example([1e308] * 12, 0, -1)
@examples(300)
def test_any_numbers_have_an_answer(numbers: list[float], source: int, until: int) -> None:
    """Costs that cannot be divided by one another, that overflow, or that vanish beside the value."""
    cost = np.array(numbers).reshape(3, 4)
    made = Routes(3, 4)
    if not 0 <= until < 12:
        with np.errstate(over="ignore", invalid="ignore"):
            want = iterated(np.where(cost > 0.0, cost, np.inf), source)
        assert made.spread(cost.ravel(), source, until=until).tolist() == want.tolist()
    else:
        made.spread(cost.ravel(), source, until=until)
    for target in range(-20, 20):
        assert made.way(target).shape[0] <= 12


def test_before_the_first_spread_there_is_no_way() -> None:
    """Not even to where one stands."""
    assert Routes(2, 2).way(0).tolist() == []


def test_costs_of_another_map_are_refused() -> None:
    """Kernels read as many costs as there are cells."""
    with pytest.raises(ValueError, match="for 6 cells"):
        Routes(2, 3).spread(np.ones(5), 0)


@pytest.mark.parametrize(("rows", "columns"), [(0, 3), (3, -1), (CELLS_MAX, 2)])
def test_a_grid_has_cells_but_not_too_many(rows: int, columns: int) -> None:
    """The room is made at once."""
    with pytest.raises(ValueError, match="cells"):
        Routes(rows, columns)


@pytest.mark.parametrize("turned", [np.fliplr, np.flipud, np.transpose])
def test_a_mirrored_map_has_mirrored_values(turned: Callable[[Values], Values]) -> None:
    """No direction is preferred."""
    floor = drawn(5, 30, 30, 0.25, 0.05, 0.95)
    cells = np.arange(900).reshape(30, 30)
    source = int(np.flatnonzero(turned(cells).ravel() == floor.source)[0])
    _, mirrored = spread(Floor(np.ascontiguousarray(turned(floor.cost)), source))

    assert mirrored.tolist() == turned(spread(floor)[1].reshape(30, 30)).ravel().tolist()


# Costs.


def test_length_is_one_for_every_passable_cell() -> None:
    """And a wall is no way."""
    assert length_cost(np.array([[True, False], [True, True]])).tolist() == [1, math.inf, 1, 1]


def test_smoothing_makes_floor_beside_walls_dear_and_never_opens_a_wall() -> None:
    """Cost falls with the distance from the wall, down to the floor."""
    p_occ = np.full((9, 21), 0.05)
    p_occ[:, 0] = 0.95
    cost = smoothed_cost(p_occ, np.full((9, 21), True), sigma_cells=1.5, p_max=0.5).reshape(9, 21)

    assert np.isinf(cost[:, 0]).all()
    assert (np.diff(cost[:, 1:7], axis=1) < 0.0).all()
    assert cost[:, 7:].tolist() == pytest.approx(np.full((9, 14), COST_MIN))


def test_what_is_not_explored_is_not_passable_whatever_is_believed() -> None:
    """It counts as half occupied, so that floor beside it is dear."""
    p_occ = np.full((1, 30), 0.05)
    explored = np.arange(30)[None, :] < 20
    cost = smoothed_cost(p_occ, explored, sigma_cells=1.5, p_max=0.5)

    assert np.isinf(cost[20:]).all()
    assert cost[19] > 0.1 > cost[10]


def test_certainly_free_floor_costs_something() -> None:
    """At 0 no cell would be nearer than another."""
    cost = smoothed_cost(np.zeros((5, 5)), np.full((5, 5), True), sigma_cells=1.5, p_max=0.5)

    assert cost.tolist() == [COST_MIN] * 25


@given(SEEDS)
@examples(40)
def test_smoothed_costs_lie_between_the_floor_and_one(seed: int) -> None:
    """And are finite exactly where floor is explored."""
    draws = np.random.default_rng(seed)
    p_occ, explored = draws.uniform(0.05, 0.95, (12, 9)), draws.random((12, 9)) < 0.7
    cost = smoothed_cost(p_occ, explored, sigma_cells=1.5, p_max=0.5).reshape(12, 9)

    assert (np.isfinite(cost) == (explored & (p_occ < 0.5))).all()
    assert ((cost >= COST_MIN) & ((cost <= 0.95) | np.isinf(cost))).all()
