"""Exit codes, the same for every verb."""

import enum
import sys
from collections.abc import Iterable
from typing import NoReturn


class Exit(enum.IntEnum):
    """What a process of kantor ends with."""

    DONE = 0
    NOT_MET = 1
    """The mission was not met, or a checker found a fault."""
    USAGE = 2
    """Bad usage or scenario."""
    PROCESS_FAILED = 3
    UNREACHABLE = 4
    """The bus cannot be reached or refuses us."""
    INTERRUPTED = 130
    TERMINATED = 143


def fail(code: Exit, message: str) -> NoReturn:
    """One line to standard error, and out."""
    print(f"kantor: {message}", file=sys.stderr)
    sys.exit(code)


def warn(messages: Iterable[str]) -> None:
    """A line each to standard error, and on."""
    for message in messages:
        print(f"kantor: warning: {message}", file=sys.stderr)
