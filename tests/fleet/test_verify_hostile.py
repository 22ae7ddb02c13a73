"""`kantor verify` and `kantor worldsim --resume` on run folders that no run has left."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from kantor_fleet.execution.verify import verify
from kantor_fleet.exits import Exit
from kantor_fleet.report.summary import read_result
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import Array
from kantor_worldsim.record import behaviour
from kantor_worldsim.record.behaviour import Change
from kantor_worldsim.record.journal import Journal, read
from kantor_worldsim.record.records import Opening
from kantor_worldsim.record.run_folder import (
    JOURNAL,
    MANIFEST,
    RESULT,
    FolderLock,
    InUseError,
    Past,
    ResumeError,
    is_empty,
)

BASELINE = Path(__file__).parents[1] / "baseline"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run folder of version 0.1.0."""
    return Path(shutil.copytree(BASELINE / "lockstep", tmp_path / "run"))


def manifest_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / MANIFEST).read_text())  # type: ignore[no-any-return]


def end_of(capsys: pytest.CaptureFixture[str], folder: Path) -> tuple[int, list[str]]:
    """The exit code of verify, and the lines that are no success."""
    try:
        code = int(verify(folder))
    except SystemExit as ended:
        code = int(ended.code or 0)
    out, err = capsys.readouterr()
    bad = [line for line in out.splitlines() if not line.startswith("ok  ")]
    return code, [*err.splitlines(), *bad]


MANIFESTS: dict[str, Callable[[dict[str, Any]], bytes]] = {
    "nested": lambda _: b"[" * 50_000,
    "nested in a field": lambda m: json.dumps(m)[:-1].encode() + b', "x": ' + b"[" * 50_000,
    "no object": lambda _: b"[]",
    "a long number": lambda _: b'{"format": 1' + b"0" * 5000 + b"}",
    "no text": lambda _: b"\xff\xfe",
    "speed 0": lambda m: json.dumps(m | {"speed": 0.0, "exchange": "wall"}).encode(),
    "speed NaN": lambda m: json.dumps(m | {"speed": float("nan"), "exchange": "wall"}).encode(),
    "speed 1e308": lambda m: json.dumps(m | {"speed": 1e308, "exchange": "wall"}).encode(),
    "an unknown exchange": lambda m: json.dumps(m | {"exchange": "x"}).encode(),
    "a negative period": lambda m: json.dumps(m | {"exact_every": -1}).encode(),
    "resumed x times": lambda m: json.dumps(m | {"resumed": "x"}).encode(),
    "long": lambda m: json.dumps(m).encode() + b" " * (1 << 25),
}


@pytest.mark.parametrize("name", MANIFESTS)
def test_a_manifest_that_no_run_has_written_is_refused(
    folder: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line, by both, as far as they need what is wrong with it."""
    cut = {key: value for key, value in manifest_of(folder).items() if key != "digest"}
    (folder / MANIFEST).write_bytes(MANIFESTS[name](cut))
    with pytest.raises(ResumeError) as refused:
        Past.of(folder)
    code, lines = end_of(capsys, folder)

    assert "\n" not in str(refused.value)
    needless = name.startswith(("speed", "a negative", "resumed"))
    assert (code, len(lines)) == ((0, 0) if needless else (2, 1))


@pytest.mark.parametrize("name", [MANIFEST, RESULT, JOURNAL])
def test_a_pipe_or_a_device_is_no_file(
    folder: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither waits for a writer, and neither reads without end."""
    for put in (os.mkfifo, lambda path: path.symlink_to("/dev/zero"), os.mkdir):
        path = folder / name
        path.rmdir() if path.is_dir() else path.unlink()
        put(path)
        code, lines = end_of(capsys, folder)
        assert read_result(folder) is None or name != RESULT
        assert (code, len(lines)) == ((0, 0) if name == RESULT else (2, 1))


def forged(folder: Path, change: Callable[[Opening], Opening]) -> None:
    """Replace the opening of a record."""
    opening, *others = [record for _, record in read(folder / JOURNAL)]
    assert isinstance(opening, Opening)
    journal = Journal(folder / JOURNAL)
    for record in (change(opening), *others):
        journal.append(record)
    journal.close()
    (folder / MANIFEST).write_text(
        json.dumps({k: v for k, v in manifest_of(folder).items() if k != "digest"})
    )


def scenario_with(**parts: dict[str, Any]) -> Callable[[Opening], Opening]:
    """A change of some parts of the scenario."""

    def change(opening: Opening) -> Opening:
        scenario: Scenario = opening.scenario
        changed = {name: replace(getattr(scenario, name), **keys) for name, keys in parts.items()}
        return replace(opening, scenario=replace(scenario, **changed))

    return change


OPENINGS: dict[str, Callable[[Opening], Opening]] = {
    "more samples": scenario_with(samples={"count": 50_000}),
    "more robots": scenario_with(robots={"count": 100}),
    "more targets": scenario_with(targets={"count": 50_000}),
    "a period that is none": scenario_with(clock={"jitter_s": 5.0}),
    "a stranger looks": lambda o: replace(o, first_look={"x" * 10: ((0, 0.0, 0.0),)}),
    "a target that is not there": lambda o: replace(o, first_look={"r1": ((2**40, 0.0, 0.0),)}),
    "no starts": lambda o: replace(o, starts_m=Array("<f8", (0, 2), b"")),
    "starts without their numbers": lambda o: replace(o, starts_m=Array("<f8", (2, 2), b"")),
    "an array without a shape": lambda o: replace(o, samples_m=Array("<f8", (), b"12345678")),
}


@pytest.mark.parametrize("name", OPENINGS)
def test_an_opening_that_orders_more_than_it_holds_is_refused(
    folder: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything of that size is made."""
    forged(folder, OPENINGS[name])
    with pytest.raises(ResumeError, match="no run can start from it"):
        Past.of(folder)
    code, lines = end_of(capsys, folder)

    assert (code, len(lines)) == (1, 1)
    assert lines[0].startswith("FAIL  run.mcap: no run can start from its opening: ")


# Behaviour that has changed.


def other_seed(opening: Opening) -> Opening:
    """What another behaviour does to a record: it can be read, and is not what comes out today."""
    return replace(opening, seed=opening.seed + 1)


def test_a_record_of_an_earlier_behaviour_is_not_called_broken(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line says what has changed since, if that concerns its mission; and a broken one of today fails."""
    forged(folder, other_seed)
    code, (line,) = end_of(capsys, folder)
    assert code == Exit.NOT_MET
    assert line.startswith("FAIL  executed again: record ")

    of_maps = Change("robots give up sooner", concerns=lambda scenario: scenario.mapping)
    monkeypatch.setattr(behaviour, "CHANGES", {2: of_maps})
    assert end_of(capsys, folder) == (Exit.NOT_MET, [line])

    monkeypatch.setattr(behaviour, "CHANGES", {2: of_maps, 3: Change("robots turn left")})
    assert verify(folder) == Exit.DONE
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("ok    executed again: record ")
    assert last.endswith(
        "recorded under behaviour 1, this is 3; changed since: (3) robots turn left"
    )


def test_a_record_of_a_later_behaviour_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line with the remedy."""
    (folder / MANIFEST).write_text(json.dumps(manifest_of(folder) | {"behaviour": 99}))

    code, (line,) = end_of(capsys, folder)
    assert code == 2
    assert "written by a newer version; verify it with that one" in line


def test_changes_are_numbered_without_a_gap() -> None:
    """From 2 on: 1 is what records without a number have."""
    assert sorted(behaviour.CHANGES) == [*range(2, 2 + len(behaviour.CHANGES))]


# The owner of a folder.


def test_a_folder_is_locked_once(folder: Path) -> None:
    """As long as it is held; nothing is put into the folder."""
    before = sorted(folder.iterdir())
    with FolderLock(folder):
        with pytest.raises(InUseError, match="another process runs this mission"):
            FolderLock(folder)
        assert sorted(folder.iterdir()) == before
    FolderLock(folder).release()


def test_where_there_is_no_folder_nothing_can_go_on(folder: Path) -> None:
    """One line, as for a folder without a run."""
    for place in (folder / "nowhere", folder / MANIFEST):
        with pytest.raises(ResumeError, match="no run to go on with"):
            FolderLock(place)


def test_a_folder_is_empty_until_its_opening_is_on_record(folder: Path, tmp_path: Path) -> None:
    """A journal's head alone is nothing."""
    assert not is_empty(folder)
    Journal(tmp_path / JOURNAL).close()
    assert is_empty(tmp_path)
    assert is_empty(tmp_path / "nowhere")
