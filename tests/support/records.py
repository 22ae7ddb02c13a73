"""The parts of a record, and what is packed in them as plain values."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.base.varint import Pairs, put_uint
from kantor_protocol.replication.registers import read_register
from kantor_protocol.wire.messages import GossipMessage, decode_gossip
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, Record, StepRecord

Records = Sequence[Record]
Play = Callable[..., tuple[Record, ...]]
"""Plays a mission with overrides, see `tests/worldsim/conftest.py`."""


def opening(records: Records) -> Opening:
    assert isinstance(records[0], Opening)
    return records[0]


def batches(records: Records) -> list[Batch]:
    return [record for record in records if isinstance(record, Batch)]


def step_records(records: Records, name: ParticipantId) -> list[StepRecord]:
    """The steps of a participant, in order."""
    return [
        step_record
        for batch in batches(records)
        for step_record in batch.step_records
        if step_record.name == name
    ]


def process_events(records: Records, kind: str = "") -> list[ProcessEvent]:
    """The process events of a kind; by default all."""
    events = [record for record in records if isinstance(record, ProcessEvent)]
    return [event for event in events if kind in {"", event.kind}]


def consumed(records: Records, until_ns: int) -> npt.NDArray[np.int64]:
    """Units that all participants together have shipped to each sample by then."""
    total = np.zeros(60, dtype=np.int64)
    for batch in batches(records):
        for step_record in batch.step_records if batch.now_ns <= until_ns else ():
            for sample, units in entries(step_record.outputs.spent):
                total[sample] += units
    return total


# Messages and packed numbers.


def gossip_of(step_record: StepRecord) -> GossipMessage:
    """The message that a participant sent in a step."""
    return decode_gossip(step_record.outputs.outbox[0].body)


def own_register(step_record: StepRecord, origins: int = 3, incarnation_id: int = 0) -> int:
    """The number of writes to the register of an incarnation that is sent along; 0 if there is none."""
    found = read_register(gossip_of(step_record).registers, origins, 9, incarnation_id)
    assert found is not None
    return found[0]


def pairs(*entries: tuple[int, int]) -> bytes:
    """Packed entries of samples and units."""
    index = np.array([i for i, _ in entries], dtype=np.int64)
    value = np.array([v for _, v in entries], dtype=np.int64)
    return Pairs().encode(index, value, len(entries))


def entries(packed: bytes) -> list[tuple[int, int]]:
    """The samples and units that `pairs` has packed."""
    decoded = Pairs().decode(packed, 60)
    assert decoded is not None
    return list(zip(decoded[0].tolist(), decoded[1].tolist(), strict=True))


def uints(*values: int) -> bytes:
    """Numbers as LEB128."""
    buffer = np.zeros(20 * len(values), dtype=np.uint8)
    at = 0
    for value in values:
        at = put_uint(buffer, at, value)
    return buffer[:at].tobytes()
