"""The journal on disk: whole, cut, altered, on a full disk, and with its writer killed."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.scenario.load import load
from kantor_worldsim.observers.metrics.density import DensityMetrics
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.journal import (
    METRICS_TOPIC,
    RECORD_TOPIC,
    Digest,
    Journal,
    file_digest,
    read,
)
from kantor_worldsim.record.records import Record, decode_record, encode_record
from kantor_worldsim.record.run_folder import (
    JOURNAL,
    MANIFEST,
    METRICS,
    RESULT,
    SCENARIO,
    folder_for,
)
from kantor_worldsim.world.world import WorldSetup
from support.strategies import examples, mission

pytestmark = pytest.mark.xdist_group("journal")

Play = Callable[..., tuple[Record, ...]]

LONG = ("robots.count=3", "energy.points=9000", "samples.count=4000", "metrics.every=1")
"""Three thousand steps: a journal of about 2 MB and a table of about 300 kB."""


def write(records: tuple[Record, ...], path: Path) -> Journal:
    """A journal with records and the metrics that follow from them."""
    journal = Journal(path)
    pipeline = Pipeline(journal, DensityMetrics(on_row=journal.append_row))
    for record in records:
        pipeline.observe(record)
    journal.close()
    return journal


def read_back(content: bytes, folder: Path) -> list[Record]:
    """Records of a file with this content."""
    path = folder / "altered.mcap"
    path.write_bytes(content)
    return [record for _, record in read(path)]


@pytest.fixture(scope="module")
def records(played: Play) -> tuple[Record, ...]:
    """A run with losses and a supervisor."""
    return played("coordination=centralized", "radio.drop=0.3", "clock.jitter_s=0.02")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files."""
    return tmp_path_factory.mktemp("journals")


@pytest.fixture(scope="module")
def content(records: tuple[Record, ...], folder: Path) -> bytes:
    """The bytes of a whole journal."""
    path = folder / "whole.mcap"
    write(records, path)
    return path.read_bytes()


def run_in(folder: Path, *overrides: str) -> Result:
    """A mission recorded in a folder."""
    scenario = mission(*overrides)
    setup = WorldSetup.of(scenario, 1)
    recording = Recording(scenario, 1, "in-process", folder)
    play(scenario, 1, setup, [recording.observe])
    return recording.finish()


# Whole.


def test_records_are_read_as_they_were_written(records: tuple[Record, ...], folder: Path) -> None:
    """Records are equal to the written ones, value for value and byte for byte."""
    write(records, folder / "back.mcap")
    back = list(read(folder / "back.mcap"))

    assert [record for _, record in back] == list(records)
    assert [payload for payload, _ in back] == [encode_record(record) for record in records]
    assert [decode_record(encode_record(record)) for record in records] == list(records)


def test_the_digest_is_the_same_with_and_without_a_file(
    records: tuple[Record, ...], folder: Path
) -> None:
    """The digest is of the records: no file, no metrics and no clock enter it."""
    without = Journal()
    for record in records:
        without.append(record)
    without.close()
    from_file = Digest()
    written = write(records, folder / "digest.mcap")
    for payload, _ in read(folder / "digest.mcap"):
        from_file.add(payload)

    assert without.digest.hex == written.digest.hex == from_file.hex
    assert without.digest.records == len(records)


def test_the_digest_depends_on_where_records_begin() -> None:
    """The same bytes cut into other records have another digest."""
    one, other = Digest(), Digest()
    one.add(b"ab")
    one.add(b"c")
    other.add(b"a")
    other.add(b"bc")

    assert one.hex != other.hex


def test_the_mcap_library_reads_the_file(records: tuple[Record, ...], folder: Path) -> None:
    """The library's own reader finds both topics, every message, and simulated time."""
    write(records, folder / "plain.mcap")
    with (folder / "plain.mcap").open("rb") as file:
        messages = list(make_reader(file).iter_messages())
    topics = [channel.topic for _, channel, _ in messages]
    rows = [json.loads(m.data) for _, channel, m in messages if channel.topic == METRICS_TOPIC]

    assert topics.count(RECORD_TOPIC) == len(records)
    assert rows[0]["tick"] == 0
    assert rows[-1]["mass_left"] == 0.0
    assert max(message.log_time for _, _, message in messages) == records[-1].now_ns


# Cut and altered.


@examples(200)
@given(st.data())
def test_a_cut_file_is_read_up_to_the_cut(
    content: bytes, records: tuple[Record, ...], folder: Path, data: st.DataObject
) -> None:
    """Every record that is whole before the cut is read, and nothing else."""
    cut = data.draw(st.integers(0, len(content)))
    ends, at = [], 0
    for record in records:
        payload = encode_record(record)
        at = content.index(payload, at) + len(payload)
        ends.append(at)
    whole = sum(end <= cut for end in ends)

    assert read_back(content[:cut], folder) == list(records[:whole])


@examples(200)
@given(at=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
def test_an_altered_byte_changes_the_digest_and_does_not_break_reading(
    content: bytes, folder: Path, at: float, flip: int
) -> None:
    """The file's digest differs for any position of the byte; reading ends early at the worst."""
    place = int(at * len(content))
    altered = bytearray(content)
    altered[place] ^= flip
    whole = folder / "as_written.mcap"
    whole.write_bytes(content)
    read_back(bytes(altered), folder)

    assert file_digest(folder / "altered.mcap") != file_digest(whole)


@examples(50)
@given(st.binary(max_size=400))
def test_any_bytes_are_read_as_a_list_of_records(folder: Path, junk: bytes) -> None:
    """A file that is no journal holds no records; a journal's head does not change that."""
    assert read_back(junk, folder) == []
    assert read_back(b"\x89MCAP0\r\n" + junk, folder) == []


# A full disk.


@contextlib.contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """A file system of this size; the test is skipped where none can be mounted."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("no file system can be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def assert_cut_but_complete(folder: Path, result: Result, whole: Result) -> None:
    """The mission went on to its end, and its result has the time at which its record was cut."""
    written = json.loads((folder / RESULT).read_bytes())
    manifest = json.loads((folder / MANIFEST).read_bytes())
    journal = [payload for payload, _ in read(folder / JOURNAL)]

    assert result.record.startswith("cut at t=")
    assert written["record"] == manifest["record"] == result.record
    assert (written["ended"], written["digest"]) == ("done", whole.digest)
    assert manifest["journal_blake2b"] == file_digest(folder / JOURNAL)
    assert len(journal) < manifest["records"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        [JOURNAL, MANIFEST, METRICS, RESULT, SCENARIO]
    )


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The long mission on a disk with room."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run_in(folder, *LONG)


def test_a_run_leaves_a_whole_record(whole_run: tuple[Path, Result]) -> None:
    """With room on the disk the record is whole and the folder has all its files."""
    folder, result = whole_run

    assert result.record == "whole"
    assert (
        len(list(read(folder / JOURNAL))) == json.loads((folder / MANIFEST).read_bytes())["records"]
    )
    assert len((folder / METRICS).read_text().splitlines()) == result.ticks + 2
    assert load(folder / SCENARIO) == mission(*LONG)


@pytest.mark.processes
@pytest.mark.parametrize("size", ["100k", "400k", "700k", "1m"])
def test_a_full_disk_cuts_the_record_and_not_the_mission(
    whole_run: tuple[Path, Result], tmp_path: Path, size: str
) -> None:
    """With a disk that fills up at any time, the mission goes on to its end and leaves its result."""
    with small_disk(tmp_path / "disk", size) as folder:
        result = run_in(folder, *LONG)
        journal = [payload for payload, _ in read(folder / JOURNAL)]

        assert_cut_but_complete(folder, result, whole_run[1])
        expected = [payload for payload, _ in read(whole_run[0] / JOURNAL)]
        assert journal == expected[: len(journal)]


LIMITED = """
import resource, sys
from pathlib import Path
from kantor_worldsim.record.journal import read
from kantor_worldsim.observers.recording import Recording

source, folder, limit = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
records = [record for _, record in read(source)]
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
recording = Recording(records[0].scenario, records[0].seed, "in-process", folder)
for record in records:
    recording.observe(record)
recording.finish()
"""


@pytest.mark.processes
def test_a_file_size_limit_cuts_the_record(whole_run: tuple[Path, Result], tmp_path: Path) -> None:
    """A limit on the size of a file is a full disk for the journal alone."""
    source, result = whole_run
    limit = 500_000
    arguments = [str(source / JOURNAL), str(tmp_path), str(limit)]
    subprocess.run([sys.executable, "-c", LIMITED, *arguments], check=True)
    expected = [payload for payload, _ in read(source / JOURNAL)]
    journal = [payload for payload, _ in read(tmp_path / JOURNAL)]
    written = json.loads((tmp_path / RESULT).read_bytes())

    assert written["record"].startswith("cut at t=")
    assert written["digest"] == result.digest
    assert (tmp_path / JOURNAL).stat().st_size <= limit
    assert len(journal) > 300
    assert journal == expected[: len(journal)]


# A killed writer.

KILLED_WRITER = """
import sys
from pathlib import Path
from kantor_worldsim.record.journal import Journal, read

records = [record for _, record in read(Path(sys.argv[1]))]
journal = Journal(Path(sys.argv[2]))
for record in records[:100]:
    journal.append(record)
print("taken", flush=True)
sys.stdin.read()
"""


@pytest.mark.processes
def test_a_killed_writer_loses_no_record_that_it_accepted(
    whole_run: tuple[Path, Result], tmp_path: Path
) -> None:
    """An accepted record is in the file, even if no other follows."""
    arguments = [str(whole_run[0] / JOURNAL), str(tmp_path / "killed.mcap")]
    with subprocess.Popen(
        [sys.executable, "-c", KILLED_WRITER, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == b"taken\n"
        os.kill(writer.pid, signal.SIGKILL)

    assert sum(1 for _ in read(tmp_path / "killed.mcap")) == 100


# The folder.


def test_folders_of_one_second_are_numbered(tmp_path: Path) -> None:
    """Runs that start at once get folders of their own."""
    made = [folder_for(mission(), 7, tmp_path / "runs") for _ in range(5)]

    assert len(set(made)) == 5
    assert all("_small_s7" in path.name for path in made)


def test_a_result_is_replaced_atomically(tmp_path: Path) -> None:
    """A run leaves no draft and no reserve, and its result can be read."""
    run_in(tmp_path)
    names = sorted(path.name for path in tmp_path.iterdir())

    assert names == sorted([JOURNAL, MANIFEST, METRICS, RESULT, SCENARIO])
    assert json.loads((tmp_path / RESULT).read_bytes())["record"] == "whole"
