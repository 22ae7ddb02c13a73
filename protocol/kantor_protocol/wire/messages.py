"""Every message on the bus and on the radio: frozen records in msgpack, versioned, add-only.

A record travels as a msgpack array: tag, version, fields in order. New fields go to the end with a
default; unknown further fields are ignored; a change of meaning takes a new version. A message
that does not decode, has another version or a number that is not finite is refused on arrival and changes nothing.
"""

import math
from functools import lru_cache
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta, Raw

from kantor_protocol.base.grid import Frame
from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import (
    Body,
    Envelope,
    Inputs,
    Observation,
    Outputs,
    ParticipantId,
    Pose,
)
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Attestation, Identities

VERSION = 1
BODY_BYTES_MAX = 262_144
"""The longest body of an envelope."""
MESSAGE_BYTES_MAX = 4 * 1024 * 1024
"""The longest message from a participant to world-sim."""
OUTBOX_MAX = 8
"""Envelopes in one report, at most; every participant of this version sends one a step."""
INBOX_MAX = 4096
"""Envelopes in one inbox, at most; so many wait for the next step of a participant that holds."""
NONCE_MAX = 64
"""Characters of a nonce, at most."""
INBOX_BYTES_MAX = 16 * 1024 * 1024
"""Content of the envelopes in an inbox, at most."""
INPUTS_BYTES_MAX = 2 * INBOX_BYTES_MAX
"""The longest encoded Inputs: an inbox, and whatever else is in them."""


class RefusedError(ValueError):
    """A message that must not be used; the text says why."""


class _Message(msgspec.Struct, frozen=True, array_like=True):
    version: int


class Array(msgspec.Struct, frozen=True, array_like=True):
    """A numpy array as dtype, shape and bytes. Object arrays are refused."""

    dtype: str
    shape: tuple[int, ...]
    content: bytes

    @classmethod
    def of(cls, array: npt.NDArray[Any]) -> "Array":
        """Pack an array of numbers."""
        ordered = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
        return cls(ordered.dtype.str, ordered.shape, ordered.tobytes())

    def open(self, dtype: str, dimensions: int) -> npt.NDArray[Any]:
        """The array, if it is of this dtype and number of dimensions; raises RefusedError."""
        kind = np.dtype(dtype)
        if self.dtype != kind.newbyteorder("<").str or len(self.shape) != dimensions:
            raise RefusedError(f"array {self.dtype}{self.shape}: expected {dtype}, {dimensions}-d")
        if min(self.shape, default=1) < 0 or math.prod(self.shape) * kind.itemsize != len(
            self.content
        ):
            raise RefusedError(f"array {self.dtype}{self.shape}: {len(self.content)} bytes")
        try:
            return np.frombuffer(self.content, dtype=kind).reshape(self.shape)
        except ValueError as error:  # an empty array of an impossible shape
            raise RefusedError(f"array {self.dtype}{self.shape}: {error}") from None


class GossipMessage(_Message, frozen=True, array_like=True, tag=1, gc=False):
    """Radio, participant to participant: version vector, and the log suffixes, claims and registers that others lack."""

    step: int
    """The sender's step."""
    x_m: float
    y_m: float
    """The place of the sender by its own account, world frame."""
    version_vector: bytes
    """For every incarnation id that the sender knows (`base/incarnations.py`), how many log entries it holds; then, with
    claims, the newest claim stamp that it holds. See `version_vector.py`. LEB128."""
    logs: bytes
    """Suffixes: incarnation id of the origin, start, span, count, then count packed pairs. LEB128."""
    claims: bytes
    """Claims: incarnation id of the origin, stamp, sample + 1 (0: none), since_ns. LEB128."""
    registers: bytes = b""
    """For every such id the stamp of the register that the sender holds; then registers: incarnation id of the origin,
    stamp, how many numbers, numbers. LEB128, the numbers zigzag-folded. Empty in a mission whose planner has none."""
    incarnation: int = 0
    """The sender's incarnation."""
    proofs: tuple[bytes, ...] = ()
    """For each attestation of another, in order: hashes by which it covers the suffix of its log that comes with it;
    see `replication/proofs.py`."""
    attestations: tuple[Attestation, ...] = ()
    """Of the state of origins, signed by them, with `trust = "signed"`; see `replication/attested.py`. The sender's own
    one comes last, and its signature ends the message."""


class Mission(_Message, frozen=True, array_like=True, tag=2):
    """World-sim to a participant that has joined: the mission, and the body that it takes over."""

    nonce: str
    """The nonce of the process that it is for."""
    scenario: Scenario
    seed: int
    starts: Array
    """(n, 2) float64, world frame, metres, in the order of the roster's robots."""
    samples: Array
    """(N, 2) float64 at time 0."""
    exchange: str
    """`lockstep`, or `wall` for the realtime exchange."""
    frame: Frame | None
    """The frame of the map, if there is one, without its contents."""
    run: str
    """The name of this run of the mission, so that the write-ahead log of another run is not used."""
    body: Body
    """The body that the participant takes over."""
    keys: dict[ParticipantId, bytes] = {}
    """With `trust = "signed"`: the public key of every participant, see `signatures.py`."""

    @property
    def identities(self) -> Identities | None:
        """Whose word counts; None with `trust = "open"`."""
        return Identities(self.run, self.keys) if self.scenario.signed else None


class Refusal(_Message, frozen=True, array_like=True, tag=3):
    """World-sim to a participant that may not join."""

    nonce: str
    reason: str


class StartClock(_Message, frozen=True, array_like=True, tag=4):
    """World-sim to a participant, realtime exchange: simulated time runs from here."""

    nonce: str
    now_ns: int
    speed: float
    """Simulated seconds in a real one."""
    observation: Observation | None = None
    """The observation of the participant's first step."""
    skew_ns: int = 0
    """The lead of the clock that its machine reads. Sent again, it sets that clock anew."""


class StepRequest(_Message, frozen=True, array_like=True, tag=5):
    """World-sim to a participant. Lockstep: make a step now. Realtime: what has arrived since the last request."""

    inputs: Inputs


class Report(_Message, frozen=True, array_like=True, tag=6):
    """Participant to world-sim: the outputs of a step."""

    nonce: str
    outputs: Outputs
    now_ns: int = 0
    """Realtime: the time on the participant's clock at which it stepped."""
    heard: tuple[tuple[ParticipantId, int], ...] = ()
    """Realtime: source and sequence of each envelope in the inbox of this step, in order."""
    observed: int = 0
    """Realtime: the step in the observation that it used."""
    skew_ns: int = 0
    """Realtime: the lead over now_ns of the clock that its machine read."""


class Ready(_Message, frozen=True, array_like=True, tag=7):
    """Participant to world-sim: mission received, prepared to step."""

    nonce: str
    incarnation: int = 0
    """The incarnation that answers."""
    step: int = 0
    """The last step that it has recovered from its write-ahead log."""
    now_ns: int = 0
    """Realtime: the time on its clock, if that runs already."""


class Stop(_Message, frozen=True, array_like=True, tag=8):
    """World-sim to a participant: the mission is over."""

    reason: str


class PoseMessage(_Message, frozen=True, array_like=True, tag=21):
    """On `<id>/pose`, for observers."""

    step: int
    now_ns: int
    pose: Pose


class Progress(_Message, frozen=True, array_like=True, tag=22):
    """On `world/progress`, for observers: how the mission goes."""

    now_ns: int
    phase: str
    """`waiting`, `running` or `over`."""
    detail: str
    """waiting: the participants that are missing; over: the reason."""
    energy_spent: int
    energy_total: int
    detected: int
    targets: int
    w_ub: float
    links: int
    messages_per_s: float
    """Deliveries in a second of simulated time."""
    robots_done: int
    robots: int
    mass_left: float = 1.0
    """Share of the mass that the common weights still hold; on a map, of the cells not yet seen."""
    distance_m: float | None = None
    """On a map: the distance that all robots have driven."""


_ENVELOPE_BYTES = 256
"""Of an envelope in an inbox without its body, at most."""
_NIL = Raw(b"\xc0")


class _OutputsShape(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Outputs, of which only the number of envelopes is looked at."""

    step: Raw
    pose: Raw
    goal: Raw = _NIL
    spent: Raw = _NIL
    lowered: Raw = _NIL
    weights: Raw = _NIL
    outbox: Annotated[tuple[Raw, ...], Meta(max_length=OUTBOX_MAX)] = ()


class _ReportShape(msgspec.Struct, frozen=True, array_like=True, tag=6, gc=False):
    """A Report, of which only numbers of items are looked at: nothing in it is decoded or copied."""

    version: Raw
    nonce: Annotated[str, Meta(max_length=NONCE_MAX)]
    outputs: _OutputsShape
    now_ns: Raw = _NIL
    heard: Annotated[tuple[Raw, ...], Meta(max_length=INBOX_MAX)] = ()


class _ReadyShape(msgspec.Struct, frozen=True, array_like=True, tag=7, gc=False):
    """A Ready, likewise."""

    version: Raw
    nonce: Annotated[str, Meta(max_length=NONCE_MAX)]


FromParticipant = Report | Ready
ToParticipant = Mission | Refusal | StartClock | StepRequest | Stop

_ENCODER = msgspec.msgpack.Encoder()
_FROM_PARTICIPANT = msgspec.msgpack.Decoder(FromParticipant)
_SHAPE = msgspec.msgpack.Decoder(_ReportShape | _ReadyShape)
_TO_PARTICIPANT = msgspec.msgpack.Decoder(ToParticipant)
_PROGRESS = msgspec.msgpack.Decoder(Progress)

encode = _ENCODER.encode
_SHORT_BYTES, _SHARED = 1024, 2048
"""Bodies that are kept decoded: how long, and how many. They take a few MB at most."""
_decode_gossip = msgspec.msgpack.Decoder(GossipMessage).decode
_decode_inputs = msgspec.msgpack.Decoder(Inputs).decode
_NO_ATTESTATIONS = encode(()) + encode(())
_NO_INCARNATION, _NO_REGISTERS = encode(0), encode(b"") + encode(0)


def envelope_bytes(envelope: Envelope) -> int:
    """What an envelope counts in an inbox: its body, and something for the rest."""
    return len(envelope.body) + _ENVELOPE_BYTES


def encode_gossip(message: GossipMessage) -> bytes:
    """The body of an envelope. Fields at the end that have their default are left out."""
    body = encode(message)
    if message.attestations or message.proofs:
        return body
    if message.incarnation:
        return b"\x9a" + body[1 : -len(_NO_ATTESTATIONS)]
    body = body[: -len(_NO_ATTESTATIONS)]
    if message.registers:
        return b"\x99" + body[1 : -len(_NO_INCARNATION)]
    return b"\x98" + body[1 : -len(_NO_REGISTERS)]


def decode_gossip(body: bytes) -> GossipMessage:
    """The body of an envelope. Raises RefusedError."""
    return _decode_once(body) if len(body) <= _SHORT_BYTES else _decode_body(body)


@lru_cache(maxsize=_SHARED)
def _decode_once(body: bytes) -> GossipMessage:
    """A broadcast is decoded once for all its receivers in this process."""
    return _decode_body(body)


def _decode_body(body: bytes) -> GossipMessage:
    if len(body) > BODY_BYTES_MAX:
        raise RefusedError(f"body of {len(body)} bytes")
    try:
        message = _decode_gossip(body)
    except _UNDECODABLE as error:
        raise RefusedError(str(error)) from None
    if message.version != VERSION:
        raise RefusedError(f"version {message.version}, this is {VERSION}")
    if not (math.isfinite(message.x_m) and math.isfinite(message.y_m)) or message.step < 0:
        raise RefusedError("gossip message without a finite place")
    if not 0 <= message.incarnation <= INCARNATIONS_MAX:
        raise RefusedError(
            f"gossip message of incarnation {message.incarnation}, the last is {INCARNATIONS_MAX}"
        )
    return message


def attestations_of(envelope: Envelope) -> tuple[Attestation, ...]:
    """The attestations that a receiver finds in an envelope: none in one that it refuses."""
    try:
        return decode_gossip(envelope.body).attestations
    except RefusedError:
        return ()


def decode_from_participant(payload: bytes) -> FromParticipant:
    """A message on `<id>/tx`. Raises RefusedError; for one with too many items before any of them is decoded."""
    if len(payload) > MESSAGE_BYTES_MAX:
        raise RefusedError(f"message of {len(payload)} bytes")
    _decoded(_SHAPE, payload)
    message: FromParticipant = _checked(_FROM_PARTICIPANT, payload)
    if isinstance(message, Report):
        check_outputs(message.outputs)
    return message


def decode_to_participant(payload: bytes) -> ToParticipant:
    """A message on `<id>/rx`. Raises RefusedError."""
    message: ToParticipant = _checked(_TO_PARTICIPANT, payload)
    return message


def decode_progress(payload: bytes) -> Progress:
    """A message on `world/progress`. Raises RefusedError."""
    message: Progress = _checked(_PROGRESS, payload)
    return message


def decode_inputs(payload: bytes) -> Inputs:
    """Encoded Inputs, as in a write-ahead log. Raises RefusedError."""
    try:
        return _decode_inputs(payload)
    except _UNDECODABLE as error:
        raise RefusedError(str(error)) from None


def check_outputs(outputs: Outputs) -> None:
    """Raise RefusedError for numbers that no participant may send."""
    pose, goal = outputs.pose, outputs.goal
    total = pose.x_m + pose.y_m + pose.heading_rad + pose.speed_m_s
    if goal is not None:
        total += goal[0] + goal[1]
    # One number that is not finite spoils the sum; only sums of absurd numbers overflow by themselves.
    if not math.isfinite(total) and not all(
        map(math.isfinite, (*msgspec.structs.astuple(pose), *(goal or ())))
    ):
        raise RefusedError("outputs with a number that is not finite")
    if not (
        0 <= outputs.step < 2**63
        and 0 <= outputs.energy_spent < 2**63
        and 0 <= outputs.refused < 2**63
    ):
        raise RefusedError("outputs with a count that is out of range")
    for envelope in outputs.outbox:
        if not 0 <= envelope.sequence < 2**63:
            raise RefusedError("outputs with a count that is out of range")
        if len(envelope.body) > BODY_BYTES_MAX:
            raise RefusedError("outputs with an oversized body")


_UNDECODABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


def _decoded(decoder: msgspec.msgpack.Decoder[Any], payload: bytes) -> Any:
    try:
        return decoder.decode(payload)
    except _UNDECODABLE as error:
        raise RefusedError(str(error)) from None


def _checked(decoder: msgspec.msgpack.Decoder[Any], payload: bytes) -> Any:
    message = _decoded(decoder, payload)
    if message.version != VERSION:
        raise RefusedError(f"version {message.version}, this is {VERSION}")
    return message
