"""Commands that only print load nothing that takes long: by what they import, not by the clock."""

import subprocess
import sys

import pytest

HEAVY = {"numba", "numpy", "scipy", "zenoh", "matplotlib", "cryptography", "distributed"}


@pytest.mark.parametrize(
    "arguments",
    [
        ("--help",),
        ("run", "--help"),
        ("scenarios",),
        ("scenarios", "show", "office"),
        ("run", "--bad"),
    ],
    ids=" ".join,
)
def test_a_command_that_only_prints_imports_no_heavy_package(arguments: tuple[str, ...]) -> None:
    """Help, the list of scenarios and a usage error come at once."""
    script = (
        "import sys; from kantor_fleet.__main__ import main\n"
        "try: main()\n"
        "finally: print(*sys.modules, sep='\\n', file=sys.__stderr__)"
    )
    command = [sys.executable, "-c", script, *arguments]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)

    loaded = {line.split(".")[0] for line in finished.stderr.splitlines()}
    assert finished.returncode == (2 if "--bad" in arguments else 0)
    assert "kantor_fleet" in loaded
    assert not loaded & HEAVY
