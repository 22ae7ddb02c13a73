"""Sensing on the true map: ranges, noise, and walls between two places."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.grid import FREE
from kantor_protocol.base.machine import Pose
from kantor_protocol.replication.occupancy_log import CODES, NO_RETURN, beam_rad
from kantor_protocol.scenario.schema import SensorOptions
from kantor_worldsim.world.maps import Cells, Ground
from kantor_worldsim.world.sensors import RangeFinder, walls_between, way_to_wall
from support.grounds import HEADINGS, Place, drawn, grounds, places
from support.references.plain_philox import philox_plain
from support.strategies import SEEDS, examples

Codes = npt.NDArray[np.uint16]


def crossings(
    cells: Cells, u: float, v: float, du: float, dv: float
) -> list[tuple[float, int, int]]:
    """Every border that a ray crosses on the map, computed directly: (distance along it, row and column beyond).

    In order; at a corner the column changes first.
    """
    rows, columns = cells.shape
    column, row = math.floor(u), math.floor(v)
    met: list[tuple[float, int, int, int]] = []
    if du > 0.0:
        met += [((border - u) / du, 0, border, 1) for border in range(column + 1, columns + 1)]
    if du < 0.0:
        met += [((border - u) / du, 0, -border, -1) for border in range(column, -1, -1)]
    if dv > 0.0:
        met += [((border - v) / dv, 1, border, 1) for border in range(row + 1, rows + 1)]
    if dv < 0.0:
        met += [((border - v) / dv, 1, -border, -1) for border in range(row, -1, -1)]
    ways = []
    for way, axis, _, step in sorted(met):
        if axis == 0:
            column += step
        else:
            row += step
        ways.append((way, row, column))
        if not (0 <= row < rows and 0 <= column < columns):
            break
    return ways


def is_wall(cells: Cells, row: int, column: int) -> bool:
    rows, columns = cells.shape
    return not (0 <= row < rows and 0 <= column < columns) or cells[row, column] != FREE


def plain_way(cells: Cells, u: float, v: float, angle_rad: float, range_cells: float) -> float:
    """`way_to_wall`, computed directly."""
    for way, row, column in crossings(cells, u, v, math.cos(angle_rad), math.sin(angle_rad)):
        if is_wall(cells, row, column):
            return max(0.0, way) if way <= range_cells else math.inf
    raise AssertionError("every ray leaves the map")


def in_cells(ground: Ground, pose: Pose) -> tuple[float, float]:
    x_m, y_m = ground.frame.origin_m
    side_m = ground.frame.resolution_m
    return (pose.x_m - x_m) / side_m, (pose.y_m - y_m) / side_m


def scan_of(
    ground: Ground,
    sensor: SensorOptions,
    pose: Pose,
    *,
    seed: int = 1,
    robot: int = 0,
    step: int = 1,
) -> Codes:
    """(beams,) the codes of one scan."""
    return np.frombuffer(RangeFinder(sensor, ground, seed).scan(robot, step, pose), dtype="<u2")


# Ranges.


@examples(1000)
@given(place=places(), angle_rad=HEADINGS, range_cells=st.floats(0.1, 20.0))
def test_the_distance_to_the_wall_is_that_of_the_direct_computation(
    place: Place, angle_rad: float, range_cells: float
) -> None:
    """Exactly, also from borders, along them and through corners."""
    u, v = in_cells(*place)
    way = way_to_wall(place.ground.cells, u, v, angle_rad, range_cells)

    assert way == plain_way(place.ground.cells, u, v, angle_rad, range_cells)


@examples(200)
@given(
    place=places(),
    beams=st.integers(1, 60),
    view_deg=st.sampled_from([360.0, 90.0, 1.0]),
    range_m=st.floats(0.01, 30.0),
)
def test_a_scan_has_ranges_in_fractions_of_the_sensor_range(
    place: Place, beams: int, view_deg: float, range_m: float
) -> None:
    """Exactly: each beam to the nearest part, and nothing beyond the range."""
    ground, pose = place
    u, v = in_cells(ground, pose)
    range_cells = range_m / ground.frame.resolution_m
    codes = []
    for beam in range(beams):
        angle_rad = beam_rad(pose.heading_rad, math.radians(view_deg), beams, beam)
        way = plain_way(ground.cells, u, v, angle_rad, range_cells)
        codes.append(NO_RETURN if way == math.inf else round(way / range_cells * CODES))
    sensor = SensorOptions(range_m=range_m, beams=beams, field_of_view_deg=view_deg)

    assert scan_of(ground, sensor, pose).tolist() == codes


def test_range_is_inclusive() -> None:
    """A wall at exactly the range returns; the outside of the map is a wall."""
    ground = drawn("....#")
    ahead = {"beams": 1, "field_of_view_deg": 1.0}

    assert scan_of(ground, SensorOptions(range_m=3.5, **ahead), Pose(0.5, 0.5)).tolist() == [CODES]
    assert scan_of(ground, SensorOptions(range_m=3.49, **ahead), Pose(0.5, 0.5)).tolist() == [
        NO_RETURN
    ]
    assert scan_of(
        ground, SensorOptions(range_m=1.0, **ahead), Pose(0.5, 0.5, math.pi)
    ).tolist() == [CODES // 2]


def test_unknown_cells_are_walls() -> None:
    """A robot neither moves nor senses through a cell that the map leaves unknown."""
    ahead = SensorOptions(range_m=4.0, beams=1)

    assert scan_of(drawn("..?."), ahead, Pose(0.0, 0.5)).tolist() == [CODES // 2]


@examples(200)
@given(
    ground=grounds(),
    u=st.floats(allow_nan=True, allow_infinity=True),
    v=st.floats(allow_nan=True, allow_infinity=True),
    angle_rad=st.floats(allow_nan=True, allow_infinity=True),
)
def test_a_beam_ends_from_any_place_and_in_any_direction(
    ground: Ground, u: float, v: float, angle_rad: float
) -> None:
    """The kernel is total: from any place, in any direction, it returns a range or none."""
    assert 0.0 <= way_to_wall(ground.cells, u, v, angle_rad, 20.0) <= math.inf


# Noise.


def test_noise_depends_on_its_key_alone() -> None:
    """A draw depends on seed, robot, step and beam, and on nothing else."""
    ground = drawn(40 * ".")
    sensor = SensorOptions(range_m=50.0, beams=1, noise_m=2.0)
    for seed, robot, step in [(1, 0, 1), (2, 0, 1), (1, 1, 1), (1, 0, 2), (1, 0, 0)]:
        words = philox_plain(seed, (Purpose.SCAN, robot, step, 0))
        first, second = words[1] << 32 | words[0], words[3] << 32 | words[2]
        units = (first >> 11) * 2.0**-53, (second >> 11) * 2.0**-53
        normal = math.sqrt(-2.0 * math.log(1.0 - units[0])) * math.cos(math.tau * units[1])
        codes = scan_of(ground, sensor, Pose(10.0, 0.5), seed=seed, robot=robot, step=step)

        assert codes.tolist() == [round((30.0 + 2.0 * normal) / 50.0 * CODES)]


def test_noise_is_normal() -> None:
    """Mean, deviation and tails of many beams; neighbours are independent."""
    ground = drawn(*(101 * [101 * "."]))
    sensor = SensorOptions(range_m=100.0, beams=10_000, noise_m=1.5, field_of_view_deg=1e-6)
    codes = np.concatenate(
        [scan_of(ground, sensor, Pose(50.5, 50.5), step=step) for step in range(4)]
    )
    normal = (codes / CODES * 100.0 - 50.5) / 1.5

    assert abs(normal.mean()) < 4.0 / math.sqrt(normal.size)
    assert abs(normal.std() - 1.0) < 4.0 / math.sqrt(2.0 * normal.size)
    assert abs((np.abs(normal) > 1.96).mean() - 0.05) < 4.0 * math.sqrt(0.05 * 0.95 / normal.size)
    assert abs(np.corrcoef(normal[1:], normal[:-1])[0, 1]) < 4.0 / math.sqrt(normal.size)


@examples(50)
@given(place=places(), seed=SEEDS, noise_m=st.floats(0.01, 100.0))
def test_noise_stays_within_the_range(place: Place, seed: int, noise_m: float) -> None:
    """A noisy range is clamped; a beam without a return still has none."""
    ground, pose = place
    exact = SensorOptions(range_m=2.0, beams=60)
    noisy = SensorOptions(range_m=2.0, beams=60, noise_m=noise_m)
    codes = scan_of(ground, noisy, pose, seed=seed)

    assert ((codes == NO_RETURN) == (scan_of(ground, exact, pose) == NO_RETURN)).all()
    assert (codes[codes != NO_RETURN] <= CODES).all()


# Walls between.


@pytest.mark.parametrize(
    ("place", "walls"),
    [
        ((2.5, 4.5), 0),
        ((3.5, 4.5), 1),  # inside a wall
        ((4.5, 4.5), 1),
        ((9.5, 4.5), 2),  # a thick one counts once
        ((4.5, 2.5), 1),
        ((0.5, 0.5), 0),
        ((1.5, 0.5), 1),
        ((9.5, 0.5), 1),
        ((12.5, 4.5), 3),  # outside is one
        ((0.5, 99.5), 1),
        ((math.nan, math.nan), 0),
    ],
)
def test_walls_are_counted_along_the_line(place: tuple[float, float], walls: int) -> None:
    """Each run of cells that are not free is a wall, from either end."""
    ground = drawn(
        "...#.??#..",
        "...#......",
        "...#......",
        ".####.....",
        "..........",
    )
    here = (0.5, 4.5)

    assert walls_between(ground.cells, *here, *place) == walls
    assert walls_between(ground.cells, *place, *here) == walls


PLACES = st.tuples(
    st.sampled_from([0.0, 0.5, 1.0, 3.0, -2.0, 12.5]) | st.floats(-3.0, 12.0),
    st.sampled_from([0.0, 0.5, 1.0, 3.0, -2.0, 12.5]) | st.floats(-3.0, 12.0),
)


@examples(1000)
@given(ground=grounds(), one=PLACES, other=PLACES)
def test_walls_are_the_same_from_either_end(
    ground: Ground, one: tuple[float, float], other: tuple[float, float]
) -> None:
    """As many walls from either end, and none if the direct computation meets none."""
    cells = ground.cells
    rows, columns = cells.shape
    walls = walls_between(cells, *one, *other)
    ends = sorted([one, other])
    start, end = ends if 0.0 <= ends[0][0] < columns and 0.0 <= ends[0][1] < rows else ends[::-1]
    inside = 0.0 <= start[0] < columns and 0.0 <= start[1] < rows

    assert walls == walls_between(cells, *other, *one)
    if not inside:
        assert walls == 1
        return
    way = [(math.floor(start[1]), math.floor(start[0]))]
    met = crossings(cells, *start, end[0] - start[0], end[1] - start[1])
    way += [(row, column) for share, row, column in met if share < 1.0]
    closed = [is_wall(cells, *cell) for cell in way]

    assert walls == sum(b and not a for a, b in zip([False, *closed], closed, strict=False))
