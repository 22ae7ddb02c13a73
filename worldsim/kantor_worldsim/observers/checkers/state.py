"""The state of the checkers: arrays that one compiled pass over a batch reads and changes."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import integers, kernel
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.checkers.delivery_index import index_deliveries
from kantor_worldsim.observers.checkers.violations import VIOLATIONS_MAX
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch
from kantor_worldsim.record.records import Opening

DROPPED = -1
"""Instead of the time at which a copy arrives: the radio has lost it."""

FORGED_FIRST = 1 << 62
"""Forged envelopes are numbered from there on."""

NOT_STOPPED = -1

PARTICIPANT = integers(
    "steps", "incarnation_id", "moved_ns", "points", "asked", "posted", "under_way", "vector_sent",
    "sequence", "differing", "entries_coming", "posted_coming", "deliveries_coming", "keyframe",
    "stopped_ns", "refusals_so_far", "number", "skew_before_ns", "lies",
)  # fmt: skip
"""A row of CheckerState.participants: last step; incarnation id; time of the last move; points shipped by all its
incarnations; whether it was asked for a step and has not answered; rows used of posted and deliveries; whether this
incarnation has sent a version vector; sequence of its last publication, entries in which that differs from its view;
rows that this batch brings to logs, posted and deliveries; 1 + the step record with which it publishes a keyframe in
this batch; since when it is stopped, or NOT_STOPPED; messages it has refused; the highest number of an envelope it has
sent; how far its clock was ahead in its last step; whether the scenario has it lie."""

LOG = integers("entries", "writes")
"""Entries of a log, points shipped."""
ENTRY = integers("sample", "units")
RUN = integers("first", "last", "target")
"""Envelopes of one participant with consecutive numbers and the same target."""
DELIVERY = integers("source", "sequence", "due_ns", "handed_over")
"""A delivery under way; whether it was handed over with the step request that is open."""
FORGED = integers("source", "sequence", "target")
VIOLATION = np.dtype(
    [(name, np.int64) for name in ("kind", "row", "item", "a", "b")]
    + [(name, np.float64) for name in ("x_m", "y_m")]
)
"""Kind of a violation, step record or delivery decision, item of it, two numbers, and two lengths for its text."""

# Slots of CheckerState.counts.
NOTED, KEYFRAMES, ALL_FORGED = 0, 1, 2

_RUNS_MAX = 3
"""Rows of posted that an envelope may need: one that is sent under a number in the middle of a run divides it."""

_NO_LOGS, _NO_POSTED, _NO_DELIVERIES, _NO_FORGED = -1, -2, -3, -4

_GROWING = {
    _NO_LOGS: "logs",
    _NO_POSTED: "posted",
    _NO_DELIVERIES: "deliveries",
    _NO_FORGED: "forged",
}


class CheckerState(NamedTuple):
    """The run so far, for the kernels. n participants, N samples; ids: incarnation ids, see `incarnations.py`."""

    participants: npt.NDArray[Any]
    """(n,) of PARTICIPANT."""
    poses_m: npt.NDArray[np.float64]
    """(n, 2) world frame."""
    views: npt.NDArray[np.int32]
    """(n, N) the weight vector of each, in units: no more than there are points of energy."""
    published: npt.NDArray[np.int32]
    """(n, N) the same, rebuilt from what each has published."""
    consumed: npt.NDArray[np.int64]
    """(N,) units shipped by all."""
    shipped: npt.NDArray[Any]
    """(ids,) of LOG."""
    logs: npt.NDArray[Any]
    """(ids, rows) of ENTRY: what an incarnation has consumed."""
    posted: npt.NDArray[Any]
    """(n, rows) of RUN: the envelopes that a participant has sent, by rising number. Who sends to everybody, or to
    the supervisor alone, needs one row for that as long as it does."""
    deliveries: npt.NDArray[Any]
    """(n, rows) of DELIVERY: what is under way to a participant."""
    delivery_slots: npt.NDArray[np.int64]
    """(n, 2 rows): 1 + the row of each delivery under way, at the first free slot from the hash of its source and
    sequence on, or 0; see `delivery_index.py`."""
    forged: npt.NDArray[Any]
    """(1, rows) of FORGED: the envelopes that faults have put on the air."""
    version_vector: npt.NDArray[np.int64]
    """(n, ids) the log lengths in the last message of each."""
    violations: npt.NDArray[Any]
    """(rows,) of VIOLATION."""
    counts: npt.NDArray[np.int64]
    """(3,): violations and keyframes in this batch; rows used of forged."""
    samples_m: npt.NDArray[np.float64]
    """(N, 2) at the start."""
    by_x: npt.NDArray[np.int64]
    """(N,) samples in the order of their x."""

    @classmethod
    def of(cls, opening: Opening) -> "CheckerState":
        """The state at the start of a run. Raises RefusedError."""
        scenario, setup = opening.scenario, opening.setup
        count, samples = len(scenario.roster), setup.samples_m.shape[0]
        poses_m = np.zeros((count, 2))
        poses_m[-1] = scenario.supervisor_m
        poses_m[: scenario.robots.count] = setup.starts_m
        participants = np.zeros(count, dtype=PARTICIPANT)
        participants["incarnation_id"] = np.arange(count)
        participants["stopped_ns"] = NOT_STOPPED
        return cls(
            participants,
            poses_m,
            views=np.full((count, samples), opening.units.sample, dtype=np.int32),
            published=np.zeros((count, samples), dtype=np.int32),
            consumed=np.zeros(samples, dtype=np.int64),
            shipped=np.zeros(count, dtype=LOG),
            logs=np.zeros((count, 64), dtype=ENTRY),
            posted=np.zeros((count, 64), dtype=RUN),
            deliveries=np.zeros((count, 64), dtype=DELIVERY),
            delivery_slots=np.zeros((count, 128), dtype=np.int64),
            forged=np.zeros((1, 64), dtype=FORGED),
            version_vector=np.zeros((count, count), dtype=np.int64),
            violations=np.zeros(VIOLATIONS_MAX, dtype=VIOLATION),
            counts=np.zeros(3, dtype=np.int64),
            samples_m=setup.samples_m.copy(),
            by_x=np.argsort(setup.samples_m[:, 0]),
        )

    def with_incarnations(self, more: int) -> "CheckerState":
        """The same with room for so many more incarnation ids."""
        return self._replace(
            shipped=_longer(self.shipped, more, axis=0),
            logs=_longer(self.logs, more, axis=0),
            version_vector=_longer(self.version_vector, more, axis=1),
        )

    def lengthened(self, missing: int) -> "CheckerState":
        """The same with twice the room where `missing_capacity` found too little."""
        name = _GROWING[missing]
        rows = getattr(self, name)
        longer = self._replace(**{name: _longer(rows, rows.shape[1], axis=1)})
        if missing == _NO_DELIVERIES:
            slots = np.concatenate((self.delivery_slots, self.delivery_slots), axis=1)
            for who, under_way in enumerate(self.participants["under_way"].tolist()):
                index_deliveries(longer.deliveries[who], slots[who], under_way)
            longer = longer._replace(delivery_slots=slots)
        return longer


def _longer(table: npt.NDArray[Any], more: int, axis: int) -> npt.NDArray[Any]:
    """A table with so many more rows of zeros."""
    shape = list(table.shape)
    shape[axis] = more
    return np.concatenate((table, np.zeros(shape, dtype=table.dtype)), axis=axis)


class Limits(NamedTuple):
    """Limits of the scenario, for the kernels."""

    sample_units: int
    point_units: int
    budget: int
    ledger: bool
    supervisor: int
    """Its place in the roster, or one beyond the roster if there is none."""
    speed_m_s: float
    transport: bool
    """Every goal is a sample that has weight."""
    claims: bool
    """Version vectors have a second half, of claims."""
    virtual: bool
    """A participant that steps has heard all that had arrived."""
    clocks: bool
    """There are clock faults."""
    signal_slack_ns: int
    """In real time: how much later than the event that stops a process its last step may be, since signals
    take a while."""
    false_logs: bool
    """Some logs are not what was consumed, and views may be below what all spending leaves; see `lies.py`."""

    @classmethod
    def of(
        cls, opening: Opening, *, virtual: bool, clocks: bool, false_logs: bool = False
    ) -> "Limits":
        """Those of a run."""
        scenario, units = opening.scenario, opening.units
        return cls(
            sample_units=units.sample,
            point_units=units.point,
            budget=scenario.steps_per_robot,
            ledger=has_ledger(scenario),
            supervisor=scenario.robots.count,
            speed_m_s=scenario.vehicle.speed_m_s,
            transport=scenario.planner.name == "transport" and scenario.samples.diffusion_m == 0.0,
            claims=scenario.claiming,
            virtual=virtual,
            clocks=clocks,
            signal_slack_ns=scenario.period_ns,
            false_logs=false_logs,
        )


def has_ledger(scenario: Scenario) -> bool:
    """Whether spending is replicated entry by entry."""
    return scenario.merge == "ledger" and not scenario.mapping


@kernel
def note_violation(
    state: CheckerState, kind: int, row: int, item: int, a: int, b: int, x_m: float, y_m: float
) -> None:
    """Note a violation as numbers; it is put into words with the record at hand."""
    at = state.counts[NOTED]
    state.counts[NOTED] += 1
    if at < state.violations.shape[0]:
        noted = state.violations[at]
        noted.kind, noted.row, noted.item, noted.a, noted.b = kind, row, item, a, b
        noted.x_m, noted.y_m = x_m, y_m


@kernel
def missing_capacity(state: CheckerState, columns: ColumnarBatch) -> int:
    """Which array has no room for this batch behind the rows it holds, or 0."""
    participants = state.participants
    for who in range(participants.shape[0]):
        participant = participants[who]
        participant.entries_coming = participant.posted_coming = 0
        participant.deliveries_coming = participant.keyframe = 0
    for row in range(columns.sizes[of.STEP_RECORDS]):
        step_record = columns.step_records[row]
        if step_record.place >= 0 and step_record.present:
            participants[step_record.place].entries_coming += max(0, step_record.spent_count)
    for row in range(columns.sizes[of.ALL_SENT]):
        if columns.sent[row].source >= 0:
            participants[columns.sent[row].source].posted_coming += _RUNS_MAX
    for row in range(columns.sizes[of.DECISIONS]):
        if columns.decisions[row].target >= 0:
            participants[columns.decisions[row].target].deliveries_coming += 1
    if state.counts[ALL_FORGED] + columns.sizes[of.INJECTED] > state.forged.shape[1]:
        return _NO_FORGED
    for who in range(participants.shape[0]):
        participant = participants[who]
        entries = state.shipped[participant.incarnation_id].entries
        if entries + participant.entries_coming > state.logs.shape[1]:
            return _NO_LOGS
        if participant.posted + participant.posted_coming > state.posted.shape[1]:
            return _NO_POSTED
        if participant.under_way + participant.deliveries_coming > state.deliveries.shape[1]:
            return _NO_DELIVERIES
    return 0


@kernel
def logs_leave(so_far: tuple[Any, ...], who: int, false: np.ndarray, left: np.ndarray) -> int:
    """Take from `left` (N,) what a participant holds of all logs by its version vector, those that are false apart.

    so_far: the fields of a CheckerState. false: (ids,). Returns the first incarnation id of whose log it holds more
    than there is, and less than 0 if there is none.
    """
    state = CheckerState(*so_far)
    for origin in range(state.shipped.shape[0]):
        length = state.version_vector[who, origin]
        if length > state.shipped[origin].entries:
            return origin
        for i in range(0 if false[origin] else length):
            entry = state.logs[origin, i]
            left[entry.sample] -= entry.units
    return -1
