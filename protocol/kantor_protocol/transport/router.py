"""Routers of the bus: world-sim's (the hub) and those of sites.

World-sim is the router; every other process is a client of it, with an identity of its own: a password on
`tcp/HOST:PORT`, a certificate on `tls/HOST:PORT`, where both sides authenticate. Access control makes world-sim the
only way from one participant to another: a participant may put on its own keys and read its own `rx`, nothing else.
The traps that Zenoh's settings avoid are in protocol/README.md.

A callback only enqueues; all work is done by the thread that calls `next`. No queue grows without bound: messages
that find it full are dropped, as on any link.

A client connects again by itself when world-sim comes back: its token and its subscription are declared anew, so
that world-sim sees it join with the nonce that it had.
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
from kantor_protocol.transport.events import Event, Flooded, Joined, Left, Received
from kantor_protocol.transport.rate_limit import Excess, RateLimit, TokenBucket, excesses
from kantor_protocol.transport.session import (
    QUEUE_MAX,
    BusError,
    close_session,
    one_line,
    open_session,
)
from kantor_protocol.transport.session_limit import SessionLimit
from kantor_protocol.wire import keys
from kantor_protocol.wire.messages import NONCE_MAX

BATCH_MAX = 128
"""Events that are taken at once."""
_SLOW_S = 0.1
"""A participant whose queue was full for so long does not read."""
_IMPATIENT_S = 10.0
"""For so long messages to a participant that does not read are dropped at once."""


class Router:
    """A router's session, which reports the events of the bus."""

    _session: zenoh.Session
    _declared: list[Any]

    def __init__(self) -> None:
        """No session yet."""
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._drained_s = 0.0
        self._guards: list[RefusalResponder | SessionLimit] = []

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

    def drain(self, timeout_s: float, every_s: float) -> list[Event]:
        """The events that have come, at most BATCH_MAX; empty after the timeout.

        every_s: least time since the last ones, in which more may gather.
        """
        first = self.next(timeout_s)
        if first is None:
            return []
        pause_s = self._drained_s + every_s - time.monotonic()
        if pause_s > 0.0:
            time.sleep(pause_s)
        more = min(self._events.qsize(), BATCH_MAX - 1)
        events = [first, *(self._events.get_nowait() for _ in range(more))]
        self._drained_s = time.monotonic()
        return events

    def close(self) -> None:
        """Leave the bus."""
        for guard in self._guards:
            guard.close()
        close_session(self._session, self._declared)


class HubRouter(Router):
    """World-sim's end of the bus: the router, with access control."""

    def __init__(
        self,
        identity: Identity,
        listen: str,
        users_file: Path | None,
        roster: tuple[ParticipantId, ...],
        notify: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """Listen.

        listen: an endpoint such as `tcp/127.0.0.1:7447`. users_file: of passwords, for an identity that is one.
        notify: takes a line about each client that shows a certificate of the fleet's authority and is refused, or has
        too many sessions; called from a thread. Raises BusError if the endpoint is not free, CredentialsError if it is not of the
        identity's kind.
        """
        super().__init__()
        check_endpoint(listen, identity)
        fleet = identity.fleet
        config = zenoh_config.hub_config(identity, roster, users_file)
        self._fleet = fleet
        self._admitting = threading.Lock()
        self._flooding: set[ParticipantId] = set()
        """Participants that have exceeded their quota."""
        self._buckets = {name: TokenBucket(RateLimit.of(0.0)) for name in roster}
        try:
            self._session = open_session("router", config, listen=listen)
        except zenoh.ZError as error:
            raise BusError(
                f"cannot listen on {listen}: {one_line(error)}; choose another"
            ) from None
        self._block = zenoh.CongestionControl.BLOCK
        self._drop = zenoh.CongestionControl.DROP
        self._patient_from_s: dict[ParticipantId, float] = {}
        """Time from which on each participant that did not read is waited for again."""
        self._publishers: dict[tuple[ParticipantId, bool], zenoh.Publisher] = {}
        self._senders = {keys.tx(fleet, name): name for name in roster}
        self._progress = keys.progress(fleet)
        if isinstance(identity, Certificate):
            wanted = (*roster, *identity.sites, OBSERVER)
            self._guards = [
                RefusalResponder(self._session, identity, wanted, notify),
                SessionLimit(self._session, notify),
            ]
        self._declared: list[Any] = [
            self._session.declare_subscriber(keys.tx(fleet), self._on_message),
            self._session.liveliness().declare_subscriber(
                keys.alive(fleet), self._on_token, history=True
            ),
        ]

    def send(self, name: ParticipantId, payload: bytes, *, blocking: bool) -> None:
        """Put a message on a participant's `rx`.

        blocking: wait while the queue is full, up to 0.2 s, instead of dropping the message; not for one who has just
        been waited for in vain.
        """
        started_s = time.monotonic()
        waits = blocking and started_s >= self._patient_from_s.get(name, started_s)
        self._publisher(name, waits=waits).put(payload)
        if waits and time.monotonic() - started_s > _SLOW_S:
            self._patient_from_s[name] = time.monotonic() + _IMPATIENT_S

    def _publisher(self, name: ParticipantId, *, waits: bool) -> zenoh.Publisher:
        """The publisher of a participant's `rx`, whose way is found once."""
        if (name, waits) not in self._publishers:
            self._publishers[name, waits] = self._session.declare_publisher(
                keys.rx(self._fleet, name),
                congestion_control=self._block if waits else self._drop,
                express=True,
            )
        return self._publishers[name, waits]

    def grant_reply(self, name: ParticipantId) -> None:
        """Let a participant answer the request that is sent to it next."""
        self._buckets[name].grant_reply()

    def charge(self, name: ParticipantId, work: float) -> bool:
        """Charge a participant for the work that one of its messages causes; whether that is within its quota."""
        with self._admitting:
            within = self._buckets[name].charge(work, time.monotonic())
        return within or self._note_excess(name)

    def limit(self, quotas: Mapping[ParticipantId, RateLimit]) -> None:
        """Set the quotas of participants; before that, little more than replies is admitted."""
        for name, quota in quotas.items():
            self._buckets[name].quota = quota

    @property
    def excess(self) -> dict[ParticipantId, Excess]:
        """Messages and bytes beyond the quotas, which were dropped."""
        return excesses(self._buckets.items())

    def publish_progress(self, payload: bytes) -> None:
        """Publish how the mission goes, for observers."""
        self._session.put(self._progress, payload, congestion_control=self._drop)

    def _on_message(self, sample: zenoh.Sample) -> None:
        name, payload = self._senders.get(str(sample.key_expr)), sample.payload
        if name is None or not self._admits(name, len(payload)):
            return
        if self._events.qsize() < QUEUE_MAX:
            self._events.put(Received(name, payload.to_bytes()))

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = keys.parse(str(sample.key_expr))
        if key is None or len(key.nonce) > NONCE_MAX:
            return
        if sample.kind == zenoh.SampleKind.DELETE:
            self._events.put(Left(key.name, key.nonce))
        elif self._admits(key.name, len(key.nonce)):
            self._events.put(Joined(key.name, key.nonce))

    def _admits(self, name: ParticipantId, size: int) -> bool:
        """Whether a message or a token of a participant is within its quota."""
        if name not in self._buckets:
            return False
        with self._admitting:  # messages and tokens come in different threads
            within = self._buckets[name].admit(size, time.monotonic())
        return within or self._note_excess(name)

    def _note_excess(self, name: ParticipantId) -> bool:
        """The first excess of a participant is an event. False."""
        with self._admitting:
            is_first = name not in self._flooding
            self._flooding.add(name)
        if is_first:
            self._events.put(Flooded(name))
        return False


class RefusalResponder:
    """Answers clients with a certificate of the fleet's authority why they are refused, and reports them.

    For TLS such a certificate is valid, and Zenoh silently forwards nothing of its holder's.
    """

    def __init__(
        self,
        session: zenoh.Session,
        identity: Certificate,
        wanted: Iterable[ParticipantId],
        notify: Callable[[str], None],
    ) -> None:
        """wanted: the users that take part. notify: takes a line for the operator; called from a thread."""
        self._identity = identity
        self._wanted = frozenset(wanted)
        self._refusals = tls.RefusalLog(notify)
        self._declared: list[Any] = [
            session.declare_queryable(keys.door(identity.fleet), self._on_query),
            session.info.declare_link_events_listener(self._on_link),
        ]

    def close(self) -> None:
        """Stop answering, and report what has not been reported yet."""
        self._declared.clear()
        self._refusals.close()

    def _reason(self, name: str) -> str:
        return self._identity.refusal_reason(name, self._wanted)

    def _on_query(self, query: zenoh.Query) -> None:
        name = str(query.key_expr).rpartition("/")[2]
        answer = self._identity.answer(name, self._wanted)
        query.reply(keys.door(self._identity.fleet, name), answer.encode())

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        name = event.link.auth_identifier
        if event.kind == zenoh.SampleKind.PUT and name and (reason := self._reason(name)):
            self._refusals.report(f"refused {name.partition('.')[0]}: {reason}")


class SiteRouter(Router):
    """The router of a site: the site's robots connect to it, and it connects to world-sim's.

    The rights of each robot are enforced here, those of all of them together at world-sim. It connects again by
    itself; while it is not connected, its robots have left.
    """

    def __init__(
        self,
        identity: Certificate,
        connect: str,
        listen: str,
        connect_timeout_s: float,
        notify: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """Wait for world-sim up to `connect_timeout_s`, then listen. notify: see HubRouter.

        Raises BusError, CredentialsError.
        """
        super().__init__()
        check_endpoint(listen, identity)
        fleet = identity.fleet
        self.members = tuple(name for name in identity.members if name != WORLD_SIM)
        """The site's robots."""
        check_free(listen)
        # A client gets the reason if world-sim refuses this identity; a router would not.
        close_session(client(connect, identity, connect_timeout_s), [])
        config = zenoh_config.site_config(identity, self.members)
        try:
            self._session = open_session("router", config, connect=connect, listen=listen)
        except zenoh.ZError as error:
            raise BusError(f"cannot connect {listen} to {connect}: {one_line(error)}") from None
        self._guards = [
            RefusalResponder(self._session, identity, (*self.members, WORLD_SIM), notify),
            SessionLimit(self._session, notify),
        ]
        self._declared: list[Any] = [
            self._session.liveliness().declare_subscriber(
                keys.alive(fleet), self._on_token, history=True
            ),
        ]

    @property
    def connected(self) -> bool:
        """Whether it is connected to world-sim."""
        return bool(self._session.info.routers_zid())

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = keys.parse(str(sample.key_expr))
        if key is not None:
            kind = Joined if sample.kind == zenoh.SampleKind.PUT else Left
            self._events.put(kind(key.name, key.nonce))
