"""Vehicles: within the speed limit always, at the goal in the end, never tighter than they turn."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.vehicles import VEHICLES, StepTimer, Vehicle
from kantor_protocol.base.machine import Body, Pose
from kantor_protocol.scenario.schema import VehicleOptions as Parameters
from support.strategies import ANGLES, FINITE, METRES, examples

NAMES = pytest.mark.parametrize("name", list(VEHICLES))
DT_S = 0.1

PARAMETERS = st.builds(
    Parameters,
    speed_m_s=st.floats(0.01, 1e3),
    acceleration_m_s2=st.floats(0.01, 1e4),
    turn_rate_rad_s=st.floats(0.01, 100.0),
    turn_radius_m=st.floats(0.01, 1e3),
)
PERIODS_S = st.just(0.0) | st.floats(1e-6, 10.0)


def poses(parameters: Parameters) -> st.SearchStrategy[Pose]:
    """Anywhere, in any direction, at any speed that the vehicle can have."""
    return st.builds(
        Pose,
        x_m=METRES,
        y_m=METRES,
        heading_rad=ANGLES,
        speed_m_s=st.floats(0.0, parameters.speed_m_s),
    )


def speeding(parameters: Parameters) -> st.SearchStrategy[Pose]:
    """The same, but some are faster than the vehicle can be."""
    faster = st.floats(parameters.speed_m_s, 10.0 * parameters.speed_m_s)
    return poses(parameters) | st.builds(Pose, METRES, METRES, ANGLES, faster)


def moved(before: Pose, after: Pose) -> float:
    """How far a step went."""
    return math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)


def rounding(pose: Pose) -> float:
    """What adding to a coordinate may be off by."""
    return 4.0 * (math.ulp(pose.x_m) + math.ulp(pose.y_m))


def track(vehicle: Vehicle, pose: Pose, goal_m: tuple[float, float], steps: int) -> list[Pose]:
    """Where the vehicle is, from the start on."""
    poses_on_the_way = [pose]
    for _ in range(steps):
        poses_on_the_way.append(vehicle.drive(poses_on_the_way[-1], *goal_m, DT_S))
    return poses_on_the_way


@NAMES
@examples(150)
@given(data=st.data(), parameters=PARAMETERS, x_m=FINITE, y_m=FINITE, dt_s=PERIODS_S)
def test_step_is_finite_and_within_the_speed(
    name: str, data: st.DataObject, parameters: Parameters, x_m: float, y_m: float, dt_s: float
) -> None:
    """Whatever the goal: a finite pose, no further than speed * dt, and no faster than the speed."""
    pose = data.draw(speeding(parameters))
    after = VEHICLES[name](parameters).drive(pose, x_m, y_m, dt_s)
    limit_m = parameters.speed_m_s * dt_s
    fastest_m_s = parameters.speed_m_s if dt_s > 0.0 else max(parameters.speed_m_s, pose.speed_m_s)

    assert all(map(math.isfinite, (after.x_m, after.y_m, after.heading_rad, after.speed_m_s)))
    assert moved(pose, after) <= limit_m * (1.0 + 1e-9) + rounding(pose) + rounding(after)
    assert 0.0 <= after.speed_m_s <= fastest_m_s * (1.0 + 1e-9)


@NAMES
@examples(60)
@given(data=st.data(), parameters=PARAMETERS, dt_s=PERIODS_S)
def test_goal_at_the_vehicle_itself_keeps_every_bound(
    name: str, data: st.DataObject, parameters: Parameters, dt_s: float
) -> None:
    """Eq. 16 is 0/0 on the goal; a vehicle is not."""
    pose = data.draw(poses(parameters))
    after = VEHICLES[name](parameters).drive(pose, pose.x_m, pose.y_m, dt_s)

    assert all(map(math.isfinite, (after.x_m, after.y_m, after.heading_rad, after.speed_m_s)))
    assert moved(pose, after) <= parameters.speed_m_s * dt_s * (1.0 + 1e-9) + rounding(pose)


@NAMES
def test_without_elapsed_time_the_pose_stays(name: str) -> None:
    """In dt = 0 nobody moves."""
    pose = Pose(1.0, 2.0, 0.5, 3.0)
    after = VEHICLES[name](Parameters()).drive(pose, 100.0, 100.0, 0.0)

    assert (after.x_m, after.y_m) == (1.0, 2.0)


@NAMES
@examples(30)
@given(data=st.data(), parameters=PARAMETERS, x_m=METRES, y_m=METRES)
def test_same_step_from_the_same_pose(
    name: str, data: st.DataObject, parameters: Parameters, x_m: float, y_m: float
) -> None:
    """All that a vehicle remembers is in its pose."""
    pose = data.draw(poses(parameters))
    driven = VEHICLES[name](parameters)
    driven.drive(Pose(9.0, 9.0, 1.0, 0.0), 0.0, 0.0, DT_S)
    fresh = VEHICLES[name](parameters)

    assert driven.drive(pose, x_m, y_m, DT_S) == fresh.drive(pose, x_m, y_m, DT_S)


@examples(100)
@given(x_m=METRES, y_m=METRES, gx_m=METRES, gy_m=METRES)
def test_first_order_is_equation_16(x_m: float, y_m: float, gx_m: float, gy_m: float) -> None:
    """Eq. 16: x <- x + u_max dt (g - x) / |g - x|, and no further than the goal."""
    after = VEHICLES["first-order"](Parameters()).drive(Pose(x_m, y_m), gx_m, gy_m, DT_S)
    distance_m = math.hypot(gx_m - x_m, gy_m - y_m)
    share = min(1.0, 10.0 / distance_m) if distance_m else 0.0

    assert [after.x_m, after.y_m] == pytest.approx(
        [x_m + share * (gx_m - x_m), y_m + share * (gy_m - y_m)], rel=1e-12, abs=1e-9
    )


def test_first_order_stops_at_the_goal() -> None:
    """Papers, 2.3: three steps of 10 m for 25 m, the last one short; then it stands."""
    way = track(VEHICLES["first-order"](Parameters()), Pose(0.0, 0.0), (15.0, 20.0), 4)

    assert [(pose.x_m, pose.y_m) for pose in way] == [
        (0.0, 0.0),
        (6.0, 8.0),
        (12.0, 16.0),
        (15.0, 20.0),
        (15.0, 20.0),
    ]
    assert [pose.speed_m_s for pose in way] == [0.0, 100.0, 100.0, 50.0, 0.0]


@pytest.mark.parametrize("name", ["second-order", "unicycle"])
@examples(60)
@given(
    acceleration_m_s2=st.sampled_from([10.0, 40.0, 400.0, 4000.0]),
    turn_rate_rad_s=st.floats(2.0, 30.0),
    x_m=st.floats(-300.0, 300.0),
    y_m=st.floats(-300.0, 300.0),
    heading_rad=ANGLES,
    speed_m_s=st.floats(0.0, 100.0),
)
def test_vehicle_that_can_brake_comes_to_the_goal_and_stays(
    name: str,
    acceleration_m_s2: float,
    turn_rate_rad_s: float,
    x_m: float,
    y_m: float,
    heading_rad: float,
    speed_m_s: float,
) -> None:
    """From anywhere within 300 m, in any direction, at any speed: at the goal within a minute, and
    not seen to leave it. With 10 m/s2, stopping from full speed alone takes ten seconds.
    """
    parameters = Parameters(acceleration_m_s2=acceleration_m_s2, turn_rate_rad_s=turn_rate_rad_s)
    start = Pose(x_m, y_m, heading_rad, speed_m_s)
    way = track(VEHICLES[name](parameters), start, (0.0, 0.0), 650)

    assert max(math.hypot(pose.x_m, pose.y_m) for pose in way[600:]) < 0.5
    assert way[-1].speed_m_s < 0.5


@examples(60)
@given(data=st.data(), parameters=PARAMETERS, x_m=METRES, y_m=METRES, dt_s=st.floats(1e-3, 1.0))
def test_second_order_keeps_its_acceleration(
    data: st.DataObject, parameters: Parameters, x_m: float, y_m: float, dt_s: float
) -> None:
    """The change of the velocity vector is bounded, in any direction."""
    pose = data.draw(poses(parameters))
    after = VEHICLES["second-order"](parameters).drive(pose, x_m, y_m, dt_s)
    change = math.hypot(
        after.speed_m_s * math.cos(after.heading_rad) - pose.speed_m_s * math.cos(pose.heading_rad),
        after.speed_m_s * math.sin(after.heading_rad) - pose.speed_m_s * math.sin(pose.heading_rad),
    )

    assert change <= parameters.acceleration_m_s2 * dt_s * (1.0 + 1e-9) + 1e-9


@examples(60)
@given(data=st.data(), parameters=PARAMETERS, x_m=METRES, y_m=METRES, dt_s=st.floats(1e-3, 1.0))
def test_unicycle_keeps_its_turn_rate_and_acceleration(
    data: st.DataObject, parameters: Parameters, x_m: float, y_m: float, dt_s: float
) -> None:
    """It turns by at most rate * dt, changes speed by at most a * dt, and rolls along its heading."""
    pose = data.draw(poses(parameters))
    after = VEHICLES["unicycle"](parameters).drive(pose, x_m, y_m, dt_s)
    turn = math.remainder(after.heading_rad - pose.heading_rad, math.tau)
    way_m = after.speed_m_s * dt_s

    assert abs(turn) <= parameters.turn_rate_rad_s * dt_s + 1e-9
    assert abs(after.speed_m_s - pose.speed_m_s) <= parameters.acceleration_m_s2 * dt_s + 1e-9
    assert [after.x_m, after.y_m] == pytest.approx(
        [
            pose.x_m + way_m * math.cos(after.heading_rad),
            pose.y_m + way_m * math.sin(after.heading_rad),
        ],
        abs=1e-6,
    )


@examples(100)
@given(data=st.data(), parameters=PARAMETERS, x_m=METRES, y_m=METRES, dt_s=st.floats(1e-3, 1.0))
def test_dubins_never_turns_tighter_than_its_radius(
    data: st.DataObject, parameters: Parameters, x_m: float, y_m: float, dt_s: float
) -> None:
    """Every step is an arc of length speed * dt on a circle that is no smaller than the tightest."""
    pose = data.draw(poses(parameters))
    after = VEHICLES["dubins"](parameters).drive(pose, x_m, y_m, dt_s)
    turn = math.remainder(after.heading_rad - pose.heading_rad, math.tau)
    length_m = parameters.speed_m_s * dt_s
    half = turn / 2.0
    chord_m = length_m * (math.sin(half) / half if half else 1.0)

    assert after.speed_m_s == parameters.speed_m_s
    if length_m / parameters.turn_radius_m < math.pi:
        assert abs(turn) <= length_m / parameters.turn_radius_m + 1e-9
        assert moved(pose, after) == pytest.approx(chord_m, rel=1e-6, abs=1e-6)


@examples(60)
@given(
    x_m=st.floats(-300.0, 300.0),
    y_m=st.floats(-300.0, 300.0),
    heading_rad=ANGLES,
    radius_m=st.floats(15.0, 60.0),
)
def test_dubins_passes_its_goal(
    x_m: float, y_m: float, heading_rad: float, radius_m: float
) -> None:
    """From outside its turning circles, a goal is passed within a radius, in the time that half a
    turn too much and the straight way take.
    """
    left = -math.sin(heading_rad) * -x_m + math.cos(heading_rad) * -y_m
    distance_m = math.hypot(x_m, y_m)
    vehicle = VEHICLES["dubins"](Parameters(turn_radius_m=radius_m))
    steps = math.ceil((distance_m + 3.0 * math.pi * radius_m) / 10.0)
    way = track(vehicle, Pose(x_m, y_m, heading_rad, 100.0), (0.0, 0.0), steps)
    outside = distance_m**2 >= 2.0 * radius_m * abs(left)

    assert not outside or min(math.hypot(pose.x_m, pose.y_m) for pose in way) < radius_m


@pytest.mark.parametrize(("beside_m", "straight"), [(20.0, True), (59.0, True), (61.0, False)])
def test_dubins_goes_straight_while_the_goal_is_inside_a_circle(
    *, beside_m: float, straight: bool
) -> None:
    """A goal less than two radii beside it cannot be turned to; it is left behind first."""
    vehicle = VEHICLES["dubins"](Parameters(turn_radius_m=30.0))
    way = track(vehicle, Pose(0.0, 0.0, 0.0, 100.0), (0.0, beside_m), 60)
    turns = [after.heading_rad - before.heading_rad for before, after in pairwise(way)]

    assert (turns[0] == 0.0) == straight
    assert any(turn != 0.0 for turn in turns)
    assert min(math.hypot(pose.x_m, pose.y_m - beside_m) for pose in way[1:]) < 6.0


# The time of a step.


def test_elapsed_time_is_between_nothing_and_a_period() -> None:
    """On a clock that runs, is late, stands still, or is set back."""
    timer = StepTimer(100_000_000, Body(Pose(0.0, 0.0)))
    times_s = [0.05, 0.15, 9.0, 9.0, 1.0, 1.02]

    elapsed_s = [timer.elapsed_s(round(now_s * 1e9)) for now_s in times_s]
    assert elapsed_s == pytest.approx([0.05, 0.1, 0.1, 0.0, 0.0, 0.02])


def test_no_time_has_passed_for_a_body_that_was_taken_over() -> None:
    """When it moved last is not known; the next step is timed as usual."""
    timer = StepTimer(100_000_000, Body(Pose(0.0, 0.0), step=7))

    assert [timer.elapsed_s(3 * 10**9), timer.elapsed_s(3 * 10**9 + 5 * 10**7)] == [0.0, 0.05]
