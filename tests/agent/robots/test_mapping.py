"""Robots on unknown maps, with or without a supervisor, in the real world-sim (in process)."""

from typing import Any

import numpy as np
import pytest

from kantor_agent.coordination import assignment
from kantor_agent.planners.map_base import Task, TeamMember
from kantor_agent.robots.mapping import MappingRobot
from kantor_protocol.base.machine import (
    SUPERVISOR,
    Body,
    Inputs,
    Observation,
    Pose,
    State,
    StateMachine,
)
from kantor_protocol.replication.occupancy_log import entries
from kantor_protocol.scenario.schema import MAP_PLANNERS
from kantor_supervisor.mapping import MappingSupervisor
from support.teams.exploring_team import ROOMS, Played, mission


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
@pytest.mark.parametrize("planner", sorted(MAP_PLANNERS))
def test_every_planner_explores_the_whole_map_and_rests(planner: str, coordination: str) -> None:
    """Each robot by itself, when no frontier can be reached any more."""
    played = Played(mission(f"planner={planner}", f"coordination={coordination}"))

    played.assert_explored()
    assert not any(
        step_record.verdict.violations or step_record.verdict.bumped
        for batch in played.batches
        for step_record in batch.step_records
        if step_record.verdict
    )


def test_robots_that_know_the_same_come_to_the_same_assignment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In contact with everybody and without loss, all robots decide the same at the same time."""
    decided: dict[int, list[dict[int, Task]]] = {}
    decide = assignment.Assignment.decide

    def noted(
        self: assignment.Assignment, group: list[TeamMember], absent: list[int], tick: int
    ) -> dict[int, Task]:
        tasks = decide(self, group, absent, tick)
        decided.setdefault(tick, []).append(tasks)
        return tasks

    monkeypatch.setattr(assignment.Assignment, "decide", noted)
    for planner in ("burgard", "kmeans", "hungarian"):
        decided.clear()
        Played(mission(f"planner={planner}")).assert_explored()
        full = {tick: tasks for tick, tasks in decided.items() if len(tasks) == 3}

        assert sum(bool(tasks[0]) for tasks in full.values()) > 5
        assert all(tasks[0] == tasks[1] == tasks[2] for tasks in full.values())


def test_a_robot_out_of_contact_explores_alone() -> None:
    """Range 0: everybody does everything, and none rests before."""
    alone = Played(mission("radio.range_m=0"))
    together = Played(mission())

    alone.assert_explored()
    assert alone.ticks > together.ticks


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
def test_loss_delay_and_repetition_cost_time_alone(coordination: str) -> None:
    """What was lost comes again; what comes twice counts once."""
    bad = ("drop=0.3", "duplicate=0.3", "delay_s=0.5", "jitter_s=1.5", "reorder=0.2")
    overrides = [f"radio.{fault}" for fault in bad]

    Played(mission(f"coordination={coordination}", *overrides)).assert_explored()


def test_robots_out_of_range_of_their_supervisor_assign_targets_themselves() -> None:
    """One that is out of range of everybody gives no orders."""
    out_of_range = ("supervisor.range_m=0", "supervisor.pose_m=[500.0, 500.0]")

    Played(mission("coordination=centralized", *out_of_range)).assert_explored()


def test_robots_go_on_without_a_supervisor_that_falls_silent() -> None:
    """Its last orders hold until they are out of date."""

    class Falling:
        def __init__(self, machine: StateMachine) -> None:
            self.machine, self.steps = machine, 0

        def step(self, inputs: Inputs, /) -> Any:
            self.steps += 1
            outputs = self.machine.step(inputs)
            return outputs if self.steps < 12 else type(outputs)(outputs.step, outputs.pose)

    def disturb(machines: dict[str, Any]) -> None:
        machines[SUPERVISOR] = Falling(machines[SUPERVISOR])

    Played(mission("coordination=centralized"), disturb=disturb).assert_explored()


@pytest.mark.parametrize(
    "overrides",
    [
        ("sensor.field_of_view_deg=40", "sensor.beams=9"),
        ("sensor.beams=7",),
        ("sensor.beams=4", "planner.replan_gap=1"),
        ("sensor.noise_m=0.2",),
        ("vehicle=unicycle", "vehicle.acceleration_m_s2=1", "vehicle.turn_rate_rad_s=1"),
        ("vehicle=second-order", "vehicle.acceleration_m_s2=1"),
        ("clock.spread=0.3", "clock.drift_ppm=1000"),
        ("clock.order=turn", "coordination=centralized"),
    ],
    ids=[
        "narrow",
        "few beams",
        "four beams",
        "noise",
        "unicycle",
        "second order",
        "clocks",
        "in turn",
    ],
)
def test_every_mission_ends(overrides: tuple[str, ...]) -> None:
    """A frontier that shows nothing, or is not reached, is given up; nobody circles for ever."""
    assert Played(mission(*overrides)).reason == "done"


def test_bodies_keep_apart_on_the_way_to_the_same_target() -> None:
    """Without coordination, robots that start side by side would else become one."""
    uncoordinated = ("planner.coordinated=false", "starts.spread=together")

    def merged(played: Played) -> int:
        poses = [
            {
                (step_record.verdict.pose.x_m, step_record.verdict.pose.y_m)
                for step_record in batch.step_records
                if step_record.verdict
            }
            for batch in played.batches
        ]
        return sum(len(places) < 3 for places in poses)

    assert merged(Played(mission(*uncoordinated))) > 10
    assert merged(Played(mission(*uncoordinated, "vehicle.radius_m=0.5"))) <= 3


def test_one_robot_needs_no_coordination() -> None:
    """Burgard et al., section 4: alone, coordinated and uncoordinated are the same, to the bit."""
    one = ("robots.count=1", "coordination=decentralized")
    records = [
        [
            (step_record.outputs.pose, step_record.outputs.goal)
            for batch in Played(mission(*one, f"planner.coordinated={flag}")).batches
            for step_record in batch.step_records
            if step_record.outputs
        ]
        for flag in ("true", "false")
    ]

    assert records[0] == records[1]


def test_rest_is_final() -> None:
    """A robot that rests stands, heads nowhere and keeps talking."""
    played = Played(mission("radio.range_m=6"))
    resting: dict[str, Pose] = {}
    for batch in played.batches:
        for step_record in batch.step_records:
            assert step_record.outputs is not None
            if step_record.name in resting:
                assert step_record.outputs.pose == resting[step_record.name]
                assert step_record.outputs.state is State.FINISHED
            if step_record.outputs.state is State.FINISHED:
                resting[step_record.name] = step_record.outputs.pose
                assert step_record.outputs.goal is None
                assert len(step_record.outputs.outbox) == 1


def test_a_late_observation_changes_nothing() -> None:
    """An observation of an older step is no news, neither of the place nor of the walls."""
    scenario = mission("robots.count=1")
    robot = MappingRobot("r1", scenario, 0, Body(Pose(2.5, 2.5)), ROOMS.frame)
    scan = np.full(scenario.sensor.beams, 65535, dtype="<u2").tobytes()
    robot.step(Inputs(1, Observation(0, Pose(2.5, 2.5), (), scan)))
    held = robot._replica.store.length[0]
    outputs = robot.step(Inputs(2, Observation(0, Pose(9.5, 9.5), (), scan)))

    assert outputs.pose.x_m == 2.5
    assert held > 0
    assert robot._replica.store.length[0] == held


def test_a_supervisor_that_knows_no_robot_assigns_no_target() -> None:
    """Before anybody has spoken it has nobody to send anywhere."""
    scenario = mission("coordination=centralized")
    supervisor = MappingSupervisor(SUPERVISOR, scenario, 0, Body(Pose(0.0, 0.0)), ROOMS.frame)
    outputs = supervisor.step(Inputs(1, Observation(0, Pose(0.0, 0.0))))

    assert outputs.state is State.EXPLORING
    assert len(outputs.outbox) == 1
    assert entries(ROOMS.frame) > 3 * ROOMS.frame.cells
