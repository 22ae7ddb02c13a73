"""The figures of papers on maps, drawn from measured runs."""

from collections.abc import Mapping, Sequence
from textwrap import fill

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, MultipleLocator, NullLocator

from kantor_fleet.report.style import FAINT, INK, TEAM, TEXT_PT, tidy
from kantor_fleet.reproduce.claims import Measure, interval
from kantor_fleet.reproduce.drawing import legend_below, new_layout, write_title
from kantor_fleet.reproduce.measured_runs import MeasuredRun, Moment
from kantor_fleet.sweep.table import Row
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.world import WorldSetup

_EVERY = 10
"""Ticks from one point of a curve to the next."""
_LINES = (
    (INK, "-", 2.2),
    (TEAM[0], "-", 1.5),
    (TEAM[2], "-", 1.5),
    (TEAM[1], "-", 1.5),
    (TEAM[1], "--", 1.2),
    (TEAM[1], ":", 1.4),
)
"""Colour, style and width of planners, in the order in which they are given."""
_LETTERS = 46
"""Letters that fit on a line above a diagram of bars."""
_CURVES = {
    "wtv": "waiting time variance, tick²",
    "epv": "variance of the explored share, %²",
}

RunsByTeam = Mapping[int, Sequence[MeasuredRun]]
"""Runs by number of robots."""


def bars(
    scenario: Scenario, panels: Mapping[str, Mapping[bool, RunsByTeam]], finished: Measure
) -> Figure:
    """The map, and for each reading the mean times with 95 % intervals, uncoordinated beside coordinated."""
    figure = Figure(figsize=(13.2, 6.8), layout=new_layout())
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(0.72, 1.0))[0]
    _draw_map(left.subplots(), scenario)
    places = right.subplots(2, 2, sharey=True)
    for axes, (title, sides) in zip(places.flat, panels.items(), strict=True):
        _draw_bars(axes, sides, finished, scenario.clock.period_s)
        write_title(axes, fill(title, _LETTERS))
    places[0, 0].set_ylim(bottom=0.0)  # shared by all; the interval of two runs may reach below
    for axes in places[:, 0]:
        axes.set_ylabel("time to explore, s", size=TEXT_PT, color=INK)
    for axes in places[1]:
        axes.set_xlabel("robots", size=TEXT_PT, color=INK)
    legend_below(right, places[0, 0])
    return figure


def curves(panels: Mapping[int, Mapping[str, Sequence[MeasuredRun]]], name: str) -> Figure:
    """The mean over the runs of `wtv` or `epv` over time, a panel for each number of robots."""
    figure = Figure(figsize=(11.6, 8.2), layout=new_layout())
    places = figure.subplots(2, 2)
    for letter, axes, (robots, lines) in zip("abcd", places.flat, panels.items(), strict=True):
        for (label, runs), (colour, style, width) in zip(lines.items(), _LINES, strict=False):
            ticks, mean = mean_curve([run.course for run in runs], name)
            axes.plot(ticks, mean, color=colour, ls=style, lw=width, label=label)
            axes.plot(ticks[-1], mean[-1], "o", color=colour, ms=4.0)
        axes.set_xlim(left=0.0)
        if name == "wtv":
            axes.set_yscale(
                "log"
            )  # robots that start together may never part, and would hide the others
        else:
            axes.set_ylim(bottom=0.0)
        tidy(axes, "tick", _CURVES[name])
        write_title(
            axes, f"({letter}) {robots} robots, mean of {len(next(iter(lines.values())))} runs"
        )
    legend_below(figure, places[0, 0])
    return figure


def ratios(
    rows: Sequence[Row], measures: Sequence[str], others: Sequence[str], teams: Sequence[int]
) -> Figure:
    """KME over the others by number of robots, geometric means with 95 % intervals."""
    figure = Figure(figsize=(11.6, 8.2), layout=new_layout())
    places = figure.subplots(2, 2, sharex=True)
    for letter, axes, measure in zip("abcd", places.flat, measures, strict=True):
        axes.axhline(1.0, color=FAINT, lw=0.9, ls=":")
        for place, (other, (colour, _, _)) in enumerate(zip(others, _LINES[1:], strict=False)):
            found = [
                (int(row["robots"]), row["ratio"], row["factor_95"])
                for row in rows
                if (row["measure"], row["against"]) == (measure, other) and row["robots"].isdigit()
            ]
            _draw_ratios(axes, found, 0.12 * (place - 1), colour, f"KME over {other}")
        means = [row["ratio"] for row in rows if row["measure"] == measure and row["ratio"]]
        _ratio_scale(axes, min(means), max(means))
        axes.set_xticks(teams)
        tidy(axes, "robots" if letter in "cd" else "", "ratio")
        write_title(axes, f"({letter}) {measure}")
    legend_below(figure, places[0, 0])
    return figure


def mean_curve(
    courses: Sequence[Sequence[Moment]], name: str
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Ticks up to the last end, and the mean over the runs; a run that has ended keeps its last value."""
    end = max(course[-1].tick for course in courses)
    ticks = np.append(np.arange(0.0, end, _EVERY), end)
    values = [
        np.interp(
            ticks,
            [moment.tick for moment in course],
            [getattr(moment, name) for moment in course],
        )
        for course in courses
    ]
    return ticks, np.mean(values, axis=0)


def _draw_map(axes: Axes, scenario: Scenario) -> None:
    """Draw the true map: white is free."""
    ground = WorldSetup.of(scenario, 0).ground
    assert ground is not None
    colours = ListedColormap([FAINT, "white", INK])
    extent_m = ground.frame.extent_m
    axes.imshow(ground.cells, cmap=colours, vmin=0, vmax=2, origin="lower", extent=extent_m)
    axes.yaxis.set_major_locator(MultipleLocator(5.0))
    tidy(axes, "x, m", "y, m")
    write_title(
        axes, f"{extent_m[1] - extent_m[0]:g} x {extent_m[3] - extent_m[2]:g} m, own layout"
    )


def _draw_bars(
    axes: Axes, sides: Mapping[bool, RunsByTeam], finished: Measure, period_s: float
) -> None:
    for (coordinated, runs), shift, colour in zip(
        sides.items(), (-0.2, 0.2), (TEAM[1], TEAM[0]), strict=True
    ):
        means = [
            interval([period_s * finished(run) for run in team_runs]) for team_runs in runs.values()
        ]
        axes.bar(
            np.array(list(runs)) + shift,
            [mean for mean, _ in means],
            0.38,
            yerr=[half for _, half in means],
            color=colour,
            ecolor=INK,
            capsize=3.0,
            label="coordinated" if coordinated else "uncoordinated",
        )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    tidy(axes, "", "")


def _draw_ratios(
    axes: Axes,
    found: Sequence[tuple[int, float, float]],
    shift: float,
    colour: str,
    label: str,
) -> None:
    """Draw points with intervals; a point whose factor is not finite has none."""
    robots, means, factors = np.array(found, dtype=np.float64).reshape(-1, 3).T
    known = np.where(np.isfinite(factors), factors, 1.0)
    axes.errorbar(
        robots + shift,
        means,
        (means - means / known, means * known - means),
        color=colour,
        marker="o",
        ms=4.0,
        lw=1.4,
        elinewidth=1.0,
        capsize=2.5,
        label=label,
    )


def _ratio_scale(axes: Axes, low: float, high: float) -> None:
    """Set the scale by the means: intervals of few runs would reach beyond any picture."""
    axes.set_yscale("log")
    axes.set_ylim(0.5 * min(low, 1.0), 2.0 * max(high, 1.0))
    axes.yaxis.set_major_locator(
        FixedLocator([0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0])
    )
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
