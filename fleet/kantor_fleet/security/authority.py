"""A fleet's private authority: it issues the certificates of its members and keeps the member list.

Everything is in one folder on the operator's machine: `authority.toml`, which never leaves it, and an identity
file for each member, to be brought to the machine of that member. The identities of routers, world-sim's and those
of sites, carry a copy of the member list (error messages call it the register).

A file is written in one step or not at all: the identities first, then the authority's member list, then the
routers' copies. After any interruption, running the command again completes what is missing.
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
from typing import Any

import msgspec
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from kantor_protocol.base.machine import SUPERVISOR, ParticipantId
from kantor_protocol.transport.credentials import (
    AUTHORITY,
    FLEET_PATTERN,
    HOST,
    OBSERVER,
    Certificate,
    CredentialsError,
    Member,
    expiry,
    public_key,
    read,
    to_toml,
    write,
)

ROBOTS_MAX = 1000
DAYS_MAX = 3650
_AUTHORITY_DAYS = 7300
"""Validity of an authority's own certificate: longer than that of any certificate it issues."""
_EARLIER = timedelta(days=1)
"""Certificates are valid from a day before they are made, for clocks that are behind."""
_HOSTS = ("localhost", "127.0.0.1", "::1")
"""Names that every router's certificate has, beside its id."""
_SITE = "site-"
"""The prefix of the id of a site's router."""
_SITE_PATTERN = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")
_ROBOT_PATTERN = re.compile(r"r[1-9][0-9]{0,3}")
_HOST_PATTERN = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(\.(?!-)[A-Za-z0-9-]{1,63})*")


Sites = dict[ParticipantId, tuple[ParticipantId, ...]]


class Authority(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of `authority.toml`. certificate, key: PEM."""

    fleet: str
    certificate: str
    key: str
    revoked: tuple[str, ...] = ()
    members: dict[ParticipantId, Member] = {}
    sites: Sites = {}
    hosts: dict[ParticipantId, tuple[str, ...]] = {}
    """Names by which others reach a router, in addition to `_HOSTS` and its id."""

    def member_list(self, router: ParticipantId) -> dict[str, Any]:
        """The fields of a router's identity by which it admits members."""
        if router == HOST:
            return {"revoked": self.revoked, "members": self.members, "sites": self.sites}
        names = (HOST, *self.sites.get(router, ()))
        members = {user: self.members[user] for user in names if user in self.members}
        revoked = tuple(name for name in self.revoked if name.partition(".")[0] in names)
        return {"revoked": revoked, "members": members}


class Wanted(msgspec.Struct, frozen=True):
    """A request of the operator to the authority."""

    fleet: str
    robots: int = 0
    supervisor: bool = False
    hosts: tuple[str, ...] = ()
    """World-sim's names, or a site's as SITE=NAME."""
    sites: tuple[str, ...] = ()
    """SITE=ROBOT,ROBOT,..."""
    days: int = 365
    renew: tuple[ParticipantId, ...] = ()
    revoke: tuple[ParticipantId, ...] = ()


def issue(folder: Path, wanted: Wanted, now: datetime) -> list[str]:
    """Carry out a request; a line for each change. Raises CredentialsError, OSError.

    now: with its time zone. Members on the list are kept, whether their files are here or on their machines.
    """
    _check(wanted)
    with _locked(folder):
        before = _open(folder, wanted.fleet)
        authority = _updated(before or _new_authority(wanted.fleet, now), wanted)
        fresh = _fresh(before, authority, wanted)
        made = {user: _certify(authority, user, wanted.days, now) for user in fresh}
        moved = _moved(folder, authority, made)
        issued = {user: _member(identity) for user, identity in made.items()}
        listed = _with_keys(folder, authority) | issued
        members = dict(sorted(listed.items(), key=lambda row: _sort_key(row[0])))
        authority = msgspec.structs.replace(authority, members=members)
        routers = _routers(folder, before, authority, made)

        if before is None:  # first: without it, what it has signed cannot be used
            _save(folder / f"{AUTHORITY}.toml", msgspec.structs.replace(authority, members={}))
        for user, identity in made.items():
            if user not in routers:
                _save(folder / f"{user}.toml", identity)
        _save(folder / f"{AUTHORITY}.toml", authority)
        for user, identity in (routers | moved).items():
            _save(folder / f"{user}.toml", identity)
    changed = [] if before is None else [*routers, *moved]
    return _changes(folder, wanted, fresh, changed, first=before is None)


def _member(identity: Certificate) -> Member:
    """The entry of the member list for a certificate."""
    return Member(identity.name, identity.until, public_key(identity).hex())


def _with_keys(folder: Path, authority: Authority) -> dict[ParticipantId, Member]:
    """The member list; keys that it lacks, since it was of an older version, from the identities in the folder."""
    members = dict(authority.members)
    for user, member in authority.members.items():
        identity = None if member.key else read(folder / f"{user}.toml", Certificate)
        if identity is not None and identity.name == member.name:
            members[user] = _member(identity)
    return members


def _moved(
    folder: Path, authority: Authority, made: dict[ParticipantId, Certificate]
) -> dict[ParticipantId, Certificate]:
    """The identities of robots in the folder that are behind another site than their files say."""
    changed = {}
    for user in authority.members:
        old = None if user in made else read(folder / f"{user}.toml", Certificate)
        if old is not None and old.site is not None and old.site != _site_of(authority, user):
            changed[user] = msgspec.structs.replace(old, site=_site_of(authority, user))
    return changed


def _site_of(authority: Authority, user: ParticipantId) -> ParticipantId:
    """The site that a robot is behind; empty for all others."""
    return next((site for site, there in authority.sites.items() if user in there), "")


def _updated(authority: Authority, wanted: Wanted) -> Authority:
    """The authority without revoked members, and with the sites and names of the request.

    Raises CredentialsError.
    """
    _check_known(authority, wanted)
    withdrawn = tuple(authority.members[user].name for user in wanted.revoke)
    placed = _placements(wanted)
    moved = {name for there in placed.values() for name in there}
    sites = {
        site: tuple(name for name in there if name not in moved)
        for site, there in authority.sites.items()
        if site not in wanted.revoke
    } | placed
    hosts = dict(authority.hosts)
    for user, host in map(_host_of, wanted.hosts):
        if user != HOST and user not in sites:
            site = user.removeprefix(_SITE)
            raise CredentialsError(f"--host {site}={host}: no such site; add --site {site}=r1,r2")
        hosts[user] = tuple(dict.fromkeys((*hosts.get(user, ()), host)))
    return msgspec.structs.replace(
        authority,
        revoked=(*authority.revoked, *withdrawn),
        members={
            user: member for user, member in authority.members.items() if user not in wanted.revoke
        },
        sites=sites,
        hosts={user: names for user, names in hosts.items() if user not in wanted.revoke},
    )


def _fresh(before: Authority | None, authority: Authority, wanted: Wanted) -> list[ParticipantId]:
    """The members that get a new certificate; a revoked member only if it is named. Raises CredentialsError."""
    robots = [f"r{number}" for number in range(1, wanted.robots + 1)]
    supervisor = [SUPERVISOR] if wanted.supervisor else []
    users = (HOST, OBSERVER, *authority.sites, *supervisor, *robots)
    named = {*_placements(wanted), *wanted.renew}
    without = (_withdrawn(authority) - named) | set(authority.members)
    renamed = [
        user
        for user in authority.hosts
        if before and authority.hosts[user] != before.hosts.get(user)
    ]
    missing = [user for user in users if user not in without]
    fresh = sorted({*missing, *renamed, *wanted.renew}, key=_sort_key)
    for site, there in authority.sites.items():
        for name in there:
            if name not in {*authority.members, *fresh, *_withdrawn(authority)}:
                label = f"--site {site.removeprefix(_SITE)}"
                raise CredentialsError(
                    f"{label}: the register has no {name}; add --robots {name[1:]}"
                )
    return fresh


def _routers(
    folder: Path,
    before: Authority | None,
    authority: Authority,
    made: dict[ParticipantId, Certificate],
) -> dict[ParticipantId, Certificate]:
    """The identities of routers that must be written, each with its copy of the member list.

    Raises CredentialsError if one of them is not in the folder.
    """
    changed = {}
    for router in (HOST, *authority.sites):
        path = folder / f"{router}.toml"
        old = made.get(router) or read(path, Certificate)
        if old is None or old.name != authority.members[router].name:
            same = before is not None and before.member_list(router) == authority.member_list(
                router
            )
            if same and not path.exists():
                continue  # it is on its machine
            raise CredentialsError(
                f"{path}: missing or not usable, and it carries the register; bring it back, "
                f"or `kantor keys {authority.fleet} --renew {router}`"
            )
        new = msgspec.structs.replace(old, **authority.member_list(router))
        if router in made or new != old:
            changed[router] = new
    return changed


def _changes(
    folder: Path,
    wanted: Wanted,
    fresh: list[ParticipantId],
    routers: list[ParticipantId],
    *,
    first: bool,
) -> list[str]:
    lines = (
        [f"{folder}/{AUTHORITY}.toml: the authority of fleet {wanted.fleet}; keep it here"]
        if first
        else []
    )
    lines += [f"{folder}/{user}.toml: made, for {wanted.days} days" for user in fresh]
    lines += [f"{user}: revoked" for user in wanted.revoke]
    lines += [f"{folder}/{user}.toml: changed; start {user} again with it" for user in routers]
    return lines or ["nothing to do"]


def listing(folder: Path, fleet: str, now: datetime) -> list[str]:
    """A line for each certificate: member, name, and expiry or revocation. Raises CredentialsError."""
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
    """Check the form of a request. Raises CredentialsError."""
    if not FLEET_PATTERN.fullmatch(wanted.fleet):
        raise CredentialsError(f"{wanted.fleet}: use lower-case letters, digits and dashes")
    if not 0 <= wanted.robots <= ROBOTS_MAX:
        raise CredentialsError(f"--robots {wanted.robots}: give a number from 0 to {ROBOTS_MAX}")
    if not 1 <= wanted.days <= DAYS_MAX:
        raise CredentialsError(f"--days {wanted.days}: give a number from 1 to {DAYS_MAX}")
    for _, host in map(_host_of, wanted.hosts):
        if not _is_address(host) and not _HOST_PATTERN.fullmatch(host):
            raise CredentialsError(f"--host {host}: give a name or an IP address, without a port")
    _placements(wanted)
    both = sorted(set(wanted.renew) & set(wanted.revoke))
    if both:
        raise CredentialsError(
            f"--renew {both[0]} --revoke {both[0]}: a renewal revokes the old one already"
        )


def _host_of(text: str) -> tuple[ParticipantId, str]:
    """The router and the name in NAME, which is world-sim's, or SITE=NAME."""
    site, equals, host = text.rpartition("=")
    return (f"{_SITE}{site}" if equals else HOST), host


def _placements(wanted: Wanted) -> Sites:
    """The robots of each site in the request. Raises CredentialsError."""
    placed: Sites = {}
    for text in wanted.sites:
        site, _, names = text.partition("=")
        there = tuple(names.split(","))
        if not _SITE_PATTERN.fullmatch(site) or not all(map(_ROBOT_PATTERN.fullmatch, there)):
            raise CredentialsError(f"--site {text}: write it as --site north=r1,r2")
        placed[f"{_SITE}{site}"] = there
    robots = [name for there in placed.values() for name in there]
    for name in robots:
        if robots.count(name) > 1:
            raise CredentialsError(f"--site: {name} can be behind one site only")
    return placed


def _check_known(authority: Authority, wanted: Wanted) -> None:
    """Check that the named members exist. Raises CredentialsError."""
    withdrawn, see = _withdrawn(authority), f"see `kantor keys {wanted.fleet} --list`"
    for user in wanted.revoke:
        if user == HOST:
            raise CredentialsError(f"--revoke {HOST}: robots know no register; make a new fleet")
        if user not in authority.members:
            state = "is revoked already" if user in withdrawn else "is not in the register"
            raise CredentialsError(f"--revoke {user}: {state}; {see}")
    for user in wanted.renew:
        if user.startswith(_SITE) and user not in authority.sites | _placements(wanted):
            raise CredentialsError(f"--renew {user}: no such site; {see}")
        if user not in authority.members and user not in withdrawn:
            raise CredentialsError(f"--renew {user}: is not in the register; {see}")


def _withdrawn(authority: Authority) -> set[ParticipantId]:
    """Members whose certificate was revoked without a new one since."""
    return {name.partition(".")[0] for name in authority.revoked} - set(authority.members)


def _sort_key(user: ParticipantId) -> tuple[bool, int, str]:
    """The sorting key of members: robots last, by number."""
    number = user[1:] if user[:1] == "r" else ""
    return (number.isdecimal(), int(number) if number.isdecimal() else 0, user)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder: one command works in it at a time."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _open(folder: Path, fleet: str) -> Authority | None:
    """The authority in a folder; None if the folder has no TOML file. Raises CredentialsError."""
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


def _save(path: Path, content: Authority | Certificate) -> None:
    write(path, to_toml(msgspec.to_builtins(content, builtin_types=(datetime,))))


def _new_authority(fleet: str, now: datetime) -> Authority:
    """A new authority with a key of its own."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name(
        [x509.NameAttribute(NameOID.COMMON_NAME, f"{fleet[:48]}-{secrets.token_hex(4)}")]
    )
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
    """Issue a certificate for a member, with a key of its own; those of routers are for servers too."""
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
    purposes, is_router = [ExtendedKeyUsageOID.CLIENT_AUTH], user == HOST or user in authority.sites
    if is_router:
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
    if is_router:
        hosts = dict.fromkeys((*_HOSTS, user, *authority.hosts.get(user, ())))
        names = x509.SubjectAlternativeName(_general_names(hosts))
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
        site=_site_of(authority, user),
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
    """The time now, with its time zone."""
    return datetime.now(UTC)
