"""Frames, and the cells that a line crosses."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.grid import FREE, NOWHERE, Frame, free_way, neighbour
from support.grounds import Place, drawn, places
from support.strategies import examples


def test_cells_are_counted_from_the_lower_left() -> None:
    """Row by row; outside there is none."""
    frame = Frame(0.5, (-1.0, 2.0), 3, 4)

    assert [frame.cell_of(x, y) for x, y in ((-1.0, 2.0), (0.99, 2.2), (-0.6, 3.4))] == [0, 3, 8]
    assert [frame.cell_of(x, y) for x, y in ((-1.01, 2.0), (1.0, 2.0), (0.0, 3.5))] == [NOWHERE] * 3
    assert frame.centre_of(9) == (-0.25, 3.25)
    assert frame.extent_m == (-1.0, 1.0, 2.0, 3.5)
    assert frame.diagonal_m == pytest.approx(2.5)


@given(rows=st.integers(1, 50), columns=st.integers(1, 50), data=st.data())
def test_the_middle_of_a_cell_is_in_it(rows: int, columns: int, data: st.DataObject) -> None:
    """Wherever the map lies."""
    origin = data.draw(st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)))
    frame = Frame(data.draw(st.sampled_from([0.05, 0.2, 1.0])), origin, rows, columns)
    cell = data.draw(st.integers(0, frame.cells - 1))

    assert frame.cell_of(*frame.centre_of(cell)) == cell


@given(rows=st.integers(1, 9), columns=st.integers(1, 9))
def test_neighbours_are_the_cells_at_a_cells_width(rows: int, columns: int) -> None:
    """Below, left, right, above; NOWHERE beyond the border."""
    frame = Frame(1.0, (0.0, 0.0), rows, columns)
    for cell in range(frame.cells):
        x, y = frame.centre_of(cell)
        expected = [frame.cell_of(x + u, y + v) for u, v in ((0, -1), (-1, 0), (1, 0), (0, 1))]

        assert [neighbour(cell, side, columns, frame.cells) for side in range(4)] == expected


CORNER = drawn(
    "...",
    ".#.",
    "...",
).cells


@pytest.mark.parametrize(
    ("start", "end", "share"),
    [
        ((0.5, 0.5), (2.5, 0.5), 1.0),
        ((0.5, 0.5), (2.5, 2.5), 0.25),
        ((0.5, 1.5), (2.5, 1.5), 0.25),
        ((0.5, 1.5), (1.5, 2.5), 0.5),
        ((1.5, 2.5), (0.5, 1.5), 0.5),
        ((0.5, 2.5), (0.5, 9.5), 0.5 / 7.0),
        ((0.5, 0.5), (0.5, 0.5), 1.0),
    ],
    ids=["free", "into", "straight into", "past a corner", "and back", "off the map", "nowhere"],
)
def test_a_way_is_free_up_to_a_wall(
    start: tuple[float, float], end: tuple[float, float], share: float
) -> None:
    """A corner that is touched counts as a wall."""
    assert free_way(CORNER, FREE, *start, *end) == pytest.approx(share)


@examples(200)
@given(place=places(), data=st.data())
def test_a_margin_forbids_no_less(place: Place, data: st.DataObject) -> None:
    """A way that keeps from corners is free without a margin too, however it is rounded."""
    frame, cells = place.ground
    cell = data.draw(st.integers(0, frame.cells - 1))
    u = (place.pose.x_m - frame.origin_m[0]) / frame.resolution_m
    v = (place.pose.y_m - frame.origin_m[1]) / frame.resolution_m
    to_u, to_v = cell % frame.columns + 0.5, cell // frame.columns + 0.5
    if free_way(cells, FREE, u, v, to_u, to_v, 1e-3) < 1.0:
        return
    for share in np.linspace(0.0, 1.0, 7).tolist():
        part_u, part_v = u + share * (to_u - u), v + share * (to_v - v)
        assert free_way(cells, FREE, u, v, part_u, part_v) == 1.0
        assert free_way(cells, FREE, part_u, part_v, to_u, to_v) == 1.0
        assert math.isfinite(part_u + part_v)
