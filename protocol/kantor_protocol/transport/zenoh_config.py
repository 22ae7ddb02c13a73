"""Zenoh's settings: how a process authenticates, and what a router admits.

The traps that they avoid are in protocol/README.md.
"""

import base64
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.transport import acl
from kantor_protocol.transport.credentials import OBSERVER, Certificate, Identity, Password
from kantor_protocol.wire import keys
from kantor_protocol.wire.messages import MESSAGE_BYTES_MAX

LEASE_MS = 1000
"""A process that is frozen or disconnected is noticed after this."""
LOCKSTEP_LEASE_MS = 10_000
"""The same where time waits for a process on a busy machine. One that has ended is noticed at once in any case."""
HANDSHAKE_S = 3.0
POSE_BYTES_MAX = 256
SHOWN_PER_S = 1000
"""Messages on a pose key, and on a weights key, that reach observers. A pose is outdated by the next, and
weights have keyframes."""
ACCEPT_TIMEOUT_MS = 2000
"""A connection that has not proved who it is by then is closed."""
ACCEPT_PENDING = 500
"""So many connections may be about to prove who they are; more are closed at once, and try again."""
SESSIONS_OF_EACH, SESSIONS_MORE = 4, 64
"""Sessions at one time: a few of each identity, and more for all of them together, such as those of observers."""
_SESSIONS_CLOSING = 64
"""Sessions that were too many and are about to be closed."""
_RECEIVE_BYTES = 32 * 1024
_FRAME_BYTES = 64 * 1024

ZenohConfig = dict[str, Any]
Subject = tuple[str, dict[str, list[str]], acl.Grants]


def common_config(mode: str, connect: str | None, listen: str | None) -> ZenohConfig:
    """The settings of every process."""
    return {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/endpoints": [connect] if connect else [],
        "listen/endpoints": [listen] if listen else [],
        # Chunks of shared memory are lost when a receiver is not scheduled for 100 ms.
        "transport/shared_memory/enabled": False,
    }


def client_config(identity: Identity, lease_ms: int | None = None) -> ZenohConfig:
    """The settings of a process that connects, and connects again when the connection is lost."""
    return _proof(identity) | {
        "connect/timeout_ms": round(HANDSHAKE_S * 1000),
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": 200,
            "period_increase_factor": 1.5,
        },
        "transport/link/tx/lease": LEASE_MS if lease_ms is None else lease_ms,
    }


def hub_config(
    identity: Identity, roster: Iterable[ParticipantId], users_file: Path | None
) -> ZenohConfig:
    """The settings of world-sim's router. users_file: the passwords, for an identity that has one."""
    fleet, roster = identity.fleet, tuple(roster)
    subjects = [(name, acl.robot(fleet, name)) for name in roster]
    if isinstance(identity, Certificate):
        subjects += [
            (name, acl.site(fleet, robots)) for name, robots in identity.robots_by_site().items()
        ]
    subjects.append((OBSERVER, acl.observer(fleet)))
    return _router(identity, subjects, roster, users_file)


def site_config(identity: Certificate, members: Iterable[ParticipantId]) -> ZenohConfig:
    """The settings of a site's router, which also connects to world-sim's."""
    fleet, members = identity.fleet, tuple(members)
    robots = [(name, acl.robot(fleet, name)) for name in members]
    subjects = [*robots, (WORLD_SIM, acl.hub(fleet, members))]
    return client_config(identity) | _router(identity, subjects, members)


def _router(
    identity: Identity,
    grants: list[tuple[str, acl.Grants]],
    roster: tuple[ParticipantId, ...],
    users_file: Path | None = None,
) -> ZenohConfig:
    fleet = identity.fleet
    return _proof(identity, users_file) | {
        "scouting/delay": 0,
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "transport/unicast/accept_timeout": ACCEPT_TIMEOUT_MS,
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/max_sessions": SESSIONS_OF_EACH * len(grants)
        + SESSIONS_MORE
        + _SESSIONS_CLOSING,
        # A frozen client must not hold the router for long (the unit is microseconds).
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 200_000,
        # A flood reaches the router in small portions, so that messages of others are read between them.
        "transport/link/tcp/so_rcvbuf": _RECEIVE_BYTES,
        "transport/link/tls/so_rcvbuf": _RECEIVE_BYTES,
        # Longer messages are not reassembled. Without this a robot could have a gigabyte waiting.
        "transport/link/rx/max_message_size": MESSAGE_BYTES_MAX + _FRAME_BYTES,
        "access_control": acl.control(_subjects(identity, grants)),
        "low_pass_filter": [
            _low_pass("all", keys.everything(fleet), MESSAGE_BYTES_MAX),
            _low_pass("pose", keys.pose(fleet, "*"), POSE_BYTES_MAX),
        ],
        "downsampling": _downsampling(fleet, roster),
    }


def _subjects(identity: Identity, grants: list[tuple[str, acl.Grants]]) -> list[Subject]:
    """Subjects with the marks by which the router recognizes them; without a valid certificate it recognizes none."""
    if isinstance(identity, Password):
        return [(name, {"usernames": [name]}, granted) for name, granted in grants]
    known = [
        (name, {"cert_common_names": [identity.members[name].name]}, granted)
        for name, granted in grants
        if name in identity.members
    ]
    return [*known, ("anybody", {"link_protocols": ["tls"]}, acl.anyone(identity.fleet))]


def _proof(identity: Identity, users_file: Path | None = None) -> ZenohConfig:
    """The settings by which a process authenticates, and checks others."""
    if isinstance(identity, Password):
        known = {"dictionary_file": str(users_file)} if users_file is not None else {}
        proof = {"user": identity.user, "password": identity.password, **known}
        return {"transport/auth/usrpwd": proof}
    key, certificate = _base64(identity.key), _base64(identity.certificate)
    return {
        "transport/link/tls": {
            "root_ca_certificate_base64": _base64(identity.authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "listen_private_key_base64": key,
            "listen_certificate_base64": certificate,
            "connect_private_key_base64": key,
            "connect_certificate_base64": certificate,
        }
    }


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


def _low_pass(label: str, key: str, bytes_max: int) -> ZenohConfig:
    """A rule that stops longer messages at the router."""
    return {
        "id": label,
        "flows": ["ingress"],
        "messages": ["put"],
        "key_exprs": [key],
        "size_limit": bytes_max,
    }


def _downsampling(fleet: str, roster: tuple[ParticipantId, ...]) -> list[ZenohConfig]:
    """Rules that thin out messages for observers: one for each participant, since many may be behind one router."""
    return [
        {
            "id": f"{name}-shows",
            "flows": ["ingress"],
            "messages": ["put"],
            "rules": [
                {"key_expr": key(fleet, name), "freq": SHOWN_PER_S}
                for key in (keys.pose, keys.weights)
            ],
        }
        for name in roster
    ]
