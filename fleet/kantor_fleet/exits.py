"""Exit codes, the same for every verb."""

import contextlib
import enum
import sys
from collections.abc import Iterable
from typing import NoReturn


class Exit(enum.IntEnum):
    """The exit code of a kantor command."""

    DONE = 0
    NOT_MET = 1
    """The mission was not met, or a checker found a violation."""
    USAGE = 2
    """Bad usage or scenario."""
    PROCESS_FAILED = 3
    UNREACHABLE = 4
    """The bus cannot be reached, or it refuses this process."""
    HUNG_UP = 129
    """Its terminal is gone."""
    INTERRUPTED = 130
    TERMINATED = 143


def fail(code: Exit, message: str) -> NoReturn:
    """Print one line to standard error and exit."""
    _tell(message)
    sys.exit(code)


def warn(messages: Iterable[str]) -> None:
    """Print a line for each warning to standard error."""
    for message in messages:
        _tell(f"warning: {message}")


def _tell(message: str) -> None:
    """Print a line to standard error, as far as that can be written."""
    with contextlib.suppress(OSError):
        print(f"kantor: {message}", file=sys.stderr, flush=True)
