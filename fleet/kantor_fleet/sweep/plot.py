"""plot.png: one measure of a sweep over what was varied.

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

from kantor_fleet.style import FAINT, INK, TEXT_PT, TITLE_PT, add_caption, team_colours, tidy
from kantor_fleet.sweep.plan import Plan, Value, Variant
from kantor_fleet.sweep.summary import Line
from kantor_fleet.sweep.table import Run, measures, replace

SIZE_IN = (8.0, 5.0)
DPI = 110

_GAP = "   ·   "
_BOX_IN = 1.1
"""Width of a picture for each box beyond what fits."""
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


def draw(plan: Plan, runs: Sequence[Run], lines: Sequence[Line], measure: str, path: Path) -> None:
    """Write the picture of a measure as PNG; nothing if no run has it."""
    ours = [line for line in lines if line.measure == measure and line.runs.n]
    if not ours:
        return
    axis = _axis(plan)
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained", facecolor="white")
    grid = figure.add_gridspec(2, 1, height_ratios=(0.12, 0.88))
    _write_title(figure.add_subfigure(grid[0]), plan, runs, lines=axis is not None)
    axes = figure.add_subfigure(grid[1]).subplots()
    if axis is None:
        figure.set_figwidth(max(SIZE_IN[0], _BOX_IN * len(ours)))
        _draw_boxes(axes, plan, runs, ours)
    else:
        _draw_lines(axes, plan, ours, axis)
    tidy(axes, "" if axis is None else plan.keys[axis], _NAMES.get(measure, measure))
    replace(path, lambda draft: figure.savefig(draft, format="png", dpi=DPI))


def _axis(plan: Plan) -> int | None:
    """Which key lies on x: the first that takes several values, all of them finite numbers."""
    for index in range(len(plan.keys)):
        values = {variant.values[index] for variant in plan.variants}
        if len(values) > 1 and all(map(_is_number, values)):
            return index
    return None


def _is_number(value: Value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _draw_lines(axes: Axes, plan: Plan, lines: Sequence[Line], axis: int) -> None:
    groups: dict[str, list[Line]] = {}
    for line in lines:
        groups.setdefault(_label(plan, line.variant, axis), []).append(line)
    for (label, group), colour in zip(groups.items(), team_colours(len(groups)), strict=True):
        group.sort(key=lambda line: line.variant.values[axis])
        x = [line.variant.values[axis] for line in group]
        scale = _scale(group[0].measure)
        first, median, third = (
            scale * np.array([line.runs[field] for line in group], dtype=np.float64)
            for field in (2, 1, 3)
        )
        axes.fill_between(x, first, third, color=colour, alpha=0.16, lw=0.0)
        axes.plot(x, median, "o-", color=colour, lw=1.6, ms=4.5, mec="white", label=label)
    axes.margins(x=0.03)
    axes.grid(axis="y", color=FAINT, alpha=0.25, lw=0.6)
    if len(groups) > 1:
        add_caption(axes, axes.lines, columns=2)


def _draw_boxes(axes: Axes, plan: Plan, runs: Sequence[Run], lines: Sequence[Line]) -> None:
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


def _label(plan: Plan, variant: Variant, axis: int | None) -> str:
    """What a variant is, without what lies on x and what does not vary."""
    words = [
        f"{key} {value}"
        for index, (key, value) in enumerate(zip(plan.keys, variant.values, strict=True))
        if index != axis and len({other.values[index] for other in plan.variants}) > 1
    ]
    return _GAP.join(words)


def _write_title(place: SubFigure, plan: Plan, runs: Sequence[Run], *, lines: bool) -> None:
    """What was run, and what the marks are."""
    seeds = len({run.seed for run in runs})
    marks = "median of the runs, in a band of their quartiles" if lines else "every dot a run"
    told = _GAP.join((f"{seeds} seeds" if seeds > 1 else "1 seed", marks))
    place.text(0.02, 0.66, plan.name, size=TITLE_PT, weight="bold", color=INK, va="center")
    place.text(0.02, 0.14, told, size=TEXT_PT, color=INK, va="center")


def _scale(measure: str) -> float:
    return 100.0 if measure in _PERCENT else 1.0
