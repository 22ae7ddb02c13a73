"""The truth: what the world lets happen, and what robots see."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.keyed import Purpose
from kantor_protocol.machine import SUPERVISOR, Outputs, Pose
from kantor_protocol.packing import Pairs
from kantor_protocol.walk import Walk
from kantor_worldsim.world import Ruling, Site, World
from strategies import SEEDS, examples, mission

PERIOD_NS = 100_000_000
STEP_M = 10.0
"""What a robot may move in a period."""
Place = tuple[float, float]

SPENT = Pairs().encode(np.array([3, 4]), np.array([1, 1]), 2)
"""A whole point: two units."""


def site(*targets: Place) -> Site:
    """Twelve samples, three robots, and these targets."""
    return Site(
        np.zeros((12, 2)),
        np.array(targets, dtype=np.float64).reshape(-1, 2),
        np.array([[0.0, 0.0], [90.0, 20.0], [50.0, 80.0]]),
    )


def world(*targets: Place, overrides: tuple[str, ...] = ()) -> World:
    """A world with r1 at the origin and these targets."""
    return World(mission("sensor.range_m=5", *overrides), 1, site(*targets))


def act(
    there: World,
    step: int,
    place: Place = (0.0, 0.0),
    spent: bytes = b"",
    name: str = "r1",
    now_ns: int | None = None,
) -> Ruling:
    """A robot's step at its time, one a period unless told otherwise."""
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
def test_move_is_no_longer_than_speed_times_time(place: Place, violations: tuple[str]) -> None:
    """A longer move is refused whole: the robot stays where it was."""
    there = world()
    ruling = act(there, 1, place)

    assert ruling.violations == violations
    assert there.pose("r1") == ruling.pose == (Pose(0.0, 0.0) if violations else Pose(*place))
    assert there.observe("r1").pose == ruling.pose


def test_time_that_has_passed_counts() -> None:
    """A robot that was silent may have moved on; one that was refused may not move twice as far."""
    there = world()

    assert act(there, 1, (30.0, 0.0), now_ns=3 * PERIOD_NS).violations == ()
    assert act(there, 2, (60.0, 0.0), now_ns=4 * PERIOD_NS).violations == ("speed",)
    assert act(there, 3, (50.0, 0.0), now_ns=5 * PERIOD_NS).violations == ("speed",)
    assert act(there, 4, (40.0, 0.0), now_ns=6 * PERIOD_NS).violations == ()


def test_supervisor_stands() -> None:
    """The supervisor cannot move at all."""
    there = world(overrides=("coordination=centralized",))

    assert act(there, 1, (50.0, 50.0), name=SUPERVISOR).violations == ()
    assert act(there, 2, (50.0, 50.1), name=SUPERVISOR).violations == ("speed",)
    assert there.pose(SUPERVISOR) == Pose(50.0, 50.0)


@pytest.mark.parametrize(("step", "now_ns"), [(2, 9 * PERIOD_NS), (1, 9 * PERIOD_NS), (3, 1)])
def test_stale_step_changes_nothing(step: int, now_ns: int) -> None:
    """A step that was seen already, or lies in the past, is refused with all that is in it."""
    there = world((8.0, 0.0), overrides=("energy.steps=1",))
    act(there, 2, (2.0, 0.0))
    stale = act(there, step, (8.0, 0.0), SPENT, now_ns=now_ns)

    assert stale == Ruling(Pose(2.0, 0.0), violations=("step",))
    assert (there.observe("r1").step, there.observe("r1").pose) == (2, Pose(2.0, 0.0))
    assert act(there, 3, (8.0, 0.0), SPENT).violations == ()


# Energy.


def test_budget_is_not_exceeded() -> None:
    """A robot ships as many points as it has energy for, and no more."""
    there = world(overrides=("energy.steps=2",))
    rulings = [act(there, step, spent=SPENT).violations for step in range(1, 5)]

    assert rulings == [(), (), ("energy",), ("energy",)]
    assert act(there, 5, (1.0, 0.0)).violations == ()
    assert act(there, 1, (90.0, 20.0), SPENT, name="r2").violations == ()


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
def test_point_that_is_no_point_is_refused(spent: bytes) -> None:
    """More units than a point holds, none, or what does not decode: no energy is spent on it."""
    there = world(overrides=("energy.steps=1",))

    assert act(there, 1, spent=spent).violations == ("units",)
    assert act(there, 2, spent=SPENT).violations == ()
    assert act(there, 3, spent=SPENT).violations == ("energy",)


def test_sound_parts_of_a_step_happen() -> None:
    """What is wrong is refused, the rest stands: each part is judged alone."""
    there = world((8.0, 0.0))
    unsound = act(there, 1, (99.0, 0.0), b"\x80")

    assert unsound.violations == ("speed", "units")
    assert there.observe("r1").step == 1
    assert act(there, 2, (5.0, 0.0), b"\x80") == Ruling(
        Pose(5.0, 0.0), ((0, 8.0, 0.0),), ("units",)
    )


# Sight.


@pytest.mark.parametrize(
    ("target", "seen"),
    [((3.0, 4.0), 1), ((0.0, -5.0), 1), ((0.0, 0.0), 1), ((3.0, math.nextafter(4.0, 5.0)), 0)],
)
def test_sight_is_inclusive(target: Place, seen: int) -> None:
    """At exactly the range a target is detected."""
    found = world(target).first_look()["r1"]

    assert found == ((0, *target),) * seen


def test_first_look_is_at_time_0() -> None:
    """What stands beside a robot is detected before anybody moves, and told with its first step."""
    there = world((1.0, 0.0), (90.0, 21.0), (50.0, 50.0))

    assert there.first_look() == {"r1": ((0, 1.0, 0.0),), "r2": ((1, 90.0, 21.0),), "r3": ()}
    assert there.observe("r1").detected == (0,)
    assert there.observe("r1").detected == ()
    assert there.found.tolist() == [True, True, False]


def test_target_is_found_once() -> None:
    """Neither the robot that found it nor another finds it again."""
    there = world((8.0, 0.0), (9.0, 0.0), (80.0, 20.0))
    found = [act(there, step, (4.0, 0.0)).found for step in (1, 2)]
    there.accept("r2", 10 * PERIOD_NS, Outputs(1, Pose(10.0, 0.0)))

    assert found == [((0, 8.0, 0.0), (1, 9.0, 0.0)), ()]
    assert there.found.tolist() == [True, True, False]


def test_only_where_a_robot_ends_up_counts() -> None:
    """What it passes on the way is not seen: endpoints only."""
    there = world((5.0, 4.9), overrides=("sensor.range_m=5",))

    assert act(there, 1, (10.0, 0.0)).found == ()


def test_supervisor_sees_nothing() -> None:
    """It has no sensor."""
    there = world((50.0, 50.0), overrides=("coordination=centralized",))

    assert SUPERVISOR not in there.first_look()
    assert act(there, 1, (50.0, 50.0), name=SUPERVISOR).found == ()


def walked(*targets: Place, periods: int) -> list[Place]:
    """Where targets are after so many periods, by their walk alone."""
    walk = Walk(np.array(targets), 3.0, PERIOD_NS, 1, Purpose.TARGET_WALK)
    walk.advance(periods * PERIOD_NS)
    return [(float(x), float(y)) for x, y in walk.xy_m]


def test_walking_target_stands_where_it_was_found() -> None:
    """Targets walk once a period; a find is where the target then was, and it is final."""
    start = (6.0, 0.0)
    there = world(start, overrides=("targets.diffusion_m=3.0", "sensor.range_m=4"))
    places = [walked(start, periods=step)[0] for step in range(1, 200)]
    near = [math.hypot(*place) <= 4.0 for place in places]
    finds = [(step, found) for step in range(1, 200) if (found := act(there, step).found)]
    first = near.index(True)

    assert sum(near) > 1
    assert finds == [(first + 1, ((0, *places[first]),))]


def test_targets_walk_whether_anybody_acts_or_not() -> None:
    """The walk depends on time alone: who was silent for long finds targets where they are."""
    there = world((200.0, 0.0), (300.0, 0.0), overrides=("targets.diffusion_m=3.0",))
    place = walked((200.0, 0.0), (300.0, 0.0), periods=40)[0]

    assert act(there, 1, place, now_ns=40 * PERIOD_NS + 99).found == ((0, *place),)


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
    """Whatever a robot sends: it keeps to its speed and its budget, and finds nothing twice."""
    scenario = mission("energy.steps=3", "targets.diffusion_m=2.0", "sensor.range_m=9")
    targets = [(float(x), float(y)) for x in range(-30, 31, 12) for y in range(-30, 31, 12)]
    there = World(scenario, seed, site(*targets))
    found = [target for finds in there.first_look().values() for target, _, _ in finds]
    step, now_ns, pose, shipped = 0, 0, Pose(0.0, 0.0), 0
    for its_step, period, x_m, y_m, spent in moves:
        at_ns = period * PERIOD_NS
        ruling = act(there, its_step, (x_m, y_m), spent, now_ns=at_ns)
        way_m = math.hypot(ruling.pose.x_m - pose.x_m, ruling.pose.y_m - pose.y_m)
        stale = its_step <= step or at_ns < now_ns

        assert ("step" in ruling.violations) == stale
        assert way_m <= (0.0 if stale else 100.0 * (at_ns - now_ns) * 1e-9 * (1.0 + 1e-5))
        pose = ruling.pose
        if not stale:
            step, now_ns = its_step, at_ns
        if spent and not {"step", "units", "energy"} & set(ruling.violations):
            shipped += 1
        found += [target for target, _, _ in ruling.found]

    assert shipped <= 3
    assert len(set(found)) == len(found)
    assert there.found.sum() == len(found)
