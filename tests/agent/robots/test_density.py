"""A robot as a transcript: what goes into its steps, and what has to come out."""

from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.robots.density import DensityRobot
from kantor_protocol.base.machine import (
    EVERYBODY,
    SUPERVISOR,
    Body,
    Envelope,
    Inputs,
    Observation,
    Outputs,
    Pose,
    State,
)
from kantor_protocol.base.varint import Pairs
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import (
    GossipMessage,
    check_outputs,
    decode_gossip,
    decode_inputs,
    encode,
)
from kantor_protocol.wire.weights import Units, WeightsSubscriber
from support.strategies import (
    MINIMUM,
    Transcript,
    build_team,
    examples,
    in_a_row,
    mission,
    scattered,
    step_rounds,
)

N = 12
SAMPLES_M = scattered(N)
UNITS = Units.of(30, N)

MISSIONS = {
    "ledger": mission(),
    "min": mission(*MINIMUM),
    "centralized": mission("coordination=centralized"),
    "beacon": mission("radio.beacon=state", *MINIMUM),
    "walking": mission("samples.diffusion_m=4.0"),
    "slow-vehicle": mission("vehicle.name=unicycle", "vehicle.speed_m_s=20.0"),
    "spare-energy": mission("energy.steps=100"),
    "little-energy": mission("energy.steps=3"),
}
EVERY_MISSION = pytest.mark.parametrize("name", list(MISSIONS))


def robot(scenario: Scenario, name: str = "r1") -> DensityRobot:
    """A robot at its start."""
    start_m = scenario.starts.poses_m[scenario.robot_ids.index(name)]
    return DensityRobot(name, scenario, 1, Body(Pose(*start_m)), SAMPLES_M)


def transcripts(name: str, rounds: int = 40) -> dict[str, Transcript]:
    """What the robots of a mission took in and put out; the supervisor is left out."""
    scenario = MISSIONS[name]
    played = step_rounds(build_team(scenario, SAMPLES_M), scenario, rounds)
    return {robot_id: played[robot_id] for robot_id in scenario.robot_ids}


def replay(scenario: Scenario, name: str, inputs: list[Inputs]) -> list[bytes]:
    """What a new robot puts out for the same inputs, as bytes."""
    machine = robot(scenario, name)
    return [encode(machine.step(one)) for one in inputs]


def pairs(packed: bytes) -> list[tuple[int, int]]:
    """Packed pairs, read."""
    arrays = Pairs().decode(packed, N)

    assert arrays is not None
    return list(zip(arrays[0].tolist(), arrays[1].tolist(), strict=True))


def alone(
    scenario: Scenario, rounds: int, change: Callable[[int, Inputs], Inputs] = lambda _, same: same
) -> list[Outputs]:
    """r1 without company; `change` may tamper with what reaches it."""
    machine = robot(scenario)
    pose, outputs = Pose(*scenario.starts.poses_m[0]), []
    for step in range(1, rounds + 1):
        inputs = Inputs(step * scenario.period_ns, Observation(step - 1, pose))
        outputs.append(machine.step(change(step, inputs)))
        pose = outputs[-1].pose
    return outputs


@EVERY_MISSION
def test_same_inputs_give_the_same_bytes(name: str) -> None:
    """A robot is a pure state machine: its record replays, also through the codec."""
    for robot_id, transcript in transcripts(name).items():
        given_inputs = [inputs for inputs, _ in transcript]
        put_out = [encode(outputs) for _, outputs in transcript]
        through_the_codec = [decode_inputs(encode(inputs)) for inputs in given_inputs]

        assert replay(MISSIONS[name], robot_id, given_inputs) == put_out
        assert replay(MISSIONS[name], robot_id, through_the_codec) == put_out


@EVERY_MISSION
def test_energy_budget_is_never_exceeded(name: str) -> None:
    """Eq. 7: at most t_e points, one a step, each of 1/M at most; and each counted."""
    for transcript in transcripts(name).values():
        points = [sum(units for _, units in pairs(outputs.spent)) for _, outputs in transcript]
        counted = [outputs.energy_spent for _, outputs in transcript]

        assert max(counted) <= MISSIONS[name].steps_per_robot
        assert counted == np.cumsum([point > 0 for point in points]).tolist()
        assert max(points) == UNITS.point


@EVERY_MISSION
def test_resting_robot_stays_and_ships_nothing(name: str) -> None:
    """FINISHED or EXHAUSTED is final: same pose, no goal, no spending; it still speaks (Alg. 3)."""
    for transcript in transcripts(name).values():
        put_out = [outputs for _, outputs in transcript]
        done = [i for i, outputs in enumerate(put_out) if outputs.state is not State.EXPLORING]

        assert done == list(range(done[0], len(put_out)))
        for outputs in put_out[done[0] + 1 :]:
            assert outputs.pose == put_out[done[0]].pose
            assert (outputs.goal, outputs.spent) == (None, b"")
            assert len(outputs.outbox) == 1


@EVERY_MISSION
def test_final_state_is_the_reason_for_rest(name: str) -> None:
    """FINISHED: no weight left in its view. EXHAUSTED: its energy is spent and weight is left."""
    for transcript in transcripts(name).values():
        left = [UNITS.sample] * N
        for _, outputs in transcript:
            for sample, weight in pairs(outputs.lowered):
                left[sample] = weight
            spent_all = outputs.energy_spent >= MISSIONS[name].steps_per_robot
            empty = State.FINISHED if not any(left) else State.EXPLORING

            assert outputs.state == (State.EXHAUSTED if any(left) and spent_all else empty)


@EVERY_MISSION
def test_published_weights_are_the_robot_s_own(name: str) -> None:
    """The messages on the weights key rebuild the vector that the lowered entries add up to."""
    for transcript in transcripts(name).values():
        left, subscriber = [UNITS.sample] * N, WeightsSubscriber()
        for _, outputs in transcript:
            for sample, weight in pairs(outputs.lowered):
                assert weight < left[sample]
                left[sample] = weight
            if outputs.weights:
                assert subscriber.apply(outputs.weights)
                assert subscriber.weights is not None
                assert subscriber.weights.tolist() == left

        assert subscriber.weights is not None
        assert subscriber.weights.tolist() == left


@pytest.mark.parametrize("name", ["ledger", "centralized", "walking", "spare-energy"])
def test_all_robots_come_to_the_sum_of_all_spending(name: str) -> None:
    """ledger: weights = first weight - everybody's spending, once all news is in (design, 4)."""
    left = [UNITS.sample] * N
    vectors = []
    for transcript in transcripts(name).values():
        vectors.append([UNITS.sample] * N)
        for _, outputs in transcript:
            for sample, units in pairs(outputs.spent):
                left[sample] -= units
            for sample, weight in pairs(outputs.lowered):
                vectors[-1][sample] = weight

    assert vectors == [[max(0, weight) for weight in left]] * 3


@EVERY_MISSION
def test_step_is_numbered_and_sound(name: str) -> None:
    """Steps and envelopes count from 1; every envelope is the robot's own and decodes."""
    for robot_id, transcript in transcripts(name).items():
        for step, (_, outputs) in enumerate(transcript, 1):
            check_outputs(outputs)
            news = decode_gossip(outputs.outbox[0].body)

            assert (outputs.step, outputs.refused, len(outputs.outbox)) == (step, 0, 1)
            assert outputs.outbox[0] == Envelope(
                robot_id, step, outputs.outbox[0].target, outputs.outbox[0].body
            )
            assert (news.step, news.x_m, news.y_m) == (step, outputs.pose.x_m, outputs.pose.y_m)


@pytest.mark.parametrize(
    ("name", "target"), [("ledger", EVERYBODY), ("min", EVERYBODY), ("centralized", SUPERVISOR)]
)
def test_robots_address_the_supervisor_only_or_all_in_range(name: str, target: str) -> None:
    """centralized: robots talk to the supervisor only; decentralized: to whoever is in range."""
    targets = {
        envelope.target
        for transcript in transcripts(name).values()
        for _, outputs in transcript
        for envelope in outputs.outbox
    }

    assert targets == {target}


def test_robot_plans_then_moves_then_spends() -> None:
    """Algorithm 1: the goal is chosen from where the robot was, the point ships from where it is."""
    far_m = np.array([[10.0, 10.0], [10.0, 95.0]])
    scenario = mission("robots.count=1", "starts.poses_m=[[10.0, 60.0]]", "energy.points=2")
    machine = DensityRobot("r1", scenario, 1, Body(Pose(10.0, 60.0)), far_m)
    outputs = machine.step(Inputs(scenario.period_ns, Observation(0, Pose(10.0, 60.0))))

    assert outputs.goal == (10.0, 95.0)
    assert outputs.pose == Pose(10.0, 70.0, outputs.pose.heading_rad, 100.0)
    assert outputs.spent == bytes([2, 1])
    assert outputs.state is State.EXPLORING


def test_robot_steps_by_the_time_that_has_passed() -> None:
    """Half a period, half a step; and never more than a period's, however late the robot is."""
    scenario = mission()
    times_ns = [scenario.period_ns // 2, scenario.period_ns, 10 * scenario.period_ns]
    machine, here, ways_m = robot(scenario), Pose(10.0, 10.0), []
    for step, now_ns in enumerate(times_ns):
        there = machine.step(Inputs(now_ns, Observation(step, here))).pose
        ways_m.append(((there.x_m - here.x_m) ** 2 + (there.y_m - here.y_m) ** 2) ** 0.5)
        here = there

    assert ways_m[:2] == pytest.approx([5.0, 5.0])
    assert ways_m[2] <= 10.0 * (1.0 + 1e-9)


def test_late_observation_does_not_move_the_robot() -> None:
    """Word of an older step changes nothing, wherever it says that the robot was."""
    scenario = mission()

    def late(step: int, inputs: Inputs) -> Inputs:
        old = Observation(max(0, step - 3), Pose(77.0, 77.0))
        return msgspec.structs.replace(inputs, observation=old) if step > 4 else inputs

    assert alone(scenario, 20, late) == alone(scenario, 20)


def test_accepted_pose_moves_the_robot() -> None:
    """The world has the last word: a robot that was stopped goes on from where it was stopped."""
    scenario = mission()

    def stopped(step: int, inputs: Inputs) -> Inputs:
        truth = Observation(step - 1, Pose(10.0, 10.0))
        return msgspec.structs.replace(inputs, observation=truth)

    poses = [outputs.pose for outputs in alone(scenario, 5, stopped)]

    assert all((pose.x_m - 10.0) ** 2 + (pose.y_m - 10.0) ** 2 <= 100.0001 for pose in poses)


NOISE = (
    Envelope("r2", 1, "", b""),
    Envelope("r2", 2, "", b"\xff" * 50),
    Envelope("r9", 1, "", encode(GossipMessage(1, 1, 0.0, 0.0, bytes(6), b"", b""))),
    Envelope("r1", 1, "", encode(GossipMessage(1, 1, 0.0, 0.0, bytes(6), b"", b""))),
    Envelope("r2", 3, "", encode(GossipMessage(2, 1, 0.0, 0.0, bytes(6), b"", b""))),
    Envelope("r2", 4, "", encode(GossipMessage(1, 1, float("nan"), 0.0, bytes(6), b"", b""))),
    Envelope("r2", 5, "", encode(GossipMessage(1, 1, 0.0, 0.0, bytes(5), b"", b""))),
    Envelope("r2", 6, "", encode(GossipMessage(1, 1, 0.0, 0.0, bytes(6), b"\x01\x00\x01", b""))),
    Envelope("r2", 7, "", encode(GossipMessage(1, 1, 0.0, 0.0, bytes(6), b"", b"\x05"))),
    Envelope("r2", 8, "", bytes(300_000)),
)


def noisy(inputs: Inputs, noise: tuple[Envelope, ...], at: int) -> Inputs:
    """The same inputs with noise among the messages."""
    inbox = (*inputs.inbox[:at], *noise, *inputs.inbox[at:])
    return msgspec.structs.replace(inputs, inbox=inbox)


@EVERY_MISSION
def test_malformed_envelopes_are_counted_and_change_nothing(name: str) -> None:
    """What is refused at the door leaves no trace but the count of it."""
    scenario = MISSIONS[name]
    machine = robot(scenario)
    for step, (inputs, outputs) in enumerate(transcripts(name)["r1"], 1):
        tampered = machine.step(noisy(inputs, NOISE, at=1))

        assert tampered == msgspec.structs.replace(outputs, refused=len(NOISE) * step)


@examples(40)
@given(
    bodies=st.lists(
        st.binary(max_size=60)
        | st.builds(
            lambda version_vector, logs, claims: encode(
                GossipMessage(1, 1, 0.0, 0.0, version_vector, logs, claims)
            ),
            st.binary(max_size=8),
            st.binary(max_size=20),
            st.binary(max_size=12),
        ),
        max_size=6,
    )
)
def test_any_bodies_give_sound_outputs(bodies: list[bytes]) -> None:
    """Whatever reaches the radio: outputs that are sound, and no more energy than there is."""
    noise = tuple(Envelope("r2", i, "", body) for i, body in enumerate(bodies))
    for outputs in alone(mission(), 12, lambda _, inputs: noisy(inputs, noise, 0)):
        check_outputs(outputs)

        assert outputs.energy_spent <= 10
        assert 0 <= outputs.refused <= outputs.step * len(bodies)


@pytest.mark.parametrize("overrides", [(), MINIMUM], ids=["ledger", "min"])
def test_resting_robot_keeps_relaying(overrides: tuple[str, ...]) -> None:
    """r2 is exhausted after its first step and stands between r1 and r3: news still gets across."""
    scenario = mission(*overrides)
    machines = build_team(scenario, SAMPLES_M)
    tired = Body(Pose(*scenario.starts.poses_m[1]), energy_spent=scenario.steps_per_robot - 1)
    machines["r2"] = DensityRobot("r2", scenario, 1, tired, SAMPLES_M)
    played = step_rounds(machines, scenario, 40, in_a_row)
    vectors = []
    for robot_id in ("r1", "r3"):
        vector = dict.fromkeys(range(N), UNITS.sample)
        for _, outputs in played[robot_id]:
            vector.update(pairs(outputs.lowered))
        vectors.append(vector)

    assert played["r2"][0][1].state is State.EXHAUSTED
    assert played["r2"][-1][1].energy_spent == scenario.steps_per_robot
    assert vectors[0] == vectors[1]
    assert sum(vectors[0].values()) < sum(UNITS.sample for _ in range(N)) - 10 * UNITS.point


def test_concurrent_robots_do_not_stay_together() -> None:
    """Papers, 2.6: robots on one belief choose one goal and become one; claims keep them apart."""
    starts = "starts.poses_m=[[50.0, 50.0], [50.0, 50.0], [50.0, 50.0]]"
    apart = {}
    for claims in (True, False):
        scenario = mission(starts, f"claims={str(claims).lower()}")
        played = step_rounds(build_team(scenario, SAMPLES_M), scenario, 8)
        places = [transcript[-1][1].pose for transcript in played.values()]
        apart[claims] = len({(pose.x_m, pose.y_m) for pose in places})

    assert apart == {True: 3, False: 1}


@pytest.mark.parametrize("name", ["ledger", "min"])
def test_robot_does_not_depend_on_how_it_was_built(name: str) -> None:
    """Samples given as a read-only array or by columns are the same samples."""
    scenario = MISSIONS[name]
    by_columns = np.asfortranarray(SAMPLES_M)
    by_columns.flags.writeable = False
    machine = DensityRobot("r1", scenario, 1, Body(Pose(*scenario.starts.poses_m[0])), by_columns)
    inputs = [one for one, _ in transcripts(name)["r1"]]

    assert [encode(machine.step(one)) for one in inputs] == replay(scenario, "r1", inputs)
