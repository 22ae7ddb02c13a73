"""The process events and wrong clocks that a scenario's faults may cause, read from its Structs alone."""

from collections.abc import Iterable
from typing import NamedTuple

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.processes import (
    ClockFault,
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


class CausedEvent(NamedTuple):
    """An event that a fault causes, once."""

    fault: int
    """Place of the fault in the scenario's list."""
    who: ParticipantId
    kind: ProcessEventKind
    at_ns: int
    """The earliest time at which it comes."""
    mid_step: bool
    """Whether it waits for a step of the process, which may never come."""


def caused_events(scenario: Scenario) -> Iterable[CausedEvent]:
    """Every event that the faults of a scenario cause."""
    for place, fault in enumerate(scenario.faults):
        if isinstance(fault, OnProcesses):
            mid_step = isinstance(fault, Kill) and fault.mid_step
            for kind, at_ns in _moments(fault):
                if at_ns is not None:
                    yield from (CausedEvent(place, who, kind, at_ns, mid_step) for who in fault.who)


def _moments(fault: OnProcesses) -> Iterable[tuple[ProcessEventKind, int | None]]:
    """What a fault does to a process, and when; a fault without an end has no second moment."""
    begins_ns, ends_ns = fault.from_ns, fault.until_ns
    match fault:
        case Kill():
            return (ProcessEventKind.KILL, begins_ns), (ProcessEventKind.START, ends_ns)
        case Late():
            return ((ProcessEventKind.START, ends_ns),)
        case Pause():
            return (ProcessEventKind.PAUSE, begins_ns), (ProcessEventKind.RESUME, ends_ns)
        case FullDisk():
            return (ProcessEventKind.FILL, begins_ns), (ProcessEventKind.FREE, ends_ns)
        case Slow():
            return (ProcessEventKind.SLOW, begins_ns), (ProcessEventKind.QUICKEN, ends_ns)
        case ClockFault():
            return (ProcessEventKind.SKEW, begins_ns), (ProcessEventKind.RIGHT, ends_ns)
        case Impostor():
            return ((ProcessEventKind.IMPOSTOR_REFUSED, begins_ns),)
        case _:
            raise TypeError(f"a process fault of an unknown kind: {fault}")


class WrongClocks:
    """Bounds on how far clocks of participants are ahead of simulated time, by the clock faults."""

    def __init__(self, scenario: Scenario, *, virtual: bool) -> None:
        """virtual: a clock is wrong exactly within the window of its fault; otherwise it learns of it later."""
        self._faults: dict[ParticipantId, list[ClockFault]] = {}
        for fault in scenario.faults:
            if isinstance(fault, ClockFault):
                for name in fault.who:
                    self._faults.setdefault(name, []).append(fault)
        self._virtual = virtual

    def __bool__(self) -> bool:
        """Whether any clock is ever wrong."""
        return bool(self._faults)

    def skews_ns(self, name: ParticipantId, now_ns: int, ruled_ns: int) -> tuple[int, int]:
        """The least and the most that a clock may be ahead.

        now_ns: time of the step, by the participant. ruled_ns: when it was ruled on, by world-sim, whose clock says
        how wrong a clock of a realtime run is to be: the participant's own is behind by the way between them.
        """
        faults = self._faults.get(name)
        if faults is None:
            return 0, 0
        if self._virtual:
            skew_ns = sum(_skew_ns(fault, now_ns) for fault in faults if fault.holds(now_ns))
            skew_ns = max(skew_ns, -now_ns)  # no clock shows a time before 0
            return skew_ns, skew_ns
        least_ns = most_ns = 0
        for fault in faults:
            if fault.from_ns <= ruled_ns:
                last_ns = ruled_ns if fault.until_ns is None else min(ruled_ns, fault.until_ns)
                reached_ns = (0, _skew_ns(fault, fault.from_ns), _skew_ns(fault, last_ns))
                least_ns, most_ns = least_ns + min(reached_ns), most_ns + max(reached_ns)
        return least_ns, most_ns


def _skew_ns(fault: ClockFault, now_ns: int) -> int:
    """The error that a fault has added to a clock: its offset, and so many millionths of the time since it began."""
    elapsed_ns = now_ns - fault.from_ns
    return round(fault.offset_s * 1e9) + elapsed_ns * round(fault.rate_ppm) // 10**6
