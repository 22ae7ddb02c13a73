"""Rules on delivery: an inbox holds what was sent, in time, within range and across no cut."""

import math

from kantor_protocol.base.kernels import kernel
from kantor_worldsim.observers.checkers.delivery_index import (
    add_to_index,
    first_slot,
    next_slot,
    remove_row,
)
from kantor_worldsim.observers.checkers.links import LinkTable
from kantor_worldsim.observers.checkers.state import (
    ASKED,
    DROPPED,
    FORGED,
    FORGED_FIRST,
    NUMBER,
    POSTED,
    UNDER_WAY,
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
    state.participants[who, UNDER_WAY] -= 1
    last = state.participants[who, UNDER_WAY]
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
        if deliveries[row, 0] != source or deliveries[row, 1] != sequence:
            continue
        there = deliveries[row, 3] != 0 if handed_over else deliveries[row, 2] <= by_ns
        if there and (first < 0 or deliveries[row, 2] < deliveries[first, 2]):
            first = row
    return first


@kernel
def check_inbox(
    state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int, now_ns: int
) -> None:
    """An inbox holds what had arrived; in virtual time all of it, in order of arrival."""
    step_record = columns.step_records[row]
    who = step_record[of.PLACE]
    deliveries = state.deliveries[who]
    if limits.virtual and state.participants[who, ASKED] == 0:
        for i in range(state.participants[who, UNDER_WAY]):
            deliveries[i, 3] = deliveries[i, 2] <= step_record[of.NOW_NS]
    state.participants[who, ASKED] = limits.virtual and not step_record[of.PRESENT]
    before_ns, before_source, before_sequence = 0, 0, 0
    for item in range(step_record[of.HEARD_COUNT]):
        heard = columns.heard[step_record[of.HEARD] + item]
        first = _find_delivery(
            state, who, heard[of.SOURCE], heard[of.SEQUENCE], now_ns, limits.virtual
        )
        if first < 0:
            note_violation(state, UNHEARD, row, item, 0, 0, 0.0, 0.0)
            continue
        source, sequence, due_ns = deliveries[first, 0], deliveries[first, 1], deliveries[first, 2]
        remove_delivery(state, who, first)
        if limits.virtual and (
            due_ns < before_ns
            or (due_ns == before_ns and 0 <= source < before_source)
            or (due_ns == before_ns and source == before_source and sequence < before_sequence)
        ):
            note_violation(state, OUT_OF_ORDER, row, item, 0, 0, 0.0, 0.0)
        before_ns, before_source, before_sequence = due_ns, source, sequence
    if limits.virtual and step_record[of.PRESENT]:
        for i in range(state.participants[who, UNDER_WAY] - 1, -1, -1):
            if deliveries[i, 3]:
                note_violation(
                    state, WITHHELD, row, 0, deliveries[i, 0], deliveries[i, 1], 0.0, 0.0
                )
                remove_delivery(state, who, i)


@kernel
def post(state: CheckerState, columns: ColumnarBatch, row: int) -> None:
    """Note the envelopes that a step sends. A sequence number is used once."""
    step_record = columns.step_records[row]
    for sent in range(step_record[of.SENT], step_record[of.SENT] + step_record[of.SENT_COUNT]):
        source, sequence = columns.sent[sent, of.SOURCE], columns.sent[sent, of.SEQUENCE]
        if source >= 0:
            participant = state.participants[source]
            if sequence <= participant[NUMBER] and find_posted(state, source, sequence) >= 0:
                note_violation(state, NUMBER_REUSED, row, 0, sequence, 0, 0.0, 0.0)
            participant[NUMBER] = max(participant[NUMBER], sequence)
            _insert_posted(state, source, sequence, columns.sent[sent, of.TARGET])


@kernel
def _insert_posted(state: CheckerState, source: int, sequence: int, target: int) -> None:
    """Add an envelope behind those with the same or a lower number: at the end, unless its number is wrong."""
    posted = state.posted[source]
    row = state.participants[source, POSTED]
    state.participants[source, POSTED] += 1
    while row > 0 and posted[row - 1, 0] > sequence:
        posted[row, 0], posted[row, 1] = posted[row - 1, 0], posted[row - 1, 1]
        row -= 1
    posted[row, 0], posted[row, 1] = sequence, target


@kernel
def post_forged(state: CheckerState, columns: ColumnarBatch) -> None:
    """Note the envelopes that a fault has put on the air."""
    for row in range(columns.sizes[of.INJECTED]):
        forged, injected = state.forged[0, state.counts[FORGED]], columns.injected[row]
        forged[0], forged[1] = injected[of.SOURCE], injected[of.SEQUENCE]
        forged[2] = injected[of.TARGET]
        state.counts[FORGED] += 1


@kernel
def find_posted(state: CheckerState, source: int, sequence: int) -> int:
    """The row of the last envelope that a source has sent under a number; negative if there is none."""
    if source < 0:
        return -1
    low, high = 0, state.participants[source, POSTED]
    while low < high:
        middle = (low + high) // 2
        if state.posted[source, middle, 0] <= sequence:
            low = middle + 1
        else:
            high = middle
    return low - 1 if low > 0 and state.posted[source, low - 1, 0] == sequence else -1


@kernel
def target_of(state: CheckerState, source: int, sequence: int) -> int:
    """The target of the envelope that a source, or a fault, has sent under a number; UNKNOWN_PLACE without one."""
    at = find_posted(state, source, sequence) if sequence < FORGED_FIRST else -1
    if at >= 0:
        return int(state.posted[source, at, 1])
    if sequence >= FORGED_FIRST:
        for i in range(state.counts[FORGED] - 1, -1, -1):
            if state.forged[0, i, 0] == source and state.forged[0, i, 1] == sequence:
                return int(state.forged[0, i, 2])
    return of.UNKNOWN_PLACE


@kernel
def check_link(state: CheckerState, links: LinkTable, row: int, source: int, receiver: int) -> None:
    """A link stands between the poses that both had at the time of sending, before the batch moves them."""
    if links.cut[source, receiver]:
        note_violation(state, CUT, row, 0, 0, 0, 0.0, 0.0)
    range_m = links.range_m[source, receiver]
    dx = state.poses_m[receiver, 0] - state.poses_m[source, 0]
    dy = state.poses_m[receiver, 1] - state.poses_m[source, 1]
    if not dx * dx + dy * dy <= range_m * range_m:
        note_violation(state, TOO_FAR, row, 0, 0, 0, math.hypot(dx, dy), range_m)


@kernel
def check_decision(state: CheckerState, links: LinkTable, columns: ColumnarBatch, row: int) -> None:
    """A delivery decision is about an envelope that was sent, and about a link that stands."""
    decision = columns.decisions[row]
    source, sequence = decision[of.SOURCE], decision[of.SEQUENCE]
    receiver, due_ns = decision[of.TARGET], decision[of.DUE_NS]
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
    row = state.participants[receiver, UNDER_WAY]
    delivery = state.deliveries[receiver, row]
    delivery[0], delivery[1], delivery[2], delivery[3] = source, sequence, due_ns, 0
    add_to_index(state.deliveries[receiver], state.delivery_slots[receiver], row)
    state.participants[receiver, UNDER_WAY] += 1
