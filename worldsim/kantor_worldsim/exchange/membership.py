"""Who plays whom: a pure register of processes, by the nonce that each of them has for itself.

1. One process at a time plays a participant. While it is on the bus, no other gets in under its id.
2. When it has left, the next that comes takes its place, and the one before is *fenced*: should it have been
   frozen only, and wake up later, it is refused, for two writers must never share a log.
3. A process that left and comes back with nobody in between goes on.
"""

from collections.abc import Iterable
from enum import Enum, auto

from kantor_protocol.base.machine import ParticipantId


class JoinDecision(Enum):
    """What becomes of a process that asks to join."""

    NEW = auto()
    """It plays the participant from now on, and needs its mission."""
    BACK = auto()
    """It played it before, and goes on."""
    UNKNOWN = auto()
    """Nobody of that name is in the team."""
    TAKEN = auto()
    """Another process plays it and is on the bus."""
    FENCED = auto()
    """Another process has taken its place."""


REFUSALS = {
    JoinDecision.UNKNOWN: "is not in the team; choose another id",
    JoinDecision.TAKEN: "is on the bus already; stop the other process or choose another id",
    JoinDecision.FENCED: "was gone, and another process has taken its place; start it again to take turns",
}
"""Why a process is not let in."""


class Membership:
    """The register."""

    def __init__(self, roster: Iterable[ParticipantId]) -> None:
        self._last: dict[ParticipantId, str] = dict.fromkeys(roster, "")
        """Nonce of the process that played each participant last, or plays it; empty: nobody has."""
        self._here: set[ParticipantId] = set()
        self._fenced: set[str] = set()

    def join(self, name: ParticipantId, nonce: str) -> JoinDecision:
        """A process has come."""
        if name not in self._last:
            return JoinDecision.UNKNOWN
        if nonce in self._fenced:
            return JoinDecision.FENCED
        last = self._last[name]
        if nonce == last:
            self._here.add(name)
            return JoinDecision.BACK
        if name in self._here:
            return JoinDecision.TAKEN
        if last:
            self._fenced.add(last)
        self._last[name] = nonce
        self._here.add(name)
        return JoinDecision.NEW

    def leave(self, name: ParticipantId, nonce: str) -> bool:
        """A process has gone; whether it was the one that plays."""
        if not self.plays(name, nonce):
            return False
        self._here.discard(name)
        return True

    def plays(self, name: ParticipantId, nonce: str) -> bool:
        """Whether this process plays that participant, and is on the bus."""
        return name in self._here and self._last[name] == nonce

    def player(self, name: ParticipantId) -> str | None:
        """The nonce of the process on the bus that plays a participant."""
        return self._last[name] if name in self._here else None
