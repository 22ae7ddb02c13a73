"""The folder that a run leaves (design, part 7), and the referees that follow the run."""

import contextlib
import csv
import json
import platform
import secrets
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, NamedTuple

import msgspec

from kantor_protocol.machine import ParticipantId
from kantor_protocol.quota import Excess
from kantor_protocol.scenario import Scenario, to_toml
from kantor_worldsim.checkers import Checker
from kantor_worldsim.exploration import Exploration
from kantor_worldsim.journal import Journal, file_digest, read
from kantor_worldsim.metrics import Following, Metrics, Result
from kantor_worldsim.reading import Reader
from kantor_worldsim.records import Ending, Opening, Record
from kantor_worldsim.survey import Survey

JOURNAL = "run.mcap"
MANIFEST = "manifest.json"
RESULT = "result.json"
SCENARIO = "scenario.toml"
METRICS = "metrics.csv"
REPORT = "report.png"


def folder_for(scenario: Scenario, seed: int, below: Path) -> Path:
    """Create `<UTC>_<scenario>_s<seed>` below a folder; a number is added if it exists."""
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}_{scenario.name}_s{seed}"
    for attempt in range(1000):
        folder = below / (stem if not attempt else f"{stem}_{attempt}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{below / stem}: a thousand runs in one second")


def metrics_of(
    scenario: Scenario,
    exact_every: int | None = None,
    reader: Reader | None = None,
    survey: Survey | None = None,
) -> Following:
    """What follows a run of a scenario: what a density needs, or a map. exact_every: see Metrics.

    reader, survey: those that other referees of the same run follow it by.
    """
    if scenario.mapping:
        return Exploration(reader, survey)
    return Metrics(exact_every, reader)


class ResumeError(ValueError):
    """A run folder from which no mission can go on; the message is one line with the remedy."""


class OverError(ResumeError):
    """The mission has come to its end, and its files are whole."""


class Terms(msgspec.Struct, frozen=True):
    """How a run is run, in its manifest."""

    run: str
    """Names it."""
    exchange: str
    speed: float
    exact_every: int | None = None


class Past(NamedTuple):
    """What a run folder holds of a mission that was cut short."""

    terms: Terms
    opening: Opening
    records: tuple[Record, ...]
    """The opening and all that followed, without an ending."""
    manifest: dict[str, Any]

    @classmethod
    def of(cls, folder: Path) -> "Past":
        """Raises ResumeError; OverError if nothing is left to be done."""
        try:
            manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
            records = [record for _, record in read(folder / JOURNAL)]
            terms = msgspec.convert(manifest, Terms)
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            what = error.strerror if isinstance(error, OSError) else str(error)
            raise ResumeError(f"{folder}: no run to go on with ({what}); give its folder") from None
        except msgspec.ValidationError as error:
            raise ResumeError(f"{folder / MANIFEST}: of another version: {error}") from None
        if not records or not isinstance(records[0], Opening):
            raise ResumeError(f"{folder / JOURNAL}: nothing has happened in it; start the run anew")
        last = records[-1]
        if isinstance(last, Ending):
            if "digest" in manifest and last.reason != "interrupted":
                raise OverError(f"{folder}: its mission is over ({last.reason})")
            records.pop()
        return cls(terms, records[0], tuple(records), manifest)


class Recording:
    """Follows a run: journal, metrics and checker; writes the run folder if there is one."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        exchange: str,
        folder: Path | None = None,
        exact_every: int | None = None,
        monotonic: Callable[[], float] = time.monotonic,
        speed: float = 1.0,
        past: Past | None = None,
    ) -> None:
        """folder: an existing folder for the run's files; None keeps nothing. exact_every: see Metrics.

        speed: wall, simulated seconds in a real one. past: what the folder has of this run already.
        """
        self._reader = Reader()
        survey = Survey(self._reader) if scenario.mapping else None
        self.metrics = metrics_of(scenario, exact_every, self._reader, survey)
        self.checker = Checker(self._reader, survey, virtual=exchange != "wall")
        self.payload = b""
        """The last record, encoded."""
        self.refused_at_door = 0
        """Messages to world-sim that it could not take in; whoever runs the bus counts them."""
        self.excess: dict[ParticipantId, Excess] = {}
        """What it did not listen to, by participant; likewise."""
        self._scenario = scenario
        self._seed = seed
        self._exchange = exchange
        self._folder = folder
        self._monotonic = monotonic
        self._started = monotonic()
        self._rows = 0
        self._table: _Table | None = None
        self.run = secrets.token_hex(8) if past is None else past.terms.run
        """Names the run."""
        if folder is not None and past is not None:
            resumed = past.manifest.get("resumed", 0) + 1
            self._manifest = past.manifest | {"resumed": resumed}
        elif folder is not None:
            _write_text(folder / SCENARIO, to_toml(scenario))
            self._manifest = _manifest(scenario, seed, exchange)
            self._manifest |= {"run": self.run, "speed": speed, "exact_every": exact_every}
        if folder is not None:
            _write_json(folder / MANIFEST, self._manifest)
            self._table = _Table(folder / METRICS, self.metrics.columns)
        self.journal = Journal(None if folder is None else folder / JOURNAL, anew=past is not None)
        if past is not None:
            self._follow(past.records)

    def _follow(self, records: Iterable[Record]) -> None:
        """Catch up. The old journal is there until all of it is in the new one."""
        for record in records:
            self.take(record)
        self.journal.replace()

    def take(self, record: Record) -> None:
        """Follow one record."""
        self.payload = self._reader.read(record)[0]
        self.journal.take(record, self.payload)
        self.metrics.take(record)
        self.checker.take(record)
        if len(self.metrics.rows) > self._rows:
            self._write_rows()

    def _write_rows(self) -> None:
        for row in self.metrics.rows[self._rows :]:
            self.journal.take_row(row)
            self.checker.take_row(row)
            if self._table is not None:
                self._table.add(row)
        self._rows = len(self.metrics.rows)

    def finish(self) -> Result:
        """Close the files and sum up."""
        self.journal.close()
        if self._table is not None:
            self._table.close()
        result = self.metrics.result(
            exchange=self._exchange,
            digest=self.journal.digest.hex,
            wall_s=self._monotonic() - self._started,
            refused_at_door=self.refused_at_door,
            excess=self.excess,
            record=self.journal.cut or "whole",
            complaints=tuple(self.checker.complaints),
        )
        if self._folder is not None:
            self._manifest |= {
                "digest": result.digest,
                "records": self.journal.digest.records,
                "record": result.record,
                "ended": result.ended,
                "absences": result.absences,
                "journal_blake2b": file_digest(self._folder / JOURNAL),
            }
            _write_json(self._folder / MANIFEST, self._manifest)
            _write_text(
                self._folder / RESULT,
                msgspec.json.format(msgspec.json.encode(result), indent=2).decode() + "\n",
            )
        return result


class _Table:
    """metrics.csv, written as the run goes; a full disk ends it quietly, the journal says so."""

    def __init__(self, path: Path, columns: tuple[str, ...]) -> None:
        self._file: IO[str] | None = None
        try:
            self._file = path.open("w", newline="", encoding="utf-8", buffering=1)
            self._writer = csv.writer(self._file)
            self._writer.writerow(columns)
        except OSError:
            self.close()

    def add(self, row: tuple[Any, ...]) -> None:
        if self._file is None:
            return
        try:
            self._writer.writerow("" if value is None else value for value in row)
        except OSError:
            self.close()

    def close(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()


def _manifest(scenario: Scenario, seed: int, exchange: str) -> dict[str, Any]:
    libraries = ("kantor", "eclipse-zenoh", "numpy", "scipy", "numba", "msgspec", "mcap")
    return {
        "format": 1,
        "scenario": scenario.name,
        "seed": seed,
        "exchange": exchange,
        "started_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {
            "python": platform.python_version(),
            "platform": platform.platform(),
            **{name: version(name) for name in libraries},
        },
    }


def _write_json(path: Path, tree: dict[str, Any]) -> None:
    _write_text(path, json.dumps(tree, indent=2) + "\n")


def _write_text(path: Path, text: str) -> None:
    """Replace a file whole, so that nobody ever reads half of it; a full disk leaves the old one."""
    draft = path.with_name(f".{path.name}.draft")
    try:
        draft.write_text(text, encoding="utf-8")
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
