"""The base class of all faults."""

from typing import Annotated

from msgspec import Meta

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.types import ScenarioTable, Seconds

Share = Annotated[float, Meta(gt=0.0, le=1.0)]
"""A probability of something that can happen."""
Span = Annotated[float, Meta(ge=1e-3, le=1e6)]
"""Seconds that pass."""
Names = tuple[ParticipantId, ...]


class Fault(ScenarioTable, frozen=True, kw_only=True, tag_field="kind"):
    """A fault within a window of simulated time since the mission's start, its end excluded."""

    from_s: Seconds = 0.0
    until_s: Seconds | None = None
    """By default it never ends."""

    @property
    def from_ns(self) -> int:
        """The begin of the window."""
        return round(self.from_s * 1e9)

    @property
    def until_ns(self) -> int | None:
        """The end of the window, or None."""
        return None if self.until_s is None else round(self.until_s * 1e9)

    def holds(self, now_ns: int) -> bool:
        """Whether a time is in its window."""
        return self.from_ns <= now_ns and (self.until_ns is None or now_ns < self.until_ns)
