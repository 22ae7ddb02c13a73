"""Decoders of records: records, the parts that checkers read of them, and journals."""

from io import BytesIO
from pathlib import Path
from typing import cast

import msgspec

from fuzz.decoding import Decode
from kantor_protocol.wire.messages import RefusedError, decode_gossip
from kantor_worldsim.record import columnar
from kantor_worldsim.record.columnar import (
    ALL_HEARD,
    ALL_SENT,
    DECISIONS,
    INJECTED,
    PAIRS,
    STEP_RECORDS,
)
from kantor_worldsim.record.journal import read as read_journal
from kantor_worldsim.record.records import decode_record, encode_record


def record(content: bytes) -> bool:
    """A record that is decoded and encoded again stays as it is."""
    try:
        record = decode_record(content)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False
    again = encode_record(record)
    assert encode_record(decode_record(again)) == again, "a record that changes on the way"
    return True


def batch_tables(_folder: Path) -> Decode:
    """The kernel that fills a decoder's tables, on any bytes and with too few rows."""
    tables = columnar.ColumnarDecoder()
    tables._make_room(64)
    sizes = tables._tables[0]

    def read(content: bytes) -> bool:
        at = columnar._read_batch(content, *tables._tables, tables._pose_bits, 3, 3, 12)
        assert at <= len(content), "read beyond the end"
        if at >= 0:
            counts = sizes[
                [STEP_RECORDS, STEP_RECORDS, ALL_HEARD, ALL_SENT, DECISIONS, PAIRS, INJECTED]
            ].tolist()
            for table, rows in zip(tables._tables[1:], counts, strict=True):
                assert 0 <= rows <= table.shape[0]
        return at >= 0

    return read


def parts_of_gossip(content: bytes) -> bool:
    """The kernel that finds the parts of a gossip message, against the decoder of messages."""
    incarnation, version_vector, vector_end, logs, end = columnar.parts_of_gossip(
        content, 0, len(content)
    )
    assert end <= len(content)
    try:
        message = decode_gossip(content)
    except RefusedError:
        assert end < 0, "the decoder of records takes for gossip what robots refuse"
        return False
    if end >= 0:
        assert incarnation == message.incarnation
        assert (content[version_vector:vector_end], content[logs:end]) == (
            message.version_vector,
            message.logs,
        )
    return end >= 0


def parts_of_weights(content: bytes) -> bool:
    """The kernel that finds the content of a message of weights."""
    *_, low, high = columnar.parts_of_weights(content, 0, len(content))
    assert high <= len(content)
    assert high < 0 or low <= high
    return high >= 0


class _InMemory:
    """A path whose file is in memory."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def open(self, _mode: str) -> BytesIO:
        """Open the bytes for reading."""
        return BytesIO(self._content)


def journal(content: bytes) -> bool:
    """A journal is read as far as it is sound."""
    found = list(read_journal(cast("Path", _InMemory(content))))
    return len(found) > 0
