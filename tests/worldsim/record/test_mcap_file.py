"""MCAP files: read by readers that seek, cut anywhere, compressed by others, and with lengths that lie."""

import json
import struct
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, SeekingReader

from kantor_worldsim.record.journal import METRICS_TOPIC, RECORD_TOPIC, Journal, read
from kantor_worldsim.record.mcap_file import messages, write_index
from kantor_worldsim.record.records import Record
from support.strategies import examples

BASELINE = Path(__file__).parents[2] / "baseline"


class Row(dict):  # type: ignore[type-arg]
    """A row of metrics."""

    def _asdict(self) -> dict[str, float]:
        return dict(self)


@pytest.fixture(scope="module")
def whole(played: object, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A journal of a run that has ended, with rows of which one has no number."""
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    journal = Journal(path)
    records: tuple[Record, ...] = played("radio.drop=0.3")  # type: ignore[operator]
    for record in records:
        journal.append(record)
        journal.append_row(Row(tick=1, w_ub=float("nan")))
    journal.close()
    return path


def seen(reader: object) -> Counter[str]:
    """Messages by topic, as the library's reader sees them."""
    return Counter(channel.topic for _, channel, _ in reader.iter_messages())  # type: ignore[attr-defined]


def test_a_reader_that_seeks_finds_every_message(whole: Path) -> None:
    """By the index, without reading from the start; checksums hold, and rows are JSON."""
    count = sum(1 for _ in read(whole))
    with whole.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert seen(reader) == {RECORD_TOPIC: count, METRICS_TOPIC: count}
    with whole.open("rb") as file:
        assert seen(NonSeekingReader(file, validate_crcs=True)).total() == 2 * count
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 2 * count
    assert summary.chunk_indexes
    rows = [m.data for m in messages(whole) if m.topic.name == METRICS_TOPIC]
    assert json.loads(rows[0], parse_constant=pytest.fail) == {"tick": 1, "w_ub": None}


def test_a_file_without_an_index_says_so(whole: Path, tmp_path: Path) -> None:
    """While a run goes on, and when it was killed: no summary, so that readers read from the start."""
    path = tmp_path / "run.mcap"
    journal = Journal(path)
    records = [record for _, record in read(whole)]
    for record in records:
        journal.append(record)
    with path.open("rb") as file:
        assert sum(1 for _ in messages(path)) == len(records)
        file.seek(0)
    journal._writer.finish()  # type: ignore[no-untyped-call]
    journal._drop_file()

    with path.open("rb") as file:
        reader = SeekingReader(file)
        assert reader.get_summary() is None
        assert seen(reader) == {RECORD_TOPIC: len(records)}


@pytest.mark.parametrize("run", ["in-process", "lockstep", "wall", "cut-off/run"])
def test_a_file_of_version_0_1_0_is_indexed_without_a_change_of_its_messages(
    run: str, tmp_path: Path
) -> None:
    """It is read before and after, message for message."""
    path = tmp_path / "run.mcap"
    path.write_bytes((BASELINE / run / "run.mcap").read_bytes())
    before = list(messages(path))
    write_index(path)

    assert before
    assert list(messages(path)) == before
    with path.open("rb") as file:
        assert seen(SeekingReader(file)).total() == len(before)
    assert [found.name for found in tmp_path.iterdir()] == ["run.mcap"]


@examples(100)
@given(share=st.floats(0.0, 1.0, exclude_max=True))
def test_an_indexed_file_is_read_up_to_where_it_is_cut(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, share: float
) -> None:
    """Inside of a chunk too: every message that is whole."""
    content = whole.read_bytes()
    cut = int(share * len(content))
    path = tmp_path_factory.getbasetemp() / "cut.mcap"
    path.write_bytes(content[:cut])
    every, found = list(messages(whole)), list(messages(path))

    assert found == every[: len(found)]
    if len(found) < len(every):
        assert content.index(every[len(found)].data) + len(every[len(found)].data) > cut or (
            every[len(found)].data in content[:cut]
        )


# Files that no one has written in good faith.


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    """A record of MCAP, with a length that may lie."""
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def text(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


HEAD = (
    b"\x89MCAP0\r\n"
    + record(1, text(b"kantor") + text(b"kantor"))
    + record(
        4, struct.pack("<HH", 1, 0) + text(RECORD_TOPIC.encode()) + text(b"msgpack") + bytes(4)
    )
)


def chunk(compression: bytes, content: bytes, size: int) -> bytes:
    times = struct.pack("<QQQI", 0, 0, size, 0)
    return record(6, times + text(compression) + struct.pack("<Q", len(content)) + content)


BAD = {
    "a chunk of 4 GiB": chunk(b"zstd", b"\x28\xb5\x2f\xfd", 4 << 30),
    "an unknown compression": chunk(b"evil", b"x", 1),
    "a chunk in a chunk": chunk(b"", chunk(b"lz4", b"x", 1 << 40), 99),
    "a length of 2^63": record(5, b"", 1 << 63),
    "a length of 1 GiB": record(5, b"", (1 << 30) - 1),
    "a text of 2 GiB": record(4, struct.pack("<HHI", 1, 0, 1 << 31) + b"x"),
    "a topic that is no text": record(4, struct.pack("<HH", 1, 0) + text(b"\xff") + text(b"")),
    "a channel that is not there": record(5, struct.pack("<HIQQ", 9, 0, 0, 0)),
    "half a message": record(5, b"\x01\x00"),
    "half a chunk": record(6, b"\x00" * 10),
}
BOUNDED = """
import resource, sys
from pathlib import Path
from kantor_worldsim.record.journal import read

used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20),) * 2)
for path in sys.argv[1:]:
    assert list(read(Path(path))) == [], path
"""


@pytest.mark.processes
def test_a_hostile_file_is_read_within_bounds(tmp_path: Path) -> None:
    """Within 64 MiB, whatever its lengths say; nothing is unpacked."""
    paths = []
    for name, content in BAD.items():
        paths.append(tmp_path / name)
        paths[-1].write_bytes(HEAD + content)
    subprocess.run([sys.executable, "-c", BOUNDED, *map(str, paths)], check=True)
