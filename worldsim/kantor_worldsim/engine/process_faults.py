"""The schedule of a scenario's process faults: which is due next, and which participants step meanwhile.

The schedule says what is to happen and when. The event loop has it carried out in virtual time, the fault
injector (`exchange/fault_injector.py`) on real processes.
"""

from typing import NamedTuple

from kantor_protocol.base.machine import NEVER_NS, WORLD_SIM, ParticipantId
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
from kantor_worldsim.record.process_events import ProcessEventKind

_BEGINS: dict[type[OnProcesses], ProcessEventKind] = {
    Kill: ProcessEventKind.KILL,
    Pause: ProcessEventKind.PAUSE,
    FullDisk: ProcessEventKind.FILL,
    Slow: ProcessEventKind.SLOW,
    ClockFault: ProcessEventKind.SKEW,
    Impostor: ProcessEventKind.IMPOSTOR_REFUSED,
}
"""The event at the beginning of a fault's window."""
_ENDS: dict[type[OnProcesses], ProcessEventKind] = {
    Kill: ProcessEventKind.START,
    Late: ProcessEventKind.START,
    Pause: ProcessEventKind.RESUME,
    FullDisk: ProcessEventKind.FREE,
    Slow: ProcessEventKind.QUICKEN,
    ClockFault: ProcessEventKind.RIGHT,
}
"""The event at the end of a fault's window."""


class ScheduledProcessFault(NamedTuple):
    """One event that a fault orders for one process."""

    at_ns: int
    fault: int
    """Index of its fault in the scenario's list."""
    who: ParticipantId
    """A participant, or world-sim."""
    kind: ProcessEventKind
    disk: Disk = "kept"
    """START: what is left of the process's write-ahead log."""
    mid_step: bool = False
    """KILL: in its next step, after its inputs were logged and before its outputs are sent."""


def schedule_of(scenario: Scenario) -> list[ScheduledProcessFault]:
    """All events that a scenario's faults order, by time and then by index of the fault.

    At one moment ends come before beginnings, so that one process can leave and another come; world-sim
    begins first and ends last, so that it observes what happens to the others.
    """
    schedule: list[ScheduledProcessFault] = []
    for index, fault in enumerate(scenario.faults):
        if not isinstance(fault, OnProcesses):
            continue
        disk = fault.disk if isinstance(fault, Kill) else "kept"
        mid_step = isinstance(fault, Kill) and fault.mid_step
        moments = ((_BEGINS, fault.from_ns), (_ENDS, fault.until_ns))
        for who in fault.who:
            schedule += [
                ScheduledProcessFault(at_ns, index, who, kinds[type(fault)], disk, mid_step)
                for kinds, at_ns in moments
                if at_ns is not None and type(fault) in kinds
            ]
    return sorted(schedule, key=_precedence)


def _precedence(scheduled: ScheduledProcessFault) -> tuple[int, bool, bool]:
    begins = scheduled.kind in _BEGINS.values()
    return scheduled.at_ns, begins, (scheduled.who == WORLD_SIM) == begins


class _Window(NamedTuple):
    """The window of a fault in nanoseconds; the fault itself computes them anew at each call."""

    from_ns: int
    until_ns: int
    every: int
    """Only one step in so many is made; 0: none is."""
    fault: OnProcesses

    @classmethod
    def of(cls, fault: OnProcesses) -> "_Window":
        until_ns = NEVER_NS if fault.until_ns is None else fault.until_ns
        return cls(fault.from_ns, until_ns, fault.every if isinstance(fault, Slow) else 0, fault)


class ProcessFaults:
    """The process faults of a scenario, consumed in order as time advances."""

    def __init__(self, scenario: Scenario, done: int = 0) -> None:
        """done: number of scheduled events that have happened already."""
        self._schedule = schedule_of(scenario)[done:]
        self._period_ns = scenario.period_ns
        faults = [fault for fault in scenario.faults if isinstance(fault, OnProcesses)]
        names = (*scenario.roster, WORLD_SIM)
        windows = [_Window.of(fault) for fault in faults]
        self._stops = {
            name: [w for w in windows if w.fault.stops and {name, WORLD_SIM} & set(w.fault.who)]
            for name in names
        }
        """Windows in which a participant makes no step, those of world-sim included."""
        self._deaths = {
            name: [w for w in windows if name in w.fault.who and _is_mid_step(w.fault)]
            for name in names
        }
        self.some_die_mid_step = any(self._deaths.values())
        """Whether a participant is ever killed in the middle of a step."""
        relevant = [w for w in windows if w.fault.stops or _is_mid_step(w.fault)]
        self._first_ns = min((w.from_ns for w in relevant), default=NEVER_NS)
        self._last_ns = max((w.until_ns for w in relevant), default=0)
        self._clocks = {
            name: [fault for fault in faults if isinstance(fault, ClockFault) and name in fault.who]
            for name in names
        }

    @property
    def next_ns(self) -> int | None:
        """Time of the next scheduled event."""
        return self._schedule[0].at_ns if self._schedule else None

    def pop(self) -> ScheduledProcessFault:
        """Remove and return the next scheduled event."""
        return self._schedule.pop(0)

    def quiet(self, from_ns: int, to_ns: int) -> bool:
        """Whether every participant steps, and none is killed in a step, from one time to another, both included."""
        return to_ns < self._first_ns or from_ns >= self._last_ns

    def idle(self, name: ParticipantId, now_ns: int) -> bool:
        """Whether a participant makes no step now, because of its own state or of world-sim's."""
        for from_ns, until_ns, every, _ in self._stops[name]:
            if from_ns <= now_ns < until_ns and not (every and self._makes_step(now_ns, every)):
                return True
        return False

    def dies(self, name: ParticipantId, now_ns: int) -> bool:
        """Whether a participant is killed in its next step, or was."""
        deaths = self._deaths[name]
        return bool(deaths) and any(death.from_ns <= now_ns < death.until_ns for death in deaths)

    def skew_ns(self, name: ParticipantId, now_ns: int) -> int:
        """Skew of a participant's clock, positive if it is ahead. No clock shows a time before the start."""
        clocks = self._clocks[name]
        if not clocks:
            return 0
        skew_ns = sum(clock.skew_ns(now_ns) for clock in clocks if clock.holds(now_ns))
        return max(skew_ns, -now_ns)

    def _makes_step(self, now_ns: int, every: int) -> bool:
        return now_ns // self._period_ns % every == 0


def _is_mid_step(fault: OnProcesses) -> bool:
    return isinstance(fault, Kill) and fault.mid_step
