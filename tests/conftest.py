"""The tiers of the tests, the order in which groups start, and the `kantor` command as a fixture."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import settings

from support.limits import EVENT_LIMIT_S
from support.tiers import LONGEST_FIRST, tier_of

settings.register_profile("kantor", deadline=None, print_blob=True)
settings.register_profile("fast", settings.get_profile("kantor"), max_examples=10)
settings.load_profile("kantor")


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--rewrite` brings the transcripts up to date."""
    parser.addoption("--rewrite", action="store_true", help="rewrite transcripts of robots")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test with its tier, and start the tiers with long tests first."""
    tiers = {item: tier_of(item) for item in items}
    for item, tier in tiers.items():
        if item.get_closest_marker(tier) is None:
            item.add_marker(tier)
    items.sort(key=lambda item: LONGEST_FIRST.index(tiers[item]))


class Finished(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


class Kantor:
    """Runs the kantor command in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._started: list[subprocess.Popen[str]] = []

    def __call__(self, *arguments: object, **environment: str) -> Finished:
        """Run to the end."""
        process = self.start(*arguments, **environment)
        out, err = process.communicate(timeout=EVENT_LIMIT_S)
        return Finished(process.returncode, out, err)

    def start(self, *arguments: object, **environment: str) -> subprocess.Popen[str]:
        """Start and go on."""
        process = subprocess.Popen(
            [sys.executable, "-m", "kantor_fleet", *map(str, arguments)],
            cwd=self.folder,
            env=os.environ | {"NO_COLOR": "1", "COLUMNS": "120"} | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._started.append(process)
        return process

    def runs(self) -> list[Path]:
        """The run folders that commands left, oldest first."""
        return sorted((self.folder / "runs").glob("*"))

    def stop_all(self) -> None:
        """End whatever is left, with all that it started."""
        for process in self._started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate(timeout=EVENT_LIMIT_S)


@pytest.fixture
def kantor(tmp_path: Path) -> Iterator[Kantor]:
    """The kantor command."""
    command = Kantor(tmp_path)
    yield command
    command.stop_all()
