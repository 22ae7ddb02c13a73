"""Rules on knowledge: what a message says, its sender has written or heard."""

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import read_int, read_uint
from kantor_protocol.replication.replica_kernels import LENGTH_MAX
from kantor_worldsim.observers.checkers.state import (
    ENTRIES,
    EPOCH,
    FOREIGN_LOG,
    FORGETS,
    LOG,
    NOBODYS,
    SLOT,
    TOLD,
    UNREADABLE,
    CheckerState,
    Limits,
    note_violation,
)
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch


@kernel
def check_gossip(
    state: CheckerState, limits: Limits, columns: ColumnarBatch, row: int, item: int
) -> None:
    """Entries that a participant sends are the ones that their origin consumed, one for one."""
    who, participants = columns.step_records[row, of.PLACE], state.book.shape[0]
    sent = columns.sent[columns.step_records[row, of.SENT] + item]
    payload = columns.payload
    incarnation, version_vector, have_end, at, end = of.parts_of_gossip(
        payload, sent[of.BODY], sent[of.BODY_END]
    )
    if end >= 0 and incarnation != state.book[who, SLOT] // participants:
        now = state.book[who, SLOT] // participants
        note_violation(state, EPOCH, row, item, incarnation, now, 0.0, 0.0)
    if not limits.ledger:
        return
    slots = (
        count_incarnations(payload, version_vector, have_end, participants, limits.claims)
        if end >= 0
        else 0
    )
    if slots == 0 or not is_log(payload, at, end):
        note_violation(state, UNREADABLE, row, item, 0, 0, 0.0, 0.0)
        return
    check_version_vector(state, payload, version_vector, slots, who, row)
    while at < end:
        origin, at = read_uint(payload, at)
        start, at = read_uint(payload, at)
        _span, at = read_uint(payload, at)
        count, at = read_uint(payload, at)
        made = state.shipped[origin, ENTRIES] if origin < state.shipped.shape[0] else 0
        sample = 0
        for told in range(start, start + count):
            step, at = read_int(payload, at)
            units, at = read_uint(payload, at)
            sample += step
            if not (
                told < made
                and state.logs[origin, told, 0] == sample
                and state.logs[origin, told, 1] == units
            ):
                own = origin == state.book[who, SLOT]
                note_violation(state, LOG if own else FOREIGN_LOG, row, origin, start, 0, 0.0, 0.0)
                return


@kernel
def count_incarnations(payload: bytes, at: int, end: int, participants: int, claims: bool) -> int:
    """How many origins the version vector in payload[at:end] is about; 0 if it is none."""
    numbers = 0
    while 0 <= at < end:
        _value, at = read_uint(payload, at)
        numbers += 1
    width = (2 if claims else 1) * participants
    return participants * (numbers // width) if at == end and numbers % width == 0 else 0


@kernel
def check_version_vector(
    state: CheckerState, payload: bytes, at: int, slots: int, who: int, row: int
) -> None:
    """A version vector does not fall, and is about origins that were there."""
    version_vector = state.version_vector[who]
    state.book[who, TOLD] = 1
    for origin in range(max(slots, version_vector.shape[0])):
        length = 0
        if origin < slots:
            length, at = read_uint(payload, at)
        if origin >= version_vector.shape[0]:
            if length > 0:
                note_violation(state, NOBODYS, row, origin, 0, 0, 0.0, 0.0)
            continue
        if length < version_vector[origin]:
            note_violation(state, FORGETS, row, origin, length, version_vector[origin], 0.0, 0.0)
        version_vector[origin] = length


@kernel
def is_log(payload: bytes, at: int, end: int) -> bool:
    """Whether payload[at:end] is a row of suffixes, see News.logs."""
    while 0 <= at < end:
        _origin, at = read_uint(payload, at)
        start, at = read_uint(payload, at)
        _span, at = read_uint(payload, at)
        count, at = read_uint(payload, at)
        if at < 0 or start > LENGTH_MAX or count > end - at:
            return False
        for _ in range(2 * count):
            _value, at = read_uint(payload, at)
    return at == end
