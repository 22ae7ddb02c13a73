"""Events of the bus, as a router tells them."""

from typing import NamedTuple

from kantor_protocol.base.machine import ParticipantId


class Joined(NamedTuple):
    """A participant's process has come."""

    name: ParticipantId
    nonce: str


class Left(NamedTuple):
    """A participant's process has gone, or has been silent for a lease."""

    name: ParticipantId
    nonce: str


class Heard(NamedTuple):
    """A message from a participant."""

    name: ParticipantId
    payload: bytes


class Flooded(NamedTuple):
    """A participant has gone beyond its quota for the first time."""

    name: ParticipantId


Event = Joined | Left | Heard | Flooded
