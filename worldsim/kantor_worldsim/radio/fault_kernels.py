"""The link faults of a scenario as a table, and the kernels that apply it.

Every fault is a rule. For a copy of an envelope, on a link, at the time of sending, its decision is: pass, deliver
later, or drop; some rules also send more copies, or shorten the range. Decisions of several rules are combined: a
drop wins, delays add up, and of several holds the longest counts. So their order does not matter.

Every draw is keyed by (seed, purpose, link, sequence, fault and copy), or by a slot of time, and
independent of what happened before: one more message changes no other draw, and faults that are appended to a list
leave those before them as they were.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.kernels import integers, kernel
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.links import (
    COPIES_MAX,
    Bandwidth,
    Burst,
    Clog,
    Delay,
    Drop,
    Duplicate,
    Hostile,
    OneWay,
    OnLinks,
    Partition,
    Range,
    Reorder,
    Replay,
)
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.radio.channel import DROPPED, LinkGeometry, hears, link_of

DUE_MAX_NS = 2**62
"""The latest due time of a copy, after every mission: such a copy does not arrive. Sums of two stay within 64 bits."""
_SLOTS_IN_A_STATE = 10
"""Slots in the shorter mean time of a burst."""
_FLAP_SHARE = 0.5

# The last word of a draw's counter: index of the fault, and of the copy that it may affect.
FAULT_SHIFT = 16
_FIRST_EXTRA = 2  # the radio itself makes one copy, or two
_FORGED = 1 << 14
_REPLAYED = 1 << 15

# Kinds of rules: those that may drop a copy, those that may delay one, and the others.
_DROP, _BURST, _ONE_WAY, _PARTITION, _DELAY, _REORDER = 0, 1, 2, 3, 4, 5
_CLOG, _BANDWIDTH, _RANGE, _DUPLICATE, _REPLAY, _HOSTILE = 6, 7, 8, 9, 10, 11

RULE = integers("kind", "fault", "from_ns", "until_ns", "at", "span_ns", "copies")
"""A row of FaultTable.rules: kind, index in the scenario's list, window. at: row of a cut in `severed`, column of a queue
in `queued`. span_ns: slot of a burst or of a cut that flaps, greatest age of a replayed message."""

EXTRA = integers("first", "rule", "latest_ns", "on_air")
"""An extra envelope: row of the first decision on the delivered envelope with which it comes, rule, the latest time of
sending of an older message, and its index on the air, or less than 0 where there is none."""

# Columns of FaultTable.numbers, by kind.
_PROBABILITY = 0  # drop, duplicate, reorder, replay, hostile
_DROP_GOOD, _DROP_BAD, _TO_BAD, _TO_GOOD = 0, 1, 2, 3  # burst
_DELAY_S, _JITTER_S = 0, 1  # delay
_LATER_S = 1  # duplicate, reorder
_SHARE = 0  # partition
_RANGE_M, _FACTOR = 0, 1  # range; a negative range_m is none
_NUMBER_COLUMNS = 4

# Columns of the counters, in the order of `FaultStats`.
_DROPPED, _DELAYED, _DOUBLED, _REPLAYS, _FORGERIES = 0, 1, 2, 3, 4


class FaultTable(NamedTuple):
    """The link faults of a scenario for kernels. n faults, p participants."""

    seed: int
    robots_m: float
    """How far links reach without faults."""
    supervisors_m: float
    """The same of links of the supervisor."""
    rules: npt.NDArray[Any]
    """(n,) of RULE."""
    numbers: npt.NDArray[np.float64]
    """(n, 4), by kind."""
    named: npt.NDArray[np.uint8]
    """(n, p): whether a fault applies to the links of a participant."""
    severed: npt.NDArray[np.uint8]
    """(cuts, p, p): whether a cut, while it holds, severs the link from source to target."""


class _Hop(NamedTuple):
    """A copy of an envelope on a link."""

    now_ns: int
    source: int
    target: int
    link: int
    sequence: int
    copy: int


@kernel
def in_burst(seed: int, link: int, index: int, slot: int, to_bad: float, to_good: float) -> bool:
    """Whether a link is bad in a slot; in slot 0 it is good. to_bad + to_good is at most 1.

    A draw below to_bad makes a link bad in every state, one from 1 - to_good on makes it good, and any other
    leaves it as it is. So the last draw that decides is found by going back slot by slot.
    """
    while slot > 0:
        draw = uniform(seed, Purpose.FAULT_BURST.value, link, slot, index)
        if draw < to_bad:
            return True
        if draw >= 1.0 - to_good:
            return False
        slot -= 1
    return False


@kernel
def _applies(table: FaultTable, rule: int, now_ns: int, source: int, target: int) -> bool:
    """Whether a fault's window holds and the fault applies to the link."""
    row = table.rules[rule]
    if not row.from_ns <= now_ns < row.until_ns:
        return False
    return table.named[rule, source] != 0 or table.named[rule, target] != 0


@kernel
def _draw(table: FaultTable, rule: int, purpose: int, hop: _Hop, copy: int) -> float:
    index = table.rules[rule].fault << FAULT_SHIFT | copy
    return uniform(table.seed, purpose, hop.link, hop.sequence, index)


@kernel
def _cuts(table: FaultTable, rule: int, now_ns: int, source: int, target: int) -> bool:
    """Whether a cut whose window is open severs a link."""
    row = table.rules[rule]
    if table.severed[row.at, source, target] == 0:
        return False
    if row.span_ns == 0:
        return True
    index, slot = row.fault << FAULT_SHIFT, now_ns // row.span_ns
    draw = uniform(table.seed, Purpose.FAULT_FLAP.value, 0, slot, index)
    return draw < table.numbers[rule, _SHARE]


@kernel
def _is_in(table: FaultTable, source: int, target: int) -> bool:
    count = table.named.shape[1]
    return 0 <= source < count and 0 <= target < count


@kernel
def severs(table: FaultTable, now_ns: int, source: int, target: int) -> bool:
    """Whether a cut severs the link between two indices in the roster now, whatever their distance."""
    if _is_in(table, source, target):
        for rule in range(table.rules.shape[0]):
            kind = table.rules[rule].kind
            if (
                kind in (_ONE_WAY, _PARTITION)
                and _applies(table, rule, now_ns, source, target)
                and _cuts(table, rule, now_ns, source, target)
            ):
                return True
    return False


@kernel
def _reach_m(table: FaultTable, rule: int, whole_m: float) -> float:
    """Range in metres that one fault leaves of whole_m."""
    range_m = table.numbers[rule, _RANGE_M]
    return min(whole_m, range_m) if range_m >= 0.0 else whole_m * table.numbers[rule, _FACTOR]


@kernel
def reach_m(table: FaultTable, now_ns: int, source: int, target: int, whole_m: float) -> float:
    """Range in metres that faults leave now of a link between two indices in the roster, before walls."""
    least_m = whole_m
    if _is_in(table, source, target):
        for rule in range(table.rules.shape[0]):
            if table.rules[rule].kind == _RANGE and _applies(table, rule, now_ns, source, target):
                least_m = min(least_m, _reach_m(table, rule, whole_m))
    return least_m


@kernel
def _is_lost(
    table: FaultTable,
    geometry: LinkGeometry,
    hop: _Hop,
    effects: np.ndarray,
) -> bool:
    """Whether a receiver is beyond the range that faults leave; each fault that excludes it is counted."""
    lost = False
    by_supervisor = geometry.supervisor in (hop.source, hop.target)
    whole_m = table.supervisors_m if by_supervisor else table.robots_m
    for rule in range(table.rules.shape[0]):
        if table.rules[rule].kind != _RANGE:
            continue
        if not _applies(table, rule, hop.now_ns, hop.source, hop.target):
            continue
        if not hears(geometry, hop.source, hop.target, _reach_m(table, rule, whole_m)):
            effects[rule, _DROPPED] += 1
            lost = True
    return lost


@kernel
def _drops(table: FaultTable, rule: int, hop: _Hop, queued: np.ndarray) -> bool:
    """Whether a fault drops a copy. queued: waiting times of its envelope, see `apply_rules`."""
    row, numbers = table.rules[rule], table.numbers[rule]
    kind = row.kind
    if kind == _BANDWIDTH:
        return queued[row.at] < 0
    if kind > _PARTITION or not _applies(table, rule, hop.now_ns, hop.source, hop.target):
        return False
    if kind in (_ONE_WAY, _PARTITION):
        return _cuts(table, rule, hop.now_ns, hop.source, hop.target)
    probability = numbers[_PROBABILITY]
    if kind == _BURST:
        index, slot = row.fault << FAULT_SHIFT, hop.now_ns // row.span_ns
        bad = in_burst(table.seed, hop.link, index, slot, numbers[_TO_BAD], numbers[_TO_GOOD])
        probability = numbers[_DROP_BAD] if bad else numbers[_DROP_GOOD]
    return _draw(table, rule, Purpose.FAULT_DROP.value, hop, hop.copy) < probability


@kernel
def _delays(table: FaultTable, rule: int, hop: _Hop, queued: np.ndarray) -> tuple[int, int]:
    """Delay of a copy by a fault, and the earliest time at which the fault lets it arrive, in ns."""
    row, numbers = table.rules[rule], table.numbers[rule]
    kind = row.kind
    if kind == _BANDWIDTH:
        return queued[row.at], 0
    if not _DELAY <= kind <= _CLOG or not _applies(table, rule, hop.now_ns, hop.source, hop.target):
        return 0, 0
    if kind == _CLOG:
        return 0, row.until_ns
    if kind == _DELAY:
        delay_s = numbers[_DELAY_S]
        if numbers[_JITTER_S] > 0.0:
            draw = _draw(table, rule, Purpose.FAULT_DELAY.value, hop, hop.copy)
            delay_s += draw * numbers[_JITTER_S]
        return round(delay_s * 1e9), 0
    draw = _draw(table, rule, Purpose.FAULT_REORDER.value, hop, hop.copy)
    share = draw / numbers[_PROBABILITY]
    return (round(share * numbers[_LATER_S] * 1e9) if share < 1.0 else 0), 0


@kernel
def _decide(
    table: FaultTable, hop: _Hop, due_ns: int, queued: np.ndarray, effects: np.ndarray
) -> int:
    """Time of arrival under all faults of a copy that the radio delivers at due_ns, or DROPPED."""
    if due_ns == DROPPED:
        return DROPPED
    dropped = False
    for rule in range(table.rules.shape[0]):
        if _drops(table, rule, hop, queued):
            effects[rule, _DROPPED] += 1
            dropped = True
    if dropped:
        return DROPPED
    later_ns, not_before_ns = 0, 0
    for rule in range(table.rules.shape[0]):
        delay_ns, held_ns = _delays(table, rule, hop, queued)
        if delay_ns > 0 or held_ns > due_ns:
            effects[rule, _DELAYED] += 1
        later_ns += min(delay_ns, DUE_MAX_NS - later_ns)
        not_before_ns = max(not_before_ns, held_ns)
    return max(due_ns + min(later_ns, DUE_MAX_NS - due_ns), not_before_ns)


@kernel
def _hop_of(sent: np.ndarray, decided: np.ndarray, first: int, supervisor: int) -> _Hop:
    target, row = decided[first, 0], decided[first, 1]
    source = sent[row, 1]
    return _Hop(sent[row, 0], source, target, link_of(source, target, supervisor), sent[row, 2], 0)


@kernel
def _with(hop: _Hop, copy: int) -> _Hop:
    return _Hop(hop.now_ns, hop.source, hop.target, hop.link, hop.sequence, copy)


@kernel
def _end_of(decided: np.ndarray, count: int, first: int) -> int:
    """The row after the radio's decisions on one envelope for one receiver."""
    end = first + 1
    while (
        end < count
        and decided[end, 0] == decided[first, 0]
        and decided[end, 1] == decided[first, 1]
    ):
        end += 1
    return end


@kernel
def _arrival(decided: np.ndarray, first: int, end: int) -> int:
    """Time of arrival of the first copy that the radio itself does not drop; DROPPED if there is none."""
    for row in range(first, end):
        if decided[row, 2] != DROPPED:
            return decided[row, 2]
    return DROPPED


@kernel
def _put(out: np.ndarray, made: int, receiver: int, on_air: int, due_ns: int) -> int:
    if made < out.shape[0]:
        out[made, 0], out[made, 1], out[made, 2] = receiver, on_air, due_ns
    return made + 1


@kernel
def _double(
    table: FaultTable,
    hop: _Hop,
    row: int,
    arrival_ns: int,
    queued: np.ndarray,
    effects: np.ndarray,
    made: int,
    out: np.ndarray,
) -> int:
    """Decide on duplicates of an envelope that arrives; returns the number of decisions so far."""
    for rule in range(table.rules.shape[0]):
        if table.rules[rule].kind != _DUPLICATE:
            continue
        if not _applies(table, rule, hop.now_ns, hop.source, hop.target):
            continue
        draw = _draw(table, rule, Purpose.FAULT_DUPLICATE.value, hop, 0)
        if draw >= table.numbers[rule, _PROBABILITY]:
            continue
        copy = _FIRST_EXTRA + COPIES_MAX * table.rules[rule].fault
        for _ in range(table.rules[rule].copies):
            effects[rule, _DOUBLED] += 1
            share = _draw(table, rule, Purpose.FAULT_DELAY.value, hop, copy)
            due_ns = arrival_ns + round(share * table.numbers[rule, _LATER_S] * 1e9)
            due_ns = _decide(table, _with(hop, copy), due_ns, queued, effects)
            made = _put(out, made, hop.target, row, due_ns)
            copy += 1
    return made


@kernel
def find_extra(
    faults: tuple[Any, ...],
    links: tuple[Any, ...],
    radioed: tuple[Any, ...],
    effects: np.ndarray,
    extra: np.ndarray,
) -> int:
    """Find the extra envelopes that come with delivered ones: older messages and forgeries. Returns their number.

    faults, links: the fields of a FaultTable and a LinkGeometry. radioed: `sent` and `decided` of an Interference, and
    the number of rows of the latter. extra (rows,) of EXTRA, but for
    what is on the air, which `LinkFaults` fills. Extra envelopes beyond its rows are only counted. effects: scratch, see
    `apply_rules`.
    """
    table, geometry = FaultTable(*faults), LinkGeometry(*links)
    sent, decided, count = radioed
    found = 0
    end = 0
    while end < count:
        first = end
        end = _end_of(decided, count, first)
        hop = _hop_of(sent, decided, first, geometry.supervisor)
        if _arrival(decided, first, end) == DROPPED:
            continue
        if _is_lost(table, geometry, hop, effects):
            continue
        for rule in range(table.rules.shape[0]):
            kind = table.rules[rule].kind
            if kind < _REPLAY or not _applies(table, rule, hop.now_ns, hop.source, hop.target):
                continue
            replays = kind == _REPLAY
            purpose = Purpose.FAULT_REPLAY.value if replays else Purpose.FAULT_HOSTILE.value
            if _draw(table, rule, purpose, hop, 0) >= table.numbers[rule, _PROBABILITY]:
                continue
            latest_ns = hop.now_ns
            if replays:
                share = 1.0 - _draw(table, rule, Purpose.FAULT_DELAY.value, hop, 0)
                latest_ns -= max(1, round(share * table.rules[rule].span_ns))
            if found < extra.shape[0]:
                row = extra[found]
                row.first, row.rule, row.latest_ns = first, rule, latest_ns
            found += 1
    return found


@kernel
def apply_rules(
    faults: tuple[Any, ...],
    links: tuple[Any, ...],
    radioed: tuple[Any, ...],
    queued: np.ndarray,
    extra: np.ndarray,
    effects: np.ndarray,
    fault_stats: np.ndarray,
    out: np.ndarray,
) -> tuple[int, int]:
    """Apply the rules to the radio's decisions. Returns the number of decisions and of receivers out of range.

    faults, links: the fields of a FaultTable and a LinkGeometry. radioed: `sent` and `decided` of an Interference, and
    the number of rows of the latter. queued (envelopes, queues): waiting
    time of each envelope in ns, or DROPPED. extra (rows,) of EXTRA: see `find_extra`; after the last one comes a row whose
    `first` is less than 0, or none. effects (n, 5): scratch. fault_stats (n, 5): the effects of each fault are added.
    out (rows, 3): the decisions; if they do not fit, nothing else has changed.
    """
    table, geometry = FaultTable(*faults), LinkGeometry(*links)
    sent, decided, count = radioed
    effects[:] = 0
    made = 0
    lost = 0
    passed = 0
    end = 0
    while end < count:
        first = end
        end = _end_of(decided, count, first)
        hop = _hop_of(sent, decided, first, geometry.supervisor)
        to, row = decided[first, 0], decided[first, 1]
        if _is_lost(table, geometry, hop, effects):
            lost += 1
            continue
        for i in range(first, end):
            due_ns = _decide(table, _with(hop, i - first), decided[i, 2], queued[row], effects)
            made = _put(out, made, to, row, due_ns)
        arrival_ns = _arrival(decided, first, end)
        if arrival_ns == DROPPED:
            continue
        made = _double(table, hop, row, arrival_ns, queued[row], effects, made, out)
        while passed < extra.shape[0] and extra[passed].first == first:
            rule, on_air = extra[passed].rule, extra[passed].on_air
            passed += 1
            if on_air >= 0:
                replays = table.rules[rule].kind == _REPLAY
                effects[rule, _REPLAYS if replays else _FORGERIES] += 1
                copy = (_REPLAYED if replays else _FORGED) + table.rules[rule].fault
                due_ns = _decide(table, _with(hop, copy), arrival_ns, queued[row], effects)
                made = _put(out, made, to, on_air, due_ns)
    if made <= out.shape[0]:
        for rule in range(table.rules.shape[0]):
            for counter in range(effects.shape[1]):
                fault_stats[rule, counter] += effects[rule, counter]
    return made, lost


def end_ns(fault: Fault) -> int:
    """End of a fault's window; DUE_MAX_NS if it has none."""
    return DUE_MAX_NS if fault.until_ns is None else fault.until_ns


class _Row(NamedTuple):
    """Entries of the table that depend on the kind of a fault."""

    kind: int
    numbers: tuple[float, ...] = ()
    span_ns: int = 0
    copies: int = 0


def _burst(fault: Burst) -> _Row:
    slot_s = min(fault.good_s, fault.bad_s) / _SLOTS_IN_A_STATE
    chances = slot_s / fault.good_s, slot_s / fault.bad_s
    return _Row(_BURST, (fault.drop_good, fault.drop_bad, *chances), round(slot_s * 1e9))


def _range(fault: Range) -> _Row:
    return _Row(_RANGE, (-1.0 if fault.range_m is None else fault.range_m, fault.factor or 0.0))


def _partition(fault: Partition) -> _Row:
    share = fault.flap_share or _FLAP_SHARE
    return _Row(_PARTITION, (share,), round((fault.flap_s or 0.0) * 1e9))


KINDS: dict[type[Fault], Callable[[Any], _Row]] = {
    Drop: lambda fault: _Row(_DROP, (fault.probability,)),
    Burst: _burst,
    OneWay: lambda _: _Row(_ONE_WAY),
    Partition: _partition,
    Delay: lambda fault: _Row(_DELAY, (fault.delay_s, fault.jitter_s)),
    Reorder: lambda fault: _Row(_REORDER, (fault.probability, fault.hold_s)),
    Clog: lambda _: _Row(_CLOG),
    Bandwidth: lambda _: _Row(_BANDWIDTH),
    Range: _range,
    Duplicate: lambda fault: _Row(
        _DUPLICATE, (fault.probability, fault.delay_s), copies=fault.copies
    ),
    Replay: lambda fault: _Row(_REPLAY, (fault.probability,), round(fault.age_s * 1e9)),
    Hostile: lambda fault: _Row(_HOSTILE, (fault.probability,)),
}


def table_of(scenario: Scenario, seed: int) -> FaultTable:
    """The link faults of a scenario, in the order of its list."""
    roster = scenario.roster
    faults = [(i, fault) for i, fault in enumerate(scenario.faults) if type(fault) in KINDS]
    rules = np.zeros(len(faults), dtype=RULE)
    numbers = np.zeros((len(faults), _NUMBER_COLUMNS))
    named = np.ones((len(faults), len(roster)), dtype=np.uint8)
    severed: list[list[list[bool]]] = []
    queues = 0
    for rule, (place, fault) in enumerate(faults):
        row, at = KINDS[type(fault)](fault), 0
        if isinstance(fault, OneWay | Partition):
            at, cuts = len(severed), fault.severs(roster)
            severed.append([[cuts(one, other) for other in roster] for one in roster])
        elif isinstance(fault, Bandwidth):
            at, queues = queues, queues + 1
        elif isinstance(fault, OnLinks) and fault.robots:
            named[rule] = [name in fault.robots for name in roster]
        window_ns = fault.from_ns, end_ns(fault)
        rules[rule] = row.kind, place, *window_ns, at, row.span_ns, row.copies
        numbers[rule, : len(row.numbers)] = row.numbers
    shape = len(severed), len(roster), len(roster)
    ranges_m = scenario.radio.range_m, scenario.supervisor.range_m
    return FaultTable(
        seed, *ranges_m, rules, numbers, named, np.array(severed, dtype=np.uint8).reshape(shape)
    )
