"""Growth of time, bytes and memory with the size of a mission, each run by a command of its own.

The robots of a team of any size have equally many neighbours: the range falls with the root of their number. Memory is
the largest resident set of a process of the run, the interpreter and its libraries included.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from kantor_command import Ran, run_command
from tables import Table, verdict

SPEED_KEPT = 0.8
"""Robot-steps a second of a thousand robots over those of a hundred with as many neighbours."""


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
    ran = {size.name: _run(size.command) for size in SIZES if size.quick or not quick}
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
        few, many = ran["100 robots"].steps_per_s, ran["1,000 robots"].steps_per_s
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
        f"{ran.result['wall_s']:.1f}",
        f"{ran.steps_per_s:,.0f}",
        f"{ran.air_bytes:.1f}",
        f"{ran.weight_bytes:.2f}",
        f"{ran.peak_bytes / 1e9:.2f}",
        ", ".join(limit.shown(ran) for limit in size.limits),
    )


def _run(command: str) -> Ran:
    with tempfile.TemporaryDirectory() as folder:
        return run_command(f"run {command}", Path(folder))
