"""Coverage: how often each class of faults took effect, from the record of a mission."""

from collections import Counter
from collections.abc import Iterable

from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM, ParticipantId
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.liars import LIES, Byzantine
from kantor_protocol.scenario.faults.links import Hostile, Partition
from kantor_protocol.scenario.faults.processes import Kill, OnProcesses, Pause
from kantor_protocol.scenario.faults.schedule import KINDS, kind_of
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, Record

CLASSES: tuple[str, ...] = (
    "drop",
    "burst",
    "delay",
    "duplicate",
    "replay",
    "reorder",
    "one-way",
    "partition halves",
    "partition ring",
    "partition bridge",
    "partition isolate",
    "partition groups",
    "partition flapping",
    "clog",
    "bandwidth",
    "range",
    "hostile",
    "kill",
    "kill torn",
    "kill lost",
    "kill mid-step",
    "kill for good",
    "kill supervisor",
    "kill worldsim",
    "pause",
    "pause supervisor",
    "pause worldsim",
    "late",
    "slow",
    "full-disk",
    "clock",
    "impostor",
    *(f"byzantine {lie}" for lie in LIES),
)
"""All classes. A fault may count for several, such as a kill of the supervisor with a torn log."""

_STRIKES = frozenset({"kill", "pause", "fill", "slow", "skew", "pretend"})


class FaultCoverage:
    """Counts, over the records of one mission, copies that link faults touched, processes that were hit, and lies."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._faults: tuple[Fault, ...] = ()
        self._lies: list[Byzantine] = []

    def observe(self, record: Record) -> None:
        """Follow one record."""
        if isinstance(record, Batch):
            for stats in record.fault_stats:
                fault = self._faults[stats.fault]
                if not isinstance(fault, Hostile):
                    hit = stats.dropped + stats.delayed + stats.doubled + stats.replayed
                    self._count(fault, "", hit)
            if self._lies:
                self._note_lies(record)
            if record.injected:
                self.counts["hostile"] += len(record.injected)
        elif isinstance(record, ProcessEvent) and record.fault >= 0:
            fault = self._faults[record.fault]
            if record.kind in _STRIKES or (record.kind == "start" and kind_of(fault) == "late"):
                self._count(fault, record.who, 1)
        elif isinstance(record, Opening):
            self._faults = record.scenario.faults
            self._lies = [fault for fault in self._faults if isinstance(fault, Byzantine)]

    def _note_lies(self, batch: Batch) -> None:
        """Count the steps in which liars had somebody to lie to; whether they were caught is for the checkers."""
        for step_record in batch.step_records:
            for fault in self._lies if step_record.outputs is not None else ():
                if step_record.name in fault.who and fault.holds(step_record.now_ns):
                    self.counts[f"{kind_of(fault)} {fault.lie}"] += 1

    def _count(self, fault: Fault, who: ParticipantId, times: int) -> None:
        for name in _classes_of(fault, who):
            self.counts[name] += times


def _classes_of(fault: Fault, who: ParticipantId) -> Iterable[str]:
    kind = kind_of(fault)
    if isinstance(fault, Partition):
        yield f"{kind} {fault.shape}"
        if fault.flap_s is not None:
            yield f"{kind} flapping"
        return
    if isinstance(fault, Kill | Pause) and who in {SUPERVISOR, WORLD_SIM}:
        yield f"{kind} {who}"
    else:
        yield kind
    if isinstance(fault, Kill):
        yield from (f"{kind} {fault.disk}",) if fault.disk != "kept" else ()
        yield from (f"{kind} mid-step",) if fault.mid_step else ()
        yield from (f"{kind} for good",) if fault.until_s is None else ()


def is_of_processes(name: str) -> bool:
    """Whether a class is about processes."""
    return issubclass(KINDS[name.split(maxsplit=1)[0]], OnProcesses)


def is_of_links(name: str) -> bool:
    """Whether a class is about links, and the messages on them."""
    return not is_of_processes(name) and KINDS[name.split(maxsplit=1)[0]] is not Byzantine
