"""The checker is silent on a sound record, and finds each rule that is broken alone."""

import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise, product
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import SUPERVISOR, Envelope, ParticipantId, Pose
from kantor_protocol.base.varint import Pairs, put_uint
from kantor_protocol.replication.cosine_basis import VISIT
from kantor_protocol.replication.registers import read_register
from kantor_protocol.scenario.faults.links import Partition, Range
from kantor_protocol.scenario.faults.processes import Kill
from kantor_protocol.scenario.faults.schedule import AnyFault
from kantor_protocol.wire.messages import GossipMessage, decode_gossip, encode
from kantor_protocol.wire.version_vector import read_version_vector
from kantor_protocol.wire.weights import WeightsMessage, WeightsSubscriber
from kantor_worldsim.observers.checkers.checker import Checker, check
from kantor_worldsim.radio.channel import DROPPED, DeliveryDecision
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.record.records import Batch, Ending, Opening, ProcessEvent, Record, StepRecord
from support.checkers import listed, rules
from support.replicas import read_logs
from support.strategies import SEEDS, examples

Play = Callable[..., tuple[Record, ...]]
Records = Sequence[Record]

SPECTRAL = ("planner=spectral", "planner.modes=3")
MERGES = {"ledger": ("merge=ledger",), "min": ("merge=min", "claims=false")}
RADIOS = {
    "perfect": (),
    "short": ("radio.range_m=30", "supervisor.range_m=50"),
    "slow": ("radio.delay_s=0.25",),
    "lossy": (
        "radio.drop=0.3",
        "radio.duplicate=0.3",
        "radio.delay_s=0.03",
        "radio.jitter_s=0.2",
        "radio.reorder=0.3",
    ),
}
DEAF = ("radio.range_m=0", "supervisor.range_m=0")
"""No robot hears another, so that nothing but the broken rule is touched."""


# Ways to change a record.

Change = Callable[[StepRecord], StepRecord]


def batches(records: Records) -> list[Batch]:
    return [record for record in records if isinstance(record, Batch)]


def step_records(records: Records, name: ParticipantId) -> list[StepRecord]:
    """What a participant did, in order."""
    return [
        step_record
        for batch in batches(records)
        for step_record in batch.step_records
        if step_record.name == name
    ]


def opening(records: Records) -> Opening:
    assert isinstance(records[0], Opening)
    return records[0]


def put(records: Records, old: Any, new: Any) -> list[Record]:
    """The records with one of them in place of another."""
    return [new if record is old else record for record in records]


def put_act(records: Records, old: StepRecord, change: Change) -> list[Record]:
    """The records with one act changed."""

    def changed(batch: Batch) -> Batch:
        told = tuple(
            change(step_record) if step_record is old else step_record
            for step_record in batch.step_records
        )
        return msgspec.structs.replace(batch, step_records=told)

    return [changed(record) if isinstance(record, Batch) else record for record in records]


def outputs(**values: Any) -> Change:
    """A change of some of what a participant returned."""
    return lambda step_record: msgspec.structs.replace(
        step_record, outputs=msgspec.structs.replace(step_record.outputs, **values)
    )


def verdict(**values: Any) -> Change:
    """A change of what the world made of it."""
    return lambda step_record: msgspec.structs.replace(
        step_record, verdict=msgspec.structs.replace(step_record.verdict, **values)
    )


def heard(*references: tuple[ParticipantId, int]) -> Change:
    """A change of the inbox."""
    return lambda step_record: msgspec.structs.replace(step_record, heard=references)


def news(step_record: StepRecord, change: Callable[[GossipMessage], GossipMessage]) -> Change:
    """A change of the message that a participant sent."""
    (envelope,) = step_record.outputs.outbox
    body = encode(change(decode_gossip(envelope.body)))
    return outputs(outbox=(msgspec.structs.replace(envelope, body=body),))


LATE_NS = 1 << 60
"""After every end: who is to hear something then never does."""


def add_verdict(records: Records, batch: Batch, decision: DeliveryDecision) -> list[Record]:
    """The records with one more verdict of the radio."""
    told = msgspec.structs.replace(batch, decisions=(*batch.decisions, decision))
    return put(records, batch, told)


def with_scenario(records: Records, **tables: dict[str, Any]) -> list[Record]:
    """The records with another scenario in the opening."""
    first = opening(records)
    scenario = msgspec.structs.replace(
        first.scenario,
        **{
            key: msgspec.structs.replace(getattr(first.scenario, key), **values)
            for key, values in tables.items()
        },
    )
    return put(records, first, msgspec.structs.replace(first, scenario=scenario))


def pairs(*entries: tuple[int, int]) -> bytes:
    index = np.array([i for i, _ in entries], dtype=np.int64)
    value = np.array([v for _, v in entries], dtype=np.int64)
    return Pairs().encode(index, value, len(entries))


def entries(packed: bytes) -> list[tuple[int, int]]:
    decoded = Pairs().decode(packed, 60)
    assert decoded is not None
    return list(zip(decoded[0].tolist(), decoded[1].tolist(), strict=True))


def uints(*values: int) -> bytes:
    buffer = np.zeros(20 * len(values), dtype=np.uint8)
    at = 0
    for value in values:
        at = put_uint(buffer, at, value)
    return buffer[:at].tobytes()


def own_register(step_record: StepRecord, origins: int = 3, slot: int = 0) -> int:
    """How many writes the register of a slot has that is sent along; 0 if there is none."""
    content = decode_gossip(step_record.outputs.outbox[0].body).registers
    found = read_register(content, origins, 9, slot)
    assert found is not None
    return found[0]


def consumed(records: Records, until_ns: int) -> npt.NDArray[np.int64]:
    """Units that all participants together have shipped to each sample by then."""
    total = np.zeros(60, dtype=np.int64)
    for batch in batches(records):
        for step_record in batch.step_records if batch.now_ns <= until_ns else ():
            for sample, units in entries(step_record.outputs.spent):
                total[sample] += units
    return total


# A good record.


@pytest.mark.parametrize(
    ("merge", "coordination", "order", "radio"),
    list(product(MERGES, ("decentralized", "centralized"), ("turn", "concurrent"), RADIOS)),
)
def test_no_complaint_about_a_sound_run(
    played: Play, merge: str, coordination: str, order: str, radio: str
) -> None:
    """Whatever the merge, the coordination, the order and the radio: the rules hold."""
    overrides = (f"coordination={coordination}", f"clock.order={order}")
    records = played(*MERGES[merge], *RADIOS[radio], *overrides)

    assert check(records).violations == []
    assert isinstance(records[-1], Ending)
    assert records[-1].reason == "done"


@pytest.mark.parametrize("radio", RADIOS)
@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
def test_no_complaint_about_a_sound_run_by_registers(
    played: Play, coordination: str, radio: str
) -> None:
    """Sums over places, whatever becomes of the messages that carry them."""
    records = played(*SPECTRAL, *RADIOS[radio], f"coordination={coordination}")

    assert check(records).violations == []
    origins = len(opening(records).scenario.roster)
    told = [own_register(step_record, origins) for step_record in step_records(records, "r1")]
    assert max(told) > 5


@examples(25)
@given(
    merge=st.sampled_from(list(MERGES.values())),
    coordination=st.sampled_from(["decentralized", "centralized"]),
    order=st.sampled_from(["turn", "concurrent"]),
    range_m=st.sampled_from([0, 25, 60, 200]),
    drop=st.sampled_from([0.0, 0.3, 0.7]),
    duplicate=st.sampled_from([0.0, 0.5]),
    delay_s=st.sampled_from([0.0, 0.02, 0.1, 0.35]),
    jitter_s=st.sampled_from([0.0, 0.05, 0.4]),
    reorder=st.sampled_from([0.0, 0.4]),
    spread=st.sampled_from([0.0, 0.4]),
    late_s=st.sampled_from([0.0, 0.04]),
    seed=SEEDS,
)
def test_no_complaint_whatever_the_radio_and_the_clocks(
    played: Play,
    merge: tuple[str, ...],
    coordination: str,
    order: str,
    range_m: int,
    drop: float,
    duplicate: float,
    delay_s: float,
    jitter_s: float,
    reorder: float,
    spread: float,
    late_s: float,
    seed: int,
) -> None:
    """No loss, delay or clock makes a sound robot break a rule."""
    records = played(
        *merge,
        f"coordination={coordination}",
        f"clock.order={order}",
        f"clock.spread={spread}",
        f"clock.jitter_s={late_s}",
        f"radio.range_m={range_m}",
        f"radio.drop={drop}",
        f"radio.duplicate={duplicate}",
        f"radio.delay_s={delay_s}",
        f"radio.jitter_s={jitter_s}",
        f"radio.reorder={reorder}",
        seed=seed,
    )

    assert check(records).violations == []


# Broken records: the overrides of the run, what is done to it, and the rules that must be named.

Break = Callable[[Records], list[Record]]
BROKEN: dict[str, tuple[tuple[str, ...], Break, set[str]]] = {}


def breaks(*broken: str, run: tuple[str, ...] = ()) -> Callable[[Break], Break]:
    """Register a way to break a record of a run, with the rules that it breaks."""

    def register(broken_record: Break) -> Break:
        name = broken_record.__name__.strip("_").replace("_", "-")
        BROKEN[f"{broken[0]}-{name}"] = (run, broken_record, set(broken))
        return broken_record

    return register


@breaks("range", run=RADIOS["short"])
def _delivered_over_the_hills(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_verdict(records, first, DeliveryDecision("r1", 1, "r2", LATE_NS))


@breaks("range", run=("coordination=centralized", "supervisor.range_m=20"))
def _delivered_to_a_far_supervisor(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_verdict(records, first, DeliveryDecision("r1", 1, SUPERVISOR, LATE_NS))


@breaks("range")
def _range_was_shorter_than_the_radio(records: Records) -> list[Record]:
    return with_scenario(records, radio={"range_m": 50.0})


@breaks("range", run=("coordination=centralized",))
def _supervisors_range_was_shorter(records: Records) -> list[Record]:
    return with_scenario(records, supervisor={"range_m": 5.0})


SHRUNK = ("faults=[{kind = 'range', range_m = 75.0, until_s = 0.15}]",)
HALVES = ("faults=[{kind = 'partition', shape = 'halves', until_s = 0.15}]",)
FLAPPING = ("faults=[{kind = 'partition', shape = 'halves', flap_s = 0.2}]",)
MUTE = ("faults=[{kind = 'one-way', senders = ['r1'], receivers = ['r3']}]",)


def under(records: Records, *faults: AnyFault) -> list[Record]:
    """The records with other faults in the opening."""
    first = opening(records)
    scenario = msgspec.structs.replace(first.scenario, faults=faults)
    return put(records, first, msgspec.structs.replace(first, scenario=scenario))


def revived(records: Records) -> list[Record]:
    """The records with one drop, the first, as a delivery."""
    batch = next(b for b in batches(records) if any(v.due_ns == DROPPED for v in b.decisions))
    lost = next(v for v in batch.decisions if v.due_ns == DROPPED)
    found = msgspec.structs.replace(lost, due_ns=LATE_NS)
    told = tuple(found if decision is lost else decision for decision in batch.decisions)
    return put(records, batch, msgspec.structs.replace(batch, decisions=told))


@breaks("range", run=SHRUNK)
def _delivered_beyond_the_shrunk_range(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_verdict(records, first, DeliveryDecision("r1", 1, "r2", LATE_NS))


@breaks("range")
def _range_was_to_shrink(records: Records) -> list[Record]:
    return under(records, Range(range_m=50.0, from_s=0.5))


@breaks("range", run=("coordination=centralized", "supervisor.range_m=100"))
def _supervisors_range_was_to_shrink(records: Records) -> list[Record]:
    return under(records, Range(factor=0.25, robots=("r2",)))


@breaks("cut", run=HALVES)
def _delivered_across_a_partition(records: Records) -> list[Record]:
    return revived(records)


@breaks("cut", run=FLAPPING)
def _delivered_across_a_partition_that_flaps(records: Records) -> list[Record]:
    return revived(records)


@breaks("cut", run=MUTE)
def _delivered_against_a_one_way_link(records: Records) -> list[Record]:
    return revived(records)


@breaks("cut", run=HALVES)
def _partition_was_to_last_longer(records: Records) -> list[Record]:
    return under(records, Partition(shape="halves", until_s=0.25))


@breaks("cut")
def _replayed_across_a_partition(records: Records) -> list[Record]:
    fifth = batches(records)[4]
    cut = Partition(shape="isolate", robots=("r3",), from_s=0.45, until_s=0.55)
    apart = msgspec.structs.replace(
        fifth, decisions=tuple(v for v in fifth.decisions if "r3" not in (v.source, v.target))
    )
    deaf = put(records, fifth, apart)
    sixth = batches(deaf)[5]
    told = tuple(put_heard(step_record, apart) for step_record in sixth.step_records)
    deaf = put(deaf, sixth, msgspec.structs.replace(sixth, step_records=told))
    return add_verdict(under(deaf, cut), apart, DeliveryDecision("r1", 2, "r3", LATE_NS))


def put_heard(step_record: StepRecord, batch: Batch) -> StepRecord:
    """The act without what a batch did not deliver to it."""
    told = {(v.source, v.sequence) for v in batch.decisions if v.target == step_record.name}
    return msgspec.structs.replace(
        step_record, heard=tuple(ref for ref in step_record.heard if ref in told)
    )


@breaks("delivery", run=DEAF)
def _heard_what_the_radio_did_not_deliver(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[5], heard(("r2", 5)))


@breaks("delivery")
def _heard_twice(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_act(records, step_record, heard(*step_record.heard, step_record.heard[0]))


@breaks("delivery")
def _heard_again_later(records: Records) -> list[Record]:
    early, late = step_records(records, "r1")[5:7]
    return put_act(records, late, heard(*late.heard, *early.heard))


@breaks("delivery", run=("radio.delay_s=0.25",))
def _heard_before_it_was_due(records: Records) -> list[Record]:
    early, late = step_records(records, "r1")[3:5]
    swapped = put_act(records, early, heard(*early.heard, late.heard[0]))
    return put_act(swapped, late, heard(*late.heard[1:]))


@breaks("delivery")
def _heard_what_was_dropped(records: Records) -> list[Record]:
    batch = batches(records)[3]
    lost = (msgspec.structs.replace(batch.decisions[0], due_ns=DROPPED), *batch.decisions[1:])
    return put(records, batch, msgspec.structs.replace(batch, decisions=lost))


@breaks("delivery", run=("radio.duplicate=0.999",))
def _heard_more_copies_than_were_ruled(records: Records) -> list[Record]:
    batch = batches(records)[3]
    return put(records, batch, msgspec.structs.replace(batch, decisions=batch.decisions[1:]))


@breaks("delivery")
def _delivered_what_was_never_sent(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_verdict(records, first, DeliveryDecision("r1", 77, "r2", first.now_ns))


@breaks("delivery")
def _delivered_to_a_stranger(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_verdict(records, first, DeliveryDecision("r1", 1, "r9", first.now_ns))


@breaks("delivery", run=("coordination=centralized",))
def _delivered_to_another_target(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_verdict(records, first, DeliveryDecision("r1", 1, "r2", first.now_ns))


@breaks("weights", run=MERGES["min"])
def _weight_rises(records: Records) -> list[Record]:
    last = step_records(records, "r1")[-1]
    spent_first = entries(step_records(records, "r1")[0].outputs.lowered)[0][0]
    return put_act(records, last, outputs(lowered=pairs((spent_first, 3))))


@breaks("weights", run=MERGES["min"])
def _weight_falls_to_what_it_was(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    fallen = entries(step_record.outputs.lowered)
    return put_act(records, step_record, outputs(lowered=pairs(*fallen, fallen[0])))


@breaks("weights", run=(*MERGES["min"], *DEAF))
def _lowered_does_not_decode(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[-1], outputs(lowered=b"\x80"))


@breaks("weights", run=MERGES["min"])
def _published_vector_is_not_the_robots(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[10]
    message = msgspec.msgpack.decode(step_record.outputs.weights, type=WeightsMessage)
    assert message.base > 0
    risen = msgspec.structs.replace(message, content=b"")
    return put_act(records, step_record, outputs(weights=msgspec.msgpack.encode(risen)))


@breaks("weights", run=MERGES["min"])
def _published_vector_cannot_be_rebuilt(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[10]
    return put_act(records, step_record, outputs(weights=step_record.outputs.weights[:-1]))


def republished(records: Records, which: int, **values: Any) -> list[Record]:
    """Something else in place of what the first robot published in one of its steps."""
    step_record = step_records(records, "r1")[which]
    message = msgspec.msgpack.decode(step_record.outputs.weights, type=WeightsMessage)
    assert (message.base == 0) == (which == 0)
    told = msgspec.structs.replace(message, **values)
    return put_act(records, step_record, outputs(weights=msgspec.msgpack.encode(told)))


@breaks("weights", run=MERGES["min"])
def _keyframe_is_not_the_robots(records: Records) -> list[Record]:
    return republished(
        records, 0, content=zlib.compress(bytes(opening(records).samples_m.shape[0]))
    )


@breaks("weights", run=MERGES["min"])
def _keyframe_does_not_inflate(records: Records) -> list[Record]:
    return republished(records, 0, content=b"?")


@breaks("weights", run=MERGES["min"])
def _keyframe_of_another_size(records: Records) -> list[Record]:
    return republished(records, 0, content=zlib.compress(bytes(3)), size=3)


@breaks("weights", run=MERGES["min"])
def _changes_of_something_else(records: Records) -> list[Record]:
    return republished(records, 10, base=7)


@breaks("weights", run=MERGES["min"])
def _changes_that_rise(records: Records) -> list[Record]:
    return republished(records, 10, content=pairs((0, 1_000_000)))


@breaks("weights", run=MERGES["min"])
def _changes_beyond_the_last_sample(records: Records) -> list[Record]:
    return republished(records, 10, content=pairs((opening(records).samples_m.shape[0], 0)))


@breaks("energy")
def _budget_was_smaller(records: Records) -> list[Record]:
    return with_scenario(records, energy={"steps": 20})


@breaks("energy", run=MERGES["min"])
def _point_holds_more_than_it_can(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    (sample, units), *rest = entries(step_record.outputs.spent)
    return put_act(records, step_record, outputs(spent=pairs((sample, units + 1), *rest)))


@breaks("energy")
def _counts_less_than_it_shipped(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[3], outputs(energy_spent=3))


@breaks("energy", "credit", run=MERGES["min"])
def _spending_does_not_decode(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[3], outputs(spent=b"\x80"))


@breaks("ledger")
def _sends_another_log_than_it_consumed(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[0]
    (sample, units), *_ = entries(step_record.outputs.spent)
    log = uints(0, 0, 1, 1) + pairs((sample, units % 2 + 1))
    change = news(step_record, lambda said: msgspec.structs.replace(said, logs=log))
    return put_act(records, step_record, change)


@breaks("ledger")
def _sends_entries_that_it_never_made(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[0]
    log = uints(0, 500, 1, 1) + pairs((0, 1))
    change = news(step_record, lambda said: msgspec.structs.replace(said, logs=log))
    return put_act(records, step_record, change)


@breaks("ledger")
def _sends_what_is_no_message(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    (envelope,) = step_record.outputs.outbox
    garbled = msgspec.structs.replace(envelope, body=b"\xc1")
    return put_act(records, step_record, outputs(outbox=(garbled,)))


@breaks("ledger")
def _sends_logs_that_do_not_decode(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    change = news(step_record, lambda said: msgspec.structs.replace(said, logs=b"\x80"))
    return put_act(records, step_record, change)


@breaks("ledger")
def _holds_more_of_a_log_than_there_is(records: Records) -> list[Record]:
    last = step_records(records, "r1")[-1]

    def boast(said: GossipMessage) -> GossipMessage:
        own, *others = read_version_vector(said.version_vector, 3) or []
        stamps = said.version_vector[len(uints(own, *others)) :]
        return msgspec.structs.replace(
            said, version_vector=uints(own, others[0] + 1, others[1]) + stamps
        )

    return put_act(records, last, news(last, boast))


@breaks("ledger", "weights")
def _ends_with_more_than_its_logs_leave(records: Records) -> list[Record]:
    step_record = [
        step_record for step_record in step_records(records, "r1") if step_record.outputs.lowered
    ][-1]
    return put_act(records, step_record, outputs(lowered=b""))


@breaks("ledger", "credit")
def _consumes_another_sample_than_it_says(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[0]
    other = int(np.argmin(consumed(records, step_record.now_ns)))
    (_, units), *rest = entries(step_record.outputs.spent)
    return put_act(records, step_record, outputs(spent=pairs((other, units), *rest)))


@breaks("credit", "weights", run=(*MERGES["min"], *DEAF, "energy.steps=10"))
def _view_falls_below_the_truth(records: Records) -> list[Record]:
    last = step_records(records, "r1")[-1]
    untouched = int(np.argmin(consumed(records, last.now_ns)))
    return put_act(records, last, outputs(lowered=pairs((untouched, 0))))


@breaks("credit", run=MERGES["min"])
def _view_falls_before_the_truth_does(records: Records) -> list[Record]:
    """r1 lowers a sample one step before another robot consumes it, which ends in the same views."""
    for early, late in pairwise(step_records(records, "r1")):
        before, fallen = entries(early.outputs.lowered), entries(late.outputs.lowered)
        truth = opening(records).units.sample - consumed(records, early.now_ns - 1)
        ahead = [(sample, left) for sample, left in fallen if left < truth[sample]]
        own = {sample for sample, _ in [*before, *entries(late.outputs.spent)]}
        if ahead and ahead[0][0] not in own:
            later = [entry for entry in fallen if entry != ahead[0]]
            told = put_act(records, early, outputs(lowered=pairs(*before, ahead[0])))
            return put_act(told, late, outputs(lowered=pairs(*later)))
    raise AssertionError("r1 never learns anything")


@breaks("register", run=SPECTRAL)
def _counts_a_place_where_it_was_not(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    moved = msgspec.structs.replace(step_record.observation, pose=Pose(1.0, 2.0))
    return put_act(records, step_record, lambda a: msgspec.structs.replace(a, observation=moved))


@breaks("register", run=SPECTRAL)
def _sends_sums_that_are_not_its_own(records: Records) -> list[Record]:
    step_record = [
        step_record for step_record in step_records(records, "r1") if own_register(step_record)
    ][-1]
    sums = bytes([0]) + bytes([own_register(step_record)]) + uints(2 * VISIT, *[0] * 8)
    lie = news(step_record, lambda said: msgspec.structs.replace(said, registers=bytes(3) + sums))
    return put_act(records, step_record, lie)


@breaks("register", run=SPECTRAL)
def _says_that_it_wrote_more_often(records: Records) -> list[Record]:
    step_record = [
        step_record for step_record in step_records(records, "r1") if own_register(step_record)
    ][-1]

    def boast(said: GossipMessage) -> GossipMessage:
        before, stamp, rest = said.registers[:4], said.registers[4], said.registers[5:]
        return msgspec.structs.replace(said, registers=before + bytes([stamp + 1]) + rest)

    return put_act(records, step_record, news(step_record, boast))


@breaks("register", run=SPECTRAL)
def _sends_registers_that_do_not_decode(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    change = news(step_record, lambda said: msgspec.structs.replace(said, registers=b"\x80"))
    return put_act(records, step_record, change)


@breaks("speed")
def _jumps(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    pose = step_record.verdict.pose
    return put_act(records, step_record, verdict(pose=Pose(pose.x_m + 30.0, pose.y_m)))


@breaks("speed", run=("coordination=centralized",))
def _supervisor_moves(records: Records) -> list[Record]:
    step_record = step_records(records, SUPERVISOR)[-1]
    return put_act(records, step_record, verdict(pose=Pose(50.0, 50.1)))


@breaks("speed")
def _nowhere(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[-1], verdict(pose=Pose(float("nan"), 0.0)))


@breaks("speed")
def _vehicle_was_slower(records: Records) -> list[Record]:
    return with_scenario(records, vehicle={"speed_m_s": 50.0})


@breaks("goal")
def _goal_is_no_sample(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[3], outputs(goal=(1.0, 2.0)))


@breaks("goal")
def _goal_is_used_up(records: Records) -> list[Record]:
    mine = step_records(records, "r1")
    empty = next(
        sample
        for step_record in mine
        for sample, left in entries(step_record.outputs.lowered)
        if left == 0
    )
    place = opening(records).setup.samples_m[empty].tolist()
    return put_act(records, mine[-2], outputs(goal=tuple(place)))


@breaks("goal", run=MERGES["min"])
def _goal_was_emptied_by_news(records: Records) -> list[Record]:
    places_m = opening(records).setup.samples_m.tolist()
    for step_record in step_records(records, "r1"):
        shipped = {sample for sample, _ in entries(step_record.outputs.spent)}
        for sample, left in entries(step_record.outputs.lowered):
            if left == 0 and sample not in shipped and step_record.outputs.goal is not None:
                return put_act(records, step_record, outputs(goal=tuple(places_m[sample])))
    raise AssertionError("no news empties a sample")


@breaks("order")
def _step_is_left_out(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[-1]
    return put_act(records, step_record, outputs(step=step_record.outputs.step + 1))


@breaks("order")
def _step_is_repeated(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[-1]
    return put_act(records, step_record, outputs(step=step_record.outputs.step - 1))


@breaks("order", run=DEAF)
def _time_runs_back(records: Records) -> list[Record]:
    batch = batches(records)[4]
    return put(records, batch, msgspec.structs.replace(batch, now_ns=batch.now_ns - 300_000_000))


@breaks("order")
def _no_opening(records: Records) -> list[Record]:
    return list(records[1:])


@breaks("order")
def _second_opening(records: Records) -> list[Record]:
    return [records[0], *records]


@breaks("order")
def _batch_after_the_ending(records: Records) -> list[Record]:
    return [*records, records[-2]]


@breaks("order")
def _second_ending(records: Records) -> list[Record]:
    return [*records, records[-1]]


@breaks("order")
def _stranger_acts(records: Records) -> list[Record]:
    first = batches(records)[0]
    stranger = msgspec.structs.replace(first.step_records[0], name="r9")
    return put(
        records, first, msgspec.structs.replace(first, step_records=(*first.step_records, stranger))
    )


@breaks("ruling")
def _world_refused_something(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[3], verdict(violations=("speed",)))


# What befalls processes.

PAUSED = ("faults=[{kind = 'pause', who = ['r2'], from_s = 0.5, until_s = 1.1}]",)
FULL = ("faults=[{kind = 'full-disk', who = ['r2'], from_s = 0.5, until_s = 1.1}]",)
LATE = ("faults=[{kind = 'late', who = ['r2'], until_s = 1.1}]",)
KILLED = ("faults=[{kind = 'kill', who = ['r2'], from_s = 0.5, until_s = 1.1}]",)
FORGETFUL = ("faults=[{kind = 'kill', who = ['r2'], from_s = 0.5, until_s = 1.1, disk = 'lost'}]",)
TORN = (FORGETFUL[0].replace("lost", "torn"),)
MID_STEP = (FORGETFUL[0].replace("disk = 'lost'", "mid_step = true"),)
WORLDLESS = ("faults=[{kind = 'kill', who = ['worldsim'], from_s = 0.5, until_s = 1.1}]",)
SKEWED = ("faults=[{kind = 'clock', who = ['r2'], from_s = 0.5, until_s = 1.1, offset_s = 3.0}]",)
HOSTILE = ("faults=[{kind = 'hostile', probability = 0.5, from_s = 0.5, until_s = 1.1}]",)
COPIED = ("faults=[{kind = 'impostor', who = ['r2'], from_s = 0.5}]",)


@pytest.mark.parametrize(
    "faults",
    [PAUSED, FULL, LATE, KILLED, FORGETFUL, TORN, MID_STEP, WORLDLESS, SKEWED, HOSTILE, COPIED],
    ids=lambda faults: faults[0].split("'")[1],
)
@pytest.mark.parametrize("merge", MERGES)
@pytest.mark.parametrize("planner", [(), SPECTRAL, ("coordination=centralized",)])
def test_no_complaint_whatever_befalls_processes(
    played: Play, faults: tuple[str, ...], merge: str, planner: tuple[str, ...]
) -> None:
    """Sound robots break no rule when their processes are struck."""
    records = played(*faults, *MERGES[merge], *planner)

    assert check(records).violations == []
    assert befell(records)


def befell(records: Records, what: str = "") -> list[ProcessEvent]:
    """The incidents of a kind, or all but those of links."""
    found = [record for record in records if isinstance(record, ProcessEvent)]
    return [each for each in found if what in {"", each.kind}] or [
        ProcessEvent(0, "record", "injected") for batch in batches(records) if batch.injected
    ]


def changed(records: Records, of_kind: str, **values: Any) -> list[Record]:
    """The records with the first incident of a kind changed."""
    incident = befell(records, of_kind)[0]
    return put(records, incident, msgspec.structs.replace(incident, **values))


def delayed(records: Records, what: str) -> list[Record]:
    """The records with an incident that comes only after the next batch in which something is done."""
    incident = befell(records, what)[0]
    at = list(records).index(incident)
    after = next(
        i for i, r in enumerate(records) if i > at and isinstance(r, Batch) and r.step_records
    )
    later = msgspec.structs.replace(incident, now_ns=records[after].now_ns)  # type: ignore[union-attr]
    return [*records[:at], *records[at + 1 : after + 1], later, *records[after + 1 :]]


@breaks("delivery")
def _did_not_hear_what_had_arrived(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_act(records, step_record, heard(*step_record.heard[1:]))


@breaks("delivery")
def _heard_out_of_turn(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_act(records, step_record, heard(*reversed(step_record.heard)))


@breaks("delivery", run=DEAF)
def _used_a_number_twice(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    (envelope,) = step_record.outputs.outbox
    again = msgspec.structs.replace(envelope, sequence=2)
    return put_act(records, step_record, outputs(outbox=(again,)))


@breaks("delivery", run=KILLED)
def _heard_what_came_while_it_was_dead(records: Records) -> list[Record]:
    step_record = next(
        step_record
        for step_record in step_records(records, "r2")
        if step_record.now_ns > 1_100_000_000
    )
    lost = next(
        (decision.source, decision.sequence)
        for batch in batches(records)
        for decision in batch.decisions
        if decision.target == "r2" and decision.due_ns == 600_000_000
    )
    return put_act(records, step_record, heard(lost, *step_record.heard))


@breaks("delivery", run=MID_STEP)
def _answered_without_what_it_was_given(records: Records) -> list[Record]:
    step_record = next(
        step_record
        for step_record in step_records(records, "r2")
        if step_record.now_ns == 500_000_000 and step_record.outputs
    )
    return put_act(records, step_record, heard(*step_record.heard[1:]))


@breaks("order", "epoch", "hold", run=FORGETFUL)
def _steps_begin_anew(records: Records) -> list[Record]:
    steps, again = 0, changed(records, "start", step=0)
    for step_record in step_records(records, "r2"):
        if step_record.now_ns > 1_100_000_000:
            steps += 1
            again = put_act(again, step_record, outputs(step=steps))
    return again


@breaks("epoch", "weights", "ledger", run=KILLED)
def _reborn_with_what_it_knew(records: Records) -> list[Record]:
    return changed(_same_as_before_after_a_lost_disk(records), "start", incarnation=1)


@breaks("weights", run=FORGETFUL)
def _reborn_and_does_not_begin_with_all_weights(records: Records) -> list[Record]:
    told = [
        step_record
        for step_record in step_records(records, "r2")
        if step_record.outputs and step_record.outputs.weights
    ]
    step_record = next(step_record for step_record in told if step_record.now_ns >= 1_100_000_000)
    changes = msgspec.msgpack.decode(step_record.outputs.weights)
    changes[3] = 1  # as if they were changes of something
    return put_act(records, step_record, outputs(weights=msgspec.msgpack.encode(changes)))


@breaks("energy", run=FORGETFUL)
def _budget_was_for_all_its_lives(records: Records) -> list[Record]:
    spent = max(
        sum(bool(step_record.outputs.spent) for step_record in step_records(records, n))
        for n in ("r1", "r3")
    )
    both = sum(bool(step_record.outputs.spent) for step_record in step_records(records, "r2"))
    assert spent >= both or both > spent
    return with_scenario(records, energy={"steps": max(spent, both) - 1})


@breaks("ledger", run=FORGETFUL)
def _forgets_its_predecessors_log(records: Records) -> list[Record]:
    step_record = step_records(records, "r2")[-1]

    def forget(said: GossipMessage) -> GossipMessage:
        told = read_version_vector(said.version_vector, 6) or []
        rest = said.version_vector[len(uints(*told)) :]
        return msgspec.structs.replace(said, version_vector=uints(told[0], 0, *told[2:]) + rest)

    return put_act(records, step_record, news(step_record, forget))


@breaks("ledger")
def _holds_entries_of_no_incarnation(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[-1]

    def invent(said: GossipMessage) -> GossipMessage:
        told = read_version_vector(said.version_vector, 3) or []
        return msgspec.structs.replace(said, version_vector=uints(*told, 1, 0, 0, *([0] * 6)))

    return put_act(records, step_record, news(step_record, invent))


@breaks("ledger")
def _forwards_what_its_origin_never_made(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    log = uints(1, 0, 1, 1) + pairs((59, 1))
    return put_act(
        records,
        step_record,
        news(step_record, lambda said: msgspec.structs.replace(said, logs=log)),
    )


@breaks("register", run=(*FORGETFUL, *SPECTRAL))
def _goes_on_with_its_predecessors_sums(records: Records) -> list[Record]:
    step_record = next(
        step_record
        for step_record in reversed(step_records(records, "r2"))
        if own_register(step_record, 6, 4)
    )
    content = decode_gossip(step_record.outputs.outbox[0].body).registers
    _, sums = read_register(content, 6, 9, 4) or (0, [])
    register = uints(0, 0, 0, 0, 0, 0, 4, own_register(step_record, 6, 4), 1, 2 * (sums[0] + VISIT))
    change = news(step_record, lambda said: msgspec.structs.replace(said, registers=register))
    return put_act(records, step_record, change)


@breaks("incident")
def _struck_by_no_fault(records: Records) -> list[Record]:
    return [*records[:9], ProcessEvent(batches(records)[7].now_ns, "r1", "slow"), *records[9:]]


@breaks("incident")
def _strikes_a_stranger(records: Records) -> list[Record]:
    return [*records[:9], ProcessEvent(batches(records)[7].now_ns, "r9", "leave"), *records[9:]]


@breaks("incident", run=COPIED)
def _strikes_another_process(records: Records) -> list[Record]:
    return changed(records, "pretend", who="r1")


@breaks("incident", run=COPIED)
def _strikes_too_early(records: Records) -> list[Record]:
    incident = befell(records)[0]
    early = msgspec.structs.replace(incident, now_ns=0)
    return [records[0], early, *(record for record in records[1:] if record is not incident)]


@breaks("incident", run=COPIED)
def _strikes_twice(records: Records) -> list[Record]:
    incident = befell(records)[0]
    at = list(records).index(incident)
    return [*records[:at], incident, *records[at:]]


@breaks("incident", run=COPIED)
def _never_strikes(records: Records) -> list[Record]:
    return [record for record in records if record is not befell(records)[0]]


@breaks("dead", run=PAUSED)
def _acts_while_it_is_paused(records: Records) -> list[Record]:
    return delayed(records, "resume")


@breaks("dead", run=FULL)
def _acts_without_a_disk(records: Records) -> list[Record]:
    return delayed(records, "free")


@breaks("dead", run=(*LATE, *DEAF))
def _acts_before_it_is_there(records: Records) -> list[Record]:
    return acting_early(records)


@breaks("dead", run=(*KILLED, *DEAF))
def _acts_while_it_is_dead(records: Records) -> list[Record]:
    return acting_early(records)


def acting_early(records: Records) -> list[Record]:
    """The records with a start that comes after a step."""
    start = befell(records, "start")[0]
    first = next(a for a in step_records(records, "r2") if a.now_ns > start.now_ns)
    return changed(delayed(records, "start"), "start", step=first.outputs.step)


@breaks("dead", run=WORLDLESS)
def _world_judges_while_it_is_down(records: Records) -> list[Record]:
    return delayed(records, "start")


@breaks("epoch", run=FORGETFUL)
def _reborn_with_a_whole_disk(records: Records) -> list[Record]:
    return under(records, Kill(who=("r2",), from_s=0.5, until_s=1.1))


@breaks("epoch", run=KILLED)
def _same_as_before_after_a_lost_disk(records: Records) -> list[Record]:
    return under(records, Kill(who=("r2",), from_s=0.5, until_s=1.1, disk="lost"))


@breaks("epoch", run=KILLED)
def _goes_on_from_a_step_to_come(records: Records) -> list[Record]:
    return changed(records, "start", step=befell(records, "start")[0].step + 2)


@breaks("epoch")
def _speaks_as_another_incarnation(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_act(
        records,
        step_record,
        news(step_record, lambda said: msgspec.structs.replace(said, incarnation=1)),
    )


@breaks("epoch", run=MERGES["min"])
def _speaks_as_another_incarnation_without_a_ledger(records: Records) -> list[Record]:
    return _speaks_as_another_incarnation(records)


@breaks("epoch", run=COPIED)
def _impostor_is_let_in(records: Records) -> list[Record]:
    return changed(records, "pretend", kind=ProcessEventKind.IMPOSTOR_ADMITTED)


@breaks("refusal")
def _refuses_what_is_sound(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[-1], outputs(refused=1))


@breaks("refusal", run=HOSTILE)
def _takes_in_what_is_forged(records: Records) -> list[Record]:
    refused = max(step_record.outputs.refused for step_record in step_records(records, "r1"))
    taken = next(
        step_record
        for step_record in step_records(records, "r1")
        if step_record.outputs.refused == refused
    )
    return put_act(records, taken, outputs(refused=refused - 1))


@breaks("refusal", run=HOSTILE)
def _something_is_forged_without_a_fault(records: Records) -> list[Record]:
    return under(records)


@breaks("refusal", run=HOSTILE)
def _forged_under_a_number_that_is_sent(records: Records) -> list[Record]:
    batch = next(batch for batch in batches(records) if batch.injected)
    more = (*batch.injected, Envelope("r1", 3, "", b""))
    return put(records, batch, msgspec.structs.replace(batch, injected=more))


@breaks("clock")
def _clock_is_wrong_of_itself(records: Records) -> list[Record]:
    return put_act(records, step_records(records, "r1")[5], skewed(1))


@breaks("clock", run=SKEWED)
def _clock_is_not_as_wrong_as_a_fault_says(records: Records) -> list[Record]:
    step_record = next(
        step_record for step_record in step_records(records, "r2") if step_record.skew_ns
    )
    return put_act(records, step_record, skewed(step_record.skew_ns - 1))


def skewed(skew_ns: int) -> Change:
    return lambda step_record: msgspec.structs.replace(step_record, skew_ns=skew_ns)


@breaks("ruling", run=SKEWED)
def _too_fast_by_a_clock_that_did_not_gain(records: Records) -> list[Record]:
    step_record = next(
        step_record for step_record in reversed(step_records(records, "r2")) if step_record.skew_ns
    )
    return put_act(records, step_record, verdict(violations=("speed",)))


def test_too_fast_by_a_clock_that_gains_is_excused(played: Play) -> None:
    """A robot cannot know that its clock has jumped: world-sim refuses the move, and no rule is broken."""
    records = played(*SKEWED)
    step_record = next(
        step_record for step_record in step_records(records, "r2") if step_record.skew_ns
    )

    assert rules(put_act(records, step_record, verdict(violations=("speed",)))) == set()
    assert rules(put_act(records, step_record, verdict(violations=("speed", "units")))) == {
        "ruling"
    }
    assert rules(put_act(records, step_record, verdict(violations=("units",)))) == {"ruling"}


@breaks("hold")
def _steps_without_having_seen_the_last_one(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    stale = msgspec.structs.replace(step_record.observation, step=step_record.observation.step - 1)
    return put_act(
        records,
        step_record,
        lambda step_record: msgspec.structs.replace(step_record, observation=stale),
    )


@pytest.mark.parametrize("name", list(BROKEN))
def test_broken_rule_is_named(played: Play, name: str) -> None:
    """A record that breaks a rule brings complaints that name this rule, and no other."""
    run, broken_record, expected = BROKEN[name]
    records = played(*run)

    assert rules(records) == set()
    assert rules(broken_record(records)) == expected


def test_every_rule_can_be_broken() -> None:
    """No rule of the checker is without a record that breaks it."""
    broken_by_rows = {"bound"}  # see test_exact.py
    assert listed(Checker) == {name.partition("-")[0] for name in BROKEN} | broken_by_rows


def test_complaint_says_when_who_and_what(played: Play) -> None:
    """A complaint is one line: rule, time, who, what."""
    records = _jumps(played(*DEAF))

    assert check(records).violations[0].startswith("speed: t=0.400 s: r1: moved ")


def test_broken_record_is_counted_to_its_end(played: Play) -> None:
    """A hundred complaints are kept, all are counted."""
    records = played()
    checker = check([*records, *(records[-1] for _ in range(150))])

    assert (len(checker.violations), checker.count) == (100, 150)


def test_subscriber_sees_what_the_checker_follows(played: Play) -> None:
    """What observers rebuild from the weights key is what the robots hold at the end."""
    for merge in MERGES.values():
        records = played(*merge)
        for name in ("r1", "r2", "r3"):
            subscriber = WeightsSubscriber()
            view = np.full(60, opening(records).units.sample)
            for step_record in step_records(records, name):
                for sample, left in entries(step_record.outputs.lowered):
                    view[sample] = left
                if step_record.outputs.weights:
                    assert subscriber.apply(step_record.outputs.weights)

            assert subscriber.weights is not None
            assert view.tolist() == subscriber.weights.tolist()


def test_logs_in_messages_are_read_as_rows() -> None:
    """A suffix is origin, start, span, count and packed pairs."""
    log = uints(1, 7, 2, 2) + pairs((3, 2), (1, 1))
    rows = read_logs(log)

    assert rows is not None
    assert rows.tolist() == [[1, 7, 3, 2], [1, 8, 1, 1]]
