"""Every message on the bus and on the radio: frozen records in msgpack, versioned, add-only.

A record travels as a msgpack array: tag, version, fields in order. New fields go to the end with a
default; unknown further fields are ignored; a change of meaning takes a new version. What does not
decode, has another version or is not finite is refused at the door and changes nothing.
"""

import math
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import Frame
from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import Body, Inputs, Observation, Outputs, ParticipantId, Pose
from kantor_protocol.scenario.schema import Scenario

VERSION = 1
BODY_BYTES_MAX = 262_144
"""The longest body of an envelope."""
MESSAGE_BYTES_MAX = 4 * 1024 * 1024
"""The longest message from a participant to world-sim."""


class RefusedError(ValueError):
    """A message that must not be taken in; the text says why."""


class _Message(msgspec.Struct, frozen=True, array_like=True):
    version: int


class Array(msgspec.Struct, frozen=True, array_like=True):
    """A numpy array as dtype, shape and bytes. Object arrays do not exist here."""

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
    """Radio, participant to participant: the sender's registers and the log suffixes others lack."""

    step: int
    """The sender's step."""
    x_m: float
    y_m: float
    """Where the sender says it is, world frame."""
    version_vector: bytes
    """Version vector: for every slot that the sender knows (`slots.py`), how many log entries it holds;
    then, with claims, the newest claim stamp it holds. LEB128."""
    logs: bytes
    """Suffixes: origin, start, span, count, then count packed pairs. LEB128."""
    claims: bytes
    """Registers: origin, stamp, sample + 1 (0: none), since_ns. LEB128."""
    registers: bytes = b""
    """For every such slot the stamp of the register that the sender holds; then registers: origin, stamp,
    numbers. LEB128, the numbers zigzag-folded. Empty in a mission whose planner has none."""
    incarnation: int = 0
    """The sender's incarnation."""


class Mission(_Message, frozen=True, array_like=True, tag=2):
    """World-sim to a participant that has joined: all that it needs to know."""

    nonce: str
    """The joining process that is meant."""
    scenario: Scenario
    seed: int
    starts: Array
    """(n, 2) float64, world frame, metres, in the order of the roster's robots."""
    samples: Array
    """(N, 2) float64 at time 0."""
    exchange: str
    """`lockstep` or `wall`."""
    frame: Frame | None
    """How the cells of the map lie, if there is one; what is in them is for the robots to find out."""
    run: str
    """Names this run of the mission, so that no snapshot of another is taken for its own."""
    body: Body
    """What the participant takes over."""


class Refusal(_Message, frozen=True, array_like=True, tag=3):
    """World-sim to a participant that may not join."""

    nonce: str
    reason: str


class StartClock(_Message, frozen=True, array_like=True, tag=4):
    """World-sim to a participant, wall exchange: simulated time runs from here."""

    nonce: str
    now_ns: int
    speed: float
    """Simulated seconds in a real one."""
    observation: Observation | None = None
    """What the participant sees before its first step."""
    skew_ns: int = 0
    """So far ahead is the clock that its machine reads. Sent again, it sets that clock anew."""


class StepRequest(_Message, frozen=True, array_like=True, tag=5):
    """World-sim to a participant: lockstep, step now; wall, news since the last one."""

    inputs: Inputs


class Report(_Message, frozen=True, array_like=True, tag=6):
    """Participant to world-sim: what it did."""

    nonce: str
    outputs: Outputs
    now_ns: int = 0
    """Wall: the time on the participant's clock at which it stepped."""
    heard: tuple[tuple[ParticipantId, int], ...] = ()
    """Wall: source and sequence of each envelope in the inbox of this step, in order."""
    observed: int = 0
    """Wall: the step in the observation that it used."""
    skew_ns: int = 0
    """Wall: how far the clock that its machine read was ahead of now_ns."""


class Ready(_Message, frozen=True, array_like=True, tag=7):
    """Participant to world-sim: mission received, prepared to step."""

    nonce: str
    incarnation: int = 0
    """Which incarnation it is."""
    step: int = 0
    """The step that it goes on from, by its own snapshot."""
    now_ns: int = 0
    """Wall: the time on its clock, if that runs already."""


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
    """waiting: who is missing; over: why."""
    energy_spent: int
    energy_total: int
    detected: int
    targets: int
    w_ub: float
    links: int
    messages_per_s: float
    """Deliveries a second of simulated time."""
    robots_done: int
    robots: int
    mass_left: float = 1.0
    """Share of the mass that the common weights still hold; on a map, of the cells not yet seen."""
    distance_m: float | None = None
    """On a map: what all robots have driven."""


FromParticipant = Report | Ready
ToParticipant = Mission | Refusal | StartClock | StepRequest | Stop

_ENCODER = msgspec.msgpack.Encoder()
_FROM_PARTICIPANT = msgspec.msgpack.Decoder(FromParticipant)
_TO_PARTICIPANT = msgspec.msgpack.Decoder(ToParticipant)
_PROGRESS = msgspec.msgpack.Decoder(Progress)

encode = _ENCODER.encode
_decode_gossip = msgspec.msgpack.Decoder(GossipMessage).decode
_decode_inputs = msgspec.msgpack.Decoder(Inputs).decode
_NO_EPOCH, _NO_REGISTERS = encode(0), encode(b"") + encode(0)


def encode_gossip(news: GossipMessage) -> bytes:
    """The body of an envelope. What has a default and is at the end is left out."""
    body = encode(news)
    if news.incarnation:
        return body
    if news.registers:
        return b"\x99" + body[1 : -len(_NO_EPOCH)]
    return b"\x98" + body[1 : -len(_NO_REGISTERS)]


def decode_gossip(body: bytes) -> GossipMessage:
    """The body of an envelope. Raises RefusedError."""
    if len(body) > BODY_BYTES_MAX:
        raise RefusedError(f"body of {len(body)} bytes")
    try:
        news = _decode_gossip(body)
    except _UNDECODABLE as error:
        raise RefusedError(str(error)) from None
    if news.version != VERSION:
        raise RefusedError(f"version {news.version}, this is {VERSION}")
    if not (math.isfinite(news.x_m) and math.isfinite(news.y_m)) or news.step < 0:
        raise RefusedError("news without a finite place")
    if not 0 <= news.incarnation <= INCARNATIONS_MAX:
        raise RefusedError(
            f"news of incarnation {news.incarnation}, the last is {INCARNATIONS_MAX}"
        )
    return news


def decode_from_participant(payload: bytes) -> FromParticipant:
    """A message on `<id>/tx`. Raises RefusedError."""
    if len(payload) > MESSAGE_BYTES_MAX:
        raise RefusedError(f"message of {len(payload)} bytes")
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
    """Inputs as they passed the codec. Raises RefusedError."""
    try:
        return _decode_inputs(payload)
    except _UNDECODABLE as error:
        raise RefusedError(str(error)) from None


def check_outputs(outputs: Outputs) -> None:
    """Raise RefusedError for numbers that no participant may send."""
    pose, goal = outputs.pose, outputs.goal
    numbers = (pose.x_m, pose.y_m, pose.heading_rad, pose.speed_m_s, *(goal or ()))
    # One number that is not finite spoils the sum; only sums of absurd numbers overflow by themselves.
    if not math.isfinite(sum(numbers)) and not all(map(math.isfinite, numbers)):
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
