"""Process events: their kinds in a mission, and the consequences of each kind.

The values of the enum stand in records and are a contract.
"""

from enum import StrEnum
from typing import NamedTuple


class ProcessEventKind(StrEnum):
    """Kinds of process events."""

    KILL = "kill"
    """SIGKILL."""
    START = "start"
    """Started again, or for the first time where the process is late."""
    PAUSE = "pause"
    """SIGSTOP."""
    RESUME = "resume"
    """SIGCONT."""
    FILL = "fill"
    """No write to its disk succeeds from now on."""
    FREE = "free"
    """Its disk has room again."""
    SLOW = "slow"
    """Only one in so many of its steps is made from now on."""
    QUICKEN = "quicken"
    """Every step is made again."""
    SKEW = "skew"
    """Its clock jumps, and may run wrong."""
    RIGHT = "right"
    """Its clock jumps back to the right time."""
    IMPOSTOR_REFUSED = "pretend"
    """A second process asked to join under its id, and was refused. Also the command to start one."""
    IMPOSTOR_ADMITTED = "let in"
    """A second process asked to join under its id, and was admitted, which must not happen."""
    LEAVE = "leave"
    """The process left the bus although no fault is the cause."""
    JOIN = "join"
    """The process is back on the bus after it left, or joined late, although no fault is the cause."""


class EventRules(NamedTuple):
    """Consequences of a kind of process event."""

    counter: str = ""
    """Counter of `result.json` for the fault that is the cause (`FaultCounts`); empty: none."""
    signal: str = ""
    """Signal or action that carries out the event on a real process; empty: none."""
    ended_by: ProcessEventKind | None = None
    """The process makes no step from this event until that one; None: it goes on."""
    takes_over: bool = False
    """A process takes over the participant's body; the event has the step and the incarnation from which it goes on."""


EVENTS = {
    ProcessEventKind.KILL: EventRules("killed", "SIGKILL", ended_by=ProcessEventKind.START),
    ProcessEventKind.START: EventRules("started", "start", takes_over=True),
    ProcessEventKind.PAUSE: EventRules("paused", "SIGSTOP", ended_by=ProcessEventKind.RESUME),
    ProcessEventKind.RESUME: EventRules("resumed", "SIGCONT"),
    ProcessEventKind.FILL: EventRules("filled", "RLIMIT_FSIZE", ended_by=ProcessEventKind.FREE),
    ProcessEventKind.FREE: EventRules("freed", "RLIMIT_FSIZE"),
    ProcessEventKind.SLOW: EventRules("slowed", "SIGSTOP and SIGCONT in turn"),
    ProcessEventKind.QUICKEN: EventRules("quickened", "SIGCONT"),
    ProcessEventKind.SKEW: EventRules("skewed"),
    ProcessEventKind.RIGHT: EventRules("righted"),
    ProcessEventKind.IMPOSTOR_REFUSED: EventRules("refused", "start"),
    ProcessEventKind.IMPOSTOR_ADMITTED: EventRules("let_in", "start"),
    ProcessEventKind.LEAVE: EventRules(ended_by=ProcessEventKind.JOIN),
    ProcessEventKind.JOIN: EventRules(takes_over=True),
}
"""The rules of every kind."""

WITHOUT_CAUSE = frozenset({ProcessEventKind.LEAVE, ProcessEventKind.JOIN})
"""Kinds that no fault of a scenario orders."""

TAKE_OVER = frozenset(kind for kind, rules in EVENTS.items() if rules.takes_over)
"""Kinds by which a process takes over a participant's body."""
