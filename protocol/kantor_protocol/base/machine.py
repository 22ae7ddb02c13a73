"""The state machine that every participant is, and what crosses its border.

Input is a value, output is a value, and the same machine with the same inputs gives the same
outputs. Time is an argument (simulated integer nanoseconds); nothing else reaches a machine.

The garbage collector does not track the records (`gc=False`): frozen values hold no cycles.
"""

import enum
from collections.abc import Callable, Mapping
from typing import Annotated, Protocol

import msgspec
from msgspec import Meta

ParticipantId = str
"""`r1`, `r2`, … for robots, `supervisor` for the supervisor."""

EVERYBODY: ParticipantId = ""
"""The target of an envelope for all participants in range."""

SUPERVISOR: ParticipantId = "supervisor"

WORLD_SIM: ParticipantId = "worldsim"
"""The process that simulates the world. It is no participant, but it can fail like one."""

NEVER_NS = 2**63 - 1
"""A time after every other, in nanoseconds."""


class State(enum.IntEnum):
    """The activity of a participant. The last two are final."""

    EXPLORING = 0
    FINISHED = 1
    """No sample has weight left, or no frontier can be reached, in its own view; it stands and relays."""
    EXHAUSTED = 2
    """Its energy is spent; it stands and keeps relaying."""


class Pose(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The pose of a body in the world frame (x right, y up, heading counter-clockwise from x)."""

    x_m: float
    y_m: float
    heading_rad: float = 0.0
    speed_m_s: float = 0.0


class Body(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A body as world-sim knows it when a process takes it over."""

    pose: Pose
    step: int = 0
    """The last step that world-sim has accepted; 0: it has not moved yet."""
    energy_spent: int = 0
    """Points shipped, by all incarnations together."""
    incarnation: int = 0
    """The incarnation that drove it last. A process that cannot go on from its write-ahead log begins the next one:
    two writers must never share a log."""


class Envelope(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One radio transmission. (source, sequence) is unique in a run."""

    source: ParticipantId
    sequence: int
    target: ParticipantId
    """A participant, or EVERYBODY in range."""
    body: bytes
    """An encoded message; the radio does not look inside."""


class Observation(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The part of a step's inputs that a participant learns from world-sim about itself."""

    step: int
    """The participant's last step that world-sim has accepted; 0 before the first."""
    pose: Pose
    """Its true pose after that step."""
    detected: tuple[int, ...] = ()
    """Targets that its sensor found since the last observation."""
    scan: bytes = b""
    """A range scan made from there, see `replication/occupancy_log.py`; empty without a map."""
    bumped: bool = False
    """Whether the last step ended at an obstacle."""


class Inputs(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The inputs of one step: what reached a participant since its last one."""

    now_ns: Annotated[int, Meta(ge=-(2**62), le=2**62)]
    observation: Observation
    inbox: tuple[Envelope, ...] = ()
    """In order of arrival."""


class Outputs(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The outputs of one step: what a participant did in it."""

    step: int
    """Counts from 1."""
    pose: Pose
    goal: tuple[float, float] | None = None
    """World frame, metres; None without a goal."""
    spent: bytes = b""
    """Packed pairs (sample, units) that it consumed in this step, nearest first (Prop. 1)."""
    lowered: bytes = b""
    """Packed pairs (sample, units left): the entries of its weight vector that fell in this step."""
    weights: bytes = b""
    """The message for its weights key in this step, if one is due (`wire/weights.py`)."""
    outbox: tuple[Envelope, ...] = ()
    energy_spent: int = 0
    """Robot points shipped since the start."""
    state: State = State.EXPLORING
    refused: int = 0
    """Messages it has refused since the start: malformed, too old, not from the roster."""


class StateMachine(Protocol):
    """A participant: robot or supervisor."""

    def step(self, inputs: Inputs, /) -> Outputs:
        """Make one step."""
        ...


Exchange = Callable[[Mapping[ParticipantId, Inputs]], Mapping[ParticipantId, Outputs]]
"""Steps all participants of a batch. A missing output is a value: late, crashed or cut off."""
