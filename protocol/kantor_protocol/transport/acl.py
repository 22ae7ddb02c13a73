"""Rights on a router, in the form of Zenoh's access control. What is not granted is denied.

A robot may put on its own keys and read its own `rx`. A site acts for its robots: towards the hub it has the rights
of all of them, and the hub has the same rights towards it, seen from the other side. An observer reads.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, Self

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.wire import keys


class Grant(NamedTuple):
    """A right of a subject, seen from the router that enforces it."""

    flow: Literal["ingress", "egress"]
    message: Literal[
        "put", "declare_subscriber", "liveliness_token", "query", "reply", "declare_queryable"
    ]
    keys: tuple[str, ...]

    @property
    def mirrored(self) -> Self:
        """The same, seen from the router at the other end of the link."""
        return self._replace(flow="egress" if self.flow == "ingress" else "ingress")


Grants = Sequence[Grant]


def robot(fleet: str, name: ParticipantId) -> Grants:
    """The rights of a robot, or of the supervisor."""
    return _participants(fleet, (name,))


def observer(fleet: str) -> Grants:
    """The rights of an observer: to read everything."""
    everything = (keys.everything(fleet),)
    return (
        Grant("ingress", "declare_subscriber", everything),
        Grant("egress", "put", everything),
    )


def anyone(fleet: str) -> Grants:
    """The right of every holder of a certificate of the fleet's authority: to query why it is refused."""
    door = (keys.door(fleet),)
    return (
        Grant("ingress", "query", door),
        Grant("egress", "declare_queryable", door),
        Grant("egress", "reply", door),
    )


def site(fleet: str, members: Iterable[ParticipantId]) -> Grants:
    """The rights of a site at the hub: to act for its robots."""
    return _participants(fleet, tuple(members))


def hub(fleet: str, members: Iterable[ParticipantId]) -> Grants:
    """The rights of the hub at a site."""
    return tuple(grant.mirrored for grant in site(fleet, members))


def control(subjects: Iterable[tuple[str, dict[str, list[str]], Grants]]) -> dict[str, Any]:
    """The setting `access_control`: for each subject its id, how the router recognizes it, and its rights."""
    rules: list[dict[str, Any]] = []
    known: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for label, marks, grants in subjects:
        own = [
            {
                "id": f"{label}-{i}",
                "permission": "allow",
                "flows": [grant.flow],
                "messages": [grant.message],
                "key_exprs": list(grant.keys),
            }
            for i, grant in enumerate(grants)
        ]
        rules += own
        known.append({"id": label, **marks})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [label]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": known,
        "policies": policies,
    }


def _participants(fleet: str, names: tuple[ParticipantId, ...]) -> Grants:
    written = (keys.tx, keys.pose, keys.weights)
    read = tuple(keys.rx(fleet, name) for name in names)
    return (
        Grant("ingress", "put", tuple(key(fleet, name) for name in names for key in written)),
        Grant("ingress", "declare_subscriber", read),
        Grant("egress", "put", read),
        Grant("ingress", "liveliness_token", tuple(keys.alive(fleet, name) for name in names)),
        # That a key has a subscriber discloses nothing. Without this a router forwards nothing that is put on it, and
        # a participant learns of nobody for whom to publish.
        Grant("egress", "declare_subscriber", (keys.everything(fleet),)),
    )
