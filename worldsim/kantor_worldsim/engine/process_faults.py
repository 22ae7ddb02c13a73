"""When the process faults of a scenario strike: a schedule of deeds, and who is idle meanwhile.

Whoever runs the mission does the deeds: the virtual loop to its crew, the wall's relay to real processes.
"""

from typing import Literal, NamedTuple

from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.scenario.faults.processes import (
    ClockFault,
    Disk,
    FullDisk,
    Impostor,
    Kill,
    Late,
    OnProcesses,
    Pause,
    Slow,
)
from kantor_protocol.scenario.schema import Scenario

_NEVER_NS = 2**63 - 1

What = Literal[
    "kill",
    "start",
    "pause",
    "resume",
    "fill",
    "free",
    "slow",
    "quicken",
    "skew",
    "right",
    "pretend",
]
_FIRST: dict[type[OnProcesses], What] = {
    Kill: "kill",
    Pause: "pause",
    FullDisk: "fill",
    Slow: "slow",
    ClockFault: "skew",
    Impostor: "pretend",
}
_LAST: dict[type[OnProcesses], What] = {
    Kill: "start",
    Late: "start",
    Pause: "resume",
    FullDisk: "free",
    Slow: "quicken",
    ClockFault: "right",
}


class ScheduledProcessFault(NamedTuple):
    """One thing that is done to one process."""

    at_ns: int
    fault: int
    """The place of its fault in the scenario's list."""
    who: ParticipantId
    what: What
    disk: Disk = "kept"
    """start: what is left of its snapshot."""
    mid_step: bool = False
    """kill: in its next step."""


def schedule_of(scenario: Scenario) -> list[ScheduledProcessFault]:
    """Everything that is done to processes in a mission, in order of time and of the list.

    At one moment what ends comes before what begins, so that a process can come and go; world-sim comes
    first and goes last, so that it sees what befalls the others.
    """
    deeds: list[ScheduledProcessFault] = []
    for index, fault in enumerate(scenario.faults):
        if not isinstance(fault, OnProcesses):
            continue
        disk = fault.disk if isinstance(fault, Kill) else "kept"
        mid_step = isinstance(fault, Kill) and fault.mid_step
        for who in fault.who:
            if first := _FIRST.get(type(fault)):
                deeds.append(
                    ScheduledProcessFault(fault.from_ns, index, who, first, disk, mid_step)
                )
            if (last := _LAST.get(type(fault))) and fault.until_ns is not None:
                deeds.append(
                    ScheduledProcessFault(fault.until_ns, index, who, last, disk, mid_step)
                )
    return sorted(deeds, key=_turn)


def _turn(deed: ScheduledProcessFault) -> tuple[int, bool, bool]:
    begins = deed.what in _FIRST.values()
    return deed.at_ns, begins, (deed.who == WORLD_SIM) == begins


class _Window(NamedTuple):
    """When a fault holds; a fault itself works that out anew each time."""

    from_ns: int
    until_ns: int
    every: int
    """It gets to one of so many steps; 0: to none."""
    fault: OnProcesses

    @classmethod
    def of(cls, fault: OnProcesses) -> "_Window":
        until_ns = _NEVER_NS if fault.until_ns is None else fault.until_ns
        return cls(fault.from_ns, until_ns, fault.every if isinstance(fault, Slow) else 0, fault)


class ProcessFaults:
    """The process faults of a scenario as time goes by."""

    def __init__(self, scenario: Scenario, done: int = 0) -> None:
        """done: so many deeds are done already."""
        self._deeds = schedule_of(scenario)[done:]
        self._period_ns = scenario.period_ns
        faults = [fault for fault in scenario.faults if isinstance(fault, OnProcesses)]
        names = (*scenario.roster, WORLD_SIM)
        windows = [_Window.of(fault) for fault in faults]
        self._stops = {
            name: [w for w in windows if w.fault.stops and {name, WORLD_SIM} & set(w.fault.who)]
            for name in names
        }
        self._deaths = {
            name: [w for w in windows if name in w.fault.who and _is_mid_step(w.fault)]
            for name in names
        }
        self.some_die_mid_step = any(self._deaths.values())
        """Whether anybody ever dies in a step."""
        struck = [w for w in windows if w.fault.stops or _is_mid_step(w.fault)]
        self._first_ns = min((w.from_ns for w in struck), default=_NEVER_NS)
        self._last_ns = max((w.until_ns for w in struck), default=0)
        self._clocks = {
            name: [fault for fault in faults if isinstance(fault, ClockFault) and name in fault.who]
            for name in names
        }

    @property
    def next_ns(self) -> int | None:
        """When the next deed is due."""
        return self._deeds[0].at_ns if self._deeds else None

    def pop(self) -> ScheduledProcessFault:
        """The next deed, handed out once."""
        return self._deeds.pop(0)

    def quiet(self, from_ns: int, to_ns: int) -> bool:
        """Whether nobody is idle and nobody dies in a step from one time to another, both included."""
        return to_ns < self._first_ns or from_ns >= self._last_ns

    def idle(self, name: ParticipantId, now_ns: int) -> bool:
        """Whether a participant takes no step now, because of its own or of world-sim's state."""
        for from_ns, until_ns, every, _ in self._stops[name]:
            if from_ns <= now_ns < until_ns and not (every and self._gets_to_it(now_ns, every)):
                return True
        return False

    def dies(self, name: ParticipantId, now_ns: int) -> bool:
        """Whether the next step of a participant is the one in which it dies, or was."""
        deaths = self._deaths[name]
        return bool(deaths) and any(death.from_ns <= now_ns < death.until_ns for death in deaths)

    def skew_ns(self, name: ParticipantId, now_ns: int) -> int:
        """How far the clock of a participant is ahead. No clock shows a time before the start."""
        clocks = self._clocks[name]
        if not clocks:
            return 0
        skew_ns = sum(clock.skew_ns(now_ns) for clock in clocks if clock.holds(now_ns))
        return max(skew_ns, -now_ns)

    def _gets_to_it(self, now_ns: int, every: int) -> bool:
        return now_ns // self._period_ns % every == 0


def _is_mid_step(fault: OnProcesses) -> bool:
    return isinstance(fault, Kill) and fault.mid_step
