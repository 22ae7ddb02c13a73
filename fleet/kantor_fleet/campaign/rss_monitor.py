"""Memory of processes while a campaign runs, read from /proc once a second."""

import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from kantor_fleet.processes.local import Fleet
from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM

WARM_UP_PERIODS = 100
"""Periods after a process's start from which on its memory counts."""
LONG_PERIODS = 150
"""Periods, after warming up, from which on a process shows whether its memory is flat."""
FLAT_MB = 4.0
"""The growth that a kind of process may have in a thousand periods, all its processes together: its logs grow."""
SETTLED = 3
"""Missions after which the processes that outlive missions are warm."""
FLAT_LASTING_MB = 20.0
"""The growth that the campaign itself, or its fork server, may have from then on."""
_EVERY_S = 1.0
_MB = 1e6
_PROC = Path("/proc")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_KINDS = {SUPERVISOR: "supervisor", WORLD_SIM: "world-sim"}


class Grown(NamedTuple):
    """The growth of one kind of process, over all that ran for long."""

    processes: int = 0
    periods: int = 0
    """Of those processes, after warming up."""
    grown_mb: float = 0.0
    """Of all processes together."""
    most_mb: float = 0.0
    """Of one process."""
    peak_mb: float = 0.0
    """The largest of any process."""

    def __add__(self, other: "Grown") -> "Grown":  # type: ignore[override]
        return Grown(
            self.processes + other.processes,
            self.periods + other.periods,
            self.grown_mb + other.grown_mb,
            max(self.most_mb, other.most_mb),
            max(self.peak_mb, other.peak_mb),
        )

    @property
    def mb_per_1000(self) -> float:
        """Over a thousand periods."""
        return 1000.0 * self.grown_mb / self.periods if self.periods else 0.0


class _ProcessMemory(NamedTuple):
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
        self._fleet = fleet
        self._processes: dict[int, _ProcessMemory] = {}
        self._due_s = 0.0

    def sample(self, periods: int) -> None:
        """Sample every process, if it is time. periods: of the mission so far."""
        now_s = time.monotonic()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _EVERY_S
        for name, pid in self._pids().items():
            mb = resident_mb(pid)
            if mb is not None:
                memory = self._processes.setdefault(
                    pid, _ProcessMemory(_KINDS.get(name, "robot"), periods, [])
                )
                memory.samples.append((periods, mb))

    def _pids(self) -> Mapping[str, int]:
        fleet = self._fleet
        processes = {WORLD_SIM: fleet.world_sim, **fleet.participants}
        return {name: process.pid for name, process in processes.items() if process.pid}

    def grown(self) -> dict[str, Grown]:
        """By kind of process."""
        total: dict[str, Grown] = {}
        for memory in self._processes.values():
            warm = memory.warm
            if warm and warm[-1][0] - warm[0][0] >= LONG_PERIODS:
                grown_mb, peak_mb = warm[-1][1] - warm[0][1], max(mb for _, mb in warm)
                one = Grown(1, warm[-1][0] - warm[0][0], grown_mb, grown_mb, peak_mb)
                total[memory.kind] = total.get(memory.kind, Grown()) + one
        return total


class Lasting:
    """Samples the processes that outlive missions: this one, and the fork server."""

    def __init__(self) -> None:
        self._samples: list[tuple[float, float]] = []

    def sample(self) -> None:
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
    """Processes that a process has started and that still run."""
    for stat in _PROC.glob("[0-9]*/stat"):
        try:
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
        except OSError:
            continue
        if int(parent) == pid and state != "Z":
            yield int(stat.parent.name)


def grandchildren() -> list[int]:
    """Processes of fleets, which the fork server has started."""
    return [pid for child in children_of(os.getpid()) for pid in children_of(child)]
