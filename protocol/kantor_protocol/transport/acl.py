"""Who may do what on a router, as Zenoh's access control wants it. Whatever is not granted is denied.

A robot may put on its own keys and read its own `rx`. A site speaks for its robots: towards the hub it may do
what they may together, and the hub may do towards it the same seen from the other side. An observer reads.
"""

from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple, Self

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.wire import keys


class Grant(NamedTuple):
    """Something that a subject may do, seen from the router that enforces it."""

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
    """What a robot, or the supervisor, may do."""
    return _participants(fleet, (name,))


def observer(fleet: str) -> Grants:
    """Reads everything."""
    everything = (keys.everything(fleet),)
    return (
        Grant("ingress", "declare_subscriber", everything),
        Grant("egress", "put", everything),
    )


def anyone(fleet: str) -> Grants:
    """Whoever has a certificate of the fleet's authority, even if it is not let in, may ask why."""
    door = (keys.door(fleet),)
    return (
        Grant("ingress", "query", door),
        Grant("egress", "declare_queryable", door),
        Grant("egress", "reply", door),
    )


def site(fleet: str, members: Iterable[ParticipantId]) -> Grants:
    """What a site may do at the hub: speak for its robots, and hear who listens to them.

    To know that somebody subscribes discloses nothing; without it a router keeps to itself what it is told.
    """
    return (
        *_participants(fleet, tuple(members)),
        Grant("egress", "declare_subscriber", (keys.everything(fleet),)),
    )


def hub(fleet: str, members: Iterable[ParticipantId]) -> Grants:
    """What the hub may do at a site."""
    return tuple(grant.mirrored for grant in site(fleet, members))


def control(subjects: Iterable[tuple[str, dict[str, list[str]], Grants]]) -> dict[str, Any]:
    """The setting `access_control`: for each subject its id, how the router knows it, and its grants."""
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
    says = (keys.tx, keys.pose, keys.weights)
    heard = tuple(keys.rx(fleet, name) for name in names)
    return (
        Grant("ingress", "put", tuple(key(fleet, name) for name in names for key in says)),
        Grant("ingress", "declare_subscriber", heard),
        Grant("egress", "put", heard),
        Grant("ingress", "liveliness_token", tuple(keys.alive(fleet, name) for name in names)),
    )
