"""Decoders of records: records, the parts that checkers read of them, and journals."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import cast

import msgspec

from fuzz import corpora
from fuzz.decoding import Decode, refuses
from kantor_fleet.report.summary import read_result
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
from kantor_worldsim.record.mcap_file import messages, write_index
from kantor_worldsim.record.records import decode_record, encode_record
from kantor_worldsim.record.run_folder import (
    JOURNAL,
    MANIFEST,
    RESULT,
    Past,
    ResumeError,
)


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
    tables._make_room(64, 64)
    sizes = tables._tables[0]

    def read(content: bytes) -> bool:
        at = columnar._read_batch(content, tables._tables, tables._pose_bits, 3, 3, 12)
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


def indexed_journal(folder: Path) -> Decode:
    """A journal with its index: what is read of it is in it whole, and written again it is the same."""
    path, again = folder / "run.mcap", folder / "again.mcap"

    def decode(content: bytes) -> bool:
        path.write_bytes(content)
        found = list(messages(path))
        assert all(message.data in content for message in found)
        again.write_bytes(content)
        write_index(again)
        assert list(messages(again)) == found, "messages that change when they are indexed"
        return len(found) > 0

    return decode


def run_folder(name: str) -> Callable[[Path], Decode]:
    """A file of a run folder beside a good journal: its run goes on, or there is one line why not."""

    def start(folder: Path) -> Decode:
        path = folder / name
        if name == MANIFEST:
            (folder / JOURNAL).write_bytes(corpora.short_journal())
        else:
            (folder / MANIFEST).write_bytes(corpora.MANIFEST_OF_A_RUN)

        def read(content: bytes) -> None:
            path.write_bytes(content)
            past = Past.of(folder)
            assert past.opening.setup is not None

        return refuses(ResumeError, read)

    return start


def result_file(folder: Path) -> Decode:
    """result.json of a run: a result that stays as it is, or none."""
    path = folder / RESULT

    def decode(content: bytes) -> bool:
        path.write_bytes(content)
        result = read_result(folder)
        return result is not None

    return decode


def journal(content: bytes) -> bool:
    """A journal is read as far as it is sound."""
    found = list(read_journal(cast("Path", _InMemory(content))))
    return len(found) > 0
