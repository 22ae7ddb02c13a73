"""Admission: honest reports pass, whatever the mission; what cannot be is refused, with its reason."""

from collections.abc import Callable, Mapping

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_fleet.execution.in_process_team import _key, team, team_identities
from kantor_protocol.base.machine import Envelope, Inputs, Outputs, ParticipantId, Pose
from kantor_protocol.base.varint import Pairs
from kantor_protocol.replication.proofs import Chain
from kantor_protocol.scenario.faults.liars import LIES
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import HASH_BYTES, Attestation, signed
from kantor_protocol.wire.messages import (
    OUTBOX_MAX,
    GossipMessage,
    decode_gossip,
    encode_gossip,
)
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.admission import Admission
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.world.world import WorldSetup
from support.missions import on_map
from support.references.plain_varint import leb128 as uint
from support.references.plain_varint import zigzag
from support.strategies import MINIMUM, examples, mission

STEPS = 12
KILLS = (
    'faults=[{kind="kill", who=["r2"], disk="lost", from_s=0.3, until_s=0.5},'
    ' {kind="kill", who=["r1"], disk="torn", mid_step=true, from_s=0.4, until_s=0.7}]'
)
SIGNED = 'trust="signed"'
FAR = """
name = "far"
domain = { min_m = [500000, 4649776], max_m = [500002, 4649778] }
robots = { count = 3 }
starts = { random = true }
vehicle = { speed_m_s = 0.001 }
clock = { period_s = 0.01 }
energy = { points = 90 }
samples = { count = 30 }
density = [{ mean_m = [500001.0, 4649777.0], variance_m2 = [0.1, 0.1] }]
"""
"""UTM coordinates, of which the rounding is a ten thousandth of a move."""
MISSIONS = {
    "ledger": mission(),
    "far": parse(FAR, "far"),
    "min": mission(*MINIMUM),
    "spectral": mission("planner=spectral", "planner.modes=4"),
    "centralized": mission("coordination=centralized"),
    "incarnations": mission(KILLS),
    "late-news": mission("radio.range_m=45", "radio.drop=0.3", "radio.delay_s=0.25", KILLS),
    "map": on_map(),
    "map-with-supervisor": on_map("coordination=centralized", "planner.name=burgard"),
    "signed": mission(SIGNED, KILLS),
    "signed-long": mission(
        SIGNED, KILLS, "samples.count=60", "energy.points=300", "radio.range_m=60"
    ),
    "signed-min": mission(SIGNED, *MINIMUM),
    "signed-spectral": mission(SIGNED, "planner=spectral", "planner.modes=4", KILLS),
    "signed-map": on_map(SIGNED),
}


def lying(lie: str) -> str:
    """The override that has r2 lie."""
    return f'faults=[{{kind="byzantine", who=["r2"], lie="{lie}", from_s=0.2}}]'


LIARS = {
    **{lie: mission(SIGNED, "energy.points=90", lying(lie)) for lie in LIES},
    "rewrite, believed": mission("energy.points=90", lying("rewrite")),
    "claim, believed": mission("energy.points=90", lying("claim")),
    "registers": mission(SIGNED, "planner=spectral", "planner.modes=4", lying("claim")),
    "fork on a map": on_map(SIGNED, lying("fork")),
    "rewrite on a map": on_map(SIGNED, lying("rewrite")),
}


class Judged(InProcessExchange):
    """An exchange that has every report judged before it is settled."""

    admission: Admission
    reasons: list[str]

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all participants of a batch."""
        outputs = super().__call__(inputs)
        self.reasons += [self.admission.refusal_reason(*made) for made in outputs.items()]
        return outputs


def played(scenario: Scenario, steps: int | None = None) -> tuple[Judged, Simulation]:
    """A mission, at least its first steps."""
    setup = WorldSetup.of(scenario, 3)
    exchange = Judged(team(scenario, 3, setup))
    identities = team_identities(scenario, 3)
    exchange.admission, exchange.reasons = Admission(scenario, setup, identities), []
    simulation = Simulation(scenario, 3, setup, [exchange.admission.observe], identities)
    enough = lambda: steps is not None and len(exchange.reasons) >= 3 * steps  # noqa: E731
    simulate(simulation, exchange, 3, enough, exchange)
    return exchange, simulation


@pytest.mark.parametrize("name", MISSIONS)
def test_an_honest_report_is_never_refused(name: str) -> None:
    """Whatever the planner, the merge and the faults: also after lost logs and with late news."""
    exchange, _ = played(MISSIONS[name])

    assert len(exchange.reasons) > STEPS
    assert set(exchange.reasons) == {""}


@pytest.mark.parametrize("name", LIARS)
def test_a_declared_liar_is_let_through_and_so_are_those_who_believe_it(name: str) -> None:
    exchange, _ = played(LIARS[name])

    assert len(exchange.reasons) > STEPS
    assert set(exchange.reasons) == {""}


@pytest.mark.parametrize("lie", ["rewrite", "claim", "overstate", "fork", "teleport"])
def test_the_same_lie_is_refused_of_one_who_is_not_declared(lie: str) -> None:
    """World-sim knows better, whatever is signed."""
    scenario = LIARS[lie]
    honest = msgspec.structs.replace(scenario, faults=())
    setup = WorldSetup.of(scenario, 3)
    exchange, identities = Judged(team(scenario, 3, setup)), team_identities(scenario, 3)
    exchange.admission, exchange.reasons = Admission(honest, setup, identities), []
    simulation = Simulation(scenario, 3, setup, [exchange.admission.observe], identities)
    simulate(simulation, exchange, 3, lambda: any(exchange.reasons), exchange)

    assert any(exchange.reasons)


def test_a_declared_liar_does_not_break_the_record() -> None:
    """What is malformed, or about incarnations that never were, is refused of everybody."""
    scenario = LIARS["rewrite"]
    setup = WorldSetup.of(scenario, 3)
    admission = Admission(scenario, setup, team_identities(scenario, 3))
    outputs = Outputs(step=1, pose=setup.poses(scenario)["r2"])
    message = GossipMessage(1, 1, 0.0, 0.0, bytes(6), b"", b"")
    cases = {
        "a malformed envelope": message_with(message, logs=b"\x01"),
        "an envelope about an incarnation that never was": message_with(
            message, version_vector=bytes(12)
        ),
        "an envelope of incarnation 1": message_with(message, incarnation=1),
    }
    for reason, body in cases.items():
        sent = msgspec.structs.replace(outputs, outbox=(Envelope("r2", 1, "", body),))
        assert admission.refusal_reason("r2", sent) == reason


def message_with(message: GossipMessage, **values: object) -> bytes:
    """The body of a message with other values."""
    return encode_gossip(msgspec.structs.replace(message, **values))


def next_report(name: ParticipantId = "r2", *overrides: str) -> tuple[Admission, Outputs]:
    """The admission of a mission under way, and the honest outputs of a robot's next step."""
    exchange, simulation = played(mission(*overrides), STEPS)
    request = simulation.request(name, simulation.done_ns + 100_000_000)
    outputs = InProcessExchange.__call__(exchange, {name: request.inputs})[name]
    assert exchange.admission.refusal_reason(name, outputs) == ""
    return exchange.admission, outputs


def suffix(origin: int, start: int, *entries: tuple[int, int]) -> bytes:
    """A suffix of a log with (sample, units)."""
    packed = uint(origin) + uint(start) + uint(len(entries)) + uint(len(entries))
    before = 0
    for sample, units in entries:
        packed += uint(zigzag(sample - before)) + uint(units)
        before = sample
    return packed


def sending(outputs: Outputs, **changes: object) -> Outputs:
    """The same outputs with another gossip message."""
    envelope = outputs.outbox[0]
    message = msgspec.structs.replace(decode_gossip(envelope.body), **changes)
    forged = msgspec.structs.replace(envelope, body=encode_gossip(message))
    return msgspec.structs.replace(outputs, outbox=(forged,))


def enveloped(outputs: Outputs, **changes: object) -> Outputs:
    """The same outputs with another envelope."""
    envelope = msgspec.structs.replace(outputs.outbox[0], **changes)
    return msgspec.structs.replace(outputs, outbox=(envelope,))


def many(outputs: Outputs, count: int) -> Outputs:
    """The same outputs with so many envelopes, numbered upwards."""
    first = outputs.outbox[0]
    return msgspec.structs.replace(
        outputs,
        outbox=tuple(
            msgspec.structs.replace(first, sequence=first.sequence + i) for i in range(count)
        ),
    )


ROSTER = 3
NOTHING = uint(0) * ROSTER
IMPOSSIBLE: dict[str, tuple[str, Callable[[Outputs], Outputs]]] = {
    "another-s-name": ("in the name of another", lambda o: enveloped(o, source="r1")),
    "no-such-target": ("for nobody", lambda o: enveloped(o, target="r9")),
    "number-used-before": ("envelope 1 after", lambda o: enveloped(o, sequence=1)),
    "number-of-a-forgery": ("envelope 46", lambda o: enveloped(o, sequence=(1 << 62) + 5)),
    "one-number-twice": ("after", lambda o: msgspec.structs.replace(o, outbox=2 * o.outbox)),
    "too-many-envelopes": ("9 envelopes", lambda o: many(o, OUTBOX_MAX + 1)),
    "malformed": ("malformed", lambda o: enveloped(o, body=b"\xc1")),
    "malformed-log": ("malformed", lambda o: sending(o, logs=b"\x01")),
    "malformed-registers": ("malformed", lambda o: sending(o, registers=b"\x01")),
    "another-incarnation": ("of incarnation 4", lambda o: sending(o, incarnation=4)),
    "incarnation-that-never-was": (
        "never was",
        lambda o: sending(o, version_vector=2 * (2 * NOTHING), logs=b"", claims=b""),
    ),
    "another-s-log": (
        "their origin never made",
        lambda o: sending(o, logs=suffix(0, 0, *((j, 2) for j in range(10)))),
    ),
    "own-log": (
        "its own log that it never made",
        lambda o: sending(o, logs=suffix(1, 0, *((j, 2) for j in range(10)))),
    ),
    "more-than-its-energy": (
        "malformed",
        lambda o: sending(o, logs=suffix(1, 0, *((j, 2) for j in range(12)))),
    ),
    "own-log-goes-on": (
        "its own log that it never made",
        lambda o: sending(o, logs=suffix(1, 40, (0, 2))),
    ),
    "holds-what-was-never-written": (
        "more of a log than its origin has written",
        lambda o: sending(o, version_vector=uint(900) + 5 * uint(0), logs=b"", claims=b""),
    ),
    "has-written-more-than-it-spent": (
        "a longer log of its own",
        lambda o: sending(o, version_vector=uint(0) + uint(900) + 4 * uint(0), logs=b""),
    ),
    "claim-from-the-future": (
        "stamp",
        lambda o: sending(o, claims=uint(0) + uint(900) + uint(1) + uint(0)),
    ),
    "own-claim-from-the-future": (
        "stamp",
        lambda o: sending(o, claims=uint(1) + uint(900) + uint(1) + uint(0)),
    ),
    "jump": (
        "a move of",
        lambda o: msgspec.structs.replace(o, pose=Pose(o.pose.x_m + 400.0, o.pose.y_m)),
    ),
    "nan": ("not finite", lambda o: msgspec.structs.replace(o, pose=Pose(float("nan"), 0.0))),
    "too-much-spending": (
        "more entries than there are samples",
        lambda o: msgspec.structs.replace(o, spent=bytes(20 * 12 + 2)),
    ),
    "spending-that-does-not-decode": (
        "spending that does not decode",
        lambda o: msgspec.structs.replace(o, spent=b"\x80"),
    ),
    "too-long-weights": (
        "longer than any",
        lambda o: msgspec.structs.replace(o, weights=bytes(2000)),
    ),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_what_cannot_be_is_refused(name: str) -> None:
    """Each with its own reason, and a sound report after it passes as if it had never come."""
    reason, change = IMPOSSIBLE[name]
    admission, honest = next_report()

    assert reason in admission.refusal_reason("r2", change(honest))
    assert admission.refusal_reason("r2", honest) == ""


def test_a_weight_below_what_all_spending_leaves_is_refused() -> None:
    """With the minimum nobody knows who lowered a weight, but how far all together can have."""
    admission, honest = next_report("r2", *MINIMUM)
    emptied = suffix(1, 0, *((j, 0) for j in range(12)))

    assert "below" in admission.refusal_reason("r2", sending(honest, logs=emptied))


@pytest.fixture(scope="module")
def under_way() -> tuple[Admission, Outputs]:
    """A mission under way, for many examples."""
    return next_report()


ENTRIES = st.lists(st.tuples(st.integers(0, 11), st.integers(0, 2)), min_size=1, max_size=4)


@given(origin=st.integers(0, 2), start=st.integers(0, 40), entries=ENTRIES)
@examples(300)
def test_a_log_passes_exactly_if_it_is_what_its_origin_consumed(
    under_way: tuple[Admission, Outputs], origin: int, start: int, entries: list[tuple[int, int]]
) -> None:
    """Against the plain rule, for any suffix of any log, by any sender."""
    admission, honest = under_way
    own = admission._pairs.decode(honest.spent, 12)
    assert own is not None
    length = int(admission._written[origin])
    truth = [tuple(entry) for entry in admission._logs[origin, :length].tolist()]
    if origin == 1:
        truth += list(zip(own[0].tolist(), own[1].tolist(), strict=True))
    reason = admission.refusal_reason("r2", sending(honest, logs=suffix(origin, start, *entries)))

    assert (reason == "") == (truth[start : start + len(entries)] == entries)


@given(
    parts=st.fixed_dictionaries(
        {},
        optional={
            "version_vector": st.binary(max_size=14),
            "logs": st.binary(max_size=30),
            "claims": st.binary(max_size=12),
            "registers": st.binary(max_size=12),
            "incarnation": st.integers(0, 15),
            "step": st.integers(0, 100),
        },
    )
)
@examples(300)
def test_nothing_that_passes_is_refused_by_a_receiver(
    under_way: tuple[Admission, Outputs], parts: dict[str, object]
) -> None:
    """Whatever a message says: no receiver has to refuse it, and so none is blamed for that."""
    admission, honest = under_way
    outputs = sending(honest, **parts)
    if admission.refusal_reason("r2", outputs) == "":
        message: GossipMessage = decode_gossip(outputs.outbox[0].body)
        assert admission._receivers.passes(1, message)
        assert message.incarnation == 0


def test_an_envelope_is_numbered_in_its_step() -> None:
    """Eight envelopes are the most; their numbers rise, and are not beyond what so many steps can have used."""
    admission, honest = next_report()

    assert admission.refusal_reason("r2", many(honest, OUTBOX_MAX)) == ""
    step = honest.step
    for sequence, passes in (
        (step, True),
        (OUTBOX_MAX * step, True),
        (OUTBOX_MAX * step + 1, False),
    ):
        reason = admission.refusal_reason("r2", enveloped(honest, sequence=sequence))
        assert (reason == "") == passes


def test_a_move_of_one_period_passes_and_a_longer_one_does_not() -> None:
    """However long the robot was silent."""
    admission, honest = next_report()
    start = admission._poses["r2"]
    for way_m, passes in ((10.0, True), (10.01, False)):
        moved = msgspec.structs.replace(honest, pose=Pose(start.x_m + way_m, start.y_m))
        assert (admission.refusal_reason("r2", moved) == "") == passes


def test_envelopes_have_one_sender() -> None:
    """An outbox of two envelopes, one of which is another's, is refused whole."""
    admission, honest = next_report()
    other = Envelope("r1", honest.step + 1, "", honest.outbox[0].body)
    both = msgspec.structs.replace(honest, outbox=(*honest.outbox, other))

    assert "another" in admission.refusal_reason("r2", both)


# Attestations.


def attested(run: str, signer: ParticipantId, **changes: object) -> Attestation:
    """What r2 says of itself, or something else, signed by somebody for a run."""
    said = msgspec.structs.replace(Attestation(1, 16, 0, bytes(HASH_BYTES)), **changes)
    return signed(run, said, _key(3, signer))


IDENTITIES = team_identities(mission(SIGNED), 3)
assert IDENTITIES is not None
RUN = IDENTITIES.run
FALSE_ATTESTATIONS: dict[str, tuple[str, tuple[Attestation, ...]]] = {
    "unsigned": ("r2", (Attestation(1, 16, 0, bytes(HASH_BYTES)),)),
    "signed-by-another": ("r2", (attested(RUN, "r1"),)),
    "of-another-run": ("r2", (attested(RUN + "0", "r2"),)),
    "another-s-in-the-own-name": ("r1", (attested(RUN, "r2", origin=0),)),
    "another-s-unsigned": ("r3", (Attestation(2, 16, 0, bytes(HASH_BYTES)), attested(RUN, "r2"))),
    "changed": ("r2", (msgspec.structs.replace(attested(RUN, "r2"), length=1),)),
    "a-short-signature": ("r2", (msgspec.structs.replace(attested(RUN, "r2"), signature=b"r2"),)),
}


@pytest.mark.parametrize("name", FALSE_ATTESTATIONS)
def test_what_its_origin_has_not_signed_is_refused_and_named(name: str) -> None:
    """Whoever sends it: the report is refused whole."""
    admission, honest = next_report("r2", SIGNED)
    origin, attestations = FALSE_ATTESTATIONS[name]

    reason = admission.refusal_reason("r2", sending(honest, attestations=attestations))

    assert reason == f"an attestation that {origin} has not signed"


FALSE_WORDS: dict[str, tuple[str, dict[str, object]]] = {
    "as-it-is": ("", {}),
    "of-an-earlier-step": ("an attestation of step 3", {"step": 3}),
    "of-a-step-to-come": ("an attestation of step 99", {"step": 99}),
    "shorter": ("of another log", {"length": 1}),
    "longer": ("of another log", {"length": 40}),
    "of-other-entries": ("of another log", {"log": bytes(HASH_BYTES)}),
}


@pytest.mark.parametrize("name", FALSE_WORDS)
def test_a_robot_that_attests_what_it_has_not_done_is_refused(name: str) -> None:
    """World-sim knows what was consumed; a refused report leaves no trace in what it knows."""
    reason, change = FALSE_WORDS[name]
    admission, honest = next_report("r2", SIGNED)
    spent = Pairs().decode(honest.spent, 12)
    written = int(admission._written[1])
    assert spent is not None
    log = np.concatenate([admission._logs[1, :written], np.stack(spent, axis=1)])
    true = {
        "step": honest.step,
        "length": len(log),
        "log": Chain(valued=True).hash(log.astype(np.int32), len(log)),
    }

    for _ in range(2):
        told = attested(RUN, "r2", **(true | change))
        told_reason = admission.refusal_reason("r2", sending(honest, attestations=(told,)))
        assert reason in told_reason
        assert (reason == "") == (told_reason == "")
    assert admission.refusal_reason("r2", honest) == ""


def test_without_identities_no_attestation_passes() -> None:
    """In an open mission nobody signs."""
    admission, honest = next_report("r2")

    reason = admission.refusal_reason("r2", sending(honest, attestations=(attested(RUN, "r2"),)))

    assert reason == "an attestation, and trust is open"
