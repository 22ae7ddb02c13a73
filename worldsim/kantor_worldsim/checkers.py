"""Referees that read only the record. Each rule can fail, and a test shows how.

A complaint is one line: rule, time, who, what. A run is clean when there is none.

Rules on numbers are kernels over the tables of a batch (`reading.py`). A fault is noted as a row of
numbers and put into words afterwards, with the record at hand: a sound run, which is nearly every run,
then costs little more than reading it.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_protocol.kernels import kernel
from kantor_protocol.machine import Outputs, ParticipantId, Pose
from kantor_protocol.messages import RefusedError, decode_news
from kantor_protocol.modes import rectangle_of, visit_at
from kantor_protocol.packing import take_int, take_uint
from kantor_protocol.registers import read_register
from kantor_protocol.replica import LENGTH_MAX
from kantor_protocol.weights import WeightsSubscriber
from kantor_worldsim import reading as of
from kantor_worldsim.channel import DROPPED
from kantor_worldsim.exact import ROUNDING
from kantor_worldsim.faults import LinkFaults
from kantor_worldsim.map_checker import MapRules
from kantor_worldsim.metrics import Row
from kantor_worldsim.reading import Reader, Reading
from kantor_worldsim.records import Act, Batch, Ending, Opening, Record
from kantor_worldsim.survey import Survey
from kantor_worldsim.world import SPEED_TOLERANCE

_COMPLAINTS_MAX = 100
"""A broken record is broken; further complaints only count."""

# Faults that kernels find.
_UNHEARD, _NEVER_SENT, _FOR_ANOTHER, _TOO_FAR = 0, 1, 2, 3
_STEP, _SPEED, _GARBLED_SPENT, _POINT, _BUDGET, _MISCOUNT = 4, 5, 6, 7, 8, 9
_GARBLED_LOWERED, _RISE, _BELOW, _UNREADABLE, _LOG = 10, 11, 12, 13, 14
_STRANGER, _REFUSED, _NOT_REBUILT, _NOT_ITS_OWN, _NO_SAMPLE, _NO_WEIGHT = 15, 16, 17, 18, 19, 20
_OF_VERDICTS = (_NEVER_SENT, _FOR_ANOTHER, _TOO_FAR)
_NO_LOGS, _NO_POSTED, _NO_FLIGHTS = -1, -2, -3
_GROWING = {_NO_LOGS: "logs", _NO_POSTED: "posted", _NO_FLIGHTS: "flights"}

_WORDS = {
    _UNHEARD: ("delivery", "heard {what}, which was not delivered"),
    _NEVER_SENT: ("delivery", "{what} was never sent"),
    _FOR_ANOTHER: ("delivery", "delivered what was for somebody else"),
    _TOO_FAR: ("range", "{what} over {x:.6g} m"),
    _STEP: ("order", "step {a}, expected {b}"),
    _SPEED: ("speed", "moved {x:.6g} m, allowed {y:.6g} m"),
    _GARBLED_SPENT: ("energy", "spending that does not decode"),
    _POINT: ("energy", "{a} units in one point"),
    _BUDGET: ("energy", "{a} points shipped"),
    _MISCOUNT: ("energy", "counts {a} of {b} points"),
    _GARBLED_LOWERED: ("weights", "entries that do not decode"),
    _RISE: ("weights", "sample {item} from {a} to {b} units"),
    _BELOW: ("credit", "its view of sample {item} is below the truth"),
    _UNREADABLE: ("ledger", "sends what nobody can read{what}"),
    _LOG: ("ledger", "its log from {a} on is not what it consumed"),
    _STRANGER: ("order", "not in the roster"),
    _REFUSED: ("ruling", "the world refused its {what}"),
    _NOT_REBUILT: ("weights", "publishes a vector that cannot be rebuilt"),
    _NOT_ITS_OWN: ("weights", "publishes a vector that is not its own"),
    _NO_SAMPLE: ("goal", "{what} is no sample"),
    _NO_WEIGHT: ("goal", "{what} has no weight left in its view"),
}
"""Rule and text of each fault."""

# Columns of State.book.
_STEPS, _ABSENCES, _MOVED_NS, _POINTS, _ENTRIES, _POSTED, _FLYING, _TOLD = 0, 1, 2, 3, 4, 5, 6, 7
_SEQUENCE, _DIFFERING, _COMING, _KEYFRAME = 8, 9, 10, 13
_BOOK_COLUMNS = 14


class State(NamedTuple):
    """What the kernels keep of the run so far. n participants, N samples."""

    book: npt.NDArray[np.int64]
    """(n, 14): last step, absences since, time of the last move, points shipped; rows used of its
    logs, posted and flights; whether it has sent a version vector; sequence of what it published last,
    entries in which that differs from its view; rows that this batch brings to logs, posted and
    flights; 1 + the act with which it publishes a keyframe in this batch."""
    poses_m: npt.NDArray[np.float64]
    """(n, 2) world frame."""
    views: npt.NDArray[np.int64]
    """(n, N) the weight vector of each, in units."""
    published: npt.NDArray[np.int64]
    """(n, N) the same, rebuilt from what each has published."""
    consumed: npt.NDArray[np.int64]
    """(N,) units shipped by all."""
    logs: npt.NDArray[np.int64]
    """(n, rows, 2): sample, units; what each has consumed."""
    posted: npt.NDArray[np.int64]
    """(n, rows, 2): sequence, target of what each has sent."""
    flights: npt.NDArray[np.int64]
    """(n, rows, 3): source, sequence, due_ns of what is on its way to each."""
    have: npt.NDArray[np.int64]
    """(n, n) log lengths that each said last it holds."""
    faults: npt.NDArray[np.int64]
    """(rows, 5): fault, act or verdict, item of it, two numbers."""
    lengths_m: npt.NDArray[np.float64]
    """(rows, 2): lengths of the fault."""
    found: npt.NDArray[np.int64]
    """(2,) how many faults and how many keyframes this batch has."""
    samples_m: npt.NDArray[np.float64]
    """(N, 2) at the start."""
    by_x: npt.NDArray[np.int64]
    """(N,) samples in the order of their x."""


class Law(NamedTuple):
    """What the scenario allows."""

    sample_units: int
    point_units: int
    budget: int
    ledger: bool
    supervisor: int
    """Its place, or a place that nobody has."""
    speed_m_s: float
    range_m: float
    supervisor_range_m: float
    transport: bool
    """Every goal is a sample that has weight."""


@kernel
def _note(
    state: State, fault: int, row: int, item: int, a: int, b: int, x_m: float, y_m: float
) -> None:
    at = state.found[0]
    state.found[0] += 1
    if at < state.faults.shape[0]:
        noted = state.faults[at]
        noted[0], noted[1], noted[2], noted[3], noted[4] = fault, row, item, a, b
        state.lengths_m[at, 0], state.lengths_m[at, 1] = x_m, y_m


@kernel
def _lacking(state: State, reading: Reading) -> int:
    """Which array has no room for this batch behind what is held of somebody, or 0."""
    book = state.book
    book[:, _COMING:] = 0
    for row in range(reading.sizes[of.ACTS]):
        act = reading.acts[row]
        if act[of.PLACE] >= 0 and act[of.PRESENT]:
            book[act[of.PLACE], _COMING] += max(0, act[of.SPENT_COUNT])
    for row in range(reading.sizes[of.ALL_SENT]):
        if reading.sent[row, of.SOURCE] >= 0:
            book[reading.sent[row, of.SOURCE], _COMING + 1] += 1
    for row in range(reading.sizes[of.VERDICTS]):
        if reading.verdicts[row, of.TARGET] >= 0:
            book[reading.verdicts[row, of.TARGET], _COMING + 2] += 1
    for who in range(book.shape[0]):
        if book[who, _ENTRIES] + book[who, _COMING] > state.logs.shape[1]:
            return _NO_LOGS
        if book[who, _POSTED] + book[who, _COMING + 1] > state.posted.shape[1]:
            return _NO_POSTED
        if book[who, _FLYING] + book[who, _COMING + 2] > state.flights.shape[1]:
            return _NO_FLIGHTS
    return 0


@kernel
def _check_inbox(state: State, reading: Reading, row: int, now_ns: int) -> None:
    act = reading.acts[row]
    who = act[of.PLACE]
    flights = state.flights[who]
    for item in range(act[of.HEARD_COUNT]):
        heard = reading.heard[act[of.HEARD] + item]
        first = -1  # the copy that arrived first
        for i in range(state.book[who, _FLYING]):
            if (
                flights[i, 0] == heard[of.SOURCE]
                and flights[i, 1] == heard[of.SEQUENCE]
                and flights[i, 2] <= now_ns
                and (first < 0 or flights[i, 2] < flights[first, 2])
            ):
                first = i
        if first < 0:
            _note(state, _UNHEARD, row, item, 0, 0, 0.0, 0.0)
            continue
        state.book[who, _FLYING] -= 1
        last = state.book[who, _FLYING]
        for column in range(3):
            flights[first, column] = flights[last, column]


@kernel
def _post(state: State, reading: Reading, row: int) -> None:
    act = reading.acts[row]
    for sent in range(act[of.SENT], act[of.SENT] + act[of.SENT_COUNT]):
        source = reading.sent[sent, of.SOURCE]
        if source >= 0:
            posted = state.posted[source, state.book[source, _POSTED]]
            posted[0], posted[1] = reading.sent[sent, of.SEQUENCE], reading.sent[sent, of.TARGET]
            state.book[source, _POSTED] += 1


@kernel
def _find_posted(state: State, source: int, sequence: int) -> int:
    """The row in which a source has sent something under this number last; negative if it has not."""
    if source >= 0:
        for i in range(state.book[source, _POSTED] - 1, -1, -1):
            if state.posted[source, i, 0] == sequence:
                return i
    return -1


@kernel
def _check_verdict(state: State, law: Law, reading: Reading, row: int) -> None:
    verdict = reading.verdicts[row]
    source, sequence = verdict[of.SOURCE], verdict[of.SEQUENCE]
    receiver, due_ns = verdict[of.TARGET], verdict[of.DUE_NS]
    at = _find_posted(state, source, sequence)
    if at < 0 or receiver < 0:
        _note(state, _NEVER_SENT, row, 0, 0, 0, 0.0, 0.0)
        return
    target = state.posted[source, at, 1]
    if target not in (of.EVERYBODY_PLACE, receiver):
        _note(state, _FOR_ANOTHER, row, 0, 0, 0, 0.0, 0.0)
    if due_ns == DROPPED:
        return
    by_supervisor = law.supervisor in (source, receiver)
    range_m = law.supervisor_range_m if by_supervisor else law.range_m
    dx = state.poses_m[receiver, 0] - state.poses_m[source, 0]
    dy = state.poses_m[receiver, 1] - state.poses_m[source, 1]
    if not dx * dx + dy * dy <= range_m * range_m:
        _note(state, _TOO_FAR, row, 0, 0, 0, math.hypot(dx, dy), 0.0)
    flight = state.flights[receiver, state.book[receiver, _FLYING]]
    flight[0], flight[1], flight[2] = source, sequence, due_ns
    state.book[receiver, _FLYING] += 1


@kernel
def _check_order(state: State, reading: Reading, row: int) -> None:
    act = reading.acts[row]
    book = state.book[act[of.PLACE]]
    expected = book[_STEPS] + 1
    if not expected <= act[of.STEP] <= expected + book[_ABSENCES]:
        _note(state, _STEP, row, 0, act[of.STEP], expected, 0.0, 0.0)
    book[_STEPS], book[_ABSENCES] = act[of.STEP], 0


@kernel
def _check_speed(state: State, law: Law, reading: Reading, row: int) -> None:
    act = reading.acts[row]
    who = act[of.PLACE]
    elapsed_ns = act[of.NOW_NS] - state.book[who, _MOVED_NS]
    limit_m_s = 0.0 if who == law.supervisor else law.speed_m_s
    limit_m = limit_m_s * elapsed_ns * 1e-9 * (1.0 + 2.0 * SPEED_TOLERANCE)
    x_m, y_m = reading.poses_m[row, 0], reading.poses_m[row, 1]
    way_m = math.hypot(x_m - state.poses_m[who, 0], y_m - state.poses_m[who, 1])
    if not way_m <= limit_m:
        _note(state, _SPEED, row, 0, 0, 0, way_m, limit_m)
    state.book[who, _MOVED_NS] = act[of.NOW_NS]
    state.poses_m[who, 0], state.poses_m[who, 1] = x_m, y_m


@kernel
def _check_energy(state: State, law: Law, reading: Reading, row: int) -> None:
    act = reading.acts[row]
    who = act[of.PLACE]
    book = state.book[who]
    if act[of.SPENT_COUNT] == of.NOT_DECODED:
        _note(state, _GARBLED_SPENT, row, 0, 0, 0, 0.0, 0.0)
        return
    shipped = 0
    for i in range(act[of.SPENT], act[of.SPENT] + act[of.SPENT_COUNT]):
        sample, units = reading.pairs[i, of.SAMPLE], reading.pairs[i, of.UNITS]
        shipped += units
        state.consumed[sample] += units
        if law.ledger:
            state.logs[who, book[_ENTRIES], 0] = sample
            state.logs[who, book[_ENTRIES], 1] = units
            book[_ENTRIES] += 1
    book[_POINTS] += act[of.SPENT_COUNT] > 0
    points = book[_POINTS]
    if shipped > law.point_units:
        _note(state, _POINT, row, 0, shipped, 0, 0.0, 0.0)
    if points > law.budget:
        _note(state, _BUDGET, row, 0, points, 0, 0.0, 0.0)
    if act[of.ENERGY] < points and who != law.supervisor:
        _note(state, _MISCOUNT, row, 0, act[of.ENERGY], points, 0.0, 0.0)


@kernel
def _check_weights(state: State, law: Law, reading: Reading, row: int) -> None:
    act = reading.acts[row]
    book, view = state.book[act[of.PLACE]], state.views[act[of.PLACE]]
    if act[of.LOWERED_COUNT] == of.NOT_DECODED:
        _note(state, _GARBLED_LOWERED, row, 0, 0, 0, 0.0, 0.0)
    for i in range(act[of.LOWERED], act[of.LOWERED] + max(0, act[of.LOWERED_COUNT])):
        sample, left = reading.pairs[i, of.SAMPLE], reading.pairs[i, of.UNITS]
        if left >= view[sample]:
            _note(state, _RISE, row, sample, view[sample], left, 0.0, 0.0)
        if left < law.sample_units - state.consumed[sample]:
            _note(state, _BELOW, row, sample, 0, 0, 0.0, 0.0)
        published = state.published[act[of.PLACE], sample]
        book[_DIFFERING] += (published != left) - (published != view[sample])
        view[sample] = left


@kernel
def _check_published(state: State, reading: Reading, row: int) -> None:
    """What has changed since the message before; a keyframe is left to `Checker`, to inflate it."""
    act = reading.acts[row]
    payload, at = reading.payload, act[of.WEIGHTS]
    book, view = state.book[act[of.PLACE]], state.views[act[of.PLACE]]
    published = state.published[act[of.PLACE]]
    sequence, base, size, at, end = of.parts_of_weights(payload, at, at + act[of.WEIGHTS_BYTES])
    if end >= 0 and base == 0:
        book[_SEQUENCE], book[_KEYFRAME] = sequence, row + 1
        state.found[1] += 1
        return
    sound = end >= 0 and base == book[_SEQUENCE] and size == view.shape[0]
    sample = 0
    while sound and at < end:
        step, at = take_int(payload, at)
        units, at = take_uint(payload, at)
        sample += step
        if not (0 <= at <= end and 0 <= sample < size) or units > published[sample]:
            sound = False
            break
        left = view[sample]
        book[_DIFFERING] += (units != left) - (published[sample] != left)
        published[sample] = units
    if end >= 0:
        book[_SEQUENCE] = sequence if sound else 0
    if not sound:
        _note(state, _NOT_REBUILT, row, 0, 0, 0, 0.0, 0.0)
    elif book[_DIFFERING]:
        _note(state, _NOT_ITS_OWN, row, 0, 0, 0, 0.0, 0.0)


@kernel
def _check_goal(state: State, reading: Reading, row: int) -> None:
    """The weight at the time of choosing: what is left now, or what it has shipped since."""
    samples_m, by_x = state.samples_m, state.by_x
    x_m, y_m = reading.poses_m[row, 2], reading.poses_m[row, 3]
    low, high = 0, by_x.shape[0]
    while low < high:
        middle = (low + high) // 2
        if samples_m[by_x[middle], 0] < x_m:
            low = middle + 1
        else:
            high = middle
    known = False
    while low < by_x.shape[0] and samples_m[by_x[low], 0] == x_m:
        sample = by_x[low]
        if samples_m[sample, 1] == y_m:
            known = True
            if state.views[reading.acts[row, of.PLACE], sample] > 0:
                return
        low += 1
    if not known:
        _note(state, _NO_SAMPLE, row, 0, 0, 0, 0.0, 0.0)
    elif not _ships_to(state, reading, row, x_m, y_m):
        _note(state, _NO_WEIGHT, row, 0, 0, 0, 0.0, 0.0)


@kernel
def _ships_to(state: State, reading: Reading, row: int, x_m: float, y_m: float) -> bool:
    """Whether something of what was spent went to this place."""
    act = reading.acts[row]
    for i in range(act[of.SPENT], act[of.SPENT] + max(0, act[of.SPENT_COUNT])):
        place_m = state.samples_m[reading.pairs[i, of.SAMPLE]]
        if place_m[0] == x_m and place_m[1] == y_m and reading.pairs[i, of.UNITS] > 0:
            return True
    return False


@kernel
def _check_ledger(state: State, reading: Reading, row: int, item: int) -> None:
    """Own entries that a participant sends are the ones it consumed, one for one."""
    who = reading.acts[row, of.PLACE]
    sent = reading.sent[reading.acts[row, of.SENT] + item]
    payload = reading.payload
    have, have_end, at, end = of.parts_of_news(payload, sent[of.BODY], sent[of.BODY_END])
    if end < 0 or not _is_log(payload, at, end) or not _is_vector(state, payload, have, have_end):
        _note(state, _UNREADABLE, row, item, 0, 0, 0.0, 0.0)
        return
    for origin in range(state.have.shape[1]):
        state.have[who, origin], have = take_uint(payload, have)
    state.book[who, _TOLD] = 1
    told = -1
    start = 0
    while at < end:
        origin, at = take_uint(payload, at)
        first, at = take_uint(payload, at)
        _span, at = take_uint(payload, at)
        count, at = take_uint(payload, at)
        if origin == who and told < 0 and count > 0:
            start, told = first, first
        sample = 0
        for _ in range(count):
            step, at = take_int(payload, at)
            units, at = take_uint(payload, at)
            sample += step
            if origin == who:
                if not (
                    told < state.book[who, _ENTRIES]
                    and state.logs[who, told, 0] == sample
                    and state.logs[who, told, 1] == units
                ):
                    _note(state, _LOG, row, item, start, 0, 0.0, 0.0)
                    return
                told += 1


@kernel
def _is_log(payload: bytes, at: int, end: int) -> bool:
    """Whether payload[at:end] is a row of suffixes, see News.logs."""
    while 0 <= at < end:
        _origin, at = take_uint(payload, at)
        start, at = take_uint(payload, at)
        _span, at = take_uint(payload, at)
        count, at = take_uint(payload, at)
        if at < 0 or start > LENGTH_MAX or count > end - at:
            return False
        for _ in range(2 * count):
            _value, at = take_uint(payload, at)
    return at == end


@kernel
def _is_vector(state: State, payload: bytes, at: int, end: int) -> bool:
    """Whether payload[at:end] begins with a log length for every participant."""
    for _ in range(state.have.shape[1]):
        _length, at = take_uint(payload, at)
    return 0 <= at <= end


@kernel
def _check(
    payload: bytes,
    sizes: np.ndarray,
    acts: np.ndarray,
    ruled_m: np.ndarray,
    heard: np.ndarray,
    sent: np.ndarray,
    verdicts: np.ndarray,
    pairs: np.ndarray,
    book: np.ndarray,
    poses_m: np.ndarray,
    views: np.ndarray,
    published: np.ndarray,
    consumed: np.ndarray,
    logs: np.ndarray,
    posted: np.ndarray,
    flights: np.ndarray,
    have: np.ndarray,
    faults: np.ndarray,
    lengths_m: np.ndarray,
    found: np.ndarray,
    samples_m: np.ndarray,
    by_x: np.ndarray,
    sample_units: int,
    point_units: int,
    budget: int,
    ledger: bool,
    supervisor: int,
    speed_m_s: float,
    range_m: float,
    supervisor_range_m: float,
    transport: bool,
    now_ns: int,
) -> int:
    """Follow one batch; how many faults and keyframes it has.

    Negative if an array has no room, and nothing has changed.
    """
    reading = Reading(payload, sizes, acts, ruled_m, heard, sent, verdicts, pairs)
    state = State(
        book,
        poses_m,
        views,
        published,
        consumed,
        logs,
        posted,
        flights,
        have,
        faults,
        lengths_m,
        found,
        samples_m,
        by_x,
    )
    law = Law(
        sample_units,
        point_units,
        budget,
        ledger,
        supervisor,
        speed_m_s,
        range_m,
        supervisor_range_m,
        transport,
    )
    lacking = _lacking(state, reading)
    if lacking < 0:
        return lacking
    found[:] = 0
    for row in range(sizes[of.ACTS]):
        if acts[row, of.PLACE] >= 0:
            _check_inbox(state, reading, row, now_ns)
            _post(state, reading, row)
    for row in range(sizes[of.VERDICTS]):
        _check_verdict(state, law, reading, row)
    for row in range(sizes[of.ACTS]):
        who = acts[row, of.PLACE]
        if who < 0:
            _note(state, _STRANGER, row, 0, 0, 0, 0.0, 0.0)
            continue
        if not acts[row, of.PRESENT]:
            book[who, _ABSENCES] += 1
            continue
        _check_order(state, reading, row)
        _check_speed(state, law, reading, row)
        _check_energy(state, law, reading, row)
        _check_weights(state, law, reading, row)
        for item in range(acts[row, of.SENT_COUNT] if ledger else 0):
            _check_ledger(state, reading, row, item)
        for item in range(acts[row, of.VIOLATIONS]):
            _note(state, _REFUSED, row, item, 0, 0, 0.0, 0.0)
        if acts[row, of.WEIGHTS_BYTES]:
            _check_published(state, reading, row)
        if transport and acts[row, of.HEADS]:
            _check_goal(state, reading, row)
    return found[0] + found[1]


class Checker:
    """Follows the records of one run and collects complaints.

    A mission with a map has no weights, energy or ledger; it has rules of its own, see `MapRules`.

    Rules
    -----
    range       no envelope is delivered to anybody beyond the range at the time of sending, nor beyond
                what a fault leaves of it
    cut         nothing is delivered over a link that a partition or a one-way fault cuts at that time
    delivery    what is in an inbox was delivered to it, is due, and came as often as ruled
    weights     no entry of a weight vector ever rises or is negative, and what is published on the
                weights key rebuilds exactly this vector
    energy      nobody ships more points than its budget, or more units than a point holds
    ledger      consumed = sum of the ledgers: what a participant sends of its log is what it consumed,
                entry for entry, and at the end its vector is exactly what the logs it holds leave
    credit      no view is lower than the weights that all spending leaves (both merges)
    speed       no accepted move is longer than speed times time
    bound       where the bounds claim to hold, the exact distance is not above them (rows that have it)
    goal        a goal has weight in the robot's own view (transport with standing samples)
    register    the own register that a robot sends is the sum over the places from which it chose
                (spectral; not once an output is missing from the record)
    order       steps count up by one, time never runs back, an opening first, nothing after the end
    ruling      the world found no fault of its own
    """

    def __init__(self, reader: Reader | None = None, survey: Survey | None = None) -> None:
        """reader, survey: those that another referee of the same run follows it by."""
        self.complaints: list[str] = []
        self.count = 0
        """All complaints, also those beyond the ones that are kept."""
        self._reader = reader or Reader()
        self._survey = survey
        self._map_rules: MapRules | None = None
        self._opening: Opening | None = None
        self._ended = False
        self._now_ns = 0

    def take(self, record: Record) -> None:
        """Check one record."""
        if self._ended:
            self._complain("order", "record", "something follows the ending")
        elif isinstance(record, Opening):
            if self._opening is not None:
                self._complain("order", "record", "a second opening")
            self._open(record)
        elif self._opening is None:
            self._complain("order", "record", "no opening")
        elif isinstance(record, Batch):
            self._check(record)
        elif isinstance(record, Ending):
            self._ended = True
            self._end()

    def take_row(self, row: tuple[Any, ...]) -> None:
        """Hold a row's bounds against its exact distance, if they claim to be bounds."""
        if not isinstance(row, Row) or row.w1_exact is None or row.w_ub_tight is None:
            return
        least = row.w1_exact * (1.0 - ROUNDING)
        for form, bound in (("tight", row.w_ub_tight), ("paper", row.w_ub_paper)):
            if not bound >= least:
                self._complain(
                    "bound", f"tick {row.tick}", f"{form} {bound:.6g} m below {row.w1_exact:.6g} m"
                )

    def _complain(self, rule: str, who: str, what: str) -> None:
        self.count += 1
        if len(self.complaints) < _COMPLAINTS_MAX:
            self.complaints.append(f"{rule}: t={self._now_ns * 1e-9:.3f} s: {who}: {what}")

    def _open(self, opening: Opening) -> None:
        self._reader.read(opening)
        scenario, site = opening.scenario, opening.site
        self._opening, self._scenario, self._units = opening, scenario, opening.units
        self._samples = site.samples_m.shape[0]
        names = scenario.roster
        self._places = {name: i for i, name in enumerate(names)}
        self._subscriber = WeightsSubscriber()
        self._faults = LinkFaults.of(scenario, opening.seed)
        self._law = Law(
            sample_units=self._units.sample,
            point_units=self._units.point,
            budget=scenario.steps_per_robot,
            ledger=scenario.merge == "ledger" and not scenario.mapping,
            supervisor=scenario.robots.count,
            speed_m_s=scenario.vehicle.speed_m_s,
            range_m=scenario.radio.range_m,
            supervisor_range_m=scenario.supervisor.range_m,
            transport=scenario.planner.name == "transport" and scenario.samples.diffusion_m == 0.0,
        )
        poses_m = np.zeros((len(names), 2))
        poses_m[-1] = scenario.supervisor_m
        poses_m[: scenario.robots.count] = site.starts_m
        self._state = State(
            book=np.zeros((len(names), _BOOK_COLUMNS), dtype=np.int64),
            poses_m=poses_m,
            views=np.full((len(names), self._samples), self._units.sample, dtype=np.int64),
            published=np.zeros((len(names), self._samples), dtype=np.int64),
            consumed=np.zeros(self._samples, dtype=np.int64),
            logs=np.zeros((len(names), 256, 2), dtype=np.int64),
            posted=np.zeros((len(names), 256, 2), dtype=np.int64),
            flights=np.zeros((len(names), 64, 3), dtype=np.int64),
            have=np.zeros((len(names), len(names)), dtype=np.int64),
            faults=np.zeros((_COMPLAINTS_MAX, 5), dtype=np.int64),
            lengths_m=np.zeros((_COMPLAINTS_MAX, 2)),
            found=np.zeros(2, dtype=np.int64),
            samples_m=site.samples_m.copy(),
            by_x=np.argsort(site.samples_m[:, 0]),
        )
        self._arguments = (*self._state, *self._law)
        self._visiting = scenario.planner.name == "spectral"
        self._registers = np.zeros((len(names), scenario.register_width), dtype=np.int64)
        self._rectangle = rectangle_of(scenario.domain)
        self._said: dict[ParticipantId, Pose] = {}
        self._missed: set[ParticipantId] = set()
        if scenario.mapping:
            self._map_rules = MapRules(self._survey or Survey(self._reader), self._complain)
            self._map_rules.open(opening)

    def _check(self, batch: Batch) -> None:
        if batch.now_ns < self._now_ns:
            self._complain("order", "record", f"time runs back to {batch.now_ns * 1e-9:.3f} s")
        self._now_ns = batch.now_ns
        if self._faults is not None:
            self._check_links(batch, self._faults)
        reading = self._reader.read(batch)
        noted = _check(*reading, *self._arguments, batch.now_ns)
        while noted < 0:
            self._lengthen(_GROWING[noted])
            noted = _check(*reading, *self._arguments, batch.now_ns)
        if noted:
            self._put_into_words(batch, int(self._state.found[0]))
            self._check_keyframes(batch)
        if self._visiting:
            self._check_registers(batch)
        if self._map_rules is not None:
            unsaid = self._map_rules.check(batch)
            self.count += unsaid

    def _check_links(self, batch: Batch, faults: LinkFaults) -> None:
        """By the places that everybody had at the time of sending, before the batch moves them."""
        for source, sequence, target, due_ns in map(msgspec.structs.astuple, batch.verdicts):
            here, there = self._places.get(source), self._places.get(target)
            if due_ns == DROPPED or here is None or there is None:
                continue
            if faults.cuts(batch.now_ns, source, target):
                self._complain("cut", target, f"{source}#{sequence} over a link that is cut")
            reach_m = faults.reach_m(batch.now_ns, source, target)
            dx, dy = (self._state.poses_m[there] - self._state.poses_m[here]).tolist()
            if not dx * dx + dy * dy <= reach_m * reach_m:
                way_m = math.hypot(dx, dy)
                what = f"{source}#{sequence} over {way_m:.6g} m, a fault leaves {reach_m:.6g} m"
                self._complain("range", target, what)

    def _lengthen(self, name: str) -> None:
        """Double one of the arrays that grow with the run."""
        rows = getattr(self._state, name)
        longer = np.concatenate((rows, np.zeros_like(rows)), axis=1)
        self._state = self._state._replace(**{name: longer})
        self._arguments = (*self._state, *self._law)

    def _put_into_words(self, batch: Batch, faults: int) -> None:
        noted = min(faults, _COMPLAINTS_MAX)
        rows, lengths_m = self._state.faults[:noted], self._state.lengths_m[:noted]
        for (fault, row, item, a, b), (x, y) in zip(rows.tolist(), lengths_m.tolist(), strict=True):
            rule, text = _WORDS[fault]
            who, what = _concerned(batch, fault, row, item)
            self._complain(rule, who, text.format(what=what, item=item, a=a, b=b, x=x, y=y))
        self.count += faults - noted

    def _check_keyframes(self, batch: Batch) -> None:
        book, subscriber = self._state.book, self._subscriber
        for place in np.flatnonzero(book[:, _KEYFRAME]).tolist():
            act = batch.acts[book[place, _KEYFRAME] - 1]
            assert act.outputs is not None
            rebuilt = subscriber.take(act.outputs.weights)
            weights, view = subscriber.weights, self._state.views[place]
            if not rebuilt or weights is None or weights.shape != view.shape:
                book[place, _SEQUENCE] = 0
                self._complain("weights", act.name, _WORDS[_NOT_REBUILT][1])
                continue
            self._state.published[place] = weights
            book[place, _DIFFERING] = np.count_nonzero(weights != view)
            if book[place, _DIFFERING]:
                self._complain("weights", act.name, _WORDS[_NOT_ITS_OWN][1])

    def _check_registers(self, batch: Batch) -> None:
        for act in batch.acts:
            if act.outputs is None or act.ruling is None:
                self._missed.add(act.name)
            elif act.name in self._places and act.name not in self._missed:
                self._check_register(act, act.outputs)

    def _check_register(self, act: Act, outputs: Outputs) -> None:
        """It chooses where it was observed last, or where it went itself if that word is late."""
        name, place, width = act.name, self._places[act.name], self._scenario.register_width
        timely = act.observation.step == outputs.step - 1
        pose = act.observation.pose if timely else self._said.get(name, act.observation.pose)
        self._said[name] = outputs.pose
        if outputs.spent:
            modes = self._scenario.planner.modes
            self._registers[place] += visit_at(pose.x_m, pose.y_m, self._rectangle, modes)
        for envelope in outputs.outbox:
            try:
                content = decode_news(envelope.body).registers
            except RefusedError:
                content = b"\x80"
            sent = read_register(content, len(self._places), width, place)
            points = int(self._state.book[place, _POINTS])
            if sent is None:
                self._complain("register", name, "sends what nobody can read")
            elif sent[0] and not np.array_equal(sent[1], self._registers[place]):
                self._complain("register", name, "its sums are not those over its places")
            elif sent[0] and sent[0] != points:
                self._complain("register", name, f"writes {sent[0]} of {points}")

    def _end(self) -> None:
        if self._law.ledger:
            for name, place in self._places.items():
                if self._state.book[place, _TOLD]:
                    self._check_view(name, self._state.have[place].tolist())

    def _check_view(self, name: ParticipantId, have: list[int]) -> None:
        state = self._state
        spent = np.zeros(self._samples, dtype=np.int64)
        for origin, length in zip(self._places, have, strict=True):
            place = self._places[origin]
            entries = int(state.book[place, _ENTRIES])
            if length > entries:
                self._complain("ledger", name, f"holds {length} entries of {origin}'s {entries}")
                return
            log = state.logs[place, :length]
            np.add.at(spent, log[:, 0], log[:, 1])
        wrong = np.flatnonzero(
            state.views[self._places[name]] != np.maximum(self._units.sample - spent, 0)
        )
        if wrong.size:
            self._complain(
                "ledger", name, f"its view of sample {wrong[0]} is not what its logs leave"
            )


def _concerned(batch: Batch, fault: int, row: int, item: int) -> tuple[str, str]:
    """Whom a fault is about; and which envelope, or what the codec says of it."""
    if fault in _OF_VERDICTS:
        verdict = batch.verdicts[row]
        return verdict.target, f"{verdict.source}#{verdict.sequence}"
    act = batch.acts[row]
    if fault == _UNHEARD:
        source, sequence = act.heard[item]
        return act.name, f"{source}#{sequence}"
    if fault == _REFUSED and act.ruling is not None:
        return act.name, act.ruling.violations[item]
    if fault in (_NO_SAMPLE, _NO_WEIGHT) and act.outputs is not None:
        return act.name, str(act.outputs.goal)
    if fault == _UNREADABLE and act.outputs is not None:
        try:
            decode_news(act.outputs.outbox[item].body)
        except RefusedError as error:
            return act.name, f": {error}"
    return act.name, ""


def check(records: Iterable[Record]) -> Checker:
    """Check a whole record."""
    checker = Checker()
    for record in records:
        checker.take(record)
    return checker
