"""A figure of a paper: what it needs run, what it claims, how it is drawn and told."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure as Picture

from kantor_fleet.reproduce.claims import Claim
from kantor_fleet.reproduce.measured_runs import MeasuredRuns, Setting
from kantor_fleet.sweep.table import Row
from kantor_worldsim.observers.metrics.result import Result

RunRequests = Mapping[Setting, Sequence[int]]
"""The seeds that each setting is run with."""


class ResultTable(NamedTuple):
    """Numbers that a figure tells beside its claims."""

    title: str
    rows: list[Row]
    """As in the CSV."""
    shown: list[Row]
    """For a person, a text in every column."""


class PaperFigure(NamedTuple):
    """A figure of a paper."""

    title: str
    runs: int
    """For each setting, as in the paper where it says so."""
    claims: tuple[Claim, ...]
    draw: Callable[[MeasuredRuns], Picture]
    row: Callable[[Result], Row]
    """What the CSV says of a run."""
    drawn: tuple[Setting, ...] = ()
    """Settings that are drawn, though nothing is claimed of them."""
    select: Callable[[int], RunRequests] | None = None
    """What is flown if `runs` counts something else than the runs for each setting."""
    table: Callable[[MeasuredRuns], ResultTable] | None = None
    kept: bool = False
    """Finished runs are kept in the folder, so that the same command goes on from there."""

    def requests(self) -> RunRequests:
        """What it needs run."""
        if self.select is not None:
            return self.select(self.runs)
        claimed = (setting for claim in self.claims for setting in claim.settings)
        return {setting: range(min(self.runs, setting.most)) for setting in (*claimed, *self.drawn)}
