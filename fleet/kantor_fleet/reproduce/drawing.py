"""The figures of papers on densities, drawn from records and rows of runs, by default of seed 0."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.layout_engine import ConstrainedLayoutEngine

from kantor_fleet.report.history import RunHistory
from kantor_fleet.report.map_drawing import (
    draw_domain,
    draw_radio,
    draw_samples,
    draw_targets,
    draw_trails,
)
from kantor_fleet.report.style import (
    FAINT,
    FIRST,
    FOUND,
    INK,
    SECOND,
    SMALL_PT,
    TEAM,
    TEXT_PT,
    THIRD,
    add_caption,
    tidy,
)
from kantor_fleet.reproduce.claims import Measure, interval
from kantor_fleet.reproduce.measured_runs import MeasuredRun, Setting, records_of
from kantor_protocol.wire.attestations import Identities
from kantor_worldsim.observers.metrics.density import DensityRow
from kantor_worldsim.record.records import Batch, Opening

_MAP_IN = 4.4
"""Width of one map, inches."""


def centralized(setting: Setting, run: MeasuredRun) -> Figure:
    """Figure 4: snapshots (a)-(e) and the bound (f)."""
    figure, axes = _panels(2, 3)
    ticks = (0, 300, 600, 800, 1000)
    _snapshots(axes[:5], setting, ticks)
    _bounds(axes[5], run)
    return figure


def decentralized(setting: Setting, runs: Sequence[MeasuredRun], ended: Measure) -> Figure:
    """Figure 7: the same for two robots that meet, in the run whose end is nearest to the median."""
    figure, axes = _panels(2, 3)
    ends = np.array([ended(run) for run in runs])
    seed = int(np.abs(ends - np.median(ends)).argmin())
    result = runs[seed].result
    assert result is not None
    end = int(ends[seed])
    _snapshots(axes[:5], setting, (0, 300, 600, 700, end), seed=seed)
    if result.first_contact_tick is not None:
        contact = f"first contact, {result.first_contact_tick}"
        axes[5].axvline(result.first_contact_tick, color=FAINT, ls=":", lw=1.2, label=contact)
    axes[5].axvline(end, color=FAINT, ls="--", lw=1.2, label=f"end, {end}")
    _bounds(axes[5], runs[seed])
    return figure


def trajectories(settings: Mapping[str, Setting]) -> Figure:
    """Figure 5: the ways of two methods side by side."""
    figure, axes = _panels(1, 2)
    for place, (letter, (name, setting)) in zip(
        axes, zip("ab", settings.items(), strict=True), strict=True
    ):
        *_, run = _runs_at(setting, (1000,))
        _map(place, run)
        found = f"{len(run.metrics.finds)} of {run.setup.targets_m.shape[0]} targets"
        write_title(place, f"({letter}) {name}: {found}")
    legend_below(figure, axes[0])
    return figure


def moving(settings: Mapping[str, Setting]) -> Figure:
    """Figure 8: snapshots of two settings at three ticks, one setting above the other."""
    figure, axes = _panels(2, 3)
    for row, (name, setting) in enumerate(settings.items()):
        places = axes[3 * row : 3 * row + 3]
        _snapshots(places, setting, (0, 500, 1000), "abc" if row == 0 else "def", f"{name}, ")
    return figure


def comparison(
    methods: Mapping[str, Sequence[MeasuredRun]], detected: Measure, robots_s: Measure
) -> Figure:
    """Figure 6: box plots of detection and bars of execution time."""
    figure = Figure(figsize=(10.5, 4.4), layout=new_layout())
    boxes, bars = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    _boxes(boxes, {name: [detected(run) for run in runs] for name, runs in methods.items()})
    tidy(boxes, "", "detected, %")
    write_title(boxes, f"(a) detection over {len(next(iter(methods.values())))} random starts")
    times_s = {name: [robots_s(run) for run in runs] for name, runs in methods.items()}
    medians_s = [float(np.median(values)) for values in times_s.values()]
    bars.bar(list(methods), medians_s, color=TEAM[: len(methods)], width=0.6)
    for x, median_s in enumerate(medians_s):
        bars.annotate(
            f"{median_s:.2f}",
            (x, median_s),
            (0, 3),
            textcoords="offset points",
            ha="center",
            size=TEXT_PT,
            color=INK,
        )
    tidy(bars, "", "CPU time of five robots, s")
    write_title(bars, "(b) execution time, both methods compiled")
    return figure


def diffusion(
    varying: Mapping[int, Sequence[MeasuredRun]],
    invariant: Mapping[int, Sequence[MeasuredRun]],
    detected: Measure,
) -> Figure:
    """Figure 9: means with 95 % intervals against the diffusion rate v."""
    figure = Figure(figsize=(6.6, 4.4), layout=new_layout())
    axes = figure.subplots()
    for runs_by_rate, label, colour in (
        (varying, "samples walk", SECOND),
        (invariant, "samples stand", THIRD),
    ):
        means = [interval([detected(run) for run in runs]) for runs in runs_by_rate.values()]
        axes.errorbar(
            list(runs_by_rate),
            [mean for mean, _ in means],
            [half for _, half in means],
            color=colour,
            marker="o",
            ms=4.0,
            lw=1.6,
            capsize=3.0,
            label=label,
        )
    tidy(axes, "diffusion rate v, m a tick", "detected, %")
    add_caption(axes, axes.get_legend_handles_labels()[0])
    return figure


class Curve(NamedTuple):
    """A line of means with their intervals."""

    x: Sequence[float]
    estimates: Sequence[tuple[float, float, float]]
    """The mean and the ends of its interval, for each x."""


class Panel(NamedTuple):
    """A diagram of curves."""

    x_label: str
    y_label: str
    curves: Mapping[str, Curve]


def resilience(panels: Sequence[Panel], columns: int) -> Figure:
    """Means with 95 % intervals against three kinds of faults; a row for each measure."""
    figure = Figure(
        figsize=(3.9 * columns, 3.3 * (len(panels) // columns) + 0.4), layout=new_layout()
    )
    places = figure.subplots(len(panels) // columns, columns, squeeze=False, sharey="row")
    for letter, axes, panel in zip("abcdefgh", places.flat, panels, strict=False):
        for (name, curve), colour in zip(panel.curves.items(), (SECOND, THIRD), strict=False):
            mean, low, high = np.array(curve.estimates).T
            axes.fill_between(curve.x, low, high, color=colour, alpha=0.22, lw=0.0)
            axes.plot(curve.x, mean, color=colour, marker="o", ms=4.0, lw=1.6, label=name)
        axes.set_xticks(panel.curves[next(iter(panel.curves))].x)
        tidy(axes, panel.x_label, panel.y_label if axes in places[:, 0] else "")
        write_title(axes, f"({letter})")
    for row in places:
        if "tick" in row[0].get_ylabel():
            row[0].set_ylim(bottom=0.0)
    legend_below(figure, places[0, 0])
    return figure


def _panels(rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(_MAP_IN * columns, 4.2 * rows + 0.4), layout=new_layout())
    return figure, list(figure.subplots(rows, columns, squeeze=False).flat)


def new_layout() -> ConstrainedLayoutEngine:
    """The layout of a picture of several diagrams."""
    return ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)


def _snapshots(
    places: Sequence[Axes],
    setting: Setting,
    ticks: Sequence[int],
    letters: str = "abcde",
    prefix: str = "",
    seed: int = 0,
) -> None:
    runs = _runs_at(setting, ticks, seed)
    for place, run, tick, letter in zip(places, runs, ticks, letters, strict=False):
        _map(place, run)
        found = f", {len(run.metrics.finds)} detected" if run.setup.targets_m.size else ""
        write_title(place, f"({letter}) {prefix}t = {tick}{found}")
    figure = places[0].figure
    assert isinstance(figure, Figure)
    legend_below(figure, places[min(1, len(places) - 1)])


def _runs_at(setting: Setting, ticks: Sequence[int], seed: int = 0) -> Iterator[RunHistory]:
    """The history of a run up to each of some ticks: one object, which advances with the iterator."""
    records = iter(records_of(setting, seed))
    opening = next(records)
    assert isinstance(opening, Opening)
    run, waiting = RunHistory(opening), next(records, None)
    if isinstance(waiting, Identities):
        waiting = next(records, None)
    for tick in ticks:
        until_ns = (tick + 1) * run.scenario.period_ns  # robots step at any phase of a period
        while isinstance(waiting, Batch) and waiting.now_ns < until_ns:
            run.follow(waiting)
            waiting = next(records, None)
        yield run


def _map(axes: Axes, run: RunHistory) -> None:
    draw_domain(axes, run)
    draw_trails(axes, run)
    draw_samples(axes, run, scale=False)
    draw_targets(axes, run)
    draw_radio(axes, run)
    axes.set_aspect("equal", adjustable="box")
    axes.margins(0.02)
    tidy(axes, "x, m", "y, m")


def write_title(axes: Axes, text: str) -> None:
    """Write a title above a diagram."""
    axes.set_title(text, size=TEXT_PT + 0.5, color=INK, loc="left")


def legend_below(figure: FigureBase, axes: Axes) -> None:
    """Add one legend for all diagrams, below them. axes: a diagram that has every label."""
    handles, labels = axes.get_legend_handles_labels()
    known = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    if not set(labels) - known:
        return
    figure.legend(
        handles,
        labels,
        loc="outside lower center",
        ncols=8,
        frameon=False,
        fontsize=SMALL_PT + 0.5,
        labelcolor=INK,
        markerscale=1.2,
    )


def _bounds(axes: Axes, run: MeasuredRun) -> None:
    ticks = [row.tick for row in run.rows]
    lines: tuple[tuple[str, Callable[[DensityRow], float | None], str, float], ...] = (
        ("bound", lambda row: row.w_ub_paper, FIRST, 2.2),
        ("tight bound", lambda row: row.w_ub_tight, SECOND, 1.4),
        ("last tick's shipping and pending", lambda row: row.w_ub_instant, THIRD, 1.1),
    )
    for label, measure, colour, width in lines:
        values = np.array([measure(row) for row in run.rows], dtype=np.float64)
        at_end = "" if np.isnan(values[-1]) else f", {values[-1]:.3g} m at the end"
        axes.plot(ticks, values, color=colour, lw=width, label=label + at_end)
    exact = [(row.tick, row.w1_exact) for row in run.rows if row.w1_exact is not None]
    if exact:
        label = f"exact distance, {exact[-1][1]:.3g} m at the end"
        axes.plot(*zip(*exact, strict=True), "o", ms=4.0, color=FOUND, label=label)
    axes.set_ylim(0.0, 1.45 * axes.get_ylim()[1])  # room for the legend
    tidy(axes, "tick", "m")
    write_title(axes, "(f) upper bound of the Wasserstein distance")
    axes.legend(loc="upper right", frameon=False, fontsize=SMALL_PT, labelcolor=INK)


def _boxes(axes: Axes, groups: Mapping[str, Sequence[float]]) -> None:
    """Draw boxes with every run beside them."""
    plot = axes.boxplot(
        list(groups.values()),
        tick_labels=list(groups),
        widths=0.5,
        patch_artist=True,
        showfliers=False,
        medianprops={"color": INK, "lw": 1.6},
    )
    for box, colour in zip(plot["boxes"], TEAM, strict=False):
        box.set(facecolor=colour, alpha=0.75, edgecolor=INK, linewidth=0.8)
    for place, values in enumerate(groups.values(), 1):
        shift = 0.12 * np.sin(
            2.4 * np.arange(len(values))
        )  # spread over the box, the same every time
        axes.scatter(place + shift, values, s=7.0, c=INK, alpha=0.35, linewidths=0.0, zorder=3.0)
