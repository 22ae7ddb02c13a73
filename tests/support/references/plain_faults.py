"""The rules of link faults in plain Python, with which the compiled ones are compared.

Slow, and close to the descriptions of the faults themselves. Forgeries are left out.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import reduce
from itertools import groupby
from operator import itemgetter
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.machine import SUPERVISOR, Envelope, ParticipantId
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.links import (
    COPIES_MAX,
    Bandwidth,
    Burst,
    Clog,
    Delay,
    Drop,
    Duplicate,
    OneWay,
    Partition,
    Range,
    Reorder,
    Replay,
)
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.radio.channel import DROPPED, LINK_WIDTH, Decisions, LinkGeometry, Sent, hears

Row = tuple[int, int, int]
"""Receiver, row on the air, due_ns: a delivery decision."""
Reaches = Callable[[int, int, float], bool]
"""Whether one participant hears another if their range were so many metres."""

_NEVER_NS = 2**62
"""Later than any mission; a copy that is due then does not arrive."""
_SLOTS_IN_A_STATE = 10
"""Of a burst: slots in the shorter of its mean times."""
_FLAP_SHARE = 0.5

# The last word of a draw's counter: which fault, and which of the copies that it may meet.
_FAULT_SHIFT = 16
_FIRST_EXTRA = 2  # the radio itself makes one copy, or two
_REPLAYED = 1 << 15

_RECEIVER = itemgetter(0, 1)


class Fate(NamedTuple):
    """The effect of a rule on a copy."""

    dropped: bool = False
    delay_ns: int = 0
    held_ns: int = 0
    """It does not arrive before."""

    def joined(self, other: "Fate") -> "Fate":
        """The effect of two rules together."""
        return Fate(
            self.dropped or other.dropped,
            self.delay_ns + other.delay_ns,
            max(self.held_ns, other.held_ns),
        )

    def due_ns(self, due_ns: int) -> int:
        """When a copy arrives that was due, or DROPPED."""
        return DROPPED if self.dropped else max(due_ns + self.delay_ns, self.held_ns)


PASS = Fate()
DROP = Fate(dropped=True)


class Hop(NamedTuple):
    """A copy of an envelope on its way over a link."""

    now_ns: int
    source: ParticipantId
    target: ParticipantId
    link: int
    sequence: int
    copy: int = 0


def in_burst(seed: int, link: int, index: int, slot: int, to_bad: float, to_good: float) -> bool:
    """Whether a link is bad in a slot, which it is not in slot 0. to_bad + to_good is at most 1.

    A draw below to_bad makes a link bad in whatever state it was, one from 1 - to_good on makes it good,
    and any other leaves it. So the last draw that decides is all that needs to be looked for.
    """
    while slot > 0:
        draw = uniform(seed, Purpose.FAULT_BURST.value, link, slot, index)
        if draw < to_bad:
            return True
        if draw >= 1.0 - to_good:
            return False
        slot -= 1
    return False


_F = TypeVar("_F", bound=Fault)


class Rule(Generic[_F]):
    """One fault of a scenario, ready to apply."""

    def __init__(self, fault: _F, index: int, scenario: Scenario, seed: int) -> None:
        """index: its place in the scenario's list."""
        self.fault = fault
        self.index = index
        self._seed = seed
        self._window_ns = range(
            fault.from_ns, _NEVER_NS if fault.until_ns is None else fault.until_ns
        )
        self._names = frozenset(getattr(fault, "robots", ()))
        self._prepare(scenario)

    def _prepare(self, scenario: Scenario) -> None:
        """Work out what does not change."""

    def active(self, now_ns: int) -> bool:
        """Whether its window is open."""
        return now_ns in self._window_ns

    def concerns(self, source: ParticipantId, target: ParticipantId) -> bool:
        """Whether it is about a link."""
        return not self._names or source in self._names or target in self._names

    def fate(self, _hop: Hop) -> Fate:
        """Its effect on a copy on a link that it is about."""
        return PASS

    def _draw(self, purpose: Purpose, hop: Hop) -> float:
        index = self.index << _FAULT_SHIFT | hop.copy
        # An enumeration as such takes numba longer to recognize than everything else here together.
        draw: float = uniform(self._seed, purpose.value, hop.link, hop.sequence, index)
        return draw

    def _slot_draw(self, purpose: Purpose, slot: int) -> float:
        draw: float = uniform(self._seed, purpose.value, 0, slot, self.index << _FAULT_SHIFT)
        return draw


class _Drop(Rule[Drop]):
    def fate(self, hop: Hop) -> Fate:
        return DROP if self._draw(Purpose.FAULT_DROP, hop) < self.fault.probability else PASS


class _Burst(Rule[Burst]):
    def _prepare(self, _scenario: Scenario) -> None:
        good_s, bad_s = self.fault.good_s, self.fault.bad_s
        slot_s = min(good_s, bad_s) / _SLOTS_IN_A_STATE
        self._slot_ns = round(slot_s * 1e9)
        self._to_bad, self._to_good = slot_s / good_s, slot_s / bad_s

    def fate(self, hop: Hop) -> Fate:
        index, slot = self.index << _FAULT_SHIFT, hop.now_ns // self._slot_ns
        bad = in_burst(self._seed, hop.link, index, slot, self._to_bad, self._to_good)
        probability = self.fault.drop_bad if bad else self.fault.drop_good
        return DROP if self._draw(Purpose.FAULT_DROP, hop) < probability else PASS


class _Delay(Rule[Delay]):
    def fate(self, hop: Hop) -> Fate:
        delay_s = self.fault.delay_s
        if self.fault.jitter_s > 0.0:
            delay_s += self._draw(Purpose.FAULT_DELAY, hop) * self.fault.jitter_s
        return Fate(delay_ns=round(delay_s * 1e9))


class _Reorder(Rule[Reorder]):
    def fate(self, hop: Hop) -> Fate:
        share = self._draw(Purpose.FAULT_REORDER, hop) / self.fault.probability
        return Fate(delay_ns=round(share * self.fault.hold_s * 1e9)) if share < 1.0 else PASS


class _Clog(Rule[Clog]):
    def fate(self, _hop: Hop) -> Fate:
        return Fate(held_ns=self._window_ns.stop)


class Cut(Rule[_F]):
    """A rule by which nothing passes some links."""

    def cuts(self, now_ns: int, source: ParticipantId, target: ParticipantId) -> bool:
        """Whether it severs a link now."""
        raise NotImplementedError

    def fate(self, hop: Hop) -> Fate:
        """A drop, or nothing."""
        return DROP if self.cuts(hop.now_ns, hop.source, hop.target) else PASS

    def concerns(self, _source: ParticipantId, _target: ParticipantId) -> bool:
        """Its names are not about links."""
        return True


class _OneWay(Cut[OneWay]):
    def _prepare(self, scenario: Scenario) -> None:
        self._severs = self.fault.severs(scenario.roster)

    def cuts(self, _now_ns: int, source: ParticipantId, target: ParticipantId) -> bool:
        return self._severs(source, target)


class _Partition(Cut[Partition]):
    def _prepare(self, scenario: Scenario) -> None:
        self._severs = self.fault.severs(scenario.roster)
        self._flap_ns = round((self.fault.flap_s or 0.0) * 1e9)
        self._share = self.fault.flap_share or _FLAP_SHARE

    def cuts(self, now_ns: int, source: ParticipantId, target: ParticipantId) -> bool:
        return self._there(now_ns) and self._severs(source, target)

    def _there(self, now_ns: int) -> bool:
        if not self._flap_ns:
            return True
        draw = self._slot_draw(Purpose.FAULT_FLAP, now_ns // self._flap_ns)
        return draw < self._share


class _Range(Rule[Range]):
    """It has no effect on copies: a receiver beyond the range gets none."""


class _Duplicate(Rule[Duplicate]):
    """It has no effect on copies: it makes more of them."""

    def copies(self, hop: Hop) -> list[tuple[int, int]]:
        """Number and delay of each copy more."""
        if self._draw(Purpose.FAULT_DUPLICATE, hop) >= self.fault.probability:
            return []
        first = _FIRST_EXTRA + COPIES_MAX * self.index
        return [
            (copy, self._delay_ns(hop, copy)) for copy in range(first, first + self.fault.copies)
        ]

    def _delay_ns(self, hop: Hop, copy: int) -> int:
        share = self._draw(Purpose.FAULT_DELAY, hop._replace(copy=copy))
        return round(share * self.fault.delay_s * 1e9)


class _Replay(Rule[Replay]):
    """It has no effect on copies: it sends an older message again."""

    def _prepare(self, _scenario: Scenario) -> None:
        self._age_ns = round(self.fault.age_s * 1e9)
        self._sent: dict[tuple[ParticipantId, ParticipantId], deque[Sent]] = {}

    def remember(self, sent: Sent) -> None:
        """Note an envelope, and drop those that are too old to be drawn."""
        past = self._sent.setdefault((sent.envelope.source, sent.envelope.target), deque())
        past.append(sent)
        while len(past) > 1 and past[1].now_ns <= sent.now_ns - self._age_ns:
            past.popleft()

    def older(self, hop: Hop, envelope: Envelope) -> Envelope | None:
        """The envelope that comes once more beside this one, if any."""
        if self._draw(Purpose.FAULT_REPLAY, hop) >= self.fault.probability:
            return None
        share = 1.0 - self._draw(Purpose.FAULT_DELAY, hop)
        latest_ns = hop.now_ns - max(1, round(share * self._age_ns))
        past = self._sent[envelope.source, envelope.target]
        return next((sent.envelope for sent in reversed(past) if sent.now_ns <= latest_ns), None)


class _Bandwidth(Rule[Bandwidth]):
    """It has the same effect on every copy of an envelope, when that is sent."""

    def _prepare(self, _scenario: Scenario) -> None:
        self._free_ns: dict[ParticipantId, int] = {}

    def send(self, now_ns: int, envelope: Envelope) -> Fate:
        """Let an envelope wait until the sender has air for it."""
        if self._names and envelope.source not in self._names:
            return PASS
        per_byte_ns = 1e9 / self.fault.bytes_per_s
        free_ns = max(now_ns, self._free_ns.get(envelope.source, 0))
        room = self.fault.queue_bytes
        if room is not None and free_ns - now_ns > room * per_byte_ns:
            return DROP
        free_ns += round(len(envelope.body) * per_byte_ns)
        self._free_ns[envelope.source] = free_ns
        return Fate(delay_ns=free_ns - now_ns)


_RULES: dict[type[Fault], type[Rule[Any]]] = {
    Drop: _Drop,
    Burst: _Burst,
    Delay: _Delay,
    Duplicate: _Duplicate,
    Replay: _Replay,
    Reorder: _Reorder,
    OneWay: _OneWay,
    Partition: _Partition,
    Clog: _Clog,
    Bandwidth: _Bandwidth,
    Range: _Range,
}

_R = TypeVar("_R", bound=Rule[Any])

_Effects = list[tuple[int, Fate]]
"""Faults by their places in the list, and their effects on a copy."""


class PlainFaults:
    """All link faults of a scenario, as `LinkFaults` has them, but for forgeries."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        rules = [
            _RULES[type(fault)](fault, index, scenario, seed)
            for index, fault in enumerate(scenario.faults)
            if type(fault) in _RULES
        ]
        self._rules = rules
        self._cuts = [rule for rule in rules if isinstance(rule, Cut)]
        self._ranges = [rule for rule in rules if isinstance(rule, _Range)]
        self._duplicates = [rule for rule in rules if isinstance(rule, _Duplicate)]
        self._replays = [rule for rule in rules if isinstance(rule, _Replay)]
        self._queues = [rule for rule in rules if isinstance(rule, _Bandwidth)]
        self._roster = scenario.roster
        self._places = {name: i for i, name in enumerate(scenario.roster)}
        self._numbers = self._places | {SUPERVISOR: LINK_WIDTH - 1}
        self._range_m = scenario.radio.range_m
        self._supervisor_range_m = scenario.supervisor.range_m
        self._counts: dict[int, Counter[str]] = {}

    def cuts(self, now_ns: int, source: ParticipantId, target: ParticipantId) -> bool:
        """Whether a message sent now cannot get from one to the other, however near they are."""
        return any(rule.active(now_ns) and rule.cuts(now_ns, source, target) for rule in self._cuts)

    def reach_m(self, now_ns: int, source: ParticipantId, target: ParticipantId) -> float:
        """The range of a link now, before walls."""
        reaches_m = (reach_m for _, reach_m in self._shrunk(now_ns, source, target))
        return min(reaches_m, default=self._whole_m(source, target))

    def interfere(
        self, sent: Sequence[Sent], _rows: np.ndarray, ruled: Decisions, field: LinkGeometry
    ) -> tuple[Sequence[Sent], Decisions, int]:
        """As `Interference` has it."""
        rows = [(to, row, due_ns) for to, row, due_ns in ruled.rows[: ruled.size].tolist()]
        on_air, decided, lost = self.rule(
            sent, rows, lambda one, other, range_m: bool(hears(field, one, other, range_m))
        )
        return (
            on_air,
            Decisions(np.array([*decided, (0, 0, 0)], dtype=np.int64), len(decided)),
            lost,
        )

    def rule(
        self, sent: Sequence[Sent], ruled: Iterable[Row], reaches: Reaches
    ) -> tuple[Sequence[Sent], list[Row], int]:
        """Apply the faults to the decisions of the radio."""
        on_air = list(sent)
        queued = [self._send(each) for each in sent]
        decided: list[Row] = []
        lost = 0
        for (to, row), ruled_copies in groupby(ruled, key=_RECEIVER):
            hop = self._hop(sent[row], to)
            if self._is_lost(hop, to, reaches):
                lost += 1
                continue
            dues_ns = [due_ns for _, _, due_ns in ruled_copies]
            for copy, which, due_ns in self._copies(hop, row, dues_ns, on_air):
                decided.append(
                    (to, which, self._judge(hop._replace(copy=copy), due_ns, queued[row]))
                )
        return on_air, decided, lost

    def pop_stats(self) -> dict[int, dict[str, int]]:
        """Counters of each fault since the last call; faults without effect are left out."""
        counted, self._counts = self._counts, {}
        return {fault: dict(counted[fault]) for fault in sorted(counted)}

    def _send(self, sent: Sent) -> _Effects:
        """The effects on an envelope for all its receivers."""
        for replay in self._replays:
            replay.remember(sent)
        now_ns, envelope = sent.now_ns, sent.envelope
        active = [queue for queue in self._queues if queue.active(now_ns)]
        return [(queue.index, queue.send(now_ns, envelope)) for queue in active]

    def _hop(self, sent: Sent, to: int) -> Hop:
        now_ns, envelope, target = sent.now_ns, sent.envelope, self._roster[to]
        link = self._numbers[envelope.source] * LINK_WIDTH + self._numbers[target]
        return Hop(now_ns, envelope.source, target, link, envelope.sequence)

    def _is_lost(self, hop: Hop, to: int, reaches: Reaches) -> bool:
        lost = False
        for rule, reach_m in self._shrunk(hop.now_ns, hop.source, hop.target):
            if not reaches(self._places[hop.source], to, reach_m):
                self._count(rule.index, "dropped")
                lost = True
        return lost

    def _shrunk(
        self, now_ns: int, source: ParticipantId, target: ParticipantId
    ) -> Iterator[tuple[_Range, float]]:
        whole_m = self._whole_m(source, target)
        for rule in self._ranges:
            if rule.active(now_ns) and rule.concerns(source, target):
                yield rule, rule.fault.reach_m(whole_m)

    def _whole_m(self, source: ParticipantId, target: ParticipantId) -> float:
        return self._supervisor_range_m if SUPERVISOR in {source, target} else self._range_m

    def _copies(
        self, hop: Hop, row: int, dues_ns: list[int], on_air: list[Sent]
    ) -> Iterator[tuple[int, int, int]]:
        """Number, row of on_air and due_ns of each: the radio's own, more of them, and older messages.

        Only what the radio itself delivers can be doubled, or be what an older message comes beside.
        """
        for copy, due_ns in enumerate(dues_ns):
            yield copy, row, due_ns
        arriving_ns = next((due_ns for due_ns in dues_ns if due_ns != DROPPED), DROPPED)
        if arriving_ns == DROPPED:
            return
        for duplicate in self._about(hop, self._duplicates):
            for copy, delay_ns in duplicate.copies(hop):
                self._count(duplicate.index, "doubled")
                yield copy, row, arriving_ns + delay_ns
        for replay in self._about(hop, self._replays):
            older = replay.older(hop, on_air[row].envelope)
            if older is not None:
                self._count(replay.index, "replayed")
                on_air.append(Sent(hop.now_ns, older))
                yield _REPLAYED + replay.index, len(on_air) - 1, arriving_ns

    def _about(self, hop: Hop, rules: list[_R]) -> list[_R]:
        """Those of the rules that are about this link now."""
        now_ns, source, target = hop[:3]
        return [rule for rule in rules if rule.active(now_ns) and rule.concerns(source, target)]

    def _judge(self, hop: Hop, due_ns: int, queued: _Effects) -> int:
        """When a copy arrives that the radio has due then, or DROPPED."""
        if due_ns == DROPPED:
            return DROPPED
        effects = queued + [(rule.index, rule.fate(hop)) for rule in self._about(hop, self._rules)]
        joined = reduce(Fate.joined, (fate for _, fate in effects), PASS)
        for index, fate in effects:
            if fate.dropped:
                self._count(index, "dropped")
            elif not joined.dropped and fate.due_ns(due_ns) > due_ns:
                self._count(index, "delayed")
        return min(joined.due_ns(due_ns), _NEVER_NS)

    def _count(self, index: int, what: str) -> None:
        self._counts.setdefault(index, Counter())[what] += 1
