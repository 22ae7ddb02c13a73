"""What processes hold in memory while a campaign goes on, read from /proc once a second."""

import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from kantor_fleet.processes.local import Fleet
from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM

WARM_UP_PERIODS = 100
"""A process's memory counts from then on in its life."""
LONG_PERIODS = 150
"""A life that goes on for so long then tells whether memory is flat."""
FLAT_MB = 4.0
"""So much may a kind of process grow over a thousand periods, all its lives together: its logs do."""
SETTLED = 3
"""Missions after which what outlives missions is warm."""
FLAT_LASTING_MB = 20.0
"""So much may the campaign itself, or its fork server, grow from then on."""
_EVERY_S = 1.0
_MB = 1e6
_PROC = Path("/proc")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_KINDS = {SUPERVISOR: "supervisor", WORLD_SIM: "world-sim"}


class Grown(NamedTuple):
    """How a kind of process has grown, over all long lives."""

    lives: int = 0
    periods: int = 0
    """Of those lives, after warming up."""
    grown_mb: float = 0.0
    """Of all lives together."""
    most_mb: float = 0.0
    """In one life."""
    peak_mb: float = 0.0
    """The largest there was."""

    def __add__(self, other: "Grown") -> "Grown":  # type: ignore[override]
        return Grown(
            self.lives + other.lives,
            self.periods + other.periods,
            self.grown_mb + other.grown_mb,
            max(self.most_mb, other.most_mb),
            max(self.peak_mb, other.peak_mb),
        )

    @property
    def mb_per_1000(self) -> float:
        """Over a thousand periods."""
        return 1000.0 * self.grown_mb / self.periods if self.periods else 0.0


class _Life(NamedTuple):
    kind: str
    since: int
    """Periods of the mission."""
    samples: list[tuple[int, float]]
    """Periods of the mission, and megabytes."""

    @property
    def warm(self) -> list[tuple[int, float]]:
        """Samples that count. The last may be of a process that was just then torn down."""
        return [sample for sample in self.samples[:-1] if sample[0] >= self.since + WARM_UP_PERIODS]


class RssMonitor:
    """Samples the processes of one fleet."""

    def __init__(self, fleet: Fleet) -> None:
        """Look at it now and then."""
        self._fleet = fleet
        self._lives: dict[int, _Life] = {}
        self._due_s = 0.0

    def look(self, periods: int) -> None:
        """Sample everybody, if it is time. periods: of the mission so far."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _EVERY_S
        for name, pid in self._pids().items():
            mb = resident_mb(pid)
            if mb is not None:
                life = self._lives.setdefault(pid, _Life(_KINDS.get(name, "robot"), periods, []))
                life.samples.append((periods, mb))

    def _pids(self) -> Mapping[str, int]:
        fleet = self._fleet
        processes = {WORLD_SIM: fleet.world_sim, **fleet.participants}
        return {name: process.pid for name, process in processes.items() if process.pid}

    def grown(self) -> dict[str, Grown]:
        """By kind of process."""
        total: dict[str, Grown] = {}
        for life in self._lives.values():
            warm = life.warm
            if warm and warm[-1][0] - warm[0][0] >= LONG_PERIODS:
                grown_mb, peak_mb = warm[-1][1] - warm[0][1], max(mb for _, mb in warm)
                one = Grown(1, warm[-1][0] - warm[0][0], grown_mb, grown_mb, peak_mb)
                total[life.kind] = total.get(life.kind, Grown()) + one
        return total


class Lasting:
    """What the processes that outlive missions hold: this one, and the fork server."""

    def __init__(self) -> None:
        self._samples: list[tuple[float, float]] = []

    def look(self) -> None:
        """Sample them; once after each mission."""
        ours = resident_mb(os.getpid()) or 0.0
        children = [resident_mb(pid) or 0.0 for pid in children_of(os.getpid())]
        self._samples.append((ours, max(children, default=0.0)))

    @property
    def grown_mb(self) -> tuple[float, float] | None:
        """The campaign's own growth since it was warm, and the fork server's."""
        if len(self._samples) <= SETTLED:
            return None
        (ours, server), (ours_now, server_now) = self._samples[SETTLED - 1], self._samples[-1]
        return ours_now - ours, server_now - server


def resident_mb(pid: int) -> float | None:
    """Megabytes in memory; None for a process that is not there."""
    try:
        return int((_PROC / str(pid) / "statm").read_text().split()[1]) * _PAGE_BYTES / _MB
    except (OSError, IndexError):
        return None


def children_of(pid: int) -> Iterator[int]:
    """Processes that a process has started, and are there yet."""
    for stat in _PROC.glob("[0-9]*/stat"):
        try:
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
        except OSError:
            continue
        if int(parent) == pid and state != "Z":
            yield int(stat.parent.name)


def grandchildren() -> list[int]:
    """Processes of fleets: what the fork server has started."""
    return [pid for child in children_of(os.getpid()) for pid in children_of(child)]
