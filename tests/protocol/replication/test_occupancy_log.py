"""What robots conclude from scans: never a false wall nor a false way, as long as nothing is noisy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN, next_cell
from kantor_protocol.base.machine import Pose
from kantor_protocol.replication.occupancy_log import (
    CERTAIN,
    CODES,
    HIT,
    NO_RETURN,
    PASS,
    RANGE_BINS,
    OccupancyLog,
    ScanReader,
    beam_rad,
    bump,
    dead_frontier,
    entries,
    given_up_frontier,
    retried_frontier,
)
from kantor_protocol.scenario.schema import SensorOptions
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.sensors import RangeFinder
from support.grounds import Place, drawn, places
from support.references.plain_scan import evidence_of
from support.strategies import examples

BEAMS = st.sampled_from([1, 4, 8, 24, 360]) | st.integers(1, 400)
VIEWS_DEG = st.sampled_from([360.0, 360.0, 180.0, 90.0]) | st.floats(1.0, 360.0)
RANGES_CELLS = st.sampled_from([0.5, 1.0, 2.0, 5.0, 40.0]) | st.floats(0.1, 15.0)


def sensor_of(
    ground: Ground,
    range_cells: float,
    beams: int = 360,
    view_deg: float = 360.0,
    noise_cells: float = 0.0,
) -> SensorOptions:
    side_m = ground.frame.resolution_m
    return SensorOptions(
        range_m=range_cells * side_m,
        beams=beams,
        field_of_view_deg=view_deg,
        noise_m=noise_cells * side_m,
    )


def scanned(ground: Ground, sensor: SensorOptions, *poses: Pose) -> OccupancyLog:
    """What a robot concludes from one scan at each pose."""
    finder = RangeFinder(sensor, ground, 1)
    evidence = OccupancyLog(ground.frame, sensor, ranges=False)
    for step, pose in enumerate(poses):
        evidence.observe(finder.scan(0, step, pose), pose, moved=True)
    return evidence


def codes(*values: int) -> bytes:
    return np.array(values, dtype="<u2").tobytes()


# Without noise.


@examples(1500)
@given(place=places(), range_cells=RANGES_CELLS, beams=BEAMS, view_deg=VIEWS_DEG)
def test_scan_never_contradicts_the_truth(
    place: Place, range_cells: float, beams: int, view_deg: float
) -> None:
    """No wall is taken for free and nothing free for a wall, on borders and at corners neither."""
    ground, pose = place
    evidence = scanned(ground, sensor_of(ground, range_cells, beams, view_deg), pose)
    truth = ground.cells.ravel()

    assert (truth[evidence.kinds == FREE] == FREE).all()
    assert (truth[evidence.kinds == OCCUPIED] != FREE).all()


def beside(ground: Ground, pose: Pose) -> list[int]:
    """The cell that a pose is in and its four neighbours, as far as there are any."""
    rows, columns = ground.cells.shape
    row, column = divmod(ground.frame.cell_of(pose.x_m, pose.y_m), columns)
    near = [
        (row, column),
        (row - 1, column),
        (row + 1, column),
        (row, column - 1),
        (row, column + 1),
    ]
    return [r * columns + c for r, c in near if 0 <= r < rows and 0 <= c < columns]


@examples(400)
@given(place=places(), range_cells=st.floats(1.5, 20.0))
def test_a_sweep_shows_the_four_cells_beside(place: Place, range_cells: float) -> None:
    """After a sweep a robot knows the four cells beside its own, wherever it stands in it."""
    ground, pose = place
    evidence = scanned(ground, sensor_of(ground, range_cells), pose)

    assert (evidence.kinds[beside(ground, pose)] != UNKNOWN).all()


@examples(300)
@given(place=places(), range_cells=st.floats(0.5, 20.0), beams=BEAMS)
def test_what_a_beam_crosses_is_known(place: Place, range_cells: float, beams: int) -> None:
    """Every free cell that a beam crosses properly, and does not merely touch, is known as free."""
    ground, pose = place
    frame, cells = ground
    evidence = scanned(ground, sensor_of(ground, range_cells, beams), pose)
    u = (pose.x_m - frame.origin_m[0]) / frame.resolution_m
    v = (pose.y_m - frame.origin_m[1]) / frame.resolution_m
    for beam in range(beams):
        angle = beam_rad(pose.heading_rad, math.tau, beams, beam)
        row, column, way = math.floor(v), math.floor(u), 0.0
        while 0 <= row < frame.rows and 0 <= column < frame.columns and cells[row, column] == FREE:
            here = row * frame.columns + column
            row, column, after = next_cell(row, column, u, v, math.cos(angle), math.sin(angle))
            if min(after, range_cells) - way > 0.01:
                assert evidence.kinds[here] == FREE
            if after > range_cells:
                break
            way = after


def test_wall_in_front_is_seen_through_its_face() -> None:
    """A beam along an axis, from the middle of a cell: free up to the wall, unknown behind it."""
    ground = drawn("......", "...#..", "......")
    pose = Pose(0.5, 1.5, 0.0)
    evidence = scanned(ground, sensor_of(ground, 10.0, 1), pose)

    assert evidence.kinds.reshape(3, 6)[1].tolist() == [
        FREE,
        FREE,
        FREE,
        OCCUPIED,
        UNKNOWN,
        UNKNOWN,
    ]
    assert evidence.kinds.sum() == 3 * FREE + OCCUPIED


def test_a_corner_says_nothing() -> None:
    """A beam that ends where four cells meet does not tell which of them is the wall."""
    ground = drawn("..#", ".#.", "...")
    evidence = scanned(ground, sensor_of(ground, 10.0, 1), Pose(0.5, 0.5, math.pi / 4))

    assert evidence.kinds.tolist() == [FREE] + 8 * [UNKNOWN]


def test_nothing_within_range_frees_the_way() -> None:
    """A beam without a return: all cells up to the range are free, also the one that it ends in."""
    ground = drawn("........")
    evidence = scanned(ground, sensor_of(ground, 3.2, 1), Pose(0.5, 0.5, 0.0))

    assert evidence.kinds.tolist() == 4 * [FREE] + 4 * [UNKNOWN]


# Sums.


def test_one_update_for_each_cell_and_scan() -> None:
    """Hundreds of beams pass the robot's own cell, and it counts once."""
    ground = drawn("#####", "#...#", "#####")
    evidence = scanned(ground, sensor_of(ground, 9.0), Pose(2.5, 1.5))
    odds = evidence.odds.reshape(3, 5)

    assert odds[1].tolist() == [HIT, PASS, PASS, PASS, HIT]
    assert odds[0].tolist() == odds[2].tolist() == [0, HIT, HIT, HIT, 0]


def test_no_cell_is_ever_certain() -> None:
    """Sums end at P = 0.05 and 0.95; a change of mind stays possible."""
    ground = drawn("#...#")
    evidence = scanned(ground, sensor_of(ground, 9.0), *20 * [Pose(2.5, 0.5)])

    assert evidence.odds.tolist() == [CERTAIN, -CERTAIN, -CERTAIN, -CERTAIN, CERTAIN]
    assert 1.0 / (1.0 + math.exp(CERTAIN / 100.0)) == pytest.approx(0.05, abs=0.001)


@pytest.mark.parametrize(
    ("hits", "passes", "evidence"), [(1, 1, HIT), (1, 2, HIT), (1, 3, PASS), (8, 17, PASS)]
)
def test_scan_is_the_sum_of_its_beams(hits: int, passes: int, evidence: int) -> None:
    """Some beams end at a cell, others pass it: a hit outweighs two passes, in either order, each scan anew."""
    ground = drawn("........")
    beams = hits * [round(3 / 8 * CODES)] + passes * [NO_RETURN]
    sensor = sensor_of(ground, 8.0, len(beams), 1.0)
    evidences = [OccupancyLog(ground.frame, sensor, ranges=False) for _ in range(2)]
    for times in (1, 2):
        for layer, scan in zip(evidences, (beams, beams[::-1]), strict=True):
            layer.observe(codes(*scan), Pose(0.0, 0.5), moved=True)
            told = [*(3 * [PASS]), evidence, *(4 * [PASS])]

            assert layer.odds.tolist() == [times * step for step in told]


def test_later_evidence_turns_a_cell() -> None:
    """A wall that is gone becomes free once more evidence speaks against it than for it."""
    ground = drawn("....")
    sensor = sensor_of(ground, 4.0, 1)
    evidence = OccupancyLog(ground.frame, sensor, ranges=False)
    pose, cell = Pose(0.5, 0.5), 2
    told = [evidence.observe(codes(round(1.5 / 4.0 * CODES)), pose, moved=True).tolist()]
    told += [evidence.observe(codes(NO_RETURN), pose, moved=True).tolist() for _ in range(3)]

    assert told == [[0, 2, 2 * cell + 1], [6], [], [2 * cell]]


# What is told.


@examples(200)
@given(place=places(), data=st.data())
def test_entries_are_the_changes_of_kind(place: Place, data: st.DataObject) -> None:
    """Rising, each cell at most once, and together they are the layer."""
    ground, pose = place
    sensor = sensor_of(ground, 6.0, 24)
    evidence = OccupancyLog(ground.frame, sensor, ranges=False)
    told = np.zeros(ground.frame.cells, dtype=np.uint8)
    scans = data.draw(
        st.lists(st.lists(st.integers(0, NO_RETURN), min_size=24, max_size=24), max_size=6)
    )
    for scan in scans:
        news = evidence.observe(codes(*scan), pose, moved=True)
        assert (np.diff(news // 2) > 0).all()
        kinds = np.where(news % 2 == 1, OCCUPIED, FREE)
        assert (told[news // 2] != kinds).all()
        told[news // 2] = kinds

    assert (told == evidence.kinds).all()
    assert (np.abs(evidence.odds) <= CERTAIN).all()
    assert ((evidence.odds > 0) <= (evidence.kinds == OCCUPIED)).all()
    assert ((evidence.odds < 0) <= (evidence.kinds == FREE)).all()


def test_ranges_are_reported_after_a_move_only() -> None:
    """A few of each scan, in bins; what found nothing is in the last bin."""
    ground = drawn("..#")
    sensor = sensor_of(ground, 4.0, 16, 1.0)
    evidence = OccupancyLog(ground.frame, sensor, ranges=True)
    near, none = codes(*16 * [round(1.5 / 4.0 * CODES)]), codes(*16 * [NO_RETURN])
    first, base = 3 * ground.frame.cells, RANGE_BINS

    assert evidence.observe(near, Pose(0.5, 0.5), moved=True)[-4:].tolist() == 4 * [first + 11]
    assert evidence.observe(near, Pose(0.5, 0.5), moved=False).tolist() == []
    assert (evidence.observe(none, Pose(0.5, 0.5), moved=True)[-4:] == first + base - 1).all()
    kinds = (dead_frontier, given_up_frontier, retried_frontier, bump)
    dead, given_up, retried, wall = (
        [kind(ground.frame, cell) for cell in range(ground.frame.cells)] for kind in kinds
    )
    ranges = list(range(first, first + base))
    assert [*dead, *ranges, *given_up, *retried, *wall] == list(
        range(2 * ground.frame.cells, entries(ground.frame))
    )


@pytest.mark.parametrize("scan", [b"", b"\0", 719 * b"\0", 722 * b"\0"])
def test_scan_of_another_size_changes_nothing(scan: bytes) -> None:
    """It changes nothing."""
    ground = drawn("...")
    evidence = OccupancyLog(ground.frame, sensor_of(ground, 4.0), ranges=True)

    assert evidence.observe(scan, Pose(0.5, 0.5), moved=True).size == 0
    assert not evidence.odds.any()


@examples(200)
@given(
    x_m=st.floats(allow_nan=True, allow_infinity=True),
    y_m=st.floats(allow_nan=True, allow_infinity=True),
    scan=st.lists(st.integers(0, NO_RETURN), min_size=8, max_size=8),
    noise=st.sampled_from([0.0, 0.5]),
)
def test_from_outside_a_scan_says_nothing(
    x_m: float, y_m: float, scan: list[int], noise: float
) -> None:
    """A pose that is not on the map adds no evidence, however absurd it is."""
    ground = drawn("...", "...")
    evidence = OccupancyLog(ground.frame, sensor_of(ground, 4.0, 8, 360.0, noise), ranges=False)
    evidence.observe(codes(*scan), Pose(x_m, y_m), moved=True)
    inside = 0.0 <= x_m < 3.0 and 0.0 <= y_m < 2.0

    assert evidence.odds.any() == inside


@examples(300)
@given(
    place=places(),
    range_cells=RANGES_CELLS,
    scan=st.lists(st.integers(0, NO_RETURN), min_size=1, max_size=24),
    view_deg=VIEWS_DEG,
    noise_cells=st.sampled_from([0.0, 0.1, 0.5]),
)
def test_scan_is_read_as_by_the_plain_reference(
    place: Place, range_cells: float, scan: list[int], view_deg: float, noise_cells: float
) -> None:
    """Cells and evidence are exactly those of the reference, whatever the ranges say."""
    (frame, _), pose = place
    sensor = sensor_of(place[0], range_cells, len(scan), view_deg, noise_cells)
    evidence = ScanReader(frame, sensor).read(codes(*scan), pose).tolist()

    expected = evidence_of(frame, sensor, scan, pose)
    assert evidence == [2 * cell + occupied for cell, occupied in expected]


# With noise.

ROOMS = drawn(
    "########################",
    "#..........#...........#",
    "#..........#...........#",
    "#..........#....##.....#",
    "#...............##.....#",
    "#......................#",
    "#..........#...........#",
    "#.....##...#...........#",
    "#.....##...#.......#...#",
    "#..........#...........#",
    "########################",
    resolution_m=0.2,
)


@pytest.mark.parametrize(("noise_cells", "right"), [(0.1, 0.99), (0.25, 0.99), (0.5, 0.95)])
def test_noise_averages_out(noise_cells: float, right: float) -> None:
    """After scans from many poses nearly all cells that were seen are what they are."""
    frame, cells = ROOMS
    free = [cell for cell in range(frame.cells) if cells.flat[cell] == FREE]
    poses = [Pose(*frame.centre_of(cell), 0.1 * i) for i, cell in enumerate(free[::3])]
    evidence = scanned(ROOMS, sensor_of(ROOMS, 12.0, noise_cells=noise_cells), *poses)
    known = evidence.kinds != UNKNOWN
    same = (evidence.kinds == FREE) == (cells.ravel() == FREE)

    assert known[cells.ravel() == FREE].all()
    assert same[known].mean() >= right
