"""Quality under loss: what faults cost a team with the paper's minimum merge, and with the ledger and claims.

This is no figure of a paper: its claims are kantor's. Ten robots of the default mission, all in range of one another, with
random starts. Detection is measured where energy is scarce: every robot has 5 % more than its share of the
M points, which suffices while nothing fails. Finishing is measured where energy is plenty: then it says
how long a team works that does not know what is done. Every seed has the same starts and targets
under all conditions, so that differences are paired.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure as Picture

from kantor_fleet.reproduce import drawing
from kantor_fleet.reproduce.claims import MISS, OK, REPORTED, ClaimVerdict, Measure
from kantor_fleet.reproduce.drawing import Curve, Panel
from kantor_fleet.reproduce.figure import PaperFigure, ResultTable, RunRequests
from kantor_fleet.reproduce.kabir_lee import detected
from kantor_fleet.reproduce.measured_runs import MeasuredRun, MeasuredRuns, Setting
from kantor_fleet.reproduce.measures import finished
from kantor_fleet.sweep.table import Row
from kantor_worldsim.observers.metrics.result import Result

ROBOTS, POINTS, SAMPLES = 10, 4000, 800
SHARE_S = POINTS / ROBOTS * 0.1
"""Simulated time in which a team that wastes nothing ships all its mass."""
_SCARCE, _PLENTY = POINTS * 21 // (20 * ROBOTS), POINTS
RUNS = 20
_RESAMPLES = 4000

MERGES = {"min": ("merge=min", "claims=false"), "ledger": ("merge=ledger", "claims=true")}
_TEAM = (
    f"robots.count={ROBOTS}",
    "starts.random=true",
    f"energy.points={POINTS}",
    f"samples.count={SAMPLES}",
    "radio.range_m=inf",
    "metrics.every=1000",
)


class GradedFault(NamedTuple):
    """A kind of fault in several degrees."""

    name: str
    unit: str
    degrees: tuple[float, ...]
    """The first is 0: no fault."""
    faults: Callable[[float, int], list[str]]
    """Entries of a scenario's `faults`, for a degree above 0 and a seed."""
    seeded: bool = False
    """The faults differ from seed to seed."""


def _dropping(percent: float, _seed: int) -> list[str]:
    return [f'{{kind="drop", probability={percent / 100.0:g}}}']


def _parted(percent: float, _seed: int) -> list[str]:
    from_s = 0.25 * SHARE_S
    until_s = from_s + percent / 100.0 * SHARE_S
    return [f'{{kind="partition", shape="halves", from_s={from_s:g}, until_s={until_s:g}}}']


def _losing(robots: float, seed: int) -> list[str]:
    """Robots killed for good: one degree higher kills one more, and the others at the same times."""
    draws = np.random.default_rng(seed)
    lost, times_s = draws.permutation(ROBOTS) + 1, draws.uniform(0.0, SHARE_S, ROBOTS)
    return [
        f'{{kind="kill", who=["r{lost[i]}"], from_s={times_s[i]:.3f}}}' for i in range(int(robots))
    ]


GRADED_FAULTS = (
    GradedFault("drop rate", "%", (0, 10, 20, 30, 40, 50, 60), _dropping),
    GradedFault("halves parted, share of the mission", "%", (0, 12.5, 25, 37.5, 50), _parted),
    GradedFault("robots lost for good", "of 10", (0, 1, 2, 3, 4), _losing, seeded=True),
)


class Objective(NamedTuple):
    """A measure of quality, and the energy with which it is measured."""

    name: str
    unit: str
    measure: Measure
    steps: int
    """Points of each robot."""


DETECTION = Objective("detected", " points", detected, _SCARCE)
FINISHING = Objective("finishing", " ticks", finished, _PLENTY)
OBJECTIVES = (DETECTION, FINISHING)


def setting(
    merge: str, objective: Objective, graded: GradedFault, degree: float, seed: int
) -> Setting:
    """The setting that is run with a seed."""
    faults = ", ".join(graded.faults(degree, seed)) if degree else ""
    return Setting(
        "fleet",
        (*_TEAM, f"energy.steps={objective.steps}", *MERGES[merge], *((f"faults=[{faults}]",) if faults else ())),
    )  # fmt: skip


def requests(runs: int) -> RunRequests:
    """All conditions with all seeds."""
    requested: dict[Setting, set[int]] = {}
    for objective in OBJECTIVES:
        for graded in GRADED_FAULTS:
            for degree in graded.degrees:
                for merge in MERGES:
                    for seed in range(runs):
                        condition = setting(merge, objective, graded, degree, seed)
                        requested.setdefault(condition, set()).add(seed)
    return {condition: sorted(seeds) for condition, seeds in requested.items()}


def values(
    measured: MeasuredRuns, merge: str, objective: Objective, graded: GradedFault, degree: float
) -> npt.NDArray[np.float64]:
    """(runs,) measures in the order of the seeds."""
    runs = len(measured[setting(merge, objective, graded, 0, 0)])
    found: list[MeasuredRun] = []
    for seed in range(runs):
        runs_there = measured[setting(merge, objective, graded, degree, seed)]
        found.append(runs_there[0 if graded.seeded and degree else seed])
    return np.array([objective.measure(run) for run in found])


class Estimate(NamedTuple):
    """A mean with its 95 % percentile bootstrap interval over the seeds."""

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, sample: npt.NDArray[np.float64]) -> "Estimate":
        """The estimate of a sample; its resampling is seeded, so that it is the same every time."""
        drawn = np.random.default_rng(0).integers(0, sample.size, (_RESAMPLES, sample.size))
        low, high = np.quantile(sample[drawn].mean(axis=1), (0.025, 0.975)).tolist()
        return cls(float(sample.mean()), low, high)

    def text(self, sign: str = "") -> str:
        """The estimate for printing."""
        digits = 0 if abs(self.mean) >= 100.0 else 1
        mean, low, high = (f"{value:{sign}.{digits}f}" for value in self)
        return f"{mean} [{low}, {high}]"


class LedgerLead(NamedTuple):
    """The ledger is better than the minimum merge in every degree of a fault, seed by seed."""

    objective: Objective
    graded: GradedFault

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings without faults; the figure adds the others."""
        return tuple(setting(merge, self.objective, self.graded, 0, 0) for merge in MERGES)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The smallest lead, with its interval; met if every interval lies above 0."""
        sign = 1.0 if self.objective is DETECTION else -1.0
        gaps = {
            degree: Estimate.of(sign * (self._values(measured, "ledger", degree) - self._values(measured, "min", degree)))
            for degree in self.graded.degrees
        }  # fmt: skip
        degree, least = min(gaps.items(), key=lambda item: item[1].low)
        met = all(gap.low > 0.0 for gap in gaps.values())
        lead = "more detected" if self.objective is DETECTION else "sooner finished"
        return ClaimVerdict(
            figure,
            f"{self.graded.name}: ledger over min, {lead}, in every degree",
            "",
            "above 0",
            f"least {least.text('+')}{self.objective.unit} at {degree:g} {self.graded.unit}",
            OK if met else MISS,
        )

    def _values(self, measured: MeasuredRuns, merge: str, degree: float) -> npt.NDArray[np.float64]:
        return values(measured, merge, self.objective, self.graded, degree)


class CostOfFault(NamedTuple):
    """The cost of the highest degree of a fault: reported, not judged."""

    merge: str
    objective: Objective
    graded: GradedFault

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings without faults; the figure adds the others."""
        return (setting(self.merge, self.objective, self.graded, 0, 0),)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The paired change from no fault to the highest degree."""
        worst = self.graded.degrees[-1]
        none, much = (
            values(measured, self.merge, self.objective, self.graded, degree)
            for degree in (0, worst)
        )
        text = f"{self.graded.name}: {self.merge}, {self.objective.name}, {worst:g} {self.graded.unit} against none"
        ours = f"{Estimate.of(much - none).text('+')}{self.objective.unit}"
        return ClaimVerdict(figure, text, "", "as measured", ours, REPORTED)


def _estimates(
    measured: MeasuredRuns, merge: str, objective: Objective, graded: GradedFault
) -> Iterator[Estimate]:
    for degree in graded.degrees:
        yield Estimate.of(values(measured, merge, objective, graded, degree))


def _draw(measured: MeasuredRuns) -> Picture:
    panels = [
        Panel(
            f"{graded.name}, {graded.unit}",
            "detected, % (energy scarce)"
            if objective is DETECTION
            else "finished, tick (energy plenty)",
            {
                merge: Curve(graded.degrees, tuple(_estimates(measured, merge, objective, graded)))
                for merge in MERGES
            },
        )
        for objective in OBJECTIVES
        for graded in GRADED_FAULTS
    ]
    return drawing.resilience(panels, len(GRADED_FAULTS))


def _table(measured: MeasuredRuns) -> ResultTable:
    rows = list(_rows(measured))
    shown: list[Row] = []
    columns = [f"{merge}: {objective.name}" for objective in OBJECTIVES for merge in MERGES]
    for graded in GRADED_FAULTS:
        for degree in graded.degrees:
            here = [r for r in rows if (r["fault"], r["degree"]) == (graded.name, degree)]
            cells = [Estimate(r["mean"], r["low_95"], r["high_95"]).text() for r in here]
            condition = f"{graded.name}: {degree:g} {graded.unit}"
            shown.append({"fault": condition} | dict(zip(columns, cells, strict=True)))
    runs = rows[0]["runs"]
    title = f"{ROBOTS} robots, N = {SAMPLES}, M = {POINTS}, mean [95 %] over {runs} seeds: detected, %; finished, tick"
    return ResultTable(title, rows, shown)


def _rows(measured: MeasuredRuns) -> Iterator[Row]:
    for graded in GRADED_FAULTS:
        for degree in graded.degrees:
            for objective in OBJECTIVES:
                for merge in MERGES:
                    sample = values(measured, merge, objective, graded, degree)
                    mean, low, high = Estimate.of(sample)
                    yield {
                        "fault": graded.name,
                        "degree": degree,
                        "measure": objective.name,
                        "merge": merge,
                        "runs": sample.size,
                        "mean": mean,
                        "low_95": low,
                        "high_95": high,
                    }


def _row(result: Result) -> Row:
    return {
        "merge": result.merge,
        "detected": result.detected,
        "targets": result.targets,
        "ticks": result.ticks,
        "mass_left": result.mass_left,
        "mass_double_counted": result.mass_double_counted,
        "energy_spent": result.energy_spent,
        "drops": result.drops,
        "deliveries": result.deliveries,
    }


def _claims() -> Iterator[LedgerLead | CostOfFault]:
    yield from (
        LedgerLead(objective, graded) for objective in OBJECTIVES for graded in GRADED_FAULTS
    )
    yield from (
        CostOfFault(merge, objective, graded)
        for objective in OBJECTIVES
        for graded in GRADED_FAULTS
        for merge in MERGES
    )


FIGURES = {
    "resilience": PaperFigure(
        "quality under loss: drop rate, partitions, lost robots",
        RUNS,
        tuple(_claims()),
        _draw,
        _row,
        select=requests,
        table=_table,
        kept=True,
    )
}
