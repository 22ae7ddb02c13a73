"""The bus: the only file that knows Zenoh.

World-sim is the router; every other process is a client of it, with an identity of its own: a password on
`tcp/HOST:PORT`, a certificate on `tls/HOST:PORT`, where both sides prove who they are. Access control makes world-sim the
only way from one participant to another: a participant may put on its own keys and read its own `rx`, nothing else. The traps that the settings below avoid are in
protocol/README.md.

A callback only enqueues; all work is done by whoever calls `next`. No queue grows without bound: what a
slow reader has no room for is lost, as on any link.

A client connects again by itself when world-sim comes back: its token and its subscription are declared
anew, so that world-sim sees it join with the nonce that it had.
"""

import contextlib
import json
import os
import queue
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import zenoh

from kantor_protocol import keys, settings, tls
from kantor_protocol.credentials import (
    OBSERVER,
    Certificate,
    CredentialsError,
    Identity,
    Password,
)
from kantor_protocol.machine import WORLD_SIM, ParticipantId
from kantor_protocol.quota import Bucket, Excess, Quota, excesses

LEASE_MS = settings.LEASE_MS
QUEUE_MAX = 16_384
"""Messages that wait for a reader."""
_CLOSE_S = 5.0


class BusError(ConnectionError):
    """The bus cannot be reached or refuses us; the message is one line with the remedy."""


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


class _Router:
    """A router's session, which tells what happens on the bus."""

    _session: zenoh.Session
    _held: list[Any]

    def __init__(self) -> None:
        """No session yet."""
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._door: _Door | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def next(self, timeout_s: float) -> Event | None:
        """The next event, or None after the timeout."""
        try:
            return self._events.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            return None

    def close(self) -> None:
        """Leave the bus."""
        if self._door is not None:
            self._door.close()
        _close(self._session, self._held)


class Host(_Router):
    """World-sim's end of the bus: the router, with access control."""

    def __init__(
        self,
        identity: Identity,
        listen: str,
        users_file: Path | None,
        roster: tuple[ParticipantId, ...],
        say: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """listen: an endpoint such as `tcp/127.0.0.1:7447`. users_file: of passwords, for an identity that is one.

        say: takes a line on whoever shows a certificate of the fleet's authority and is not let in; called
        from a thread. Raises BusError if the endpoint cannot be had, CredentialsError if it is not of the
        identity's kind.
        """
        super().__init__()
        check_endpoint(listen, identity)
        fleet = identity.fleet
        known = settings.hub(identity, roster, users_file)
        self._fleet = fleet
        self._listening = threading.Lock()
        self._buckets = {name: Bucket(Quota.of(0.0)) for name in roster}
        try:
            self._session = _open("router", known, listen=listen)
        except zenoh.ZError as error:
            raise BusError(f"cannot listen on {listen}: {_short(error)}; choose another") from None
        self._block = zenoh.CongestionControl.BLOCK
        self._drop = zenoh.CongestionControl.DROP
        self._rx = {name: keys.rx(fleet, name) for name in roster}
        self._progress = keys.progress(fleet)
        if isinstance(identity, Certificate):
            wanted = (*roster, *identity.sites, OBSERVER)
            self._door = _Door(self._session, identity, wanted, say)
        self._held: list[Any] = [
            self._session.declare_subscriber(keys.tx(fleet), self._on_message),
            self._session.liveliness().declare_subscriber(
                keys.alive(fleet), self._on_token, history=True
            ),
        ]

    def send(self, name: ParticipantId, payload: bytes, *, patiently: bool) -> None:
        """Put on a participant's `rx`. patiently: wait for a full queue, up to 0.2 s, rather than drop."""
        congestion = self._block if patiently else self._drop
        if patiently:  # what may be lost is news, and news asks for nothing
            self._buckets[name].ask()
        self._session.put(self._rx[name], payload, congestion_control=congestion, express=True)

    def limit(self, quotas: Mapping[ParticipantId, Quota]) -> None:
        """How much to take in of what each says; before that, little more than answers."""
        for name, quota in quotas.items():
            self._buckets[name].quota = quota

    @property
    def excess(self) -> dict[ParticipantId, Excess]:
        """What was beyond the quotas."""
        return excesses(self._buckets.items())

    def publish_progress(self, payload: bytes) -> None:
        """Tell observers how the mission goes."""
        self._session.put(self._progress, payload, congestion_control=self._drop)

    def _on_message(self, sample: zenoh.Sample) -> None:
        key = keys.parse(str(sample.key_expr))
        if key is None or not self._listens(key.name, len(sample.payload)):
            return
        if self._events.qsize() < QUEUE_MAX:
            self._events.put(Heard(key.name, sample.payload.to_bytes()))

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = keys.parse(str(sample.key_expr))
        if key is None:
            return
        if sample.kind == zenoh.SampleKind.DELETE:
            self._events.put(Left(key.name, key.nonce))
        elif self._listens(key.name, len(key.nonce)):
            self._events.put(Joined(key.name, key.nonce))

    def _listens(self, name: ParticipantId, size: int) -> bool:
        """Whether something that a participant says is within its quota."""
        bucket = self._buckets.get(name)
        if bucket is None:
            return False
        with self._listening:  # messages and tokens come in different threads
            flooded = bucket.floods
            taken = bucket.take(size, time.monotonic())
            if bucket.floods and not flooded:
                self._events.put(Flooded(name))
            return taken


class _Door:
    """Tells whoever shows a certificate of the fleet's authority, and is not let in, why; and the host's log too.

    For TLS such a certificate is sound, and Zenoh silently passes nothing of its holder's on.
    """

    def __init__(
        self,
        session: zenoh.Session,
        identity: Certificate,
        wanted: Iterable[ParticipantId],
        say: Callable[[str], None],
    ) -> None:
        self._identity = identity
        self._wanted = frozenset(wanted)
        self._refusals = tls.Refusals(say)
        self._held: list[Any] = [
            session.declare_queryable(keys.door(identity.fleet), self._on_question),
            session.info.declare_link_events_listener(self._on_link),
        ]

    def close(self) -> None:
        """Tell what has not been told."""
        self._held.clear()
        self._refusals.close()

    def _objection(self, name: str) -> str:
        return self._identity.objection(name, self._wanted)

    def _on_question(self, query: zenoh.Query) -> None:
        name = str(query.key_expr).rpartition("/")[2]
        query.reply(keys.door(self._identity.fleet, name), self._objection(name).encode())

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        name = event.link.auth_identifier
        if event.kind == zenoh.SampleKind.PUT and name and (objection := self._objection(name)):
            self._refusals.tell(f"refused {name.partition('.')[0]}: {objection}")


class Site(_Router):
    """A router of a place: its robots connect to it, and it connects to world-sim's.

    What each robot may do is enforced here, what all of them may do at world-sim. It connects again by itself;
    without it its robots have left.
    """

    def __init__(
        self,
        identity: Certificate,
        connect: str,
        listen: str,
        patience_s: float,
        say: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """Wait for world-sim up to `patience_s`, then listen. say: see Host. Raises BusError, CredentialsError."""
        super().__init__()
        check_endpoint(listen, identity)
        fleet = identity.fleet
        self.members = tuple(name for name in identity.members if name != WORLD_SIM)
        """Its robots."""
        _check_free(listen)
        _close(_client(connect, identity, patience_s), [])  # which is told why, if it is not let in
        own = settings.site(identity, self.members)
        try:
            self._session = _open("router", own, connect=connect, listen=listen)
        except zenoh.ZError as error:
            raise BusError(f"cannot connect {listen} to {connect}: {_short(error)}") from None
        self._door = _Door(self._session, identity, (*self.members, WORLD_SIM), say)
        self._held: list[Any] = [
            self._session.liveliness().declare_subscriber(
                keys.alive(fleet), self._on_token, history=True
            ),
        ]

    @property
    def connected(self) -> bool:
        """Whether world-sim is there."""
        return bool(self._session.info.routers_zid())

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = keys.parse(str(sample.key_expr))
        if key is not None:
            kind = Joined if sample.kind == zenoh.SampleKind.PUT else Left
            self._events.put(kind(key.name, key.nonce))


class Line:
    """A participant's end of the bus: a client of world-sim."""

    def __init__(self, session: zenoh.Session, identity: Identity, nonce: str) -> None:
        """Use `line` to open one."""
        fleet, name = identity.fleet, identity.user
        self.nonce = nonce
        self._session = session
        self._received: queue.SimpleQueue[bytes | BusError] = queue.SimpleQueue()
        self._identity = identity
        self._block = zenoh.CongestionControl.BLOCK
        self._drop = zenoh.CongestionControl.DROP
        self._tx, self._pose = keys.tx(fleet, name), keys.pose(fleet, name)
        self._weights = keys.weights(fleet, name)
        self._held: list[Any] = [
            session.declare_subscriber(keys.rx(fleet, name), self._on_message),
            session.liveliness().declare_token(keys.alive(fleet, name, nonce)),
        ]
        if isinstance(identity, Certificate):
            self._held.append(session.info.declare_transport_events_listener(self._on_transport))

    def next(self, timeout_s: float | None) -> bytes | None:
        """The next message from world-sim, or None after the timeout.

        Raises BusError if world-sim was started again and does not let us in any more.
        """
        try:
            got = self._received.get(timeout=None if timeout_s is None else max(0.0, timeout_s))
        except queue.Empty:
            return None
        if isinstance(got, BusError):
            raise got
        return got

    def send(self, payload: bytes, *, patiently: bool) -> None:
        """Put on the own `tx`. patiently: wait for a full queue rather than drop."""
        congestion = self._block if patiently else self._drop
        self._session.put(self._tx, payload, congestion_control=congestion, express=True)

    def publish_pose(self, payload: bytes) -> None:
        """Tell observers the own pose."""
        self._session.put(self._pose, payload)

    def publish_weights(self, payload: bytes) -> None:
        """Tell observers the own weight vector."""
        self._session.put(self._weights, payload)

    def close(self) -> None:
        """Leave the bus."""
        _close(self._session, self._held)

    def _on_message(self, sample: zenoh.Sample) -> None:
        if self._received.qsize() < QUEUE_MAX:
            self._received.put(sample.payload.to_bytes())

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        """We are connected again: perhaps to a world-sim with another register."""
        assert isinstance(self._identity, Certificate)
        with contextlib.suppress(zenoh.ZError):  # it is closed meanwhile
            if event.kind == zenoh.SampleKind.PUT and (
                objection := _answer_at_door(self._session, self._identity)
            ):
                self._received.put(BusError(f"refuses {self._identity.user}: {objection}"))


class Watch:
    """An observer's end of the bus: reads, never writes."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        """Use `watch` to open one."""
        self._session = session
        self._received: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        self._held: list[Any] = [session.declare_subscriber(key, self._on_message)]

    def next(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The next message as (key, payload), or None after the timeout."""
        try:
            return self._received.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            return None

    def close(self) -> None:
        """Leave the bus."""
        _close(self._session, self._held)

    def _on_message(self, sample: zenoh.Sample) -> None:
        if self._received.qsize() < QUEUE_MAX:
            self._received.put((str(sample.key_expr), sample.payload.to_bytes()))


@contextlib.contextmanager
def line(connect: str, identity: Identity, nonce: str, patience_s: float) -> Iterator[Line]:
    """Join world-sim's bus as a participant, waiting for it up to `patience_s`. Raises BusError."""
    opened = Line(_client(connect, identity, patience_s), identity, nonce)
    try:
        yield opened
    finally:
        opened.close()


@contextlib.contextmanager
def watch(connect: str, identity: Identity, key: str, patience_s: float) -> Iterator[Watch]:
    """Join world-sim's bus as an observer of the keys that match. Raises BusError."""
    opened = Watch(_client(connect, identity, patience_s), key)
    try:
        yield opened
    finally:
        opened.close()


def free_endpoint(protocol: str = "tcp") -> str:
    """A loopback endpoint that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


def await_endpoint(
    connect: str,
    patience_s: float,
    identity: Identity | None = None,
    monotonic: Callable[[], float] = time.monotonic,
) -> None:
    """Return once something accepts connections there.

    identity: if it is a certificate, also shake hands with it, which is worth an objection in words. Raises
    BusError after `patience_s`, and at once if either side objects.
    """
    _, host, port = _address(connect)
    give_up = monotonic() + patience_s
    pause_s = 0.02
    while True:
        try:
            objection = _look_in(host, port, identity)
        except socket.gaierror:
            raise BusError(f"{connect}: no such host; check --connect") from None
        except OSError:
            if monotonic() >= give_up:
                raise BusError(
                    f"{connect}: nothing listens there after {patience_s:g} s; "
                    f"start `kantor worldsim` or check --connect"
                ) from None
        else:
            if objection:
                raise BusError(f"{connect}: {objection}")
            return
        time.sleep(pause_s)
        pause_s = min(0.2, 1.5 * pause_s)


def _look_in(host: str, port: int, identity: Identity | None) -> str:
    """What world-sim or we have against each other. Raises OSError if nothing listens there."""
    if isinstance(identity, Certificate):
        return tls.objection(host, port, identity)
    socket.create_connection((host, port), timeout=1.0).close()
    return ""


def _address(endpoint: str) -> tuple[str, str, int]:
    protocol, _, place = endpoint.partition("/")
    host, _, port = place.rpartition(":")
    sound = protocol in {"tcp", "tls"} and host and port.isdecimal() and port.isascii()
    if not sound or int(port) > 65535:
        raise BusError(f"{endpoint}: not an endpoint; write it as tcp/HOST:PORT or tls/HOST:PORT")
    return protocol, host.strip("[]"), int(port)


def is_tls(endpoint: str) -> bool:
    """Whether an endpoint is for certificates. Raises BusError if it is none."""
    return _address(endpoint)[0] == "tls"


def check_endpoint(endpoint: str, identity: Identity | None = None) -> None:
    """Raise BusError unless it reads tcp/HOST:PORT or tls/HOST:PORT.

    identity: raise CredentialsError unless it is of the kind that the endpoint is for.
    """
    protocol, _, place = endpoint.partition("/")
    if is_tls(endpoint) and isinstance(identity, Password):
        raise CredentialsError(
            f"{endpoint}: {identity.user} has a password, and tls takes certificates; "
            f"make them with `kantor keys`, or use tcp/{place}"
        )
    if protocol == "tcp" and isinstance(identity, Certificate):
        raise CredentialsError(
            f"{endpoint}: {identity.user} has a certificate, and tcp takes passwords; use tls/{place}"
        )


def _check_free(listen: str) -> None:
    """Raise BusError if somebody else listens there."""
    _, host, port = _address(listen)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            reason = error.strerror or error
            raise BusError(f"cannot listen on {listen}: {reason}; choose another") from None


def _client(connect: str, identity: Identity, patience_s: float) -> zenoh.Session:
    check_endpoint(connect, identity)
    await_endpoint(connect, patience_s, identity)
    try:
        session = _open("client", settings.client(identity), connect=connect)
    except zenoh.ZError:
        await_endpoint(connect, 0.0, identity)  # which may have changed since
        raise BusError(
            f"{connect}: refuses {identity.user}; its credentials are not this world-sim's"
        ) from None
    if isinstance(identity, Certificate):
        try:
            _knock(connect, session, identity)
        except BusError:
            _close(session, [])
            raise
    return session


def _knock(connect: str, session: zenoh.Session, identity: Certificate) -> None:
    """Ask whether we are let in: a certificate may be sound and yet not the register's. Raises BusError."""
    objection = _answer_at_door(session, identity)
    if objection is None:
        raise BusError(
            f"{connect}: no world-sim of fleet {identity.fleet} answers; check --connect"
        )
    if objection:
        raise BusError(f"{connect}: refuses {identity.user}: {objection}")


def _answer_at_door(session: zenoh.Session, identity: Certificate) -> str | None:
    """What the router has against us; None if nobody answers. One that has just been opened may take a moment."""
    give_up = time.monotonic() + settings.HANDSHAKE_S
    while time.monotonic() < give_up:
        for reply in session.get(keys.door(identity.fleet, identity.name), timeout=1.0):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes().decode(errors="replace")
        time.sleep(0.02)
    return None


def _open(
    mode: str,
    own: settings.Settings,
    *,
    connect: str | None = None,
    listen: str | None = None,
) -> zenoh.Session:
    """Raises zenoh.ZError."""
    config = zenoh.Config()
    for key, value in (settings.everywhere(mode, connect, listen) | own).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _close(session: zenoh.Session, held: list[Any]) -> None:
    """Close without ever hanging: a close may block when the other side is gone."""
    held.clear()

    def close() -> None:
        with contextlib.suppress(zenoh.ZError):
            session.close()  # type: ignore[no-untyped-call]

    closing = threading.Thread(target=close, daemon=True)
    closing.start()
    closing.join(_CLOSE_S)


def _short(error: Exception) -> str:
    return str(error).splitlines()[0].partition(" at ")[0][:200]


def init_log() -> None:
    """Zenoh's own log: silent, since kantor tells what a user can mend, unless RUST_LOG says more."""
    zenoh.init_log_from_env_or("off")


@contextlib.contextmanager
def host_log(identity: Identity, say: Callable[[str], None]) -> Iterator[None]:
    """`init_log` for a host; with certificates, also a line on whoever comes without a sound one.

    Zenoh tells of them in its log alone (zenoh#2712), without an address and with a misleading hint, and its log
    goes to standard output. In here its lines are read instead, while our own output goes on where it went.
    say: called from a thread.
    """
    if isinstance(identity, Password) or "RUST_LOG" in os.environ:
        init_log()
        yield
        return
    refusals = tls.Refusals(say)
    sys.stdout.flush()
    usual = sys.stdout
    reading, writing = os.pipe()
    kept = os.dup(1)
    os.dup2(writing, 1)
    os.close(writing)
    sys.stdout = os.fdopen(os.dup(kept), "w", encoding="utf-8", errors="replace", buffering=1)
    zenoh.init_log_from_env_or("zenoh_link_tls=warn")

    def read() -> None:
        with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
            for line in lines:
                if reason := tls.logged_reason(line):
                    refusals.tell(reason)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield
    finally:
        os.dup2(kept, 1)  # closes the pipe, unless somebody else holds it
        os.close(kept)
        reader.join(_CLOSE_S)
        refusals.close()
        sys.stdout.flush()
        sys.stdout.close()
        sys.stdout = usual
