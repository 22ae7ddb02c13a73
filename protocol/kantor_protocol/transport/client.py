"""Clients of the bus: a participant's session and an observer's."""

import contextlib
import queue
import threading
import time
from collections.abc import Iterator
from typing import Any

import zenoh

from kantor_protocol.transport import zenoh_config
from kantor_protocol.transport.credentials import Certificate, Identity
from kantor_protocol.transport.endpoint import await_endpoint, check_endpoint, is_crowded
from kantor_protocol.transport.session import (
    CLOSE_S,
    QUEUE_MAX,
    BusError,
    close_session,
    open_session,
)
from kantor_protocol.wire import keys


class ParticipantSession:
    """A participant's end of the bus: a client of world-sim's router, or of a site's."""

    def __init__(self, session: zenoh.Session, identity: Identity, nonce: str) -> None:
        """A session is opened by `participant_session`."""
        fleet, name = identity.fleet, identity.user
        self.nonce = nonce
        self._session = session
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(QUEUE_MAX)
        subscriber = session.declare_subscriber(keys.rx(fleet, name), ring)
        self._messages = subscriber.handler
        self._fed: queue.SimpleQueue[bytes | BusError] | None = None
        """What a thread has taken from the messages, so that one can wait for a limited time."""
        self._feeder: threading.Thread | None = None
        self._identity = identity
        # What is put on the key of a declared publisher is not sent while nobody subscribes to it.
        self._tx = {
            blocking: session.declare_publisher(
                keys.tx(fleet, name),
                congestion_control=zenoh.CongestionControl.BLOCK
                if blocking
                else zenoh.CongestionControl.DROP,
                express=True,
            )
            for blocking in (False, True)
        }
        self._pose = session.declare_publisher(keys.pose(fleet, name))
        self._weights = session.declare_publisher(keys.weights(fleet, name))
        self._declared: list[Any] = [
            subscriber,
            *self._tx.values(),
            self._pose,
            self._weights,
            session.liveliness().declare_token(keys.alive(fleet, name, nonce)),
        ]
        if isinstance(identity, Certificate):
            self._feed()
            self._declared.append(
                session.info.declare_transport_events_listener(self._on_transport)
            )

    def next(self, timeout_s: float | None) -> bytes | None:
        """The next message from world-sim, or None after the timeout.

        Raises BusError if world-sim was started again and does not admit this process any more.
        """
        if timeout_s is None and self._fed is None:
            return self._messages.recv().payload.to_bytes()
        fed = self._fed or self._feed()
        try:
            message = fed.get(timeout=None if timeout_s is None else max(0.0, timeout_s))
        except queue.Empty:
            return None
        if isinstance(message, BusError):
            raise message
        return message

    def send(self, payload: bytes, *, blocking: bool) -> None:
        """Put a message on the own `tx`. blocking: wait while the queue is full, instead of dropping the message."""
        self._tx[blocking].put(payload)

    def publish_pose(self, payload: bytes) -> None:
        """Publish the own pose for observers."""
        self._pose.put(payload)

    def publish_weights(self, payload: bytes) -> None:
        """Publish the own weight vector for observers."""
        self._weights.put(payload)

    def close(self) -> None:
        """Leave the bus. A thread that still waited at the end of its process would abort it."""
        close_session(self._session, self._declared)
        if self._feeder is not None:
            self._feeder.join(CLOSE_S)

    def _feed(self) -> queue.SimpleQueue[bytes | BusError]:
        """From now on a thread takes the messages: whoever waits for them otherwise needs none, and one wake-up less."""
        fed: queue.SimpleQueue[bytes | BusError] = queue.SimpleQueue()

        def feed() -> None:
            with contextlib.suppress(zenoh.ZError):  # the session was closed
                for sample in self._messages:
                    if fed.qsize() < QUEUE_MAX:
                        fed.put(sample.payload.to_bytes())

        self._feeder = threading.Thread(target=feed, daemon=True)
        self._feeder.start()
        self._fed = fed
        return fed

    def _on_transport(self, event: zenoh.TransportEvent) -> None:
        """Check membership after a reconnection: it may be to a world-sim with another member list."""
        assert isinstance(self._identity, Certificate)
        assert self._fed is not None
        with contextlib.suppress(zenoh.ZError):  # it was closed meanwhile
            if event.kind != zenoh.SampleKind.PUT:
                return
            if distrust := _distrust(self._session, self._identity):
                self._fed.put(BusError(distrust))
            elif reason := _reason_of_refusal(self._session, self._identity):
                self._fed.put(BusError(f"refuses {self._identity.user}: {reason}"))


class ObserverSession:
    """An observer's end of the bus: reads, never writes."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        """A session is opened by `observer_session`."""
        self._session = session
        self._received: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        self._declared: list[Any] = [session.declare_subscriber(key, self._on_message)]

    def next(self, timeout_s: float) -> tuple[str, bytes] | None:
        """The next message as (key, payload), or None after the timeout."""
        try:
            return self._received.get(timeout=max(0.0, timeout_s))
        except queue.Empty:
            return None

    def close(self) -> None:
        """Leave the bus."""
        close_session(self._session, self._declared)

    def _on_message(self, sample: zenoh.Sample) -> None:
        if self._received.qsize() < QUEUE_MAX:
            self._received.put((str(sample.key_expr), sample.payload.to_bytes()))


_REFUSALS = 2
"""Attempts in a row that fail where there is room, after which the credentials are wrong."""


@contextlib.contextmanager
def participant_session(
    connect: str,
    identity: Identity,
    nonce: str,
    connect_timeout_s: float,
    lease_ms: int | None = None,
) -> Iterator[ParticipantSession]:
    """Join the bus as a participant, waiting for world-sim up to `connect_timeout_s`. Raises BusError."""
    opened = client(connect, identity, connect_timeout_s, lease_ms)
    session = ParticipantSession(opened, identity, nonce)
    try:
        yield session
    finally:
        session.close()


@contextlib.contextmanager
def observer_session(
    connect: str, identity: Identity, key: str, connect_timeout_s: float
) -> Iterator[ObserverSession]:
    """Join the bus as an observer of the keys that match. Raises BusError."""
    session = ObserverSession(client(connect, identity, connect_timeout_s), key)
    try:
        yield session
    finally:
        session.close()


def client(
    connect: str, identity: Identity, connect_timeout_s: float, lease_ms: int | None = None
) -> zenoh.Session:
    """Open the session of a client, once the router at the endpoint admits it. Raises BusError."""
    check_endpoint(connect, identity)
    give_up = time.monotonic() + connect_timeout_s
    await_endpoint(connect, connect_timeout_s, identity)
    session = _opened(connect, identity, give_up, lease_ms)
    if isinstance(identity, Certificate):
        try:
            _check_admitted(connect, session, identity)
        except BusError:
            close_session(session, [])
            raise
    return session


def _opened(
    connect: str, identity: Identity, give_up: float, lease_ms: int | None
) -> zenoh.Session:
    """A session, as soon as the router has room for it. give_up: by the monotonic clock. Raises BusError."""
    config = zenoh_config.client_config(identity, lease_ms)
    refusals = 0
    while True:
        with contextlib.suppress(zenoh.ZError):
            return open_session("client", config, connect=connect)
        late = time.monotonic() >= give_up
        crowded = isinstance(identity, Certificate) or is_crowded(connect)
        # Room may have become free just after an attempt failed for want of it: one refusal proves nothing.
        refusals = 0 if crowded else refusals + 1
        # Since the last handshake it may have expired, or the router may have been started with another member list.
        await_endpoint(connect, max(0.0, give_up - time.monotonic()), identity)
        if (crowded or refusals < _REFUSALS) and not late:
            continue
        if crowded:
            raise BusError(
                f"{connect}: has no room for {identity.user}: too many others are connecting; try again later"
            )
        raise BusError(
            f"{connect}: refuses {identity.user}; its credentials are not this world-sim's, "
            "or it is connected too often already"
        )


def _distrust(session: zenoh.Session, identity: Certificate) -> str:
    """Why what this session is connected to is not trusted; empty if it is."""
    names = [link.auth_identifier or "" for link in session.info.links()]
    return next(filter(None, map(identity.distrust, names)), "")


def _check_admitted(connect: str, session: zenoh.Session, identity: Certificate) -> None:
    """Check that this is a router to trust, and ask it whether this identity is a member. Raises BusError.

    A certificate may be valid and yet not in the member list.
    """
    if distrust := _distrust(session, identity):
        raise BusError(f"{connect}: {distrust}")
    reason = _reason_of_refusal(session, identity)
    if reason is None:
        raise BusError(
            f"{connect}: no world-sim of fleet {identity.fleet} answers; check --connect"
        )
    if reason:
        raise BusError(f"{connect}: refuses {identity.user}: {reason}")


def _reason_of_refusal(session: zenoh.Session, identity: Certificate) -> str | None:
    """Why the router refuses this identity, empty if it does not; None without an answer.

    A session that has just been opened may take a moment until queries reach the router.
    """
    give_up = time.monotonic() + zenoh_config.HANDSHAKE_S
    while time.monotonic() < give_up:
        for reply in session.get(keys.door(identity.fleet, identity.name), timeout=1.0):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes().decode(errors="replace")
        time.sleep(0.02)
    return None
