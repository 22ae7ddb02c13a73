"""The bus: the only file that knows Zenoh.

World-sim is the router; every other process is a client of it, with an identity of its own. Access
control makes world-sim the only way from one participant to another: a participant may put on its own
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
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

import zenoh

from kantor_protocol import access, keys
from kantor_protocol.credentials import OBSERVER, Identity
from kantor_protocol.machine import WORLD_SIM, ParticipantId
from kantor_protocol.messages import MESSAGE_BYTES_MAX

LEASE_MS = 1000
"""A frozen or cut-off process is noticed after this."""
QUEUE_MAX = 16_384
"""Messages that wait for a reader."""
_HANDSHAKE_S = 3.0
_CLOSE_S = 5.0
_RECONNECT = {
    "connect/timeout_ms": round(_HANDSHAKE_S * 1000),
    "connect/retry": {"period_init_ms": 50, "period_max_ms": 200, "period_increase_factor": 1.5},
    "transport/link/tx/lease": LEASE_MS,
}


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


Event = Joined | Left | Heard
Subject = tuple[str, dict[str, list[str]], access.Grants]


class Host:
    """World-sim's end of the bus: the router, with access control."""

    def __init__(
        self,
        identity: Identity,
        listen: str,
        users_file: Path,
        roster: tuple[ParticipantId, ...],
    ) -> None:
        """listen: an endpoint such as `tcp/127.0.0.1:7447`. Raises BusError if it cannot be had."""
        fleet = identity.fleet
        settings = _router(identity, _subjects(identity, roster))
        if not identity.certificate:
            settings["transport/auth/usrpwd"]["dictionary_file"] = str(users_file)
        self._fleet = fleet
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        try:
            self._session = zenoh.open(_config("router", listen=listen, settings=settings))
        except zenoh.ZError as error:
            raise BusError(f"cannot listen on {listen}: {_short(error)}; choose another") from None
        self._block = zenoh.CongestionControl.BLOCK
        self._drop = zenoh.CongestionControl.DROP
        self._rx = {name: keys.rx(fleet, name) for name in roster}
        self._progress = keys.progress(fleet)
        self._held: list[Any] = [
            self._session.declare_subscriber(keys.tx(fleet), self._on_message),
            self._session.liveliness().declare_subscriber(
                keys.alive(fleet), self._on_token, history=True
            ),
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
        self._session.put(self._rx[name], payload, congestion_control=congestion, express=True)

    def publish_progress(self, payload: bytes) -> None:
        """Tell observers how the mission goes."""
        self._session.put(self._progress, payload, congestion_control=self._drop)

    def close(self) -> None:
        """Leave the bus."""
        _close(self._session, self._held)

    def _on_message(self, sample: zenoh.Sample) -> None:
        key = keys.parse(str(sample.key_expr))
        if key is not None and self._events.qsize() < QUEUE_MAX:
            self._events.put(Heard(key.name, sample.payload.to_bytes()))

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = keys.parse(str(sample.key_expr))
        if key is not None:
            kind = Joined if sample.kind == zenoh.SampleKind.PUT else Left
            self._events.put(kind(key.name, key.nonce))


class Site:
    """A router of a place: its robots connect to it, and it connects to world-sim's.

    What each robot may do is enforced here, what all of them may do at world-sim. It connects again by itself;
    without it its robots have left.
    """

    def __init__(self, identity: Identity, connect: str, listen: str, patience_s: float) -> None:
        """Wait for world-sim up to `patience_s`, then listen. Raises BusError."""
        fleet = identity.fleet
        self.members = tuple(name for name in identity.members if name != WORLD_SIM)
        """Its robots."""
        robots = [(name, access.robot(fleet, name)) for name in self.members]
        hub = (WORLD_SIM, access.hub(fleet, self.members))
        settings = _router(identity, _marked(identity, [*robots, hub])) | _RECONNECT
        _check_free(listen)
        await_endpoint(connect, patience_s)
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        try:
            self._session = zenoh.open(
                _config("router", connect=connect, listen=listen, settings=settings)
            )
        except zenoh.ZError:
            raise BusError(
                f"{connect}: refuses {identity.user}; its credentials are not this world-sim's"
            ) from None
        self._held: list[Any] = [
            self._session.liveliness().declare_subscriber(
                keys.alive(fleet), self._on_token, history=True
            )
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def next(self, timeout_s: float) -> Event | None:
        """Who has come or gone, or None after the timeout."""
        try:
            return self._events.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            return None

    @property
    def connected(self) -> bool:
        """Whether world-sim is there."""
        return bool(self._session.info.routers_zid())

    def close(self) -> None:
        """Leave the bus."""
        _close(self._session, self._held)

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


def free_endpoint() -> str:
    """A loopback endpoint that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def await_endpoint(
    connect: str, patience_s: float, monotonic: Callable[[], float] = time.monotonic
) -> None:
    """Return once something accepts connections there; raises BusError after `patience_s`."""
    host, port = _address(connect)
    give_up = monotonic() + patience_s
    pause_s = 0.02
    while True:
        try:
            with socket.create_connection((host, port), timeout=1.0):
                return
        except socket.gaierror:
            raise BusError(f"{connect}: no such host; check --connect") from None
        except OSError:
            if monotonic() >= give_up:
                raise BusError(
                    f"{connect}: nothing listens there after {patience_s:g} s; "
                    f"start `kantor worldsim` or check --connect"
                ) from None
        time.sleep(pause_s)
        pause_s = min(0.2, 1.5 * pause_s)


def _address(endpoint: str) -> tuple[str, int]:
    protocol, _, place = endpoint.partition("/")
    host, _, port = place.rpartition(":")
    if protocol not in {"tcp", "tls"} or not host or not port.isdigit() or int(port) > 65535:
        raise BusError(f"{endpoint}: not an endpoint; write it as tcp/HOST:PORT")
    return host.strip("[]"), int(port)


def _check_free(listen: str) -> None:
    """Raise BusError if somebody else listens there."""
    family = socket.AF_INET6 if ":" in _address(listen)[0] else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(_address(listen))
        except OSError as error:
            reason = error.strerror or error
            raise BusError(f"cannot listen on {listen}: {reason}; choose another") from None


def check_endpoint(endpoint: str) -> None:
    """Raise BusError unless it reads tcp/HOST:PORT."""
    _address(endpoint)


def _client(connect: str, identity: Identity, patience_s: float) -> zenoh.Session:
    await_endpoint(connect, patience_s)
    settings = _proof(identity) | _RECONNECT
    try:
        return zenoh.open(_config("client", connect=connect, settings=settings))
    except zenoh.ZError:
        raise BusError(
            f"{connect}: refuses {identity.user}; its credentials are not this world-sim's"
        ) from None


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


def _router(identity: Identity, subjects: Iterable[Subject]) -> dict[str, Any]:
    """The settings of world-sim's router and of a site's."""
    return _proof(identity) | {
        "scouting/delay": 0,
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        # A frozen client must not hold the router for long (the unit is microseconds).
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 200_000,
        "access_control": access.control(subjects),
        "low_pass_filter": [
            {
                "id": "tx",
                "flows": ["ingress"],
                "messages": ["put"],
                "key_exprs": [keys.everything(identity.fleet)],
                "size_limit": MESSAGE_BYTES_MAX,
            }
        ],
    }


def _subjects(identity: Identity, roster: Iterable[ParticipantId]) -> list[Subject]:
    """Whom the hub lets in, and as what."""
    fleet = identity.fleet
    sites = [(name, access.site(fleet, members)) for name, members in identity.sites.items()]
    robots = [(name, access.robot(fleet, name)) for name in roster]
    return _marked(identity, [*robots, *sites, (OBSERVER, access.observer(fleet))])


def _marked(identity: Identity, grants: Iterable[tuple[str, access.Grants]]) -> list[Subject]:
    """With how the router knows each."""
    if not identity.certificate:
        return [(name, {"usernames": [name]}, granted) for name, granted in grants]
    known = identity.members
    return [
        (name, {"cert_common_names": [known[name]]}, granted)
        for name, granted in grants
        if name in known
    ]


def _proof(identity: Identity) -> dict[str, Any]:
    """How a process shows who it is, and sees who others are."""
    if not identity.certificate:
        return {"transport/auth/usrpwd": {"user": identity.user, "password": identity.password}}
    key, certificate = _base64(identity.key), _base64(identity.certificate)
    return {
        "transport/link/tls": {
            "root_ca_certificate_base64": _base64(identity.authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "listen_private_key_base64": key,
            "listen_certificate_base64": certificate,
            "connect_private_key_base64": key,
            "connect_certificate_base64": certificate,
        }
    }


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()


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
