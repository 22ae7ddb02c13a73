"""Signals as a value to ask for, instead of an exception anywhere."""

import signal
from types import FrameType
from typing import Self

from kantor_fleet.exits import Exit


class Interrupts:
    """Notes SIGINT and SIGTERM while the context is open; the second SIGINT interrupts for good."""

    def __init__(self, *, patient: bool = False) -> None:
        """patient: no number of signals interrupts; somebody else sees to it that this ends."""
        self._patient = patient
        self.code: Exit | None = None
        """What to exit with, once a signal has come."""

    def __enter__(self) -> Self:
        self._before = {
            number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        """Whether a signal has come."""
        return self.code is not None

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.code is not None and number == signal.SIGINT and not self._patient:
            raise KeyboardInterrupt
        self.code = Exit.INTERRUPTED if number == signal.SIGINT else Exit.TERMINATED
