"""Link faults of a scenario, applied to the channel's decisions; the rules themselves are in `fault_kernels.py`.

A mission has more delivery decisions than steps, so kernels make them. The parts that need the envelopes themselves
are here, and cost time only where a fault asks for them: only a queue (bandwidth), replayed messages and the numbers
of forgeries depend on what was sent before.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from kantor_protocol.base.machine import SUPERVISOR, Envelope, ParticipantId
from kantor_protocol.scenario.faults.links import (
    FORGED_SEQUENCE_MIN,
    Bandwidth,
    Hostile,
    Replay,
)
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.radio import fault_kernels as of
from kantor_worldsim.radio.channel import DROPPED, Decisions, LinkGeometry, Sent, link_of
from kantor_worldsim.radio.fault_kernels import (
    DUE_MAX_NS,
    EXTRA,
    KINDS,
    apply_rules,
    end_ns,
    find_extra,
    reach_m,
    severs,
    table_of,
)
from kantor_worldsim.radio.forgeries import ForgeryDraws, forge, strangers


class FaultStats(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Effects of one fault on copies of messages for receivers within the radio's range."""

    fault: int
    """Its index in the scenario's list."""
    dropped: int = 0
    """A copy that several faults drop counts for each."""
    delayed: int = 0
    """Copies that arrive later."""
    doubled: int = 0
    replayed: int = 0
    forged: int = 0


_COUNTERS = len(FaultStats.__struct_fields__) - 1


class _History:
    """Recent messages, for a fault that replays them."""

    def __init__(self, fault: Replay) -> None:
        self._age_ns = round(fault.age_s * 1e9)
        self._until_ns = end_ns(fault)
        self._sent: dict[tuple[ParticipantId, ParticipantId], deque[Sent]] = {}

    def remember(self, sent: Sent) -> None:
        """Add a message, and drop those that are too old to be drawn."""
        if sent.now_ns >= self._until_ns:
            return
        past = self._sent.setdefault((sent.envelope.source, sent.envelope.target), deque())
        past.append(sent)
        while len(past) > 1 and past[1].now_ns <= sent.now_ns - self._age_ns:
            past.popleft()

    def older(self, envelope: Envelope, latest_ns: int) -> Envelope | None:
        """The newest message of the same sender to the same receivers that was sent by latest_ns."""
        past = self._sent.get((envelope.source, envelope.target), ())
        return next((sent.envelope for sent in reversed(past) if sent.now_ns <= latest_ns), None)


class _Queue:
    """Messages that wait for their sender's bandwidth."""

    def __init__(self, fault: Bandwidth) -> None:
        self._fault = fault
        self._until_ns = end_ns(fault)
        self._names = frozenset(fault.robots)
        self._free_ns: dict[ParticipantId, int] = {}

    def send(self, now_ns: int, envelope: Envelope) -> int:
        """Waiting time of an envelope in nanoseconds, or DROPPED."""
        if not self._fault.from_ns <= now_ns < self._until_ns:
            return 0
        if self._names and envelope.source not in self._names:
            return 0
        per_byte_ns = 1e9 / self._fault.bytes_per_s
        free_ns = max(now_ns, self._free_ns.get(envelope.source, 0))
        room = self._fault.queue_bytes
        if room is not None and free_ns - now_ns > room * per_byte_ns:
            return DROPPED
        free_ns += round(len(envelope.body) * per_byte_ns)
        self._free_ns[envelope.source] = free_ns
        return min(free_ns - now_ns, DUE_MAX_NS)


class LinkFaults:
    """All link faults of a scenario, as the interference of a `Channel`."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """Use `of`, which is None for a scenario without link faults."""
        self.table = table_of(scenario, seed)
        """The rules, for kernels."""
        self._order: list[int] = self.table.rules["fault"].tolist()
        faults = {fault: scenario.faults[fault] for fault in self._order}
        self._histories = {i: _History(f) for i, f in faults.items() if isinstance(f, Replay)}
        self._queues = [_Queue(fault) for fault in faults.values() if isinstance(fault, Bandwidth)]
        self._over_ns = max(map(end_ns, faults.values()), default=0)
        """Messages that are sent from this time on are not affected."""
        self._has_extra = any(isinstance(f, Replay | Hostile) for f in faults.values())
        self._roster = scenario.roster
        self._strangers = strangers(scenario.roster)
        self._places = {name: i for i, name in enumerate(scenario.roster)}
        self._seed = seed
        self._forged: list[Envelope] = []
        self._next_forged = FORGED_SEQUENCE_MIN
        self._effects = np.zeros((len(faults), _COUNTERS), dtype=np.int64)
        self._totals = np.zeros((len(faults), _COUNTERS), dtype=np.int64)
        self._queued = np.zeros((1, len(self._queues)), dtype=np.int64)
        self._extra = np.zeros(1, dtype=EXTRA)
        self._extra["first"] = -1
        self._out = np.zeros((1, 3), dtype=np.int64)
        self._geometry: LinkGeometry | None = None
        self._constant: tuple[Any, ...] = ()
        """Arguments of the kernels that stay the same from call to call."""

    @classmethod
    def of(cls, scenario: Scenario, seed: int) -> "LinkFaults | None":
        """Link faults of a scenario, or None if it has none."""
        faulty = any(type(fault) in KINDS for fault in scenario.faults)
        return cls(scenario, seed) if faulty else None

    def cuts(self, now_ns: int, source: ParticipantId, target: ParticipantId) -> bool:
        """Whether a cut severs the link from source to target now."""
        return bool(severs(self.table, now_ns, self._place(source), self._place(target)))

    def reach_m(self, now_ns: int, source: ParticipantId, target: ParticipantId) -> float:
        """The range of a link now, before walls."""
        by_supervisor = SUPERVISOR in {source, target}
        whole_m = self.table.supervisors_m if by_supervisor else self.table.robots_m
        left_m: float = reach_m(
            self.table, now_ns, self._place(source), self._place(target), whole_m
        )
        return left_m

    def rule(
        self, sent: Sequence[Sent], rows: np.ndarray, decided: Decisions, geometry: LinkGeometry
    ) -> tuple[Sequence[Sent], Decisions, int]:
        """Apply the faults to the channel's decisions; see `Interference`."""
        if sent[0].now_ns >= self._over_ns:
            return sent, decided, 0
        self._enqueue(sent)
        if geometry is not self._geometry:
            self._geometry, self._constant = geometry, (tuple(self.table), tuple(geometry))
        arguments = (*self._constant, (rows, *decided))
        on_air = self._add_extra(sent, decided, arguments) if self._has_extra else sent
        made, lost = self._apply_rules(arguments)
        if made > self._out.shape[0]:
            self._out = np.zeros((2 * made, 3), dtype=np.int64)
            made, lost = self._apply_rules(arguments)
        return on_air, Decisions(self._out, made), lost

    def pop_stats(self) -> tuple[FaultStats, ...]:
        """Effects of each fault since the last call; faults without any are left out."""
        if not self._totals.any():
            return ()
        counted = zip(self._order, self._totals.tolist(), strict=True)
        stats = tuple([FaultStats(fault, *counts) for fault, counts in counted if any(counts)])
        self._totals[:] = 0
        return stats

    def pop_forged(self) -> tuple[Envelope, ...]:
        """Envelopes that were forged since the last call."""
        forged, self._forged = self._forged, []
        return tuple(forged)

    def _place(self, name: ParticipantId) -> int:
        return self._places.get(name, -1)

    def _apply_rules(self, arguments: tuple[Any, ...]) -> tuple[int, int]:
        made, lost = apply_rules(
            *arguments, self._queued, self._extra, self._effects, self._totals, self._out
        )
        return made, lost

    def _enqueue(self, sent: Sequence[Sent]) -> None:
        """Apply the rules that do not depend on the receiver: queues and histories."""
        if self._queued.shape[0] < len(sent):
            self._queued = np.zeros((2 * len(sent), len(self._queues)), dtype=np.int64)
        if self._queues:
            self._queued[: len(sent)] = [
                [q.send(each.now_ns, each.envelope) for q in self._queues] for each in sent
            ]
        for history in self._histories.values():
            for each in sent:
                history.remember(each)

    def _add_extra(
        self, sent: Sequence[Sent], decided: Decisions, arguments: tuple[Any, ...]
    ) -> list[Sent]:
        """Put extra envelopes on the air; returns all envelopes on the air."""
        found = find_extra(*arguments, self._effects, self._extra)
        if found >= self._extra.shape[0]:
            self._extra = np.zeros(2 * found, dtype=EXTRA)
            find_extra(*arguments, self._effects, self._extra)
        self._extra["first"][found:] = -1
        on_air = list(sent)
        for row, (first, rule, latest_ns, _) in enumerate(self._extra[:found].tolist()):
            to, which, _ = decided.rows[first].tolist()
            more = self._extra_envelope(on_air[which], to, rule, latest_ns)
            self._extra["on_air"][row] = -1 if more is None else len(on_air)
            if more is not None:
                on_air.append(Sent(sent[which].now_ns, more))
        return on_air

    def _extra_envelope(self, sent: Sent, to: int, rule: int, latest_ns: int) -> Envelope | None:
        """The envelope that a rule sends with another one, or None."""
        fault = self._order[rule]
        if fault in self._histories:
            return self._histories[fault].older(sent.envelope, latest_ns)
        return self._forge(sent.envelope, to, fault)

    def _forge(self, envelope: Envelope, to: int, fault: int) -> Envelope:
        link = link_of(self._places[envelope.source], to, self._places.get(SUPERVISOR, -1))
        draws = ForgeryDraws(self._seed, link, envelope.sequence, fault << of.FAULT_SHIFT)
        source, body = forge(draws, envelope, self._strangers)
        forged = Envelope(source, self._next_forged, self._roster[to], body)
        self._next_forged += 1
        self._forged.append(forged)
        return forged
