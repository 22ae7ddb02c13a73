"""The state of the checkers, and how a violation is noted and put into words."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch

VIOLATIONS_MAX = 100
"""A broken record is broken; further complaints only count."""


# Faults that kernels find.
UNHEARD, NEVER_SENT, FOR_ANOTHER, TOO_FAR = 0, 1, 2, 3


STEP, SPEED, GARBLED_SPENT, POINT, BUDGET, MISCOUNT = 4, 5, 6, 7, 8, 9


GARBLED_LOWERED, RISE, BELOW, UNREADABLE, LOG = 10, 11, 12, 13, 14


STRANGER, REFUSED, NOT_REBUILT, NOT_ITS_OWN, NO_SAMPLE, NO_WEIGHT = 15, 16, 17, 18, 19, 20


WITHHELD, OUT_OF_TURN, AGAIN, STOPPED, STALE, REFUSALS = 21, 22, 23, 24, 25, 26


EPOCH, FOREIGN_LOG, FORGETS, NOBODYS, SKEW, CUT = 27, 28, 29, 30, 31, 32


OF_DECISIONS = (NEVER_SENT, FOR_ANOTHER, TOO_FAR, CUT)


_NO_LOGS, _NO_POSTED, _NO_FLIGHTS, _NO_FORGED = -1, -2, -3, -4


GROWING = {
    _NO_LOGS: "logs",
    _NO_POSTED: "posted",
    _NO_FLIGHTS: "flights",
    _NO_FORGED: "forged",
}


WORDS = {
    UNHEARD: ("delivery", "heard {what}, which was not delivered"),
    NEVER_SENT: ("delivery", "{what} was never sent"),
    FOR_ANOTHER: ("delivery", "delivered what was for somebody else"),
    TOO_FAR: ("range", "{what} over {x:.6g} m, allowed {y:.6g} m"),
    CUT: ("cut", "{what} over a link that is cut"),
    STEP: ("order", "step {a}, expected {b}"),
    SPEED: ("speed", "moved {x:.6g} m, allowed {y:.6g} m"),
    GARBLED_SPENT: ("energy", "spending that does not decode"),
    POINT: ("energy", "{a} units in one point"),
    BUDGET: ("energy", "{a} points shipped"),
    MISCOUNT: ("energy", "counts {a} of {b} points"),
    GARBLED_LOWERED: ("weights", "entries that do not decode"),
    RISE: ("weights", "sample {item} from {a} to {b} units"),
    BELOW: ("credit", "its view of sample {item} is below the truth"),
    UNREADABLE: ("ledger", "sends what nobody can read{what}"),
    LOG: ("ledger", "its log from {a} on is not what it consumed"),
    STRANGER: ("order", "not in the roster"),
    REFUSED: ("ruling", "the world refused its {what}"),
    NOT_REBUILT: ("weights", "publishes a vector that cannot be rebuilt"),
    NOT_ITS_OWN: ("weights", "publishes a vector that is not its own"),
    NO_SAMPLE: ("goal", "{what} is no sample"),
    NO_WEIGHT: ("goal", "{what} has no weight left in its view"),
    WITHHELD: ("delivery", "did not hear {what}, which had arrived"),
    OUT_OF_TURN: ("delivery", "heard {what} after what arrived later"),
    AGAIN: ("delivery", "sends under number {a}, which it has used"),
    STOPPED: ("dead", "acts, and is stopped since {x:.3f} s"),
    STALE: ("hold", "makes step {a} and has seen what became of step {b}"),
    REFUSALS: ("refusal", "refused {a} messages; {b} were forged"),
    EPOCH: ("epoch", "speaks as incarnation {a} and is {b}"),
    FOREIGN_LOG: ("ledger", "forwards an entry at {a} of {what}'s log that it never made"),
    FORGETS: ("ledger", "holds {a} entries of {what}'s log of which it held {b}"),
    NOBODYS: ("ledger", "holds entries of {what}, who was never there"),
    SKEW: ("clock", "its clock is {a} ns ahead, which no fault says"),
}
"""Rule and text of each fault."""


# Columns of State.book.
STEPS, SLOT, MOVED_NS, POINTS, OPEN, POSTED, FLYING, TOLD = 0, 1, 2, 3, 4, 5, 6, 7


SEQUENCE, DIFFERING, _COMING, KEYFRAME, STOPPED_NS = 8, 9, 10, 13, 14


REFUSALS_SO_FAR, NUMBER, SKEW_BEFORE_NS = 15, 16, 17


BOOK_COLUMNS = 18


# Columns of State.shipped.
ENTRIES, WRITES = 0, 1


# Slots of State.found.
FAULTS, KEYFRAMES, FORGED = 0, 1, 2


FORGED_FIRST = 1 << 62
"""What is forged has numbers from there on."""


NOT = -1
"""In the book: not stopped."""


STOPS = {"kill": "start", "pause": "resume", "fill": "free", "leave": "join"}
"""What stops a process, and what has it go on."""


STARTS = ("start", "join")


class CheckerState(NamedTuple):
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
    version_vector: npt.NDArray[np.int64]
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


class Limits(NamedTuple):
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
def note_violation(
    state: CheckerState, fault: int, row: int, item: int, a: int, b: int, x_m: float, y_m: float
) -> None:
    """Note a violation as numbers; it is put into words with the record at hand."""
    at = state.found[FAULTS]
    state.found[FAULTS] += 1
    if at < state.faults.shape[0]:
        noted = state.faults[at]
        noted[0], noted[1], noted[2], noted[3], noted[4] = fault, row, item, a, b
        state.lengths_m[at, 0], state.lengths_m[at, 1] = x_m, y_m


@kernel
def missing_capacity(state: CheckerState, columns: ColumnarBatch) -> int:
    """Which array has no room for this batch behind what is held of somebody, or 0."""
    book = state.book
    book[:, _COMING : KEYFRAME + 1] = 0
    for row in range(columns.sizes[of.ACTS]):
        step_record = columns.step_records[row]
        if step_record[of.PLACE] >= 0 and step_record[of.PRESENT]:
            book[step_record[of.PLACE], _COMING] += max(0, step_record[of.SPENT_COUNT])
    for row in range(columns.sizes[of.ALL_SENT]):
        if columns.sent[row, of.SOURCE] >= 0:
            book[columns.sent[row, of.SOURCE], _COMING + 1] += 1
    for row in range(columns.sizes[of.VERDICTS]):
        if columns.decisions[row, of.TARGET] >= 0:
            book[columns.decisions[row, of.TARGET], _COMING + 2] += 1
    if state.found[FORGED] + columns.sizes[of.INJECTED] > state.forged.shape[1]:
        return _NO_FORGED
    for who in range(book.shape[0]):
        if state.shipped[book[who, SLOT], ENTRIES] + book[who, _COMING] > state.logs.shape[1]:
            return _NO_LOGS
        if book[who, POSTED] + book[who, _COMING + 1] > state.posted.shape[1]:
            return _NO_POSTED
        if book[who, FLYING] + book[who, _COMING + 2] > state.flights.shape[1]:
            return _NO_FLIGHTS
    return 0
