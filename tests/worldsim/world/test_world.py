"""The truth: the steps that the world accepts, and the targets that robots detect."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.grid import FREE, Frame, free_way
from kantor_protocol.base.machine import SUPERVISOR, Body, Outputs, Pose
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.base.varint import Pairs
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.wire.messages import RefusedError
from kantor_worldsim.record.records import Opening, decode_record, encode_record, opening_of
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.sensors import RangeFinder
from kantor_worldsim.world.world import STANDOFF_CELLS, StepVerdict, World, WorldSetup, stopped
from support.grounds import HEADINGS, drawn, exploration, places
from support.grounds import Place as Stand
from support.strategies import SEEDS, examples, mission

PERIOD_NS = 100_000_000
STEP_M = 10.0
"""Distance in metres that a robot may move in a period."""
Place = tuple[float, float]

SPENT = Pairs().encode(np.array([3, 4]), np.array([1, 1]), 2)
"""A whole point: two units."""


def setup(*targets: Place) -> WorldSetup:
    """Twelve samples, three robots, and these targets."""
    return WorldSetup(
        np.zeros((12, 2)),
        np.array(targets, dtype=np.float64).reshape(-1, 2),
        np.array([[0.0, 0.0], [90.0, 20.0], [50.0, 80.0]]),
    )


def world(*targets: Place, overrides: tuple[str, ...] = ()) -> World:
    """A world with r1 at the origin and these targets."""
    return World(mission("sensor.range_m=5", *overrides), 1, setup(*targets))


def step_record(
    there: World,
    step: int,
    place: Place = (0.0, 0.0),
    spent: bytes = b"",
    name: str = "r1",
    now_ns: int | None = None,
) -> StepVerdict:
    """A robot's step at its time, one a period unless a time is given."""
    when = PERIOD_NS * step if now_ns is None else now_ns
    return there.accept(name, when, Outputs(step, Pose(*place), spent=spent))


# Motion.


@pytest.mark.parametrize(
    ("place", "violations"),
    [
        ((STEP_M, 0.0), ()),
        ((6.0, -8.0), ()),
        ((STEP_M * (1.0 + 0.9e-6), 0.0), ()),
        ((STEP_M * (1.0 + 1.1e-6), 0.0), ("speed",)),
        ((8.0, 8.0), ("speed",)),
        ((math.inf, 0.0), ("speed",)),
        ((math.nan, 0.0), ("speed",)),
    ],
)
def test_a_move_is_no_longer_than_speed_times_time(place: Place, violations: tuple[str]) -> None:
    """A longer move is refused whole: the robot stays where it was."""
    there = world()
    verdict = step_record(there, 1, place)

    assert verdict.violations == violations
    assert there.pose("r1") == verdict.pose == (Pose(0.0, 0.0) if violations else Pose(*place))
    assert there.observe("r1").pose == verdict.pose


def test_the_time_since_the_last_accepted_step_counts() -> None:
    """A robot that was silent may have moved on; one that was refused may not move twice as far."""
    there = world()

    assert step_record(there, 1, (30.0, 0.0), now_ns=3 * PERIOD_NS).violations == ()
    assert step_record(there, 2, (60.0, 0.0), now_ns=4 * PERIOD_NS).violations == ("speed",)
    assert step_record(there, 3, (50.0, 0.0), now_ns=5 * PERIOD_NS).violations == ("speed",)
    assert step_record(there, 4, (40.0, 0.0), now_ns=6 * PERIOD_NS).violations == ()


def test_the_supervisor_does_not_move() -> None:
    """The supervisor cannot move at all."""
    there = world(overrides=("coordination=centralized",))

    assert step_record(there, 1, (50.0, 50.0), name=SUPERVISOR).violations == ()
    assert step_record(there, 2, (50.0, 50.1), name=SUPERVISOR).violations == ("speed",)
    assert there.pose(SUPERVISOR) == Pose(50.0, 50.0)


@pytest.mark.parametrize(("step", "now_ns"), [(2, 9 * PERIOD_NS), (1, 9 * PERIOD_NS), (3, 1)])
def test_a_stale_step_changes_nothing(step: int, now_ns: int) -> None:
    """A step that was accepted already, or lies in the past, is refused as a whole."""
    there = world((8.0, 0.0), overrides=("energy.steps=1",))
    step_record(there, 2, (2.0, 0.0))
    stale = step_record(there, step, (8.0, 0.0), SPENT, now_ns=now_ns)

    assert stale == StepVerdict(Pose(2.0, 0.0), violations=("step",))
    assert (there.observe("r1").step, there.observe("r1").pose) == (2, Pose(2.0, 0.0))
    assert step_record(there, 3, (8.0, 0.0), SPENT).violations == ()


# Bodies.


def test_a_body_outlives_the_incarnations_that_drive_it() -> None:
    """Pose, step and energy go on through all incarnations; the world keeps the present one."""
    there = world(overrides=("energy.steps=2",))
    step_record(there, 1, (2.0, 0.0), SPENT)
    first = there.body("r1")
    changed = [there.begin("r1", incarnation) for incarnation in (0, 3, 3)]
    verdicts = [step_record(there, step, (2.0, 0.0), SPENT).violations for step in (2, 3)]

    assert first == Body(Pose(2.0, 0.0), 1, 1, 0)
    assert changed == [False, True, False]
    assert verdicts == [(), ("energy",)]
    assert there.body("r1") == Body(Pose(2.0, 0.0), 3, 2, 3)
    assert there.body("r2") == Body(Pose(90.0, 20.0))


# Energy.


def test_the_energy_budget_is_not_exceeded() -> None:
    """A robot ships as many points as it has energy for, and no more."""
    there = world(overrides=("energy.steps=2",))
    verdicts = [step_record(there, step, spent=SPENT).violations for step in range(1, 5)]

    assert verdicts == [(), (), ("energy",), ("energy",)]
    assert step_record(there, 5, (1.0, 0.0)).violations == ()
    assert step_record(there, 1, (90.0, 20.0), SPENT, name="r2").violations == ()


@pytest.mark.parametrize(
    "spent",
    [
        Pairs().encode(np.array([3, 4]), np.array([1, 2]), 2),
        Pairs().encode(np.array([3]), np.array([0]), 1),
        Pairs().encode(np.array([12]), np.array([1]), 1),
        b"\x80",
        b"\x02",
    ],
    ids=["too-much", "nothing", "no-sample", "cut", "half-a-pair"],
)
def test_an_impossible_point_is_refused_and_costs_no_energy(spent: bytes) -> None:
    """More units than a point holds, none, or bytes that do not decode: no energy is spent on it."""
    there = world(overrides=("energy.steps=1",))

    assert step_record(there, 1, spent=spent).violations == ("units",)
    assert step_record(there, 2, spent=SPENT).violations == ()
    assert step_record(there, 3, spent=SPENT).violations == ("energy",)


def test_sound_parts_of_a_step_take_effect() -> None:
    """The wrong parts are refused, the others take effect: each part is checked alone."""
    there = world((8.0, 0.0))
    unsound = step_record(there, 1, (99.0, 0.0), b"\x80")

    assert unsound.violations == ("speed", "units")
    assert there.observe("r1").step == 1
    assert step_record(there, 2, (5.0, 0.0), b"\x80") == StepVerdict(
        Pose(5.0, 0.0), ((0, 8.0, 0.0),), ("units",)
    )


# Sight.


@pytest.mark.parametrize(
    ("target", "seen"),
    [((3.0, 4.0), 1), ((0.0, -5.0), 1), ((0.0, 0.0), 1), ((3.0, math.nextafter(4.0, 5.0)), 0)],
)
def test_the_sensor_range_is_inclusive(target: Place, seen: int) -> None:
    """At exactly the range a target is detected."""
    found = world(target).first_look()["r1"]

    assert found == ((0, *target),) * seen


def test_the_first_look_is_at_time_0() -> None:
    """A target near a robot is detected before any robot moves, and is in its first observation."""
    there = world((1.0, 0.0), (90.0, 21.0), (50.0, 50.0))

    assert there.first_look() == {"r1": ((0, 1.0, 0.0),), "r2": ((1, 90.0, 21.0),), "r3": ()}
    assert there.observe("r1").detected == (0,)
    assert there.found.tolist() == [True, True, False]


def test_a_target_is_found_once() -> None:
    """Neither the robot that found it nor another finds it again."""
    there = world((8.0, 0.0), (9.0, 0.0), (80.0, 20.0))
    found = [step_record(there, step, (4.0, 0.0)).found for step in (1, 2)]
    there.accept("r2", 10 * PERIOD_NS, Outputs(1, Pose(10.0, 0.0)))

    assert found == [((0, 8.0, 0.0), (1, 9.0, 0.0)), ()]
    assert there.found.tolist() == [True, True, False]


def test_finds_are_in_the_observation_of_the_step_that_made_them() -> None:
    """At every reading of the observation, until the next step."""
    there = world((8.0, 0.0))
    step_record(there, 1, (4.0, 0.0))
    observed = [there.observe("r1").detected for _ in range(2)]
    step_record(there, 1, (4.0, 0.0))
    observed.append(there.observe("r1").detected)
    step_record(there, 2, (4.0, 0.0))

    assert observed == [(0,), (0,), (0,)]
    assert there.observe("r1").detected == ()


def test_only_the_end_of_a_move_counts_for_detection() -> None:
    """A target that is passed on the way is not detected: endpoints only."""
    there = world((5.0, 4.9), overrides=("sensor.range_m=5",))

    assert step_record(there, 1, (10.0, 0.0)).found == ()


def test_the_supervisor_detects_nothing() -> None:
    """The supervisor has no sensor."""
    there = world((50.0, 50.0), overrides=("coordination=centralized",))

    assert SUPERVISOR not in there.first_look()
    assert step_record(there, 1, (50.0, 50.0), name=SUPERVISOR).found == ()


def walked(*targets: Place, periods: int) -> list[Place]:
    """Positions of targets after a number of periods, by their walk alone."""
    walk = RandomWalk(np.array(targets), 3.0, PERIOD_NS, 1, Purpose.TARGET_WALK)
    walk.advance(periods * PERIOD_NS)
    return [(float(x), float(y)) for x, y in walk.xy_m]


def test_a_walking_target_has_the_position_where_it_was_found() -> None:
    """Targets walk once a period; a find has the position of the target then, and is final."""
    start = (6.0, 0.0)
    there = world(start, overrides=("targets.diffusion_m=3.0", "sensor.range_m=4"))
    places = [walked(start, periods=step)[0] for step in range(1, 200)]
    near = [math.hypot(*place) <= 4.0 for place in places]
    finds = [(step, found) for step in range(1, 200) if (found := step_record(there, step).found)]
    first = near.index(True)

    assert sum(near) > 1
    assert finds == [(first + 1, ((0, *places[first]),))]


def test_targets_walk_without_any_step() -> None:
    """The walk depends on time alone: a robot that was silent for long finds targets where they are."""
    there = world((200.0, 0.0), (300.0, 0.0), overrides=("targets.diffusion_m=3.0",))
    place = walked((200.0, 0.0), (300.0, 0.0), periods=40)[0]

    assert step_record(there, 1, place, now_ns=40 * PERIOD_NS + 99).found == ((0, *place),)


# Everything at once.

MOVES = st.lists(
    st.tuples(
        st.integers(1, 30),
        st.integers(0, 30),
        st.floats(-40.0, 40.0),
        st.floats(-40.0, 40.0),
        st.sampled_from([b"", SPENT, SPENT, b"\x80"]),
    ),
    max_size=40,
)


@examples(100)
@given(moves=MOVES, seed=SEEDS)
def test_no_robot_gets_around_the_rules(
    moves: list[tuple[int, int, float, float, bytes]], seed: int
) -> None:
    """With any outputs, a robot keeps to its speed and its budget, and finds no target twice."""
    scenario = mission("energy.steps=3", "targets.diffusion_m=2.0", "sensor.range_m=9")
    targets = [(float(x), float(y)) for x in range(-30, 31, 12) for y in range(-30, 31, 12)]
    there = World(scenario, seed, setup(*targets))
    found = [target for finds in there.first_look().values() for target, _, _ in finds]
    step, now_ns, pose, shipped = 0, 0, Pose(0.0, 0.0), 0
    for its_step, period, x_m, y_m, spent in moves:
        at_ns = period * PERIOD_NS
        verdict = step_record(there, its_step, (x_m, y_m), spent, now_ns=at_ns)
        way_m = math.hypot(verdict.pose.x_m - pose.x_m, verdict.pose.y_m - pose.y_m)
        stale = its_step <= step or at_ns < now_ns

        assert ("step" in verdict.violations) == stale
        assert way_m <= (0.0 if stale else 100.0 * (at_ns - now_ns) * 1e-9 * (1.0 + 1e-5))
        pose = verdict.pose
        if not stale:
            step, now_ns = its_step, at_ns
        if spent and not {"step", "units", "energy"} & set(verdict.violations):
            shipped += 1
        found += [target for target, _, _ in verdict.found]

    assert shipped <= 3
    assert len(set(found)) == len(found)
    assert there.found.sum() == len(found)


# On a map.

ROOM = drawn(
    "........",
    ".####...",
    ".#..#...",
    ".#......",
    ".####...",
    "........",
)
"""A room of two by two cells with a door to the right, in the middle of free space."""


def on(
    ground: Ground,
    start: Place,
    *targets: Place,
    overrides: tuple[str, ...] = ("sensor.range_m=8",),
) -> World:
    """A world with this map, r1 at a start, and these targets."""
    where = WorldSetup(
        np.zeros((0, 2)), np.array(targets).reshape(-1, 2), np.array([start]), ground
    )
    return World(exploration("vehicle.speed_m_s=100", *overrides), 1, where)


@examples(1000)
@given(stand=places(), data=st.data())
def test_no_robot_ends_in_a_wall(stand: Stand, data: st.DataObject) -> None:
    """With any goal, robots end in free cells, on their way, and their observation reports a cut move."""
    ground, pose = stand
    side_m, (x_m, y_m) = ground.frame.resolution_m, ground.frame.origin_m
    lattice = st.integers(-4, 40).map(lambda k: k / 2)
    for _ in range(data.draw(st.integers(1, 5))):
        u, v = data.draw(st.tuples(lattice, lattice) | st.tuples(*2 * [st.floats(-3.0, 12.0)]))
        wanted = Pose(x_m + u * side_m, y_m + v * side_m, 1.0, 2.0)
        end, bumped = stopped(ground, pose, wanted)
        cell = ground.frame.cell_of(end.x_m, end.y_m)

        assert cell >= 0
        assert ground.cells.flat[cell] == FREE
        assert (end == wanted) == (not bumped)
        if bumped:
            way_m = math.hypot(wanted.x_m - pose.x_m, wanted.y_m - pose.y_m)
            gone_m = math.hypot(end.x_m - pose.x_m, end.y_m - pose.y_m)
            left_m = math.hypot(wanted.x_m - end.x_m, wanted.y_m - end.y_m)
            assert gone_m + left_m == pytest.approx(way_m, rel=1e-9, abs=1e-9)
            assert (end.heading_rad, end.speed_m_s) == (1.0, 0.0)
        pose = end


@examples(300)
@given(stand=places(), share=st.floats(0.0, 1.0), heading=HEADINGS)
def test_a_move_through_free_cells_is_not_cut(stand: Stand, share: float, heading: float) -> None:
    """A move that ends well before the next wall, corners included, takes effect unchanged."""
    ground, pose = stand
    side_m, (x_m, y_m) = ground.frame.resolution_m, ground.frame.origin_m
    u, v = (pose.x_m - x_m) / side_m, (pose.y_m - y_m) / side_m
    far = 20.0
    to_u, to_v = u + far * math.cos(heading), v + far * math.sin(heading)
    open_cells = far * free_way(ground.cells, FREE, u, v, to_u, to_v, 1e-3)
    way_m = share * max(0.0, open_cells - 1e-3) * side_m
    wanted = Pose(pose.x_m + way_m * math.cos(heading), pose.y_m + way_m * math.sin(heading))
    end, bumped = stopped(ground, pose, wanted)

    assert (end, bumped) == (wanted, False)


@pytest.mark.parametrize(
    ("start", "wanted", "end"),
    [
        ((0.5, 0.5), (7.5, 0.5), None),
        ((0.5, 2.5), (2.5, 2.5), (1.0 - STANDOFF_CELLS, 2.5)),
        ((2.5, 2.5), (6.5, 2.5), None),
        ((2.5, 2.5), (2.5, -3.0), (2.5, 2.0 + STANDOFF_CELLS)),
        ((0.5, 0.5), (-9.0, 0.5), (STANDOFF_CELLS, 0.5)),
        ((0.5, 2.5), (1.0, 2.5), (1.0 - STANDOFF_CELLS, 2.5)),  # a border belongs to the wall
        ((2.0, 2.5), (1.5, 2.5), (2.0, 2.5)),
        ((0.995, 2.5), (1.5, 2.5), (0.995, 2.5)),
    ],
)
def test_a_wall_stops_a_move(start: Place, wanted: Place, end: Place | None) -> None:
    """The robot ends just before the wall, or where it was; the bump is counted, reported, and breaks no rule."""
    there = on(ROOM, start)
    verdict = there.accept("r1", PERIOD_NS, Outputs(1, Pose(*wanted, 0.5, 9.0)))
    truth = Pose(*wanted, 0.5, 9.0) if end is None else Pose(*end, 0.5, 0.0)

    assert verdict == StepVerdict(truth, bumped=end is not None)
    assert there.pose("r1") == truth
    look = there.observe("r1")
    assert (look.pose, look.bumped) == (truth, end is not None)


def test_corners_are_not_cut() -> None:
    """Between two walls that meet at a corner there is no way through."""
    there = on(drawn("#.", ".#"), (0.5, 0.5))
    verdict = there.accept("r1", PERIOD_NS, Outputs(1, Pose(1.5, 1.5)))

    assert verdict.bumped
    assert max(verdict.pose.x_m, verdict.pose.y_m) < 1.0


def test_a_bump_is_reported_of_the_last_step_alone() -> None:
    """A step that is refused for its speed meets no wall; a stale one changes nothing."""
    there = on(ROOM, (0.5, 2.5))
    observed = []
    for step, place in [
        (1, (2.0, 2.5)),
        (1, (0.5, 2.5)),
        (2, (99.0, 2.5)),
        (3, (9.0, 2.5)),
        (4, (0.5, 2.5)),
    ]:
        verdict = there.accept("r1", step * PERIOD_NS, Outputs(step, Pose(*place)))
        observed.append((verdict.violations, verdict.bumped, there.observe("r1").bumped))

    assert observed == [
        ((), True, True),
        (("step",), False, True),
        (("speed",), False, False),
        ((), True, True),
        ((), False, False),
    ]


def test_a_scan_is_in_the_observation_until_the_next_scan() -> None:
    """At time 0 and after every accepted step, from the true pose."""
    there = on(ROOM, (0.5, 2.5))
    finder = RangeFinder(exploration("sensor.range_m=8").sensor, ROOM, 1)
    first = there.observe("r1").scan
    there.accept("r1", PERIOD_NS, Outputs(1, Pose(3.0, 2.5, 1.0)))
    second = there.observe("r1")

    assert first == finder.scan(0, 0, Pose(0.5, 2.5))
    assert second.scan == finder.scan(0, 1, second.pose)
    assert (second.pose.x_m, second.bumped) == (1.0 - STANDOFF_CELLS, True)
    there.accept("r1", PERIOD_NS, Outputs(1, Pose(0.5, 0.5)))  # stale
    assert there.observe("r1").scan == there.observe("r1").scan == second.scan


def test_each_scan_has_noise_of_its_own() -> None:
    """A robot that stands still measures anew in every step, and seeds differ."""
    noisy = ("sensor.range_m=8", "sensor.noise_m=0.1")
    there = on(ROOM, (0.5, 2.5), overrides=noisy)
    scans = [there.observe("r1").scan]
    for step in (1, 2):
        there.accept("r1", step * PERIOD_NS, Outputs(step, Pose(0.5, 2.5)))
        scans.append(there.observe("r1").scan)

    assert len(set(scans)) == 3
    assert on(ROOM, (0.5, 2.5), overrides=noisy).observe("r1").scan == scans[0]


def test_the_supervisor_is_in_no_cell() -> None:
    """The supervisor has no scanner, and may stand in a wall."""
    there = on(
        ROOM, (0.5, 0.5), overrides=("coordination=centralized", "supervisor.pose_m=[1.5, 1.5]")
    )
    verdict = there.accept(SUPERVISOR, PERIOD_NS, Outputs(1, Pose(1.5, 1.5)))

    assert verdict == StepVerdict(Pose(1.5, 1.5))
    assert there.observe(SUPERVISOR).scan == b""


@pytest.mark.parametrize("start", [(1.5, 2.5), (1.0, 1.5), (-0.1, 0.5), (8.0, 0.5)])
def test_a_start_in_a_wall_is_refused(start: Place) -> None:
    """Also on the lower borders of one, and outside."""
    with pytest.raises(ScenarioError, match=r"r1 at .* is in no free cell"):
        on(ROOM, start)


@pytest.mark.parametrize(
    ("target", "seen"),
    [
        ((0.5, 5.5), 1),
        ((0.5, 0.5), 1),
        ((2.5, 2.5), 0),  # behind a wall
        ((1.5, 2.5), 0),  # in it
        ((6.5, 2.5), 0),
        ((0.5, 7.5), 0),  # outside
        ((7.5, 5.5), 0),
    ],
)
def test_targets_are_detected_within_range_and_in_sight(target: Place, seen: int) -> None:
    """On a map nothing is found through walls."""
    there = on(ROOM, (0.5, 2.5), target, overrides=("sensor.range_m=6.5",))

    assert there.first_look() == {"r1": ((0, *target),) * seen}


def test_no_mass_can_be_shipped_on_a_map() -> None:
    """There is no mass, so there is no energy to spend on it."""
    there = on(ROOM, (0.5, 0.5))

    assert there.accept("r1", PERIOD_NS, Outputs(1, Pose(0.5, 0.5), spent=SPENT)).violations == (
        "units",
    )


def test_the_setup_of_a_map_has_starts_and_no_samples() -> None:
    """The layout, starts in its free cells, no samples; targets only from a file."""
    scenario = exploration("robots.count=4", "map.size_m=[20.0, 10.0]")
    setup_of_map = WorldSetup.of(scenario, 3)
    ground = setup_of_map.ground
    assert ground is not None
    cells = [ground.frame.cell_of(x_m, y_m) for x_m, y_m in setup_of_map.starts_m]

    assert (ground.cells.shape, setup_of_map.starts_m.shape) == ((10, 20), (4, 2))
    assert (setup_of_map.samples_m.shape, setup_of_map.targets_m.shape) == ((0, 2), (0, 2))
    assert (ground.cells.flat[cells] == FREE).all()
    World(scenario, 3, setup_of_map)


def test_the_opening_holds_the_map() -> None:
    """A replay has the recorded map; without a map nothing is added."""
    scenario = exploration()
    there = WorldSetup(np.zeros((0, 2)), np.zeros((0, 2)), np.array([[0.5, 0.5]]), ROOM)
    opening = decode_record(encode_record(opening_of(scenario, 1, there, {"r1": ()})))
    assert isinstance(opening, Opening)
    ground = opening.setup.ground
    assert ground is not None

    assert ground.frame == ROOM.frame
    assert (ground.cells == ROOM.cells).all()
    assert ground.cells.flags.writeable
    assert opening.units.whole == 0
    plain = opening_of(mission(), 1, setup(), {})
    assert (plain.ground, plain.frame, plain.setup.ground) == (None, None, None)


def test_a_map_that_does_not_fit_its_frame_is_refused() -> None:
    """A forged opening is refused without a crash."""
    there = WorldSetup(np.zeros((0, 2)), np.zeros((0, 2)), np.array([[0.5, 0.5]]), ROOM)
    opening = opening_of(exploration(), 1, there, {"r1": ()})
    frame = Frame(1.0, (0.0, 0.0), 8, 6)

    with pytest.raises(RefusedError):
        _ = msgspec.structs.replace(opening, frame=frame).setup
