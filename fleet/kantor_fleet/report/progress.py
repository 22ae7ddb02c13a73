"""Progress of a mission on standard output: a panel in a terminal, plain lines elsewhere."""

import math
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.constrain import Constrain
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from kantor_protocol.wire.messages import Progress

_LINE_S = 1.0
"""Real time from one plain line to the next."""
_PANEL_S = 0.1
"""Real time from one refresh of the panel to the next."""
_PANEL_COLUMNS = 78


class ProgressView:
    """Shows progress at a limited rate, so that a person or a log can follow.

    Used as a context manager. However fast the mission runs, the first and the last progress are
    shown.
    """

    def __init__(
        self,
        scenario: str,
        console: Console | None = None,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """scenario: its name. monotonic: seconds of real time, for the rate alone."""
        # rich would take forced colours (FORCE_COLOR) for a terminal; a panel needs a real one.
        self._console = console or Console(force_terminal=sys.stdout.isatty())
        self._scenario = scenario
        self._monotonic = monotonic
        self._due_s = -math.inf
        self._pending: Progress | None = None
        self._over = False
        self._line = ""
        self._live: Live | None = None
        if self._console.is_terminal and not self._console.is_dumb_terminal:
            self._live = Live(console=self._console, auto_refresh=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Show what is pending, and leave the terminal to others."""
        self._show_pending()
        if self._live is not None:
            self._live.stop()

    def show(self, progress: Progress) -> None:
        """Show progress if it is due, the first, or the end of the mission; else keep it for later."""
        self._pending = progress
        ends = progress.phase == "over" and not self._over
        self._over = progress.phase == "over"
        if ends or self._monotonic() >= self._due_s:
            self._show_pending()

    def note(self, line: str) -> None:
        """Print a line, above the panel."""
        self._console.out(printable(line), highlight=False)

    def _show_pending(self) -> None:
        progress, self._pending = self._pending, None
        if progress is None:
            return
        if self._live is not None:
            self._due_s = self._monotonic() + _PANEL_S
            self._live.start()  # not before the first progress, so that nothing empty is shown
            self._live.update(panel_of(self._scenario, progress), refresh=True)
            return
        self._due_s = self._monotonic() + _LINE_S
        line = line_of(progress)
        if line != self._line:  # a long wait is one line in a log
            self.note(line)
        self._line = line


def line_of(progress: Progress) -> str:
    """Progress as one plain line."""
    parts = [_time(progress)]
    if progress.phase == "waiting":
        return f"{parts[0]}  {_phase(progress)}"
    parts.append(f"explored {_explored(progress)}")
    parts += [f"{name} {value}" for name, value in _figures(progress)]
    if progress.phase != "running" or progress.detail:
        parts.append(_phase(progress))
    return "  ".join(parts)


def panel_of(scenario: str, progress: Progress) -> RenderableType:
    """Progress as a small panel: the share explored, the figures and the phase."""
    explored = Table.grid(padding=(0, 1), expand=True)
    explored.add_column()
    explored.add_column(ratio=1)
    explored.add_column(justify="right")
    bar = ProgressBar(total=1.0, completed=1.0 - progress.mass_left)
    explored.add_row("explored", bar, _explored(progress))

    rows: list[RenderableType] = [Text(_phase(progress), style=_STYLES.get(progress.phase, ""))]
    if progress.phase != "waiting":
        figures = [Text.assemble((f"{name} ", "dim"), value) for name, value in _figures(progress)]
        rows = [explored, Columns(figures, padding=(0, 3)), *rows]
    title = Text.assemble((printable(scenario), "bold"), f"  {_time(progress)}")
    return Constrain(Panel(Group(*rows), title=title, title_align="left"), _PANEL_COLUMNS)


def printable(text: str) -> str:
    """Text with a question mark for each control character: it may come from another process."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


_STYLES = {"waiting": "yellow", "running": "green", "over": "cyan"}


def _explored(progress: Progress) -> str:
    """Share of the mass that is used up, or of the map that any robot has seen."""
    return f"{100.0 * (1.0 - progress.mass_left):.0f} %"


def _figures(progress: Progress) -> list[tuple[str, str]]:
    """Names and values of the figures, in the order in which they are shown."""
    detected = [("detected", f"{progress.detected}/{progress.targets}")] if progress.targets else []
    if progress.distance_m is not None:  # a mission on a map has neither energy nor bound
        figures = [("distance", f"{progress.distance_m:.0f} m"), *detected]
    else:
        energy = f"{progress.energy_spent}/{progress.energy_total}"
        bound = f"{progress.w_ub:.1f}" if progress.w_ub >= 100.0 else f"{progress.w_ub:.4g}"
        figures = [("energy", energy), *detected, ("W_UB", bound)]
    return [
        *figures,
        ("links", f"{progress.links}"),
        ("msg/s", f"{progress.messages_per_s:.0f}"),
        ("done", f"{progress.robots_done}/{progress.robots}"),
    ]


def _time(progress: Progress) -> str:
    return f"t={progress.now_ns * 1e-9:6.1f} s"


def _phase(progress: Progress) -> str:
    detail = printable(progress.detail)
    if progress.phase == "waiting":
        return f"waiting for {detail}" if detail else "waiting"
    phase = printable(progress.phase)
    return f"{phase}: {detail}" if detail else phase
