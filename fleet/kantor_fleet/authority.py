"""A fleet's private authority: it issues the certificates of its members and keeps the register of them.

Everything is in one folder on the operator's machine: `authority.toml`, which never leaves it, and an identity
file for each member, to be handed to whoever runs it. World-sim's identity carries a copy of the register.

A file is written whole or not at all, the identities first, then the authority's register, then world-sim's copy.
So whatever interrupts this, running it again makes good what is missing.
"""

import fcntl
import ipaddress
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from kantor_protocol.credentials import (
    AUTHORITY,
    FLEET_PATTERN,
    HOST,
    OBSERVER,
    Certificate,
    CredentialsError,
    Member,
    expiry,
    read,
    to_toml,
    write,
)
from kantor_protocol.machine import SUPERVISOR, ParticipantId

ROBOTS_MAX = 1000
DAYS_MAX = 3650
_AUTHORITY_DAYS = 7300
"""How long an authority issues: longer than any certificate of it lasts."""
_EARLIER = timedelta(days=1)
"""Certificates are valid from a day before they are made, for clocks that are behind."""
_HOSTS = ("localhost", "127.0.0.1", "::1", HOST)
"""Names that every world-sim's certificate has."""
_HOST_PATTERN = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(\.(?!-)[A-Za-z0-9-]{1,63})*")


class Authority(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What `authority.toml` holds. certificate, key: PEM."""

    fleet: str
    certificate: str
    key: str
    hosts: tuple[str, ...] = _HOSTS
    revoked: tuple[str, ...] = ()
    members: dict[ParticipantId, Member] = {}


class Wanted(msgspec.Struct, frozen=True):
    """What an operator asks of the authority."""

    fleet: str
    robots: int = 0
    supervisor: bool = False
    hosts: tuple[str, ...] = ()
    days: int = 365
    renew: tuple[ParticipantId, ...] = ()
    revoke: tuple[ParticipantId, ...] = ()


def issue(folder: Path, wanted: Wanted, now: datetime) -> list[str]:
    """Do what is wanted; a line for each thing that was done. Raises CredentialsError, OSError.

    now: with its zone. Members that the register has are kept, whether their files are here or have been
    handed out.
    """
    _check(wanted)
    with _locked(folder):
        before = _open(folder, wanted.fleet)
        authority = before or _found(wanted.fleet, now)
        hosts = tuple(dict.fromkeys((*authority.hosts, *wanted.hosts)))
        users = _users(authority, wanted)
        _check_known(authority, wanted, users)
        withdrawn = [authority.members[user].name for user in wanted.revoke]
        revoked = (*authority.revoked, *withdrawn)
        kept = {
            user: member for user, member in authority.members.items() if user not in wanted.revoke
        }
        fresh = [user for user in users if user not in kept or user in wanted.renew]
        if hosts != authority.hosts and HOST not in fresh:
            fresh.append(HOST)
        host = None if HOST in fresh else _host(folder, wanted.fleet)

        authority = msgspec.structs.replace(authority, hosts=hosts, revoked=revoked)
        if before is None:
            _save(folder / f"{AUTHORITY}.toml", authority)
        made = {user: _certify(authority, user, wanted.days, now) for user in fresh}
        for user, identity in made.items():
            if user != HOST:
                _save(folder / f"{user}.toml", identity)
        members = kept | {user: Member(made[user].name, made[user].until) for user in fresh}
        authority = msgspec.structs.replace(
            authority, members=dict(sorted(members.items(), key=lambda row: _order(row[0])))
        )
        _save(folder / f"{AUTHORITY}.toml", authority)
        host = host or made[HOST]
        copy = msgspec.structs.replace(host, revoked=revoked, members=authority.members)
        if HOST in made or copy != host:
            _save(folder / f"{HOST}.toml", copy)
    return _news(folder, wanted, fresh, changed=HOST in made or copy != host, first=before is None)


def _news(
    folder: Path, wanted: Wanted, fresh: list[ParticipantId], *, changed: bool, first: bool
) -> list[str]:
    lines = (
        [f"{folder}/{AUTHORITY}.toml: the authority of fleet {wanted.fleet}; keep it here"]
        if first
        else []
    )
    lines += [
        f"{folder}/{user}.toml: made, for {wanted.days} days" for user in sorted(fresh, key=_order)
    ]
    lines += [f"{user}: revoked" for user in wanted.revoke if user not in fresh]
    if changed and not first:
        lines.append(f"bring {folder}/{HOST}.toml to world-sim and start it again")
    return lines or ["nothing to do"]


def listing(folder: Path, fleet: str, now: datetime) -> list[str]:
    """A line for each certificate: whose, which, until when, and whether it counts. Raises CredentialsError."""
    authority = _open(folder, fleet)
    if authority is None:
        raise CredentialsError(
            f"{folder}: no {AUTHORITY}.toml; `kantor keys {fleet} --robots 5` makes one"
        )
    rows = [
        (user, member.name, expiry(member.until, now)) for user, member in authority.members.items()
    ]
    rows += [(name.partition(".")[0], name, "revoked") for name in authority.revoked]
    wide = [max(len(row[column]) for row in rows) for column in range(2)]
    return [f"{user:<{wide[0]}}  {name:<{wide[1]}}  {state}" for user, name, state in rows]


def _check(wanted: Wanted) -> None:
    """Raises CredentialsError."""
    if not FLEET_PATTERN.fullmatch(wanted.fleet):
        raise CredentialsError(f"{wanted.fleet}: use lower-case letters, digits and dashes")
    if not 0 <= wanted.robots <= ROBOTS_MAX:
        raise CredentialsError(f"--robots {wanted.robots}: give a number from 0 to {ROBOTS_MAX}")
    if not 1 <= wanted.days <= DAYS_MAX:
        raise CredentialsError(f"--days {wanted.days}: give a number from 1 to {DAYS_MAX}")
    for host in wanted.hosts:
        if not _is_address(host) and not _HOST_PATTERN.fullmatch(host):
            raise CredentialsError(f"--host {host}: give a name or an IP address, without a port")
    both = sorted(set(wanted.renew) & set(wanted.revoke))
    if both:
        raise CredentialsError(
            f"--renew {both[0]} --revoke {both[0]}: renewed, the old one ceases to count"
        )


def _check_known(authority: Authority, wanted: Wanted, users: list[ParticipantId]) -> None:
    """Raises CredentialsError."""
    withdrawn = _withdrawn(authority)
    for user in wanted.revoke:
        if user == HOST:
            raise CredentialsError(
                f"--revoke {HOST}: robots have no register; use --renew and a new folder"
            )
        if user not in authority.members:
            state = "is revoked already" if user in withdrawn else "is not in the register"
            raise CredentialsError(
                f"--revoke {user}: {state}; see `kantor keys {wanted.fleet} --list`"
            )
    for user in wanted.renew:
        if user not in users and user not in authority.members and user not in withdrawn:
            raise CredentialsError(
                f"--renew {user}: is not in the register; see `kantor keys {wanted.fleet} --list`"
            )


def _withdrawn(authority: Authority) -> set[ParticipantId]:
    return {name.partition(".")[0] for name in authority.revoked}


def _users(authority: Authority, wanted: Wanted) -> list[ParticipantId]:
    """Everybody who should have a certificate. Whoever was revoked gets a new one only by its name."""
    robots = [f"r{number}" for number in range(1, wanted.robots + 1)]
    supervisor = [SUPERVISOR] if wanted.supervisor else []
    without = (_withdrawn(authority) - set(authority.members)) | set(wanted.revoke)
    asked = [user for user in (HOST, OBSERVER, *supervisor, *robots) if user not in without]
    return list(dict.fromkeys((*asked, *wanted.renew)))


def _order(user: ParticipantId) -> tuple[bool, int, str]:
    """Robots last, by number."""
    number = user[1:] if user[:1] == "r" else ""
    return (number.isdecimal(), int(number) if number.isdecimal() else 0, user)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One at a time."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _open(folder: Path, fleet: str) -> Authority | None:
    """The folder's authority, or None where there is none and nothing in its place."""
    path = folder / f"{AUTHORITY}.toml"
    if not path.exists():
        others = sorted(found.name for found in folder.glob("*.toml"))
        if others:
            raise CredentialsError(
                f"{folder}: has {others[0]}, but no {AUTHORITY}.toml; choose an empty folder for --out"
            )
        return None
    authority = read(path, Authority)
    if authority is None:
        raise CredentialsError(f"{path}: not an authority, or damaged; choose another --out")
    if authority.fleet != fleet:
        raise CredentialsError(
            f"{path}: the authority of fleet {authority.fleet}; choose another --out"
        )
    return authority


def _host(folder: Path, fleet: str) -> Certificate:
    """World-sim's identity, which the register goes with."""
    path = folder / f"{HOST}.toml"
    host = read(path, Certificate)
    if host is None or host.user != HOST or host.fleet != fleet:
        raise CredentialsError(
            f"{path}: not there or no use, and the register goes with it; bring it back, "
            f"or `kantor keys {fleet} --renew {HOST}`"
        )
    return host


def _save(path: Path, content: Authority | Certificate) -> None:
    write(path, to_toml(msgspec.to_builtins(content, builtin_types=(datetime,))))


def _found(fleet: str, now: datetime) -> Authority:
    """A new authority."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"{fleet}-{secrets.token_hex(4)}")])
    usage = dict.fromkeys(_USAGES, False) | {"key_cert_sign": True, "crl_sign": True}
    certificate = (
        _unsigned(name, key.public_key(), now, now + timedelta(days=_AUTHORITY_DAYS))
        .issuer_name(name)
        .serial_number(x509.random_serial_number())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.KeyUsage(**usage), critical=True)
        .sign(key, hashes.SHA256())
    )
    return Authority(fleet, _pem(certificate), _secret(key))


_USAGES = (
    "digital_signature",
    "content_commitment",
    "key_encipherment",
    "data_encipherment",
    "key_agreement",
    "key_cert_sign",
    "crl_sign",
    "encipher_only",
    "decipher_only",
)


def _certify(authority: Authority, user: ParticipantId, days: int, now: datetime) -> Certificate:
    """A certificate for a member, with a key of its own. Only world-sim's is a server's."""
    key = ec.generate_private_key(ec.SECP256R1())
    issuer = x509.load_pem_x509_certificate(authority.certificate.encode())
    issuer_key = serialization.load_pem_private_key(authority.key.encode(), password=None)
    assert isinstance(issuer_key, ec.EllipticCurvePrivateKey)
    until = min(now + timedelta(days=days), issuer.not_valid_after_utc).replace(microsecond=0)
    if until <= now:
        raise CredentialsError(
            f"{AUTHORITY}.toml: has expired; make a new fleet with another --out"
        )
    serial = secrets.randbits(64) | 1
    common_name = f"{user}.{serial:016x}"
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if user == HOST:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    usage = dict.fromkeys(_USAGES, False) | {"digital_signature": True}
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
    unsigned = (
        _unsigned(subject, key.public_key(), now, until)
        .issuer_name(issuer.subject)
        .serial_number(serial)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.KeyUsage(**usage), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key()),
            critical=False,
        )
    )
    if user == HOST:
        names = x509.SubjectAlternativeName(_general_names(authority.hosts))
        unsigned = unsigned.add_extension(names, critical=False)
    certificate = unsigned.sign(issuer_key, hashes.SHA256())
    return Certificate(
        authority.fleet,
        user,
        common_name,
        until,
        authority.certificate,
        _pem(certificate),
        _secret(key),
    )


def _unsigned(
    subject: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime, until: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .public_key(key)
        .not_valid_before(now - _EARLIER)
        .not_valid_after(until)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _general_names(hosts: Iterable[str]) -> list[x509.GeneralName]:
    return [
        x509.IPAddress(ipaddress.ip_address(host)) if _is_address(host) else x509.DNSName(host)
        for host in hosts
    ]


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def _pem(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(serialization.Encoding.PEM).decode()


def _secret(key: ec.EllipticCurvePrivateKey) -> str:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    ).decode()


def today() -> datetime:
    """Now, with its zone."""
    return datetime.now(UTC)
