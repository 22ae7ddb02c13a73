"""When a robot gives a target up, and what it learns at a wall."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.mapping.pursuit import Pursuit, wall_met
from kantor_protocol.base.grid import FREE, NOWHERE, free_way
from kantor_protocol.base.machine import Pose
from kantor_worldsim.world.world import stopped
from support.grounds import drawn
from support.strategies import examples

PATIENCE = 60
ROOM = drawn(
    "#######",
    "#.#...#",
    "#.#.#.#",
    "#...#.#",
    "#######",
)


def driven(cells: float, steps: int, pursuit: Pursuit | None = None) -> Pursuit:
    """A pursuit with a way of 10 cells that gets no shorter, after so many steps of so many cells each."""
    pursuit = pursuit or Pursuit(PATIENCE)
    pursuit.follow(10.0)
    for _ in range(steps):
        pursuit.drive(cells, 0.0, bumped=False)
        pursuit.follow(10.0)
    return pursuit


@examples(200)
@given(cells=st.floats(1e-6, 10.0), left_cells=st.floats(0.5, 1e4), steps=st.integers(1, 2000))
def test_a_robot_that_gets_nearer_is_never_in_vain(
    cells: float, left_cells: float, steps: int
) -> None:
    """At any speed, be it a millionth of a cell in a step."""
    pursuit = Pursuit(PATIENCE)
    for step in range(min(steps, int(left_cells / cells))):
        pursuit.follow(left_cells - step * cells)
        pursuit.drive(cells, 0.0, bumped=False)
        assert not pursuit.is_vain


def test_to_wait_and_to_turn_is_no_effort() -> None:
    """However long: for another robot to pass, or for the vehicle to come about."""
    pursuit = driven(0.0, 100_000)
    for _ in range(100_000):
        pursuit.drive(0.0, 0.01, bumped=True)
    assert not pursuit.is_vain


@pytest.mark.parametrize("cells", [0.01, 0.5, 1.0, 8.0])
def test_a_robot_that_drives_about_in_vain_gives_up_after_a_distance(cells: float) -> None:
    """Its patience in cells and the way that is left; and not before as many steps as its patience."""
    steps = math.ceil((PATIENCE + 10.0) / min(1.0, cells))
    assert not driven(cells, steps - 2).is_vain
    assert driven(cells, steps + 2).is_vain


def test_a_detour_is_no_failure() -> None:
    """A wall that turns up makes the way longer than the patience."""
    pursuit = driven(1.0, 5)
    for left_cells in range(500, 10, -1):
        pursuit.follow(float(left_cells))
        pursuit.drive(1.0, 0.0, bumped=False)
        assert not pursuit.is_vain


def test_steps_at_a_wall_and_steps_without_a_way_count() -> None:
    """They end a pursuit that moves no further."""
    bumping, lost = Pursuit(PATIENCE), Pursuit(PATIENCE)
    for _ in range(PATIENCE + 1):
        assert not bumping.is_vain
        assert not lost.is_vain
        bumping.drive(0.0, 0.0, bumped=True)
        lost.miss()
    assert bumping.is_vain
    assert lost.is_vain


def test_another_target_begins_anew() -> None:
    """Nothing of the last pursuit counts."""
    pursuit = driven(1.0, 200)
    assert pursuit.is_vain
    pursuit.begin()
    assert not pursuit.is_vain


@examples(400)
@given(
    cell=st.sampled_from(np.flatnonzero(ROOM.cells == FREE).tolist()),
    within=st.tuples(st.floats(0.0, 0.999), st.floats(0.0, 0.999)),
    angle_rad=st.floats(-math.pi, math.pi),
    way_m=st.floats(1e-3, 5.0),
)
def test_the_wall_that_a_robot_met_is_a_wall(
    cell: int, within: tuple[float, float], angle_rad: float, way_m: float
) -> None:
    """Wherever it drives; where it is unclear which of two cells it was, none is named."""
    frame, cells = ROOM
    x_m, y_m = cell % frame.columns + within[0], cell // frame.columns + within[1]
    start = Pose(x_m, y_m)
    end = Pose(x_m + way_m * math.cos(angle_rad), y_m + way_m * math.sin(angle_rad), angle_rad)
    stop, bumped = stopped(ROOM, start, end)
    met = wall_met(frame, start, end, stop) if bumped else NOWHERE
    assert met == NOWHERE or cells.flat[met] != FREE
    straight = abs(math.remainder(angle_rad, math.pi / 2.0)) < 0.1
    middle = abs(x_m % 1.0 - 0.5) < 0.2 and abs(y_m % 1.0 - 0.5) < 0.2
    if bumped and straight and middle and way_m < 1.0:
        assert free_way(cells, FREE, *frame.uv(x_m, y_m), *frame.uv(end.x_m, end.y_m)) < 1.0
        assert met != NOWHERE


def test_a_robot_that_was_not_stopped_met_nothing() -> None:
    """A move without a length, and one that ends amid a cell."""
    frame, pose = ROOM.frame, Pose(1.5, 1.5)
    assert wall_met(frame, pose, pose, pose) == NOWHERE
    assert wall_met(frame, pose, Pose(1.5, 2.5), Pose(1.5, 2.5)) == NOWHERE
