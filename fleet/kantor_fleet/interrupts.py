"""Signals as a value to poll, instead of an exception at any point."""

import signal
from types import FrameType
from typing import Self

from kantor_fleet.exits import Exit


class Interrupts:
    """Notes SIGINT and SIGTERM while the context is open; a second SIGINT raises KeyboardInterrupt."""

    def __init__(self, *, patient: bool = False) -> None:
        """patient: no signal raises, for a process that its parent ends, or that is about to end."""
        self._patient = patient
        self.code: Exit | None = None
        """The exit code, once a signal has arrived."""

    def __enter__(self) -> Self:
        self._before = {
            number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Whether a signal has arrived."""
        return self.code is not None

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.code is not None and number == signal.SIGINT and not self._patient:
            raise KeyboardInterrupt
        self.code = Exit.INTERRUPTED if number == signal.SIGINT else Exit.TERMINATED
