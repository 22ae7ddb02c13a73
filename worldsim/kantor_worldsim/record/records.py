"""The record of a run: one opening, a batch for each moment at which participants stepped, process events, one ending.

With `trust = "signed"` the identities follow the opening. They and all signatures are no part of what a mission is:
records are compared, and digested, without them (`without_signatures`).

Everything that judges or measures a run (checkers, metrics, reports, replay) reads these records and
nothing else. They hold no trace of the exchange, so that the same scenario and seed give the same bytes in process
and over the bus. Tags and the order of fields are a contract.
"""

import msgspec

from kantor_protocol.base.grid import Frame
from kantor_protocol.base.machine import Envelope, Inputs, Observation, Outputs, ParticipantId
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.scenario.validate import complaints
from kantor_protocol.wire.attestations import Identities, unsigned_envelope, unsigned_outputs
from kantor_protocol.wire.messages import Array, RefusedError
from kantor_protocol.wire.weights import Units
from kantor_worldsim.radio.channel import DeliveryDecision
from kantor_worldsim.radio.link_faults import FaultStats
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.world import Found, StepVerdict, WorldSetup, units_of

VERSION = 1


class Opening(msgspec.Struct, frozen=True, array_like=True, tag="opening"):
    """Initial state of a run."""

    version: int
    scenario: Scenario
    seed: int
    samples_m: Array
    targets_m: Array
    starts_m: Array
    first_look: dict[ParticipantId, tuple[Found, ...]]
    """Targets that each robot detects at time 0."""
    ground: Array | None = None
    """(rows, columns) uint8: the true map, if the robots explore one; see `grid.py`."""
    frame: Frame | None = None
    """Frame of the map: position of its cells in the world."""

    def check(self) -> None:
        """Check that a run can start from this, and that its scenario orders no more than what it holds.

        Raises RefusedError, ScenarioError.
        """
        scenario, counted = self.scenario, _counts_in(self.scenario)
        arrays = {"starts": self.starts_m, "samples": self.samples_m, "targets": self.targets_m}
        for name, count in counted.items():
            if arrays[name].shape[:1] != (count,):
                raise RefusedError(f"{arrays[name].shape} {name}, and {count} in the scenario")
        if scenario.mapping != (self.ground is not None):
            raise RefusedError("a map in the scenario or in the opening, and not in both")
        if (problem := next(iter(complaints(scenario)), None)) is not None:
            raise ScenarioError(problem)
        targets = self.setup.targets_m.shape[0]
        for name, found in self.first_look.items():
            if name not in scenario.robot_ids:
                raise RefusedError(f"{name} looks around and is not in the team")
            if any(not 0 <= target < targets for target, _, _ in found):
                raise RefusedError(f"{name} sees a target that there is not")

    @property
    def setup(self) -> WorldSetup:
        """The arrays of the opening. Raises RefusedError."""
        return WorldSetup(
            self.samples_m.open("<f8", 2),
            self.targets_m.open("<f8", 2),
            self.starts_m.open("<f8", 2),
            self._ground,
        )

    @property
    def _ground(self) -> Ground | None:
        if self.ground is None or self.frame is None:
            return None
        if self.ground.shape != (self.frame.rows, self.frame.columns):
            raise RefusedError(f"map of shape {self.ground.shape} in a frame of another")
        # A copy: kernels are compiled for arrays that may be written.
        return Ground(self.frame, self.ground.open("u1", 2).copy())

    @property
    def units(self) -> Units:
        """Units of mass of the run."""
        return units_of(self.scenario, self.samples_m.shape[0])


def _counts_in(scenario: Scenario) -> dict[str, int]:
    """Numbers of points that a scenario itself decides, and no file."""
    counts = {"starts": scenario.robots.count}
    if scenario.samples.file is None and scenario.samples.count is not None:
        counts["samples"] = scenario.samples.count
    if scenario.targets.file is None:
        counts["targets"] = scenario.targets.count
    return counts


class StepRecord(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One participant's step: its inputs, its outputs, and the world's verdict."""

    name: ParticipantId
    now_ns: int
    observation: Observation
    heard: tuple[tuple[ParticipantId, int], ...]
    """The inbox by reference: source and sequence of each envelope, in order; empty without outputs."""
    outputs: Outputs | None
    """None: late, crashed or disconnected. In virtual time the participant is requested again, with the same inputs,
    until it answers; now_ns stays the time of the first request."""
    verdict: StepVerdict | None
    skew_ns: int = 0
    """Skew of the clock that it read, positive if it was ahead of now_ns."""


class Batch(msgspec.Struct, frozen=True, array_like=True, tag="batch"):
    """All steps of one moment, and the delivery decisions on what they sent."""

    now_ns: int
    step_records: tuple[StepRecord, ...]
    decisions: tuple[DeliveryDecision, ...]
    out_of_range: int
    """Number of receivers that envelopes did not reach because of range."""
    absent: tuple[ParticipantId, ...] = ()
    """Participants that were requested to step and returned no outputs."""
    fault_stats: tuple[FaultStats, ...] = ()
    """Effects of the scenario's link faults on the decisions."""
    injected: tuple[Envelope, ...] = ()
    """Envelopes that a fault put on the air and no participant sent; decisions may be about them."""


class ProcessEvent(msgspec.Struct, frozen=True, array_like=True, tag="incident", gc=False):
    """An event of a process; see `ProcessEventKind`."""

    now_ns: int
    who: ParticipantId
    """A participant, or world-sim."""
    kind: ProcessEventKind
    fault: int = -1
    """Index of its fault in the scenario's list; -1: no fault is the cause."""
    step: int = 0
    """Kinds that take over: the last step that is done."""
    incarnation: int = 0
    """Kinds that take over: the incarnation that goes on."""


class Ending(msgspec.Struct, frozen=True, array_like=True, tag="ending"):
    """Time and reason of the end."""

    now_ns: int
    reason: str
    """`done`, `limit`, `interrupted` or `deserted` (no robot left)."""


Record = Opening | Identities | Batch | ProcessEvent | Ending

_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(Record)

encode_record = _ENCODER.encode


def decode_record(payload: bytes) -> Record:
    """A record from its bytes. Raises msgspec.MsgspecError."""
    record: Record = _DECODER.decode(payload)
    return record


def without_signatures(record: Record) -> Record:
    """The record with all signatures zeroed; itself if it has none."""
    if not isinstance(record, Batch):
        return record
    steps = tuple([_without_signatures(step_record) for step_record in record.step_records])
    injected = tuple([unsigned_envelope(envelope) for envelope in record.injected])
    before = (*record.step_records, *record.injected)
    if all(new is old for new, old in zip((*steps, *injected), before, strict=True)):
        return record
    return msgspec.structs.replace(record, step_records=steps, injected=injected)


def _without_signatures(step_record: StepRecord) -> StepRecord:
    outputs = step_record.outputs
    if outputs is None:
        return step_record
    unsigned = unsigned_outputs(outputs)
    if unsigned is outputs:
        return step_record
    return msgspec.structs.replace(step_record, outputs=unsigned)


def opening_of(
    scenario: Scenario,
    seed: int,
    setup: WorldSetup,
    first_look: dict[ParticipantId, tuple[Found, ...]],
) -> Opening:
    """The opening record of a run."""
    ground = setup.ground
    return Opening(
        VERSION,
        scenario,
        seed,
        Array.of(setup.samples_m),
        Array.of(setup.targets_m),
        Array.of(setup.starts_m),
        first_look,
        ground and Array.of(ground.cells),
        ground and ground.frame,
    )


class EnvelopeIndex:
    """Envelopes of a run by (source, sequence), which turns references back into inboxes."""

    def __init__(self) -> None:
        self._envelopes: dict[tuple[ParticipantId, int], Envelope] = {}

    def inputs(self, step_record: StepRecord) -> Inputs:
        """Inputs of a step. Raises KeyError for an envelope that was never sent."""
        inbox = tuple(self._envelopes[reference] for reference in step_record.heard)
        return Inputs(step_record.now_ns + step_record.skew_ns, step_record.observation, inbox)

    def add(self, batch: Batch) -> None:
        """Add the envelopes of a batch, those that a fault injected included."""
        for envelope in batch.injected:
            self._envelopes[envelope.source, envelope.sequence] = envelope
        for step_record in batch.step_records:
            for envelope in step_record.outputs.outbox if step_record.outputs else ():
                self._envelopes[envelope.source, envelope.sequence] = envelope
