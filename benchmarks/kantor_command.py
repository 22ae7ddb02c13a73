"""A kantor command as a user types it, and what it takes with all processes that it starts."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

INSTALLED = (sys.executable, "-m", "kantor_fleet")
"""The command of this environment."""


class Ran(NamedTuple):
    """What a command took."""

    wall_s: float
    cpu_s: float
    peak_bytes: float
    """Resident set of the largest process."""
    result: dict[str, Any]
    """Its result.json; empty if it leaves none."""

    @property
    def steps(self) -> int:
        """Steps of robots."""
        return int(self.result["ticks"] * self.result["robots"])

    @property
    def steps_per_s(self) -> float:
        """Steps of robots in a second of the mission's own loop."""
        return self.steps / float(self.result["wall_s"])

    @property
    def air_bytes(self) -> float:
        """On the air, for a robot in a tick."""
        return float(self.result["bytes_per_robot_tick"]["total"])

    @property
    def weight_bytes(self) -> float:
        """On the weights key, for a robot in a tick."""
        return float(self.result["bytes_per_robot_tick"]["weights"])


def run_command(
    arguments: str,
    folder: Path,
    kantor: Sequence[str] = INSTALLED,
    environment: Mapping[str, str] | None = None,
) -> Ran:
    """Run `kantor ARGUMENTS` in a folder without runs. Ends this program if it fails."""
    begun_s = time.monotonic()
    process = subprocess.Popen(
        [*kantor, *arguments.split()],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert process.stdout is not None
    told = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.monotonic() - begun_s
    if process.returncode not in {0, 1}:  # 1: a mission that is cut by its limit
        print(told.decode(errors="replace")[-2000:], file=sys.stderr)
        sys.exit(f"{kantor[0]} {arguments}: exit code {process.returncode}")
    results = list(folder.glob("runs/*/result.json"))
    result = json.loads(results[0].read_text(encoding="utf-8")) if results else {}
    return Ran(wall_s, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024, result)
