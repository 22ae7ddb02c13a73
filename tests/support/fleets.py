"""What tests ask of a fleet of processes."""

import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from kantor_worldsim.record.journal import read
from kantor_worldsim.record.records import Batch, ProcessEvent, Record, StepRecord
from support.limits import EVENT_LIMIT_S

if TYPE_CHECKING:
    import subprocess


def result_of(folder: Path) -> dict[str, object]:
    """result.json of a run folder."""
    tree = json.loads((folder / "result.json").read_text())
    assert isinstance(tree, dict)
    return tree


def await_line(process: "subprocess.Popen[str]", start: str, part: str = "") -> str:
    """The first line of output that starts so and has that part; fails when the output ends before."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(start) and part in line:
            return line
    raise AssertionError(f"no line starts with {start!r} and has {part!r}")


def children_named(process: "subprocess.Popen[str]", log: Path) -> int:
    """The process id that a participant's log tells."""
    return int(json.loads(log.read_text().splitlines()[0])["pid"])


def records_of(folder: Path) -> list[Record]:
    """What a run folder has on record so far."""
    return [record for _, record in read(folder / "run.mcap")]


def incidents_of(folder: Path) -> list[ProcessEvent]:
    """What befell processes."""
    return [record for record in records_of(folder) if isinstance(record, ProcessEvent)]


def acts_of(records: Iterable[Record], name: str) -> list[StepRecord]:
    """What a participant did, in order."""
    batches = (record for record in records if isinstance(record, Batch))
    return [
        step_record
        for batch in batches
        for step_record in batch.step_records
        if step_record.name == name and step_record.outputs
    ]


def await_incident(folder: Path, who: str, what: str, count: int = 1) -> ProcessEvent:
    """The incident of this kind, once it is on record."""
    give_up = time.monotonic() + EVENT_LIMIT_S
    while time.monotonic() < give_up:
        found = [i for i in incidents_of(folder) if (i.who, i.kind) == (who, what)]
        if len(found) >= count:
            return found[count - 1]
        time.sleep(0.02)  # the record is a file, which tells nobody that it grows
    raise AssertionError(f"nothing on record of {who}: {what}")


def await_act(folder: Path, name: str, after: int = 0) -> StepRecord:
    """The first step of a participant after a number of steps, once it is on record."""
    give_up = time.monotonic() + EVENT_LIMIT_S
    while time.monotonic() < give_up:
        step_records = acts_of(records_of(folder), name)
        if len(step_records) > after:
            return step_records[after]
        time.sleep(0.02)
    raise AssertionError(f"{name} makes no step {after + 1}")
