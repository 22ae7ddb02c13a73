"""Columnar batches: arrays of numbers for observers, decoded in one compiled pass from the record's bytes.

Metrics and checkers follow every step record of a run. Walking its Structs in Python costs more than the robots
do; the encoded record, which the journal needs anyway, holds the same and is decoded in a microsecond.
An observer that needs a text (the message of a violation, a name) has the record itself.

The kernels here are total: with any bytes, they stay inside them and inside the arrays.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.kernels import Row, integers, kernel
from kantor_protocol.base.machine import SUPERVISOR
from kantor_protocol.base.varint import read_int, read_uint
from kantor_protocol.wire.messages import BODY_BYTES_MAX, VERSION, GossipMessage
from kantor_protocol.wire.weights import WeightsMessage
from kantor_worldsim.record.records import Batch, Opening, Record, encode_record

NOT_DECODED = -1
"""In place of a count: the packed pairs are malformed."""

ALL_PLACES = -1
UNKNOWN_PLACE = -2
"""The index of a name that is not in the roster."""

STEP_RECORD = integers(
    "place", "now_ns", "present", "step", "energy", "state", "refused", "finds", "violations",
    "unshipped", "weights_bytes", "body_bytes", "heard", "heard_count", "sent", "sent_count",
    "spent", "spent_count", "lowered", "lowered_count", "heads", "weights", "observed", "skew_ns",
    "too_fast",
)  # fmt: skip
"""A row of ColumnarBatch.step_records. Ranges of other tables are a first row and a count.

present: the step record has outputs and a verdict; all fields from `step` on are valid only then, but for heard,
observed and skew_ns. observed: the step in the observation that the participant received. too_fast: 1 + index of the
violation that is of speed, or 0. unshipped: the world refused the step, its energy or its units, so that nothing was
shipped. heads: the outputs have a goal. weights: position in the payload at which the published weights begin."""

REFERENCE = integers("source", "sequence")
ENVELOPE = integers("source", "sequence", "target", "body", "body_end")
"""An envelope; its body lies between two positions in the payload."""
DECISION = integers("source", "sequence", "target", "due_ns")
PAIR = integers("sample", "units")

# Indices of ColumnarBatch.sizes: rows of step_records, decisions, heard, sent, pairs and injected.
STEP_RECORDS, DECISIONS, ALL_HEARD, ALL_SENT, PAIRS, INJECTED = 0, 1, 2, 3, 4, 5


class ColumnarBatch(NamedTuple):
    """One batch as arrays; names are indices in the roster. Valid until the next batch is decoded."""

    payload: bytes
    """The encoded record."""
    sizes: npt.NDArray[np.int64]
    """(6,): number of valid rows of each array."""
    step_records: npt.NDArray[Any]
    """(rows,) of STEP_RECORD."""
    poses_m: npt.NDArray[np.float64]
    """(rows, 4): x and y of the pose in each verdict and of each goal, world frame."""
    heard: npt.NDArray[Any]
    """(rows,) of REFERENCE."""
    sent: npt.NDArray[Any]
    """(rows,) of ENVELOPE."""
    decisions: npt.NDArray[Any]
    """(rows,) of DECISION."""
    pairs: npt.NDArray[Any]
    """(rows,) of PAIR."""
    injected: npt.NDArray[Any]
    """(rows,) of ENVELOPE: those that a fault injected."""


# Msgpack. Kinds of a value by its head; SIMPLE: nil and truth values.
SIMPLE, NUMBER, FLOAT, SINGLE, TEXT, BYTES, EXTENSION, ARRAY, MAP = 0, 1, 2, 3, 4, 5, 6, 7, 8
_MALFORMED = -1
_ANY = 1 << 32


@kernel
def _big_endian(payload: bytes, at: int, size: int) -> int:
    value = 0
    for i in range(at, at + size):
        value = value << 8 | int(payload[i])
    return value


@kernel
def head_of(payload: bytes, at: int) -> tuple[int, int, int]:
    """(kind, value, position after it) of the head at `at`; the position is negative if malformed.

    The value is a number, the bits of a float, the size of a content in bytes or the items of an array or map.
    A content begins at the position after the head and ends within the payload.
    """
    size = len(payload)
    if at < 0 or at >= size:
        return SIMPLE, 0, _MALFORMED
    first = int(payload[at])
    at += 1
    if first < 0x80:
        return NUMBER, first, at
    if first >= 0xE0:
        return NUMBER, first - 256, at
    kind = _KINDS[first - 0x80]
    if first < 0xC0:
        value = first & (31 if first >= 0xA0 else 15)
    elif 0xD4 <= first <= 0xD8:
        value = 1 + (1 << (first - 0xD4))
    else:
        width = _WIDTHS[first - 0xC0]
        if at + width > size:
            return SIMPLE, 0, _MALFORMED
        value = _big_endian(payload, at, width)
        at += width
        if 0xD0 <= first <= 0xD2:  # a signed number of less than 64 bits
            value -= (value >> (8 * width - 1)) << (8 * width)
        elif kind == EXTENSION:
            value += 1  # its type
    if kind in (TEXT, BYTES, EXTENSION) and at + value > size:
        return SIMPLE, 0, _MALFORMED
    return kind, value, at


_WIDTHS = np.array([0, 0, 0, 0, 1, 2, 4, 1, 2, 4, 4, 8, 1, 2, 4, 8, 1, 2, 4, 8, 0, 0, 0, 0, 0,
                    1, 2, 4, 2, 4, 2, 4])  # fmt: skip
"""Bytes of the number after a first byte of 0xc0 … 0xdf."""
_KINDS = np.repeat(
    [
        MAP,
        ARRAY,
        TEXT,
        SIMPLE,
        BYTES,
        EXTENSION,
        SINGLE,
        FLOAT,
        NUMBER,
        EXTENSION,
        TEXT,
        ARRAY,
        MAP,
    ],
    [16, 16, 32, 4, 3, 3, 1, 1, 8, 5, 3, 2, 2],
)
"""Kind by a first byte of 0x80 … 0xdf."""


@kernel
def skip(payload: bytes, at: int, values: int) -> int:
    """The position after a number of values, or a negative one if malformed."""
    while values > 0 and at >= 0:
        kind, size, at = head_of(payload, at)
        values -= 1
        if kind in (TEXT, BYTES, EXTENSION):
            at += size
        elif kind == ARRAY:
            values += size
        elif kind == MAP:
            values += 2 * size
    return at


@kernel
def _number(payload: bytes, at: int) -> tuple[int, int]:
    kind, value, at = head_of(payload, at)
    return value, at if kind == NUMBER else _MALFORMED


@kernel
def _array(payload: bytes, at: int, room: int) -> tuple[int, int]:
    """(items, position of the first) of an array of at most `room` items; otherwise (0, malformed)."""
    kind, items, at = head_of(payload, at)
    if kind != ARRAY or at < 0 or items > room:
        return 0, _MALFORMED
    return items, at


_ATTESTED = np.array([NUMBER, NUMBER, NUMBER, BYTES, ARRAY, NUMBER, BYTES, BYTES])
"""Kinds of the fields of an Attestation; of the array, `claim`, all items are numbers."""
_ATTESTED_MIN, _CLAIMED = 4, 3
"""Fields without a default, and items of `claim`."""


class BatchColumns(NamedTuple):
    """The tables into which a batch is decoded, for the kernels."""

    batch: ColumnarBatch
    pose_bits: npt.NDArray[np.int64]
    """The memory of poses_m as integers."""
    robots: int
    supervisor: int
    """Its index in the roster, or UNKNOWN_PLACE if there is none."""


@kernel
def _read_metres(columns: BatchColumns, row: int, axis: int, at: int) -> int:
    kind, value, at = head_of(columns.batch.payload, at)
    if kind == NUMBER:
        columns.batch.poses_m[row, axis] = float(value)
    else:
        columns.pose_bits[row, axis] = value
    return at if kind in (NUMBER, FLOAT) else _MALFORMED


_GOSSIP_TAG = GossipMessage.__struct_config__.tag
_WEIGHTS_TAG = WeightsMessage.__struct_config__.tag
_SUPERVISOR_TEXT = np.frombuffer(SUPERVISOR.encode(), dtype=np.uint8)
_REFUSALS = tuple(np.frombuffer(text, dtype=np.uint8) for text in (b"step", b"energy", b"units"))
_SPEED = np.frombuffer(b"speed", dtype=np.uint8)


@kernel
def _equals(payload: bytes, at: int, size: int, text: np.ndarray) -> bool:
    same = size == text.shape[0]
    for i in range(text.shape[0] if same else 0):
        same = same and payload[at + i] == text[i]
    return same


@kernel
def _place(columns: BatchColumns, at: int) -> tuple[int, int]:
    """Index in the roster of the name at `at`, see `Scenario.roster`, and the position after it."""
    payload = columns.batch.payload
    kind, size, at = head_of(payload, at)
    if kind != TEXT or at < 0:
        return UNKNOWN_PLACE, _MALFORMED
    after = at + size
    if size == 0:
        return ALL_PLACES, after
    if _equals(payload, at, size, _SUPERVISOR_TEXT):
        return columns.supervisor, after
    if payload[at] != 114 or size > 5:  # r1, r2, …
        return UNKNOWN_PLACE, after
    number = 0
    for i in range(at + 1, after):
        digit = int(payload[i]) - 48
        if not 0 <= digit <= 9 or (number == 0 and digit == 0):
            return UNKNOWN_PLACE, after
        number = 10 * number + digit
    return (number - 1 if 1 <= number <= columns.robots else UNKNOWN_PLACE), after


@kernel
def _read_pairs(columns: BatchColumns, at: int, bound: int) -> tuple[int, int]:
    """Read a field of packed pairs: (count or NOT_DECODED, position after it)."""
    kind, size, at = head_of(columns.batch.payload, at)
    if kind != BYTES:
        return NOT_DECODED, _MALFORMED
    end = at + size
    row, sample = columns.batch.sizes[PAIRS], 0
    while at < end:
        step, at = read_int(columns.batch.payload, at)
        units, at = read_uint(columns.batch.payload, at)
        sample += step
        if at < 0 or at > end or sample < 0 or sample >= bound:
            return NOT_DECODED, end
        if row >= columns.batch.pairs.shape[0]:
            return NOT_DECODED, _MALFORMED
        columns.batch.pairs[row].sample, columns.batch.pairs[row].units = sample, units
        row += 1
    count = row - columns.batch.sizes[PAIRS]
    columns.batch.sizes[PAIRS] = row
    return count, end


@kernel
def _read_heard(columns: BatchColumns, step_record: Row, at: int) -> int:
    step_record.heard = columns.batch.sizes[ALL_HEARD]
    step_record.heard_count, at = _array(
        columns.batch.payload, at, columns.batch.heard.shape[0] - step_record.heard
    )
    for row in range(step_record.heard, step_record.heard + step_record.heard_count):
        _, at = _array(columns.batch.payload, at, _ANY)
        columns.batch.heard[row].source, at = _place(columns, at)
        columns.batch.heard[row].sequence, at = _number(columns.batch.payload, at)
    columns.batch.sizes[ALL_HEARD] += step_record.heard_count
    return at


@kernel
def _read_envelope(columns: BatchColumns, row: Row, at: int) -> int:
    _, at = _array(columns.batch.payload, at, _ANY)
    row.source, at = _place(columns, at)
    row.sequence, at = _number(columns.batch.payload, at)
    row.target, at = _place(columns, at)
    kind, size, at = head_of(columns.batch.payload, at)
    if kind != BYTES or at < 0:
        return _MALFORMED
    row.body, row.body_end = at, at + size
    return at + size


@kernel
def _read_outbox(columns: BatchColumns, step_record: Row, at: int) -> int:
    step_record.sent = columns.batch.sizes[ALL_SENT]
    step_record.body_bytes = 0
    step_record.sent_count, at = _array(
        columns.batch.payload, at, columns.batch.sent.shape[0] - step_record.sent
    )
    for row in range(step_record.sent, step_record.sent + step_record.sent_count):
        at = _read_envelope(columns, columns.batch.sent[row], at)
        step_record.body_bytes += columns.batch.sent[row].body_end - columns.batch.sent[row].body
    columns.batch.sizes[ALL_SENT] += step_record.sent_count
    return at


@kernel
def _read_goal(columns: BatchColumns, step_record: Row, row: int, at: int) -> int:
    kind, numbers, after = head_of(columns.batch.payload, at)
    step_record.heads = kind == ARRAY
    if kind != ARRAY:
        return after
    if numbers != 2:
        return _MALFORMED
    at = _read_metres(columns, row, 2, after)
    return _read_metres(columns, row, 3, at)


@kernel
def _read_outputs(columns: BatchColumns, step_record: Row, row: int, at: int, samples: int) -> int:
    kind, fields, at = head_of(columns.batch.payload, at)
    step_record.present = kind == ARRAY
    step_record.sent_count = 0
    if kind != ARRAY:
        return at
    step_record.step, at = _number(columns.batch.payload, at)
    at = skip(columns.batch.payload, at, 1)  # pose
    at = _read_goal(columns, step_record, row, at)
    step_record.spent = columns.batch.sizes[PAIRS]
    step_record.spent_count, at = _read_pairs(columns, at, samples)
    step_record.lowered = columns.batch.sizes[PAIRS]
    step_record.lowered_count, at = _read_pairs(columns, at, samples)
    _, step_record.weights_bytes, step_record.weights = head_of(columns.batch.payload, at)
    at = _read_outbox(columns, step_record, step_record.weights + step_record.weights_bytes)
    step_record.energy, at = _number(columns.batch.payload, at)
    step_record.state, at = _number(columns.batch.payload, at)
    step_record.refused, at = _number(columns.batch.payload, at)
    return skip(columns.batch.payload, at, fields - 10)


@kernel
def _read_verdict(columns: BatchColumns, step_record: Row, row: int, at: int) -> int:
    kind, fields, at = head_of(columns.batch.payload, at)
    step_record.present &= kind == ARRAY
    if kind != ARRAY:
        return at
    numbers, at = _array(columns.batch.payload, at, _ANY)
    at = _read_metres(columns, row, 0, at)
    at = _read_metres(columns, row, 1, at)
    at = skip(columns.batch.payload, at, numbers - 2)
    step_record.finds, at = _array(columns.batch.payload, at, _ANY)
    at = skip(columns.batch.payload, at, step_record.finds)
    step_record.violations, at = _array(columns.batch.payload, at, _ANY)
    step_record.unshipped = step_record.too_fast = 0
    for item in range(step_record.violations):
        kind, size, at = head_of(columns.batch.payload, at)
        if kind != TEXT:
            return _MALFORMED
        for text in _REFUSALS:
            step_record.unshipped |= _equals(columns.batch.payload, at, size, text)
        if _equals(columns.batch.payload, at, size, _SPEED):
            step_record.too_fast = item + 1
        at += size
    return skip(columns.batch.payload, at, fields - 3)


@kernel
def _read_batch(
    payload: bytes,
    tables: tuple[Any, ...],
    pose_bits: np.ndarray,
    robots: int,
    supervisor: int,
    samples: int,
) -> int:
    """Fill the tables of a ColumnarBatch; returns the position after the fields that were decoded.

    Negative if the payload is no batch, or if a table has too few rows for it.
    """
    batch = ColumnarBatch(payload, *tables)
    columns = BatchColumns(batch, pose_bits, robots, supervisor)
    sizes, step_records, decisions = batch.sizes, batch.step_records, batch.decisions
    sizes[:] = 0
    parts, at = _array(payload, 0, _ANY)
    at = skip(payload, at, 2)  # tag, now_ns
    sizes[STEP_RECORDS], at = _array(payload, at, step_records.shape[0])
    for i in range(sizes[STEP_RECORDS]):
        step_record = step_records[i]
        fields, at = _array(payload, at, _ANY)
        step_record.place, at = _place(columns, at)
        step_record.now_ns, at = _number(payload, at)
        items, at = _array(payload, at, _ANY)  # the observation
        step_record.observed, at = _number(payload, at)
        at = skip(payload, at, items - 1)
        at = _read_heard(columns, step_record, at)
        at = _read_outputs(columns, step_record, i, at, samples)
        at = _read_verdict(columns, step_record, i, at)
        step_record.skew_ns = 0
        if fields > 6:
            step_record.skew_ns, at = _number(payload, at)
        at = skip(payload, at, fields - 7)
        if at < 0:
            return _MALFORMED
    sizes[DECISIONS], at = _array(payload, at, decisions.shape[0])
    for i in range(sizes[DECISIONS]):
        fields, at = _array(payload, at, _ANY)
        decisions[i].source, at = _place(columns, at)
        decisions[i].sequence, at = _number(payload, at)
        decisions[i].target, at = _place(columns, at)
        decisions[i].due_ns, at = _number(payload, at)
        at = skip(payload, at, fields - 4)
    if parts < 8:
        return at
    at = skip(payload, at, 3)  # out_of_range, absent, fault_stats
    sizes[INJECTED], at = _array(payload, at, columns.batch.injected.shape[0])
    for i in range(sizes[INJECTED]):
        at = _read_envelope(columns, columns.batch.injected[i], at)
    return at


@kernel
def _is_finite(kind: int, value: int) -> bool:
    if kind == FLOAT:
        return value >> 52 & 0x7FF != 0x7FF
    return kind == NUMBER or (kind == SINGLE and value >> 23 & 0xFF != 0xFF)


@kernel
def _skip_proofs(payload: bytes, at: int) -> int:
    """The position after the proofs at `at`, or a negative one if malformed."""
    count, at = _array(payload, at, _ANY)
    while count > 0 and at >= 0:
        count -= 1
        kind, size, at = head_of(payload, at)
        if kind != BYTES or at < 0:
            return _MALFORMED
        at += size
    return at


@kernel
def _skip_attestations(payload: bytes, at: int) -> int:
    """The position after the attestations at `at`, or a negative one if malformed."""
    count, at = _array(payload, at, _ANY)
    while count > 0 and at >= 0:
        count -= 1
        fields, at = _array(payload, at, _ANY)
        if fields < _ATTESTED_MIN:
            return _MALFORMED
        for field in range(min(fields, _ATTESTED.shape[0])):
            expected = _ATTESTED[field]
            kind, size, at = head_of(payload, at)
            if kind != expected or (kind == ARRAY and size != _CLAIMED):
                return _MALFORMED
            if kind == BYTES and at >= 0:
                at += size
            elif kind == ARRAY:
                for _ in range(_CLAIMED):
                    _, at = _number(payload, at)
        at = skip(payload, at, fields - _ATTESTED.shape[0])
    return at


@kernel
def parts_of_gossip(payload: bytes, at: int, end: int) -> tuple[int, int, int, int, int]:
    """Incarnation of the GossipMessage in payload[at:end]; where its `version_vector` and `logs` begin and end.

    The last is negative for a body that `decode_gossip` refuses.
    """
    refused = (0, 0, 0, 0, _MALFORMED)
    if end - at > BODY_BYTES_MAX:
        return refused
    fields, at = _array(payload, at, _ANY)
    tag, at = _number(payload, at)
    version, at = _number(payload, at)
    step, at = _number(payload, at)
    kind_x, x, at = head_of(payload, at)
    kind_y, y, at = head_of(payload, at)
    if at < 0 or fields < 8 or tag != _GOSSIP_TAG or version != VERSION or step < 0:
        return refused
    if not (_is_finite(kind_x, x) and _is_finite(kind_y, y)):
        return refused
    vector_kind, size, version_vector = head_of(payload, at)
    vector_end = version_vector + size
    logs_kind, size, logs = head_of(payload, vector_end if version_vector > 0 else version_vector)
    logs_end = logs + size
    claims_kind, size, claims = head_of(payload, logs_end if logs > 0 else logs)
    if claims < 0 or not vector_kind == logs_kind == claims_kind == BYTES:
        return refused
    at = claims + size
    if fields > 8:
        kind, size, at = head_of(payload, at)
        if kind != BYTES or at < 0:  # the registers
            return refused
        at += size
    incarnation = 0
    if fields > 9:
        incarnation, at = _number(payload, at)
    if fields > 10:
        at = _skip_proofs(payload, at)
    if fields > 11:
        at = _skip_attestations(payload, at)
    if not 0 <= incarnation <= INCARNATIONS_MAX or skip(payload, at, fields - 12) != end:
        return refused
    return incarnation, version_vector, vector_end, logs, logs_end


@kernel
def parts_of_weights(payload: bytes, at: int, end: int) -> tuple[int, int, int, int, int]:
    """Sequence, base, size of the WeightsMessage in payload[at:end]; where its content begins and ends.

    The last is negative for a message that `WeightsSubscriber` does not decode.
    """
    fields, at = _array(payload, at, _ANY)
    tag, at = _number(payload, at)
    version, at = _number(payload, at)
    sequence, at = _number(payload, at)
    base, at = _number(payload, at)
    size, at = _number(payload, at)
    kind, length, at = head_of(payload, at)
    sound = fields >= 6 and tag == _WEIGHTS_TAG and version == VERSION and kind == BYTES
    if not sound or at < 0 or skip(payload, at + length, fields - 6) != end:
        return 0, 0, 0, 0, _MALFORMED
    return sequence, base, size, at, at + length


class DecodedRecord(NamedTuple):
    """A record with its bytes and, for a batch, its columns: decoded once for all observers."""

    record: Record
    payload: bytes
    """The record encoded."""
    columns: tuple[Any, ...]
    """The fields of a `ColumnarBatch`, as arguments of a kernel. They are overwritten by the next batch."""


class ColumnarDecoder:
    """Decodes the records of one run in order."""

    def __init__(self) -> None:
        self._bounds = (0, UNKNOWN_PLACE, 0)
        """Number of robots, index of the supervisor, number of samples."""
        self._make_room(1 << 10, 1)

    def decode(self, record: Record, payload: bytes = b"") -> DecodedRecord:
        """The record's bytes and, for a batch, its columns.

        The first record must be an opening. payload: the record encoded, if the caller has it.
        """
        payload = payload or encode_record(record)
        if isinstance(record, Batch):
            if len(record.step_records) > self._steps:
                self._make_room(self._rows, len(record.step_records))
            while _read_batch(payload, self._tables, self._pose_bits, *self._bounds) < 0:
                assert self._rows <= len(payload), "what msgspec has encoded can be read"
                self._make_room(2 * self._rows, self._steps)
        elif isinstance(record, Opening):
            scenario = record.scenario
            supervisor = scenario.robots.count if scenario.centralized else UNKNOWN_PLACE
            self._bounds = (scenario.robots.count, supervisor, record.samples_m.shape[0])
        return DecodedRecord(record, payload, (payload, *self._tables))

    def _make_room(self, rows: int, steps: int) -> None:
        """Allocate tables of so many rows, those of step records apart; none needs more than its payload has bytes."""
        self._rows, self._steps = rows, steps
        poses_m = np.zeros((steps, 4))
        self._pose_bits = poses_m.view(np.int64)
        self._tables = (
            np.zeros(6, dtype=np.int64),
            np.zeros(steps, dtype=STEP_RECORD),
            poses_m,
            *(np.zeros(rows, dtype=row) for row in (REFERENCE, ENVELOPE, DECISION, PAIR, ENVELOPE)),
        )
