"""Membership: which process plays which participant, by the nonce that each process has drawn for itself. Pure.

1. One process at a time plays a participant. While it is on the bus, no other process is admitted under its id.
2. When it has left, the next process that joins takes its place, and the earlier one is *fenced*: if it was only
   frozen and wakes up later, it is refused, because two writers must never share a log.
3. A process that left and joins again with no other in between goes on.
"""

from collections.abc import Iterable
from enum import Enum, auto

from kantor_protocol.base.machine import ParticipantId

FENCED_MAX = 65_536
"""Replaced processes that are remembered: a participant that replaces itself again and again fills no memory."""


class JoinDecision(Enum):
    """Decision on a process that asks to join."""

    NEW = auto()
    """It plays the participant from now on, and needs its mission."""
    BACK = auto()
    """It played the participant before, and goes on."""
    UNKNOWN = auto()
    """The id is not in the roster."""
    TAKEN = auto()
    """Another process plays the participant and is on the bus."""
    FENCED = auto()
    """Another process has taken its place."""


REFUSALS = {
    JoinDecision.UNKNOWN: "is not in the team; choose another id",
    JoinDecision.TAKEN: "is on the bus already; stop the other process or choose another id",
    JoinDecision.FENCED: "was gone, and another process has taken its place; start it again to take turns",
}
"""The reason that a refused process is given."""


class Membership:
    """The processes that play the participants of a roster."""

    def __init__(self, roster: Iterable[ParticipantId]) -> None:
        self._last: dict[ParticipantId, str] = dict.fromkeys(roster, "")
        """Nonce of the process that plays each participant or played it last; empty: none has."""
        self._present: set[ParticipantId] = set()
        """Participants whose process is on the bus; each has a nonce."""
        self._fenced: dict[str, None] = {}
        """Nonces of the last replaced processes, in order; none of them plays a participant."""

    def join(self, name: ParticipantId, nonce: str) -> JoinDecision:
        """Decide on a process that asks to join."""
        if name not in self._last:
            return JoinDecision.UNKNOWN
        if nonce in self._fenced:
            return JoinDecision.FENCED
        last = self._last[name]
        if nonce == last:
            self._present.add(name)
            return JoinDecision.BACK
        if name in self._present:
            return JoinDecision.TAKEN
        if last:
            self._fence(last)
        self._last[name] = nonce
        self._present.add(name)
        return JoinDecision.NEW

    def _fence(self, nonce: str) -> None:
        self._fenced[nonce] = None
        if len(self._fenced) > FENCED_MAX:
            del self._fenced[next(iter(self._fenced))]

    def leave(self, name: ParticipantId, nonce: str) -> bool:
        """Note that a process has left; whether it was the one that plays the participant."""
        if not self.plays(name, nonce):
            return False
        self._present.discard(name)
        return True

    def plays(self, name: ParticipantId, nonce: str) -> bool:
        """Whether this process plays the participant and is on the bus."""
        return name in self._present and self._last[name] == nonce

    def player(self, name: ParticipantId) -> str | None:
        """Nonce of the process on the bus that plays a participant."""
        return self._last[name] if name in self._present else None
