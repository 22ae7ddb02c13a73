"""runs.jsonl: every finished run of a sweep, written as soon as it is finished.

The first line names the format and the version of kantor; every other line is a run. Lines are only ever added.
A line that was torn, because the machine went down, is dropped.
"""

import fcntl
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec

from kantor_fleet.execution.experiment import Outcome
from kantor_fleet.sweep.plan import RunKey, SweepError

_FORMAT = 1
_UNREADABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


class _Header(msgspec.Struct, frozen=True):
    format: int
    kantor: str


class _RunLine(msgspec.Struct, frozen=True):
    scenario: str
    code: str
    seed: int
    exact: bool
    outcome: msgspec.Raw


class RunsJournal:
    """Outcomes of runs, in memory and on disk; one process writes at a time."""

    def __init__(self, path: Path, kind: type[Outcome] = Outcome) -> None:
        """Read the file, or begin one. kind: the type of the outcomes. Raises SweepError, OSError."""
        self._kind = kind
        self.outcomes: dict[RunKey, Outcome] = {}
        """The outcome that was added last under each key."""
        self._path = path
        self._header = _Header(_FORMAT, version("kantor"))
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a+b")
        try:
            self._lock()
            self._recover()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._file.close()

    def add(self, key: RunKey, outcome: Outcome) -> None:
        """Add a run. It has been handed to the operating system when this returns."""
        self._write(_RunLine(*key, msgspec.Raw(msgspec.json.encode(outcome))))
        self.outcomes[key] = outcome

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SweepError(
                f"{self._path}: another sweep writes here; wait for it, or give another --out"
            ) from None

    def _recover(self) -> None:
        self._file.seek(0)
        text = self._file.read()
        whole, _, torn = text.rpartition(b"\n")
        first, *lines = whole.splitlines() or [torn]
        if whole:
            self._check(first)
            for number, line in enumerate(lines, 2):
                self._restore(number, line)
            self._file.truncate(len(text) - len(torn))
        elif (msgspec.json.encode(self._header) + b"\n").startswith(torn):
            self._file.truncate(0)
            self._write(self._header)
        else:
            self._check(first)

    def _check(self, first: bytes) -> None:
        try:
            header = msgspec.json.decode(first, type=_Header)
        except _UNREADABLE:
            raise SweepError(f"{self._path}: no journal of a sweep; give another --out") from None
        if header != self._header:
            raise SweepError(
                f"{self._path}: written by kantor {header.kantor}, this is "
                f"{self._header.kantor}; give another --out, or remove the file"
            )

    def _restore(self, number: int, line: bytes) -> None:
        try:
            run = msgspec.json.decode(line, type=_RunLine)
            outcome = msgspec.json.decode(run.outcome, type=self._kind)
        except _UNREADABLE as error:
            raise SweepError(
                f"{self._path}: line {number} is no run ({error}); remove it"
            ) from None
        self.outcomes[RunKey(run.scenario, run.code, run.seed, run.exact)] = outcome

    def _write(self, line: _Header | _RunLine) -> None:
        self._file.write(msgspec.json.encode(line) + b"\n")
        self._file.flush()
