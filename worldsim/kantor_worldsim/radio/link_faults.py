"""What the link faults of a scenario do to the radio's verdicts; the rules themselves are in `rules.py`.

A mission has more verdicts than steps, so they are ruled by kernels. What needs the envelopes themselves
stays here, and takes its time only where a fault asks for it: only a queue (bandwidth), what is replayed
and the numbers of forgeries depend on what was sent before.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from kantor_protocol.base.machine import SUPERVISOR, Envelope, ParticipantId
from kantor_protocol.scenario.faults.links import Bandwidth, Hostile, Replay
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.radio import fault_kernels as of
from kantor_worldsim.radio.channel import DROPPED, Field, Ruled, Sent, link_of
from kantor_worldsim.radio.fault_kernels import (
    KINDS,
    NEVER_NS,
    find_beside,
    reach_m,
    rule_on,
    severs,
    table_of,
    until_ns,
)
from kantor_worldsim.radio.forgeries import FIRST_SEQUENCE, ForgeryDraws, forge, strangers


class FaultStats(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """What one fault did to copies of messages for receivers within the radio's range."""

    fault: int
    """Its place in the scenario's list."""
    dropped: int = 0
    """A copy that several faults drop counts for each."""
    delayed: int = 0
    """Of those that arrive."""
    doubled: int = 0
    replayed: int = 0
    forged: int = 0


_DEEDS = len(FaultStats.__struct_fields__) - 1


class _History:
    """What was sent lately, for a fault that sends it again."""

    def __init__(self, fault: Replay) -> None:
        self._age_ns = round(fault.age_s * 1e9)
        self._until_ns = until_ns(fault)
        self._sent: dict[tuple[ParticipantId, ParticipantId], deque[Sent]] = {}

    def remember(self, sent: Sent) -> None:
        """Note what is sent, and forget what is too old to be drawn."""
        if sent.now_ns >= self._until_ns:
            return
        past = self._sent.setdefault((sent.envelope.source, sent.envelope.target), deque())
        past.append(sent)
        while len(past) > 1 and past[1].now_ns <= sent.now_ns - self._age_ns:
            past.popleft()

    def older(self, envelope: Envelope, latest_ns: int) -> Envelope | None:
        """The newest message of the same sender to the same receivers that was sent by then."""
        past = self._sent.get((envelope.source, envelope.target), ())
        return next((sent.envelope for sent in reversed(past) if sent.now_ns <= latest_ns), None)


class _Queue:
    """What waits until its sender has air for it."""

    def __init__(self, fault: Bandwidth) -> None:
        self._fault = fault
        self._until_ns = until_ns(fault)
        self._names = frozenset(fault.robots)
        self._free_ns: dict[ParticipantId, int] = {}

    def send(self, now_ns: int, envelope: Envelope) -> int:
        """How long an envelope waits, or DROPPED."""
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
        return min(free_ns - now_ns, NEVER_NS)


class LinkFaults:
    """All link faults of a scenario, as the radio's interference (see `Channel`) and for referees."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """Use `of`, which takes no trouble where there are none."""
        self.table = table_of(scenario, seed)
        """For kernels; without faults it has no rows."""
        self._order: list[int] = self.table.rules[:, of.FAULT].tolist()
        faults = {fault: scenario.faults[fault] for fault in self._order}
        self._histories = {i: _History(f) for i, f in faults.items() if isinstance(f, Replay)}
        self._queues = [_Queue(fault) for fault in faults.values() if isinstance(fault, Bandwidth)]
        self._over_ns = max(map(until_ns, faults.values()), default=0)
        """Nothing that is sent from then on is touched."""
        self._has_beside = any(isinstance(f, Replay | Hostile) for f in faults.values())
        self._roster = scenario.roster
        self._strangers = strangers(scenario.roster)
        self._places = {name: i for i, name in enumerate(scenario.roster)}
        self._ranges_m = scenario.radio.range_m, scenario.supervisor.range_m
        self._seed = seed
        self._forged: list[Envelope] = []
        self._next_forged = FIRST_SEQUENCE
        self._struck = np.zeros((len(faults), _DEEDS), dtype=np.int64)
        self._tolls = np.zeros((len(faults), _DEEDS), dtype=np.int64)
        self._queued = np.zeros((1, len(self._queues)), dtype=np.int64)
        self._beside = np.zeros((1, 4), dtype=np.int64)
        self._out = np.zeros((1, 3), dtype=np.int64)
        self._field: Field | None = None
        self._standing: tuple[Any, ...] = ()
        """Arguments of the kernels that stay the same from call to call."""

    @classmethod
    def of(cls, scenario: Scenario, seed: int) -> "LinkFaults | None":
        """Those of a scenario, or None if it has none."""
        faulty = any(type(fault) in KINDS for fault in scenario.faults)
        return cls(scenario, seed) if faulty else None

    def cuts(self, now_ns: int, source: ParticipantId, target: ParticipantId) -> bool:
        """Whether nothing that is sent now gets from one to the other, however near they are."""
        return bool(severs(self.table, now_ns, self._place(source), self._place(target)))

    def reach_m(self, now_ns: int, source: ParticipantId, target: ParticipantId) -> float:
        """The range of a link now, before walls."""
        whole_m = self._ranges_m[SUPERVISOR in {source, target}]
        left_m: float = reach_m(
            self.table, now_ns, self._place(source), self._place(target), whole_m
        )
        return left_m

    def rule(
        self, sent: Sequence[Sent], rows: np.ndarray, ruled: Ruled, field: Field
    ) -> tuple[Sequence[Sent], Ruled, int]:
        """Rule on what the radio has ruled; see `Interference`."""
        if sent[0].now_ns >= self._over_ns:
            return sent, ruled, 0
        self._enqueue(sent)
        if field is not self._field:
            self._field, self._standing = field, (*self.table, *field, *self._ranges_m)
        law = (*self._standing, rows, *ruled)
        on_air, besides = self._bring(sent, law) if self._has_beside else (sent, 0)
        made, lost = self._judge(law, besides)
        if made > self._out.shape[0]:
            self._out = np.zeros((2 * made, 3), dtype=np.int64)
            made, lost = self._judge(law, besides)
        return on_air, Ruled(self._out, made), lost

    def pop_stats(self) -> tuple[FaultStats, ...]:
        """What each fault has done since the last call; those that did nothing are left out."""
        told = self._tolls.tobytes()
        if told.count(0) == len(told):
            return ()
        fault_stats = [
            FaultStats(fault, *deeds)
            for fault, deeds in zip(self._order, self._tolls.tolist(), strict=True)
            if any(deeds)
        ]
        self._tolls[:] = 0
        return tuple(fault_stats)

    def pop_forged(self) -> tuple[Envelope, ...]:
        """What was forged since the last call."""
        forged, self._forged = self._forged, []
        return tuple(forged)

    def _place(self, name: ParticipantId) -> int:
        return self._places.get(name, -1)

    def _judge(self, law: tuple[Any, ...], besides: int) -> tuple[int, int]:
        made, lost = rule_on(
            *law, self._queued, self._beside, besides, self._struck, self._tolls, self._out
        )
        return made, lost

    def _enqueue(self, sent: Sequence[Sent]) -> None:
        """Note what is said of envelopes whoever hears them."""
        if self._queued.shape[0] < len(sent):
            self._queued = np.zeros((2 * len(sent), len(self._queues)), dtype=np.int64)
        if self._queues:
            self._queued[: len(sent)] = [[q.send(*each) for q in self._queues] for each in sent]
        for history in self._histories.values():
            for each in sent:
                history.remember(each)

    def _bring(self, sent: Sequence[Sent], law: tuple[Any, ...]) -> tuple[list[Sent], int]:
        """Put on the air what comes beside messages: all that is there, and how many rows tell of it."""
        found = find_beside(*law, self._struck, self._beside)
        if found > self._beside.shape[0]:
            self._beside = np.zeros((2 * found, 4), dtype=np.int64)
            find_beside(*law, self._struck, self._beside)
        on_air, ruled = list(sent), law[-2]
        for row, (first, rule, latest_ns, _) in enumerate(self._beside[:found].tolist()):
            to, which, _ = ruled[first].tolist()
            more = self._more(on_air[which], to, rule, latest_ns)
            self._beside[row, of.ON_AIR] = -1 if more is None else len(on_air)
            if more is not None:
                on_air.append(Sent(sent[which].now_ns, more))
        return on_air, found

    def _more(self, sent: Sent, to: int, rule: int, latest_ns: int) -> Envelope | None:
        """What comes beside an envelope, if anything."""
        fault = self._order[rule]
        if fault in self._histories:
            return self._histories[fault].older(sent.envelope, latest_ns)
        return self._forge(sent.envelope, to, fault)

    def _forge(self, envelope: Envelope, to: int, fault: int) -> Envelope:
        link = link_of(self._places[envelope.source], to, self._places.get(SUPERVISOR, -1))
        dice = ForgeryDraws(self._seed, link, envelope.sequence, fault << of.FAULT_SHIFT)
        source, body = forge(dice, envelope, self._strangers)
        forged = Envelope(source, self._next_forged, self._roster[to], body)
        self._next_forged += 1
        self._forged.append(forged)
        return forged
