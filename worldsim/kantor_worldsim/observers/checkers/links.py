"""The links of a mission by its scenario alone: which are cut, and how far the others reach.

A plain reading of the link faults for the checkers. It shares no code with the radio and works in another
way: the mission is divided at every moment at which a cut or a shorter range begins, ends or flaps. From one
such moment to the next a table tells of any two participants whether a link is cut, and how far it reaches.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.links import OneWay, Partition, Range
from kantor_protocol.scenario.schema import Scenario

_ALWAYS_NS = 1 << 62
"""Later than the end of any mission."""
_FLAP_SHARE = 0.5
"""Share of the time in which a flapping cut is there, unless its fault says otherwise."""
_COPY_BITS = 16
"""The last word of a draw's counter is the place of the fault in the scenario's list, above so many bits."""


class LinkTable(NamedTuple):
    """All links at one moment, for kernels. n participants, in the order of the roster."""

    cut: npt.NDArray[np.bool_]
    """(n, n): whether nothing passes from one (row) to another (column); (0, 0) if no fault ever cuts."""
    whole_m: npt.NDArray[np.float64]
    """(2,): how far links reach without faults: those of two robots, and those of the supervisor."""
    most_m: npt.NDArray[np.float64]
    """(n,): how far the links of each may reach by faults."""
    share: npt.NDArray[np.float64]
    """(n,): the share that faults leave of the links of each."""
    supervisor: int
    """Its place in the roster, or one beyond."""


@kernel
def is_cut(table: LinkTable, source: int, target: int) -> bool:
    """Whether nothing passes from one participant to another."""
    return table.cut.shape[0] > 0 and table.cut[source, target]


@kernel
def range_of(table: LinkTable, source: int, target: int) -> float:
    """How far a link reaches, before walls."""
    by_supervisor = table.supervisor in (source, target)
    whole_m = table.whole_m[1 if by_supervisor else 0]
    left_m = min(whole_m, table.most_m[source], table.most_m[target])
    return min(left_m, whole_m * min(table.share[source], table.share[target]))


class _Cut(NamedTuple):
    """A one-way fault or a partition."""

    place: int
    """In the scenario's list."""
    fault: OneWay | Partition
    severed: npt.NDArray[np.bool_]
    """(n, n): the links that it cuts while it is there."""
    flap_ns: int
    """Length of the intervals in which it is there or not; 0: it is always there."""

    def is_there(self, now_ns: int, seed: int) -> bool:
        """Whether it cuts its links within its window."""
        if not self.flap_ns:
            return True
        assert isinstance(self.fault, Partition)
        purpose, interval = Purpose.FAULT_FLAP.value, now_ns // self.flap_ns
        draw = uniform(seed, purpose, 0, interval, self.place << _COPY_BITS)
        return bool(draw < (self.fault.flap_share or _FLAP_SHARE))


class Links:
    """The links of a mission as time passes."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._names = scenario.roster
        self._seed = seed
        self._cuts = [
            _Cut(place, fault, _severed(fault, self._names), _flap_ns(fault))
            for place, fault in enumerate(scenario.faults)
            if isinstance(fault, OneWay | Partition)
        ]
        self._ranges = [fault for fault in scenario.faults if isinstance(fault, Range)]
        count = len(self._names)
        ends = count if self._cuts else 0
        self.table = LinkTable(
            cut=np.zeros((ends, ends), dtype=np.bool_),
            whole_m=np.array([scenario.radio.range_m, scenario.supervisor.range_m]),
            most_m=np.full(count, np.inf),
            share=np.ones(count),
            supervisor=scenario.robots.count,
        )
        """As it is since the last `move_to`; always the same arrays."""
        self._from_ns = self._until_ns = -1

    def move_to(self, now_ns: int) -> None:
        """Bring the table to a time, in nanoseconds since the mission's start."""
        if self._from_ns <= now_ns < self._until_ns:
            return
        cut, _, most_m, share, _ = self.table
        cut[:], most_m[:], share[:] = False, np.inf, 1.0
        for each in self._cuts:
            if each.fault.holds(now_ns) and each.is_there(now_ns, self._seed):
                cut |= each.severed
        for fault in self._ranges:
            if fault.holds(now_ns):
                self._shorten(fault)
        edges_ns = list(self._edges_ns(now_ns))
        self._from_ns = max((edge_ns for edge_ns in edges_ns if edge_ns <= now_ns), default=0)
        self._until_ns = min(
            (edge_ns for edge_ns in edges_ns if edge_ns > now_ns), default=_ALWAYS_NS
        )

    def is_cut(self, source: int, target: int) -> bool:
        """Whether nothing passes from one participant to another, by their places."""
        return bool(is_cut(self.table, source, target))

    def range_m(self, source: int, target: int) -> float:
        """How far a link reaches, before walls."""
        return float(range_of(self.table, source, target))

    def _shorten(self, fault: Range) -> None:
        """A fault on ranges counts for each link that has one of its participants at an end."""
        touched = _among(fault.robots or self._names, self._names)
        if fault.range_m is not None:
            self.table.most_m[touched] = np.minimum(self.table.most_m[touched], fault.range_m)
        else:
            self.table.share[touched] = np.minimum(self.table.share[touched], fault.factor or 0.0)

    def _edges_ns(self, now_ns: int) -> Iterator[int]:
        """The moments around a time at which a link may change."""
        faults: list[Fault] = [*(each.fault for each in self._cuts), *self._ranges]
        for fault in faults:
            yield fault.from_ns
            yield _ALWAYS_NS if fault.until_ns is None else fault.until_ns
        for each in self._cuts:
            if each.flap_ns and each.fault.holds(now_ns):
                interval = now_ns // each.flap_ns
                yield interval * each.flap_ns
                yield (interval + 1) * each.flap_ns


def _flap_ns(fault: OneWay | Partition) -> int:
    flap_s = fault.flap_s if isinstance(fault, Partition) else None
    return round((flap_s or 0.0) * 1e9)


def _among(
    some: Iterable[ParticipantId], names: tuple[ParticipantId, ...]
) -> npt.NDArray[np.bool_]:
    """(n,): whether each of the names is among some."""
    wanted = frozenset(some)
    return np.array([name in wanted for name in names], dtype=np.bool_)


def _severed(fault: OneWay | Partition, names: tuple[ParticipantId, ...]) -> npt.NDArray[np.bool_]:
    """(n, n): the links that a fault cuts while it is there."""
    if isinstance(fault, OneWay):
        senders, receivers = fault.senders or names, fault.receivers or names
        return np.logical_and.outer(_among(senders, names), _among(receivers, names))
    together = np.zeros((len(names), len(names)), dtype=np.bool_)
    for part in _parts(fault, names):
        inside = _among(part, names)
        together |= np.logical_and.outer(inside, inside)
    return ~together


def _parts(fault: Partition, names: tuple[ParticipantId, ...]) -> Iterator[Iterable[ParticipantId]]:
    """The parts into which the team falls. A link stands if some part has both its ends."""
    count = len(names)
    if fault.shape == "halves":  # of an odd team, the first half has one more
        yield from (names[: count - count // 2], names[count - count // 2 :])
    elif fault.shape == "bridge":  # the one in the middle belongs to both
        yield from (names[: count // 2 + 1], names[count // 2 :])
    elif fault.shape == "ring":  # each with the one after it, the last with the first
        yield from ((names[i - 1], names[i]) for i in range(count))
    else:
        groups = fault.groups if fault.shape == "groups" else [(name,) for name in fault.robots]
        yield from groups
        yield set(names).difference(*groups)
