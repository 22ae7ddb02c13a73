"""Robots on maps that wait, crawl, turn slowly, see badly or are misled: they explore all that they can reach."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.replication.occupancy_log import bump, given_up_frontier
from kantor_protocol.scenario.schema import MAP_PLANNERS
from kantor_worldsim.observers.checkers.checker import Checker
from kantor_worldsim.observers.metrics.mapping import MapMetrics
from kantor_worldsim.observers.pipeline import Pipeline
from support.grounds import SMALL, drawn
from support.strategies import examples
from support.teams.exploring_team import ROOMS, Played, mission

CORRIDOR = drawn(
    "##############",
    "#............#",
    "##############",
)


def measured(played: Played) -> tuple[str, int, list[str]]:
    """How a mission ended by its metrics, the cells that it left unseen, and violations."""
    metrics = MapMetrics()
    checker = Checker(metrics.map_tracker)
    pipeline = Pipeline(metrics, checker)
    for record in played.records:
        pipeline.observe(record)
    result = metrics.result(
        exchange="in-process", digest="", wall_s=0.0, refused_at_door=0, excess={}, record="whole",
        complaints=(),
    )  # fmt: skip
    assert result.map is not None
    return result.ended, result.map.unseen, list(checker.violations)


@pytest.mark.parametrize("planner", sorted(MAP_PLANNERS))
def test_robots_that_wait_for_one_another_explore_the_corridor(planner: str) -> None:
    """Four in a corridor one cell wide, where the last can only follow."""
    poses = "[[1.5, 1.5], [2.5, 1.5], [3.5, 1.5], [4.5, 1.5]]"
    slow = ("vehicle.speed_m_s=0.05", "vehicle.radius_m=0.5", "sensor.range_m=2", "limit_s=20000")
    starts = ("robots.count=4", "starts.random=false", f"starts.poses_m={poses}")
    played = Played(mission(f"planner={planner}", *slow, *starts), CORRIDOR)

    assert measured(played) == ("done", 0, [])


@examples(12)
@given(
    planner=st.sampled_from(sorted(MAP_PLANNERS)),
    vehicle=st.sampled_from(["first-order", "second-order", "unicycle"]),
    cells_per_step=st.sampled_from([0.01, 0.03, 0.4, 1.5, 4.0]),
    period_s=st.sampled_from([0.02, 0.1, 1.0, 7.0]),
    radius_m=st.sampled_from([0.0, 0.4, 1.5]),
    range_m=st.sampled_from([1.5, 3.0, 8.0]),
    robots=st.integers(1, 3),
)
def test_nothing_is_left_at_any_speed_period_radius_and_range(
    planner: str,
    vehicle: str,
    cells_per_step: float,
    period_s: float,
    radius_m: float,
    range_m: float,
    robots: int,
) -> None:
    """A robot that needs a hundred steps for a cell declares nothing dead while it drives there."""
    speed_m_s = cells_per_step / period_s
    played = Played(
        mission(
            f"planner={planner}",
            f"vehicle={vehicle}",
            f"vehicle.speed_m_s={speed_m_s}",
            f"vehicle.acceleration_m_s2={speed_m_s / period_s}",
            "vehicle.turn_rate_rad_s=3",
            f"vehicle.radius_m={radius_m}",
            f"clock.period_s={period_s}",
            f"sensor.range_m={range_m}",
            f"robots.count={robots}",
            f"limit_s={30_000 * period_s}",
        ),
        SMALL,
    )

    assert measured(played) == ("done", 0, [])


@pytest.mark.parametrize("noise_m", [0.1, 0.3, 0.5])
def test_bumps_are_evidence(noise_m: float) -> None:
    """With ranges that are off by half a cell robots run into walls, learn of them and go on.

    Cells may stay unseen that all take for walls; then the result says so.
    """
    for seed in range(3):
        played = Played(mission(f"sensor.noise_m={noise_m}", "limit_s=5000"), seed=seed)
        ended, unseen, violations = measured(played)

        assert played.reason == "done"
        assert violations == []
        assert unseen <= (10 if noise_m < 0.5 else 30)
        assert ended == ("stuck" if unseen else "done")


def test_frontiers_that_were_given_up_wrongly_are_tried_again() -> None:
    """One robot gives up every cell of the map: the others try them once all else is done, and find more."""
    frame = ROOMS.frame

    def mislead(machines: dict[str, Any]) -> None:
        every = [given_up_frontier(frame, cell) for cell in range(frame.cells)]
        machines["r2"]._replica.append(np.array(every))

    Played(mission(), disturb=mislead).assert_explored()


def test_a_robot_that_falls_silent_holds_nobody_back() -> None:
    """The others give way to it while it is in contact, and then pass."""

    class Falling:
        def __init__(self, machine: Any) -> None:
            self.machine, self.steps = machine, 0

        def step(self, inputs: Any, /) -> Any:
            self.steps += 1
            outputs = self.machine.step(inputs)
            return outputs if self.steps < 6 else type(outputs)(outputs.step, outputs.pose)

    def silence(machines: dict[str, Any]) -> None:
        machines["r1"] = Falling(machines["r1"])

    poses = "[[3.5, 1.5], [2.5, 1.5], [1.5, 1.5]]"
    starts = ("starts.random=false", f"starts.poses_m={poses}", "vehicle.radius_m=2")
    played = Played(
        mission("vehicle.speed_m_s=0.2", "sensor.range_m=2", *starts), CORRIDOR, disturb=silence
    )

    known = played.cells("r2")[played.observable]
    assert (known != 0).all()


def test_a_wall_that_a_robot_met_stays_a_wall() -> None:
    """Whatever scans say of the cell: nobody drives there again."""
    frame = ROOMS.frame
    cell = frame.cell_of(7.5, 6.5)

    def meet(machines: dict[str, Any]) -> None:
        machines["r2"]._replica.append(np.array([bump(frame, cell)]))

    played = Played(mission(), disturb=meet)
    assert played.reason == "done"
    assert all(played.cells(name)[cell] == 2 for name in ("r1", "r2", "r3"))
    _, _, violations = measured(played)
    assert any("tells in its log at 0 of a wall where there is none" in each for each in violations)


def test_a_mission_that_leaves_ground_is_stuck() -> None:
    """A sensor with one beam sees hardly anything: the record says that all rest, the result what that means."""
    played = Played(mission("sensor.beams=1"))
    ended, unseen, violations = measured(played)

    assert played.reason == "done"
    assert ended == "stuck"
    assert unseen > 100
    assert violations == []
