"""Signals as a value to poll, instead of an exception at any point."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Self

from kantor_fleet.exits import Exit

_CODES = {
    signal.SIGHUP: Exit.HUNG_UP,
    signal.SIGINT: Exit.INTERRUPTED,
    signal.SIGTERM: Exit.TERMINATED,
}


class Interrupted(KeyboardInterrupt):
    """A signal ends the command at once."""

    def __init__(self, code: Exit) -> None:
        super().__init__()
        self.code = code
        """The exit code."""


class Interrupts:
    """Notes SIGINT, SIGTERM and SIGHUP while the context is open; a second SIGINT raises Interrupted.

    SIGHUP that is ignored, as under nohup, stays so.
    """

    def __init__(self, *, patient: bool = False) -> None:
        """patient: no signal raises, for a process that its parent ends, or that is about to end."""
        self._patient = patient
        self._at_once = False
        self.code: Exit | None = None
        """The exit code, once a signal has arrived."""

    def __enter__(self) -> Self:
        self._before = {
            number: signal.signal(number, self._note)
            for number in _CODES
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN
        }
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Whether a signal has arrived."""
        return self.code is not None

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Raise Interrupted at the first signal, or if there was one: what is done here can be abandoned."""
        self._at_once = True
        try:
            if self.code is not None:
                raise Interrupted(self.code)
            yield
        finally:
            self._at_once = False

    def _note(self, number: int, _frame: FrameType | None) -> None:
        again = self.code is not None and number == signal.SIGINT and not self._patient
        self.code = _CODES[signal.Signals(number)]
        if again or self._at_once:
            raise Interrupted(self.code)
