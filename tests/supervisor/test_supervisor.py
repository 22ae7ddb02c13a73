"""The supervisor (Kabir & Lee, Algorithm 2): it merges, tells everybody, and does nothing else."""

import msgspec
import pytest

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
from kantor_protocol.wire.messages import decode_gossip, decode_inputs, encode
from kantor_protocol.wire.weights import Units, WeightsSubscriber
from kantor_supervisor.density import DensitySupervisor
from support.strategies import Transcript, build_team, mission, scattered, step_rounds

N = 12
SAMPLES_M = scattered(N)
UNITS = Units.of(30, N)

MISSIONS = {
    "ledger": mission("coordination=centralized"),
    "min": mission("coordination=centralized", "merge=min", "claims=false"),
    "placed": mission("coordination=centralized", "supervisor.pose_m=[1.0, 2.0]"),
}
EVERY_MISSION = pytest.mark.parametrize("name", list(MISSIONS))


def transcripts(name: str, rounds: int = 30) -> dict[str, Transcript]:
    """What everybody took in and put out."""
    return step_rounds(build_team(MISSIONS[name], SAMPLES_M), MISSIONS[name], rounds)


def supervisor(scenario: Scenario) -> DensitySupervisor:
    """A supervisor that has heard nobody."""
    return DensitySupervisor(SUPERVISOR, scenario, Body(Pose(*scenario.supervisor_m)), N)


def vector_after(outputs: list[Outputs]) -> list[int]:
    """The weights that lowered entries add up to."""
    left = [UNITS.sample] * N
    for one in outputs:
        arrays = Pairs().decode(one.lowered, N)
        assert arrays is not None
        for sample, weight in zip(arrays[0].tolist(), arrays[1].tolist(), strict=True):
            left[sample] = weight
    return left


@EVERY_MISSION
def test_same_inputs_give_the_same_bytes(name: str) -> None:
    """One more pure state machine."""
    transcript = transcripts(name)[SUPERVISOR]
    again, through_the_codec = supervisor(MISSIONS[name]), supervisor(MISSIONS[name])

    for inputs, outputs in transcript:
        assert encode(again.step(inputs)) == encode(outputs)
        assert encode(through_the_codec.step(decode_inputs(encode(inputs)))) == encode(outputs)


@pytest.mark.parametrize(("name", "place"), [("ledger", (50.0, 50.0)), ("placed", (1.0, 2.0))])
def test_supervisor_stays_and_ships_nothing(name: str, place: tuple[float, float]) -> None:
    """It has a place and a radio, and no energy to spend."""
    for step, (_, outputs) in enumerate(transcripts(name)[SUPERVISOR], 1):
        news = decode_gossip(outputs.outbox[0].body)

        assert outputs.pose == Pose(*place)
        assert (outputs.step, outputs.goal, outputs.spent) == (step, None, b"")
        assert (outputs.energy_spent, outputs.refused) == (0, 0)
        assert (news.step, news.x_m, news.y_m) == (step, *place)


@EVERY_MISSION
def test_supervisor_sends_one_envelope_a_step_to_all_in_range(name: str) -> None:
    """Eq. 9: one word a step, for all robots."""
    for step, (_, outputs) in enumerate(transcripts(name)[SUPERVISOR], 1):
        (envelope,) = outputs.outbox

        assert envelope == Envelope(SUPERVISOR, step, EVERYBODY, envelope.body)


@EVERY_MISSION
def test_robots_and_supervisor_come_to_one_vector(name: str) -> None:
    """Eq. 8-9: what robots tell the supervisor alone, everybody learns."""
    vectors = [
        vector_after([outputs for _, outputs in transcript])
        for transcript in transcripts(name).values()
    ]

    assert vectors == [vectors[0]] * 4
    assert sum(vectors[0]) < UNITS.whole


def test_minimum_of_all_vectors_is_broadcast() -> None:
    """Eq. 8: n_t = min over all robots, entry by entry, one step after they spoke."""
    played = transcripts("min", rounds=2)
    robots = [
        vector_after([outputs for _, outputs in played[name][:1]]) for name in ("r1", "r2", "r3")
    ]
    merged = vector_after([outputs for _, outputs in played[SUPERVISOR]])

    assert merged == [min(column) for column in zip(*robots, strict=True)]


def test_sum_of_all_spending_is_broadcast() -> None:
    """ledger: the first weight less what each robot shipped, one step after they spoke."""
    played = transcripts("ledger", rounds=2)
    expected = [UNITS.sample] * N
    for name in ("r1", "r2", "r3"):
        arrays = Pairs().decode(played[name][0][1].spent, N)
        assert arrays is not None
        for sample, units in zip(arrays[0].tolist(), arrays[1].tolist(), strict=True):
            expected[sample] -= units
    merged = vector_after([outputs for _, outputs in played[SUPERVISOR]])

    assert merged == [max(0, weight) for weight in expected]


def test_robots_learn_of_one_another_only_through_the_supervisor() -> None:
    """centralized: without the supervisor's word, robots know nothing of each other."""
    scenario = MISSIONS["ledger"]
    deaf = step_rounds(
        build_team(scenario, SAMPLES_M), scenario, 10, lambda speaker, _: speaker != SUPERVISOR
    )
    heard = [len(inputs.inbox) for inputs, _ in deaf["r1"]]
    lowered = [outputs.energy_spent for _, outputs in deaf["r1"]]

    assert heard == [0] * 10
    assert lowered[-1] == 10
    assert sum(vector_after([o for _, o in deaf["r1"]])) == UNITS.whole - 10 * UNITS.point


@EVERY_MISSION
def test_supervisor_is_finished_when_nothing_is_left_in_its_view(name: str) -> None:
    """The state follows the merged vector."""
    put_out = [outputs for _, outputs in transcripts(name)[SUPERVISOR]]
    for i, outputs in enumerate(put_out):
        empty = not any(vector_after(put_out[: i + 1]))

        assert outputs.state == (State.FINISHED if empty else State.EXPLORING)


def test_published_weights_are_the_merged_vector() -> None:
    """The supervisor, too, has a weights key that observers can rebuild its vector from."""
    put_out = [outputs for _, outputs in transcripts("ledger")[SUPERVISOR]]
    subscriber = WeightsSubscriber()
    for i, outputs in enumerate(put_out):
        if outputs.weights:
            assert subscriber.apply(outputs.weights)
            assert subscriber.weights is not None
            assert subscriber.weights.tolist() == vector_after(put_out[: i + 1])


def test_malformed_envelopes_are_counted_and_change_nothing() -> None:
    """What is refused at the door leaves no trace but the count of it."""
    noise = (
        Envelope("r1", 9, "", b""),
        Envelope("r7", 9, "", b"\x00"),
        Envelope(SUPERVISOR, 9, "", b"\x00"),
        Envelope("r2", 9, SUPERVISOR, b"\xff" * 40),
    )
    machine = supervisor(MISSIONS["ledger"])
    for step, (inputs, outputs) in enumerate(transcripts("ledger")[SUPERVISOR], 1):
        inbox = (*noise[:2], *inputs.inbox, *noise[2:])
        tampered = machine.step(msgspec.structs.replace(inputs, inbox=inbox))

        assert tampered == msgspec.structs.replace(outputs, refused=4 * step)


def test_repeated_and_late_messages_change_nothing() -> None:
    """Idempotent: everything once more, a step later and backwards, and the same vector."""
    transcript = transcripts("ledger")[SUPERVISOR]
    machine = supervisor(MISSIONS["ledger"])
    late: tuple[Envelope, ...] = ()
    put_out = []
    for inputs, _ in transcript:
        both = (*inputs.inbox, *late, *inputs.inbox)
        put_out.append(machine.step(msgspec.structs.replace(inputs, inbox=both)))
        late = inputs.inbox[::-1]

    assert [outputs.lowered for outputs in put_out] == [
        outputs.lowered for _, outputs in transcript
    ]


def test_supervisor_that_has_received_nothing_sends_a_version_vector_of_zeros() -> None:
    """Before anybody spoke it holds nothing and says so: a version vector of zeros."""
    scenario = MISSIONS["ledger"]
    look = Observation(0, Pose(50.0, 50.0))
    outputs = supervisor(scenario).step(Inputs(150_000_000, look))
    news = decode_gossip(outputs.outbox[0].body)

    assert (news.version_vector, news.logs, news.claims) == (bytes(8), b"", b"")
    assert outputs.state is State.EXPLORING
    assert (outputs.lowered, outputs.weights[:1]) == (b"", b"\x96")
