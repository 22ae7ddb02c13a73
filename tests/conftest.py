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

settings.register_profile("kantor", deadline=None, print_blob=True)
settings.register_profile("fast", settings.get_profile("kantor"), max_examples=25)
settings.load_profile("kantor")

TESTS = Path(__file__).parent
TIERS = ("unit", "processes", "papers", "campaign", "containers", "fuzz")
TIER_OF_PLACE = {
    **dict.fromkeys(("agent", "fleet", "protocol", "supervisor", "worldsim"), "unit"),
    **{tier: tier for tier in TIERS[1:]},
    "fleet/test_report.py": "processes",
    "fleet/test_report_of_maps.py": "processes",
    "fleet/test_reproduce.py": "papers",
    "fleet/test_reproduce_maps.py": "papers",
    "fleet/test_reproduce_resilience.py": "papers",
    "test_architecture.py": "unit",
    "test_digests.py": "processes",
    "test_readme.py": "processes",
    "test_tiers.py": "unit",
}
"""The tier of a folder or file of this folder; the longest path counts, and a mark of the test above all."""
LONGEST_FIRST = ("containers", "papers", "processes", "campaign", "fuzz", "unit")
"""Tiers in the order in which they start: a long test that starts last leaves the other worker idle."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--rewrite` brings the transcripts up to date."""
    parser.addoption("--rewrite", action="store_true", help="rewrite transcripts of robots")


def tier_of(item: pytest.Item) -> str:
    """The tier of a test: its own mark, `processes` if it runs the command, or that of its place."""
    own = [mark.name for mark in item.iter_markers() if mark.name in TIERS]
    if len(own) > 1:
        raise pytest.UsageError(f"{item.nodeid}: several tiers: {', '.join(own)}; keep one")
    if own:
        return own[0]
    path = item.path.relative_to(TESTS)
    places = [place.as_posix() for place in (path, *path.parents)]
    tier = next((TIER_OF_PLACE[place] for place in places if place in TIER_OF_PLACE), None)
    if tier is None:
        raise pytest.UsageError(f"{item.nodeid}: no tier; add {path} to tests/conftest.py")
    return "processes" if tier == "unit" and "kantor" in item.fixturenames else tier


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
