"""Quality under loss: what faults cost a team, by the paper's minimum and by the ledger with claims.

No paper's figure: its claims are ours. Ten robots of the default mission, all in range of one another, with
random starts. Detection is measured where energy is scarce: every robot has 5 % more than its share of the
M points, which suffices while nothing fails. Finishing is measured where energy is plenty: then it says
how long a team works that does not know what is done. Every seed has the same starts and targets
under all conditions, so that differences are taken in pairs.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure as Picture

from kantor_fleet.reproduce import drawing
from kantor_fleet.reproduce.claims import MISS, OK, TOLD, Measure, Verdict
from kantor_fleet.reproduce.drawing import Course, Panel
from kantor_fleet.reproduce.figure import Figure, ResultTable, RunRequests
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


class Scourge(NamedTuple):
    """A kind of fault in several degrees."""

    name: str
    unit: str
    degrees: tuple[float, ...]
    """The first one is none."""
    faults: Callable[[float, int], list[str]]
    """Entries of a scenario's list for a degree above 0 and a seed."""
    seeded: bool = False
    """They differ from seed to seed."""


def _dropping(percent: float, _seed: int) -> list[str]:
    return [f'{{kind="drop", probability={percent / 100.0:g}}}']


def _parted(percent: float, _seed: int) -> list[str]:
    from_s = 0.25 * SHARE_S
    until_s = from_s + percent / 100.0 * SHARE_S
    return [f'{{kind="partition", shape="halves", from_s={from_s:g}, until_s={until_s:g}}}']


def _losing(robots: float, seed: int) -> list[str]:
    """The same robots at the same times for every number, one more each."""
    draws = np.random.default_rng(seed)
    lost, times_s = draws.permutation(ROBOTS) + 1, draws.uniform(0.0, SHARE_S, ROBOTS)
    return [
        f'{{kind="kill", who=["r{lost[i]}"], from_s={times_s[i]:.3f}}}' for i in range(int(robots))
    ]


SCOURGES = (
    Scourge("drop rate", "%", (0, 10, 20, 30, 40, 50, 60), _dropping),
    Scourge("halves parted, share of the mission", "%", (0, 12.5, 25, 37.5, 50), _parted),
    Scourge("robots lost for good", "of 10", (0, 1, 2, 3, 4), _losing, seeded=True),
)


class Aim(NamedTuple):
    """Something that is measured, and with how many points for each robot."""

    name: str
    unit: str
    measure: Measure
    steps: int


DETECTION = Aim("detected", " points", detected, _SCARCE)
FINISHING = Aim("finishing", " ticks", finished, _PLENTY)
AIMS = (DETECTION, FINISHING)


def setting(merge: str, aim: Aim, scourge: Scourge, degree: float, seed: int) -> Setting:
    """What is flown with a seed."""
    faults = ", ".join(scourge.faults(degree, seed)) if degree else ""
    return Setting(
        "fleet",
        (*_TEAM, f"energy.steps={aim.steps}", *MERGES[merge], *((f"faults=[{faults}]",) if faults else ())),
    )  # fmt: skip


def part(runs: int) -> RunRequests:
    """Every condition with every seed."""
    orders: dict[Setting, set[int]] = {}
    for aim in AIMS:
        for scourge in SCOURGES:
            for degree in scourge.degrees:
                for merge in MERGES:
                    for seed in range(runs):
                        flown = setting(merge, aim, scourge, degree, seed)
                        orders.setdefault(flown, set()).add(seed)
    return {flown: sorted(seeds) for flown, seeds in orders.items()}


def values(
    flights: MeasuredRuns, merge: str, aim: Aim, scourge: Scourge, degree: float
) -> npt.NDArray[np.float64]:
    """(runs,) what was measured, in the order of the seeds."""
    runs = len(flights[setting(merge, aim, scourge, 0, 0)])
    found: list[MeasuredRun] = []
    for seed in range(runs):
        flown = flights[setting(merge, aim, scourge, degree, seed)]
        found.append(flown[0 if scourge.seeded and degree else seed])
    return np.array([aim.measure(flight) for flight in found])


class Estimate(NamedTuple):
    """A mean with its 95 % percentile bootstrap interval over the seeds."""

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, sample: npt.NDArray[np.float64]) -> "Estimate":
        """The same every time."""
        drawn = np.random.default_rng(0).integers(0, sample.size, (_RESAMPLES, sample.size))
        low, high = np.quantile(sample[drawn].mean(axis=1), (0.025, 0.975)).tolist()
        return cls(float(sample.mean()), low, high)

    def text(self, sign: str = "") -> str:
        """For a person."""
        digits = 0 if abs(self.mean) >= 100.0 else 1
        mean, low, high = (f"{value:{sign}.{digits}f}" for value in self)
        return f"{mean} [{low}, {high}]"


class Better(NamedTuple):
    """The ledger is better than the minimum in every degree of a scourge, seed by seed."""

    aim: Aim
    scourge: Scourge

    @property
    def settings(self) -> tuple[Setting, ...]:
        """Of no fault; the figure knows the others."""
        return tuple(setting(merge, self.aim, self.scourge, 0, 0) for merge in MERGES)

    def judge(self, figure: str, flights: MeasuredRuns) -> Verdict:
        """The smallest gap, with its interval; ahead if every interval lies above 0."""
        sign = 1.0 if self.aim is DETECTION else -1.0
        gaps = {
            degree: Estimate.of(sign * (self._values(flights, "ledger", degree) - self._values(flights, "min", degree)))
            for degree in self.scourge.degrees
        }  # fmt: skip
        degree, least = min(gaps.items(), key=lambda item: item[1].low)
        met = all(gap.low > 0.0 for gap in gaps.values())
        what = "more detected" if self.aim is DETECTION else "sooner finished"
        return Verdict(
            figure,
            f"{self.scourge.name}: ledger over min, {what}, in every degree",
            "",
            "above 0",
            f"least {least.text('+')}{self.aim.unit} at {degree:g} {self.scourge.unit}",
            OK if met else MISS,
        )

    def _values(self, flights: MeasuredRuns, merge: str, degree: float) -> npt.NDArray[np.float64]:
        return values(flights, merge, self.aim, self.scourge, degree)


class Price(NamedTuple):
    """What the worst degree of a scourge costs; told as measured."""

    merge: str
    aim: Aim
    scourge: Scourge

    @property
    def settings(self) -> tuple[Setting, ...]:
        """Of no fault; the figure knows the others."""
        return (setting(self.merge, self.aim, self.scourge, 0, 0),)

    def judge(self, figure: str, flights: MeasuredRuns) -> Verdict:
        """The paired change."""
        worst = self.scourge.degrees[-1]
        none, much = (
            values(flights, self.merge, self.aim, self.scourge, degree) for degree in (0, worst)
        )
        text = f"{self.scourge.name}: {self.merge}, {self.aim.name}, {worst:g} {self.scourge.unit} against none"
        ours = f"{Estimate.of(much - none).text('+')}{self.aim.unit}"
        return Verdict(figure, text, "", "as measured", ours, TOLD)


def _estimates(flights: MeasuredRuns, merge: str, aim: Aim, scourge: Scourge) -> Iterator[Estimate]:
    for degree in scourge.degrees:
        yield Estimate.of(values(flights, merge, aim, scourge, degree))


def _draw(flights: MeasuredRuns) -> Picture:
    panels = [
        Panel(
            f"{scourge.name}, {scourge.unit}",
            "detected, % (energy scarce)" if aim is DETECTION else "finished, tick (energy plenty)",
            {
                merge: Course(scourge.degrees, tuple(_estimates(flights, merge, aim, scourge)))
                for merge in MERGES
            },
        )
        for aim in AIMS
        for scourge in SCOURGES
    ]
    return drawing.resilience(panels, len(SCOURGES))


def _table(flights: MeasuredRuns) -> ResultTable:
    rows = list(_rows(flights))
    shown: list[Row] = []
    columns = [f"{merge}: {aim.name}" for aim in AIMS for merge in MERGES]
    for scourge in SCOURGES:
        for degree in scourge.degrees:
            here = [r for r in rows if (r["fault"], r["degree"]) == (scourge.name, degree)]
            cells = [Estimate(r["mean"], r["low_95"], r["high_95"]).text() for r in here]
            fault = f"{scourge.name}: {degree:g} {scourge.unit}"
            shown.append({"fault": fault} | dict(zip(columns, cells, strict=True)))
    runs = rows[0]["runs"]
    title = f"{ROBOTS} robots, N = {SAMPLES}, M = {POINTS}, mean [95 %] over {runs} seeds: detected, %; finished, tick"
    return ResultTable(title, rows, shown)


def _rows(flights: MeasuredRuns) -> Iterator[Row]:
    for scourge in SCOURGES:
        for degree in scourge.degrees:
            for aim in AIMS:
                for merge in MERGES:
                    sample = values(flights, merge, aim, scourge, degree)
                    mean, low, high = Estimate.of(sample)
                    yield {
                        "fault": scourge.name,
                        "degree": degree,
                        "measure": aim.name,
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


def _claims() -> Iterator[Better | Price]:
    yield from (Better(aim, scourge) for aim in AIMS for scourge in SCOURGES)
    yield from (
        Price(merge, aim, scourge) for aim in AIMS for scourge in SCOURGES for merge in MERGES
    )


FIGURES = {
    "resilience": Figure(
        "quality under loss: drop rate, partitions, lost robots",
        RUNS,
        tuple(_claims()),
        _draw,
        _row,
        part=part,
        table=_table,
        kept=True,
    )
}
