"""Resuming: the contents of a run folder for a world-sim that follows one that was killed."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.records import Ending, Record
from kantor_worldsim.record.run_folder import (
    JOURNAL,
    MANIFEST,
    METRICS,
    RESULT,
    OverError,
    Past,
    ResumeError,
)
from support.strategies import mission

ROOMY = ("samples.count=60", "energy.points=90", "energy.steps=60", "targets.count=40")

Play = Callable[..., tuple[Record, ...]]


@pytest.fixture
def records(played: Play) -> tuple[Record, ...]:
    """A small mission."""
    return played()


Cut = Callable[[Path, tuple[Record, ...]], Recording]


@pytest.fixture
def cut_short() -> Iterator[Cut]:
    """Makes a recording whose process is about to be killed."""
    made: list[Recording] = []

    def cut(folder: Path, records: tuple[Record, ...]) -> Recording:
        recording = Recording(mission(*ROOMY), 1, "wall", folder, speed=3.0)
        made.append(recording)
        for record in records:
            recording.observe(record)
        return recording

    yield cut
    for recording in made:
        drop(recording)


def drop(recording: Recording) -> None:
    """Close the files, as the operating system does for a killed process."""
    recording.journal._drop_file()
    if recording._table is not None:
        recording._table.close()


def test_a_run_that_was_cut_short_is_read_as_it_was(
    cut_short: Cut, records: tuple[Record, ...], tmp_path: Path
) -> None:
    recording = cut_short(tmp_path, records[:20])
    with (tmp_path / JOURNAL).open("ab") as file:
        file.write(b"\x05\x40\x00\x00")
    past = Past.of(tmp_path)

    assert past.records == records[:20]
    assert past.opening == records[0]
    assert past.terms.run == recording.run
    assert (past.terms.exchange, past.terms.speed, past.terms.exact_every) == ("wall", 3.0, None)


def test_a_resumed_recording_ends_as_one_that_was_never_cut(
    cut_short: Cut, records: tuple[Record, ...], tmp_path: Path
) -> None:
    """Cut twice: the same record, the same table, the same digest, and the run's name is kept."""
    for name in ("once", "thrice"):
        (tmp_path / name).mkdir()
    recording = cut_short(tmp_path / "once", records)
    once = recording.finish()
    first = cut_short(tmp_path / "thrice", records[:10])
    for begin, end in ((10, 25), (25, len(records))):
        past = Past.of(tmp_path / "thrice")
        recording = Recording(past.opening.scenario, 1, "wall", tmp_path / "thrice", past=past)
        for record in records[begin:end]:
            recording.observe(record)
        if end < len(records):
            drop(recording)
    thrice = recording.finish()
    manifest = json.loads((tmp_path / "thrice" / MANIFEST).read_bytes())

    assert thrice.digest == once.digest
    assert recording.run == first.run
    assert manifest["resumed"] == 2
    assert manifest["speed"] == 3.0
    for name in (JOURNAL, METRICS):
        same = [(tmp_path / run / name).read_bytes() for run in ("once", "thrice")]
        assert same[0] == same[1]
    assert not list((tmp_path / "thrice").glob(".*"))


KILLED_AGAIN = """
import os, signal, sys
from pathlib import Path
from kantor_worldsim.record.journal import Journal
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.run_folder import Past

take, taken = Journal.append, 0

def count(self, record, payload=b""):
    global taken
    take(self, record, payload)
    taken += 1
    if taken == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)

Journal.append = count
past = Past.of(Path(sys.argv[1]))
Recording(past.opening.scenario, 1, "wall", Path(sys.argv[1]), past=past)
"""


@pytest.mark.parametrize("after", [1, 15, 20])
def test_a_second_kill_while_catching_up_loses_nothing(
    cut_short: Cut, records: tuple[Record, ...], tmp_path: Path, after: int
) -> None:
    cut_short(tmp_path, records[:20])
    before = (tmp_path / JOURNAL).read_bytes()
    killed = subprocess.run(
        [sys.executable, "-c", KILLED_AGAIN, str(tmp_path), str(after)], check=False
    )

    assert killed.returncode == -signal.SIGKILL
    assert (tmp_path / JOURNAL).read_bytes() == before
    assert Past.of(tmp_path).records == records[:20]


def test_an_interrupted_mission_can_be_resumed_and_one_that_is_over_cannot(
    cut_short: Cut, records: tuple[Record, ...], tmp_path: Path
) -> None:
    for reason in ("interrupted", "done"):
        folder = tmp_path / reason
        folder.mkdir()
        cut_short(folder, (*records[:5], Ending(10**10, reason))).finish()

    assert Past.of(tmp_path / "interrupted").records == records[:5]
    with pytest.raises(OverError, match=r"its mission is over \(done\)"):
        Past.of(tmp_path / "done")


def test_an_ending_without_a_result_is_left_out(
    cut_short: Cut, records: tuple[Record, ...], tmp_path: Path
) -> None:
    """World-sim was killed between the last record and the result."""
    cut_short(tmp_path, records)

    assert isinstance(records[-1], Ending)
    assert Past.of(tmp_path).records == records[:-1]
    assert not (tmp_path / RESULT).exists()


def test_a_folder_without_a_run_is_refused_in_one_line(
    cut_short: Cut, records: tuple[Record, ...], tmp_path: Path
) -> None:
    with pytest.raises(ResumeError, match="no run to go on with"):
        Past.of(tmp_path / "nowhere")
    cut_short(tmp_path, records[:3])
    manifest = (tmp_path / MANIFEST).read_bytes()
    for broken, complaint in (
        (b"{", "no run to go on with"),
        (b"\xff\xfe", "no run to go on with"),
        (b"[]", "of another version"),
        (b'{"exchange": "wall"}', "of another version"),
    ):
        (tmp_path / MANIFEST).write_bytes(broken)
        with pytest.raises(ResumeError, match=complaint) as refused:
            Past.of(tmp_path)
        assert "\n" not in str(refused.value)
    (tmp_path / MANIFEST).write_bytes(manifest)
    os.truncate(tmp_path / JOURNAL, 60)
    with pytest.raises(ResumeError, match="nothing has happened in it"):
        Past.of(tmp_path)


def test_every_run_has_a_name_of_its_own() -> None:
    assert Recording(mission(), 1, "wall").run != Recording(mission(), 1, "wall").run
