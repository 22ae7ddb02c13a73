"""A radio with link faults, the envelopes that it transmits, and its decisions as plain values."""

import itertools
from collections.abc import Sequence

import msgspec

from kantor_protocol.base.machine import EVERYBODY, Envelope, ParticipantId, Pose
from kantor_protocol.scenario.faults.schedule import AnyFault
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.radio.channel import DROPPED, Channel, DeliveryDecision, Sent
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.world.maps import Ground
from support.strategies import mission

MS = 1_000_000
S = 1_000 * MS

PLACES = {"r2": (30.0, 0.0), "r3": (60.0, 0.0)}
"""Robots in a row, 30 m apart; r1 is at the origin."""
ALL_LINKS = {f"{one}>{other}" for one, other in itertools.permutations(("r1", "r2", "r3"), 2)}
"""Links of three robots, as source>target."""


class FaultyRadio:
    """A channel under faults, with all participants in one place but for those in `at`."""

    def __init__(
        self,
        *faults: AnyFault,
        scenario: Scenario | None = None,
        seed: int = 1,
        at: dict[ParticipantId, tuple[float, float]] | None = None,
        ground: Ground | None = None,
    ) -> None:
        self.scenario = msgspec.structs.replace(scenario or mission(), faults=faults)
        self.faults = LinkFaults(self.scenario, seed)
        self.channel = Channel(self.scenario, seed, ground, self.faults.rule)
        for name in self.scenario.roster:
            self.channel.place(name, Pose(*(at or {}).get(name, (0.0, 0.0))))

    def transmit(self, *sent: Sent) -> list[DeliveryDecision]:
        """Decisions on envelopes."""
        return self.channel.transmit(sent)[0]

    @property
    def fault_stats(self) -> dict[int, dict[str, int]]:
        """Effects of each fault, without counters that are zero."""
        return {
            stats.fault: {
                k: n for k, n in msgspec.structs.asdict(stats).items() if n and k != "fault"
            }
            for stats in self.faults.pop_stats()
        }


def sent_by(
    source: ParticipantId,
    sequence: int,
    now_ns: int = 0,
    target: ParticipantId = EVERYBODY,
    size: int = 0,
) -> Sent:
    """An envelope on the radio."""
    return Sent(now_ns, Envelope(source, sequence, target, bytes(size)))


def broadcasts(count: int, roster: Sequence[str] = ("r1", "r2", "r3"), size: int = 0) -> list[Sent]:
    """`count` broadcasts of each participant, 100 ms apart."""
    return [
        sent_by(name, sequence, 100 * MS * sequence, size=size)
        for sequence in range(1, count + 1)
        for name in roster
    ]


def dues(decisions: Sequence[DeliveryDecision]) -> list[int]:
    return [decision.due_ns for decision in decisions]


def reached(decisions: Sequence[DeliveryDecision]) -> set[str]:
    """Links over which a copy passed, as source>target."""
    return {f"{v.source}>{v.target}" for v in decisions if v.due_ns != DROPPED}
