"""Batches as tables: the same as the Structs they were read from, and total on whatever bytes."""

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
from kantor_worldsim.radio.channel import DROPPED, DeliveryDecision
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import (
    ColumnarBatch,
    ColumnarDecoder,
    head_of,
    parts_of_news,
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
    """The place of a name, as tables have it."""
    if name == "":
        return of.EVERYBODY_PLACE
    return roster.index(name) if name in roster else of.STRANGER


def pairs(packed: bytes, samples: int) -> list[list[int]] | None:
    decoded = Pairs().decode(packed, samples)
    return None if decoded is None else np.stack(decoded, axis=1).tolist()


def plain(batch: Batch, roster: tuple[str, ...], samples: int) -> list[Any]:
    """What the tables hold, taken from the Structs."""
    acts: list[Any] = []
    for act in batch.acts:
        out, ruling = act.outputs, act.ruling
        told: list[Any] = [
            place(act.name, roster),
            act.now_ns,
            [[place(source, roster), sequence] for source, sequence in act.heard],
            act.observation.step,
            act.skew_ns,
        ]
        if out is not None and ruling is not None:
            refused = {"step", "energy", "units"} & set(ruling.violations)
            told += [out.step, out.energy_spent, int(out.state), out.refused, len(ruling.found)]
            fast = [i for i, what in enumerate(ruling.violations, 1) if what == "speed"]
            told += [len(ruling.violations), bool(refused), max(fast, default=0)]
            told += [len(out.weights)]
            told += [sum(len(envelope.body) for envelope in out.outbox)]
            told += [[ruling.pose.x_m, ruling.pose.y_m]]
            told += [None if out.goal is None else [*out.goal], out.weights]
            told += [pairs(out.spent, samples), pairs(out.lowered, samples)]
            told += [[addressed(e, roster) for e in out.outbox]]
        acts.append(told)
    verdicts = [
        [place(v.source, roster), v.sequence, place(v.target, roster), v.due_ns]
        for v in batch.verdicts
    ]
    return [acts, verdicts, [addressed(e, roster) for e in batch.injected]]


def addressed(envelope: Envelope, roster: tuple[str, ...]) -> list[Any]:
    """An envelope, names as places."""
    source, sequence, target, body = msgspec.structs.astuple(envelope)
    return [place(source, roster), sequence, place(target, roster), body]


def tabled(reading: ColumnarBatch) -> list[Any]:
    """The same from the tables."""

    def rows(table: np.ndarray, first: int, count: int) -> list[list[int]] | None:
        return None if count == of.NOT_DECODED else table[first : first + count].tolist()

    def bodies(sent: list[list[int]] | None) -> list[Any]:
        return [[*head, reading.payload[at:end]] for *head, at, end in sent or ()]

    acts: list[Any] = []
    for row in range(int(reading.sizes[of.ACTS])):
        act = reading.acts[row].tolist()
        heard = rows(reading.heard, act[of.HEARD], act[of.HEARD_COUNT])
        told: list[Any] = [act[of.PLACE], act[of.NOW_NS], heard]
        told += [act[of.OBSERVED], act[of.SKEW_NS]]
        if act[of.PRESENT]:
            told += [act[of.STEP], act[of.ENERGY], act[of.STATE], act[of.REFUSED], act[of.FINDS]]
            told += [act[of.VIOLATIONS], bool(act[of.VOID]), act[of.TOO_FAST]]
            told += [act[of.WEIGHTS_BYTES]]
            *pose_m, goal_x_m, goal_y_m = reading.poses_m[row].tolist()
            begin, end = act[of.WEIGHTS], act[of.WEIGHTS] + act[of.WEIGHTS_BYTES]
            told += [act[of.BODY_BYTES], pose_m]
            told += [[goal_x_m, goal_y_m] if act[of.HEADS] else None, reading.payload[begin:end]]
            told += [rows(reading.pairs, act[of.SPENT], act[of.SPENT_COUNT])]
            told += [rows(reading.pairs, act[of.LOWERED], act[of.LOWERED_COUNT])]
            told += [bodies(rows(reading.sent, act[of.SENT], act[of.SENT_COUNT]))]
        acts.append(told)
    verdicts = rows(reading.verdicts, 0, int(reading.sizes[of.VERDICTS]))
    injected = rows(reading.injected, 0, int(reading.sizes[of.INJECTED]))
    return [acts, verdicts, bodies(injected)]


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
def test_tables_hold_what_the_record_holds(played: Play, coordination: str) -> None:
    """Over a whole mission with loss and copies: every number of every batch, also from given bytes."""
    records = played(*LOSSY, f"coordination={coordination}")
    opening, reader, given = records[0], ColumnarDecoder(), ColumnarDecoder()
    assert isinstance(opening, Opening)
    reader.read(opening)
    given.read(opening)
    for record in records:
        if isinstance(record, Batch):
            told = plain(record, opening.scenario.roster, 60)
            assert tabled(ColumnarBatch(*reader.read(record))) == told
            payload = encode_record(record)
            assert tabled(ColumnarBatch(*given.read(decode_record(payload), payload))) == told


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
"""Strangers, numbers of every width, a ruling in whole metres, pairs that do not decode."""


def test_odd_values_are_read_too(played: Play) -> None:
    """Whatever a record may hold, the tables hold it."""
    reader = ColumnarDecoder()
    reader.read(played()[0])

    assert tabled(ColumnarBatch(*reader.read(ODD))) == plain(ODD, ROSTER, 60)


def test_tables_grow_with_what_comes(played: Play) -> None:
    """More pairs, verdicts and deliveries in one batch than there was room for."""
    many = tuple(DeliveryDecision("r1", sequence, "r2", sequence) for sequence in range(5000))
    entries = Pairs().encode(np.arange(60).repeat(100), np.arange(6000), 6000)
    outputs = Outputs(1, Pose(0.0, 0.0), lowered=entries)
    look = Observation(0, Pose(0.0, 0.0))
    act = StepRecord(
        "r1", 1, look, tuple(("r2", i) for i in range(3000)), outputs, StepVerdict(look.pose)
    )
    batch = Batch(1, (act,), many, 0)
    reader = ColumnarDecoder()
    reader.read(played()[0])

    assert tabled(ColumnarBatch(*reader.read(batch))) == plain(batch, ROSTER, 60)


def test_record_is_read_once_for_all(played: Play) -> None:
    """Referees that share a reader share its work."""
    records = played()
    reader = ColumnarDecoder()
    reader.read(records[0])

    assert reader.read(records[1]) is reader.read(records[1])
    assert reader.read(records[1])[0] == encode_record(records[1])


# Msgpack, beside the library.

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
def test_any_value_is_passed_over(value: Any, more: bytes, *, single: bool) -> None:
    """A value ends where the library says; cut short it has no end."""
    packed = msgpack.packb(value, use_single_float=single)

    assert skip(packed + more, 0, 1) == len(packed)
    assert skip(packed[:-1], 0, 1) < 0 or len(packed) == 1


@given(value=st.integers(-(2**63), 2**63 - 1))
def test_numbers_are_read_as_they_are(value: int) -> None:
    """Every width, both signs."""
    packed = msgpack.packb(value)

    assert head_of(packed, 0) == (of.NUMBER, value, len(packed))


@examples(300)
@given(payload=st.binary(max_size=60), at=st.integers(-2, 70), values=st.integers(0, 5))
def test_noise_never_leads_outside(payload: bytes, at: int, values: int) -> None:
    """A position is within the payload, or negative."""
    assert head_of(payload, at)[2] <= len(payload)
    assert values == 0 or skip(payload, at, values) <= len(payload)


# News.


def readable(body: bytes) -> tuple[int, bytes, bytes] | None:
    try:
        news = decode_gossip(body)
    except RefusedError:
        return None
    return news.epoch, news.have, news.logs


def parts(body: bytes) -> tuple[int, bytes, bytes] | None:
    framed = b"\xc0\xc0" + body + b"\xc0"
    epoch, have, have_end, logs, logs_end = parts_of_news(framed, 2, 2 + len(body))
    return None if logs_end < 0 else (epoch, framed[have:have_end], framed[logs:logs_end])


_ALL_FIELDS = GossipMessage(1, 0, 0.0, 0.0, b"", b"", b"\x00", b"\x00")


@examples(200)
@example(
    news=_ALL_FIELDS, at=len(encode(_ALL_FIELDS)) - 3, byte=0xA1, cut=0
)  # a text for registers
@given(news=NEWS, at=st.integers(0, 200), byte=st.integers(0, 255), cut=st.integers(0, 30))
def test_news_is_read_as_the_codec_does(news: GossipMessage, at: int, byte: int, cut: int) -> None:
    """Sound messages, messages with one byte changed, cut messages: the same parts or none.

    The kernel may refuse what the codec still takes, such as a text in place of a number it skips;
    it never takes what the codec refuses.
    """
    body = encode(news)
    changed = bytearray(body)
    changed[at % len(body)] = byte

    assert parts(body) == (news.epoch, news.have, news.logs)
    assert parts(body[: max(0, len(body) - cut - 1)]) is None
    assert parts(bytes(changed)) in (None, readable(bytes(changed)))


@pytest.mark.parametrize(
    "tree",
    [
        [1, 1, 7, 1, -2, b"h", b"l", b""],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"more", 3, [1, {"a": 2}]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 15],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", 16],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"", -1],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"more", "no epoch"],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", b"more", b"no epoch", [1, {"a": 2}]],
        [1, 1, 7, 1.5, 2.5, b"h", b"l", b"", 5, 5],
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
def test_odd_news(tree: Any, *, single: bool) -> None:
    """Whole metres, short floats, further fields, other versions, missing fields."""
    body = msgpack.packb(tree, use_single_float=single)

    assert parts(body) == readable(body)


def test_record_holds_more_fields_some_day(played: Play) -> None:
    """Fields that are added at the end are passed over."""
    reader = ColumnarDecoder()
    reader.read(played()[0])
    tree = msgspec.msgpack.decode(encode_record(ODD))
    tree.append({"new": 1})
    for act in tree[2]:
        act[2].append("new")
        act.append({"new": [1, 2]})
        for part in (act[4], act[5]):
            if part is not None:
                part.append(b"new")
    for verdict in tree[3]:
        verdict.append(1.0)
    sizes, *tables = (table.copy() for table in ColumnarBatch(*reader.read(ODD))[1:])
    told = plain(ODD, ROSTER, 60)
    payload = msgspec.msgpack.encode(tree)
    bits = tables[1].view(np.int64)

    assert of._read_batch(payload, sizes, *tables, bits, 3, of.STRANGER, 60) > 0
    assert tabled(ColumnarBatch(payload, sizes, *tables)) == told


@examples(300)
@given(changes=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=4))
def test_garbled_batch_stays_within_its_tables(changes: list[tuple[int, int]]) -> None:
    """No bytes lead outside: rows behind the tables stay as they were."""
    small = msgspec.structs.replace(ODD, acts=(ODD.acts[0], ODD.acts[2]))
    payload = bytearray(encode_record(small))
    for at, byte in changes:
        payload[at % len(payload)] = byte
    rows = len(payload) // 2 + 1
    around = [np.full((rows + 8, columns), 77, dtype=np.int64) for columns in (25, 2, 5, 4, 2, 5)]
    acts, heard, sent, verdicts, pairs, injected = (table[:rows] for table in around)
    poses_m = np.zeros((rows, 4))
    sizes, bits = np.zeros(6, dtype=np.int64), poses_m.view(np.int64)
    tables = (sizes, acts, poses_m, heard, sent, verdicts, pairs, injected, bits)
    of._read_batch(bytes(payload), *tables, 3, of.STRANGER, 60)

    assert all(bool((table[rows:] == 77).all()) for table in around)
