"""Growth of time, bytes and memory with the size of a mission, each run by a command of its own.

The robots of a team of any size have equally many neighbours: the range falls with the root of their number. Memory is
the largest resident set of a process of the run, the interpreter and its libraries included.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from tables import Table, verdict

SPEED_KEPT = 0.8
"""Robot-steps a second of a thousand robots over those of a hundred with as many neighbours."""


class Ran(NamedTuple):
    """What a mission took, with all its processes."""

    wall_s: float
    """Of the mission's own loop."""
    cpu_s: float
    """Of the whole command."""
    peak_bytes: float
    result: dict[str, Any]

    @property
    def steps(self) -> int:
        """Steps of robots."""
        return int(self.result["ticks"] * self.result["robots"])

    @property
    def air_bytes(self) -> float:
        """On the air, per robot and tick."""
        return float(self.result["bytes_per_robot_tick"]["total"])

    @property
    def weight_bytes(self) -> float:
        """On the weights key, per robot and tick."""
        return float(self.result["bytes_per_robot_tick"]["weights"])


class Limit(NamedTuple):
    """A target of a run."""

    of: Callable[[Ran], float]
    most: float
    unit: str

    def shown(self, ran: Ran) -> str:
        """The target and whether it is met."""
        return f"<= {self.most:g} {self.unit} {verdict(met=self.of(ran) <= self.most)}"


class Size(NamedTuple):
    """A mission of some size."""

    name: str
    command: str
    limits: tuple[Limit, ...] = ()
    quick: bool = False
    """Whether it is run when there is little time."""


_TEAM = "--exchange in-process --set starts.random=true samples.count=20000 energy.steps=150"
_FLEET = "--exchange in-process --set limit_s=20"


def _air(most: float) -> Limit:
    return Limit(lambda ran: ran.air_bytes, most, "B")


def _weights(most: float) -> Limit:
    return Limit(lambda ran: ran.weight_bytes, most, "B of weights")


def _memory(most_gb: float) -> Limit:
    return Limit(lambda ran: ran.peak_bytes / 1e9, most_gb, "GB")


SIZES = (
    Size("5 robots", f"fleet {_TEAM} radio.range_m=447.2", (_air(80.0),), quick=True),
    Size(
        "100 robots",
        f"fleet {_TEAM} radio.range_m=100 robots.count=100",
        (_air(130.0), _memory(0.4)),
        quick=True,
    ),
    Size(
        "1,000 robots",
        f"fleet {_TEAM} radio.range_m=31.62 robots.count=1000",
        (_air(160.0), _memory(1.5)),
    ),
    Size(
        "300 robot processes",
        "fleet --exchange lockstep --set starts.random=true robots.count=300 radio.range_m=57.7 limit_s=5",
    ),
    Size("2,000 samples", f"fleet {_FLEET}", (_weights(8.0),), quick=True),
    Size("1,000,000 samples", f"fleet {_FLEET} samples.count=1000000", (_weights(8.0),)),
    Size(
        "a day at 1 Hz",
        "fleet --exchange in-process --set limit_s=86400 linger_s=86400 clock.period_s=1",
    ),
)


def measure(*, quick: bool) -> Table:
    """Each mission once: bytes and memory are the same every time."""
    ran = {size.name: run(size.command) for size in SIZES if size.quick or not quick}
    rows = [_row(size, ran[size.name]) for size in SIZES if size.name in ran]
    met = all(
        limit.of(ran[s.name]) <= limit.most for s in SIZES if s.name in ran for limit in s.limits
    )
    head = (
        "mission",
        "robot-steps",
        "wall s",
        "robot-steps/s",
        "B a robot and tick",
        "of weights",
        "GB",
        "targets",
    )
    notes: tuple[str, ...] = ()
    if "1,000 robots" in ran:
        few, many = (each.steps / each.wall_s for each in (ran["100 robots"], ran["1,000 robots"]))
        grown = many / few >= SPEED_KEPT
        met = met and grown
        notes = (
            f"speed of 1,000 robots over 100: {many / few:.2f} of >= {SPEED_KEPT:g} {verdict(met=grown)}",
        )
    return Table("scale: growth with the size of a mission", head, rows, notes, met)


def _row(size: Size, ran: Ran) -> tuple[str, ...]:
    return (
        size.name,
        f"{ran.steps:,}",
        f"{ran.wall_s:.1f}",
        f"{ran.steps / ran.wall_s:,.0f}",
        f"{ran.air_bytes:.1f}",
        f"{ran.weight_bytes:.2f}",
        f"{ran.peak_bytes / 1e9:.2f}",
        ", ".join(limit.shown(ran) for limit in size.limits),
    )


def run(command: str) -> Ran:
    """Run a mission by `kantor run`. Ends this program if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        kantor = [sys.executable, "-m", "kantor_fleet", "run", *command.split()]
        process = subprocess.Popen(
            kantor, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert process.stdout is not None
        told = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in {0, 1}:  # 1: a mission that its limit has cut
            sys.exit(f"kantor run {command}: {told.decode(errors='replace')[-2000:]}")
        (path,) = Path(folder).glob("runs/*/result.json")
        result = json.loads(path.read_text(encoding="utf-8"))
    return Ran(result["wall_s"], used.ru_utime + used.ru_stime, used.ru_maxrss * 1024, result)
