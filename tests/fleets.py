"""What tests ask of a fleet of processes."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

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
