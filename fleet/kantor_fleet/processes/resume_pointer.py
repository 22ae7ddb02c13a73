"""The pointer to the current run of a world-sim that a container engine or systemd starts again when it dies.

The pointer is in its state folder and names the run and the machine. A container is a machine of its own: the same
container, started again, goes on with its run; a new one begins another.
"""

import socket
from pathlib import Path

import msgspec

from kantor_protocol.scenario.file_names import name_of, path_of
from kantor_protocol.storage.drafts import replace

_FILE = "worldsim.json"


class _ResumePointer(msgspec.Struct, frozen=True):
    machine: str
    run: str


def note(state: Path, run: Path) -> None:
    """Point to the run that this machine is in. Raises OSError."""
    state.mkdir(parents=True, exist_ok=True)
    pointer = _ResumePointer(socket.gethostname(), name_of(run.absolute()))
    replace(state / _FILE, lambda draft: draft.write_bytes(msgspec.json.encode(pointer)))


def run_in(state: Path) -> Path | None:
    """The run that this machine was in, if any."""
    try:
        pointer = msgspec.json.decode((state / _FILE).read_bytes(), type=_ResumePointer)
    except (OSError, msgspec.MsgspecError):
        return None
    return path_of(pointer.run) if pointer.machine == socket.gethostname() else None
