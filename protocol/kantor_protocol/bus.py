"""The bus: the only file that knows Zenoh.

World-sim is the router; every other process is a client of it, with an identity of its own: a password on
`tcp/HOST:PORT`, a certificate on `tls/HOST:PORT`, where both sides prove who they are. Access control makes world-sim the only way from one participant to another: a participant may put on its own
keys and read its own `rx`, nothing else. The traps that the settings below avoid are in
protocol/README.md.

A callback only enqueues; all work is done by whoever calls `next`. No queue grows without bound: what a
slow reader has no room for is lost, as on any link.

A client connects again by itself when world-sim comes back: its token and its subscription are declared
anew, so that world-sim sees it join with the nonce that it had.
"""

import base64
import contextlib
import json
import os
import queue
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import zenoh

from kantor_protocol import keys, tls
from kantor_protocol.credentials import (
    OBSERVER,
    Certificate,
    CredentialsError,
    Identity,
    Password,
)
from kantor_protocol.machine import ParticipantId
from kantor_protocol.messages import MESSAGE_BYTES_MAX
from kantor_protocol.quota import Bucket, Excess, Quota, excesses

LEASE_MS = 1000
"""A frozen or cut-off process is noticed after this."""
QUEUE_MAX = 16_384
"""Messages that wait for a reader."""
POSE_BYTES_MAX = 256
SHOWN_PER_S = 1000
"""Messages on a pose key, and on a weights key, that reach observers. A pose is outdated by the next, and
weights have keyframes."""
_RECEIVE_BYTES = 32 * 1024
_FRAME_BYTES = 64 * 1024
_HANDSHAKE_S = 3.0
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


class Host:
    """World-sim's end of the bus: the router, with access control."""

    def __init__(
        self,
        identity: Identity,
        listen: str,
        users_file: Path,
        roster: tuple[ParticipantId, ...],
        say: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """listen: an endpoint such as `tcp/127.0.0.1:7447`. users_file: of passwords, for an identity that is one.

        say: takes a line on whoever shows a certificate of the fleet's authority and is not let in; called
        from a thread. Raises BusError if the endpoint cannot be had, CredentialsError if it is not of the
        identity's kind.
        """
        check_endpoint(listen, identity)
        fleet = identity.fleet
        settings = {
            "scouting/delay": 0,
            "open/return_conditions": {"connect_scouted": False, "declares": False},
            # A frozen client must not hold the router for long (the unit is microseconds).
            "transport/link/tx/queue/congestion_control/block/wait_before_close": 200_000,
            **_proof(identity, "listen", users_file),
            # A flood reaches the router in small portions, so that the others' turn comes between them.
            "transport/link/tcp/so_rcvbuf": _RECEIVE_BYTES,
            "transport/link/tls/so_rcvbuf": _RECEIVE_BYTES,
            # Longer ones are not put together. Without this a robot could have a gigabyte waiting.
            "transport/link/rx/max_message_size": MESSAGE_BYTES_MAX + _FRAME_BYTES,
            "access_control": _access(fleet, _subjects(identity, (*roster, OBSERVER))),
            "low_pass_filter": [
                _low_pass("all", keys.everything(fleet), MESSAGE_BYTES_MAX),
                _low_pass("pose", keys.pose(fleet, "*"), POSE_BYTES_MAX),
            ],
            "downsampling": _downsampling(fleet, roster),
        }
        self._fleet = fleet
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._listening = threading.Lock()
        self._buckets = {name: Bucket(Quota.of(0.0)) for name in roster}
        try:
            self._session = zenoh.open(_config("router", listen=listen, settings=settings))
        except zenoh.ZError as error:
            raise BusError(f"cannot listen on {listen}: {_short(error)}; choose another") from None
        self._block = zenoh.CongestionControl.BLOCK
        self._drop = zenoh.CongestionControl.DROP
        self._rx = {name: keys.rx(fleet, name) for name in roster}
        self._progress = keys.progress(fleet)
        self._wanted = frozenset((*roster, OBSERVER))
        self._identity = identity
        self._refusals = tls.Refusals(say)
        self._held: list[Any] = [
            self._session.declare_subscriber(keys.tx(fleet), self._on_message),
            self._session.liveliness().declare_subscriber(
                keys.alive(fleet), self._on_token, history=True
            ),
        ]
        if isinstance(identity, Certificate):
            self._held += [
                self._session.declare_queryable(keys.door(fleet), self._on_question),
                self._session.info.declare_link_events_listener(self._on_link),
            ]

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

    def close(self) -> None:
        """Leave the bus."""
        _close(self._session, self._held)
        self._refusals.close()

    def _objection(self, name: str) -> str:
        """Why the holder of a certificate is not let in."""
        assert isinstance(self._identity, Certificate)
        return self._identity.objection(name, self._wanted)

    def _on_question(self, query: zenoh.Query) -> None:
        name = str(query.key_expr).rpartition("/")[2]
        query.reply(keys.door(self._fleet, name), self._objection(name).encode())

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        name = event.link.auth_identifier
        if event.kind == zenoh.SampleKind.PUT and name and (objection := self._objection(name)):
            self._refusals.tell(f"refused {name.partition('.')[0]}: {objection}")

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


class Line:
    """A participant's end of the bus: a client of world-sim."""

    def __init__(self, session: zenoh.Session, identity: Identity, nonce: str) -> None:
        """Use `line` to open one."""
        fleet, name = identity.fleet, identity.user
        self.nonce = nonce
        self._session = session
        self._received: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._block = zenoh.CongestionControl.BLOCK
        self._drop = zenoh.CongestionControl.DROP
        self._tx, self._pose = keys.tx(fleet, name), keys.pose(fleet, name)
        self._weights = keys.weights(fleet, name)
        self._held: list[Any] = [
            session.declare_subscriber(keys.rx(fleet, name), self._on_message),
            session.liveliness().declare_token(keys.alive(fleet, name, nonce)),
        ]

    def next(self, timeout_s: float | None) -> bytes | None:
        """The next message from world-sim, or None after the timeout."""
        try:
            return self._received.get(timeout=None if timeout_s is None else max(0.0, timeout_s))
        except queue.Empty:
            return None

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


def _client(connect: str, identity: Identity, patience_s: float) -> zenoh.Session:
    check_endpoint(connect, identity)
    await_endpoint(connect, patience_s, identity)
    settings = {
        "connect/timeout_ms": round(_HANDSHAKE_S * 1000),
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": 200,
            "period_increase_factor": 1.5,
        },
        "transport/link/tx/lease": LEASE_MS,
        **_proof(identity, "connect"),
    }
    try:
        session = zenoh.open(_config("client", connect=connect, settings=settings))
    except zenoh.ZError:
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
    for reply in session.get(keys.door(identity.fleet, identity.name), timeout=_HANDSHAKE_S):
        if reply.ok is not None:
            if objection := reply.ok.payload.to_bytes().decode(errors="replace"):
                raise BusError(f"{connect}: refuses {identity.user}: {objection}")
            return
    raise BusError(f"{connect}: no world-sim of fleet {identity.fleet} answers; check --connect")


def _proof(identity: Identity, side: str, users_file: Path | None = None) -> dict[str, Any]:
    """The settings that prove who we are. side: connect or listen."""
    if isinstance(identity, Password):
        known = {"dictionary_file": str(users_file)} if users_file is not None else {}
        proof = {"user": identity.user, "password": identity.password, **known}
        return {"transport/auth/usrpwd": proof}

    def encoded(pem: str) -> str:
        return base64.b64encode(pem.encode()).decode()

    return {
        "transport/link/tls": {
            "root_ca_certificate_base64": encoded(identity.authority),
            f"{side}_certificate_base64": encoded(identity.certificate),
            f"{side}_private_key_base64": encoded(identity.key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
    }


def _config(
    mode: str, *, connect: str | None = None, listen: str | None = None, settings: dict[str, Any]
) -> zenoh.Config:
    config = zenoh.Config()
    every = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/endpoints": [connect] if connect else [],
        "listen/endpoints": [listen] if listen else [],
        # Chunks of shared memory are lost when a receiver is not scheduled for 100 ms.
        "transport/shared_memory/enabled": False,
    }
    for key, value in (every | settings).items():
        config.insert_json5(key, json.dumps(value))
    return config


class Grant(NamedTuple):
    """What somebody may do on the router."""

    label: str
    flow: str
    messages: list[str]
    expressions: list[str]


Subject = Mapping[str, list[str]]
"""How the router knows somebody: by `usernames`, `cert_common_names` or `link_protocols`."""


def _subjects(identity: Identity, users: tuple[ParticipantId, ...]) -> dict[ParticipantId, Subject]:
    """How the router knows those users. Who has no certificate, or whose was revoked, is unknown to it."""
    if isinstance(identity, Password):
        return {user: {"usernames": [user]} for user in users}
    named = identity.names(users)
    return {user: {"cert_common_names": [name]} for user, name in named.items()}


def _participant(fleet: str, name: ParticipantId) -> list[Grant]:
    """A participant's grants."""
    own = [keys.tx(fleet, name), keys.pose(fleet, name), keys.weights(fleet, name)]
    return [
        Grant("says", "ingress", ["put"], own),
        Grant("listens", "ingress", ["declare_subscriber"], [keys.rx(fleet, name)]),
        Grant("hears", "egress", ["put"], [keys.rx(fleet, name)]),
        Grant("lives", "ingress", ["liveliness_token"], [keys.alive(fleet, name)]),
    ]


def _observer(fleet: str) -> list[Grant]:
    """An observer's grants."""
    everything = [keys.everything(fleet)]
    return [
        Grant("listens", "ingress", ["declare_subscriber"], everything),
        Grant("hears", "egress", ["put"], everything),
    ]


def _anybody(fleet: str) -> list[Grant]:
    """What a client may do whose certificate is the fleet's, even if it is not let in: ask why."""
    return [
        Grant("asks", "ingress", ["query"], [keys.door(fleet)]),
        Grant("learns", "egress", ["reply", "declare_queryable"], [keys.door(fleet)]),
    ]


def _access(fleet: str, subjects: Mapping[ParticipantId, Subject]) -> dict[str, Any]:
    """Who may do what on the router. Whatever is not allowed here is denied."""
    grants = [
        (user, subject, _observer(fleet) if user == OBSERVER else _participant(fleet, user))
        for user, subject in subjects.items()
    ]
    if any("cert_common_names" in subject for subject in subjects.values()):
        grants.append(("anybody", {"link_protocols": ["tls"]}, _anybody(fleet)))
    return rules_of(grants)


def rules_of(grants: list[tuple[str, Subject, list[Grant]]]) -> dict[str, Any]:
    """Zenoh's access control: everybody's name, how the router knows them, and what they may do."""
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": f"{user}-{grant.label}",
                "permission": "allow",
                "flows": [grant.flow],
                "messages": grant.messages,
                "key_exprs": grant.expressions,
            }
            for user, _, granted in grants
            for grant in granted
        ],
        "subjects": [{"id": user, **subject} for user, subject, _ in grants],
        "policies": [
            {"rules": [f"{user}-{grant.label}" for grant in granted], "subjects": [user]}
            for user, _, granted in grants
        ],
    }


def _low_pass(label: str, key: str, bytes_max: int) -> dict[str, Any]:
    """Nothing longer passes the router."""
    return {
        "id": label,
        "flows": ["ingress"],
        "messages": ["put"],
        "key_exprs": [key],
        "size_limit": bytes_max,
    }


def _downsampling(fleet: str, roster: tuple[ParticipantId, ...]) -> list[dict[str, Any]]:
    """What observers can do without. A rule for each, since many may stand behind one router."""
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
