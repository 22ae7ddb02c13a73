"""MCAP files: their messages up to where a file is cut, and their index for readers that seek.

While a run goes on its file has no chunks, so that a killed recorder loses nothing. At its end the messages are
gathered in chunks, uncompressed, with an index and a summary. The records in such a chunk have the same form as those
outside, and are read the same way: a chunk is a heading between them. Other tools may have packed the messages into
compressed chunks; these are inflated whole, within a bound.
"""

import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.writer import CompressionType, Writer

from kantor_protocol.storage.drafts import replace

PROFILE = "kantor"
_MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
_CHUNK_HEAD = struct.Struct("<QQQII")
"""First and last time, uncompressed size, CRC32, length of the compression's name."""
CHUNK_BYTES_MAX = 1 << 27
"""Of a compressed chunk, inflated. Tools make them of a few MiB."""
_RECORDS_LENGTH = struct.Struct("<Q")
_CHANNEL_HEAD = struct.Struct("<HHI")
"""Channel, schema, length of the topic."""
_ENCODING_HEAD = struct.Struct("<I")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time."""
_CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x04, 0x05, 0x06, 0x0F


class Topic(NamedTuple):
    """A channel: its topic, and how its messages are encoded."""

    name: str
    encoding: str


class McapMessage(NamedTuple):
    """A message with its topic."""

    topic: Topic
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


def messages(path: Path) -> Iterator[McapMessage]:
    """The messages of a file in their order, up to where it ends, is cut or is no MCAP as kantor writes it.

    No more is read into memory than one record, or one compressed chunk; and none is longer than the file.
    """
    with path.open("rb") as file:
        channels: dict[int, Topic] = {}
        if file.read(len(_MAGIC)) != _MAGIC:
            return
        for opcode, content in _records(file):
            try:
                if opcode == _CHANNEL:
                    number, topic = _channel(content)
                    channels[number] = topic
                else:
                    number, sequence, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(content)
                    data = content[_MESSAGE_HEAD.size :]
                    yield McapMessage(channels[number], sequence, log_ns, publish_ns, data)
            except (struct.error, UnicodeDecodeError, KeyError):
                return


def _records(file: IO[bytes], *, in_chunk: bool = False) -> Iterator[tuple[int, bytes]]:
    """Channels and messages, inside and outside of chunks, up to the summary or where the file is cut."""
    start = file.tell()
    end = file.seek(0, os.SEEK_END)
    file.seek(start)
    while len(head := file.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(head)
        if opcode == _DATA_END:
            return
        if opcode == _CHUNK:
            heading = file.read(_CHUNK_HEAD.size)
            if len(heading) < _CHUNK_HEAD.size or in_chunk:
                return
            *_, size, _, name_length = _CHUNK_HEAD.unpack(heading)
            if name_length == 0:
                file.seek(_RECORDS_LENGTH.size, os.SEEK_CUR)  # its records follow
                continue
            if length > end - file.tell() + _CHUNK_HEAD.size or length < _CHUNK_HEAD.size:
                return
            rest = file.read(length - _CHUNK_HEAD.size)
            packed = rest[name_length + _RECORDS_LENGTH.size :]
            if (content := _inflated(rest[:name_length], packed, size)) is None:
                return
            yield from _records(BytesIO(content), in_chunk=True)
        elif length > end - file.tell():
            return
        elif opcode in {_CHANNEL, _MESSAGE}:
            yield opcode, file.read(length)
        else:
            file.seek(length, os.SEEK_CUR)


def _inflated(compression: bytes, packed: bytes, size: int) -> bytes | None:
    """The content of a compressed chunk; None if it is damaged, or larger than it says or may be."""
    content = b""
    if size > CHUNK_BYTES_MAX:
        return None
    try:
        if compression == b"zstd":
            with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
                content = stream.read(size + 1)
        elif compression == b"lz4":
            content = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    except (zstandard.ZstdError, ValueError, EOFError, RuntimeError):  # the last is of lz4
        return None
    return content if len(content) == size else None


def _channel(content: bytes) -> tuple[int, Topic]:
    """A channel's number and topic. Raises struct.error, UnicodeDecodeError."""
    number, _, length = _CHANNEL_HEAD.unpack_from(content)
    end = _CHANNEL_HEAD.size + length
    (encoding_length,) = _ENCODING_HEAD.unpack_from(content, end)
    start = end + _ENCODING_HEAD.size
    encoding = content[start : start + encoding_length]
    return number, Topic(content[_CHANNEL_HEAD.size : end].decode(), encoding.decode())


def write_index(path: Path) -> None:
    """Gather the messages of a file in chunks and write their index behind them; the file is replaced at once.

    Raises OSError, and then the file is as it was.
    """

    def write(draft: Path) -> None:
        with draft.open("wb") as file:
            _write_chunks(messages(path), file)
            file.flush()
            os.fsync(file.fileno())

    replace(path, write)


def _write_chunks(source: Iterator[McapMessage], file: IO[bytes]) -> None:
    writer = Writer(file, compression=CompressionType.NONE)
    writer.start(profile=PROFILE, library=PROFILE)
    channels: dict[Topic, int] = {}
    for message in source:
        topic = message.topic
        if topic not in channels:
            channels[topic] = writer.register_channel(topic.name, topic.encoding, 0)
        writer.add_message(
            channels[topic],
            message.log_time_ns,
            message.data,
            message.publish_time_ns,
            message.sequence,
        )
    writer.finish()  # type: ignore[no-untyped-call]
