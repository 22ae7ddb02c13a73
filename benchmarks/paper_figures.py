"""Kabir & Lee's figures against ours: every claim over many seeds, as one table.

    python benchmarks/paper_figures.py [--seeds 20] [--jobs N]

Runs are in process and exactly repeatable. Exits with 1 if a claim misses its band. The bands are
those of an independent simulator's faithful reading of the paper, not of this code.
"""

import argparse
import math
import multiprocessing
import os
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

from scipy.stats import t as student

from kantor_fleet.catalog import find
from kantor_fleet.team import team
from kantor_worldsim.loop import in_process, simulate
from kantor_worldsim.metrics import Result
from kantor_worldsim.recording import Recording
from kantor_worldsim.stage import Stage
from kantor_worldsim.world import Site

LEDGER = ("merge=ledger", "claims=true")
MINIMUM = ("merge=min", "claims=false")
CONCURRENT = ("clock.order=concurrent",)
SPEEDS_M = (3, 5, 7, 9, 12, 15)
"""Diffusions v of section VI-D at which the time-varying form is clearly ahead."""


class Setting(NamedTuple):
    """A packaged scenario with overrides."""

    scenario: str
    overrides: tuple[str, ...] = ()

    def __str__(self) -> str:
        return " ".join((self.scenario, *self.overrides))


class Line(NamedTuple):
    """One line of the table."""

    claim: str
    setting: str
    paper: str
    target: str
    ours: str
    met: bool


Runs = Mapping[Setting, Sequence[Result]]


class Claim(NamedTuple):
    """A figure whose median over seeds must lie in a band."""

    text: str
    setting: Setting
    paper: str
    low: float
    high: float
    measure: Callable[[Result], float]
    digits: int = 0
    unit: str = ""

    @property
    def settings(self) -> tuple[Setting, ...]:
        return (self.setting,)

    def line(self, runs: Runs) -> Line:
        values = [self.measure(result) for result in runs[self.setting]]
        first, median, third = _quartiles(values)
        shown = [f"{value:.{self.digits}f}" for value in (median, first, third)]
        ours = f"{shown[0]} [{shown[1]}, {shown[2]}]{self.unit}"
        met = self.low <= median <= self.high
        return Line(self.text, str(self.setting), self.paper, self._target, ours, met)

    @property
    def _target(self) -> str:
        low, high = f"{self.low:g}", f"{self.high:g}"
        if math.isinf(self.high):
            return f">= {low}{self.unit}"
        return f"<= {high}{self.unit}" if math.isinf(self.low) else f"{low} to {high}{self.unit}"


class Gap(NamedTuple):
    """Section VI-D: samples that walk with the targets find more than samples that stand."""

    diffusion_m: int

    @property
    def settings(self) -> tuple[Setting, Setting]:
        targets = f"targets.diffusion_m={self.diffusion_m}"
        samples = f"samples.diffusion_m={self.diffusion_m}"
        return (
            Setting("paper-timevarying", (targets, samples)),
            Setting("paper-timeinvariant", (targets,)),
        )

    def line(self, runs: Runs) -> Line:
        varying, invariant = self.settings
        gaps = [
            _detected(one) - _detected(other)
            for one, other in zip(runs[varying], runs[invariant], strict=True)
        ]
        mean, half = _interval(gaps)
        return Line(
            f"VI-D v={self.diffusion_m}: detected, varying - invariant",
            f"paper-time(varying|invariant) diffusion_m={self.diffusion_m}",
            "ahead",
            "> 0 points",
            f"{mean:.1f} ± {half:.1f} points",
            mean - half > 0.0,
        )


def _detected(result: Result) -> float:
    return 100.0 * (result.detection_rate or 0.0)


def _finished(result: Result) -> float:
    """The tick at which the team finished; the last one for a run that was cut."""
    return float(result.ticks if result.finished_tick is None else result.finished_tick)


def _first_contact(result: Result) -> float:
    return math.inf if result.first_contact_tick is None else float(result.first_contact_tick)


def _bound_at_start(result: Result) -> float:
    return result.w_ub_start


def _bound_at_end(result: Result) -> float:
    return result.w_ub.final_instant


A = Setting("paper-centralized")
A_CONCURRENT = Setting("paper-centralized-concurrent")
C = Setting("paper-decentralized")
C_CONCURRENT = Setting("paper-decentralized", CONCURRENT)
B = ("starts.random=true", "metrics.every=0")
SPECTRAL = (*B, "planner=spectral")
NO_LESS, NO_MORE = math.inf, -math.inf

CLAIMS: tuple[Claim | Gap, ...] = (
    Claim("VI-A: W_UB at the start", A, "3600", 3600, 3700, _bound_at_start, 1),
    Claim("VI-A: detected, in turn", A, "91.3 %", 88, 91, _detected, 1, " %"),
    Claim("VI-A: W_UB at the end, last tick's", A, "0.2421", 0.15, 0.25, _bound_at_end, 3),
    Claim("VI-A: detected, concurrent, minimum", A_CONCURRENT, "-", 64, 73, _detected, 1, " %"),
    Claim(
        "VI-A: detected, concurrent, ledger + claims",
        Setting(A_CONCURRENT.scenario, LEDGER),
        "91.3 %",
        86.5,
        NO_LESS,
        _detected,
        1,
        " %",
    ),
    Claim(
        "VI-B: detected, optimal transport",
        Setting(A.scenario, B),
        "89 %",
        87,
        91,
        _detected,
        1,
        " %",
    ),
    *(
        Claim(
            f"VI-B: detected, spectral, K = {modes}",
            Setting(A.scenario, (*SPECTRAL, f"planner.modes={modes}")),
            "< 82 %",
            low,
            high,
            _detected,
            1,
            " %",
        )
        for modes, low, high in ((10, 66, 73), (15, 74, 80), (20, 78, 84))
    ),
    Claim("VI-C: first contact, tick", C, "693", 685, 705, _first_contact),
    Claim("VI-C: end, in turn, tick", C, "1057", 1025, 1060, _finished),
    Claim("VI-C: end, concurrent, minimum, tick", C_CONCURRENT, "-", 1130, NO_LESS, _finished),
    Claim(
        "VI-C: end, concurrent, ledger + claims, tick",
        Setting(C.scenario, CONCURRENT + LEDGER),
        "1057",
        NO_MORE,
        1055,
        _finished,
    ),
    Claim(
        "VI-A decentralized: end, concurrent, minimum, tick",
        Setting("fleet", MINIMUM),
        "-",
        1800,
        NO_LESS,
        _finished,
    ),
    Claim(
        "VI-A decentralized: end, concurrent, ledger + claims, tick",
        Setting("fleet"),
        "-",
        NO_MORE,
        1095,
        _finished,
    ),
    *(Gap(diffusion_m) for diffusion_m in SPEEDS_M),
)


def fly(setting: Setting, seed: int) -> Result:
    """One run in process. Raises RuntimeError when the run broke a rule."""
    scenario = find(setting.scenario, setting.overrides)
    site = Site.of(scenario, seed)
    recording = Recording(scenario, seed, "in-process")
    stage = Stage(scenario, seed, site, [recording.take])
    simulate(stage, in_process(team(scenario, seed, site)), seed, lambda: False)
    result = recording.finish()
    if result.violations:
        raise RuntimeError(f"{setting}, seed {seed}: {result.complaints[0]}")
    return result


def _quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    if len(values) == 1:
        return values[0], values[0], values[0]
    first, median, third = statistics.quantiles(values, n=4, method="inclusive")
    return first, median, third


def _interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half width of its 95 % interval by Student's t."""
    if len(values) == 1:
        return values[0], math.inf
    error = statistics.stdev(values) / math.sqrt(len(values))
    return statistics.fmean(values), float(student.ppf(0.975, len(values) - 1)) * error


def _run_all(orders: Sequence[tuple[Setting, int]], jobs: int) -> Iterator[Result]:
    """The runs in order, with a count for whoever watches."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=spawn) as pool:
        done = pool.map(fly, *zip(*orders, strict=True), chunksize=2)
        for number, result in enumerate(done, 1):
            if sys.stderr.isatty():
                end = "\n" if number == len(orders) else ""
                print(f"\r{number}/{len(orders)} runs", end=end, file=sys.stderr, flush=True)
            yield result


def _print_table(lines: Sequence[Line], seeds: int) -> None:
    head = ("claim", "scenario and overrides", "paper", "target", "ours", "verdict")
    rows = [(*line[:-1], "ok" if line.met else "MISS") for line in lines]
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    print(f"{seeds} seeds; ours: median [Q1, Q3], or mean ± 95 % of paired differences\n")
    for row in (head, tuple("-" * width for width in widths), *rows):
        print(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        )


def main() -> int:
    """Print the table; 1 if a claim misses."""
    parser = argparse.ArgumentParser(description="Kabir & Lee's figures against ours.")
    parser.add_argument("--seeds", type=int, default=20, help="runs for each setting")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    options = parser.parse_args()
    if options.seeds < 1 or options.jobs < 1:
        parser.error("--seeds and --jobs must be at least 1")
    settings = list(dict.fromkeys(setting for claim in CLAIMS for setting in claim.settings))
    orders = [(setting, seed) for setting in settings for seed in range(options.seeds)]
    runs: dict[Setting, list[Result]] = {setting: [] for setting in settings}
    for (setting, _seed), result in zip(orders, _run_all(orders, options.jobs), strict=True):
        runs[setting].append(result)
    lines = [claim.line(runs) for claim in CLAIMS]
    _print_table(lines, options.seeds)
    return 0 if all(line.met for line in lines) else 1


if __name__ == "__main__":
    sys.exit(main())
