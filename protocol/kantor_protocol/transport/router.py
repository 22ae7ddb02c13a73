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

import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Self

import zenoh

from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.transport import tls, zenoh_config
from kantor_protocol.transport.client import client
from kantor_protocol.transport.credentials import OBSERVER, Certificate, Identity
from kantor_protocol.transport.endpoint import check_endpoint, check_free
from kantor_protocol.transport.events import Event, Flooded, Heard, Joined, Left
from kantor_protocol.transport.rate_limit import Excess, RateLimit, TokenBucket, excesses
from kantor_protocol.transport.session import (
    QUEUE_MAX,
    BusError,
    close_session,
    one_line,
    open_session,
)
from kantor_protocol.wire import keys


class Router:
    """A router's session, which tells what happens on the bus."""

    _session: zenoh.Session
    _held: list[Any]

    def __init__(self) -> None:
        """No session yet."""
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._door: RefusalResponder | None = None

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
        close_session(self._session, self._held)


class HubRouter(Router):
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
        known = zenoh_config.hub_config(identity, roster, users_file)
        self._fleet = fleet
        self._listening = threading.Lock()
        self._buckets = {name: TokenBucket(RateLimit.of(0.0)) for name in roster}
        try:
            self._session = open_session("router", known, listen=listen)
        except zenoh.ZError as error:
            raise BusError(
                f"cannot listen on {listen}: {one_line(error)}; choose another"
            ) from None
        self._block = zenoh.CongestionControl.BLOCK
        self._drop = zenoh.CongestionControl.DROP
        self._rx = {name: keys.rx(fleet, name) for name in roster}
        self._progress = keys.progress(fleet)
        if isinstance(identity, Certificate):
            wanted = (*roster, *identity.sites, OBSERVER)
            self._door = RefusalResponder(self._session, identity, wanted, say)
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

    def limit(self, quotas: Mapping[ParticipantId, RateLimit]) -> None:
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
            taken = bucket.admit(size, time.monotonic())
            if bucket.floods and not flooded:
                self._events.put(Flooded(name))
            return taken


class RefusalResponder:
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


class SiteRouter(Router):
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
        check_free(listen)
        close_session(
            client(connect, identity, patience_s), []
        )  # which is told why, if it is not let in
        own = zenoh_config.site_config(identity, self.members)
        try:
            self._session = open_session("router", own, connect=connect, listen=listen)
        except zenoh.ZError as error:
            raise BusError(f"cannot connect {listen} to {connect}: {one_line(error)}") from None
        self._door = RefusalResponder(self._session, identity, (*self.members, WORLD_SIM), say)
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
