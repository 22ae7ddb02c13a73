"""Rules on delivery: an inbox holds what was sent, in time, within range and across no cut."""

import math

import numpy as np

from kantor_protocol.base.kernels import Row, kernel
from kantor_worldsim.observers.checkers.delivery_index import (
    add_to_index,
    first_slot,
    next_slot,
    remove_row,
)
from kantor_worldsim.observers.checkers.links import LinkTable, is_cut, range_of
from kantor_worldsim.observers.checkers.state import (
    ALL_FORGED,
    DROPPED,
    FORGED_FIRST,
    CheckerState,
    Limits,
    note_violation,
)
from kantor_worldsim.observers.checkers.violations import (
    CUT,
    NEVER_SENT,
    NUMBER_REUSED,
    OUT_OF_ORDER,
    TOO_FAR,
    UNHEARD,
    WITHHELD,
    WRONG_TARGET,
)
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch


@kernel
def remove_delivery(state: CheckerState, who: int, row: int) -> None:
    """Take a row out of the deliveries that are under way to a participant."""
    state.participants[who].under_way -= 1
    last = state.participants[who].under_way
    remove_row(state.deliveries[who], state.delivery_slots[who], row, last)


@kernel
def _find_delivery(
    state: CheckerState, who: int, source: int, sequence: int, by_ns: int, handed_over: bool
) -> int:
    """The delivery of an envelope that arrived first; negative if there is none.

    handed_over: only what was marked as handed over counts; otherwise all that has arrived by by_ns.
    """
    deliveries, slots = state.deliveries[who], state.delivery_slots[who]
    first = -1
    slot = first_slot(source, sequence, slots)
    while slots[slot] != 0:
        row = slots[slot] - 1
        slot = next_slot(slot, slots)
        if deliveries[row].source != source or deliveries[row].sequence != sequence:
            continue
        there = deliveries[row].handed_over != 0 if handed_over else deliveries[row].due_ns <= by_ns
        if there and (first < 0 or deliveries[row].due_ns < deliveries[first].due_ns):
            first = row
    return first


@kernel
def check_inbox(
    state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int, now_ns: int
) -> None:
    """An inbox holds what had arrived; in virtual time all of it, in order of arrival."""
    step_record = columns.step_records[row]
    who = step_record.place
    deliveries = state.deliveries[who]
    if limits.virtual and state.participants[who].asked == 0:
        for i in range(state.participants[who].under_way):
            deliveries[i].handed_over = deliveries[i].due_ns <= step_record.now_ns
    state.participants[who].asked = limits.virtual and not step_record.present
    before_ns, before_source, before_sequence = 0, 0, 0
    for item in range(step_record.heard_count):
        heard = columns.heard[step_record.heard + item]
        first = _find_delivery(state, who, heard.source, heard.sequence, now_ns, limits.virtual)
        if first < 0:
            note_violation(state, UNHEARD, row, item, 0, 0, 0.0, 0.0)
            continue
        source, sequence, due_ns = (
            deliveries[first].source,
            deliveries[first].sequence,
            deliveries[first].due_ns,
        )
        remove_delivery(state, who, first)
        if limits.virtual and (
            due_ns < before_ns
            or (due_ns == before_ns and 0 <= source < before_source)
            or (due_ns == before_ns and source == before_source and sequence < before_sequence)
        ):
            note_violation(state, OUT_OF_ORDER, row, item, 0, 0, 0.0, 0.0)
        before_ns, before_source, before_sequence = due_ns, source, sequence
    if limits.virtual and step_record.present:
        for i in range(state.participants[who].under_way - 1, -1, -1):
            if deliveries[i].handed_over:
                note_violation(
                    state, WITHHELD, row, 0, deliveries[i].source, deliveries[i].sequence, 0.0, 0.0
                )
                remove_delivery(state, who, i)


@kernel
def post(state: CheckerState, columns: ColumnarBatch, row: int) -> None:
    """Note the envelopes that a step sends. A sequence number is used once."""
    step_record = columns.step_records[row]
    for sent in range(step_record.sent, step_record.sent + step_record.sent_count):
        source, sequence = columns.sent[sent].source, columns.sent[sent].sequence
        if source >= 0:
            participant = state.participants[source]
            if sequence <= participant.number and find_posted(state, source, sequence) >= 0:
                note_violation(state, NUMBER_REUSED, row, 0, sequence, 0, 0.0, 0.0)
            participant.number = max(participant.number, sequence)
            insert_posted(state, source, sequence, columns.sent[sent].target)


@kernel
def insert_posted(state: CheckerState, source: int, sequence: int, target: int) -> None:
    """Add an envelope to the runs: at the end, unless its number is wrong; one that is there already is replaced."""
    runs, participant = state.posted[source], state.participants[source]
    at = _run_before(state, source, sequence)
    goes_on = at >= 0 and runs[at].last + 1 == sequence and runs[at].target == target
    if goes_on and (at + 1 == participant.posted or sequence < runs[at + 1].first):
        runs[at].last = sequence
        return
    if at >= 0 and sequence <= runs[at].last:
        last = runs[at].last
        runs[at].last = sequence - 1
        if last > sequence:
            _insert_run(runs, participant, at + 1, sequence + 1, last, runs[at].target)
        if runs[at].first == sequence:
            runs[at].first, runs[at].last, runs[at].target = sequence, sequence, target
            return
    _insert_run(runs, participant, at + 1, sequence, sequence, target)


@kernel
def _insert_run(
    runs: np.ndarray, participant: Row, at: int, first: int, last: int, target: int
) -> None:
    row = participant.posted
    participant.posted += 1
    while row > at:
        runs[row].first, runs[row].last = runs[row - 1].first, runs[row - 1].last
        runs[row].target = runs[row - 1].target
        row -= 1
    runs[at].first, runs[at].last, runs[at].target = first, last, target


@kernel
def post_forged(state: CheckerState, columns: ColumnarBatch) -> None:
    """Note the envelopes that a fault has put on the air."""
    for row in range(columns.sizes[of.INJECTED]):
        forged, injected = state.forged[0, state.counts[ALL_FORGED]], columns.injected[row]
        forged.source, forged.sequence = injected.source, injected.sequence
        forged.target = injected.target
        state.counts[ALL_FORGED] += 1


@kernel
def _run_before(state: CheckerState, source: int, sequence: int) -> int:
    """The last run of a source's envelopes that begins at or before a number; negative if there is none."""
    low, high = 0, state.participants[source].posted
    while low < high:
        middle = (low + high) // 2
        if state.posted[source, middle].first <= sequence:
            low = middle + 1
        else:
            high = middle
    return low - 1


@kernel
def find_posted(state: CheckerState, source: int, sequence: int) -> int:
    """The run in which a source has sent an envelope under a number; negative if there is none."""
    if source < 0:
        return -1
    at = _run_before(state, source, sequence)
    return at if at >= 0 and sequence <= state.posted[source, at].last else -1


@kernel
def target_of(state: CheckerState, source: int, sequence: int) -> int:
    """The target of the envelope that a source, or a fault, has sent under a number; UNKNOWN_PLACE without one."""
    at = find_posted(state, source, sequence) if sequence < FORGED_FIRST else -1
    if at >= 0:
        return int(state.posted[source, at].target)
    if sequence >= FORGED_FIRST:
        for i in range(state.counts[ALL_FORGED] - 1, -1, -1):
            forged = state.forged[0, i]
            if forged.source == source and forged.sequence == sequence:
                return int(forged.target)
    return of.UNKNOWN_PLACE


@kernel
def check_link(state: CheckerState, links: LinkTable, row: int, source: int, receiver: int) -> None:
    """A link stands between the poses that both had at the time of sending, before the batch moves them."""
    if is_cut(links, source, receiver):
        note_violation(state, CUT, row, 0, 0, 0, 0.0, 0.0)
    range_m = range_of(links, source, receiver)
    dx = state.poses_m[receiver, 0] - state.poses_m[source, 0]
    dy = state.poses_m[receiver, 1] - state.poses_m[source, 1]
    if not dx * dx + dy * dy <= range_m * range_m:
        note_violation(state, TOO_FAR, row, 0, 0, 0, math.hypot(dx, dy), range_m)


@kernel
def check_decision(state: CheckerState, links: LinkTable, columns: ColumnarBatch, row: int) -> None:
    """A delivery decision is about an envelope that was sent, and about a link that stands."""
    decision = columns.decisions[row]
    source, sequence = decision.source, decision.sequence
    receiver, due_ns = decision.target, decision.due_ns
    target = target_of(state, source, sequence)
    if target == of.UNKNOWN_PLACE or receiver < 0:
        note_violation(state, NEVER_SENT, row, 0, 0, 0, 0.0, 0.0)
        return
    if target not in (of.ALL_PLACES, receiver):
        note_violation(state, WRONG_TARGET, row, 0, 0, 0, 0.0, 0.0)
    if due_ns == DROPPED:
        return
    if source >= 0:  # a stranger has no known pose
        check_link(state, links, row, source, receiver)
    row = state.participants[receiver].under_way
    delivery = state.deliveries[receiver, row]
    delivery.source, delivery.sequence = source, sequence
    delivery.due_ns, delivery.handed_over = due_ns, 0
    add_to_index(state.deliveries[receiver], state.delivery_slots[receiver], row)
    state.participants[receiver].under_way += 1
