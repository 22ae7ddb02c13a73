"""The journal: the records of a run on disk (MCAP, msgpack) and their digest.

Every message goes to the operating system at once, so a killed recorder loses no record that it accepted;
MCAP's own chunks would hold seconds back. A file cut anywhere can be read up to the cut.
"""

import contextlib
import dataclasses
import hashlib
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import lz4.frame
import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

from kantor_worldsim.record.columnar import DecodedRecord
from kantor_worldsim.record.records import Batch, Ending, Record, decode_record, encode_record

RECORD_TOPIC = "/kantor/record"
METRICS_TOPIC = "/kantor/metrics"
_RESERVE_BYTES = 256 * 1024
_RECORD_BYTES_MAX = 1 << 30
_CHUNK_BYTES_MAX = 1 << 27
"""Of an inflated chunk. The journal has none; other tools may have packed its messages into some, of a few MiB."""


class Digest:
    """The digest of a record: BLAKE2b over the encoded records in order."""

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=32)
        self.records = 0

    def add(self, payload: bytes) -> None:
        """Add one encoded record."""
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
                use_statistics=True,
                use_summary_offsets=False,
            )
            self._writer.start(profile="kantor", library="kantor")
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
        self.digest.add(payload)
        if isinstance(record, (Batch, Ending)):
            self._time_ns = record.now_ns
        if self._file is not None:
            self._write(RECORD_TOPIC, payload)

    def append_row(self, row: Any) -> None:
        """Write one row of metrics, for viewers; it is not part of the digest."""
        if self._file is not None:
            self._write(METRICS_TOPIC, json.dumps(row._asdict()).encode())

    def replace(self) -> None:
        """Replace the old file, once all its records have been written again."""
        draft, self._draft = self._draft, None
        if draft is not None and self._path is not None and self.cut is None:
            draft.replace(self._path)

    def close(self) -> None:
        """Finish the file, and delete the reserve, so that the result has room on the disk."""
        if self._file is not None:
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]
                self._file.flush()
            except OSError as error:
                self._give_up(error)
        self._drop_file()
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
    for topic, message in _messages(path):
        if topic == RECORD_TOPIC:
            try:
                yield message.data, decode_record(message.data)
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                return


def _messages(path: Path) -> Iterator[tuple[str, Message]]:
    channels: dict[int, str] = {}
    with path.open("rb") as file:
        try:
            for item in _records_of_file(file):
                if isinstance(item, Message):
                    yield channels.get(item.channel_id, ""), item
                elif isinstance(item, Channel):
                    channels[item.id] = item.topic
        except (McapError, zstandard.ZstdError, ValueError, EOFError, OverflowError, struct.error):
            return
        except RuntimeError:  # of lz4
            return


def _records_of_file(file: IO[bytes]) -> Iterator[McapRecord]:
    """The records of an MCAP file, those in its chunks included. Raises what the reader and the codecs raise."""
    reader = StreamReader(file, emit_chunks=True, record_size_limit=_RECORD_BYTES_MAX)
    for item in reader.records:
        if isinstance(item, Chunk):
            yield from breakup_chunk(_inflated(item))
        else:
            yield item


def _inflated(chunk: Chunk) -> Chunk:
    """The same chunk without compression. Raises ValueError if it is larger than it may be, or than it says."""
    size = chunk.uncompressed_size
    if size > _CHUNK_BYTES_MAX:
        raise ValueError(f"a chunk of {size} bytes")
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            content = stream.read(size + 1)
    elif chunk.compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        content = chunk.data
    if len(content) > max(size, len(chunk.data)):
        raise ValueError("a chunk that is larger than it says")
    return dataclasses.replace(chunk, compression="", data=content)


def file_digest(path: Path) -> str:
    """BLAKE2b of the bytes of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=32)).hexdigest()
