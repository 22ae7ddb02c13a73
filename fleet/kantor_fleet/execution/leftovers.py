"""What is left on the disk when a command is killed, and the process that removes it then.

The process is a fork that sleeps until the command has ended. It is in a session of its own, so that what ends the
command and its group does not end it.
"""

import contextlib
import os
import shutil
import signal
import time
from pathlib import Path
from typing import Self

from kantor_worldsim.record.run_folder import FolderLock, ResumeError, remove_if_empty

_WRITERS_END_S = 10.0
"""Time in which the processes that write a run folder end after the command."""
_DONE = b"\0done\0"


class Leftovers:
    """Folders to be removed when this process is killed. A context; on leaving it in any other way nothing is done."""

    def __init__(self, temporary: Path) -> None:
        """temporary: a folder that no one needs without this process."""
        told, self._telling = os.pipe()
        self._cleaner = os.fork()
        if self._cleaner == 0:
            try:
                os.close(self._telling)
                _clean_up(told, temporary)
            finally:
                os._exit(0)
        os.close(told)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        with contextlib.suppress(BrokenPipeError):
            os.write(self._telling, _DONE)
        os.close(self._telling)
        os.waitpid(self._cleaner, 0)

    def add_run(self, folder: Path) -> None:
        """Add a run folder, which is removed if nothing has happened in its run."""
        with contextlib.suppress(BrokenPipeError):
            os.write(self._telling, os.fsencode(folder.absolute()) + b"\0")


def _clean_up(told: int, temporary: Path) -> None:
    """Wait for the end of the command, and remove what it could not."""
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):  # a reader of the command's output does not wait for this
        os.dup2(nowhere, descriptor)
    content = b""
    while part := os.read(told, 1 << 16):
        content += part
    if content.endswith(_DONE):
        return
    shutil.rmtree(temporary, ignore_errors=True)
    for folder in filter(None, content.split(b"\0")):
        _remove_run(Path(os.fsdecode(folder)))


def _remove_run(folder: Path) -> None:
    """Remove a run folder in which nothing has happened, once no process writes it any more."""
    give_up = time.monotonic() + _WRITERS_END_S
    while time.monotonic() < give_up:
        try:
            with FolderLock(folder):
                remove_if_empty(folder)
        except ResumeError:
            if not folder.exists():
                return
            time.sleep(0.02)
        else:
            return
