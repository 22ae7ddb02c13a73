"""Journals whose messages another tool has packed into compressed chunks: read like any other, and never beyond bounds."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer

from kantor_worldsim.record import mcap_file
from kantor_worldsim.record.journal import RECORD_TOPIC, read
from kantor_worldsim.record.records import Record, encode_record
from support.strategies import examples

Play = Callable[..., tuple[Record, ...]]
MAGIC = b"\x89MCAP0\r\n"
BOMB_BYTES = 50_000_000
PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.compress,
    "lz4": lz4.frame.compress,
    "": lambda content: content,
}


@pytest.mark.parametrize("kind", list(CompressionType))
def test_packed_records_are_read(kind: CompressionType, played: Play, tmp_path: Path) -> None:
    """Whatever they are packed with."""
    records, path = played(), tmp_path / "packed.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=kind, chunk_size=10_000)
        writer.start()
        channel = writer.register_channel(RECORD_TOPIC, "msgpack", 0)
        for record in records:
            writer.add_message(channel, 0, encode_record(record), 0)
        writer.finish()

    assert tuple(record for _, record in read(path)) == records


def with_chunk(path: Path, compression: str, data: bytes, size: int) -> None:
    """A file with one chunk that says how large it is."""
    builder = RecordBuilder()
    Chunk(compression, data, 0, 0, 0, size).write(builder)
    path.write_bytes(MAGIC + builder.end())


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
@pytest.mark.parametrize("size", [10, mcap_file.CHUNK_BYTES_MAX + 1, 2**63])
def test_a_bomb_is_not_inflated(kind: str, size: int, tmp_path: Path) -> None:
    """A chunk is inflated up to what it says, and not at all if that is more than any may be."""
    path = tmp_path / "bomb.mcap"
    with_chunk(path, kind, PACK[kind](bytes(BOMB_BYTES)), size)
    tracemalloc.start()
    try:
        assert list(read(path)) == []
        assert tracemalloc.get_traced_memory()[1] < BOMB_BYTES / 5
    finally:
        tracemalloc.stop()


@given(kind=st.sampled_from(list(PACK)), content=st.binary(max_size=60), size=st.integers(0, 80))
@examples(100)
def test_a_chunk_of_anything_ends_a_journal(
    kind: str, content: bytes, size: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Damaged contents, and wrong sizes: no more is read, and nothing is raised."""
    path = tmp_path_factory.getbasetemp() / "chunk.mcap"
    for data in (content, PACK[kind](content)):
        with_chunk(path, kind, data, size)
        assert list(read(path)) == []
