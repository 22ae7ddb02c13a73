"""Rules on delivery: an inbox holds what was sent, in time, within range and across no cut."""

import math

from kantor_protocol.base.kernels import kernel
from kantor_worldsim.observers.checkers.state import (
    AGAIN,
    CUT,
    FLYING,
    FOR_ANOTHER,
    FORGED,
    FORGED_FIRST,
    NEVER_SENT,
    NUMBER,
    OPEN,
    OUT_OF_TURN,
    POSTED,
    TOO_FAR,
    UNHEARD,
    WITHHELD,
    CheckerState,
    Limits,
    note_violation,
)
from kantor_worldsim.radio.channel import DROPPED
from kantor_worldsim.radio.fault_kernels import FaultTable, reach_m, severs
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch


@kernel
def land(state: CheckerState, who: int, row: int) -> None:
    """Take a row out of what is on its way to somebody."""
    flights = state.flights[who]
    state.book[who, FLYING] -= 1
    last = state.book[who, FLYING]
    for column in range(4):
        flights[row, column] = flights[last, column]


@kernel
def check_inbox(
    state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int, now_ns: int
) -> None:
    """What was heard had arrived; in virtual time also: all that had arrived, in order of arrival."""
    step_record = columns.step_records[row]
    who = step_record[of.PLACE]
    flights = state.flights[who]
    if state.book[who, OPEN] == 0:
        by_ns = step_record[of.NOW_NS] if limits.virtual else now_ns
        for i in range(state.book[who, FLYING]):
            flights[i, 3] = flights[i, 2] <= by_ns
    state.book[who, OPEN] = limits.virtual and not step_record[of.PRESENT]
    before_ns, before_source, before_sequence = 0, 0, 0
    for item in range(step_record[of.HEARD_COUNT]):
        heard = columns.heard[step_record[of.HEARD] + item]
        first = -1  # the copy that arrived first
        for i in range(state.book[who, FLYING]):
            if (
                flights[i, 0] == heard[of.SOURCE]
                and flights[i, 1] == heard[of.SEQUENCE]
                and flights[i, 3]
                and (first < 0 or flights[i, 2] < flights[first, 2])
            ):
                first = i
        if first < 0:
            note_violation(state, UNHEARD, row, item, 0, 0, 0.0, 0.0)
            continue
        source, sequence, due_ns = flights[first, 0], flights[first, 1], flights[first, 2]
        land(state, who, first)
        if limits.virtual and (
            due_ns < before_ns
            or (due_ns == before_ns and 0 <= source < before_source)
            or (due_ns == before_ns and source == before_source and sequence < before_sequence)
        ):
            note_violation(state, OUT_OF_TURN, row, item, 0, 0, 0.0, 0.0)
        before_ns, before_source, before_sequence = due_ns, source, sequence
    if limits.virtual and step_record[of.PRESENT]:
        for i in range(state.book[who, FLYING] - 1, -1, -1):
            if flights[i, 3]:
                note_violation(state, WITHHELD, row, 0, flights[i, 0], flights[i, 1], 0.0, 0.0)
                land(state, who, i)


@kernel
def post(state: CheckerState, columns: ColumnarBatch, row: int) -> None:
    """Note the envelopes that a step sends; a sequence number is used once."""
    step_record = columns.step_records[row]
    for sent in range(step_record[of.SENT], step_record[of.SENT] + step_record[of.SENT_COUNT]):
        source, sequence = columns.sent[sent, of.SOURCE], columns.sent[sent, of.SEQUENCE]
        if source >= 0:
            book = state.book[source]
            if sequence <= book[NUMBER] and find_posted(state, source, sequence) >= 0:
                note_violation(state, AGAIN, row, 0, sequence, 0, 0.0, 0.0)
            book[NUMBER] = max(book[NUMBER], sequence)
            posted = state.posted[source, book[POSTED]]
            posted[0], posted[1] = sequence, columns.sent[sent, of.TARGET]
            book[POSTED] += 1


@kernel
def post_forged(state: CheckerState, columns: ColumnarBatch) -> None:
    """Note the envelopes that a fault has put on the air."""
    for row in range(columns.sizes[of.INJECTED]):
        forged, injected = state.forged[0, state.found[FORGED]], columns.injected[row]
        forged[0], forged[1] = injected[of.SOURCE], injected[of.SEQUENCE]
        forged[2] = injected[of.TARGET]
        state.found[FORGED] += 1


@kernel
def find_posted(state: CheckerState, source: int, sequence: int) -> int:
    """The row in which a source has sent something under this number last; negative if it has not."""
    if source >= 0:
        for i in range(state.book[source, POSTED] - 1, -1, -1):
            if state.posted[source, i, 0] == sequence:
                return i
    return -1


@kernel
def target_of(state: CheckerState, source: int, sequence: int) -> int:
    """For whom somebody, or a fault, has sent something under this number; STRANGER if nobody has."""
    at = find_posted(state, source, sequence) if sequence < FORGED_FIRST else -1
    if at >= 0:
        return int(state.posted[source, at, 1])
    if sequence >= FORGED_FIRST:
        for i in range(state.found[FORGED] - 1, -1, -1):
            if state.forged[0, i, 0] == source and state.forged[0, i, 1] == sequence:
                return int(state.forged[0, i, 2])
    return of.STRANGER


@kernel
def check_link(
    state: CheckerState,
    limits: Limits,
    links: FaultTable,
    row: int,
    now_ns: int,
    source: int,
    receiver: int,
) -> None:
    """By the places that both had at the time of sending, before the batch moves them."""
    range_m = (
        limits.supervisor_range_m if limits.supervisor in (source, receiver) else limits.range_m
    )
    if links.rules.shape[0] > 0:
        if severs(links, now_ns, source, receiver):
            note_violation(state, CUT, row, 0, 0, 0, 0.0, 0.0)
        range_m = reach_m(links, now_ns, source, receiver, range_m)
    dx = state.poses_m[receiver, 0] - state.poses_m[source, 0]
    dy = state.poses_m[receiver, 1] - state.poses_m[source, 1]
    if not dx * dx + dy * dy <= range_m * range_m:
        note_violation(state, TOO_FAR, row, 0, 0, 0, math.hypot(dx, dy), range_m)


@kernel
def check_decision(
    state: CheckerState,
    limits: Limits,
    links: FaultTable,
    columns: ColumnarBatch,
    row: int,
    now_ns: int,
) -> None:
    """A delivery decision is about an envelope that was sent, and about a link that stands."""
    decision = columns.decisions[row]
    source, sequence = decision[of.SOURCE], decision[of.SEQUENCE]
    receiver, due_ns = decision[of.TARGET], decision[of.DUE_NS]
    target = target_of(state, source, sequence)
    if target == of.STRANGER or receiver < 0:
        note_violation(state, NEVER_SENT, row, 0, 0, 0, 0.0, 0.0)
        return
    if target not in (of.EVERYBODY_PLACE, receiver):
        note_violation(state, FOR_ANOTHER, row, 0, 0, 0, 0.0, 0.0)
    if due_ns == DROPPED:
        return
    if source >= 0:  # nobody knows where a stranger is
        check_link(state, limits, links, row, now_ns, source, receiver)
    flight = state.flights[receiver, state.book[receiver, FLYING]]
    flight[0], flight[1], flight[2], flight[3] = source, sequence, due_ns, 0
    state.book[receiver, FLYING] += 1
