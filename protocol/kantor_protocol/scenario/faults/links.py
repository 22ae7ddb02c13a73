"""Faults of links, and of the messages on them.

They are injected where the radio decides on deliveries (`kantor_worldsim/radio/link_faults.py`), so they apply in
every exchange, and a message that is under way when a window ends still arrives as decided.
"""

from collections.abc import Callable
from typing import Annotated, Literal

from msgspec import Meta

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.base import Fault, Names, Share, Span
from kantor_protocol.scenario.types import NotNegative, Positive, Probability, Seconds

Severs = Callable[[ParticipantId, ParticipantId], bool]
"""Whether no message of a sender (first) reaches a receiver (second)."""

COPIES_MAX = 8

FORGED_SEQUENCE_MIN = 1 << 62
"""Forged envelopes are numbered from here on; no participant sends so many."""

_BRIDGE = -1
"""The side of a participant that hears both halves."""


class OnLinks(Fault, frozen=True, kw_only=True):
    """A fault of links, in both directions."""

    robots: Names = ()
    """Links with one of these participants at an end; by default every link."""


class Drop(OnLinks, frozen=True, kw_only=True, tag="drop"):
    """Every copy is lost with this probability, independently."""

    probability: Share


class Burst(OnLinks, frozen=True, kw_only=True, tag="burst"):
    """Losses come in bursts (Gilbert 1960, Elliott 1963).

    Each direction of each link is good or bad, for times that are geometrically distributed in intervals of
    a tenth of the shorter mean. All begin the mission good, and go on changing outside the window.
    """

    good_s: Span
    """Mean time from one burst to the next."""
    bad_s: Span
    """Mean length of a burst."""
    drop_good: Probability = 0.0
    drop_bad: Share = 1.0


class Delay(OnLinks, frozen=True, kw_only=True, tag="delay"):
    """Every copy arrives later by delay_s and a time drawn from [0, jitter_s]."""

    delay_s: Seconds = 0.0
    jitter_s: Seconds = 0.0


class Duplicate(OnLinks, frozen=True, kw_only=True, tag="duplicate"):
    """With this probability more copies arrive, each later by a time drawn from [0, delay_s]."""

    probability: Share
    copies: Annotated[int, Meta(ge=1, le=COPIES_MAX)] = 1
    delay_s: Seconds = 0.0


class Replay(OnLinks, frozen=True, kw_only=True, tag="replay"):
    """With this probability an older message of the same sender to the same receivers comes once more.

    It is the newest one that is as old as a time drawn from (0, age_s].
    """

    probability: Share
    age_s: Span


class Reorder(OnLinks, frozen=True, kw_only=True, tag="reorder"):
    """With this probability a copy is held back by up to hold_s, so that later ones overtake it."""

    probability: Share
    hold_s: Span


class OneWay(Fault, frozen=True, kw_only=True, tag="one-way"):
    """No message of the senders reaches the receivers; the other direction works."""

    senders: Names = ()
    """By default all participants."""
    receivers: Names = ()
    """By default all participants."""

    def severs(self, roster: Names) -> Severs:
        """The links that it cuts."""
        senders, receivers = frozenset(self.senders or roster), frozenset(self.receivers or roster)
        return lambda sender, receiver: sender in senders and receiver in receivers


class Partition(Fault, frozen=True, kw_only=True, tag="partition"):
    """The team is divided: no message passes between two parts, in either direction."""

    shape: Literal["halves", "ring", "bridge", "isolate", "groups"]
    """In the order of the roster, the supervisor last. halves: the first half and the second.
    ring: each hears only the one before and the one after, the last and the first each other.
    bridge: two halves, and one in the middle that hears both. isolate: each of `robots` for itself.
    groups: as given, and all that are in none together."""
    robots: Names = ()
    """isolate: the participants to isolate."""
    groups: tuple[Names, ...] = ()
    """groups: the groups."""
    flap_s: Span | None = None
    """The cut comes and goes: so often it is drawn whether it is there. By default it stays."""
    flap_share: Annotated[float, Meta(gt=0.0, lt=1.0)] | None = None
    """Share of the time in which it is there, if it flaps; by default half."""

    def severs(self, roster: Names) -> Severs:
        """The links that it cuts while it is there."""
        if self.shape == "ring":
            place = {name: i for i, name in enumerate(roster)}
            return lambda one, other: 1 < abs(place[one] - place[other]) < len(roster) - 1
        side = self._sides(roster)
        return lambda one, other: (
            side[one] != side[other]
            and _BRIDGE
            not in {
                side[one],
                side[other],
            }
        )

    def _sides(self, roster: Names) -> dict[ParticipantId, int]:
        middle = len(roster) // 2
        if self.shape == "halves":
            return {name: int(i >= len(roster) - middle) for i, name in enumerate(roster)}
        if self.shape == "bridge":
            sides = {name: int(i > middle) for i, name in enumerate(roster)}
            return sides | {roster[middle]: _BRIDGE}
        parts = self.groups if self.shape == "groups" else tuple((name,) for name in self.robots)
        sides = dict.fromkeys(roster, 0)
        return sides | {name: i for i, part in enumerate(parts, 1) for name in part}


class Clog(OnLinks, frozen=True, kw_only=True, tag="clog"):
    """Messages sent in the window arrive when it ends, in a burst, in the order of (sender, sequence)."""


class Bandwidth(Fault, frozen=True, kw_only=True, tag="bandwidth"):
    """A sender has so many bytes a second; a message waits until those sent before have been transmitted."""

    robots: Names = ()
    """Senders, each for itself; by default all participants."""
    bytes_per_s: Positive
    """Of message bodies. A message takes its time on the air whether it reaches a receiver or not."""
    queue_bytes: Annotated[int, Meta(ge=0, le=2**62)] | None = None
    """How much may wait; a message that finds more waiting is dropped. By default everything waits."""


class Range(OnLinks, frozen=True, kw_only=True, tag="range"):
    """The radio range is shorter."""

    range_m: NotNegative | None = None
    """The range at most, the bound included."""
    factor: Probability | None = None
    """Or the share of the range that is left."""

    def reach_m(self, range_m: float) -> float:
        """The range under this fault."""
        return (
            range_m * (self.factor or 0.0) if self.range_m is None else min(range_m, self.range_m)
        )


class Hostile(OnLinks, frozen=True, kw_only=True, tag="hostile"):
    """With this probability a forgery arrives beside a message, to be refused by its receiver.

    It is in the sender's name, or in that of a stranger: noise, a message that is cut short, of another version,
    oversized, deeply nested, with numbers that are not finite, or of origins that do not exist.
    """

    probability: Share


LinkFault = (
    Drop
    | Burst
    | Delay
    | Duplicate
    | Replay
    | Reorder
    | OneWay
    | Partition
    | Clog
    | Bandwidth
    | Range
    | Hostile
)
