"""Standard output that cannot be written: closed, full, or with no one to read it.

A mission goes on without it, because its record is what counts. The command says so in one line at its end.
"""

import io
import os
import sys
from typing import IO

_STANDARD = (0, 1, 2)


class _Descriptor(io.RawIOBase):
    """A descriptor that is written as long as that succeeds."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.error: OSError | None = None

    def writable(self) -> bool:
        """Yes."""
        return True

    def fileno(self) -> int:
        """The descriptor."""
        return self.number

    def isatty(self) -> bool:
        """Whether a terminal is there."""
        return os.isatty(self.number)

    def write(self, content: "memoryview | bytes", /) -> int:  # type: ignore[override]
        """Write all that is still wanted."""
        rest = memoryview(content)
        while rest and self.error is None:
            try:
                rest = rest[os.write(self.number, rest) :]
            except OSError as error:
                self.error = error
        return len(content)


class Output:
    """Standard output of the command. What cannot be written is dropped, and `error` says why."""

    def __init__(self) -> None:
        """Take over `sys.stdout`, unless it is not the one that the process began with."""
        self._closed = _open_standard()
        self._descriptor = _Descriptor(1)
        if self._closed or sys.stdout is sys.__stdout__:
            sys.stdout = self._text(sys.stdout)

    @property
    def error(self) -> str | None:
        """Why output was lost, if any was."""
        if self._closed:
            return "it is closed"
        error = self._descriptor.error
        return None if error is None else str(error.strerror)

    @property
    def unread(self) -> bool:
        """Whether its reader has enough, as `head` has."""
        return isinstance(self._descriptor.error, BrokenPipeError)

    def _text(self, former: "IO[str] | None") -> io.TextIOWrapper:
        if former is not None:
            former.flush()
        return io.TextIOWrapper(
            io.BufferedWriter(self._descriptor),  # type: ignore[type-var]
            encoding=getattr(former, "encoding", None) or "utf-8",
            errors="backslashreplace",
            line_buffering=self._descriptor.isatty(),
            write_through=bool(getattr(former, "write_through", False)),
        )


def _open_standard() -> bool:
    """Have no file of the command's own in the place of a standard one; whether output was closed."""
    closed = set()
    for number in _STANDARD:
        try:
            os.fstat(number)
        except OSError:
            closed.add(os.open(os.devnull, os.O_RDWR))
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    return 1 in closed


def is_lost() -> bool:
    """Whether standard output is lost, so that a command which does nothing but print may end."""
    buffer = getattr(sys.stdout, "buffer", None)
    raw = getattr(buffer, "raw", None)
    return isinstance(raw, _Descriptor) and raw.error is not None
