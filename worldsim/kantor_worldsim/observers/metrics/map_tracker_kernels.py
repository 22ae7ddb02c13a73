"""The compiled kernels of the map tracker: logs and scans, followed entry by entry."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import take_int, take_uint
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
    have: npt.NDArray[np.int64]
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
def _note(books: MapTrackerState, fault: int, row: int, item: int, a: int, b: int) -> None:
    at = books.union[FAULTS]
    books.union[FAULTS] += 1
    if at < books.faults.shape[0]:
        noted = books.faults[at]
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
def _renew(books: MapTrackerState, land: GroundTruth, cell: int) -> None:
    """Whether a cell is a frontier of what anybody has seen."""
    rows, columns = land.truth.shape
    first, column = books.first_tick, cell % columns
    now = False
    if first[cell] >= 0 and land.counting[cell] and land.truth[cell // columns, column] == FREE:
        now = bool(
            (column > 0 and first[cell - 1] < 0)
            or (column + 1 < columns and first[cell + 1] < 0)
            or (cell >= columns and first[cell - columns] < 0)
            or (cell + columns < rows * columns and first[cell + columns] < 0)
        )
    books.union[FRONTIERS] += int(now) - int(books.frontier[cell])
    books.frontier[cell] = now


@kernel
def _stamp(books: MapTrackerState, land: GroundTruth, cell: int, tick: int) -> None:
    """Somebody sees a cell for the first time."""
    columns = land.truth.shape[1]
    books.first_tick[cell] = tick
    books.union[SEEN] += land.counting[cell]
    _renew(books, land, cell)
    if cell % columns > 0:
        _renew(books, land, cell - 1)
    if cell % columns + 1 < columns:
        _renew(books, land, cell + 1)
    if cell >= columns:
        _renew(books, land, cell - columns)
    if cell + columns < books.first_tick.shape[0]:
        _renew(books, land, cell + columns)


@kernel
def _hold(books: MapTrackerState, land: GroundTruth, who: int, entry: int) -> None:
    """A robot learns an entry, its own or another's."""
    cells = books.first_tick.shape[0]
    held = books.held[who]
    if entry >= 3 * cells:
        return
    if entry >= 2 * cells:
        held[entry - 2 * cells] |= VOID
        return
    cell = entry >> 1
    books.counts[who, HELD_CELLS] += held[cell] & KIND == 0 and land.counting[cell]
    held[cell] = (held[cell] & (VOID | OWN)) | (FREE + (entry & 1))


@kernel
def look(
    first_tick: np.ndarray,
    frontier: np.ndarray,
    held: np.ndarray,
    made: np.ndarray,
    told: np.ndarray,
    have: np.ndarray,
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
    books = MapTrackerState(
        first_tick,
        frontier,
        held,
        made,
        told,
        have,
        folded,
        written,
        slots,
        counts,
        stood,
        union,
        faults,
    )
    land = GroundTruth(truth, counting, exact)
    cells, columns = first_tick.shape[0], truth.shape[1]
    for i in range(news.shape[0]):
        entry = news[i]
        made[slots[who], written[slots[who], MADE]] = entry
        written[slots[who], MADE] += 1
        _hold(books, land, who, entry)
        if entry >= 2 * cells:
            continue
        cell = entry >> 1
        if exact and (truth[cell // columns, cell % columns] == FREE) != (entry & 1 == 0):
            _note(books, FALSE_CELL, row, 0, cell, entry & 1)
        counts[who, OWN_CELLS] += held[who, cell] & OWN == 0 and counting[cell]
        held[who, cell] |= OWN
        if first_tick[cell] < 0:
            _stamp(books, land, cell, tick)


@kernel
def _is_log(payload: bytes, at: int, end: int, origins: int) -> bool:
    """Whether payload[at:end] is a row of suffixes of bare entries, see News.logs."""
    while 0 <= at < end:
        origin, at = take_uint(payload, at)
        start, at = take_uint(payload, at)
        span, at = take_uint(payload, at)
        count, at = take_uint(payload, at)
        if at < 0 or origin >= origins or start > LENGTH_MAX or count > end - at or count != span:
            return False
        for _ in range(count):
            _step, at = take_int(payload, at)
    return at == end


@kernel
def _is_near(books: MapTrackerState, who: int, cell: int, columns: int) -> bool:
    """Whether a robot has ever stood near a cell."""
    for i in range(books.counts[who, STOOD] - 1, -1, -1):
        stood = books.stood[who, i]
        rows_apart = abs(stood // columns - cell // columns)
        if max(rows_apart, abs(stood % columns - cell % columns)) <= VOID_CELLS:
            return True
    return False


@kernel
def _append(books: MapTrackerState, land: GroundTruth, who: int, entry: int) -> int:
    """A robot tells the next entry of its log: a fault, or NEVER."""
    cells, slot = books.first_tick.shape[0], books.slots[who]
    written = books.written[slot]
    if 2 * cells <= entry < 3 * cells:
        if not _is_near(books, who, entry - 2 * cells, land.truth.shape[1]):
            return FAR_VOID
        written[VOIDS] += 1
        _hold(books, land, who, entry)
    elif written[MATCHED] < written[MADE] and books.made[slot, written[MATCHED]] == entry:
        written[MATCHED] += 1
    else:
        return NOT_ITS_SCANS
    books.told[slot, written[TOLD]] = entry
    written[TOLD] += 1
    return NEVER


@kernel
def _follow_entry(
    books: MapTrackerState, land: GroundTruth, who: int, origin: int, position: int, entry: int
) -> int:
    """An entry of a slot's log as `who` sends it: a fault, or NEVER."""
    own = origin == books.slots[who]
    if position < books.written[origin, TOLD]:
        same = books.told[origin, position] == entry
        return NEVER if same else NOT_ITS_SCANS if own else FOREIGN
    if not own or who >= books.held.shape[0]:
        return FOREIGN
    if position == books.written[origin, TOLD]:
        return int(_append(books, land, who, entry))
    return GAP


@kernel
def _follow_have(
    books: MapTrackerState, payload: bytes, at: int, told: int, who: int, row: int, item: int
) -> None:
    """A version vector of `told` slots never falls and never names what nobody has told."""
    robots = books.held.shape[0]
    for origin in range(max(told, books.have.shape[1])):
        length = 0
        if origin < told:
            length, at = take_uint(payload, at)
        if origin >= books.have.shape[1]:
            if length > 0:
                _note(books, MORE, row, item, length, 0)
            continue
        before, books.have[who, origin] = books.have[who, origin], length
        if length < before:
            _note(books, FORGETS, row, item, length, before)
        if origin != books.slots[who] or who >= robots:
            known = books.written[origin, TOLD]
            if length > known:
                _note(books, MORE, row, item, length, known)
        else:
            known = books.written[origin, MADE] + books.written[origin, VOIDS]
            if not known <= length <= known + books.first_tick.shape[0]:
                _note(books, SHORT, row, item, length, known)


@kernel
def _follow_logs(
    books: MapTrackerState,
    land: GroundTruth,
    reading: ColumnarBatch,
    row: int,
    item: int,
    at: int,
    end: int,
) -> None:
    """The suffixes in payload[at:end], up to the first fault."""
    who, payload = reading.acts[row, of.PLACE], reading.payload
    while at < end:
        origin, at = take_uint(payload, at)
        position, at = take_uint(payload, at)
        _span, at = take_uint(payload, at)
        count, at = take_uint(payload, at)
        entry = 0
        for _ in range(count):
            step, at = take_int(payload, at)
            entry += step
            fault = _follow_entry(books, land, who, origin, position, entry)
            if fault != NEVER:
                _note(books, fault, row, item, origin, position)
                return
            position += 1


@kernel
def _follow_news(
    books: MapTrackerState, land: GroundTruth, reading: ColumnarBatch, row: int, item: int
) -> None:
    """One envelope: its logs, then its version vector, then what the sender holds by it."""
    who = reading.acts[row, of.PLACE]
    sent = reading.sent[reading.acts[row, of.SENT] + item]
    payload = reading.payload
    _epoch, have, have_end, at, end = of.parts_of_news(payload, sent[of.BODY], sent[of.BODY_END])
    roster, robots = books.slots.shape[0], books.held.shape[0]
    slots = _slots(payload, have, have_end, roster) if end >= 0 else 0
    if slots == 0 or not _is_log(payload, at, end, books.have.shape[1]):
        _note(books, UNREADABLE, row, item, 0, 0)
        return
    if who < robots:
        books.union[LOG_BYTES] += end - at
    _follow_logs(books, land, reading, row, item, at, end)
    _follow_have(books, payload, have, slots, who, row, item)
    for origin in range(books.have.shape[1] if who < robots else 0):
        last = min(books.have[who, origin], books.written[origin, TOLD])
        if origin != books.slots[who]:
            for i in range(books.folded[who, origin], last):
                _hold(books, land, who, books.told[origin, i])
            books.folded[who, origin] = max(last, books.folded[who, origin])


@kernel
def _slots(payload: bytes, at: int, end: int, roster: int) -> int:
    """How many slots the version vector in payload[at:end] is for; 0 if it is none."""
    numbers = 0
    while 0 <= at < end:
        _length, at = take_uint(payload, at)
        numbers += 1
    return numbers if at == end and numbers % roster == 0 else 0


@kernel
def follow(
    payload: bytes,
    sizes: np.ndarray,
    acts: np.ndarray,
    poses_m: np.ndarray,
    heard: np.ndarray,
    sent: np.ndarray,
    verdicts: np.ndarray,
    pairs: np.ndarray,
    injected: np.ndarray,
    first_tick: np.ndarray,
    frontier: np.ndarray,
    held: np.ndarray,
    made: np.ndarray,
    told: np.ndarray,
    have: np.ndarray,
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
    books = MapTrackerState(
        first_tick,
        frontier,
        held,
        made,
        told,
        have,
        folded,
        written,
        slots,
        counts,
        stood,
        union,
        faults,
    )
    land = GroundTruth(truth, counting, exact)
    reading = ColumnarBatch(payload, sizes, acts, poses_m, heard, sent, verdicts, pairs, injected)
    for row in range(sizes[of.ACTS]):
        who = acts[row, of.PLACE]
        if who >= 0 and acts[row, of.PRESENT]:
            for item in range(acts[row, of.SENT_COUNT]):
                _follow_news(books, land, reading, row, item)


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
