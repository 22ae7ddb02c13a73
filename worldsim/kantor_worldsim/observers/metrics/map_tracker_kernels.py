"""The compiled kernels of the map tracker: logs and scans, followed entry by entry."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import read_int, read_uint
from kantor_protocol.replication.replica_kernels import LENGTH_MAX
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch

NEVER = -1


KIND, VOID, OWN = 3, 4, 8
"""What Books.held says of a cell: its kind, that it is no frontier, that the robot saw it itself."""


# Columns of Books.written and Books.counts, and slots of Books.union.
MADE, TOLD, MATCHED, VOIDS = 0, 1, 2, 3


OWN_CELLS, HELD_CELLS, STOOD = 0, 1, 2


SEEN, FRONTIERS, LOG_BYTES, FAULTS = 0, 1, 2, 3


# Faults in what robots send, and of what their scans say.
UNREADABLE, NOT_ITS_SCANS, FAR_VOID, GAP, SHORT, FORGETS = 0, 1, 2, 3, 4, 5


FOREIGN, MORE, FALSE_CELL = 6, 7, 8


FAULTS_MAX = 100


VOID_CELLS = 2
"""How far from a frontier that it calls none a robot may have stood, in cells along either axis."""


class MapTrackerState(NamedTuple):
    """All that is followed, for the kernels. n robots, p participants, c cells.

    Incarnation e of participant i writes the log of slot e p + i.
    """

    first_tick: npt.NDArray[np.int32]
    """(c,) when anybody first saw a cell, or NEVER."""
    frontier: npt.NDArray[np.bool_]
    """(c,) seen by anybody and truly free and reachable, with a neighbour that nobody has seen."""
    held: npt.NDArray[np.uint8]
    """(n, c) what each robot knows, by its own scans and the logs that it holds."""
    made: npt.NDArray[np.int32]
    """(slots, rows) the entries that each robot's scans gave."""
    told: npt.NDArray[np.int32]
    """(slots, rows) its log as it sends it: the same, and frontiers that are none."""
    version_vector: npt.NDArray[np.int64]
    """(p, slots) the version vector that each has sent last."""
    folded: npt.NDArray[np.int64]
    """(n, slots) entries of others' logs that are in `held`."""
    written: npt.NDArray[np.int64]
    """(slots, 4) entries made and told; of those told, such that were made, and voids."""
    slots: npt.NDArray[np.int64]
    """(p,) the slot of each."""
    counts: npt.NDArray[np.int64]
    """(n, 3) cells seen by itself and known in all; cells in `stood`."""
    stood: npt.NDArray[np.int32]
    """(n, rows) the cells in which a robot stood, in order."""
    union: npt.NDArray[np.int64]
    """(4,) cells seen by anybody; how many are frontiers; bytes of logs that robots sent; faults in
    the last batch."""
    faults: npt.NDArray[np.int64]
    """(rows, 5): fault, act, envelope of it, two numbers."""


class GroundTruth(NamedTuple):
    """What is true, for the kernels."""

    truth: npt.NDArray[np.uint8]
    """(rows, columns)"""
    counting: npt.NDArray[np.bool_]
    """(c,) the cells that can ever be seen."""
    exact: bool
    """Scans have no noise."""


@kernel
def _note(state: MapTrackerState, fault: int, row: int, item: int, a: int, b: int) -> None:
    at = state.union[FAULTS]
    state.union[FAULTS] += 1
    if at < state.faults.shape[0]:
        noted = state.faults[at]
        noted[0], noted[1], noted[2], noted[3], noted[4] = fault, row, item, a, b


@kernel
def is_frontier(known: np.ndarray, mask: int, cell: int, columns: int) -> bool:
    """Whether a 4-neighbour of a cell is unknown. known: (c,), of which only the bits of mask count."""
    column = cell % columns
    return bool(
        (column > 0 and known[cell - 1] & mask == 0)
        or (column + 1 < columns and known[cell + 1] & mask == 0)
        or (cell >= columns and known[cell - columns] & mask == 0)
        or (cell + columns < known.shape[0] and known[cell + columns] & mask == 0)
    )


@kernel
def _renew(state: MapTrackerState, ground: GroundTruth, cell: int) -> None:
    """Whether a cell is a frontier of what anybody has seen."""
    rows, columns = ground.truth.shape
    first, column = state.first_tick, cell % columns
    now = False
    if first[cell] >= 0 and ground.counting[cell] and ground.truth[cell // columns, column] == FREE:
        now = bool(
            (column > 0 and first[cell - 1] < 0)
            or (column + 1 < columns and first[cell + 1] < 0)
            or (cell >= columns and first[cell - columns] < 0)
            or (cell + columns < rows * columns and first[cell + columns] < 0)
        )
    state.union[FRONTIERS] += int(now) - int(state.frontier[cell])
    state.frontier[cell] = now


@kernel
def _stamp(state: MapTrackerState, ground: GroundTruth, cell: int, tick: int) -> None:
    """Somebody sees a cell for the first time."""
    columns = ground.truth.shape[1]
    state.first_tick[cell] = tick
    state.union[SEEN] += ground.counting[cell]
    _renew(state, ground, cell)
    if cell % columns > 0:
        _renew(state, ground, cell - 1)
    if cell % columns + 1 < columns:
        _renew(state, ground, cell + 1)
    if cell >= columns:
        _renew(state, ground, cell - columns)
    if cell + columns < state.first_tick.shape[0]:
        _renew(state, ground, cell + columns)


@kernel
def _hold(state: MapTrackerState, ground: GroundTruth, who: int, entry: int) -> None:
    """A robot learns an entry, its own or another's."""
    cells = state.first_tick.shape[0]
    held = state.held[who]
    if entry >= 3 * cells:
        return
    if entry >= 2 * cells:
        held[entry - 2 * cells] |= VOID
        return
    cell = entry >> 1
    state.counts[who, HELD_CELLS] += held[cell] & KIND == 0 and ground.counting[cell]
    held[cell] = (held[cell] & (VOID | OWN)) | (FREE + (entry & 1))


@kernel
def look(
    first_tick: np.ndarray,
    frontier: np.ndarray,
    held: np.ndarray,
    made: np.ndarray,
    told: np.ndarray,
    version_vector: np.ndarray,
    folded: np.ndarray,
    written: np.ndarray,
    slots: np.ndarray,
    counts: np.ndarray,
    stood: np.ndarray,
    union: np.ndarray,
    faults: np.ndarray,
    truth: np.ndarray,
    counting: np.ndarray,
    exact: bool,
    news: np.ndarray,
    who: int,
    row: int,
    tick: int,
) -> None:
    """A robot takes in what a scan says. news: (k,) entries; `made` has room for them."""
    state = MapTrackerState(
        first_tick,
        frontier,
        held,
        made,
        told,
        version_vector,
        folded,
        written,
        slots,
        counts,
        stood,
        union,
        faults,
    )
    ground = GroundTruth(truth, counting, exact)
    cells, columns = first_tick.shape[0], truth.shape[1]
    for i in range(news.shape[0]):
        entry = news[i]
        made[slots[who], written[slots[who], MADE]] = entry
        written[slots[who], MADE] += 1
        _hold(state, ground, who, entry)
        if entry >= 2 * cells:
            continue
        cell = entry >> 1
        if exact and (truth[cell // columns, cell % columns] == FREE) != (entry & 1 == 0):
            _note(state, FALSE_CELL, row, 0, cell, entry & 1)
        counts[who, OWN_CELLS] += held[who, cell] & OWN == 0 and counting[cell]
        held[who, cell] |= OWN
        if first_tick[cell] < 0:
            _stamp(state, ground, cell, tick)


@kernel
def _is_log(payload: bytes, at: int, end: int, origins: int) -> bool:
    """Whether payload[at:end] is a row of suffixes of bare entries, see News.logs."""
    while 0 <= at < end:
        origin, at = read_uint(payload, at)
        start, at = read_uint(payload, at)
        span, at = read_uint(payload, at)
        count, at = read_uint(payload, at)
        if at < 0 or origin >= origins or start > LENGTH_MAX or count > end - at or count != span:
            return False
        for _ in range(count):
            _step, at = read_int(payload, at)
    return at == end


@kernel
def _is_near(state: MapTrackerState, who: int, cell: int, columns: int) -> bool:
    """Whether a robot has ever stood near a cell."""
    for i in range(state.counts[who, STOOD] - 1, -1, -1):
        stood = state.stood[who, i]
        rows_apart = abs(stood // columns - cell // columns)
        if max(rows_apart, abs(stood % columns - cell % columns)) <= VOID_CELLS:
            return True
    return False


@kernel
def _append(state: MapTrackerState, ground: GroundTruth, who: int, entry: int) -> int:
    """A robot tells the next entry of its log: a fault, or NEVER."""
    cells, slot = state.first_tick.shape[0], state.slots[who]
    written = state.written[slot]
    if 2 * cells <= entry < 3 * cells:
        if not _is_near(state, who, entry - 2 * cells, ground.truth.shape[1]):
            return FAR_VOID
        written[VOIDS] += 1
        _hold(state, ground, who, entry)
    elif written[MATCHED] < written[MADE] and state.made[slot, written[MATCHED]] == entry:
        written[MATCHED] += 1
    else:
        return NOT_ITS_SCANS
    state.told[slot, written[TOLD]] = entry
    written[TOLD] += 1
    return NEVER


@kernel
def _follow_entry(
    state: MapTrackerState, ground: GroundTruth, who: int, origin: int, position: int, entry: int
) -> int:
    """An entry of a slot's log as `who` sends it: a fault, or NEVER."""
    own = origin == state.slots[who]
    if position < state.written[origin, TOLD]:
        same = state.told[origin, position] == entry
        return NEVER if same else NOT_ITS_SCANS if own else FOREIGN
    if not own or who >= state.held.shape[0]:
        return FOREIGN
    if position == state.written[origin, TOLD]:
        return int(_append(state, ground, who, entry))
    return GAP


@kernel
def _follow_version_vector(
    state: MapTrackerState, payload: bytes, at: int, told: int, who: int, row: int, item: int
) -> None:
    """A version vector of `told` slots never falls and never names what nobody has told."""
    robots = state.held.shape[0]
    for origin in range(max(told, state.version_vector.shape[1])):
        length = 0
        if origin < told:
            length, at = read_uint(payload, at)
        if origin >= state.version_vector.shape[1]:
            if length > 0:
                _note(state, MORE, row, item, length, 0)
            continue
        before, state.version_vector[who, origin] = state.version_vector[who, origin], length
        if length < before:
            _note(state, FORGETS, row, item, length, before)
        if origin != state.slots[who] or who >= robots:
            known = state.written[origin, TOLD]
            if length > known:
                _note(state, MORE, row, item, length, known)
        else:
            known = state.written[origin, MADE] + state.written[origin, VOIDS]
            if not known <= length <= known + state.first_tick.shape[0]:
                _note(state, SHORT, row, item, length, known)


@kernel
def _follow_logs(
    state: MapTrackerState,
    ground: GroundTruth,
    columns: ColumnarBatch,
    row: int,
    item: int,
    at: int,
    end: int,
) -> None:
    """The suffixes in payload[at:end], up to the first fault."""
    who, payload = columns.step_records[row, of.PLACE], columns.payload
    while at < end:
        origin, at = read_uint(payload, at)
        position, at = read_uint(payload, at)
        _span, at = read_uint(payload, at)
        count, at = read_uint(payload, at)
        entry = 0
        for _ in range(count):
            step, at = read_int(payload, at)
            entry += step
            fault = _follow_entry(state, ground, who, origin, position, entry)
            if fault != NEVER:
                _note(state, fault, row, item, origin, position)
                return
            position += 1


@kernel
def _follow_news(
    state: MapTrackerState, ground: GroundTruth, columns: ColumnarBatch, row: int, item: int
) -> None:
    """One envelope: its logs, then its version vector, then what the sender holds by it."""
    who = columns.step_records[row, of.PLACE]
    sent = columns.sent[columns.step_records[row, of.SENT] + item]
    payload = columns.payload
    _incarnation, version_vector, have_end, at, end = of.parts_of_gossip(
        payload, sent[of.BODY], sent[of.BODY_END]
    )
    roster, robots = state.slots.shape[0], state.held.shape[0]
    slots = _slots(payload, version_vector, have_end, roster) if end >= 0 else 0
    if slots == 0 or not _is_log(payload, at, end, state.version_vector.shape[1]):
        _note(state, UNREADABLE, row, item, 0, 0)
        return
    if who < robots:
        state.union[LOG_BYTES] += end - at
    _follow_logs(state, ground, columns, row, item, at, end)
    _follow_version_vector(state, payload, version_vector, slots, who, row, item)
    for origin in range(state.version_vector.shape[1] if who < robots else 0):
        last = min(state.version_vector[who, origin], state.written[origin, TOLD])
        if origin != state.slots[who]:
            for i in range(state.folded[who, origin], last):
                _hold(state, ground, who, state.told[origin, i])
            state.folded[who, origin] = max(last, state.folded[who, origin])


@kernel
def _slots(payload: bytes, at: int, end: int, roster: int) -> int:
    """How many slots the version vector in payload[at:end] is for; 0 if it is none."""
    numbers = 0
    while 0 <= at < end:
        _length, at = read_uint(payload, at)
        numbers += 1
    return numbers if at == end and numbers % roster == 0 else 0


@kernel
def follow(
    payload: bytes,
    sizes: np.ndarray,
    step_records: np.ndarray,
    poses_m: np.ndarray,
    heard: np.ndarray,
    sent: np.ndarray,
    decisions: np.ndarray,
    pairs: np.ndarray,
    injected: np.ndarray,
    first_tick: np.ndarray,
    frontier: np.ndarray,
    held: np.ndarray,
    made: np.ndarray,
    told: np.ndarray,
    version_vector: np.ndarray,
    folded: np.ndarray,
    written: np.ndarray,
    slots: np.ndarray,
    counts: np.ndarray,
    stood: np.ndarray,
    union: np.ndarray,
    faults: np.ndarray,
    truth: np.ndarray,
    counting: np.ndarray,
    exact: bool,
) -> None:
    """Follow what is sent in one batch; `told` has room for it."""
    state = MapTrackerState(
        first_tick,
        frontier,
        held,
        made,
        told,
        version_vector,
        folded,
        written,
        slots,
        counts,
        stood,
        union,
        faults,
    )
    ground = GroundTruth(truth, counting, exact)
    columns = ColumnarBatch(
        payload, sizes, step_records, poses_m, heard, sent, decisions, pairs, injected
    )
    for row in range(sizes[of.ACTS]):
        who = step_records[row, of.PLACE]
        if who >= 0 and step_records[row, of.PRESENT]:
            for item in range(step_records[row, of.SENT_COUNT]):
                _follow_news(state, ground, columns, row, item)


@kernel
def find_way(held: np.ndarray, start: int, columns: int, queue: np.ndarray) -> int:
    """A frontier that can be reached from a cell over known free cells, or NEVER.

    held: (c,) as in Books, of one robot; cells in the queue are marked meanwhile. queue: (c,) room.
    """
    reached = 2 * OWN
    count, found = 1, NEVER
    queue[0] = start
    held[start] |= reached
    at = 0
    while at < count:
        cell = queue[at]
        at += 1
        if (
            found == NEVER
            and held[cell] & KIND == FREE
            and held[cell] & VOID == 0
            and is_frontier(held, KIND, cell, columns)
        ):
            found = cell
        column = cell % columns
        for side in range(4):
            beside = cell
            if side == 0 and column > 0:
                beside = cell - 1
            elif side == 1 and column + 1 < columns:
                beside = cell + 1
            elif side == 2 and cell >= columns:
                beside = cell - columns
            elif side == 3 and cell + columns < held.shape[0]:
                beside = cell + columns
            if held[beside] & KIND == FREE and held[beside] & reached == 0:
                held[beside] |= reached
                queue[count] = beside
                count += 1
    for i in range(count):
        held[queue[i]] &= reached - 1
    return found
