"""The record of a run: one opening, a batch for each moment at which somebody acted, one ending.

Everything that judges or measures a run (checkers, metrics, reports, replay) reads these records and
nothing else. They hold no trace of the exchange that ran the robots, so that the same scenario and
seed give the same bytes in process and over the bus.
"""

import msgspec

from kantor_protocol.base.grid import Frame
from kantor_protocol.base.machine import Envelope, Inputs, Observation, Outputs, ParticipantId
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import Array, RefusedError
from kantor_protocol.wire.weights import Units
from kantor_worldsim.radio.channel import DeliveryDecision
from kantor_worldsim.radio.link_faults import FaultStats
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.world import Found, StepVerdict, WorldSetup, units_of

VERSION = 1


class Opening(msgspec.Struct, frozen=True, array_like=True, tag="opening"):
    """What the run starts from."""

    version: int
    scenario: Scenario
    seed: int
    samples_m: Array
    targets_m: Array
    starts_m: Array
    first_look: dict[ParticipantId, tuple[Found, ...]]
    """Targets seen at time 0."""
    ground: Array | None = None
    """(rows, columns) uint8: the true map, if the robots explore one; see `grid.py`."""
    frame: Frame | None = None
    """How its cells lie."""

    @property
    def site(self) -> WorldSetup:
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
        """The mass of the run."""
        return units_of(self.scenario, self.samples_m.shape[0])


class StepRecord(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One participant's step: what it was given, what it did, what the world made of it."""

    name: ParticipantId
    now_ns: int
    observation: Observation
    heard: tuple[tuple[ParticipantId, int], ...]
    """The inbox by reference: source and sequence of each envelope, in order; empty without outputs."""
    outputs: Outputs | None
    """None: late, crashed or cut off. Turn by turn it is asked again until it answers, with the same
    inputs; now_ns stays when they were first given."""
    verdict: StepVerdict | None
    skew_ns: int = 0
    """How far the clock that it read was ahead of now_ns."""


class Batch(msgspec.Struct, frozen=True, array_like=True, tag="batch"):
    """Everybody who acted at one moment, and what became of what they sent."""

    now_ns: int
    step_records: tuple[StepRecord, ...]
    decisions: tuple[DeliveryDecision, ...]
    out_of_range: int
    """Receivers that an envelope did not reach for range."""
    absent: tuple[ParticipantId, ...] = ()
    """Participants that were asked and gave no outputs."""
    fault_stats: tuple[FaultStats, ...] = ()
    """What the scenario's faults had to do with the verdicts."""
    injected: tuple[Envelope, ...] = ()
    """What a fault put on the air and nobody sent; verdicts may be about it."""


class ProcessEvent(msgspec.Struct, frozen=True, array_like=True, tag="incident", gc=False):
    """Something that befell a process."""

    now_ns: int
    who: ParticipantId
    """A participant, or world-sim."""
    what: str
    """See `outages.Deed`; `leave` and `join` are nobody's deeds."""
    fault: int = -1
    """Its place in the scenario's list; -1: nobody ordered it."""
    step: int = 0
    """start, join: the step that it goes on from."""
    incarnation: int = 0
    """start, join: its incarnation."""


class Ending(msgspec.Struct, frozen=True, array_like=True, tag="ending"):
    """Why and when the run ended."""

    now_ns: int
    reason: str
    """`done`, `limit`, `interrupted` or `deserted` (nobody left)."""


Record = Opening | Batch | ProcessEvent | Ending

_ENCODER = msgspec.msgpack.Encoder()
_DECODER = msgspec.msgpack.Decoder(Record)

encode_record = _ENCODER.encode


def decode_record(payload: bytes) -> Record:
    """A record from its bytes. Raises msgspec.MsgspecError."""
    record: Record = _DECODER.decode(payload)
    return record


def opening_of(
    scenario: Scenario,
    seed: int,
    site: WorldSetup,
    first_look: dict[ParticipantId, tuple[Found, ...]],
) -> Opening:
    """The first record of a run."""
    ground = site.ground
    return Opening(
        VERSION,
        scenario,
        seed,
        Array.of(site.samples_m),
        Array.of(site.targets_m),
        Array.of(site.starts_m),
        first_look,
        ground and Array.of(ground.cells),
        ground and ground.frame,
    )


class EnvelopeIndex:
    """Envelopes of a run by (source, sequence), to turn references back into inboxes."""

    def __init__(self) -> None:
        self._envelopes: dict[tuple[ParticipantId, int], Envelope] = {}

    def inputs(self, step_record: StepRecord) -> Inputs:
        """What the participant was given. Raises KeyError for an envelope that was never sent."""
        inbox = tuple(self._envelopes[reference] for reference in step_record.heard)
        return Inputs(step_record.now_ns + step_record.skew_ns, step_record.observation, inbox)

    def post(self, batch: Batch) -> None:
        """Note what was sent in a batch, and what nobody sent."""
        for envelope in batch.injected:
            self._envelopes[envelope.source, envelope.sequence] = envelope
        for step_record in batch.step_records:
            for envelope in step_record.outputs.outbox if step_record.outputs else ():
                self._envelopes[envelope.source, envelope.sequence] = envelope
