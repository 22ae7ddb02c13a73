"""Maps from drawings and at random, and missions on them."""

import math
from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st

from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.base.machine import Pose
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.maps import Ground

_KINDS = {".": FREE, "#": OCCUPIED, "?": UNKNOWN}

_ON_A_MAP = """
name = "on-a-map"

[map]
layout = "blank"

[robots]
count = 1

[starts]
random = true

[planner]
name = "frontier"
"""


def exploration(*overrides: str) -> Scenario:
    """A mission on a map with `key.sub=value` overrides. Tests put their own map in its place."""
    return parse(_ON_A_MAP, "on-a-map", overrides)


def drawn(
    *rows: str, resolution_m: float = 1.0, origin_m: tuple[float, float] = (0.0, 0.0)
) -> Ground:
    """A map from a drawing, highest row first: `.` free, `#` wall, `?` unknown."""
    cells = np.array([[_KINDS[mark] for mark in row] for row in reversed(rows)], dtype=np.uint8)
    return Ground(Frame(resolution_m, origin_m, *cells.shape), cells)


SMALL = drawn(
    "########",
    "#..#...#",
    "#..#.#.#",
    "#....#.#",
    "########",
)
"""Two corridors round a wall, in which robots have to turn back."""


class Place(NamedTuple):
    """A map and a pose in one of its free cells."""

    ground: Ground
    pose: Pose


_SIDES_M = st.sampled_from([1.0, 0.2, 0.05, 0.3])
_ORIGINS = st.sampled_from([0.0, -3.7, 1e4]) | st.floats(-100.0, 100.0)
_WITHIN = st.sampled_from([0.0, 0.0, 0.5, 1e-9, 0.25, 1.0 - 2**-40]) | st.floats(0.0, 0.999)
"""Of a cell: on a border, in the middle, anywhere."""
HEADINGS = st.sampled_from([k * math.pi / 4 for k in range(-4, 9)]) | st.floats(-7.0, 7.0)


@st.composite
def grounds(draw: st.DrawFn, most: int = 9) -> Ground:
    """A small map with at least one free cell."""
    rows, columns = draw(st.integers(1, most)), draw(st.integers(1, most))
    marks = draw(st.sampled_from(["....#", ".#", ".", ".......?#"]))
    kinds = st.sampled_from([_KINDS[mark] for mark in marks])
    size = rows * columns
    cells = np.array(draw(st.lists(kinds, min_size=size, max_size=size)), dtype=np.uint8)
    cells[draw(st.integers(0, size - 1))] = FREE
    frame = Frame(draw(_SIDES_M), (draw(_ORIGINS), draw(_ORIGINS)), rows, columns)
    return Ground(frame, cells.reshape(rows, columns))


@st.composite
def places(draw: st.DrawFn, most: int = 9) -> Place:
    """A small map and a pose in a free cell, on its lower borders more often than not."""
    ground = draw(grounds(most))
    frame, cells = ground
    rows, columns = np.nonzero(cells == FREE)
    i = draw(st.integers(0, len(rows) - 1))
    x_m = frame.origin_m[0] + (int(columns[i]) + draw(_WITHIN)) * frame.resolution_m
    y_m = frame.origin_m[1] + (int(rows[i]) + draw(_WITHIN)) * frame.resolution_m
    cell = frame.cell_of(x_m, y_m)
    if cell < 0 or cells.flat[cell] != FREE:  # rounding has moved it over a border
        x_m, y_m = frame.centre_of(int(rows[i]) * frame.columns + int(columns[i]))
    return Place(ground, Pose(x_m, y_m, draw(HEADINGS)))
