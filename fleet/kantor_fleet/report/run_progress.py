"""Progress of many runs on standard output: a bar in a terminal, plain lines elsewhere."""

import math
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from kantor_fleet.report.progress import printable

_LINE_S = 5.0
"""Real time from one plain line to the next."""
_AN_HOUR_S = 3600.0
_WIDTH = 160
"""Columns of a table that is printed into a file or a pipe."""


def table_console() -> Console:
    """The console for tables: as wide as the terminal, if it is one."""
    return Console(width=None if sys.stdout.isatty() else _WIDTH)


class RunProgressView:
    """Counts finished runs, reports failures, and estimates the time left."""

    def __init__(self, runs: int, monotonic: Callable[[], float] = time.monotonic) -> None:
        """runs: the number of runs to do."""
        terminal = sys.stdout.isatty()
        self._console = Console(force_terminal=terminal)
        self._bar = Progress(
            TextColumn("runs"),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("·"),
            TimeElapsedColumn(),
            TextColumn("· left"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not terminal,
            speed_estimate_period=_AN_HOUR_S,  # a run may take minutes
        )
        self._task = self._bar.add_task("", total=runs)
        self._plain = not terminal
        self._runs, self._done = runs, 0
        self._monotonic = monotonic
        self._started_s = monotonic()
        self._due_s = -math.inf
        self._reported: set[str] = set()

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def count(self, failed: str | None = None) -> None:
        """Count one more run. failed: the reason of a failure; each reason is printed once."""
        if failed is not None and failed not in self._reported:
            self._reported.add(failed)
            self.note(f"a run failed: {failed}")
        self._done += 1
        self._bar.advance(self._task)
        now_s = self._monotonic()
        if self._plain and (now_s >= self._due_s or self._done == self._runs):
            self._due_s = now_s + _LINE_S
            self.note(f"{self._done}/{self._runs} runs{self._left(now_s)}")

    def note(self, line: str) -> None:
        """Print a line, above the bar."""
        self._console.print(printable(line), markup=False, highlight=False, soft_wrap=True)

    def _left(self, now_s: float) -> str:
        left_s = (now_s - self._started_s) / self._done * (self._runs - self._done)
        minutes, seconds = divmod(round(left_s), 60)
        return f", about {minutes}:{seconds:02d} left" if self._done < self._runs else ""
