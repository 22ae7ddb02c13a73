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

import contextlib
import json
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import zenoh

from kantor_protocol import keys
from kantor_protocol.credentials import OBSERVER, Identity
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
    ) -> None:
        """listen: an endpoint such as `tcp/127.0.0.1:7447`. Raises BusError if it cannot be had."""
        fleet = identity.fleet
        settings = {
            "scouting/delay": 0,
            "open/return_conditions": {"connect_scouted": False, "declares": False},
            # A frozen client must not hold the router for long (the unit is microseconds).
            "transport/link/tx/queue/congestion_control/block/wait_before_close": 200_000,
            "transport/auth/usrpwd": {
                "user": identity.user,
                "password": identity.password,
                "dictionary_file": str(users_file),
            },
            # A flood reaches the router in small portions, so that the others' turn comes between them.
            "transport/link/tcp/so_rcvbuf": _RECEIVE_BYTES,
            "transport/link/tls/so_rcvbuf": _RECEIVE_BYTES,
            # Longer ones are not put together. Without this a robot could have a gigabyte waiting.
            "transport/link/rx/max_message_size": MESSAGE_BYTES_MAX + _FRAME_BYTES,
            "access_control": _access(fleet, roster),
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
    if protocol != "tcp" or not host or not port.isdigit() or int(port) > 65535:
        raise BusError(f"{endpoint}: not an endpoint; write it as tcp/HOST:PORT")
    return host.strip("[]"), int(port)


def check_endpoint(endpoint: str) -> None:
    """Raise BusError unless it reads tcp/HOST:PORT."""
    _address(endpoint)


def _client(connect: str, identity: Identity, patience_s: float) -> zenoh.Session:
    await_endpoint(connect, patience_s)
    settings = {
        "connect/timeout_ms": round(_HANDSHAKE_S * 1000),
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": 200,
            "period_increase_factor": 1.5,
        },
        "transport/link/tx/lease": LEASE_MS,
        "transport/auth/usrpwd": {"user": identity.user, "password": identity.password},
    }
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


def _access(fleet: str, roster: tuple[ParticipantId, ...]) -> dict[str, Any]:
    """Who may do what on the router. Whatever is not allowed here is denied."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def allow(user: str, *grants: tuple[str, str, list[str], list[str]]) -> None:
        for label, flow, messages, expressions in grants:
            rules.append(
                {
                    "id": f"{user}-{label}",
                    "permission": "allow",
                    "flows": [flow],
                    "messages": messages,
                    "key_exprs": expressions,
                }
            )
        subjects.append({"id": user, "usernames": [user]})
        policies.append({"rules": [f"{user}-{label}" for label, *_ in grants], "subjects": [user]})

    for name in roster:
        own = [keys.tx(fleet, name), keys.pose(fleet, name), keys.weights(fleet, name)]
        allow(
            name,
            ("says", "ingress", ["put"], own),
            ("listens", "ingress", ["declare_subscriber"], [keys.rx(fleet, name)]),
            ("hears", "egress", ["put"], [keys.rx(fleet, name)]),
            ("lives", "ingress", ["liveliness_token"], [keys.alive(fleet, name)]),
        )
    everything = [keys.everything(fleet)]
    allow(
        OBSERVER,
        ("listens", "ingress", ["declare_subscriber"], everything),
        ("hears", "egress", ["put"], everything),
    )
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
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
