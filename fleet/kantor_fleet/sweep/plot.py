"""plot.png: one measure of a sweep over the varied keys.

The first varied key whose values are numbers lies on x; every combination of the others is a line, the
median of its runs, in a band from the first to the third quartile. Without such a key every variant is
a box with its runs beside it.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from kantor_fleet.report.style import FAINT, INK, TEXT_PT, TITLE_PT, add_caption, team_colours, tidy
from kantor_fleet.sweep.plan import SweepPlan, Variant
from kantor_fleet.sweep.summary import SummaryRow
from kantor_fleet.sweep.table import SweepRun, measures
from kantor_protocol.storage.drafts import replace

SIZE_IN = (8.0, 5.0)
DPI = 110

_GAP = "   ·   "
_BOX_IN = 1.1
"""Width of a picture for each box, if that is wider than SIZE_IN."""
_CAPTION_LETTERS = 66
"""Letters that fit on a line above the axes."""
_LOG_RATIO = 20.0
"""The ratio of the largest to the least value from which on x is logarithmic."""
_LABELLED_MAX = 8
"""The most values that each get a label on x."""
_PERCENT = frozenset({"detection_rate", "mass_left", "mass_double_counted"})
"""Shares, shown in percent."""
_NAMES = {
    "detection_rate": "targets detected, %",
    "finished_tick": "finished, tick",
    "first_contact_tick": "first contact, tick",
    "mass_left": "mass left, %",
    "mass_double_counted": "mass counted twice, %",
    "w_ub_paper": "$W_\\mathrm{UB}$, m",
    "w_ub_tight": "$W_\\mathrm{UB}$ (tight), m",
    "w1_exact": "$W_1$, m",
}


def draw(
    plan: SweepPlan, runs: Sequence[SweepRun], lines: Sequence[SummaryRow], measure: str, path: Path
) -> None:
    """Write the picture of a measure as PNG; no file if no run has it."""
    rows = [row for row in lines if row.measure == measure and row.runs.n]
    if not rows:
        path.unlink(missing_ok=True)  # it may be of another plan
        return
    axis = _axis(plan)
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06)
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout=layout, facecolor="white")
    grid = figure.add_gridspec(2, 1, height_ratios=(0.12, 0.88))
    _write_title(figure.add_subfigure(grid[0]), plan, runs, lines=axis is not None)
    axes = figure.add_subfigure(grid[1]).subplots()
    if axis is None:
        figure.set_figwidth(max(SIZE_IN[0], _BOX_IN * len(rows)))
        _draw_boxes(axes, plan, runs, rows)
    else:
        _draw_lines(axes, plan, rows, axis)
    tidy(axes, "" if axis is None else plan.keys[axis], _NAMES.get(measure, measure))
    replace(path, lambda draft: figure.savefig(draft, format="png", dpi=DPI))


def _axis(plan: SweepPlan) -> int | None:
    """The index of the key on x: the first that takes several values, all of them numbers."""
    for index in range(len(plan.keys)):
        values = {variant.values[index] for variant in plan.variants}
        if len(values) > 1 and all(type(value) in {int, float} for value in values):
            return index
    return None


def _draw_lines(axes: Axes, plan: SweepPlan, lines: Sequence[SummaryRow], axis: int) -> None:
    places = _place_values(axes, sorted({_number(line.variant, axis) for line in lines}))
    groups: dict[str, list[SummaryRow]] = {}
    for line in lines:
        groups.setdefault(_label(plan, line.variant, axis), []).append(line)
    for (label, group), colour in zip(groups.items(), team_colours(len(groups)), strict=True):
        group.sort(key=lambda line: _number(line.variant, axis))
        x = [places[_number(line.variant, axis)] for line in group]
        spreads = [line.runs for line in group]
        scale = _scale(group[0].measure)
        first = scale * np.array([spread.quartile_1 for spread in spreads])
        third = scale * np.array([spread.quartile_3 for spread in spreads])
        median = scale * np.array([spread.median for spread in spreads])
        axes.fill_between(x, first, third, color=colour, alpha=0.16, lw=0.0)
        axes.plot(x, median, "o-", color=colour, lw=1.6, ms=4.5, mec="white", label=label)
    axes.grid(axis="y", color=FAINT, alpha=0.25, lw=0.6)
    if len(groups) > 1:
        widest = max(map(len, groups))
        add_caption(axes, axes.lines, columns=max(1, _CAPTION_LETTERS // widest))


def _place_values(axes: Axes, values: Sequence[float]) -> dict[float, float]:
    """The place of each value on x, which is logarithmic for a large span; equal steps if a value is infinite."""
    axes.margins(x=0.03)
    finite = all(map(math.isfinite, values))
    places = dict(zip(values, values if finite else range(len(values)), strict=True))
    if finite and 0.0 < _LOG_RATIO * values[0] <= values[-1]:
        axes.set_xscale("log")
    if len(values) <= _LABELLED_MAX or not finite:
        axes.set_xticks(list(places.values()), [f"{value:g}" for value in values])
        axes.set_xticks([], minor=True)
    return places


def _number(variant: Variant, axis: int) -> float:
    return float(variant.values[axis])


def _draw_boxes(
    axes: Axes, plan: SweepPlan, runs: Sequence[SweepRun], lines: Sequence[SummaryRow]
) -> None:
    measure = lines[0].measure
    scale = _scale(measure)
    for place, (line, colour) in enumerate(zip(lines, team_colours(len(lines)), strict=True)):
        found = (measures(run.outcome.result) for run in runs if run.variant is line.variant)
        values = scale * np.array([row[measure] for row in found if row.get(measure) is not None])
        axes.boxplot(
            values,
            positions=[place],
            widths=0.4,
            showfliers=False,
            patch_artist=True,
            boxprops={"facecolor": colour, "alpha": 0.3, "edgecolor": colour},
            medianprops={"color": INK, "lw": 1.4},
            whiskerprops={"color": FAINT, "lw": 0.9},
            capprops={"color": FAINT, "lw": 0.9},
        )
        spots = place + 0.28 + 0.1 * np.linspace(0.0, 1.0, values.size)
        axes.plot(spots, values, "o", color=colour, ms=2.6, mew=0.0, alpha=0.7)
    labels = [_label(plan, line.variant, None).replace(_GAP, "\n") for line in lines]
    axes.set_xticks(range(len(lines)), labels)
    axes.set_xlim(-0.6, len(lines) - 0.3)
    axes.grid(axis="y", color=FAINT, alpha=0.25, lw=0.6)


def _label(plan: SweepPlan, variant: Variant, axis: int | None) -> str:
    """The values of a variant, without the key on x and those that do not vary."""
    words = [
        f"{key} {text}"
        for index, (key, text) in enumerate(variant.settings(plan.keys).items())
        if index != axis and len({other.values[index] for other in plan.variants}) > 1
    ]
    return _GAP.join(words)


def _write_title(
    place: SubFigure, plan: SweepPlan, runs: Sequence[SweepRun], *, lines: bool
) -> None:
    """Write the scenario's name, the number of seeds and the meaning of the marks."""
    seeds = len({run.seed for run in runs})
    marks = "median of the runs, in a band of their quartiles" if lines else "every dot a run"
    caption = _GAP.join((f"{seeds} seeds" if seeds > 1 else "1 seed", marks))
    place.text(0.02, 0.66, plan.name, size=TITLE_PT, weight="bold", color=INK, va="center")
    place.text(0.02, 0.14, caption, size=TEXT_PT, color=INK, va="center")


def _scale(measure: str) -> float:
    return 100.0 if measure in _PERCENT else 1.0
