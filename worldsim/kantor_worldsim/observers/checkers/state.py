"""The state of the checkers: arrays that one compiled pass over a batch reads and changes."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.checkers.delivery_index import index_deliveries
from kantor_worldsim.observers.checkers.links import LinkTable
from kantor_worldsim.observers.checkers.violations import VIOLATIONS_MAX
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch
from kantor_worldsim.record.records import Opening

DROPPED = -1
"""Instead of the time at which a copy arrives: the radio has lost it."""

FORGED_FIRST = 1 << 62
"""Forged envelopes are numbered from there on."""

NOT_STOPPED = -1

# Columns of CheckerState.participants.
STEPS, INCARNATION_ID, MOVED_NS, POINTS, ASKED, POSTED, UNDER_WAY, VECTOR_SENT = range(8)
SEQUENCE, DIFFERING, _COMING, KEYFRAME, STOPPED_NS = 8, 9, 10, 13, 14
REFUSALS_SO_FAR, NUMBER, SKEW_BEFORE_NS, LIES = 15, 16, 17, 18
_PARTICIPANT_COLUMNS = 19

# Columns of CheckerState.shipped.
ENTRIES, WRITES = 0, 1

# Slots of CheckerState.counts.
NOTED, KEYFRAMES, FORGED = 0, 1, 2

_NO_LOGS, _NO_POSTED, _NO_DELIVERIES, _NO_FORGED = -1, -2, -3, -4

_GROWING = {
    _NO_LOGS: "logs",
    _NO_POSTED: "posted",
    _NO_DELIVERIES: "deliveries",
    _NO_FORGED: "forged",
}


class CheckerState(NamedTuple):
    """The run so far, for the kernels. n participants, N samples; ids: incarnation ids, see `incarnations.py`."""

    participants: npt.NDArray[np.int64]
    """(n, 19): last step; incarnation id; time of the last move; points shipped by all its incarnations;
    whether it was asked for a step and has not answered; rows used of posted and deliveries; whether this
    incarnation has sent a version vector; sequence of its last publication, entries in which that
    differs from its view; rows that this batch brings to logs, posted and deliveries; 1 + the step record
    with which it publishes a keyframe in this batch; since when it is stopped, or NOT_STOPPED; messages it
    has refused; the highest number of an envelope it has sent; how far its clock was ahead in its last step;
    whether the scenario has it lie."""
    poses_m: npt.NDArray[np.float64]
    """(n, 2) world frame."""
    views: npt.NDArray[np.int64]
    """(n, N) the weight vector of each, in units."""
    published: npt.NDArray[np.int64]
    """(n, N) the same, rebuilt from what each has published."""
    consumed: npt.NDArray[np.int64]
    """(N,) units shipped by all."""
    shipped: npt.NDArray[np.int64]
    """(ids, 2): entries of each log, points shipped."""
    logs: npt.NDArray[np.int64]
    """(ids, rows, 2): sample and units of each entry that an incarnation has consumed."""
    posted: npt.NDArray[np.int64]
    """(n, rows, 2): sequence and target of each envelope that a participant has sent, by rising sequence."""
    deliveries: npt.NDArray[np.int64]
    """(n, rows, 4): source, sequence, due_ns of each delivery under way to a participant; whether it was
    handed over with the step request that is open."""
    delivery_slots: npt.NDArray[np.int64]
    """(n, 2 rows): 1 + the row of each delivery under way, at the first free slot from the hash of its source and
    sequence on, or 0; see `delivery_index.py`."""
    forged: npt.NDArray[np.int64]
    """(1, rows, 3): source, sequence, target of the envelopes that faults have put on the air."""
    version_vector: npt.NDArray[np.int64]
    """(n, ids) the log lengths in the last message of each."""
    violations: npt.NDArray[np.int64]
    """(rows, 5): kind of the violation, step record or delivery decision, item of it, two numbers."""
    lengths_m: npt.NDArray[np.float64]
    """(rows, 2): two lengths for the text of the violation."""
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
        participants = np.zeros((count, _PARTICIPANT_COLUMNS), dtype=np.int64)
        participants[:, INCARNATION_ID] = np.arange(count)
        participants[:, STOPPED_NS] = NOT_STOPPED
        return cls(
            participants,
            poses_m,
            views=np.full((count, samples), opening.units.sample, dtype=np.int64),
            published=np.zeros((count, samples), dtype=np.int64),
            consumed=np.zeros(samples, dtype=np.int64),
            shipped=np.zeros((count, 2), dtype=np.int64),
            logs=np.zeros((count, 256, 2), dtype=np.int64),
            posted=np.zeros((count, 256, 2), dtype=np.int64),
            deliveries=np.zeros((count, 64, 4), dtype=np.int64),
            delivery_slots=np.zeros((count, 128), dtype=np.int64),
            forged=np.zeros((1, 64, 3), dtype=np.int64),
            version_vector=np.zeros((count, count), dtype=np.int64),
            violations=np.zeros((VIOLATIONS_MAX, 5), dtype=np.int64),
            lengths_m=np.zeros((VIOLATIONS_MAX, 2)),
            counts=np.zeros(3, dtype=np.int64),
            samples_m=setup.samples_m.copy(),
            by_x=np.argsort(setup.samples_m[:, 0]),
        )

    def with_incarnations(self, more: int) -> "CheckerState":
        """The same with room for so many more incarnation ids."""
        return self._replace(
            shipped=np.pad(self.shipped, ((0, more), (0, 0))),
            logs=np.pad(self.logs, ((0, more), (0, 0), (0, 0))),
            version_vector=np.pad(self.version_vector, ((0, 0), (0, more))),
        )

    def lengthened(self, missing: int) -> "CheckerState":
        """The same with twice the room where `missing_capacity` found too little."""
        name = _GROWING[missing]
        rows = getattr(self, name)
        longer = self._replace(**{name: np.concatenate((rows, np.zeros_like(rows)), axis=1)})
        if missing == _NO_DELIVERIES:
            slots = np.concatenate((self.delivery_slots, self.delivery_slots), axis=1)
            for who, under_way in enumerate(self.participants[:, UNDER_WAY].tolist()):
                index_deliveries(longer.deliveries[who], slots[who], under_way)
            longer = longer._replace(delivery_slots=slots)
        return longer


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


def arguments(state: CheckerState, limits: Limits, links: LinkTable) -> tuple[Any, ...]:
    """The arguments of the compiled pass behind a batch: a NamedTuple of arrays costs much at the border to Python."""
    return (*state, *limits, *links)


@kernel
def note_violation(
    state: CheckerState, kind: int, row: int, item: int, a: int, b: int, x_m: float, y_m: float
) -> None:
    """Note a violation as numbers; it is put into words with the record at hand."""
    at = state.counts[NOTED]
    state.counts[NOTED] += 1
    if at < state.violations.shape[0]:
        noted = state.violations[at]
        noted[0], noted[1], noted[2], noted[3], noted[4] = kind, row, item, a, b
        state.lengths_m[at, 0], state.lengths_m[at, 1] = x_m, y_m


@kernel
def missing_capacity(state: CheckerState, columns: ColumnarBatch) -> int:
    """Which array has no room for this batch behind the rows it holds, or 0."""
    participants = state.participants
    participants[:, _COMING : KEYFRAME + 1] = 0
    for row in range(columns.sizes[of.STEP_RECORDS]):
        step_record = columns.step_records[row]
        if step_record[of.PLACE] >= 0 and step_record[of.PRESENT]:
            participants[step_record[of.PLACE], _COMING] += max(0, step_record[of.SPENT_COUNT])
    for row in range(columns.sizes[of.ALL_SENT]):
        if columns.sent[row, of.SOURCE] >= 0:
            participants[columns.sent[row, of.SOURCE], _COMING + 1] += 1
    for row in range(columns.sizes[of.DECISIONS]):
        if columns.decisions[row, of.TARGET] >= 0:
            participants[columns.decisions[row, of.TARGET], _COMING + 2] += 1
    if state.counts[FORGED] + columns.sizes[of.INJECTED] > state.forged.shape[1]:
        return _NO_FORGED
    for who in range(participants.shape[0]):
        participant = participants[who]
        entries = state.shipped[participant[INCARNATION_ID], ENTRIES]
        if entries + participant[_COMING] > state.logs.shape[1]:
            return _NO_LOGS
        if participant[POSTED] + participant[_COMING + 1] > state.posted.shape[1]:
            return _NO_POSTED
        if participant[UNDER_WAY] + participant[_COMING + 2] > state.deliveries.shape[1]:
            return _NO_DELIVERIES
    return 0
