"""Claims of a paper: each compares a published value, that of a faithful reading, and measured runs.

A *faithful reading* is an independent simulator that follows the paper.
"""

import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from scipy.stats import t as student

from kantor_fleet.reproduce.measured_runs import MeasuredRun, MeasuredRuns, Setting

Measure = Callable[[MeasuredRun], float]

OK, MISS = "ok", "MISS"
UNMATCHED = "ok, not the paper's"
"""The measured value agrees with the faithful reading, and no faithful reading can give the published one."""
REPORTED = "reported"
"""Reported, not judged: neither the paper nor a reading of it gives a bound."""


class ClaimVerdict(NamedTuple):
    """A row of the table of verdicts."""

    figure: str
    claim: str
    published: str
    reading: str
    """The value of a faithful reading: a band, or a relation."""
    ours: str
    verdict: str
    why: str = ""
    """Why the published figure cannot be matched."""


class Claim(Protocol):
    """A statement of a figure that runs can confirm or miss."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings whose runs it needs."""
        ...

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The row of the table of verdicts."""
        ...


class MedianInBand(NamedTuple):
    """The median over the runs lies in a band."""

    text: str
    setting: Setting
    published: str
    low: float
    high: float
    measure: Measure
    digits: int = 0
    unit: str = ""
    why: str = ""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The one setting."""
        return (self.setting,)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """Median [quartiles] against the band."""
        values = [self.measure(run) for run in measured[self.setting]]
        first, median, third = quartiles(values)
        shown = [f"{value:.{self.digits}f}" for value in (median, first, third)]
        ours = f"{shown[0]} [{shown[1]}, {shown[2]}]{self.unit}"
        met = self.low <= median <= self.high
        verdict = MISS if not met else UNMATCHED if self.why else OK
        return ClaimVerdict(figure, self.text, self.published, self._band, ours, verdict, self.why)

    @property
    def _band(self) -> str:
        low, high = f"{self.low:g}", f"{self.high:g}"
        if math.isinf(self.high):
            return f"≥ {low}{self.unit}"
        return f"≤ {high}{self.unit}" if math.isinf(self.low) else f"{low} to {high}{self.unit}"


class NarrowestSpread(NamedTuple):
    """The quartiles of one setting lie closer together than those of all others."""

    text: str
    narrow: Setting
    others: tuple[Setting, ...]
    published: str
    measure: Measure
    unit: str

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The narrow one first."""
        return (self.narrow, *self.others)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The interquartile ranges."""
        ranges = []
        for setting in self.settings:
            first, _, third = quartiles([self.measure(run) for run in measured[setting]])
            ranges.append(third - first)
        ours = f"{ranges[0]:.1f} against " + ", ".join(f"{width:.1f}" for width in ranges[1:])
        met = ranges[0] < min(ranges[1:])
        verdict = OK if met else MISS
        return ClaimVerdict(
            figure, self.text, self.published, "smallest", ours + self.unit, verdict
        )


class PairedLead(NamedTuple):
    """One setting lies above another, seed by seed and, if `apart`, with separate intervals."""

    text: str
    upper: Setting
    lower: Setting
    published: str
    reading: str
    measure: Measure
    unit: str
    apart: bool = False
    """The 95 % intervals of the two means must not overlap either."""
    sure: bool = True
    """The reading itself is significant; if it is not, either sign meets the claim."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The upper and the lower setting."""
        return (self.upper, self.lower)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """Means with 95 % intervals by Student's t, and the paired gap."""
        upper, lower = (
            [self.measure(run) for run in measured[setting]] for setting in self.settings
        )
        gap, half = interval([one - other for one, other in zip(upper, lower, strict=True)])
        (high, high_half), (low, low_half) = interval(upper), interval(lower)
        met = gap - half > 0.0 or not self.sure
        if self.apart:
            met = met and high - high_half > low + low_half
        ours = (
            f"{high:.1f} ± {high_half:.1f} against {low:.1f} ± {low_half:.1f}{self.unit}, "
            f"paired {gap:+.1f} ± {half:.1f}"
        )
        return ClaimVerdict(
            figure, self.text, self.published, self.reading, ours, OK if met else MISS
        )


class WideRange(NamedTuple):
    """One run of each of several settings that hardly differ: the outcomes lie at least so far apart."""

    text: str
    settings: tuple[Setting, ...]
    published: str
    least: float
    """The least distance from the lowest to the highest outcome."""
    measure: Measure
    unit: str

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The lowest and the highest outcome."""
        values = [self.measure(measured[setting][0]) for setting in self.settings]
        low, high = min(values), max(values)
        ours = f"{low:.1f} to {high:.1f}{self.unit} over {len(values)} starts"
        reading = f"≥ {self.least:g} points apart"
        verdict = OK if high - low >= self.least else MISS
        return ClaimVerdict(figure, self.text, self.published, reading, ours, verdict)


class MedianRatio(NamedTuple):
    """The ratio of two settings' medians, reported and not judged: it depends on the implementation."""

    text: str
    over: Setting
    under: Setting
    published: str
    measure: Measure
    why: str

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings over and under."""
        return (self.over, self.under)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """Both medians and their ratio."""
        over, under = (
            statistics.median(self.measure(run) for run in measured[setting])
            for setting in self.settings
        )
        ours = f"{over:.3f} s against {under:.3f} s: {over / under:.2f} times"
        return ClaimVerdict(figure, self.text, self.published, "either", ours, UNMATCHED, self.why)


class RareShare(NamedTuple):
    """The share of runs in which something happens stays below a bound."""

    text: str
    setting: Setting
    published: str
    most: float
    happens: Callable[[MeasuredRun], bool]

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The one setting."""
        return (self.setting,)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The number of runs in which it happens, among all."""
        runs = measured[self.setting]
        count = sum(self.happens(run) for run in runs)
        verdict = OK if count <= self.most * len(runs) else MISS
        reading = f"≤ {100.0 * self.most:.0f} %"
        ours = f"{100.0 * count / len(runs):.0f} % ({count} of {len(runs)})"
        return ClaimVerdict(figure, self.text, self.published, reading, ours, verdict)


class MeanRatio(NamedTuple):
    """The ratio of two settings' means over the same starts lies in a band, if there is one."""

    text: str
    over: Setting
    under: Setting
    published: str
    reading: str
    measure: Measure
    low: float = -math.inf
    high: float = math.inf
    why: str = ""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings over and under."""
        return (self.over, self.under)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The ratio with its 95 % bootstrap interval; whole starts are resampled."""
        over, under = (
            [self.measure(run) for run in measured[setting]] for setting in self.settings
        )
        ratio, low, high = mean_ratio(over, under)
        ours = f"{ratio:.2f} [{low:.2f}, {high:.2f}]"
        return ClaimVerdict(
            figure, self.text, self.published, self.reading, ours, self._verdict(ratio), self.why
        )

    def _verdict(self, ratio: float) -> str:
        if not self.low <= ratio <= self.high:
            return MISS
        if self.why:
            return UNMATCHED
        return REPORTED if math.isinf(self.low) and math.isinf(self.high) else OK


class IdenticalRuns(NamedTuple):
    """Two settings give equal measures in every run."""

    text: str
    one: Setting
    other: Setting
    published: str
    measures: tuple[Measure, ...]

    @property
    def settings(self) -> tuple[Setting, ...]:
        """Both settings."""
        return (self.one, self.other)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The number of runs that agree in every measure, among all."""
        pairs = list(zip(*(measured[setting] for setting in self.settings), strict=True))
        same = sum(
            all(measure(one) == measure(other) for measure in self.measures) for one, other in pairs
        )
        verdict = OK if same == len(pairs) else MISS
        ours = f"{same} of {len(pairs)} runs the same"
        return ClaimVerdict(figure, self.text, self.published, "every run the same", ours, verdict)


class LowestMean(NamedTuple):
    """Among the means of several settings the first is the lowest."""

    text: str
    named: tuple[tuple[str, Setting], ...]
    published: str
    measure: Measure
    above: tuple[str, ...] = ()
    """The names that a faithful reading has above the first; with none the claim is reported, not judged."""
    why: str = ""
    """Why a faithful reading does not have the first below the others too."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The first is the one in question."""
        return tuple(setting for _, setting in self.named)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """All means in order."""
        means = {
            name: statistics.fmean(self.measure(run) for run in measured[setting])
            for name, setting in self.named
        }
        first = means[self.named[0][0]]
        ours = ", ".join(
            f"{name} {mean:,.0f}" for name, mean in sorted(means.items(), key=lambda item: item[1])
        )
        reading = f"below {' and '.join(self.above)}" if self.above else "either"
        lowest = first == min(means.values())
        if not self.above:
            verdict = REPORTED
        elif any(first >= means[name] for name in self.above):
            verdict = MISS
        else:
            verdict = OK if lowest else UNMATCHED
        why = "" if lowest else self.why
        return ClaimVerdict(figure, self.text, self.published, reading, ours, verdict, why)


Group = tuple[Setting, ...]
"""Settings whose runs are taken together."""


class GeometricMeanRatio(NamedTuple):
    """The geometric mean of ratios, run by run, over several settings stays below a bound."""

    text: str
    over: Group
    under: Group
    """Compared with the setting of `over` at the same place."""
    published: str
    reading: str
    measure: Measure
    most: float = math.inf
    """Infinite: the claim is reported, not judged."""
    why: str = ""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings over and under."""
        return (*self.over, *self.under)

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The mean with its 95 % factor by Student's t on logarithms."""
        ratios = list(paired_ratios(measured, self.over, self.under, self.measure))
        if not ratios:
            ours = "no runs"
            return ClaimVerdict(
                figure, self.text, self.published, self.reading, ours, REPORTED, self.why
            )
        mean, factor = geometric(ratios)
        verdict = REPORTED if math.isinf(self.most) else OK if mean <= self.most else MISS
        ours = f"{text_of_ratio(mean, factor)} (n = {len(ratios)})"
        return ClaimVerdict(
            figure, self.text, self.published, self.reading, ours, verdict, self.why
        )


class LowerThroughout(NamedTuple):
    """In each of several pairs of groups, the first lies below the second, setting by setting."""

    text: str
    pairs: tuple[tuple[str, Group, Group], ...]
    """Name, lower, upper; settings at the same place of both groups are compared."""
    published: str
    measure: Measure

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings of all pairs."""
        return tuple(s for _, lower, upper in self.pairs for s in (*lower, *upper))

    def judge(self, figure: str, measured: MeasuredRuns) -> ClaimVerdict:
        """The ratios lower over upper; missed if one lies above 1, beyond its interval if it has one."""
        ratios = {
            name: geometric(found)
            for name, lower, upper in self.pairs
            if (found := list(self._ratios(measured, lower, upper)))
        }
        ours = ", ".join(f"{name} {text_of_ratio(*ratio)}" for name, ratio in ratios.items())
        missed = any(
            mean > (factor if math.isfinite(factor) else 1.0) for mean, factor in ratios.values()
        )
        reading = "each below 1, or not clearly above"
        return ClaimVerdict(
            figure, self.text, self.published, reading, ours, MISS if missed else OK
        )

    def _ratios(self, measured: MeasuredRuns, lower: Group, upper: Group) -> Iterator[float]:
        """Ratios of geometric means, for settings with runs; their starts differ, so that runs cannot be paired."""
        for one, other in zip(lower, upper, strict=True):
            if measured.get(one) and measured.get(other):
                low, high = (
                    geometric(map(self.measure, measured[each]))[0] for each in (one, other)
                )
                yield low / high


def mean_ratio(
    over: Sequence[float], under: Sequence[float], resamples: int = 10_000
) -> tuple[float, float, float]:
    """Ratio of means and its 95 % percentile interval; pairs are resampled together, with a fixed seed."""
    pairs = np.array([over, under], dtype=np.float64)
    drawn = np.random.default_rng(0).integers(0, pairs.shape[1], (resamples, pairs.shape[1]))
    means = pairs[:, drawn].mean(axis=2)
    low, high = np.quantile(means[0] / means[1], (0.025, 0.975)).tolist()
    ratio = float(pairs[0].mean() / pairs[1].mean())
    return ratio, low, high


def paired_ratios(
    measured: MeasuredRuns, over: Group, under: Group, measure: Measure
) -> Iterator[float]:
    """Ratios of the runs that both of a pair of settings have, where both measures are above 0."""
    for one, other in zip(over, under, strict=True):
        for upper, lower in zip(measured.get(one, ()), measured.get(other, ()), strict=True):
            if measure(upper) > 0.0 and measure(lower) > 0.0:
                yield measure(upper) / measure(lower)


def geometric(values: Iterable[float]) -> tuple[float, float]:
    """Geometric mean, and the factor by which its 95 % interval reaches up and down."""
    mean, half = interval([math.log(value) for value in values])
    return math.exp(mean), math.exp(half)


def text_of_ratio(mean: float, factor: float) -> str:
    """A geometric mean and its factor, for printing."""
    return f"{mean:.2f} x÷ {factor:.2f}" if math.isfinite(factor) else f"{mean:.2f}"


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """First quartile, median, third quartile."""
    if len(values) == 1:
        return values[0], values[0], values[0]
    first, median, third = statistics.quantiles(values, n=4, method="inclusive")
    return first, median, third


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half width of its 95 % interval by Student's t."""
    if len(values) == 1:
        return values[0], math.inf
    error = statistics.stdev(values) / math.sqrt(len(values))
    return statistics.fmean(values), float(student.ppf(0.975, len(values) - 1)) * error
