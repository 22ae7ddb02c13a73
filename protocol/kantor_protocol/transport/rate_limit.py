"""How much a participant may say: a token bucket of messages and of bytes, pure.

A sound participant says what it is asked for, once, and of itself no more than its clock has it say, and then again
now and then. So a question earns the answer to it, however fast questions follow each other, and time earns the rest.
What is beyond that is not listened to.
"""

from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.clocks import StepClock
from kantor_protocol.wire.messages import MESSAGE_BYTES_MAX

BURST_MESSAGES = 256
"""What may come at once, such as all that was said again while world-sim was frozen."""
BURST_BYTES = MESSAGE_BYTES_MAX
"""The longest message passes after a rest."""
_SPARE_PER_S = 20.0
"""Said unasked: who comes back, and what has not been heard, five times a second."""
_MARGIN = 4.0
_MEAN_BYTES = 16_384
"""A report with news for thirty robots; what a partition has held up comes on top, from the burst."""


class RateLimit(NamedTuple):
    """What time earns, in real seconds."""

    messages_per_s: float
    bytes_per_s: float

    @classmethod
    def of(cls, steps_per_s: float) -> "RateLimit":
        """For a participant that steps so often by its own clock; 0 if it steps when it is asked only."""
        messages_per_s = _MARGIN * steps_per_s + _SPARE_PER_S
        return cls(messages_per_s, messages_per_s * _MEAN_BYTES)


def rate_limits(
    clocks: dict[ParticipantId, StepClock], exchange: str, speed: float
) -> dict[ParticipantId, RateLimit]:
    """The quota of everybody. speed: wall, simulated seconds in a real one."""
    of_its_own = speed if exchange == "wall" else 0.0
    return {
        name: RateLimit.of(of_its_own * 1e9 / clock.period_ns) for name, clock in clocks.items()
    }


class Excess(msgspec.Struct, frozen=True):
    """What was not listened to."""

    messages: int
    bytes: int


class TokenBucket:
    """What one participant may say yet. One thread asks, another takes; neither waits for the other."""

    def __init__(self, quota: RateLimit) -> None:
        """It is full at the start."""
        self.quota = quota
        self._messages, self._bytes = float(BURST_MESSAGES), float(BURST_BYTES)
        self._at_s: float | None = None
        self._asked = self._credited = 0
        self._excess_messages = self._excess_bytes = 0

    @property
    def excess(self) -> Excess:
        """What was beyond the quota so far."""
        return Excess(self._excess_messages, self._excess_bytes)

    @property
    def floods(self) -> bool:
        """Whether there was anything beyond it."""
        return self._excess_messages > 0

    def ask(self) -> None:
        """It has been asked something, which it may answer."""
        self._asked += 1

    def admit(self, size: int, now_s: float) -> bool:
        """Whether a message of so many bytes is within the quota. now_s does not run back."""
        self._fill(now_s)
        if self._messages < 1.0 or self._bytes < size:
            self._excess_messages += 1
            self._excess_bytes += size
            return False
        self._messages -= 1.0
        self._bytes -= size
        return True

    def _fill(self, now_s: float) -> None:
        elapsed_s = 0.0 if self._at_s is None else now_s - self._at_s
        asked = self._asked
        answers, self._at_s, self._credited = asked - self._credited, now_s, asked
        messages = self._messages + answers + elapsed_s * self.quota.messages_per_s
        # An answer may be as long as any message.
        octets = self._bytes + answers * MESSAGE_BYTES_MAX + elapsed_s * self.quota.bytes_per_s
        self._messages, self._bytes = min(messages, BURST_MESSAGES), min(octets, BURST_BYTES)


def excesses(buckets: Iterable[tuple[ParticipantId, TokenBucket]]) -> dict[ParticipantId, Excess]:
    """Of those that have gone beyond their quota."""
    return {name: bucket.excess for name, bucket in buckets if bucket.floods}
