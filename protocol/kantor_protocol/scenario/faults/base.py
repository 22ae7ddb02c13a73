"""What every fault has."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated

from msgspec import Meta

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.types import ScenarioTable, Seconds

if TYPE_CHECKING:
    from kantor_protocol.scenario.schema import Scenario

Share = Annotated[float, Meta(gt=0.0, le=1.0)]
"""A probability of something that can happen."""
Span = Annotated[float, Meta(ge=1e-3, le=1e6)]
"""Seconds that pass."""
Names = tuple[ParticipantId, ...]


class Fault(ScenarioTable, frozen=True, kw_only=True, tag_field="kind"):
    """What every fault has: a window, its end excluded, in simulated time since the mission's start."""

    from_s: Seconds = 0.0
    until_s: Seconds | None = None
    """By default it never ends."""

    @property
    def from_ns(self) -> int:
        """When it begins."""
        return round(self.from_s * 1e9)

    @property
    def until_ns(self) -> int | None:
        """When it is over, or None."""
        return None if self.until_s is None else round(self.until_s * 1e9)

    def holds(self, now_ns: int) -> bool:
        """Whether a time is in its window."""
        return self.from_ns <= now_ns and (self.until_ns is None or now_ns < self.until_ns)

    def complaints(self, scenario: "Scenario") -> Iterable[str]:
        """Why it cannot apply to a scenario: `key: what, and the remedy`."""
        if self.until_ns is not None and self.until_ns <= self.from_ns:
            yield f"until_s: {self.until_s:g} s is not after from_s, {self.from_s:g} s; set a later end"
        if self.from_ns >= scenario.limit_ns:
            limit_s = scenario.limit_ns * 1e-9
            yield f"from_s: {self.from_s:g} s is never reached; the mission is cut at {limit_s:g} s"


def complaints_of_names(key: str, names: Names, scenario: "Scenario") -> Iterable[str]:
    """Names that nobody has, or that stand there twice."""
    roster = scenario.roster
    for name in names:
        if name not in roster:
            known = f"{roster[0]} to r{scenario.robots.count}"
            known += " and supervisor" if scenario.centralized else ""
            yield f"{key}: {name} is not in the team; known: {known}"
        elif names.count(name) > 1:
            yield f"{key}: {name} is named twice; name it once"
