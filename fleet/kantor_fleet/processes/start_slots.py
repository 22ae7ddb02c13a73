"""Slots for starting: a large team starts a few processes at a time.

Three hundred processes that start at once keep one another from a processor for seconds: sessions that are open
already expire, and connecting again takes as long.
"""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

from kantor_protocol.storage import private_files

_SLOTS = 4 * (os.cpu_count() or 1)


def take_slot(folder: Path) -> Callable[[], None]:
    """Wait for this process's slot; what gives it back, which its end does as well. folder: of the slots of a fleet."""
    private_files.make_folder(folder)
    file = (folder / f"slot-{os.getpid() % _SLOTS}").open("wb")
    fcntl.flock(file, fcntl.LOCK_EX)
    return file.close
