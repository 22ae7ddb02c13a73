"""The folder of a run: its files, and the contents of one whose run was cut short."""

import contextlib
import csv
import errno
import fcntl
import json
import os
import platform
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from multiprocessing import reduction
from pathlib import Path
from typing import IO, Annotated, Any, Literal, NamedTuple, Self

import msgspec

from kantor_protocol.files.reading import read_text
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.storage.drafts import replace
from kantor_protocol.wire.attestations import Identities
from kantor_protocol.wire.messages import RefusedError
from kantor_worldsim.record import behaviour
from kantor_worldsim.record.journal import read
from kantor_worldsim.record.records import Ending, Opening, Record

JOURNAL = "run.mcap"
MANIFEST = "manifest.json"
RESULT = "result.json"
SCENARIO = "scenario.toml"
METRICS = "metrics.csv"
REPORT = "report.png"
_FORMAT = 1
"""Of the folder, in its manifest."""


def folder_for(
    scenario: Scenario,
    seed: int,
    below: Path,
    announce: Callable[[Path], None] = lambda _folder: None,
) -> Path:
    """Create `<UTC>_<scenario>_s<seed>` below a folder; a number is added if it exists.

    announce: called with the folder before it is there, so that its maker can be killed at any moment.
    """
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}_{scenario.name}_s{seed}"
    for attempt in range(1000):
        folder = below / (stem if not attempt else f"{stem}_{attempt}")
        announce(folder)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{below / stem}: a thousand runs in one second")


class ResumeError(ValueError):
    """A run folder from which no mission can go on; the message is one line with the remedy."""


class OverError(ResumeError):
    """The mission has come to its end, and its files are whole."""


class InUseError(ResumeError):
    """A run folder that another process writes."""


class FolderLock:
    """The right to write a run folder: of one process at a time, and of those that it starts with this.

    It ends with the last process that has it, however that ends. Where a file system has no locks it excludes no one.
    """

    def __init__(self, folder: Path) -> None:
        """Raises InUseError, and ResumeError if there is no such folder."""
        try:
            self._descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise ResumeError(
                f"{folder}: no run to go on with ({error.strerror}); give its folder"
            ) from None
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise InUseError(
                f"{folder}: another process runs this mission; wait for its end, or end it"
            ) from None
        except OSError as error:
            if error.errno not in {errno.EBADF, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}:
                raise

    @classmethod
    def _inherited(cls, descriptor: Any) -> "FolderLock":
        lock = cls.__new__(cls)
        lock._descriptor = descriptor.detach()  # noqa: SLF001
        return lock

    def __reduce__(self) -> Any:
        """For a process that is being started."""
        return FolderLock._inherited, (reduction.DupFd(self._descriptor),)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.release()

    def release(self) -> None:
        """Give it up."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def is_empty(folder: Path) -> bool:
    """Whether nothing has happened in the run of a folder: not even its opening is on record."""
    try:
        return next(read(folder / JOURNAL), None) is None
    except OSError:
        return True


def remove_if_empty(folder: Path) -> bool:
    """Remove the folder of a run in which nothing has happened; whether it has been removed."""
    if not is_empty(folder):
        return False
    shutil.rmtree(folder, ignore_errors=True)
    return not folder.exists()


Exchange = Literal["in-process", "lockstep", "wall"]


class Terms(msgspec.Struct, frozen=True):
    """Settings of a run, as in its manifest."""

    run: Annotated[str, msgspec.Meta(min_length=1, max_length=64)]
    """Name of the run."""
    exchange: Exchange
    speed: Annotated[float, msgspec.Meta(gt=0.0, le=1000.0)]
    exact_every: Annotated[int, msgspec.Meta(ge=0)] | None = None
    resumed: Annotated[int, msgspec.Meta(ge=0, le=1 << 30)] = 0
    """Number of times that it was resumed."""


class Manifest(msgspec.Struct, frozen=True):
    """A manifest, as far as it is needed to verify a run."""

    format: Literal[1]
    exchange: Exchange
    behaviour: Annotated[int, msgspec.Meta(ge=1)] = behaviour.FIRST
    digest: str | None = None
    """None while the run goes on, and when it was killed."""
    records: int | None = None
    record: str | None = None
    """`whole`, or where it was cut."""
    journal_blake2b: str | None = None


class Past(NamedTuple):
    """Contents of the folder of a run that was cut short."""

    terms: Terms
    opening: Opening
    records: tuple[Record, ...]
    """The opening and all that followed, without an ending."""
    manifest: dict[str, Any]

    @classmethod
    def of(cls, folder: Path) -> "Past":
        """Read a run folder. Raises ResumeError; OverError if the mission has come to its end."""
        try:
            manifest = json.loads(read_text(folder / MANIFEST))
            records = [record for _, record in read(folder / JOURNAL)]
            terms = msgspec.convert(manifest, Terms)
        except msgspec.ValidationError as error:
            raise ResumeError(f"{folder / MANIFEST}: of another version: {error}") from None
        except (OSError, ValueError, RecursionError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            raise ResumeError(
                f"{folder}: no run to go on with ({reason}); give its folder"
            ) from None
        if not records or not isinstance(records[0], Opening):
            raise ResumeError(f"{folder / JOURNAL}: nothing has happened in it; start the run anew")
        try:
            records[0].check()
        except (RefusedError, ScenarioError) as error:
            raise ResumeError(f"{folder / JOURNAL}: no run can start from it: {error}") from None
        past = cls(terms, records[0], tuple(records), manifest)
        if records[0].scenario.signed and past.identities is None:
            raise ResumeError(f"{folder / JOURNAL}: nothing has happened in it; start the run anew")
        last = records[-1]
        if isinstance(last, Ending):
            if "digest" in manifest and last.reason != "interrupted":
                raise OverError(f"{folder}: its mission is over ({last.reason})")
            past = past._replace(records=past.records[:-1])
        return past

    @property
    def identities(self) -> Identities | None:
        """Whose word counts in this run; None with `trust = "open"`."""
        return next((each for each in self.records[1:2] if isinstance(each, Identities)), None)


class MetricsFile:
    """metrics.csv, written as the run goes; a full disk ends it without an error, which the journal reports."""

    def __init__(self, path: Path, columns: tuple[str, ...]) -> None:
        self._file: IO[str] | None = None
        try:
            self._file = path.open("w", newline="", encoding="utf-8", buffering=1)
            self._writer = csv.writer(self._file)
            self._writer.writerow(columns)
        except OSError:
            self.close()

    def add(self, row: tuple[Any, ...]) -> None:
        """Append one row."""
        if self._file is None:
            return
        try:
            self._writer.writerow("" if value is None else value for value in row)
        except OSError:
            self.close()

    def close(self) -> None:
        """Close the file; more rows are ignored."""
        file, self._file = self._file, None
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()


def new_manifest(scenario: Scenario, seed: int, exchange: str) -> dict[str, Any]:
    """Manifest of a run that begins now."""
    libraries = ("kantor", "eclipse-zenoh", "numpy", "scipy", "numba", "msgspec", "mcap")
    return {
        "format": _FORMAT,
        "behaviour": behaviour.current(),
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


def write_json(path: Path, tree: dict[str, Any]) -> None:
    """Replace a file by a JSON tree; see `write_text`."""
    write_text(path, json.dumps(tree, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Replace a file atomically, so that no reader gets half of it; a full disk leaves the old one."""
    with contextlib.suppress(OSError):
        replace(path, lambda draft: draft.write_text(text, encoding="utf-8"))
