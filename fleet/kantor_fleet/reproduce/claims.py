"""Claims of a paper: what it publishes, what a faithful reading gives, what we measure, a verdict."""

import math
import statistics
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from scipy.stats import t as student

from kantor_fleet.reproduce.flights import Flight, Flights, Setting

Measure = Callable[[Flight], float]

OK, MISS = "ok", "MISS"
UNMATCHED = "ok, not the paper's"
"""Ours agrees with the faithful reading, which cannot give what was published."""


class Verdict(NamedTuple):
    """One line of the table."""

    figure: str
    claim: str
    published: str
    reading: str
    """What a faithful reading gives: a band, or a relation."""
    ours: str
    verdict: str
    why: str = ""
    """Why the published figure cannot be matched."""


class Claim(Protocol):
    """Something that a figure says."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """The settings that it needs flown."""
        ...

    def judge(self, figure: str, flights: Flights) -> Verdict:
        """The line of the table."""
        ...


class Median(NamedTuple):
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
        """One."""
        return (self.setting,)

    def judge(self, figure: str, flights: Flights) -> Verdict:
        """Median [quartiles] against the band."""
        values = [self.measure(flight) for flight in flights[self.setting]]
        first, median, third = quartiles(values)
        shown = [f"{value:.{self.digits}f}" for value in (median, first, third)]
        ours = f"{shown[0]} [{shown[1]}, {shown[2]}]{self.unit}"
        met = self.low <= median <= self.high
        verdict = MISS if not met else UNMATCHED if self.why else OK
        return Verdict(figure, self.text, self.published, self._band, ours, verdict, self.why)

    @property
    def _band(self) -> str:
        low, high = f"{self.low:g}", f"{self.high:g}"
        if math.isinf(self.high):
            return f"≥ {low}{self.unit}"
        return f"≤ {high}{self.unit}" if math.isinf(self.low) else f"{low} to {high}{self.unit}"


class Spread(NamedTuple):
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

    def judge(self, figure: str, flights: Flights) -> Verdict:
        """Interquartile ranges."""
        ranges = []
        for setting in self.settings:
            first, _, third = quartiles([self.measure(flight) for flight in flights[setting]])
            ranges.append(third - first)
        ours = f"{ranges[0]:.1f} against " + ", ".join(f"{width:.1f}" for width in ranges[1:])
        met = ranges[0] < min(ranges[1:])
        verdict = OK if met else MISS
        return Verdict(figure, self.text, self.published, "smallest", ours + self.unit, verdict)


class Ahead(NamedTuple):
    """One setting lies above another, seed by seed and, where asked, with intervals apart."""

    text: str
    upper: Setting
    lower: Setting
    published: str
    reading: str
    measure: Measure
    unit: str
    apart: bool = False
    """Also the 95 % intervals of the two means must not overlap."""
    sure: bool = True
    """The reading itself is significant; if not, any sign is in order."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """Upper, lower."""
        return (self.upper, self.lower)

    def judge(self, figure: str, flights: Flights) -> Verdict:
        """Means with 95 % intervals by Student's t, and the paired gap."""
        upper, lower = (
            [self.measure(flight) for flight in flights[setting]] for setting in self.settings
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
        return Verdict(figure, self.text, self.published, self.reading, ours, OK if met else MISS)


class Range(NamedTuple):
    """One run of each of several settings that hardly differ: how far apart the outcomes lie."""

    text: str
    settings: tuple[Setting, ...]
    published: str
    least: float
    """How far apart, at least."""
    measure: Measure
    unit: str

    def judge(self, figure: str, flights: Flights) -> Verdict:
        """From the lowest to the highest."""
        values = [self.measure(flights[setting][0]) for setting in self.settings]
        low, high = min(values), max(values)
        ours = f"{low:.1f} to {high:.1f}{self.unit} over {len(values)} starts"
        reading = f"≥ {self.least:g} points apart"
        verdict = OK if high - low >= self.least else MISS
        return Verdict(figure, self.text, self.published, reading, ours, verdict)


class Ratio(NamedTuple):
    """The ratio of two settings' medians, told and not judged: it depends on the implementation."""

    text: str
    over: Setting
    under: Setting
    published: str
    measure: Measure
    why: str

    @property
    def settings(self) -> tuple[Setting, ...]:
        """Over, under."""
        return (self.over, self.under)

    def judge(self, figure: str, flights: Flights) -> Verdict:
        """Medians, and one over the other."""
        over, under = (
            statistics.median(self.measure(flight) for flight in flights[setting])
            for setting in self.settings
        )
        ours = f"{over:.3f} s against {under:.3f} s: {over / under:.2f} times"
        return Verdict(figure, self.text, self.published, "either", ours, UNMATCHED, self.why)


class Share(NamedTuple):
    """The share of runs in which something happens stays below a bound."""

    text: str
    setting: Setting
    published: str
    most: float
    happens: Callable[[Flight], bool]

    @property
    def settings(self) -> tuple[Setting, ...]:
        """One."""
        return (self.setting,)

    def judge(self, figure: str, flights: Flights) -> Verdict:
        """Runs among all."""
        runs = flights[self.setting]
        count = sum(self.happens(flight) for flight in runs)
        verdict = OK if count <= self.most * len(runs) else MISS
        reading = f"≤ {100.0 * self.most:.0f} %"
        ours = f"{100.0 * count / len(runs):.0f} % ({count} of {len(runs)})"
        return Verdict(figure, self.text, self.published, reading, ours, verdict)


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
