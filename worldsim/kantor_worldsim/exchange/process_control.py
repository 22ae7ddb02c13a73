"""What a world-sim process asks of whoever has started the processes of a fleet."""

from collections.abc import Callable
from typing import Literal, NamedTuple

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.processes import Disk


class ProcessCommand(NamedTuple):
    """One thing to be done to one process. The order is carried out when the answer comes."""

    what: Literal[
        "kill",  # SIGKILL; it is gone
        "start",  # kill it if it is there, see to its disk, and start it
        "freeze",  # SIGSTOP
        "thaw",  # SIGCONT
        "fill",  # it can write no more
        "free",  # it can write again
        "pretend",  # start a second process under this id
        "refused",  # what became of that; None: it is there still
        "restart",  # world-sim itself: SIGKILL, and after a while start it to resume; there is no answer
        "rest",  # world-sim itself: SIGSTOP, and after a while SIGCONT
    ]
    who: ParticipantId
    disk: Disk = "kept"
    step: int = 0
    """start: the last step that the world knows of."""
    after_s: float = 0.0
    """Real seconds."""


ProcessController = Callable[[ProcessCommand], bool | None]
"""Whoever carries out orders."""
