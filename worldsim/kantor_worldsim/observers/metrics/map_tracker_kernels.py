"""The compiled kernels of the map tracker: logs and scans, followed entry by entry."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE, OCCUPIED
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import read_int, read_uint
from kantor_protocol.replication.occupancy_log import RANGE_BINS
from kantor_worldsim.observers.metrics.gossip_reader import count_incarnations, is_log
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch

NEVER = -1


KIND, DEAD, OWN, BUMP = 3, 4, 8, 32
"""Bits of MapTrackerState.held: kind of a cell, a frontier that is dead or was given up, seen by the robot
itself, a wall that a robot has met."""


# Columns of MapTrackerState.written and .counts, and incarnation_ids of .totals.
SCANNED, AS_SENT, MATCHED, NOT_SCANNED = 0, 1, 2, 3


OWN_CELLS, HELD_CELLS, STOOD = 0, 1, 2


SEEN, FRONTIERS, LOG_BYTES, NOTED = 0, 1, 2, 3


# Violations in what robots send, and in what their scans say.
UNREADABLE, NOT_ITS_SCANS, FAR_FRONTIER, GAP, SHORT, FORGETS = 0, 1, 2, 3, 4, 5


FOREIGN, MORE, FALSE_CELL, FALSE_BUMP, NOT_GIVEN_UP = 6, 7, 8, 9, 10


VIOLATIONS_MAX = 100


OF_CELL, OF_DEAD, OF_RANGE, OF_GIVEN_UP, OF_RETRIED, OF_BUMP = 0, 1, 2, 3, 4, 5
"""What an entry of a log is about."""


DEAD_FRONTIER_CELLS = 2
"""How far from a frontier that it declares dead a robot may have stood, in cells along either axis."""


class MapTrackerState(NamedTuple):
    """The state of the map tracker, for the kernels. n robots, p participants, c cells.

    ids: incarnation ids. Incarnation e of participant i writes the log of id e p + i.
    """

    first_tick: npt.NDArray[np.int32]
    """(c,) the tick at which a robot first saw a cell, or NEVER."""
    frontier: npt.NDArray[np.bool_]
    """(c,) seen and truly free and reachable, with a neighbour that no robot has seen."""
    held: npt.NDArray[np.uint8]
    """(n, c) what each robot knows, by its own scans and the logs that it holds."""
    scanned: npt.NDArray[np.int32]
    """(ids, rows) the entries that each robot's scans gave."""
    as_sent: npt.NDArray[np.int32]
    """(ids, rows) its log as it sends it: the same, and what it says of frontiers and bumps."""
    version_vector: npt.NDArray[np.int64]
    """(p, ids) the version vector that each has sent last."""
    folded: npt.NDArray[np.int64]
    """(n, ids) entries of others' logs that are in `held`."""
    written: npt.NDArray[np.int64]
    """(ids, 4) entries scanned and sent; of those sent, such that were scanned, and others."""
    incarnation_ids: npt.NDArray[np.int64]
    """(p,) the id of each one's newest incarnation."""
    counts: npt.NDArray[np.int64]
    """(n, 3) cells seen by itself and known in all; cells in `stood`."""
    stood: npt.NDArray[np.int32]
    """(n, rows) the cells in which a robot stood, in order."""
    totals: npt.NDArray[np.int64]
    """(4,) cells seen by any robot; frontiers; bytes of logs that robots sent; violations in the last
    batch."""
    violations: npt.NDArray[np.int64]
    """(rows, 5): kind of the violation, step record, envelope of it, two numbers."""
    lies: npt.NDArray[np.bool_]
    """(p,) whether the scenario has each lie: what it sends is then its log, whatever its scans say."""


class GroundTruth(NamedTuple):
    """The true map, for the kernels."""

    truth: npt.NDArray[np.uint8]
    """(rows, columns)"""
    counting: npt.NDArray[np.bool_]
    """(c,) the cells that can ever be seen."""
    exact: bool
    """Scans have no noise."""


@kernel
def _note(state: MapTrackerState, kind: int, row: int, item: int, a: int, b: int) -> None:
    at = state.totals[NOTED]
    state.totals[NOTED] += 1
    if at < state.violations.shape[0]:
        noted = state.violations[at]
        noted[0], noted[1], noted[2], noted[3], noted[4] = kind, row, item, a, b


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
    """Note whether a cell is a frontier of all that robots have seen."""
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
    state.totals[FRONTIERS] += int(now) - int(state.frontier[cell])
    state.frontier[cell] = now


@kernel
def _stamp(state: MapTrackerState, ground: GroundTruth, cell: int, tick: int) -> None:
    """A robot is the first to see a cell."""
    columns = ground.truth.shape[1]
    state.first_tick[cell] = tick
    state.totals[SEEN] += ground.counting[cell]
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
def part_of(entry: int, cells: int) -> tuple[int, int]:
    """What an entry of a log is about, and the cell; cells: of the map. See `occupancy_log`."""
    if entry < 2 * cells:
        return OF_CELL, entry >> 1
    if entry < 3 * cells:
        return OF_DEAD, entry - 2 * cells
    if entry < 3 * cells + RANGE_BINS:
        return OF_RANGE, NEVER
    beyond = entry - 3 * cells - RANGE_BINS
    if beyond < cells:
        return OF_GIVEN_UP, beyond
    if beyond < 2 * cells:
        return OF_RETRIED, beyond - cells
    return OF_BUMP, beyond - 2 * cells


@kernel
def _hold(state: MapTrackerState, ground: GroundTruth, who: int, entry: int) -> None:
    """A robot takes in an entry, its own or another's."""
    cells = state.first_tick.shape[0]
    held = state.held[who]
    about, cell = part_of(entry, cells)
    if about in (OF_DEAD, OF_GIVEN_UP):
        held[cell] |= DEAD
    elif about in (OF_CELL, OF_BUMP):
        state.counts[who, HELD_CELLS] += held[cell] & KIND == 0 and ground.counting[cell]
        wall = about == OF_BUMP or held[cell] & BUMP != 0
        kind = OCCUPIED if wall else FREE + (entry & 1)
        held[cell] = (held[cell] & (DEAD | OWN)) | (BUMP if wall else 0) | kind


@kernel
def take_scan(
    so_far: tuple[Any, ...],
    true: tuple[Any, ...],
    entries_seen: np.ndarray,
    who: int,
    row: int,
    tick: int,
) -> None:
    """A robot takes in a scan. entries_seen: (k,) its entries; `scanned` has room for them.

    so_far, true: the fields of a MapTrackerState and a GroundTruth.
    """
    state, ground = MapTrackerState(*so_far), GroundTruth(*true)
    truth, own = ground.truth, state.incarnation_ids[who]
    cells, columns = state.first_tick.shape[0], truth.shape[1]
    for i in range(entries_seen.shape[0]):
        entry = entries_seen[i]
        state.scanned[own, state.written[own, SCANNED]] = entry
        state.written[own, SCANNED] += 1
        _hold(state, ground, who, entry)
        if entry >= 2 * cells:
            continue
        cell = entry >> 1
        if ground.exact and (truth[cell // columns, cell % columns] == FREE) != (entry & 1 == 0):
            _note(state, FALSE_CELL, row, 0, cell, entry & 1)
        state.counts[who, OWN_CELLS] += state.held[who, cell] & OWN == 0 and ground.counting[cell]
        state.held[who, cell] |= OWN
        if state.first_tick[cell] < 0:
            _stamp(state, ground, cell, tick)


@kernel
def _is_near(state: MapTrackerState, who: int, cell: int, columns: int) -> bool:
    """Whether a robot has ever stood near a cell."""
    for i in range(state.counts[who, STOOD] - 1, -1, -1):
        stood = state.stood[who, i]
        rows_apart = abs(stood // columns - cell // columns)
        if max(rows_apart, abs(stood % columns - cell % columns)) <= DEAD_FRONTIER_CELLS:
            return True
    return False


@kernel
def _is_given_up(state: MapTrackerState, cell: int) -> bool:
    """Whether any robot has said that it gives a frontier up."""
    found = False
    for robot in range(state.held.shape[0]):
        found = found or state.held[robot, cell] & DEAD != 0
    return found


@kernel
def _append(state: MapTrackerState, ground: GroundTruth, who: int, entry: int) -> int:
    """A robot sends the next entry of its log: the kind of a violation, or NEVER."""
    cells, own, found = state.first_tick.shape[0], state.incarnation_ids[who], NEVER
    written = state.written[own]
    about, cell = part_of(entry, cells)
    if about not in (OF_CELL, OF_RANGE):
        columns = ground.truth.shape[1]
        if about == OF_BUMP and ground.truth[cell // columns, cell % columns] == FREE:
            return FALSE_BUMP
        if about == OF_RETRIED and not _is_given_up(state, cell):
            return NOT_GIVEN_UP
        if about in (OF_DEAD, OF_GIVEN_UP) and not _is_near(state, who, cell, columns):
            return FAR_FRONTIER
        written[NOT_SCANNED] += 1
        _hold(state, ground, who, entry)
    elif written[MATCHED] < written[SCANNED] and state.scanned[own, written[MATCHED]] == entry:
        written[MATCHED] += 1
    elif state.lies[who]:
        written[MATCHED] += 1
        found = NOT_ITS_SCANS
    else:
        return NOT_ITS_SCANS
    state.as_sent[own, written[AS_SENT]] = entry
    written[AS_SENT] += 1
    return found


@kernel
def _follow_entry(
    state: MapTrackerState, ground: GroundTruth, who: int, origin: int, position: int, entry: int
) -> int:
    """A participant sends an entry of a log: the kind of a violation, or NEVER."""
    own = origin == state.incarnation_ids[who]
    if position < state.written[origin, AS_SENT]:
        same = state.as_sent[origin, position] == entry
        return NEVER if same else NOT_ITS_SCANS if own else FOREIGN
    if not own or who >= state.held.shape[0]:
        return FOREIGN
    if position == state.written[origin, AS_SENT]:
        return int(_append(state, ground, who, entry))
    return GAP


@kernel
def _follow_version_vector(
    state: MapTrackerState, payload: bytes, at: int, ids: int, who: int, row: int, item: int
) -> None:
    """A version vector of so many incarnation ids never falls, and names no entry that was never sent."""
    robots = state.held.shape[0]
    for origin in range(max(ids, state.version_vector.shape[1])):
        length = 0
        if origin < ids:
            length, at = read_uint(payload, at)
        if origin >= state.version_vector.shape[1]:
            if length > 0:
                _note(state, MORE, row, item, length, 0)
            continue
        before, state.version_vector[who, origin] = state.version_vector[who, origin], length
        if length < before:
            _note(state, FORGETS, row, item, length, before)
        if origin != state.incarnation_ids[who] or who >= robots:
            known = state.written[origin, AS_SENT]
            if length > known:
                _note(state, MORE, row, item, length, known)
        else:
            known = state.written[origin, SCANNED] + state.written[origin, NOT_SCANNED]
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
    """Follow the suffixes in payload[at:end], up to the first violation; of a liar all, and the first is noted."""
    who, payload = columns.step_records[row].place, columns.payload
    lied = False
    while at < end:
        origin, at = read_uint(payload, at)
        position, at = read_uint(payload, at)
        _span, at = read_uint(payload, at)
        count, at = read_uint(payload, at)
        entry = 0
        for _ in range(count):
            step, at = read_int(payload, at)
            entry += step
            kind = _follow_entry(state, ground, who, origin, position, entry)
            if kind != NEVER and not lied:
                _note(state, kind, row, item, origin, position)
                if not state.lies[who]:
                    return
                lied = True
            position += 1


@kernel
def _follow_gossip(
    state: MapTrackerState, ground: GroundTruth, columns: ColumnarBatch, row: int, item: int
) -> None:
    """Follow an envelope: its logs, then its version vector, then what the sender holds by it."""
    who = columns.step_records[row].place
    sent = columns.sent[columns.step_records[row].sent + item]
    payload = columns.payload
    _incarnation, version_vector, vector_end, at, end = of.parts_of_gossip(
        payload, sent.body, sent.body_end
    )
    roster, robots = state.incarnation_ids.shape[0], state.held.shape[0]
    ids = count_incarnations(payload, version_vector, vector_end, roster, 1) if end >= 0 else 0
    if ids == 0 or not is_log(payload, at, end, 1, state.version_vector.shape[1]):
        _note(state, UNREADABLE, row, item, 0, 0)
        return
    if who < robots:
        state.totals[LOG_BYTES] += end - at
    _follow_logs(state, ground, columns, row, item, at, end)
    _follow_version_vector(state, payload, version_vector, ids, who, row, item)
    for origin in range(state.version_vector.shape[1] if who < robots else 0):
        last = min(state.version_vector[who, origin], state.written[origin, AS_SENT])
        if origin != state.incarnation_ids[who]:
            for i in range(state.folded[who, origin], last):
                _hold(state, ground, who, state.as_sent[origin, i])
            state.folded[who, origin] = max(last, state.folded[who, origin])


@kernel
def follow(batch: tuple[Any, ...], so_far: tuple[Any, ...], true: tuple[Any, ...]) -> None:
    """Follow what is sent in one batch; `as_sent` has room for it.

    batch, so_far, true: the fields of a ColumnarBatch, a MapTrackerState and a GroundTruth.
    """
    columns, state = ColumnarBatch(*batch), MapTrackerState(*so_far)
    ground = GroundTruth(*true)
    for row in range(columns.sizes[of.STEP_RECORDS]):
        step_record = columns.step_records[row]
        if step_record.place >= 0 and step_record.present:
            for item in range(step_record.sent_count):
                _follow_gossip(state, ground, columns, row, item)


@kernel
def find_way(held: np.ndarray, start: int, columns: int, queue: np.ndarray) -> int:
    """A frontier that can be reached from a cell over known free cells, or NEVER.

    held: (c,) as in MapTrackerState, of one robot; cells in the queue are marked meanwhile. queue: (c,) room.
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
            and held[cell] & DEAD == 0
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
