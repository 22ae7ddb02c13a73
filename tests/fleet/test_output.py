"""Standard output that cannot be written: closed, full, or with no one to read it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

MISSION = (
    *("fleet", "--exchange", "in-process", "--set", "limit_s=0.4", "robots.count=1"),
    "starts.random=true",
)
SWEEP = (
    *("sweep", "paper-single", "--seeds", "0:1", "--jobs", "1", "--set", "limit_s=0.4"),
    *("energy.points=100", "samples.count=50"),
)

pytestmark = pytest.mark.processes


def ended(folder: Path, shell: str, *words: str) -> tuple[int, list[str]]:
    """The exit code and the lines on standard error of a command whose output a shell redirects."""
    command = " ".join([sys.executable, "-m", "kantor_fleet", *words, shell])
    finished = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"],
        cwd=folder, env=os.environ | {"NO_COLOR": "1", "COLUMNS": "120"}, stderr=subprocess.PIPE, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, check=False,
    )  # fmt: skip
    return finished.returncode, finished.stderr.splitlines()


LOST = {
    ">&-": "kantor: warning: standard output: it is closed; what was printed is lost",
    "> /dev/full": "kantor: warning: standard output: No space left on device; what was printed is lost",
}


@pytest.mark.parametrize("shell", LOST)
@pytest.mark.parametrize(
    ("words", "code"), [(("run", *MISSION), 1), (SWEEP, 0)], ids=["run", "sweep"]
)
def test_a_mission_goes_on_without_output(
    tmp_path: Path, shell: str, words: tuple[str, ...], code: int
) -> None:
    """Its record is whole and its exit code that of the mission; one line says what was lost."""
    assert ended(tmp_path, shell, *words) == (code, [LOST[shell]])
    results = [*tmp_path.glob("runs/*/report.png"), *tmp_path.glob("sweeps/*/table.csv")]
    assert len(results) == 1


@pytest.mark.parametrize("shell", LOST)
@pytest.mark.parametrize("words", [("--help",), ("run", "--help"), ("scenarios", "show", "fleet")])
def test_a_command_that_only_prints_has_failed(
    tmp_path: Path, shell: str, words: tuple[str, ...]
) -> None:
    """One line, and exit code 2."""
    assert ended(tmp_path, shell, *words) == (2, [LOST[shell]])


def test_a_reader_that_has_enough_is_no_error(tmp_path: Path) -> None:
    """As `head`: nothing is said; a mission goes on to its end all the same."""
    assert ended(tmp_path, "| head -c 1", "scenarios", "show", "fleet") == (0, [])
    assert ended(tmp_path, "| head -c 0", "run", *MISSION) == (1, [])
    assert len([*tmp_path.glob("runs/*/report.png")]) == 1


def test_a_closed_descriptor_is_no_place_for_a_file(tmp_path: Path) -> None:
    """With all three closed, what the command says does not end up in its own files."""
    assert ended(tmp_path, "<&- >&- 2>&-", "run", *MISSION) == (1, [])
    (folder,) = tmp_path.glob("runs/*")
    assert ended(tmp_path, "", "verify", str(folder)) == (0, [])


def test_an_error_without_standard_error_keeps_its_code(tmp_path: Path) -> None:
    """Neither in the output nor as another exit code."""
    assert ended(tmp_path, "2>&-", "run", "nowhere") == (2, [])
    assert ended(tmp_path, "2> /dev/full", "run", "nowhere") == (2, [])
