"""A figure of a paper: the runs that it needs, its claims, its drawing and its table."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from matplotlib.figure import Figure as Picture

from kantor_fleet.reproduce.claims import Claim
from kantor_fleet.reproduce.measured_runs import MeasuredRuns, Setting
from kantor_fleet.sweep.table import Row
from kantor_worldsim.observers.metrics.result import Result

RunRequests = Mapping[Setting, Sequence[int]]
"""The seeds to run of each setting."""


class ResultTable(NamedTuple):
    """Numbers that a figure prints beside its claims."""

    title: str
    rows: list[Row]
    """The rows of the CSV file."""
    shown: list[Row]
    """The rows that are printed, with a text in every column."""


class PaperFigure(NamedTuple):
    """A figure of a paper."""

    title: str
    runs: int
    """Runs of each setting, as in the paper where it gives a number."""
    claims: tuple[Claim, ...]
    draw: Callable[[MeasuredRuns], Picture]
    row: Callable[[Result], Row]
    """The columns of a run in the CSV file."""
    drawn: tuple[Setting, ...] = ()
    """Settings that are drawn without a claim about them."""
    select: Callable[[int], RunRequests] | None = None
    """The runs that it needs, where `runs` counts something else than the runs of each setting."""
    table: Callable[[MeasuredRuns], ResultTable] | None = None
    kept: bool = False
    """Finished runs are kept in the folder, so that the same command resumes from there."""

    def requests(self) -> RunRequests:
        """The runs that it needs."""
        if self.select is not None:
            return self.select(self.runs)
        claimed = (setting for claim in self.claims for setting in claim.settings)
        return {setting: range(min(self.runs, setting.most)) for setting in (*claimed, *self.drawn)}
