"""What the robots of a mapping run have seen, followed once for all referees.

Everything is made anew from the record: a robot's evidence is what its recorded scans say (`Evidence`),
and what it holds of others are the prefixes of their logs that its version vectors name. What it says
otherwise is a fault, noted here as numbers and put into words by the checker.

Only cells that can ever be seen count (`starts.observable`). Ticks are periods. A cell is stamped with
the tick of the step in which somebody first took in a scan of it.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.evidence import Evidence, entries
from kantor_protocol.grid import FREE, NOWHERE
from kantor_protocol.kernels import kernel
from kantor_protocol.machine import Observation, ParticipantId, Pose
from kantor_protocol.messages import RefusedError
from kantor_protocol.packing import take_int, take_uint
from kantor_protocol.replica import LENGTH_MAX
from kantor_protocol.slots import EPOCHS_MAX
from kantor_worldsim import reading as of
from kantor_worldsim.reading import Reader, Reading
from kantor_worldsim.records import Batch, Incident, Opening, Record
from kantor_worldsim.starts import observable
from kantor_worldsim.world import Ruling

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
_FAULTS_MAX = 100

_VOID_CELLS = 2
"""How far from a frontier that it calls none a robot may have stood, in cells along either axis."""


class Books(NamedTuple):
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


class Land(NamedTuple):
    """What is true, for the kernels."""

    truth: npt.NDArray[np.uint8]
    """(rows, columns)"""
    counting: npt.NDArray[np.bool_]
    """(c,) the cells that can ever be seen."""
    exact: bool
    """Scans have no noise."""


@kernel
def _note(books: Books, fault: int, row: int, item: int, a: int, b: int) -> None:
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
def _renew(books: Books, land: Land, cell: int) -> None:
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
def _stamp(books: Books, land: Land, cell: int, tick: int) -> None:
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
def _hold(books: Books, land: Land, who: int, entry: int) -> None:
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
def _look(
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
    books = Books(
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
    land = Land(truth, counting, exact)
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
def _is_near(books: Books, who: int, cell: int, columns: int) -> bool:
    """Whether a robot has ever stood near a cell."""
    for i in range(books.counts[who, STOOD] - 1, -1, -1):
        stood = books.stood[who, i]
        rows_apart = abs(stood // columns - cell // columns)
        if max(rows_apart, abs(stood % columns - cell % columns)) <= _VOID_CELLS:
            return True
    return False


@kernel
def _append(books: Books, land: Land, who: int, entry: int) -> int:
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
    books: Books, land: Land, who: int, origin: int, position: int, entry: int
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
    books: Books, payload: bytes, at: int, told: int, who: int, row: int, item: int
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
    books: Books, land: Land, reading: Reading, row: int, item: int, at: int, end: int
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
def _follow_news(books: Books, land: Land, reading: Reading, row: int, item: int) -> None:
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
def _follow(
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
    books = Books(
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
    land = Land(truth, counting, exact)
    reading = Reading(payload, sizes, acts, poses_m, heard, sent, verdicts, pairs, injected)
    for row in range(sizes[of.ACTS]):
        who = acts[row, of.PLACE]
        if who >= 0 and acts[row, of.PRESENT]:
            for item in range(acts[row, of.SENT_COUNT]):
                _follow_news(books, land, reading, row, item)


@kernel
def _find_way(held: np.ndarray, start: int, columns: int, queue: np.ndarray) -> int:
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


class Survey:
    """Follows the records of a mapping run. Several referees may share one; each record counts once.

    Whoever wants to know how things stood before a record asks before anybody hands it on.
    """

    def __init__(self, reader: Reader | None = None) -> None:
        """reader: the one that another referee of the same run reads by."""
        self._reader = reader or Reader()
        self._record: Record | None = None

    def take(self, record: Record) -> None:
        """Follow one record. The first must be an opening with a true map; raises RefusedError."""
        if record is self._record:
            return
        self._record = record
        if isinstance(record, Opening):
            self._open(record)
        elif isinstance(record, Batch):
            self._follow(record)
        elif isinstance(record, Incident) and record.what in {"start", "join"}:
            self._take_over(record)

    def _open(self, opening: Opening) -> None:
        self._reader.read(opening)
        scenario, site = opening.scenario, opening.site
        if site.ground is None:
            raise RefusedError("a mission on a map, and no map in its opening")
        self.ground, self.frame = site.ground, site.ground.frame
        self.observable = observable(site.ground, site.starts_m)
        """(rows, columns)"""
        self.total = int(self.observable.sum())
        """How many cells can ever be seen."""
        self.tick = 0
        robots, cells, everybody = scenario.robots.count, self.frame.cells, len(scenario.roster)
        assert entries(self.frame) < 2**31
        self.books = Books(
            first_tick=np.full(cells, NEVER, dtype=np.int32),
            frontier=np.zeros(cells, dtype=np.bool_),
            held=np.zeros((robots, cells), dtype=np.uint8),
            made=np.zeros((everybody, 4096), dtype=np.int32),
            told=np.zeros((everybody, 4096), dtype=np.int32),
            have=np.zeros((everybody, everybody), dtype=np.int64),
            folded=np.zeros((robots, everybody), dtype=np.int64),
            written=np.zeros((everybody, 4), dtype=np.int64),
            slots=np.arange(everybody),
            counts=np.zeros((robots, 3), dtype=np.int64),
            stood=np.full((robots, 256), NEVER, dtype=np.int32),
            union=np.zeros(4, dtype=np.int64),
            faults=np.zeros((_FAULTS_MAX, 5), dtype=np.int64),
        )
        self._land = Land(
            np.ascontiguousarray(self.ground.cells),
            self.observable.ravel(),
            scenario.sensor.noise_m == 0.0,
        )
        self._arguments = (*self.books, *self._land)
        self.poses_m: list[tuple[float, float]] = [(x, y) for x, y in site.starts_m.tolist()]
        """Where the robots are, world frame."""
        self.ways_m = [0.0] * robots
        """How far each has driven."""
        self.bumps: list[tuple[float, float]] = []
        """Where robots ended a move at a wall."""
        self._patience = scenario.planner.patience
        self._strived: list[tuple[tuple[float, float] | None, int]] = [(None, 0)] * robots
        """The goal of each, and for how many steps it has been that."""
        self.completed_tick: int | None = None
        self.t95_tick: int | None = None
        self.t99_tick: int | None = None
        self.all_t99_tick: int | None = None
        self._period_ns = scenario.period_ns
        self.places = {name: i for i, name in enumerate(scenario.robot_ids)}
        """Of the robots, in the order of the roster."""
        self._queue = np.zeros(cells, dtype=np.int32)
        self._scenario = scenario
        self._evidence = [self._new_evidence() for _ in range(robots)]
        self._looked: list[tuple[int, Pose | None]] = [(NEVER, None)] * robots
        for place in range(robots):
            self._stand(place, self.cell_of(place))

    @property
    def seen(self) -> int:
        """Cells that anybody has seen."""
        return self.books.union.item(SEEN)

    @property
    def stamps(self) -> npt.NDArray[np.int32]:
        """(seen,) the ticks at which the cells that count were first seen."""
        ticks = self.books.first_tick[self._land.counting]
        return np.asarray(ticks[ticks >= 0])

    @property
    def own_cells(self) -> npt.NDArray[np.int64]:
        """(n,) how many cells each robot has seen itself; a view."""
        return self.books.counts[:, OWN_CELLS]

    @property
    def held_cells(self) -> npt.NDArray[np.int64]:
        """(n,) how many cells each robot knows; a view."""
        return self.books.counts[:, HELD_CELLS]

    @property
    def log_bytes(self) -> int:
        """Of logs in all that robots have sent."""
        return self.books.union.item(LOG_BYTES)

    @property
    def faults(self) -> tuple[npt.NDArray[np.int64], int]:
        """Of the last batch, as in Books, and how many there are."""
        count = self.books.union.item(FAULTS)
        return self.books.faults[: min(count, _FAULTS_MAX)], count

    def cell_of(self, place: int) -> int:
        """The cell in which a robot is, or NOWHERE."""
        x_m, y_m = self.poses_m[place]
        return self.frame.cell_of(x_m, y_m) if math.isfinite(x_m + y_m) else NOWHERE

    def reachable(self, name: ParticipantId) -> int:
        """A frontier that a robot can reach by all that it holds, or NEVER.

        Frontiers that it may have called none in entries that it has not sent yet do not count.
        """
        place, books = self.places[name], self.books
        start = self.cell_of(place)
        if start == NOWHERE:
            return NEVER
        held = books.held[place]
        slot = books.slots[place]
        untold = books.have[place, slot] > books.written[slot, MADE] + books.written[slot, VOIDS]
        while True:
            cell = int(_find_way(held, start, self.frame.columns, self._queue))
            if cell == NEVER or not untold or not self._is_near(place, cell):
                return cell
            held[cell] |= VOID

    def _is_near(self, place: int, cell: int) -> bool:
        stood = self.books.stood[place, : self.books.counts[place, STOOD]]
        row, column = divmod(cell, self.frame.columns)
        apart = np.maximum(
            abs(stood // self.frame.columns - row), abs(stood % self.frame.columns - column)
        )
        return bool((apart <= _VOID_CELLS).any())

    def _follow(self, batch: Batch) -> None:
        self.books.union[FAULTS] = 0
        self.tick = batch.now_ns // self._period_ns
        reading = Reading(*self._reader.read(batch))
        acted = [
            (row, self.places[act.name], act)
            for row, act in enumerate(batch.acts)
            if act.name in self.places and act.outputs is not None and act.ruling is not None
        ]
        for row, place, act in acted:
            self._look(place, act.observation, row)
        acts = reading.acts[: reading.sizes[of.ACTS]]
        self._reserve("told", "written", TOLD, int(acts[:, of.BODY_BYTES].max(initial=0)))
        _follow(*reading, *self._arguments)
        for _, place, act in acted:
            assert act.ruling is not None
            assert act.outputs is not None
            self._move(place, act.ruling)
            self._strive(place, act.outputs.goal)
        self._note_moments()

    def _new_evidence(self) -> Evidence:
        scenario = self._scenario
        return Evidence(self.frame, scenario.sensor, ranges=scenario.learns_ranges)

    def _take_over(self, incident: Incident) -> None:
        """A new incarnation of a robot knows nothing, and writes a new log."""
        names = self._scenario.roster
        if incident.who not in names:
            return
        who, roster = names.index(incident.who), len(names)
        slot = incident.epoch * roster + who
        if not self.books.slots[who] < slot <= EPOCHS_MAX * roster + who:
            return
        while slot >= self.books.have.shape[1]:
            self._add_slots(roster)
        books = self.books
        books.slots[who] = slot
        books.have[who] = 0
        if who < books.held.shape[0]:
            books.held[who] &= OWN  # a body counts a cell once
            books.folded[who] = 0
            books.counts[who, [HELD_CELLS, STOOD]] = 0
            self._evidence[who] = self._new_evidence()
            self._looked[who], self._strived[who] = (NEVER, None), (None, 0)
            self._stand(who, self.cell_of(who))

    def _add_slots(self, more: int) -> None:
        """Room for another incarnation of everybody."""
        books = self.books
        self.books = books._replace(
            made=np.pad(books.made, ((0, more), (0, 0))),
            told=np.pad(books.told, ((0, more), (0, 0))),
            written=np.pad(books.written, ((0, more), (0, 0))),
            have=np.pad(books.have, ((0, 0), (0, more))),
            folded=np.pad(books.folded, ((0, 0), (0, more))),
        )
        self._arguments = (*self.books, *self._land)

    def _look(self, place: int, observation: Observation, row: int) -> None:
        """A robot takes in each new scan once; it learns of ranges when it has moved."""
        step, before = self._looked[place]
        if observation.step <= step:
            return
        pose = observation.pose
        self._looked[place] = observation.step, pose
        news = self._evidence[place].take(observation.scan, pose, moved=pose != before)
        if news.shape[0]:
            self._reserve("made", "written", MADE, news.shape[0])
            _look(*self._arguments, news, place, row, self.tick)

    def _move(self, place: int, ruling: Ruling) -> None:
        x_m, y_m = self.poses_m[place]
        pose = ruling.pose
        if ruling.bumped:
            self.bumps.append((pose.x_m, pose.y_m))
        if (pose.x_m, pose.y_m) != (x_m, y_m):
            self.ways_m[place] += math.hypot(pose.x_m - x_m, pose.y_m - y_m)
            self.poses_m[place] = pose.x_m, pose.y_m
            self._stand(place, self.cell_of(place))

    def _strive(self, place: int, goal: tuple[float, float] | None) -> None:
        """A robot that has headed for the same goal for long enough may speak of it as if it stood there."""
        before, steps = self._strived[place]
        self._strived[place] = goal, steps + 1 if goal == before else 1
        if goal is None or self._strived[place][1] != self._patience:
            return
        cell = self.frame.cell_of(*goal)
        if cell != NOWHERE:
            self._stand(place, cell)

    def _stand(self, place: int, cell: int) -> None:
        """Note the cell in which a robot is."""
        count = self.books.counts.item(place, STOOD)
        if count and self.books.stood.item(place, count - 1) == cell:
            return
        self._reserve("stood", "counts", STOOD, 1)
        self.books.stood[place, count] = cell
        self.books.counts[place, STOOD] += 1

    def _reserve(self, name: str, counted: str, column: int, more: int) -> None:
        """Room for so many more entries in one of the arrays that grow with the run."""
        rows = getattr(self.books, name)
        needed = int(getattr(self.books, counted)[:, column].max()) + more
        if needed <= rows.shape[1]:
            return
        longer = np.zeros((rows.shape[0], 2 * needed), dtype=rows.dtype)
        longer[:, : rows.shape[1]] = rows
        self.books = self.books._replace(**{name: longer})
        self._arguments = (*self.books, *self._land)

    def _note_moments(self) -> None:
        """When the union was complete, and when nearly everything was known to somebody, to everybody."""
        seen, total, tick = self.seen, self.total, self.tick
        if self.completed_tick is None and seen and not self.books.union[FRONTIERS]:
            self.completed_tick = tick
        if self.t95_tick is None and 100 * seen >= 95 * total:
            self.t95_tick = tick
        if self.t99_tick is None and 100 * seen >= 99 * total:
            self.t99_tick = tick
        if self.all_t99_tick is None and self.t99_tick is not None:
            least = int(self.held_cells.min())
            self.all_t99_tick = tick if 100 * least >= 99 * total else None
