"""Identities on the bus: a user and a password for each participant, in files for its eyes only.

A folder holds `<id>.toml` for each identity, to be handed to whoever runs it, and `users.txt` for the
router. World-sim writes it; nothing else does.
"""

import os
import re
import secrets
import tomllib
from collections.abc import Iterable
from pathlib import Path

import msgspec

from kantor_protocol.machine import WORLD_SIM, ParticipantId

HOST = WORLD_SIM
OBSERVER = "observer"
_USERS = "users.txt"
FLEET_PATTERN = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")


class CredentialsError(ValueError):
    """Credentials that are missing or no use; the message is one line with the remedy."""


class Identity(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Who a process is on which fleet's bus."""

    fleet: str
    user: ParticipantId
    password: str = ""
    authority: str = ""
    certificate: str = ""
    key: str = ""
    members: dict[ParticipantId, str] = {}
    sites: dict[str, list[ParticipantId]] = {}


def issue(folder: Path, fleet: str, users: Iterable[ParticipantId]) -> dict[str, Identity]:
    """Identities for the given users; those that the folder has already for this fleet are kept."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    identities = {}
    for user in (HOST, OBSERVER, *users):
        path = folder / f"{user}.toml"
        identity = _read(path) if path.exists() else None
        if identity is None or identity.fleet != fleet or identity.user != user:
            identity = Identity(fleet, user, secrets.token_urlsafe(24))
            tree = msgspec.to_builtins(identity)
            _write(path, "".join(f'{key} = "{value}"\n' for key, value in tree.items()))
        identities[user] = identity
    lines = (f"{identity.user}:{identity.password}\n" for identity in identities.values())
    _write(folder / _USERS, "".join(lines))
    return identities


def users_file(folder: Path) -> Path:
    """What the router reads."""
    return folder / _USERS


def find(place: Path, user: ParticipantId) -> Identity:
    """The identity of a user from a credentials folder, or from its file itself.

    Raises CredentialsError.
    """
    path = place / f"{user}.toml" if place.is_dir() else place
    if not path.exists():
        known = sorted(found.stem for found in place.glob("*.toml")) if place.is_dir() else []
        hint = f"known here: {', '.join(known)}" if known else "start `kantor worldsim` first"
        raise CredentialsError(f"{path}: no credentials for {user}; {hint}")
    identity = _read(path)
    if identity is None:
        raise CredentialsError(f"{path}: not a credentials file; let world-sim write it anew")
    if identity.user != user:
        raise CredentialsError(f"{path}: credentials of {identity.user}, not of {user}")
    return identity


def _read(path: Path) -> Identity | None:
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Identity)
    except (OSError, ValueError, RecursionError):  # not to be read, no text, no TOML, no identity
        return None


def _write(path: Path, text: str) -> None:
    """Write for the owner's eyes only, whole or not at all."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        file.write(text)
    draft.replace(path)
