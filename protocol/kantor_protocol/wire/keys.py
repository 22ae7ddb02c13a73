"""Every key expression on the bus, built and taken apart in one place.

kantor/v1/<fleet>/<id>/pose      robot -> observers
kantor/v1/<fleet>/<id>/weights   robot -> observers
kantor/v1/<fleet>/<id>/tx        participant -> world-sim
kantor/v1/<fleet>/<id>/rx        world-sim -> participant
kantor/v1/<fleet>/<id>/alive/<nonce>   liveliness token of one process
kantor/v1/<fleet>/world/<name>   world-sim -> observers
kantor/v1/<fleet>/door/<name>    asked by whoever has a certificate of that name; world-sim answers
"""

from typing import NamedTuple

from kantor_protocol.base.machine import ParticipantId

_ROOT = "kantor/v1"
WORLD = "world"


class Key(NamedTuple):
    """A key taken apart."""

    fleet: str
    name: ParticipantId
    """A participant, or WORLD."""
    kind: str
    nonce: str = ""


def pose(fleet: str, name: ParticipantId) -> str:
    """Where a participant publishes its pose."""
    return f"{_ROOT}/{fleet}/{name}/pose"


def weights(fleet: str, name: ParticipantId) -> str:
    """Where a participant publishes its weight vector."""
    return f"{_ROOT}/{fleet}/{name}/weights"


def tx(fleet: str, name: ParticipantId = "*") -> str:
    """What a participant sends to world-sim."""
    return f"{_ROOT}/{fleet}/{name}/tx"


def rx(fleet: str, name: ParticipantId) -> str:
    """What world-sim sends to a participant."""
    return f"{_ROOT}/{fleet}/{name}/rx"


def alive(fleet: str, name: ParticipantId = "*", nonce: str = "*") -> str:
    """The liveliness token of a participant's process."""
    return f"{_ROOT}/{fleet}/{name}/alive/{nonce}"


def progress(fleet: str) -> str:
    """How the mission goes."""
    return f"{_ROOT}/{fleet}/{WORLD}/progress"


def door(fleet: str, name: str = "*") -> str:
    """Where the holder of a certificate asks whether it is let in."""
    return f"{_ROOT}/{fleet}/door/{name}"


def everything(fleet: str) -> str:
    """The whole fleet."""
    return f"{_ROOT}/{fleet}/**"


def parse(key: str) -> Key | None:
    """Take a key apart; None if it is none of kantor's."""
    parts = key.split("/")
    if len(parts) < 5 or parts[:2] != _ROOT.split("/"):
        return None
    return Key(parts[2], parts[3], parts[4], "/".join(parts[5:]))
