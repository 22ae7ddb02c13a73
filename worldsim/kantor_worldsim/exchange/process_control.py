"""Commands to real processes: what world-sim asks of the process that started the fleet."""

from collections.abc import Callable
from enum import Enum, auto
from typing import NamedTuple

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.processes import Disk


class CommandKind(Enum):
    """Kinds of commands."""

    KILL = auto()
    """SIGKILL."""
    START = auto()
    """Kill the process if it runs, damage its write-ahead log as `disk` says, and start it."""
    FREEZE = auto()
    """SIGSTOP."""
    THAW = auto()
    """SIGCONT."""
    FILL_DISK = auto()
    """Let no write succeed."""
    FREE_DISK = auto()
    """Let writes succeed again."""
    START_IMPOSTOR = auto()
    """Start a second process under the same id."""
    IS_IMPOSTOR_REFUSED = auto()
    """Answers whether the second process was refused; None: it still runs."""
    RESTART_WORLD_SIM = auto()
    """SIGKILL to world-sim, and after a while start it to resume; there is no answer."""
    REST_WORLD_SIM = auto()
    """SIGSTOP to world-sim, and after a while SIGCONT."""


class ProcessCommand(NamedTuple):
    """A command to one process. It is carried out when the answer arrives."""

    kind: CommandKind
    who: ParticipantId
    disk: Disk = "kept"
    step: int = 0
    """START: the last step that is on record."""
    after_s: float = 0.0
    """World-sim: real seconds until it goes on."""


ProcessController = Callable[[ProcessCommand], bool | None]
"""Carries out commands."""


def no_controller(command: ProcessCommand) -> bool | None:
    """The controller of processes that were started one by one, which refuses every command."""
    raise TypeError(f"{command.who}: faults of processes need the process that started the fleet")
