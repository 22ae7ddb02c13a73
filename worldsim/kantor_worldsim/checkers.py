"""Referees that read only the record. Each rule can fail, and a test shows how.

A complaint is one line: rule, time, who, what. A run is clean when there is none.

Rules on numbers are kernels over the tables of a batch (`reading.py`). A fault is noted as a row of
numbers and put into words afterwards, with the record at hand: a sound run, which is nearly every run,
then costs little more than reading it.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.faults import Clock, Fault, Hostile, Kill, Late
from kantor_protocol.kernels import kernel
from kantor_protocol.machine import WORLD_SIM, Envelope, Outputs, ParticipantId
from kantor_protocol.messages import RefusedError, decode_news
from kantor_protocol.modes import rectangle_of, visit_at
from kantor_protocol.packing import take_int, take_uint
from kantor_protocol.registers import read_register
from kantor_protocol.replica import LENGTH_MAX
from kantor_protocol.slots import slots_told
from kantor_protocol.weights import WeightsSubscriber
from kantor_worldsim import reading as of
from kantor_worldsim.channel import DROPPED
from kantor_worldsim.exact import ROUNDING
from kantor_worldsim.faults import LinkFaults
from kantor_worldsim.map_checker import MapRules
from kantor_worldsim.metrics import Row
from kantor_worldsim.outages import Deed, deeds_of
from kantor_worldsim.reading import Reader, Reading
from kantor_worldsim.records import Act, Batch, Ending, Incident, Opening, Record
from kantor_worldsim.rules import Table, reach_m, severs
from kantor_worldsim.survey import Survey
from kantor_worldsim.world import SPEED_TOLERANCE

_COMPLAINTS_MAX = 100
"""A broken record is broken; further complaints only count."""

# Faults that kernels find.
_UNHEARD, _NEVER_SENT, _FOR_ANOTHER, _TOO_FAR = 0, 1, 2, 3
_STEP, _SPEED, _GARBLED_SPENT, _POINT, _BUDGET, _MISCOUNT = 4, 5, 6, 7, 8, 9
_GARBLED_LOWERED, _RISE, _BELOW, _UNREADABLE, _LOG = 10, 11, 12, 13, 14
_STRANGER, _REFUSED, _NOT_REBUILT, _NOT_ITS_OWN, _NO_SAMPLE, _NO_WEIGHT = 15, 16, 17, 18, 19, 20
_WITHHELD, _OUT_OF_TURN, _AGAIN, _STOPPED, _STALE, _REFUSALS = 21, 22, 23, 24, 25, 26
_EPOCH, _FOREIGN_LOG, _FORGETS, _NOBODYS, _SKEW, _CUT = 27, 28, 29, 30, 31, 32
_OF_VERDICTS = (_NEVER_SENT, _FOR_ANOTHER, _TOO_FAR, _CUT)
_NO_LOGS, _NO_POSTED, _NO_FLIGHTS, _NO_FORGED = -1, -2, -3, -4
_GROWING = {
    _NO_LOGS: "logs",
    _NO_POSTED: "posted",
    _NO_FLIGHTS: "flights",
    _NO_FORGED: "forged",
}

_WORDS = {
    _UNHEARD: ("delivery", "heard {what}, which was not delivered"),
    _NEVER_SENT: ("delivery", "{what} was never sent"),
    _FOR_ANOTHER: ("delivery", "delivered what was for somebody else"),
    _TOO_FAR: ("range", "{what} over {x:.6g} m, allowed {y:.6g} m"),
    _CUT: ("cut", "{what} over a link that is cut"),
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
    _WITHHELD: ("delivery", "did not hear {what}, which had arrived"),
    _OUT_OF_TURN: ("delivery", "heard {what} after what arrived later"),
    _AGAIN: ("delivery", "sends under number {a}, which it has used"),
    _STOPPED: ("dead", "acts, and is stopped since {x:.3f} s"),
    _STALE: ("hold", "makes step {a} and has seen what became of step {b}"),
    _REFUSALS: ("refusal", "refused {a} messages; {b} were forged"),
    _EPOCH: ("epoch", "speaks as incarnation {a} and is {b}"),
    _FOREIGN_LOG: ("ledger", "forwards an entry at {a} of {what}'s log that it never made"),
    _FORGETS: ("ledger", "holds {a} entries of {what}'s log of which it held {b}"),
    _NOBODYS: ("ledger", "holds entries of {what}, who was never there"),
    _SKEW: ("clock", "its clock is {a} ns ahead, which no fault says"),
}
"""Rule and text of each fault."""

# Columns of State.book.
_STEPS, _SLOT, _MOVED_NS, _POINTS, _OPEN, _POSTED, _FLYING, _TOLD = 0, 1, 2, 3, 4, 5, 6, 7
_SEQUENCE, _DIFFERING, _COMING, _KEYFRAME, _STOPPED_NS = 8, 9, 10, 13, 14
_REFUSALS_SO_FAR, _NUMBER, _SKEW_BEFORE_NS = 15, 16, 17
_BOOK_COLUMNS = 18
# Columns of State.shipped.
_ENTRIES, _WRITES = 0, 1
# Slots of State.found.
_FAULTS, _KEYFRAMES, _FORGED = 0, 1, 2

FORGED_FIRST = 1 << 62
"""What is forged has numbers from there on."""

_NOT = -1
"""In the book: not stopped."""

_STOPS = {"kill": "start", "pause": "resume", "fill": "free", "leave": "join"}
"""What stops a process, and what has it go on."""
_STARTS = ("start", "join")


class State(NamedTuple):
    """What the kernels keep of the run so far. n participants, N samples."""

    book: npt.NDArray[np.int64]
    """(n, 18): last step; origin slot; time of the last move; points shipped by all its incarnations;
    whether it has a turn that it has not answered; rows used of posted and flights; whether this
    incarnation has sent a version vector; sequence of what it published last, entries in which that
    differs from its view; rows that this batch brings to logs, posted and flights; 1 + the act with which
    it publishes a keyframe in this batch; since when it is stopped, or _NOT; messages it has refused;
    the highest number of what it has sent; how far its clock was ahead in its last step."""
    poses_m: npt.NDArray[np.float64]
    """(n, 2) world frame."""
    views: npt.NDArray[np.int64]
    """(n, N) the weight vector of each, in units."""
    published: npt.NDArray[np.int64]
    """(n, N) the same, rebuilt from what each has published."""
    consumed: npt.NDArray[np.int64]
    """(N,) units shipped by all."""
    shipped: npt.NDArray[np.int64]
    """(slots, 2): entries of each log, points shipped. Incarnation e of participant i has slot e n + i."""
    logs: npt.NDArray[np.int64]
    """(slots, rows, 2): sample, units; what each has consumed."""
    posted: npt.NDArray[np.int64]
    """(n, rows, 2): sequence, target of what each has sent."""
    flights: npt.NDArray[np.int64]
    """(n, rows, 4): source, sequence, due_ns of what is on its way to each; whether it was handed over with
    the turn that is open."""
    forged: npt.NDArray[np.int64]
    """(1, rows, 3): source, sequence, target of what faults have put on the air."""
    have: npt.NDArray[np.int64]
    """(n, slots) log lengths that each said last it holds."""
    faults: npt.NDArray[np.int64]
    """(rows, 5): fault, act or verdict, item of it, two numbers."""
    lengths_m: npt.NDArray[np.float64]
    """(rows, 2): lengths of the fault."""
    found: npt.NDArray[np.int64]
    """(3,) how many faults and how many keyframes this batch has; rows used of forged."""
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
    claims: bool
    """Version vectors have a second half, of claims."""
    virtual: bool
    """Who steps has heard all that had arrived."""
    clocks: bool
    """There are faults of clocks."""
    patience_ns: int
    """How much later than it was stopped somebody may have acted: signals take a while."""


@kernel
def _note(
    state: State, fault: int, row: int, item: int, a: int, b: int, x_m: float, y_m: float
) -> None:
    at = state.found[_FAULTS]
    state.found[_FAULTS] += 1
    if at < state.faults.shape[0]:
        noted = state.faults[at]
        noted[0], noted[1], noted[2], noted[3], noted[4] = fault, row, item, a, b
        state.lengths_m[at, 0], state.lengths_m[at, 1] = x_m, y_m


@kernel
def _lacking(state: State, reading: Reading) -> int:
    """Which array has no room for this batch behind what is held of somebody, or 0."""
    book = state.book
    book[:, _COMING : _KEYFRAME + 1] = 0
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
    if state.found[_FORGED] + reading.sizes[of.INJECTED] > state.forged.shape[1]:
        return _NO_FORGED
    for who in range(book.shape[0]):
        if state.shipped[book[who, _SLOT], _ENTRIES] + book[who, _COMING] > state.logs.shape[1]:
            return _NO_LOGS
        if book[who, _POSTED] + book[who, _COMING + 1] > state.posted.shape[1]:
            return _NO_POSTED
        if book[who, _FLYING] + book[who, _COMING + 2] > state.flights.shape[1]:
            return _NO_FLIGHTS
    return 0


@kernel
def _land(state: State, who: int, row: int) -> None:
    """Take a row out of what is on its way to somebody."""
    flights = state.flights[who]
    state.book[who, _FLYING] -= 1
    last = state.book[who, _FLYING]
    for column in range(4):
        flights[row, column] = flights[last, column]


@kernel
def _check_inbox(state: State, law: Law, reading: Reading, row: int, now_ns: int) -> None:
    """What was heard had arrived; in virtual time also: all that had arrived, in order of arrival."""
    act = reading.acts[row]
    who = act[of.PLACE]
    flights = state.flights[who]
    if state.book[who, _OPEN] == 0:
        by_ns = act[of.NOW_NS] if law.virtual else now_ns
        for i in range(state.book[who, _FLYING]):
            flights[i, 3] = flights[i, 2] <= by_ns
    state.book[who, _OPEN] = law.virtual and not act[of.PRESENT]
    before_ns, before_source, before_sequence = 0, 0, 0
    for item in range(act[of.HEARD_COUNT]):
        heard = reading.heard[act[of.HEARD] + item]
        first = -1  # the copy that arrived first
        for i in range(state.book[who, _FLYING]):
            if (
                flights[i, 0] == heard[of.SOURCE]
                and flights[i, 1] == heard[of.SEQUENCE]
                and flights[i, 3]
                and (first < 0 or flights[i, 2] < flights[first, 2])
            ):
                first = i
        if first < 0:
            _note(state, _UNHEARD, row, item, 0, 0, 0.0, 0.0)
            continue
        source, sequence, due_ns = flights[first, 0], flights[first, 1], flights[first, 2]
        _land(state, who, first)
        if law.virtual and (
            due_ns < before_ns
            or (due_ns == before_ns and 0 <= source < before_source)
            or (due_ns == before_ns and source == before_source and sequence < before_sequence)
        ):
            _note(state, _OUT_OF_TURN, row, item, 0, 0, 0.0, 0.0)
        before_ns, before_source, before_sequence = due_ns, source, sequence
    if law.virtual and act[of.PRESENT]:
        for i in range(state.book[who, _FLYING] - 1, -1, -1):
            if flights[i, 3]:
                _note(state, _WITHHELD, row, 0, flights[i, 0], flights[i, 1], 0.0, 0.0)
                _land(state, who, i)


@kernel
def _post(state: State, reading: Reading, row: int) -> None:
    act = reading.acts[row]
    for sent in range(act[of.SENT], act[of.SENT] + act[of.SENT_COUNT]):
        source, sequence = reading.sent[sent, of.SOURCE], reading.sent[sent, of.SEQUENCE]
        if source >= 0:
            book = state.book[source]
            if sequence <= book[_NUMBER] and _find_posted(state, source, sequence) >= 0:
                _note(state, _AGAIN, row, 0, sequence, 0, 0.0, 0.0)
            book[_NUMBER] = max(book[_NUMBER], sequence)
            posted = state.posted[source, book[_POSTED]]
            posted[0], posted[1] = sequence, reading.sent[sent, of.TARGET]
            book[_POSTED] += 1


@kernel
def _post_forged(state: State, reading: Reading) -> None:
    for row in range(reading.sizes[of.INJECTED]):
        forged, injected = state.forged[0, state.found[_FORGED]], reading.injected[row]
        forged[0], forged[1] = injected[of.SOURCE], injected[of.SEQUENCE]
        forged[2] = injected[of.TARGET]
        state.found[_FORGED] += 1


@kernel
def _find_posted(state: State, source: int, sequence: int) -> int:
    """The row in which a source has sent something under this number last; negative if it has not."""
    if source >= 0:
        for i in range(state.book[source, _POSTED] - 1, -1, -1):
            if state.posted[source, i, 0] == sequence:
                return i
    return -1


@kernel
def _target_of(state: State, source: int, sequence: int) -> int:
    """For whom somebody, or a fault, has sent something under this number; STRANGER if nobody has."""
    at = _find_posted(state, source, sequence) if sequence < FORGED_FIRST else -1
    if at >= 0:
        return int(state.posted[source, at, 1])
    if sequence >= FORGED_FIRST:
        for i in range(state.found[_FORGED] - 1, -1, -1):
            if state.forged[0, i, 0] == source and state.forged[0, i, 1] == sequence:
                return int(state.forged[0, i, 2])
    return of.STRANGER


@kernel
def _check_link(
    state: State, law: Law, links: Table, row: int, now_ns: int, source: int, receiver: int
) -> None:
    """By the places that both had at the time of sending, before the batch moves them."""
    range_m = law.supervisor_range_m if law.supervisor in (source, receiver) else law.range_m
    if links.rules.shape[0] > 0:
        if severs(links, now_ns, source, receiver):
            _note(state, _CUT, row, 0, 0, 0, 0.0, 0.0)
        range_m = reach_m(links, now_ns, source, receiver, range_m)
    dx = state.poses_m[receiver, 0] - state.poses_m[source, 0]
    dy = state.poses_m[receiver, 1] - state.poses_m[source, 1]
    if not dx * dx + dy * dy <= range_m * range_m:
        _note(state, _TOO_FAR, row, 0, 0, 0, math.hypot(dx, dy), range_m)


@kernel
def _check_verdict(
    state: State, law: Law, links: Table, reading: Reading, row: int, now_ns: int
) -> None:
    verdict = reading.verdicts[row]
    source, sequence = verdict[of.SOURCE], verdict[of.SEQUENCE]
    receiver, due_ns = verdict[of.TARGET], verdict[of.DUE_NS]
    target = _target_of(state, source, sequence)
    if target == of.STRANGER or receiver < 0:
        _note(state, _NEVER_SENT, row, 0, 0, 0, 0.0, 0.0)
        return
    if target not in (of.EVERYBODY_PLACE, receiver):
        _note(state, _FOR_ANOTHER, row, 0, 0, 0, 0.0, 0.0)
    if due_ns == DROPPED:
        return
    if source >= 0:  # nobody knows where a stranger is
        _check_link(state, law, links, row, now_ns, source, receiver)
    flight = state.flights[receiver, state.book[receiver, _FLYING]]
    flight[0], flight[1], flight[2], flight[3] = source, sequence, due_ns, 0
    state.book[receiver, _FLYING] += 1


@kernel
def _check_life(state: State, law: Law, reading: Reading, row: int) -> None:
    """Whether it can act at all, and by what clock."""
    act = reading.acts[row]
    stopped_ns = state.book[act[of.PLACE], _STOPPED_NS]
    if stopped_ns != _NOT and (law.virtual or act[of.NOW_NS] > stopped_ns + law.patience_ns):
        _note(state, _STOPPED, row, 0, 0, 0, stopped_ns * 1e-9, 0.0)
    if act[of.SKEW_NS] != 0 and not law.clocks:
        _note(state, _SKEW, row, 0, act[of.SKEW_NS], 0, 0.0, 0.0)


@kernel
def _check_ruling(state: State, law: Law, reading: Reading, row: int) -> None:
    """Who is too fast since its clock has gained on time cannot know, and is not to blame."""
    act = reading.acts[row]
    book = state.book[act[of.PLACE]]
    excused = law.clocks and act[of.SKEW_NS] > book[_SKEW_BEFORE_NS]
    book[_SKEW_BEFORE_NS] = act[of.SKEW_NS]
    for item in range(act[of.VIOLATIONS]):
        if not (excused and item + 1 == act[of.TOO_FAST]):
            _note(state, _REFUSED, row, item, 0, 0, 0.0, 0.0)


@kernel
def _check_order(state: State, reading: Reading, row: int) -> None:
    act = reading.acts[row]
    book = state.book[act[of.PLACE]]
    if act[of.STEP] != book[_STEPS] + 1:
        _note(state, _STEP, row, 0, act[of.STEP], book[_STEPS] + 1, 0.0, 0.0)
    elif act[of.OBSERVED] != book[_STEPS]:
        _note(state, _STALE, row, 0, act[of.STEP], act[of.OBSERVED], 0.0, 0.0)
    book[_STEPS] = act[of.STEP]


@kernel
def _check_refusals(state: State, reading: Reading, row: int) -> None:
    """It refuses what is forged, and nothing else."""
    act = reading.acts[row]
    book = state.book[act[of.PLACE]]
    forged = 0
    for item in range(act[of.HEARD], act[of.HEARD] + act[of.HEARD_COUNT]):
        forged += reading.heard[item, of.SEQUENCE] >= FORGED_FIRST
    refused = act[of.REFUSED] - book[_REFUSALS_SO_FAR]
    if refused != forged:
        _note(state, _REFUSALS, row, 0, refused, forged, 0.0, 0.0)
    book[_REFUSALS_SO_FAR] = act[of.REFUSED]


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
    book, slot = state.book[who], state.book[who, _SLOT]
    if act[of.SPENT_COUNT] == of.NOT_DECODED:
        _note(state, _GARBLED_SPENT, row, 0, 0, 0, 0.0, 0.0)
        return
    shipped = 0
    for i in range(act[of.SPENT], act[of.SPENT] + act[of.SPENT_COUNT]):
        sample, units = reading.pairs[i, of.SAMPLE], reading.pairs[i, of.UNITS]
        shipped += units
        state.consumed[sample] += units
        if law.ledger:
            entry = state.logs[slot, state.shipped[slot, _ENTRIES]]
            entry[0], entry[1] = sample, units
            state.shipped[slot, _ENTRIES] += 1
    state.shipped[slot, _WRITES] += act[of.SPENT_COUNT] > 0
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
        state.found[_KEYFRAMES] += 1
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
def _check_news(state: State, law: Law, reading: Reading, row: int, item: int) -> None:
    """Entries that a participant sends are the ones that their origin consumed, one for one."""
    who, participants = reading.acts[row, of.PLACE], state.book.shape[0]
    sent = reading.sent[reading.acts[row, of.SENT] + item]
    payload = reading.payload
    epoch, have, have_end, at, end = of.parts_of_news(payload, sent[of.BODY], sent[of.BODY_END])
    if end >= 0 and epoch != state.book[who, _SLOT] // participants:
        now = state.book[who, _SLOT] // participants
        _note(state, _EPOCH, row, item, epoch, now, 0.0, 0.0)
    if not law.ledger:
        return
    slots = _slots(payload, have, have_end, participants, law.claims) if end >= 0 else 0
    if slots == 0 or not _is_log(payload, at, end):
        _note(state, _UNREADABLE, row, item, 0, 0, 0.0, 0.0)
        return
    _check_have(state, payload, have, slots, who, row)
    while at < end:
        origin, at = take_uint(payload, at)
        start, at = take_uint(payload, at)
        _span, at = take_uint(payload, at)
        count, at = take_uint(payload, at)
        made = state.shipped[origin, _ENTRIES] if origin < state.shipped.shape[0] else 0
        sample = 0
        for told in range(start, start + count):
            step, at = take_int(payload, at)
            units, at = take_uint(payload, at)
            sample += step
            if not (
                told < made
                and state.logs[origin, told, 0] == sample
                and state.logs[origin, told, 1] == units
            ):
                own = origin == state.book[who, _SLOT]
                _note(state, _LOG if own else _FOREIGN_LOG, row, origin, start, 0, 0.0, 0.0)
                return


@kernel
def _slots(payload: bytes, at: int, end: int, participants: int, claims: bool) -> int:
    """How many origins the version vector in payload[at:end] is about; 0 if it is none."""
    numbers = 0
    while 0 <= at < end:
        _value, at = take_uint(payload, at)
        numbers += 1
    width = (2 if claims else 1) * participants
    return participants * (numbers // width) if at == end and numbers % width == 0 else 0


@kernel
def _check_have(state: State, payload: bytes, at: int, slots: int, who: int, row: int) -> None:
    """A version vector does not fall, and is about origins that were there."""
    have = state.have[who]
    state.book[who, _TOLD] = 1
    for origin in range(max(slots, have.shape[0])):
        length = 0
        if origin < slots:
            length, at = take_uint(payload, at)
        if origin >= have.shape[0]:
            if length > 0:
                _note(state, _NOBODYS, row, origin, 0, 0, 0.0, 0.0)
            continue
        if length < have[origin]:
            _note(state, _FORGETS, row, origin, length, have[origin], 0.0, 0.0)
        have[origin] = length


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
def _check(
    payload: bytes,
    sizes: np.ndarray,
    acts: np.ndarray,
    ruled_m: np.ndarray,
    heard: np.ndarray,
    sent: np.ndarray,
    verdicts: np.ndarray,
    pairs: np.ndarray,
    injected: np.ndarray,
    book: np.ndarray,
    poses_m: np.ndarray,
    views: np.ndarray,
    published: np.ndarray,
    consumed: np.ndarray,
    shipped: np.ndarray,
    logs: np.ndarray,
    posted: np.ndarray,
    flights: np.ndarray,
    forged: np.ndarray,
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
    claims: bool,
    virtual: bool,
    clocks: bool,
    patience_ns: int,
    seed: int,
    link_rules: np.ndarray,
    link_numbers: np.ndarray,
    link_names: np.ndarray,
    severed: np.ndarray,
    now_ns: int,
) -> int:
    """Follow one batch; how many faults and keyframes it has.

    Negative if an array has no room, and nothing has changed.
    """
    reading = Reading(payload, sizes, acts, ruled_m, heard, sent, verdicts, pairs, injected)
    state = State(
        book,
        poses_m,
        views,
        published,
        consumed,
        shipped,
        logs,
        posted,
        flights,
        forged,
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
        claims,
        virtual,
        clocks,
        patience_ns,
    )
    links = Table(seed, link_rules, link_numbers, link_names, severed)
    lacking = _lacking(state, reading)
    if lacking < 0:
        return lacking
    found[_FAULTS], found[_KEYFRAMES] = 0, 0
    for row in range(sizes[of.ACTS]):
        if acts[row, of.PLACE] >= 0:
            _check_inbox(state, law, reading, row, now_ns)
            _post(state, reading, row)
    _post_forged(state, reading)
    for row in range(sizes[of.VERDICTS]):
        _check_verdict(state, law, links, reading, row, now_ns)
    for row in range(sizes[of.ACTS]):
        who = acts[row, of.PLACE]
        if who < 0:
            _note(state, _STRANGER, row, 0, 0, 0, 0.0, 0.0)
            continue
        if not acts[row, of.PRESENT]:
            continue
        _check_life(state, law, reading, row)
        _check_order(state, reading, row)
        _check_refusals(state, reading, row)
        _check_speed(state, law, reading, row)
        _check_energy(state, law, reading, row)
        _check_weights(state, law, reading, row)
        for item in range(acts[row, of.SENT_COUNT]):
            _check_news(state, law, reading, row, item)
        _check_ruling(state, law, reading, row)
        if acts[row, of.WEIGHTS_BYTES]:
            _check_published(state, reading, row)
        if transport and acts[row, of.HEADS]:
            _check_goal(state, reading, row)
    return found[_FAULTS] + found[_KEYFRAMES]


class Checker:
    """Follows the records of one run and collects complaints.

    A mission with a map has no weights, energy or ledger; it has rules of its own, see `MapRules`.

    Rules
    -----
    range       no envelope is delivered to anybody beyond the range at the time of sending, nor beyond
                what a fault leaves of it
    cut         nothing is delivered over a link that a partition or a one-way fault cuts at that time
    delivery    what is in an inbox was delivered to it, is due, and came as often as ruled; nobody uses a
                number twice; what arrives where nobody lives is lost. In virtual time: who steps has heard
                all that had arrived, in order of arrival, source and number
    weights     no entry of a weight vector ever rises or is negative, and what is published on the
                weights key rebuilds exactly this vector
    energy      nobody ships more points than its budget, over all its incarnations, or more units than a
                point holds
    ledger      consumed = sum of the ledgers: what a participant sends of a log is what its origin
                consumed, entry for entry, it forgets no entry, and at its end its vector is exactly what the
                logs it holds leave
    credit      no view is lower than the weights that all spending leaves (both merges)
    speed       no accepted move is longer than speed times time
    bound       where the bounds claim to hold, the exact distance is not above them (rows that have it)
    goal        a goal has weight in the robot's own view (transport with standing samples)
    register    the own register that a robot sends is the sum over the places from which it chose
                (spectral)
    order       steps count up by one, whatever becomes of processes, time never runs back, an opening
                first, nothing after the end
    hold        a step is made by who has seen what became of the one before
    ruling      the world found no fault of its own, but for the speed of who has a clock that has gained on
                time since its last step
    incident    what befalls a process is what a fault says: of its kind, to whom it names, not too early,
                once, and not left out; without a fault processes only leave and join
    dead        who is dead, paused, not there yet or without a disk does not act, and nobody does while
                world-sim is down
    epoch       a new incarnation comes only after a lost or torn disk, or of itself; each counts one more,
                goes on from the last step, and says in its messages which it is; no impostor is let in
    refusal     a participant refuses what is forged, all of it and nothing else, and nothing is forged but
                where a hostile fault says so
    clock       the clock that a participant reads is as wrong as the faults of clocks say; on the wall no
                further than they have said by then
    """

    def __init__(
        self, reader: Reader | None = None, survey: Survey | None = None, *, virtual: bool = True
    ) -> None:
        """reader, survey: those that another referee of the same run follows it by.

        virtual: not the wall exchange, so that all that had arrived is heard.
        """
        self.complaints: list[str] = []
        self.count = 0
        """All complaints, also those beyond the ones that are kept."""
        self._reader = reader or Reader()
        self._survey = survey
        self._virtual = virtual
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
        elif isinstance(record, Incident):
            self._befall(record)
        else:
            self._ended = True
            self._end(record)

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
        self._names = names
        self._places = {name: i for i, name in enumerate(names)}
        self._subscriber = WeightsSubscriber()
        self._links = LinkFaults(scenario, opening.seed).table
        self._hostile = [fault for fault in scenario.faults if isinstance(fault, Hostile)]
        self._clocks = [fault for fault in scenario.faults if isinstance(fault, Clock)]
        self._clocks_of = {
            name: [fault for fault in self._clocks if name in fault.who] for name in names
        }
        self._deeds: dict[tuple[int, ParticipantId, str], Deed] = {
            (deed.fault, deed.who, deed.what): deed for deed in deeds_of(scenario)
        }
        self._stopped: dict[ParticipantId, dict[str, int]] = {name: {} for name in names}
        self._stopped[WORLD_SIM] = {}
        """Who is stopped by what, and since when."""
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
            claims=scenario.claiming,
            virtual=self._virtual,
            clocks=bool(self._clocks),
            patience_ns=scenario.period_ns,
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
            shipped=np.zeros((len(names), 2), dtype=np.int64),
            logs=np.zeros((len(names), 256, 2), dtype=np.int64),
            posted=np.zeros((len(names), 256, 2), dtype=np.int64),
            flights=np.zeros((len(names), 64, 4), dtype=np.int64),
            forged=np.zeros((1, 64, 3), dtype=np.int64),
            have=np.zeros((len(names), len(names)), dtype=np.int64),
            faults=np.zeros((_COMPLAINTS_MAX, 5), dtype=np.int64),
            lengths_m=np.zeros((_COMPLAINTS_MAX, 2)),
            found=np.zeros(3, dtype=np.int64),
            samples_m=site.samples_m.copy(),
            by_x=np.argsort(site.samples_m[:, 0]),
        )
        self._state.book[:, _SLOT] = np.arange(len(names))
        self._state.book[:, _STOPPED_NS] = _NOT
        self._arguments = (*self._state, *self._law, *self._links)
        self._visiting = scenario.planner.name == "spectral"
        self._registers = np.zeros((len(names), scenario.register_width), dtype=np.int64)
        self._rectangle = rectangle_of(scenario.domain)
        for fault in scenario.faults:
            for name in fault.who if isinstance(fault, Late) else ():
                self._stop(name, "kill", 0)
        if scenario.mapping:
            self._map_rules = MapRules(self._survey or Survey(self._reader), self._complain)
            self._map_rules.open(opening)

    def _check(self, batch: Batch) -> None:
        self._pass_time(batch.now_ns)
        if self._stopped[WORLD_SIM]:
            self._complain("dead", WORLD_SIM, "judges what is done, and is stopped")
        if batch.injected:
            self._check_injected(batch)
        if self._clocks:
            self._check_clocks(batch)
        reading = self._reader.read(batch)
        noted = _check(*reading, *self._arguments, batch.now_ns)
        while noted < 0:
            self._lengthen(_GROWING[noted])
            noted = _check(*reading, *self._arguments, batch.now_ns)
        if noted:
            self._put_into_words(batch, self._state.found.item(_FAULTS))
            self._check_keyframes(batch)
        if self._visiting:
            self._check_registers(batch)
        if self._map_rules is not None:
            unsaid = self._map_rules.check(batch)
            self.count += unsaid

    def _pass_time(self, now_ns: int) -> None:
        if now_ns < self._now_ns:
            self._complain("order", "record", f"time runs back to {now_ns * 1e-9:.3f} s")
        self._now_ns = now_ns

    def _check_injected(self, batch: Batch) -> None:
        if not any(_within(fault, batch.now_ns) for fault in self._hostile):
            self._complain("refusal", "record", "something is forged where no fault says so")
        for envelope in batch.injected:
            if envelope.sequence < FORGED_FIRST:
                number = f"{envelope.source}#{envelope.sequence}"
                self._complain("refusal", "record", f"{number} is forged, and may have been sent")

    def _check_clocks(self, batch: Batch) -> None:
        for act in batch.acts:
            if act.skew_ns == 0 and not self._clocks_of.get(act.name):
                continue
            least_ns, most_ns = self._skews_ns(act.name, act.now_ns)
            if not least_ns <= act.skew_ns <= most_ns:
                what = f"its clock is {act.skew_ns} ns ahead, by its faults {most_ns}"
                self._complain("clock", act.name, what)

    def _skews_ns(self, name: ParticipantId, now_ns: int) -> tuple[int, int]:
        """The least and the most that a clock can be ahead. On the wall it hears of its faults later."""
        clocks = self._clocks_of.get(name, ())
        if self._virtual:
            skew_ns = sum(clock.skew_ns(now_ns) for clock in clocks if _within(clock, now_ns))
            skew_ns = max(skew_ns, -now_ns)  # no clock shows a time before 0
            return skew_ns, skew_ns
        least_ns = most_ns = 0
        for clock in clocks:
            if clock.from_ns <= now_ns:
                last_ns = now_ns if clock.until_ns is None else min(now_ns, clock.until_ns)
                said_ns = (0, clock.skew_ns(clock.from_ns), clock.skew_ns(last_ns))
                least_ns, most_ns = least_ns + min(said_ns), most_ns + max(said_ns)
        return least_ns, most_ns

    def _befall(self, incident: Incident) -> None:
        """Follow what befell a process."""
        self._pass_time(incident.now_ns)
        name, what = incident.who, incident.what
        if name not in self._stopped:
            self._complain("incident", name, "not in the roster")
            return
        self._check_cause(incident)
        if what in _STOPS:
            self._stop(name, what, incident.now_ns)
        elif what in _STARTS and name in self._places:
            self._take_over(incident, self._places[name])
        for cause in tuple(self._stopped[name]):
            if _STOPS[cause] == what or what in _STARTS:
                del self._stopped[name][cause]
        self._note_stopped(name)
        if self._map_rules is not None:
            self._map_rules.befall(incident)

    def _check_cause(self, incident: Incident) -> None:
        """Whether a fault says so, or nobody."""
        fault, name, what = incident.fault, incident.who, incident.what
        if what == "let in":
            self._complain("epoch", name, "an impostor was let in")
            what = "pretend"
        if fault < 0:
            if what not in {"leave", "join"}:
                self._complain("incident", name, f"{what}, and no fault says so")
            return
        deed = self._deeds.pop((fault, name, what), None)
        if deed is None:
            self._complain("incident", name, f"{what}, which fault {fault} does not say, or once")
        elif incident.now_ns < deed.at_ns:
            self._complain("incident", name, f"{what} before {deed.at_ns * 1e-9:.3f} s")

    def _stop(self, name: ParticipantId, what: str, now_ns: int) -> None:
        self._stopped[name].setdefault(what, now_ns)
        self._note_stopped(name)

    def _note_stopped(self, name: ParticipantId) -> None:
        if name in self._places:
            since_ns = min(self._stopped[name].values(), default=_NOT)
            self._state.book[self._places[name], _STOPPED_NS] = since_ns

    def _take_over(self, incident: Incident, place: int) -> None:
        """A process takes a body over: as who drove it before, or as a new incarnation."""
        book = self._state.book[place]
        steps, epoch = book.item(_STEPS), book.item(_SLOT) // len(self._names)
        disk = self._disk_of(incident.fault)
        expected = {epoch}
        if steps and disk != "kept":
            expected = {epoch + 1} if disk == "lost" else {epoch, epoch + 1}
        if incident.epoch not in expected:
            what = f"incarnation {incident.epoch} after {epoch}, its disk is {disk}"
            self._complain("epoch", incident.who, what)
        ahead = 1 if incident.epoch == epoch else 0  # its last step may have been heard by nobody
        if not steps <= incident.step <= steps + ahead:
            what = f"goes on from step {incident.step}, its last was {steps}"
            self._complain("epoch", incident.who, what)
        self._lose_flights(place, incident.now_ns)
        if incident.epoch > epoch:
            self._be_reborn(incident, place)

    def _disk_of(self, fault: int) -> str:
        """What is left of the disk by a fault; nobody knows what a process finds that came of itself."""
        if fault < 0:
            return "unknown"
        faults = self._scenario.faults
        known = faults[fault] if fault < len(faults) else None
        return known.disk if isinstance(known, Kill) else "kept"

    def _lose_flights(self, place: int, now_ns: int) -> None:
        """What has arrived where nobody lived is lost, but for what came with a turn that is open."""
        book = self._state.book[place]
        if not self._stopped[self._names[place]]:
            return
        flights = self._state.flights[place]
        under_way = flights[: book[_FLYING]]
        due_ns = under_way[:, 2]
        kept = under_way[
            (due_ns < book[_STOPPED_NS]) | (due_ns >= now_ns) | (book[_OPEN] & under_way[:, 3] > 0)
        ]
        flights[: kept.shape[0]] = kept
        book[_FLYING] = kept.shape[0]

    def _be_reborn(self, incident: Incident, place: int) -> None:
        """All that it knew is gone: its vector is full, its logs are empty, its own is a new one."""
        if self._law.ledger and self._state.book[place, _TOLD]:
            self._check_view(incident.who, place)
        participants = len(self._names)
        slot = incident.epoch * participants + place
        while slot >= self._state.shipped.shape[0]:
            self._add_slots(participants)
        state = self._state
        state.views[place], state.published[place] = self._units.sample, 0
        state.have[place] = 0
        book = state.book[place]
        book[_SLOT] = slot
        book[[_SEQUENCE, _DIFFERING, _TOLD, _REFUSALS_SO_FAR]] = 0

    def _add_slots(self, more: int) -> None:
        """Room for another incarnation of everybody."""
        state = self._state
        self._state = state._replace(
            shipped=np.pad(state.shipped, ((0, more), (0, 0))),
            logs=np.pad(state.logs, ((0, more), (0, 0), (0, 0))),
            have=np.pad(state.have, ((0, 0), (0, more))),
        )
        self._registers = np.pad(self._registers, ((0, more), (0, 0)))
        self._arguments = (*self._state, *self._law, *self._links)

    def _lengthen(self, name: str) -> None:
        """Double one of the arrays that grow with the run."""
        rows = getattr(self._state, name)
        longer = np.concatenate((rows, np.zeros_like(rows)), axis=1)
        self._state = self._state._replace(**{name: longer})
        self._arguments = (*self._state, *self._law, *self._links)

    def _put_into_words(self, batch: Batch, faults: int) -> None:
        noted = min(faults, _COMPLAINTS_MAX)
        rows, lengths_m = self._state.faults[:noted], self._state.lengths_m[:noted]
        for (fault, row, item, a, b), (x, y) in zip(rows.tolist(), lengths_m.tolist(), strict=True):
            rule, text = _WORDS[fault]
            who, what = self._concerned(batch, fault, row, item, a, b)
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
            if act.outputs is not None and act.ruling is not None and act.name in self._places:
                self._check_register(act, act.outputs)

    def _check_register(self, act: Act, outputs: Outputs) -> None:
        """It chooses where it was observed last."""
        name = act.name
        slot = self._state.book.item(self._places[name], _SLOT)
        if outputs.spent:
            pose, modes = act.observation.pose, self._scenario.planner.modes
            self._registers[slot] += visit_at(pose.x_m, pose.y_m, self._rectangle, modes)
        points, sums = self._state.shipped.item(slot, _WRITES), self._registers[slot].tobytes()
        for envelope in outputs.outbox:
            sent = self._sent_register(envelope, slot)
            if sent is None:
                self._complain("register", name, "sends what nobody can read")
            elif sent[0] and sent[1].tobytes() != sums:
                self._complain("register", name, "its sums are not those over its places")
            elif sent[0] and sent[0] != points:
                self._complain("register", name, f"writes {sent[0]} of {points}")

    def _sent_register(
        self, envelope: Envelope, slot: int
    ) -> tuple[int, npt.NDArray[np.int64]] | None:
        """Stamp and numbers of a register in a message; stamp 0 if absent, None if malformed."""
        try:
            news = decode_news(envelope.body)
        except RefusedError:
            return None
        slots = slots_told(news.have, len(self._names), claims=self._law.claims)
        if slots is None:
            return None
        return read_register(news.registers, slots, self._scenario.register_width, slot)

    def _end(self, ending: Ending) -> None:
        if self._law.ledger:
            for name, place in self._places.items():
                if self._state.book[place, _TOLD]:
                    self._check_view(name, place)
        for deed in self._deeds.values():
            if deed.at_ns < ending.now_ns and self._virtual and not deed.mid_step:
                what = (
                    f"no {deed.what}, and fault {deed.fault} says so at {deed.at_ns * 1e-9:.3f} s"
                )
                self._complain("incident", deed.who, what)

    def _check_view(self, name: ParticipantId, place: int) -> None:
        state = self._state
        spent = np.zeros(self._samples, dtype=np.int64)
        for slot, length in enumerate(state.have[place].tolist()):
            entries = state.shipped.item(slot, _ENTRIES)
            if length > entries:
                origin = self._origin(slot)
                self._complain("ledger", name, f"holds {length} entries of {origin}'s {entries}")
                return
            log = state.logs[slot, :length]
            np.add.at(spent, log[:, 0], log[:, 1])
        wrong = np.flatnonzero(state.views[place] != np.maximum(self._units.sample - spent, 0))
        if wrong.size:
            self._complain(
                "ledger", name, f"its view of sample {wrong[0]} is not what its logs leave"
            )

    def _origin(self, slot: int) -> str:
        """A participant, and which incarnation if it is not the first."""
        epoch, place = divmod(slot, len(self._names))
        return f"{self._names[place]}:{epoch}" if epoch else self._names[place]

    def _concerned(
        self, batch: Batch, fault: int, row: int, item: int, a: int, b: int
    ) -> tuple[str, str]:
        """Whom a fault is about; and which envelope, which origin, or what the codec says of it."""
        if fault in _OF_VERDICTS:
            verdict = batch.verdicts[row]
            return verdict.target, f"{verdict.source}#{verdict.sequence}"
        act = batch.acts[row]
        if fault in (_UNHEARD, _OUT_OF_TURN):
            source, sequence = act.heard[item]
            return act.name, f"{source}#{sequence}"
        if fault == _WITHHELD:
            return act.name, f"{self._names[a] if a >= 0 else 'a stranger'}#{b}"
        if fault in (_FOREIGN_LOG, _FORGETS, _NOBODYS):
            return act.name, self._origin(item)
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


def _within(fault: Fault, now_ns: int) -> bool:
    return fault.from_ns <= now_ns and (fault.until_ns is None or now_ns < fault.until_ns)


def check(records: Iterable[Record], *, virtual: bool = True) -> Checker:
    """Check a whole record. virtual: see Checker."""
    checker = Checker(virtual=virtual)
    for record in records:
        checker.take(record)
    return checker
