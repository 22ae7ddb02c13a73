"""Rate limits of participants: a token bucket of messages and of bytes, without a clock of its own.

Each request for a step grants one reply, however fast requests follow each other; nothing else that world-sim sends
grants anything, so that no message pays for itself. Unsolicited messages draw on tokens that accrue with time. A
report costs as much as it causes: one token for each envelope to the whole team, less for one to a few. A correct
participant answers each request once, sends no more by itself than one report with one envelope for each step of its
clock, and repeats a report now and then. Messages beyond the quota are dropped.
"""

from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.clocks import StepClock
from kantor_protocol.wire.messages import MESSAGE_BYTES_MAX

BURST_MESSAGES = 256
"""Messages that may come at once, such as all repeated reports while world-sim was frozen."""
BURST_BYTES = MESSAGE_BYTES_MAX
"""The longest message passes after a rest."""
_SPARE_PER_S = 20.0
"""Unsolicited messages: of a process that joins again, and reports that are repeated five times a second."""
_MARGIN = 4.0
_MEAN_BYTES = 16_384
"""A report with a gossip message for thirty robots; more, after a partition, comes from the burst."""


class RateLimit(NamedTuple):
    """Tokens that accrue in a real second."""

    messages_per_s: float
    bytes_per_s: float

    @classmethod
    def of(cls, steps_per_s: float) -> "RateLimit":
        """The limit of a participant that steps so often by its own clock; 0 if it steps on request only."""
        messages_per_s = _MARGIN * steps_per_s + _SPARE_PER_S
        return cls(messages_per_s, messages_per_s * _MEAN_BYTES)


def rate_limits(
    clocks: dict[ParticipantId, StepClock], exchange: str, speed: float
) -> dict[ParticipantId, RateLimit]:
    """The limits of all participants. speed: realtime exchange, simulated seconds in a real one."""
    own_speed = speed if exchange == "wall" else 0.0
    return {name: RateLimit.of(own_speed * 1e9 / clock.period_ns) for name, clock in clocks.items()}


class Excess(msgspec.Struct, frozen=True):
    """Messages and bytes beyond a quota, which were dropped."""

    messages: int
    bytes: int


class TokenBucket:
    """The tokens of one participant. One thread grants replies, another admits messages; neither waits for the other."""

    def __init__(self, quota: RateLimit) -> None:
        """A full bucket."""
        self.quota = quota
        """May be replaced."""
        self._messages, self._bytes = float(BURST_MESSAGES), float(BURST_BYTES)
        self._at_s: float | None = None
        self._granted = self._credited = 0
        self._excess_messages = self._excess_bytes = 0

    @property
    def excess(self) -> Excess:
        """Messages and bytes beyond the quota so far."""
        return Excess(self._excess_messages, self._excess_bytes)

    @property
    def exceeded(self) -> bool:
        """Whether any message was beyond the quota."""
        return self._excess_messages > 0

    def grant_reply(self) -> None:
        """Grant one message of any length: the reply to a request."""
        self._granted += 1

    def admit(self, size: int, now_s: float) -> bool:
        """Whether a message of so many bytes is within the quota; if so, it is charged. now_s never falls."""
        self._fill(now_s)
        if self._messages < 1.0 or self._bytes < size:
            self._excess_messages += 1
            self._excess_bytes += size
            return False
        self._messages -= 1.0
        self._bytes -= size
        return True

    def charge(self, work: float, now_s: float) -> bool:
        """Whether the work that an admitted message causes is within the quota; if so, it is charged.

        work: in messages; the message itself has been charged for one.
        """
        self._fill(now_s)
        more = max(0.0, work - 1.0)
        if self._messages < more:
            self._excess_messages += 1
            return False
        self._messages -= more
        return True

    def _fill(self, now_s: float) -> None:
        elapsed_s = 0.0 if self._at_s is None else now_s - self._at_s
        granted = self._granted
        replies, self._at_s, self._credited = granted - self._credited, now_s, granted
        messages = self._messages + replies + elapsed_s * self.quota.messages_per_s
        # A reply may be as long as any message.
        octets = self._bytes + replies * MESSAGE_BYTES_MAX + elapsed_s * self.quota.bytes_per_s
        self._messages, self._bytes = min(messages, BURST_MESSAGES), min(octets, BURST_BYTES)


def excesses(buckets: Iterable[tuple[ParticipantId, TokenBucket]]) -> dict[ParticipantId, Excess]:
    """The excess of each participant that has exceeded its quota."""
    return {name: bucket.excess for name, bucket in buckets if bucket.exceeded}
