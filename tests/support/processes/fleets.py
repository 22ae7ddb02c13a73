"""Outputs, records and logs of a fleet of processes, read and waited for."""

import json
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from kantor_worldsim.record.journal import read
from kantor_worldsim.record.records import Batch, ProcessEvent, Record, StepRecord
from support.limits import EVENT_LIMIT_S

if TYPE_CHECKING:
    from support.processes.command import Process

T = TypeVar("T")


def result_of(folder: Path) -> dict[str, object]:
    """result.json of a run folder."""
    tree = json.loads((folder / "result.json").read_text())
    assert isinstance(tree, dict)
    return tree


def await_line(process: "Process", start: str, part: str = "") -> str:
    """The first line of output that starts so and has that part; fails when the output ends before."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(start) and part in line:
            return line
    raise AssertionError(f"no line starts with {start!r} and has {part!r}")


def children_named(process: "Process", log: Path) -> int:
    """The process id of a participant, from its log."""
    return int(json.loads(log.read_text().splitlines()[0])["pid"])


def records_of(folder: Path) -> list[Record]:
    """The records of a run folder so far."""
    return [record for _, record in read(folder / "run.mcap")]


def incidents_of(folder: Path) -> list[ProcessEvent]:
    """The process events of a run folder so far."""
    return [record for record in records_of(folder) if isinstance(record, ProcessEvent)]


def acts_of(records: Iterable[Record], name: str) -> list[StepRecord]:
    """The steps of a participant that were done, in order."""
    batches = (record for record in records if isinstance(record, Batch))
    return [
        step_record
        for batch in batches
        for step_record in batch.step_records
        if step_record.name == name and step_record.outputs
    ]


def await_incident(folder: Path, who: str, kind: str, count: int = 1) -> ProcessEvent:
    """The process event of this kind, once it is on record so often."""

    def found(records: list[Record]) -> list[ProcessEvent]:
        events = (record for record in records if isinstance(record, ProcessEvent))
        return [event for event in events if (event.who, event.kind) == (who, kind)]

    return _await(folder, found, count - 1, f"{who}: {kind}")


def await_act(folder: Path, name: str, after: int = 0, since_ns: int = 0) -> StepRecord:
    """The first step of a participant after a number of steps and a moment, once it is on record."""

    def found(records: list[Record]) -> list[StepRecord]:
        return [step for step in acts_of(records, name) if step.now_ns >= since_ns]

    return _await(folder, found, after, f"step {after + 1} of {name}")


def await_text(log: Path, text: str, count: int = 1) -> None:
    """Return once a log has a text so often."""
    give_up = time.monotonic() + EVENT_LIMIT_S
    while log.read_text().count(text) < count:
        assert time.monotonic() < give_up, f"{log} never has {text!r}"
        time.sleep(0.02)


def _await(folder: Path, find: Callable[[list[Record]], list[T]], index: int, name: str) -> T:
    """One of the entries that `find` finds. A file sends no event when it grows, so it is read again."""
    give_up = time.monotonic() + EVENT_LIMIT_S
    while (now := time.monotonic()) < give_up:
        found = find(records_of(folder))
        if len(found) > index:
            return found[index]
        time.sleep(max(0.02, 3.0 * (time.monotonic() - now)))  # leave the processor to the fleet
    raise AssertionError(f"never on record: {name}")
