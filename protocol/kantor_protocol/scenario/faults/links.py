"""Faults of links, and of what travels over them.

They are injected where the radio rules (`kantor_worldsim.faults`), so they hold for every exchange, and a
message that is under way when a window ends still arrives as ruled.
"""

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.base import Fault, Names, Share, Span, complaints_of_names
from kantor_protocol.scenario.types import NotNegative, Positive, Probability, Seconds

if TYPE_CHECKING:
    from kantor_protocol.scenario.schema import Scenario

Severs = Callable[[ParticipantId, ParticipantId], bool]
"""Whether nothing of a sender (first) reaches a receiver (second)."""

COPIES_MAX = 8

_BRIDGE = -1
"""The side of a participant that hears both halves."""


class OnLinks(Fault, frozen=True, kw_only=True):
    """A fault of links, in both directions."""

    robots: Names = ()
    """Links with one of these participants at an end; by default every link."""

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also names that nobody has."""
        yield from super().complaints(scenario)
        yield from complaints_of_names("robots", self.robots, scenario)


class Drop(OnLinks, frozen=True, kw_only=True, tag="drop"):
    """Every copy is lost with this probability, whatever happens to others."""

    probability: Share


class Burst(OnLinks, frozen=True, kw_only=True, tag="burst"):
    """Losses come in bursts (Gilbert 1960, Elliott 1963).

    Each direction of each link is good or bad, for times that are geometrically distributed in slots of a
    tenth of the shorter mean. All begin the mission good, and go on changing outside the window.
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

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also a delay of nothing."""
        yield from super().complaints(scenario)
        if not self.delay_s + self.jitter_s > 0.0:
            yield "delay_s: delays nothing; set it, or jitter_s"


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
    """Nothing of the senders reaches the receivers; the other direction stands."""

    senders: Names = ()
    """By default everybody."""
    receivers: Names = ()
    """By default everybody."""

    def severs(self, roster: Names) -> Severs:
        """Which links it cuts."""
        senders, receivers = frozenset(self.senders or roster), frozenset(self.receivers or roster)
        return lambda sender, receiver: sender in senders and receiver in receivers

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also names that nobody has, and a cut of nothing or of everything."""
        yield from super().complaints(scenario)
        yield from complaints_of_names("senders", self.senders, scenario)
        yield from complaints_of_names("receivers", self.receivers, scenario)
        if not self.senders and not self.receivers:
            yield "senders: missing; set senders, receivers or both"
        elif not _cuts_any(self.severs(scenario.roster), scenario.roster):
            yield "receivers: no link leads there from the senders; name others"


class Partition(Fault, frozen=True, kw_only=True, tag="partition"):
    """The team falls apart: nothing passes between two parts, in either direction."""

    shape: Literal["halves", "ring", "bridge", "isolate", "groups"]
    """In the order of the roster, the supervisor last. halves: the first half and the second.
    ring: everybody hears only the one before and the one after, the last and the first each other.
    bridge: two halves, and one in the middle that hears both. isolate: each of `robots` for itself.
    groups: as given, and whoever is in none together."""
    robots: Names = ()
    """isolate: who."""
    groups: tuple[Names, ...] = ()
    """groups: who together."""
    flap_s: Span | None = None
    """The cut comes and goes: so often it is drawn whether it is there. By default it stays."""
    flap_share: Annotated[float, Meta(gt=0.0, lt=1.0)] | None = None
    """Share of the time in which it is there, if it flaps; by default half."""

    def severs(self, roster: Names) -> Severs:
        """Which links it cuts while it is there."""
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

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also parts that are none, and a cut of nothing."""
        yield from super().complaints(scenario)
        for key, shape in (("robots", "isolate"), ("groups", "groups")):
            if bool(getattr(self, key)) != (self.shape == shape):
                needs = "missing; set it" if self.shape == shape else f'only with shape = "{shape}"'
                yield f"{key}: {needs}"
        yield from complaints_of_names("robots", self.robots, scenario)
        for i, group in enumerate(self.groups):
            yield from complaints_of_names(f"groups[{i}]", group, scenario)
            yield from () if group else (f"groups[{i}]: nobody is in it; name somebody",)
        yield from complaints_of_names("groups", sum(self.groups, ()), scenario)
        if self.flap_share is not None and self.flap_s is None:
            yield "flap_share: only with flap_s; set it"
        if not _cuts_any(self.severs(scenario.roster), scenario.roster):
            yield f"shape: {self.shape} cuts no link of a team of {len(scenario.roster)}"


class Clog(OnLinks, frozen=True, kw_only=True, tag="clog"):
    """What is sent in the window arrives when it ends, in a burst, in the order of (sender, sequence)."""

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also a clog without an end."""
        yield from super().complaints(scenario)
        if self.until_s is None:
            yield "until_s: missing; a clog needs an end"


class Bandwidth(Fault, frozen=True, kw_only=True, tag="bandwidth"):
    """A sender has so many bytes a second; what is more waits behind what it sent before."""

    robots: Names = ()
    """Senders, each for itself; by default everybody."""
    bytes_per_s: Positive
    """Of message bodies. A message takes its time on the air whether anybody hears it or not."""
    queue_bytes: Annotated[int, Meta(ge=0, le=2**62)] | None = None
    """How much may wait; what finds more before it is dropped. By default everything waits."""

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also names that nobody has, and a trickle."""
        yield from super().complaints(scenario)
        yield from complaints_of_names("robots", self.robots, scenario)
        if self.bytes_per_s < 1e-3:
            yield f"bytes_per_s: {self.bytes_per_s:g} is less than a byte in 1000 s; use drop"


class Range(OnLinks, frozen=True, kw_only=True, tag="range"):
    """The radio reaches less far."""

    range_m: NotNegative | None = None
    """So far at most, the bound included."""
    factor: Probability | None = None
    """Or so many times as far as before."""

    def reach_m(self, range_m: float) -> float:
        """What is left of a range."""
        return (
            range_m * (self.factor or 0.0) if self.range_m is None else min(range_m, self.range_m)
        )

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also a range that does not shrink."""
        yield from super().complaints(scenario)
        if (self.range_m is None) == (self.factor is None):
            yield "range_m: set either range_m or factor"
            return
        whose = "supervisor" if scenario.centralized else "radio"
        before_m = scenario.supervisor.range_m if scenario.centralized else scenario.radio.range_m
        if self.factor is not None and before_m == math.inf:
            yield f"factor: {whose}.range_m is infinite and stays so; set range_m"
        if self.range_m is not None and self.range_m >= before_m:
            yield f"range_m: {whose}.range_m is {before_m:g} m already; set a shorter one"
        if scenario.centralized and scenario.mapping and scenario.supervisor.pose_m is None:
            yield "range_m: the supervisor has no place on the map; set supervisor.pose_m"


class Hostile(OnLinks, frozen=True, kw_only=True, tag="hostile"):
    """With this probability something that nobody sent comes beside a message, to be refused.

    It is in the sender's name, or in that of a stranger: noise, what is cut short, of another version,
    oversized, deeply nested, with numbers that are none, or of origins that nobody is.
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


def _cuts_any(severs: Severs, roster: Names) -> bool:
    return any(severs(one, other) for one in roster for other in roster if one != other)
