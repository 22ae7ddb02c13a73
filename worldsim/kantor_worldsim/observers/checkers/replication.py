"""Rules on replication: a message holds entries of logs as their origins wrote them."""

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import read_int, read_uint
from kantor_worldsim.observers.checkers.state import (
    CheckerState,
    Limits,
    note_violation,
)
from kantor_worldsim.observers.checkers.violations import (
    FOREIGN_LOG,
    FORGETS,
    LOG,
    NO_INCARNATION,
    OTHER_INCARNATION,
    UNREADABLE,
)
from kantor_worldsim.observers.metrics.gossip_reader import ANY_ORIGIN, count_incarnations, is_log
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch


@kernel
def check_gossip(
    state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int, item: int
) -> None:
    """A message names its sender's incarnation, and its entries are those of their origins, one for one."""
    who, roster = columns.step_records[row].place, state.participants.shape[0]
    sent = columns.sent[columns.step_records[row].sent + item]
    payload = columns.payload
    incarnation, version_vector, vector_end, logs, end = of.parts_of_gossip(
        payload, sent.body, sent.body_end
    )
    current = state.participants[who].incarnation_id // roster
    if end >= 0 and incarnation != current:
        note_violation(state, OTHER_INCARNATION, row, item, incarnation, current, 0.0, 0.0)
    if not limits.ledger:
        return
    ids = 0
    if end >= 0:
        parts = 2 if limits.claims else 1
        ids = count_incarnations(payload, version_vector, vector_end, roster, parts)
    if ids == 0 or not is_log(payload, logs, end, 2, ANY_ORIGIN):
        note_violation(state, UNREADABLE, row, item, 0, 0, 0.0, 0.0)
        return
    check_version_vector(state, payload, version_vector, ids, who, row)
    while logs < end:
        logs = check_suffix(state, payload, logs, who, row)
        if logs < 0:
            return


@kernel
def check_suffix(state: CheckerState, payload: bytes, at: int, who: int, row: int) -> int:
    """One suffix of a log; the position after it, or less than 0 for a violation."""
    origin, at = read_uint(payload, at)
    start, at = read_uint(payload, at)
    _span, at = read_uint(payload, at)
    count, at = read_uint(payload, at)
    written = state.shipped[origin].entries if origin < state.shipped.shape[0] else 0
    sample = 0
    for position in range(start, start + count):
        step, at = read_int(payload, at)
        units, at = read_uint(payload, at)
        sample += step
        if not (
            position < written
            and state.logs[origin, position].sample == sample
            and state.logs[origin, position].units == units
        ):
            own = origin == state.participants[who].incarnation_id
            note_violation(state, LOG if own else FOREIGN_LOG, row, origin, start, 0, 0.0, 0.0)
            return -1
    return at


@kernel
def check_version_vector(
    state: CheckerState, payload: bytes, at: int, ids: int, who: int, row: int
) -> None:
    """A version vector of so many incarnation ids does not fall, and is about incarnations that were there."""
    version_vector = state.version_vector[who]
    state.participants[who].vector_sent = 1
    for origin in range(max(ids, version_vector.shape[0])):
        length = 0
        if origin < ids:
            length, at = read_uint(payload, at)
        if origin >= version_vector.shape[0]:
            if length > 0:
                note_violation(state, NO_INCARNATION, row, origin, 0, 0, 0.0, 0.0)
            continue
        if length < version_vector[origin]:
            note_violation(state, FORGETS, row, origin, length, version_vector[origin], 0.0, 0.0)
        version_vector[origin] = length
