"""Forged envelopes: extra envelopes with real ones, which every receiver refuses."""

import itertools
from collections import Counter
from collections.abc import Callable, Sequence

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Envelope, Pose
from kantor_protocol.scenario.faults.links import (
    FORGED_SEQUENCE_MIN,
    Delay,
    Drop,
    Hostile,
    Partition,
)
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import (
    BODY_BYTES_MAX,
    GossipMessage,
    RefusedError,
    decode_gossip,
    encode_gossip,
)
from kantor_worldsim.radio import link_faults as injection
from kantor_worldsim.radio.channel import DROPPED, Channel, DeliveryDecision, Sent
from kantor_worldsim.radio.forgeries import (
    FORGERS,
    OVERSIZED_SHARE,
    ForgeryDraws,
    forge,
    forged,
    strangers,
)
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.record.records import (
    Batch,
    EnvelopeIndex,
    Opening,
    Record,
    decode_record,
    encode_record,
)
from kantor_worldsim.world.world import WorldSetup
from support.missions import on_map, setup_of
from support.strategies import NEWS, SEEDS, examples, mission

MS = 1_000_000
BODY = encode_gossip(GossipMessage(1, 7, 1.0, 2.0, b"\1\2\3\4\5\6", b"\0\0\1\1\2\1", b"\0\1\1\0"))
NAMES = ("r1", "r2", "r3")


class HostileRadio:
    """A radio with all participants in one place."""

    def __init__(self, *faults: Hostile | Partition | Delay | Drop, seed: int = 1) -> None:
        self.scenario = msgspec.structs.replace(mission(), faults=faults)
        self.faults = LinkFaults(self.scenario, seed)
        self.channel = Channel(self.scenario, seed, None, self.faults.rule)
        for name in self.scenario.roster:
            self.channel.place(name, Pose(0.0, 0.0))

    def transmit(self, *sent: Sent) -> tuple[list[DeliveryDecision], list[DeliveryDecision]]:
        """Decisions on envelopes, and on the forgeries that arrive with them."""
        decisions = self.channel.transmit(sent)[0]
        extra = [v for v in decisions if v.sequence >= FORGED_SEQUENCE_MIN]
        return [v for v in decisions if v.sequence < FORGED_SEQUENCE_MIN], extra


def broadcasts(count: int) -> list[Sent]:
    """`count` broadcasts of each participant, 100 ms apart."""
    return [
        Sent(100 * MS * i, Envelope(name, i, EVERYBODY, BODY))
        for i in range(1, count + 1)
        for name in NAMES
    ]


# Injected envelopes.


def test_forgeries_change_no_decision_on_sent_envelopes() -> None:
    radio = HostileRadio(Hostile(probability=0.5))

    assert radio.transmit(*broadcasts(50))[0] == HostileRadio().transmit(*broadcasts(50))[0]


@pytest.mark.parametrize("probability", [0.1, 0.9])
def test_forgeries_come_at_their_rate(probability: float) -> None:
    radio = HostileRadio(Hostile(probability=probability))
    extra = radio.transmit(*broadcasts(300))[1]
    (stats,) = radio.faults.pop_stats()

    assert abs(len(extra) - 1800 * probability) < 5 * (1800 * 0.09) ** 0.5
    assert stats.forged == len(extra)


def test_a_forgery_arrives_with_its_message_and_has_a_sequence_number_of_its_own() -> None:
    """A forgery is for the same receiver, in the sender's name or a stranger's, and it is on record."""
    radio = HostileRadio(Hostile(probability=1.0))
    decisions, extra = radio.transmit(*broadcasts(100))
    forgeries = radio.faults.pop_forged()

    assert [v.sequence for v in extra] == list(
        range(FORGED_SEQUENCE_MIN, FORGED_SEQUENCE_MIN + 600)
    )
    assert [(v.source, v.sequence, v.target) for v in extra] == [
        (e.source, e.sequence, e.target) for e in forgeries
    ]
    for own, other in zip(decisions, extra, strict=True):
        assert (own.target, own.due_ns) == (other.target, other.due_ns)
        assert other.source == own.source or other.source in strangers(NAMES)
    assert radio.faults.pop_forged() == ()
    assert radio.transmit(*broadcasts(1))[1][0].sequence == FORGED_SEQUENCE_MIN + 600


def test_other_link_faults_apply_to_forgeries() -> None:
    """A cut severs them as well, losses are drawn for each alone, delays apply to them."""
    halves = HostileRadio(Hostile(probability=1.0), Partition(shape="halves")).transmit(
        *broadcasts(50)
    )
    lossy = HostileRadio(Hostile(probability=1.0), Drop(probability=0.5)).transmit(*broadcasts(200))
    late = HostileRadio(Delay(delay_s=0.5), Hostile(probability=1.0)).transmit(*broadcasts(1))

    for own, other in zip(*halves, strict=True):
        assert own.due_ns == other.due_ns
    drops = Counter((a.due_ns == DROPPED, b.due_ns == DROPPED) for a, b in zip(*lossy, strict=True))
    assert all(230 < drops[pair] < 370 for pair in itertools.product((False, True), repeat=2))
    assert {v.due_ns for v in late[1]} == {600 * MS}


@examples(40)
@given(st.data())
def test_forgeries_depend_on_the_message_alone(data: st.DataObject) -> None:
    """All but their sequence numbers: in any portions, with others in between or not."""
    talk = broadcasts(20)
    some = [talk[i] for i in sorted(data.draw(st.sets(st.integers(0, len(talk) - 1))))]
    made = []
    for portions in ([talk], [some], [[each] for each in some]):
        radio = HostileRadio(Hostile(probability=0.5))
        made.append([])
        for portion in portions:
            radio.transmit(*portion)
        for envelope in radio.faults.pop_forged():
            made[-1].append((envelope.source, envelope.target, envelope.body))

    assert made[1] == made[2]
    assert not Counter(made[1]) - Counter(made[0])


# The catalogue.


def test_no_participant_has_a_name_that_forgeries_use() -> None:
    for scenario in (mission(), mission("coordination=centralized")):
        assert not set(strangers(scenario.roster)) & set(scenario.roster)
        assert EVERYBODY in strangers(scenario.roster)
    assert SUPERVISOR in strangers(NAMES)


def test_every_entry_of_the_catalogue_occurs_and_oversized_ones_are_rare() -> None:
    made = [
        forge(ForgeryDraws(1, 5, i, 0), Envelope("r1", i, "", BODY), ("x",)) for i in range(8000)
    ]
    oversized = sum(len(body) > BODY_BYTES_MAX for _, body in made)
    strange = sum(source == "x" for source, _ in made)

    assert 10 < oversized < 60
    assert abs(oversized - 8000 * OVERSIZED_SHARE) < 30
    assert 700 < strange < 1100
    assert all(body == BODY for source, body in made if source == "x")
    assert len({body for _, body in made}) > 400


@examples(200)
@given(
    news=NEWS,
    noise=st.binary(max_size=50),
    seed=SEEDS,
    which=st.integers(0, len(FORGERS) - 1),
)
def test_forgers_are_total_and_deterministic(
    news: GossipMessage, noise: bytes, seed: int, which: int
) -> None:
    for body in (encode_gossip(news), noise, b""):
        first, second = (
            forged(FORGERS[which], ForgeryDraws(seed, 1, 2, 3), body) for _ in range(2)
        )
        assert first == second


def _is_gossip(body: bytes) -> bool:
    try:
        decode_gossip(body)
    except RefusedError:
        return False
    return True


def test_some_forgeries_decode_and_are_refused_by_their_contents() -> None:
    """So the decoder is not the only check that is tested."""
    decoded = [f for f in FORGERS if _is_gossip(forged(f, ForgeryDraws(1, 1, 1, 1), BODY))]

    assert len(decoded) >= 8


# Whole missions.

ROOMY = ("samples.count=60", "energy.points=90", "energy.steps=60")
WORLDS: dict[str, Callable[[], Scenario]] = {
    "ledger": lambda: mission(*ROOMY),
    "state": lambda: mission(*ROOMY, "radio.beacon=state"),
    "min": lambda: mission(*ROOMY, "merge=min", "claims=false"),
    "spectral": lambda: mission(*ROOMY, "planner.name=spectral", "claims=false"),
    "centralized": lambda: mission(*ROOMY, "coordination=centralized"),
    "map": lambda: on_map("radio.range_m=30"),
    "map-hungarian": lambda: on_map(
        "radio.range_m=30", "coordination=centralized", "planner.name=burgard"
    ),
}


def recorded(scenario: Scenario) -> list[Record]:
    """The records of a mission."""
    setup = setup_of(scenario) if scenario.mapping else WorldSetup.of(scenario, 1)
    records: list[Record] = []
    play(scenario, 1, setup, [records.append])
    return records


def without_forgeries(records: Sequence[Record]) -> list[Record]:
    """The records as if nothing had been forged, and nothing refused."""
    return [_clean(record) for record in records]


def _clean(record: Record) -> Record:
    replace = msgspec.structs.replace
    if isinstance(record, Opening):
        return replace(record, scenario=replace(record.scenario, faults=()))
    if not isinstance(record, Batch):
        return record
    step_records = [
        replace(
            step_record,
            heard=tuple(each for each in step_record.heard if each[1] < FORGED_SEQUENCE_MIN),
            outputs=step_record.outputs and replace(step_record.outputs, refused=0),
        )
        for step_record in record.step_records
    ]
    decisions = [v for v in record.decisions if v.sequence < FORGED_SEQUENCE_MIN]
    return replace(
        record,
        step_records=tuple(step_records),
        decisions=tuple(decisions),
        fault_stats=(),
        injected=(),
    )


@pytest.mark.parametrize("name", WORLDS)
def test_every_participant_refuses_every_entry_of_the_catalogue(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each participant acts as without forgeries, and counts each that reaches it.

    Every forger, and every stranger, in turn.
    """
    made: Counter[object] = Counter()

    def in_turn(
        draws: ForgeryDraws, envelope: Envelope, names: tuple[str, ...]
    ) -> tuple[str, bytes]:
        which = made.total() % (len(FORGERS) + len(names))
        made[which] += 1
        if which < len(FORGERS):
            return envelope.source, forged(FORGERS[which], draws, envelope.body)
        return names[which - len(FORGERS)], envelope.body

    monkeypatch.setattr(injection, "forge", in_turn)
    scenario = WORLDS[name]()
    faults = 6 * (Hostile(probability=1.0),)
    records = recorded(msgspec.structs.replace(scenario, faults=faults))
    refused: Counter[str] = Counter()
    for record in records:
        for step_record in record.step_records if isinstance(record, Batch) else ():
            refused[step_record.name] += sum(
                sequence >= FORGED_SEQUENCE_MIN for _, sequence in step_record.heard
            )
            assert step_record.outputs is not None
            assert step_record.outputs.refused == refused[step_record.name]

    assert min(made.values()) >= 3
    assert len(made) == len(FORGERS) + len(strangers(scenario.roster))
    assert without_forgeries(records) == without_forgeries(recorded(scenario))


def test_inboxes_with_forgeries_can_be_rebuilt() -> None:
    """From the records as they are kept, also when they have to be encoded first."""
    scenario = msgspec.structs.replace(mission(), faults=3 * (Hostile(probability=0.5),))
    index = EnvelopeIndex()
    received = 0
    for record in recorded(scenario):
        again = decode_record(encode_record(record))
        assert again == record
        if isinstance(again, Batch):
            for step_record in again.step_records:
                inputs = index.inputs(step_record)
                received += sum(
                    envelope.sequence >= FORGED_SEQUENCE_MIN for envelope in inputs.inbox
                )
            index.add(again)

    assert received > 50
