"""Robots and supervisors in signed missions: they come to the same end, are valid, and are restored exactly."""

from functools import partial

import pytest

from kantor_agent.robots.density import DensityRobot
from kantor_agent.robots.mapping import MappingRobot
from kantor_protocol.base.machine import SUPERVISOR, Body, ParticipantId, Pose, State, StateMachine
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import decode_gossip
from kantor_protocol.wire.weights import Units
from kantor_supervisor.density import DensitySupervisor
from kantor_supervisor.mapping import MappingSupervisor
from support.missions import ROOMS, on_map
from support.replication.attesting import Signing, identities_of, signed_body
from support.strategies import Transcript, in_a_row, mission, scattered, start_poses, step_rounds

SAMPLES_M = scattered(12)
UNITS = Units.of(30, 12)

MISSIONS = {
    "ledger": mission("trust=signed"),
    "min": mission("trust=signed", "merge=min"),
    "spectral": mission("trust=signed", "planner=spectral", "planner.modes=3"),
    "centralized": mission("trust=signed", "coordination=centralized"),
    "map": on_map("trust=signed"),
    "centralized-map": on_map("trust=signed", "coordination=centralized"),
}


def participant(name: ParticipantId, scenario: Scenario) -> StateMachine:
    """A participant at its start."""
    body, identities = Body(start_poses(scenario)[name]), identities_of(scenario)
    if scenario.mapping and name == SUPERVISOR:
        return MappingSupervisor(name, scenario, 1, body, ROOMS.frame, identities)
    if scenario.mapping:
        return MappingRobot(name, scenario, 1, body, ROOMS.frame, identities)
    if name == SUPERVISOR:
        return DensitySupervisor(name, scenario, body, 12, identities)
    return DensityRobot(name, scenario, 1, body, SAMPLES_M, identities)


def transcripts(scenario: Scenario, rounds: int) -> dict[ParticipantId, Transcript]:
    """What all took in and put out, signed."""
    machines = {name: Signing(name, participant(name, scenario)) for name in scenario.roster}
    return step_rounds(machines, scenario, rounds)


@pytest.mark.parametrize("name", MISSIONS)
def test_restored_from_its_inputs_a_participant_says_the_same(name: str) -> None:
    """Whoever signs gets the same words to sign, so that a signature of them is the same too."""
    scenario = MISSIONS[name]
    attestations = 0
    for who, transcript in transcripts(scenario, 45).items():
        again = Signing(who, participant(who, scenario))
        for inputs, outputs in transcript:
            assert again.step(inputs) == outputs
            assert outputs.refused == 0
            attestations += len(decode_gossip(outputs.outbox[0].body).attestations)

    assert attestations > 0


def test_signed_robots_finish_with_what_all_have_spent() -> None:
    """r1 and r3 know of each other by r2 alone."""
    scenario = mission("trust=signed")
    machines = {name: Signing(name, participant(name, scenario)) for name in scenario.roster}
    played = step_rounds(machines, scenario, 60, in_a_row)
    weights = [
        machines[name]._machine._replica.weights.tolist()  # type: ignore[attr-defined]
        for name in scenario.roster
    ]

    assert all(played[name][-1][1].state is not State.EXPLORING for name in scenario.roster)
    assert weights[0] == weights[1] == weights[2]


def test_a_robot_that_becomes_final_attests_at_once() -> None:
    """So that others can pass on all that it has spent."""
    scenario = mission("trust=signed")
    for transcript in transcripts(scenario, 20).values():
        final = next(o for _, o in transcript if o.state is not State.EXPLORING)
        own = decode_gossip(final.outbox[0].body).attestations[-1]

        assert own.step == final.step


def test_a_participant_of_a_signed_mission_needs_identities() -> None:
    """To build one without is a mistake of whoever runs it."""
    scenario = mission("trust=signed")
    build = partial(DensityRobot, "r1", scenario, 1, Body(Pose(1.0, 2.0)), SAMPLES_M)

    with pytest.raises(AssertionError, match="identities"):
        build()
    with pytest.raises(AssertionError, match="key"):
        build(identities=type(identities_of(scenario))("run", {}))  # type: ignore[call-arg,misc]
    assert signed_body("r1", b"no message") == b"no message"
