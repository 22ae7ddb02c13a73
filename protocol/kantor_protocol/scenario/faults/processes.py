"""Faults of processes: of robots, of the supervisor, and of world-sim itself.

In process and in lockstep they are played by whoever runs the mission, with the same record. On the wall
they are real: signals, new processes, limits of the operating system.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Literal

from msgspec import Meta

from kantor_protocol.base.machine import WORLD_SIM
from kantor_protocol.scenario.faults.base import Fault, Names, complaints_of_names

if TYPE_CHECKING:
    from kantor_protocol.scenario.schema import Scenario

Disk = Literal["kept", "torn", "lost"]
"""What a process that starts again finds of its snapshot: all, all but the end, or nothing."""


class OnProcesses(Fault, frozen=True, kw_only=True):
    """A fault of processes."""

    who: Annotated[Names, Meta(min_length=1)]
    """Participants, or worldsim where that is said."""

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also names that nobody has."""
        yield from super().complaints(scenario)
        participants = tuple(
            name for name in self.who if name != WORLD_SIM or not self.of_world_sim
        )
        yield from complaints_of_names("who", participants, scenario)

    @property
    def of_world_sim(self) -> bool:
        """Whether world-sim can have it too."""
        return False

    @property
    def stops(self) -> bool:
        """Whether the process does nothing within the window; two such windows must not overlap."""
        return True


class _WithEnd(OnProcesses, frozen=True, kw_only=True):
    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also one that never ends."""
        yield from super().complaints(scenario)
        if self.until_s is None:
            yield f"until_s: missing; a {self.__struct_config__.tag} needs an end"


class Kill(OnProcesses, frozen=True, kw_only=True, tag="kill"):
    """SIGKILL at from_s; at until_s it is started again, or never if there is none."""

    disk: Disk = "kept"
    """What is left of its snapshot. Whoever lacks what others may have comes back as a new incarnation."""
    mid_step: bool = False
    """It dies in its next step: after that was noted, before anybody heard of it."""

    @property
    def of_world_sim(self) -> bool:
        """It starts again from its journal."""
        return True

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also a mission without a world, or a world that forgets."""
        yield from super().complaints(scenario)
        if WORLD_SIM in self.who and self.until_s is None:
            yield "until_s: missing; a mission cannot end without world-sim"
        if WORLD_SIM in self.who and (self.disk != "kept" or self.mid_step):
            key = "disk" if self.disk != "kept" else "mid_step"
            yield f"{key}: only for participants; leave it out for worldsim"


class Pause(_WithEnd, frozen=True, kw_only=True, tag="pause"):
    """SIGSTOP at from_s, SIGCONT at until_s."""

    @property
    def of_world_sim(self) -> bool:
        """Everybody holds until it goes on."""
        return True


class Late(_WithEnd, frozen=True, kw_only=True, tag="late"):
    """It is not there from the start and joins at until_s."""

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also one that begins later, and a team of which nobody is there."""
        yield from super().complaints(scenario)
        if self.from_s > 0.0:
            yield "from_s: a late joiner is missing from the start; leave it out"
        if set(scenario.robot_ids) <= set(self.who):
            yield "who: nobody would be there at the start; leave out a robot"


class Slow(OnProcesses, frozen=True, kw_only=True, tag="slow"):
    """It gets to only one of so many of its steps; what it hears waits meanwhile."""

    every: Annotated[int, Meta(ge=2, le=1000)]


class FullDisk(_WithEnd, frozen=True, kw_only=True, tag="full-disk"):
    """It cannot write its snapshot; what it cannot note it must not do."""


class ClockFault(OnProcesses, frozen=True, kw_only=True, tag="clock"):
    """Its clock jumps at from_s, runs wrong, and jumps back to the right time at until_s."""

    offset_s: Annotated[float, Meta(ge=-3600.0, le=3600.0)] = 0.0
    rate_ppm: Annotated[float, Meta(ge=-50_000.0, le=50_000.0)] = 0.0
    """Runs fast, in parts per million."""

    @property
    def stops(self) -> bool:
        """It goes on."""
        return False

    def skew_ns(self, now_ns: int) -> int:
        """How far it is ahead at a time in the window."""
        drift_ns = (now_ns - self.from_ns) * round(self.rate_ppm) // 1_000_000
        return round(self.offset_s * 1e9) + drift_ns

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also a clock that is right."""
        yield from super().complaints(scenario)
        if self.offset_s == 0.0 and round(self.rate_ppm) == 0:
            yield "offset_s: the clock is right; set it, or rate_ppm"


class Impostor(OnProcesses, frozen=True, kw_only=True, tag="impostor"):
    """At from_s a second process asks to join under the same id, with the right credentials."""

    @property
    def stops(self) -> bool:
        """It is somebody else."""
        return False

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Also an end, which it does not have."""
        yield from super().complaints(scenario)
        if self.until_s is not None:
            yield "until_s: an impostor asks once, at from_s; leave it out"


ProcessFault = Kill | Pause | Late | Slow | FullDisk | ClockFault | Impostor
