"""Columnar batches: equal to the Structs from which they are decoded, and total on any bytes."""

from collections.abc import Callable
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from kantor_protocol.base.machine import SUPERVISOR, Envelope, Observation, Outputs, Pose
from kantor_protocol.base.varint import Pairs
from kantor_protocol.wire.messages import GossipMessage, RefusedError, decode_gossip, encode
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.radio.channel import DROPPED, DeliveryDecision
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import (
    ColumnarBatch,
    ColumnarDecoder,
    DecodedRecord,
    head_of,
    parts_of_gossip,
    skip,
)
from kantor_worldsim.record.records import (
    Batch,
    Opening,
    Record,
    StepRecord,
    decode_record,
    encode_record,
)
from kantor_worldsim.world.world import StepVerdict
from support.strategies import NEWS, examples

Play = Callable[..., tuple[Record, ...]]

LOSSY = ("radio.drop=0.3", "radio.duplicate=0.3", "radio.jitter_s=0.2", "publish.weights_every=2")
ROSTER = ("r1", "r2", "r3")


def place(name: str, roster: tuple[str, ...]) -> int:
    """Index of a name, as in columnar batches."""
    if name == "":
        return of.ALL_PLACES
    return roster.index(name) if name in roster else of.UNKNOWN_PLACE


def pairs(packed: bytes, samples: int) -> list[list[int]] | None:
    decoded = Pairs().decode(packed, samples)
    return None if decoded is None else np.stack(decoded, axis=1).tolist()


def plain(batch: Batch, roster: tuple[str, ...], samples: int) -> list[Any]:
    """Expected contents of the columns, taken from the Structs."""
    step_records: list[Any] = []
    for step_record in batch.step_records:
        out, verdict = step_record.outputs, step_record.verdict
        values: list[Any] = [
            place(step_record.name, roster),
            step_record.now_ns,
            [[place(source, roster), sequence] for source, sequence in step_record.heard],
            step_record.observation.step,
            step_record.skew_ns,
        ]
        if out is not None and verdict is not None:
            refused = {"step", "energy", "units"} & set(verdict.violations)
            values += [out.step, out.energy_spent, int(out.state), out.refused, len(verdict.found)]
            fast = [i for i, rule in enumerate(verdict.violations, 1) if rule == "speed"]
            values += [len(verdict.violations), bool(refused), max(fast, default=0)]
            values += [len(out.weights)]
            values += [sum(len(envelope.body) for envelope in out.outbox)]
            values += [[verdict.pose.x_m, verdict.pose.y_m]]
            values += [None if out.goal is None else [*out.goal], out.weights]
            values += [pairs(out.spent, samples), pairs(out.lowered, samples)]
            values += [[addressed(e, roster) for e in out.outbox]]
        step_records.append(values)
    decisions = [
        [place(v.source, roster), v.sequence, place(v.target, roster), v.due_ns]
        for v in batch.decisions
    ]
    return [step_records, decisions, [addressed(e, roster) for e in batch.injected]]


def addressed(envelope: Envelope, roster: tuple[str, ...]) -> list[Any]:
    """An envelope, with names as indices."""
    source, sequence, target, body = msgspec.structs.astuple(envelope)
    return [place(source, roster), sequence, place(target, roster), body]


def contents(columns: ColumnarBatch) -> list[Any]:
    """The same contents, taken from the columns."""

    def rows(table: np.ndarray, first: int, count: int) -> list[list[int]] | None:
        if count == of.NOT_DECODED:
            return None
        return [list(row) for row in table[first : first + count].tolist()]

    def bodies(sent: list[list[int]] | None) -> list[Any]:
        return [[*head, columns.payload[at:end]] for *head, at, end in sent or ()]

    step_records: list[Any] = []
    for row in range(int(columns.sizes[of.STEP_RECORDS])):
        numbers = columns.step_records[row].tolist()
        step_record = dict(zip(of.STEP_RECORD.names or (), numbers, strict=True))
        heard = rows(columns.heard, step_record["heard"], step_record["heard_count"])
        values: list[Any] = [step_record["place"], step_record["now_ns"], heard]
        values += [step_record["observed"], step_record["skew_ns"]]
        if step_record["present"]:
            names = ("step", "energy", "state", "refused", "finds", "violations")
            values += [step_record[name] for name in names]
            values += [bool(step_record["unshipped"]), step_record["too_fast"]]
            values += [step_record["weights_bytes"]]
            *pose_m, goal_x_m, goal_y_m = columns.poses_m[row].tolist()
            begin = step_record["weights"]
            end = begin + step_record["weights_bytes"]
            values += [step_record["body_bytes"], pose_m]
            values += [
                [goal_x_m, goal_y_m] if step_record["heads"] else None,
                columns.payload[begin:end],
            ]
            for name in ("spent", "lowered"):
                values += [rows(columns.pairs, step_record[name], step_record[f"{name}_count"])]
            values += [bodies(rows(columns.sent, step_record["sent"], step_record["sent_count"]))]
        step_records.append(values)
    decisions = rows(columns.decisions, 0, int(columns.sizes[of.DECISIONS]))
    injected = rows(columns.injected, 0, int(columns.sizes[of.INJECTED]))
    return [step_records, decisions, bodies(injected)]


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
def test_columns_have_the_contents_of_the_record(played: Play, coordination: str) -> None:
    """Over a whole mission with loss and copies: every number of every batch, also from given bytes."""
    records = played(*LOSSY, f"coordination={coordination}")
    opening, decoder, given = records[0], ColumnarDecoder(), ColumnarDecoder()
    assert isinstance(opening, Opening)
    decoder.decode(opening)
    given.decode(opening)
    for record in records:
        if isinstance(record, Batch):
            values = plain(record, opening.scenario.roster, 60)
            assert contents(ColumnarBatch(*decoder.decode(record).columns)) == values
            payload = encode_record(record)
            assert (
                contents(ColumnarBatch(*given.decode(decode_record(payload), payload).columns))
                == values
            )


ODD = Batch(
    1 << 62,
    (
        StepRecord(
            "r10", -5, Observation(0, Pose(0.0, 0.0)), (("", 1 << 40), ("R1", 3)), None, None, -7
        ),
        StepRecord(
            "r2",
            -(1 << 62),
            Observation(3, Pose(0.0, 0.0), (1, 2, 3)),
            tuple(("r1", sequence) for sequence in range(300)),
            Outputs(
                70_000,
                Pose(1.0, 2.0),
                (3.0, 4.0),
                spent=b"\x80",
                lowered=b"\x02\x05\x01\x07",
                weights=bytes(70_000),
                outbox=(Envelope("r01", 1, SUPERVISOR, bytes(300)), Envelope("r3", 2, "", b"")),
            ),
            StepVerdict(
                Pose(7, -300), ((1, 2.0, 3.0),), ("speed", "units", "s" * 300), bumped=True
            ),
        ),
        StepRecord("r1", 0, Observation(0, Pose(0.0, 0.0)), (), Outputs(1, Pose(0.0, 0.0)), None),
    ),
    (
        DeliveryDecision("r1", 2, "supervisor", DROPPED),
        DeliveryDecision("x" * 40, 1 << 33, "r3", -40_000),
    ),
    out_of_range=3,
    injected=(Envelope("r1", 1 << 62, "", b"\x98"), Envelope("r1\x00", 3, "r2", bytes(70_000))),
)
"""Strangers, numbers of every width, a verdict in whole metres, pairs that do not decode."""


def test_odd_values_are_decoded_too(played: Play) -> None:
    """Every content that a record may have is in the columns."""
    decoder = ColumnarDecoder()
    decoder.decode(played()[0])

    assert contents(ColumnarBatch(*decoder.decode(ODD).columns)) == plain(ODD, ROSTER, 60)


def test_columns_grow_with_the_batch(played: Play) -> None:
    """More pairs, decisions and deliveries in one batch than there was room for."""
    many = tuple(DeliveryDecision("r1", sequence, "r2", sequence) for sequence in range(5000))
    entries = Pairs().encode(np.arange(60).repeat(100), np.arange(6000), 6000)
    outputs = Outputs(1, Pose(0.0, 0.0), lowered=entries)
    look = Observation(0, Pose(0.0, 0.0))
    step_record = StepRecord(
        "r1", 1, look, tuple(("r2", i) for i in range(3000)), outputs, StepVerdict(look.pose)
    )
    batch = Batch(1, (step_record,), many, 0)
    decoder = ColumnarDecoder()
    decoder.decode(played()[0])

    assert contents(ColumnarBatch(*decoder.decode(batch).columns)) == plain(batch, ROSTER, 60)


def test_a_record_is_decoded_once_for_all_observers_in_order(played: Play) -> None:
    """Every observer receives the same object, the first observer first, and its bytes are the record's."""
    calls: list[tuple[str, DecodedRecord]] = []

    class Noting:
        def __init__(self, name: str) -> None:
            self.name = name

        def observe(self, decoded: DecodedRecord, /) -> None:
            calls.append((self.name, decoded))

    records = played()
    pipeline = Pipeline(Noting("first"), Noting("second"))
    for record in records[:3]:
        assert pipeline.observe(record).payload == encode_record(record)

    assert [name for name, _ in calls] == 3 * ["first", "second"]
    assert all(calls[i][1] is calls[i + 1][1] for i in range(0, 6, 2))
    assert [decoded.record for _, decoded in calls[::2]] == list(records[:3])


# Msgpack, compared with the library.

VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, width=32)
    | st.text(max_size=40)
    | st.binary(max_size=300)
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=40)),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=20,
)


@examples(200)
@given(value=VALUES, more=st.binary(max_size=4), single=st.booleans())
def test_any_value_is_skipped(value: Any, more: bytes, *, single: bool) -> None:
    """A value ends at the position that the library gives; cut short it has no end."""
    packed = msgpack.packb(value, use_single_float=single)

    assert skip(packed + more, 0, 1) == len(packed)
    assert skip(packed[:-1], 0, 1) < 0 or len(packed) == 1


@given(value=st.integers(-(2**63), 2**63 - 1))
def test_numbers_of_every_width_are_decoded(value: int) -> None:
    """Every width, both signs."""
    packed = msgpack.packb(value)

    assert head_of(packed, 0) == (of.NUMBER, value, len(packed))


@examples(300)
@given(payload=st.binary(max_size=60), at=st.integers(-2, 70), values=st.integers(0, 5))
def test_no_bytes_lead_outside_the_payload(payload: bytes, at: int, values: int) -> None:
    """A position is within the payload, or negative."""
    assert head_of(payload, at)[2] <= len(payload)
    assert values == 0 or skip(payload, at, values) <= len(payload)


# Gossip messages.


def readable(body: bytes) -> tuple[int, bytes, bytes] | None:
    try:
        news = decode_gossip(body)
    except RefusedError:
        return None
    return news.incarnation, news.version_vector, news.logs


def parts(body: bytes) -> tuple[int, bytes, bytes] | None:
    framed = b"\xc0\xc0" + body + b"\xc0"
    incarnation, version_vector, vector_end, logs, logs_end = parts_of_gossip(
        framed, 2, 2 + len(body)
    )
    return (
        None
        if logs_end < 0
        else (incarnation, framed[version_vector:vector_end], framed[logs:logs_end])
    )


_ATTESTATION = [0, 1, 2, b"h" * 16, [1, 2, 3], 4, b"", b"s" * 64]
_ALL_FIELDS = GossipMessage(1, 0, 0.0, 0.0, b"", b"", b"\x00", b"\x00")


@examples(200)
@example(
    news=_ALL_FIELDS, at=len(encode(_ALL_FIELDS)) - 3, byte=0xA1, cut=0
)  # a text for registers
@given(news=NEWS, at=st.integers(0, 200), byte=st.integers(0, 255), cut=st.integers(0, 30))
def test_a_gossip_message_has_the_parts_that_the_codec_decodes(
    news: GossipMessage, at: int, byte: int, cut: int
) -> None:
    """Sound messages, messages with one byte changed, cut messages: the same parts or none.

    The kernel may refuse a message that the codec still decodes, such as a text in place of a number it skips;
    it never accepts one that the codec refuses.
    """
    body = encode(news)
    changed = bytearray(body)
    changed[at % len(body)] = byte

    assert parts(body) == (news.incarnation, news.version_vector, news.logs)
    assert parts(body[: max(0, len(body) - cut - 1)]) is None
    assert parts(bytes(changed)) in (None, readable(bytes(changed)))


@pytest.mark.parametrize(
    "tree",
    [
        [1, 1, 7, 1, -2, b"h", b"l", b""],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"more", 3, [], [], [1, {"a": 2}]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 15],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 16],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", -1],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"more", "no epoch"],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"more", b"no epoch", [1, {"a": 2}]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", 5, 5],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"], [_ATTESTATION, _ATTESTATION]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"], [[*_ATTESTATION, "more"]], "more"],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"], [_ATTESTATION[:4]]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"], [_ATTESTATION[:3]]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"], [[0, 1, 2, b"h", [1, 2]]]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"], [[0, 1, 2, b"h", [1, b"", 2]]]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"], [[0, 1, 2, "h"]]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"], [7]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [], {}],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p", 7], [_ATTESTATION]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, {}, [_ATTESTATION]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 1, [b"p"]],
        [1, 2, 7, 1.5, 2.5, b"h", b"l", b""],
        [2, 1, 7, 1.5, 2.5, b"h", b"l", b""],
        [1, 1, -7, 1.5, 2.5, b"h", b"l", b""],
        [1, 1, 7, 1.5, float("inf"), b"h", b"l", b""],
        [1, 1, 7, 1.5, float("nan"), b"h", b"l", b""],
        [1, 1, 7, 1.5, 2.5, "h", b"l", b""],
        [1, 1, 7, 1.5, 2.5, b"h", b"l"],
        [1, 1, None, 1.5, 2.5, b"h", b"l", b""],
        {},
    ],
)
@pytest.mark.parametrize("single", [False, True])
def test_odd_gossip_messages_have_the_parts_that_the_codec_decodes(
    tree: Any, *, single: bool
) -> None:
    """Whole metres, short floats, further fields, other versions, missing fields, attestations of any shape."""
    body = msgpack.packb(tree, use_single_float=single)

    assert parts(body) == readable(body)


def test_fields_added_to_a_record_are_skipped(played: Play) -> None:
    """Fields that are added at the end do not change the columns."""
    decoder = ColumnarDecoder()
    decoder.decode(played()[0])
    tree = msgspec.msgpack.decode(encode_record(ODD))
    tree.append({"new": 1})
    for step_record in tree[2]:
        step_record[2].append("new")
        step_record.append({"new": [1, 2]})
        for part in (step_record[4], step_record[5]):
            if part is not None:
                part.append(b"new")
    for decision in tree[3]:
        decision.append(1.0)
    sizes, *tables = (table.copy() for table in ColumnarBatch(*decoder.decode(ODD).columns)[1:])
    values = plain(ODD, ROSTER, 60)
    payload = msgspec.msgpack.encode(tree)
    bits = tables[1].view(np.int64)

    assert of._read_batch(payload, (sizes, *tables), bits, 3, of.UNKNOWN_PLACE, 60) > 0
    assert contents(ColumnarBatch(payload, sizes, *tables)) == values


@examples(300)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=4))
def test_a_garbled_batch_stays_within_its_arrays(changes: list[tuple[int, int]]) -> None:
    """No bytes lead outside: rows after the arrays stay as they were."""
    small = msgspec.structs.replace(ODD, step_records=(ODD.step_records[0], ODD.step_records[2]))
    payload = bytearray(encode_record(small))
    for at, byte in changes:
        payload[at % len(payload)] = byte
    rows = len(payload) // 2 + 1
    kinds = (of.STEP_RECORD, of.REFERENCE, of.ENVELOPE, of.DECISION, of.PAIR, of.ENVELOPE)
    around = [np.full(rows + 8, 77, dtype=np.int64).astype(kind) for kind in kinds]
    step_records, heard, sent, decisions, pairs, injected = (table[:rows] for table in around)
    poses_m = np.zeros((rows, 4))
    sizes, bits = np.zeros(6, dtype=np.int64), poses_m.view(np.int64)
    tables = (sizes, step_records, poses_m, heard, sent, decisions, pairs, injected)
    of._read_batch(bytes(payload), tables, bits, 3, of.UNKNOWN_PLACE, 60)

    assert all(set(row.tolist()) == {77} for table in around for row in table[rows:])
