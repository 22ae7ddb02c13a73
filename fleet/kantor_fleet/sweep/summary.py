"""Statistics of a sweep: each variant by itself, and compared with the first one.

Runs of the same seed share samples, targets, starts and draws, so variants are compared run by run:
the differences scatter less than the runs do.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from rich.box import SIMPLE_HEAD
from rich.table import Table
from scipy.stats import bootstrap

from kantor_fleet.sweep.plan import SweepPlan, Variant
from kantor_fleet.sweep.table import MEASURES, Row, SweepRun, applies, measures

MAIN = (
    *("detection_rate", "finished_tick", "w_ub_paper", "w1_exact", "mass_left"),
    *("map_completed_tick", "map_distance_m", "map_wtv_final_r8", "map_epv_mean_r8"),
)
"""The measures that are printed if they vary; the first of them is drawn."""

_RESAMPLES = 2_000
_LEVEL = 0.95

Numbers = npt.NDArray[np.float64]


class Distribution(NamedTuple):
    """Median, quartiles and interval of numbers; None where there are too few."""

    n: int
    median: float | None = None
    quartile_1: float | None = None
    quartile_3: float | None = None
    low: float | None = None
    """The lower end of the 95 % bootstrap interval of the median."""
    high: float | None = None

    @classmethod
    def of(cls, numbers: Numbers) -> "Distribution":
        """The distribution of numbers; the resampling is seeded, so that it is the same every time."""
        if not numbers.size:
            return cls(0)
        first, median, third = np.quantile(numbers, (0.25, 0.5, 0.75)).tolist()
        return cls(numbers.size, median, first, third, *_interval(numbers))


class SummaryRow(NamedTuple):
    """One measure of one variant."""

    variant: Variant
    measure: str
    failed: int
    """Runs without a result."""
    runs: Distribution
    difference: Distribution
    """Differences of the runs to those of the first variant with the same seeds."""


def summarize(plan: SweepPlan, runs: Iterable[SweepRun]) -> list[SummaryRow]:
    """A row for every variant and measure."""
    by_variant: dict[str, dict[int, Row]] = {variant.digest: {} for variant in plan.variants}
    for run in runs:
        by_variant[run.variant.digest][run.seed] = measures(run.outcome.result)
    first = by_variant[plan.variants[0].digest]
    return [
        _summary_row(variant, name, by_variant[variant.digest], first)
        for variant in plan.variants
        for name in MEASURES
        if applies(plan, name)
    ]


def rows(plan: SweepPlan, lines: Iterable[SummaryRow]) -> list[Row]:
    """The rows of summary.csv."""
    return [
        dict(zip(plan.keys, line.variant.values, strict=True))
        | {"measure": line.measure, "failed": line.failed}
        | line.runs._asdict()
        | {f"difference_{name}": value for name, value in line.difference._asdict().items()}
        for line in lines
    ]


def columns(plan: SweepPlan) -> list[str]:
    """The columns of summary.csv."""
    differences = [f"difference_{name}" for name in Distribution._fields]
    return [*plan.keys, "measure", "failed", *Distribution._fields, *differences]


def varying(runs: Iterable[SweepRun], names: Sequence[str]) -> list[str]:
    """The measures that differ between runs."""
    found = [measures(run.outcome.result) for run in runs]
    return [name for name in names if len({row[name] for row in found if row} - {None}) > 1]


def table_of(plan: SweepPlan, lines: Iterable[SummaryRow], measure: str) -> Table:
    """A printed table of one measure; 95 % intervals are in brackets."""
    table = Table(
        title=measure,
        title_style="bold",
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
    )
    several = len(plan.variants) > 1
    heads = [*plan.keys, "runs", "median", "quartiles", *["paired difference"] * several]
    for head in heads:
        table.add_column(head, justify="right")
    for line in lines:
        if line.measure == measure:
            table.add_row(*_cells(plan, line)[: len(heads)])
    return table


def _shown(value: float | None) -> str:
    """A number for printing."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _cells(plan: SweepPlan, line: SummaryRow) -> list[str]:
    first = line.variant is plan.variants[0]
    return [
        *line.variant.settings(plan.keys).values(),
        f"{line.runs.n}, {line.failed} failed" if line.failed else f"{line.runs.n}",
        _median_of(line.runs),
        f"{_shown(line.runs.quartile_1)} to {_shown(line.runs.quartile_3)}",
        "" if first else _median_of(line.difference),
    ]


def _median_of(numbers: Distribution) -> str:
    if numbers.low is None:
        return _shown(numbers.median)
    return f"{_shown(numbers.median)} [{_shown(numbers.low)}, {_shown(numbers.high)}]"


def _summary_row(
    variant: Variant, name: str, own: Mapping[int, Row], first: Mapping[int, Row]
) -> SummaryRow:
    values = {seed: row[name] for seed, row in own.items() if row.get(name) is not None}
    others = {seed: row[name] for seed, row in first.items() if row.get(name) is not None}
    differences = [value - others[seed] for seed, value in values.items() if seed in others]
    return SummaryRow(
        variant,
        name,
        sum(not row for row in own.values()),
        Distribution.of(np.array([*values.values()], dtype=np.float64)),
        Distribution.of(np.array(differences, dtype=np.float64)),
    )


def _interval(numbers: Numbers) -> tuple[float | None, float | None]:
    if numbers.size < 2:
        return None, None
    if numbers.min() == numbers.max():
        return float(numbers[0]), float(numbers[0])
    interval = bootstrap(
        (numbers,),
        np.median,
        n_resamples=_RESAMPLES,
        confidence_level=_LEVEL,
        method="percentile",  # the median of few runs takes too few values for a correction of bias
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(interval.low), float(interval.high)
