"""Events of the bus, as a router reports them."""

from typing import NamedTuple

from kantor_protocol.base.machine import ParticipantId


class Joined(NamedTuple):
    """A participant's process has declared its token."""

    name: ParticipantId
    nonce: str


class Left(NamedTuple):
    """A participant's process has ended, or was silent for a lease."""

    name: ParticipantId
    nonce: str


class Received(NamedTuple):
    """A message of a participant has arrived."""

    name: ParticipantId
    payload: bytes


class Flooded(NamedTuple):
    """A participant has exceeded its quota for the first time."""

    name: ParticipantId


Event = Joined | Left | Received | Flooded
