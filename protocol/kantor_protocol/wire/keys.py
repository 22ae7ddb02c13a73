"""Key expressions on the bus: built and parsed in one place.

kantor/v1/<fleet>/<id>/pose      robot -> observers
kantor/v1/<fleet>/<id>/weights   robot -> observers
kantor/v1/<fleet>/<id>/tx        participant -> world-sim
kantor/v1/<fleet>/<id>/rx        world-sim -> participant
kantor/v1/<fleet>/<id>/alive/<nonce>   liveliness token of one process
kantor/v1/<fleet>/world/<name>   world-sim -> observers
kantor/v1/<fleet>/door/<name>    queried by the holder of the certificate of that name; the router answers
"""

from typing import NamedTuple

from kantor_protocol.base.machine import ParticipantId

_ROOT = "kantor/v1"
WORLD = "world"


class Key(NamedTuple):
    """The parts of a key."""

    fleet: str
    name: ParticipantId
    """A participant, or WORLD."""
    kind: str
    nonce: str = ""


def pose(fleet: str, name: ParticipantId) -> str:
    """The key on which a participant publishes its pose."""
    return f"{_ROOT}/{fleet}/{name}/pose"


def weights(fleet: str, name: ParticipantId) -> str:
    """The key on which a participant publishes its weight vector."""
    return f"{_ROOT}/{fleet}/{name}/weights"


def tx(fleet: str, name: ParticipantId = "*") -> str:
    """The key of messages from a participant to world-sim."""
    return f"{_ROOT}/{fleet}/{name}/tx"


def rx(fleet: str, name: ParticipantId) -> str:
    """The key of messages from world-sim to a participant."""
    return f"{_ROOT}/{fleet}/{name}/rx"


def alive(fleet: str, name: ParticipantId = "*", nonce: str = "*") -> str:
    """The key of the liveliness token of a participant's process."""
    return f"{_ROOT}/{fleet}/{name}/alive/{nonce}"


def progress(fleet: str) -> str:
    """The key on which world-sim publishes how the mission goes."""
    return f"{_ROOT}/{fleet}/{WORLD}/progress"


def door(fleet: str, name: str = "*") -> str:
    """The key that the holder of a certificate queries for the reason why it is refused."""
    return f"{_ROOT}/{fleet}/door/{name}"


def everything(fleet: str) -> str:
    """All keys of a fleet."""
    return f"{_ROOT}/{fleet}/**"


def parse(key: str) -> Key | None:
    """The parts of a key; None if it is none of kantor's."""
    parts = key.split("/")
    if len(parts) < 5 or parts[:2] != _ROOT.split("/"):
        return None
    return Key(parts[2], parts[3], parts[4], "/".join(parts[5:]))
