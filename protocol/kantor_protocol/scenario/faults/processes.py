"""Faults of processes: of robots, of the supervisor, and of world-sim itself.

In process and in lockstep the event loop of the mission simulates them, with the same record. In the realtime
exchange they are real: signals, new processes, limits of the operating system.
"""

from typing import Annotated, Literal

from msgspec import Meta

from kantor_protocol.scenario.faults.base import Fault, Names

Disk = Literal["kept", "torn", "lost"]
"""What is left of the write-ahead log of a process that starts again: all, all but the end, or nothing."""


class OnProcesses(Fault, frozen=True, kw_only=True):
    """A fault of processes."""

    who: Annotated[Names, Meta(min_length=1)]
    """Participants; worldsim as well where `of_world_sim` is true."""

    @property
    def of_world_sim(self) -> bool:
        """Whether world-sim can have it too."""
        return False

    @property
    def stops(self) -> bool:
        """Whether the process does nothing within the window; two such windows must not overlap."""
        return True


class WithEnd(OnProcesses, frozen=True, kw_only=True):
    """A fault of processes that must end."""


class Kill(OnProcesses, frozen=True, kw_only=True, tag="kill"):
    """SIGKILL at from_s; at until_s it is started again, or never if there is none."""

    disk: Disk = "kept"
    """What is left of its write-ahead log. A participant whose log lacks a step comes back as a new incarnation."""
    mid_step: bool = False
    """It is killed in its next step: after that was written to the log, before it was reported."""

    @property
    def of_world_sim(self) -> bool:
        """It can: it starts again from its journal."""
        return True


class Pause(WithEnd, frozen=True, kw_only=True, tag="pause"):
    """SIGSTOP at from_s, SIGCONT at until_s."""

    @property
    def of_world_sim(self) -> bool:
        """It can: all participants hold until it goes on."""
        return True


class Late(WithEnd, frozen=True, kw_only=True, tag="late"):
    """It is missing from the start and joins at until_s."""


class Slow(OnProcesses, frozen=True, kw_only=True, tag="slow"):
    """It makes only one of so many of its steps; messages to it wait meanwhile."""

    every: Annotated[int, Meta(ge=2, le=1000)]


class FullDisk(WithEnd, frozen=True, kw_only=True, tag="full-disk"):
    """It cannot write its write-ahead log, and so must make no step."""


class ClockFault(OnProcesses, frozen=True, kw_only=True, tag="clock"):
    """Its clock jumps at from_s, runs wrong, and jumps back to the right time at until_s."""

    offset_s: Annotated[float, Meta(ge=-3600.0, le=3600.0)] = 0.0
    rate_ppm: Annotated[float, Meta(ge=-50_000.0, le=50_000.0)] = 0.0
    """Runs fast, in parts per million."""

    @property
    def stops(self) -> bool:
        """It does not: the process goes on."""
        return False

    def skew_ns(self, now_ns: int) -> int:
        """How far the clock is ahead at a time in the window."""
        drift_ns = (now_ns - self.from_ns) * round(self.rate_ppm) // 1_000_000
        return round(self.offset_s * 1e9) + drift_ns


class Impostor(OnProcesses, frozen=True, kw_only=True, tag="impostor"):
    """At from_s a second process asks to join under the same id, with the right credentials."""

    @property
    def stops(self) -> bool:
        """It does not: the impostor is another process."""
        return False


ProcessFault = Kill | Pause | Late | Slow | FullDisk | ClockFault | Impostor
