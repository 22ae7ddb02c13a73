"""Identities of processes on the bus: one TOML file for each, readable by its owner only.

There are two kinds. A *password* is for a run on one machine: `kantor worldsim` makes them, a folder with
`<id>.toml` for each identity and `users.txt` for the router. A *certificate* is for everything else: it is
issued by the fleet's authority (`kantor keys`), and never by world-sim. World-sim's own certificate comes
with the list of the members that it admits.

With both a participant signs (`signing_key`): the key follows from the password, or is the certificate's. World-sim
knows all public keys: it made the passwords, or has the member list.
"""

import hashlib
import os
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.files.reading import UnreadableError, read_text
from kantor_protocol.files.toml import TomlError, parse_toml
from kantor_protocol.storage import private_files
from kantor_protocol.wire.signatures import KEY_BYTES_MAX, SigningKey

HOST = WORLD_SIM
OBSERVER = "observer"
AUTHORITY = "authority"
"""Not an identity: the name of the file that the fleet's certificates come from."""
SOON = timedelta(days=7)
"""A certificate that expires within this is worth a warning."""
_USERS = "users.txt"
_PEM_MAX = 16_384
"""Characters of a certificate or a key; a longer text is refused."""
FLEET_PATTERN = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
NAME_PATTERN = re.compile(r"[a-z0-9-]{1,69}\.[0-9a-f]{16}")
"""Names of certificates."""
_KEY_PATTERN = re.compile(rf"|([0-9a-f]{{2}}){{1,{KEY_BYTES_MAX}}}")
_SIGNING = b"kantor signing"
"""What a key is made from a password for; at most 16 bytes."""


class CredentialsError(ValueError):
    """Credentials that are missing or unusable; the message is one line with the remedy."""


def _check_fleet(fleet: str) -> None:
    if not FLEET_PATTERN.fullmatch(fleet):
        raise ValueError(f"{fleet} is no name of a fleet")


class Password(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The identity of a process on one fleet's bus: a user with a password."""

    fleet: str
    user: ParticipantId
    password: str

    def __post_init__(self) -> None:
        """Check the name of the fleet. Raises ValueError."""
        _check_fleet(self.fleet)


class Member(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An entry of the member list: the certificate that counts for a user."""

    name: str
    """Its common name: the identity's id, a dot, and the certificate's serial number in hexadecimal."""
    until: datetime
    """Its expiry (UTC)."""
    key: str = ""
    """Its public key, see `wire/signatures.py`, hexadecimal; empty in a list of an older version."""

    def __post_init__(self) -> None:
        """Check that the key can be one. Raises ValueError."""
        if not _KEY_PATTERN.fullmatch(self.key):
            raise ValueError("no public key")


class Certificate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The identity of a process on one fleet's bus: a user with a certificate. All three parts are PEM."""

    fleet: str
    user: ParticipantId
    name: str
    """The certificate's common name."""
    until: datetime
    authority: str
    certificate: str
    key: str
    revoked: tuple[str, ...] = ()
    """A router's: names of certificates that were revoked before they expired."""
    members: dict[ParticipantId, Member] = {}
    """A router's: the certificate of each member; clients that show another one are refused. A site's has its robots
    and world-sim."""
    sites: dict[ParticipantId, tuple[ParticipantId, ...]] = {}
    """World-sim's: for each site its robots."""
    site: ParticipantId | None = None
    """The site whose router it may connect to as well as to world-sim; empty: none. None: an older file, any."""

    def __post_init__(self) -> None:
        """Check that an authority can have issued this. Raises ValueError."""
        _check_fleet(self.fleet)
        for user, name, until in (
            (self.user, self.name, self.until),
            *((user, member.name, member.until) for user, member in self.members.items()),
        ):
            if not NAME_PATTERN.fullmatch(name) or name.partition(".")[0] != user:
                raise ValueError(f"{name} is no name of a certificate of {user}")
            if until.utcoffset() != timedelta(0):
                raise ValueError("a time without its zone")
        if any(len(part) > _PEM_MAX for part in (self.authority, self.certificate, self.key)):
            raise ValueError("no PEM")

    def distrust(self, name: str) -> str:
        """Why what answers, by the common name of its certificate, is no router to connect to; empty if it is one.

        Every router of a fleet has a certificate for servers; its name says what it is.
        """
        user = name.partition(".")[0]
        known = (HOST,) if self.site == "" else (HOST, self.site)
        if user in known or (self.site is None and user.startswith("site-")):
            return ""
        return (
            f"what answers is {user or 'nobody'}, not {' or '.join(map(str, known))}; do not trust it, "
            f"or use the newest {self.user}.toml"
        )

    def public_keys(self, users: Iterable[ParticipantId]) -> dict[ParticipantId, bytes]:
        """The public key of each of these users; empty for one that is not on the list, or without its key."""
        listed = {user: member.key for user, member in self.members.items()}
        return {user: bytes.fromhex(listed.get(user, "")) for user in users}

    def robots_by_site(self) -> dict[ParticipantId, tuple[ParticipantId, ...]]:
        """For each site the robots that it acts for: those that have not been revoked."""
        return {
            site: tuple(name for name in robots if name in self.members)
            for site, robots in self.sites.items()
        }

    def refusal_reason(self, name: str, wanted: Iterable[ParticipantId]) -> str:
        """Why the holder of a certificate is refused, with the remedy; empty if it is admitted.

        name: the certificate's common name. wanted: the users that take part.
        """
        user = name.partition(".")[0]
        member = self.members.get(user)
        renew = self._renewal(user)
        if name in self.revoked:
            return f"its certificate has been revoked; {renew}"
        if member is None:
            return (
                f"is not in the register; start {self.user} again with the newest {self.user}.toml"
            )
        if member.name != name:
            return self._another(user)
        if user not in wanted:
            return "is not in the team; choose another id"
        return ""

    def answer(self, name: str, wanted: Iterable[ParticipantId]) -> str:
        """What whoever asks is told about a certificate: as `refusal_reason`, if this certificate exists.

        Anybody may ask about any name. Of names that were only guessed all are answered alike, so that nobody learns
        who the members are.
        """
        known = {*self.revoked, *(member.name for member in self.members.values())}
        return (
            self.refusal_reason(name, wanted)
            if name in known
            else self._another(name.partition(".")[0])
        )

    def _another(self, user: str) -> str:
        return f"the register names another certificate; use the newest {user}.toml, or {self._renewal(user)}"

    def _renewal(self, user: str) -> str:
        return f"`kantor keys {self.fleet} --renew {user}` makes a new one"

    def warnings(self, users: Iterable[ParticipantId], now: datetime) -> list[str]:
        """A line for each of those users' certificates, and the own, that expires soon or has expired."""
        return [
            f"{user}'s certificate {expiry(self.members[user].until, now)}; "
            f"`kantor keys {self.fleet} --renew {user}`"
            for user in (self.user, *users)
            if user in self.members and self.members[user].until - now < SOON
        ]


Identity = Password | Certificate


def signing_key(identity: Identity) -> SigningKey:
    """The key with which a participant signs. Raises CredentialsError."""
    from kantor_protocol.wire.signing_keys import CertificateKey, Ed25519Key  # noqa: PLC0415  open runs need none

    if isinstance(identity, Password):
        key = hashlib.blake2b(identity.password.encode()).digest()
        owner = f"{identity.fleet}/{identity.user}".encode()
        return Ed25519Key(hashlib.blake2b(owner, digest_size=32, key=key, person=_SIGNING).digest())
    try:
        return CertificateKey(identity.key.encode())
    except ValueError:
        raise CredentialsError(
            f"{identity.user}: its certificate's key cannot sign; "
            f"`kantor keys {identity.fleet} --renew {identity.user}` makes another"
        ) from None


def public_key(identity: Identity) -> bytes:
    """The public key of a participant. Raises CredentialsError."""
    return signing_key(identity).public


T = TypeVar("T")


def issue(folder: Path, fleet: str, users: Iterable[ParticipantId]) -> dict[str, Password]:
    """Passwords for the given users; those that the folder has already are kept.

    Raises CredentialsError if the folder holds something else: nothing is overwritten.
    """
    private_files.make_folder(folder)
    identities = draw(fleet, users)
    for user in identities:
        kept = _kept(folder / f"{user}.toml", fleet, user)
        if kept is None:
            write(folder / f"{user}.toml", to_toml(msgspec.to_builtins(identities[user])))
        else:
            identities[user] = kept
    write(folder / _USERS, _dictionary(identities))
    return identities


def draw(fleet: str, users: Iterable[ParticipantId]) -> dict[str, Password]:
    """New passwords for the given users, for world-sim and for observers; they are in memory only."""
    names = (HOST, OBSERVER, *users)
    return {user: Password(fleet, user, secrets.token_urlsafe(24)) for user in names}


def _dictionary(identities: Mapping[str, Password]) -> str:
    """Passwords as the router reads them."""
    return "".join(f"{each.user}:{each.password}\n" for each in identities.values())


@contextmanager
def users_in_memory(identities: Mapping[str, Password]) -> Iterator[Path]:
    """The file of passwords that the router reads, on no disk and for this process only."""
    with os.fdopen(os.memfd_create(_USERS), "w", encoding="utf-8") as file:
        file.write(_dictionary(identities))
        file.flush()
        yield Path(f"/proc/self/fd/{file.fileno()}")


def _kept(path: Path, fleet: str, user: ParticipantId) -> Password | None:
    """The password that a folder has for a user, if any. Raises CredentialsError."""
    if not path.exists():
        return None
    identity = _read(path)
    if isinstance(identity, Certificate):
        raise CredentialsError(
            f"{path}: a certificate; listen on tls/HOST:PORT, or choose another folder for passwords"
        )
    if identity is None:
        raise CredentialsError(f"{path}: not a credentials file; delete it to have it made anew")
    if (identity.fleet, identity.user) != (fleet, user):
        raise CredentialsError(
            f"{path}: credentials of {identity.user} of fleet {identity.fleet}; choose another folder"
        )
    return identity


def users_file(folder: Path) -> Path:
    """The file of passwords that the router reads."""
    return folder / _USERS


def find(place: Path, user: ParticipantId) -> Identity:
    """The identity of a user from a credentials folder, or from its file itself.

    Raises CredentialsError.
    """
    path = place / f"{user}.toml" if place.is_dir() else place
    if not path.exists():
        found = {found.stem for found in place.glob("*.toml")} if place.is_dir() else set()
        known = sorted(found - {AUTHORITY})
        hint = f"known here: {', '.join(known)}" if known else _NONE_HERE
        raise CredentialsError(f"{path}: no credentials for {user}; {hint}")
    identity = _read(path)
    if identity is None:
        raise CredentialsError(f"{path}: not a credentials file; {_ANEW}")
    if identity.user != user:
        raise CredentialsError(f"{path}: credentials of {identity.user}, not of {user}")
    return identity


_NONE_HERE = "start `kantor worldsim` first, or bring what `kantor keys` has made"
_ANEW = "delete it and let world-sim, or `kantor keys --renew`, make it anew"


def _read(path: Path) -> Identity | None:
    tree = _tree(path)
    return _converted(tree, Password) or _converted(tree, Certificate)


def read(path: Path, kind: type[T]) -> T | None:
    """A TOML file as a Struct; None if it is none of this kind."""
    return _converted(_tree(path), kind)


def _tree(path: Path) -> dict[str, Any]:
    try:
        return parse_toml(read_text(path))
    except (UnreadableError, TomlError):
        return {}


def _converted(tree: dict[str, Any], kind: type[T]) -> T | None:
    try:
        return msgspec.convert(tree, kind)
    except (ValueError, RecursionError):
        return None


def to_toml(tree: Mapping[str, Any]) -> str:
    """Texts, times, lists of texts, and tables of tables of these, as TOML."""
    given = {key: value for key, value in tree.items() if value is not None}
    flat = {key: value for key, value in given.items() if not isinstance(value, Mapping)}
    text = "".join(f"{key} = {_value(value)}\n" for key, value in flat.items())
    for key, table in tree.items():
        if isinstance(table, Mapping):
            rows = (f"{_text(row)} = {_value(value)}\n" for row, value in table.items())
            text += f"\n[{key}]\n{''.join(rows)}"
    return text


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_value(item)}' for key, item in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, datetime):
        return value.isoformat()
    if (
        "\n" in value
        and value.isascii()
        and not re.search(r"[\\\"\r\x00-\x09\x0b-\x1f\x7f]", value)
    ):
        return f'"""\n{value}"""'
    return _text(value)


def _text(value: str) -> str:
    """A text in quotes. TOML knows JSON's escapes, except that DEL must be written as one."""
    return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")


def expiry(until: datetime, now: datetime) -> str:
    """The expiry of a certificate, in plain English."""
    when = f"{until:%Y-%m-%d %H:%M} UTC"
    return f"expires on {when}" if until > now else f"expired on {when}"


def write(path: Path, text: str) -> None:
    """Write a file that its owner alone can read, whole or not at all."""
    private_files.replace(path, text.encode())
