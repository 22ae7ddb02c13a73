"""The journal: the records of a run on disk (MCAP, msgpack) and their digest.

Every message goes to the operating system at once, so a killed recorder loses no record that it accepted;
MCAP's own chunks would hold seconds back. A file cut anywhere can be read up to the cut. The file of a run that has
ended is written once more, with an index for readers that seek.
"""

import contextlib
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import msgspec
from mcap.writer import CompressionType, IndexType, Writer

from kantor_protocol.wire.attestations import Identities
from kantor_worldsim.record.columnar import DecodedRecord
from kantor_worldsim.record.mcap_file import PROFILE, messages, write_index
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    Opening,
    Record,
    decode_record,
    encode_record,
    without_signatures,
)

RECORD_TOPIC = "/kantor/record"
METRICS_TOPIC = "/kantor/metrics"
_RESERVE_BYTES = 256 * 1024


class Digest:
    """The digest of a record: BLAKE2b over the encoded records in order, without identities and signatures."""

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=32)
        self._signed = False
        self.records = 0
        """Number of records in it."""

    def follow(self, record: Record, payload: bytes = b"") -> None:
        """Add one record. payload: the record encoded, if the caller has it."""
        if isinstance(record, Opening):
            self._signed = record.scenario.signed
        if isinstance(record, Identities):
            return
        bare = without_signatures(record) if self._signed else record
        self.add(payload if payload and bare is record else encode_record(bare))

    def add(self, payload: bytes) -> None:
        """Add one encoded record as it is."""
        self._hash.update(len(payload).to_bytes(8, "little") + payload)
        self.records += 1

    @property
    def hex(self) -> str:
        """Digest of the records that were added so far, hexadecimal."""
        return self._hash.hexdigest()


class Journal:
    """Digests every record and, given a file, writes it.

    A disk that fills up does not stop the mission: the journal notes where it was cut and writes no
    more. Room for the ending was set aside at the start.
    """

    def __init__(self, path: Path | None = None, *, anew: bool = False) -> None:
        """path: the file to create; None digests only. anew: write next to the existing file, see `replace`."""
        self.digest = Digest()
        self.cut: str | None = None
        """Why the file ends early, if it does."""
        self._file: IO[bytes] | None = None
        self._path = path
        self._draft = path.with_name(f".{path.name}.draft") if path is not None and anew else None
        self._sequence = 0
        self._time_ns = 0
        if path is not None:
            self._open(self._draft or path)

    def _open(self, path: Path) -> None:
        self._reserve = path.with_name(".reserve")
        self._file = path.open("wb")
        try:
            self._reserve.write_bytes(bytes(_RESERVE_BYTES))
            self._writer = Writer(
                self._file,
                compression=CompressionType.NONE,
                index_types=IndexType.NONE,
                use_chunking=False,
                # Without a summary readers know that there is no index, and read from the start.
                use_statistics=False,
                use_summary_offsets=False,
                repeat_channels=False,
                repeat_schemas=False,
            )
            self._writer.start(profile=PROFILE, library=PROFILE)
            self._channels = {
                RECORD_TOPIC: self._writer.register_channel(RECORD_TOPIC, "msgpack", 0),
                METRICS_TOPIC: self._writer.register_channel(METRICS_TOPIC, "json", 0),
            }
            self._file.flush()
        except OSError as error:
            self._give_up(error)

    def observe(self, decoded: DecodedRecord, /) -> None:
        """Write one record."""
        self.append(decoded.record, decoded.payload)

    def append(self, record: Record, payload: bytes = b"") -> None:
        """Write one record. payload: the record encoded, if the caller has it."""
        payload = payload or encode_record(record)
        self.digest.follow(record, payload)
        if isinstance(record, (Batch, Ending)):
            self._time_ns = record.now_ns
        if self._file is not None:
            self._write(RECORD_TOPIC, payload)

    def append_row(self, row: Any) -> None:
        """Write one row of metrics, for viewers; it is not part of the digest."""
        if self._file is not None:
            self._write(
                METRICS_TOPIC, msgspec.json.encode(row._asdict())
            )  # what is not finite is null

    def replace(self) -> None:
        """Replace the old file, once all its records have been written again."""
        draft, self._draft = self._draft, None
        if draft is not None and self._path is not None and self.cut is None:
            draft.replace(self._path)

    def close(self) -> None:
        """Finish the file, index it, and delete the reserve, so that the result has room on the disk."""
        if self._file is not None:
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.flush()
            except OSError as error:
                self._give_up(error)
        self._drop_file()
        if self._path is not None and self._draft is None and self.cut is None:
            with contextlib.suppress(OSError):  # no room for a second copy: the file stays without
                write_index(self._path)
        if self._path is not None:
            self._reserve.unlink(missing_ok=True)

    def _write(self, topic: str, payload: bytes) -> None:
        if self._file is None or self.cut is not None:
            return
        self._sequence += 1
        try:
            self._writer.add_message(
                self._channels[topic], self._time_ns, payload, self._time_ns, self._sequence
            )
            self._file.flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        """Stop writing."""
        self.cut = f"cut at t={self._time_ns * 1e-9:.3f} s: {error.strerror or error}"
        self._drop_file()

    def _drop_file(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(
                OSError
            ):  # the buffered bytes did not fit: the file ends before them
                file.close()


def read(path: Path) -> Iterator[tuple[bytes, Record]]:
    """The records of a journal with their bytes, up to where it ends or is cut."""
    for message in messages(path):
        if message.topic.name == RECORD_TOPIC:
            try:
                yield message.data, decode_record(message.data)
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                return


def file_digest(path: Path) -> str:
    """BLAKE2b of the bytes of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=32)).hexdigest()
