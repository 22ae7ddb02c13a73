"""A world-sim that its engine starts again whenever it dies: which run it is in.

Its state folder names the run and the machine. A container is a machine of its own: the same one, started again, goes
on with its run, and a new one begins another.
"""

import socket
from pathlib import Path

import msgspec

_FILE = "worldsim.json"


class _Standing(msgspec.Struct, frozen=True):
    machine: str
    run: str


def note(state: Path, run: Path) -> None:
    """This machine is in this run. Raises OSError."""
    state.mkdir(parents=True, exist_ok=True)
    draft = state / f".{_FILE}"
    draft.write_bytes(msgspec.json.encode(_Standing(socket.gethostname(), str(run))))
    draft.replace(state / _FILE)


def run_in(state: Path) -> Path | None:
    """The run that this machine was last in, if any."""
    try:
        standing = msgspec.json.decode((state / _FILE).read_bytes(), type=_Standing)
    except (OSError, msgspec.MsgspecError):
        return None
    return Path(standing.run) if standing.machine == socket.gethostname() else None
