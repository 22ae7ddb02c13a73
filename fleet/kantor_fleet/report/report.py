"""report.png: one picture of a run, drawn from its records and nothing else.

On the left the map at the end of the run, on the right its measures over time. Times are simulated seconds.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from kantor_fleet.report.history import RunHistory
from kantor_fleet.report.map_drawing import (
    draw_bumps,
    draw_deaths,
    draw_domain,
    draw_known,
    draw_radio,
    draw_samples,
    draw_supervisor,
    draw_targets,
    draw_trails,
    thinned,
)
from kantor_fleet.report.style import (
    CUT,
    FAINT,
    FIRST,
    FOUND,
    INK,
    KILLED,
    SECOND,
    TEXT_PT,
    THIRD,
    TITLE_PT,
    add_caption,
    add_legend,
    team_colours,
    tidy,
)
from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM
from kantor_protocol.scenario.faults.links import OneWay, Partition
from kantor_worldsim.observers.metrics.density import DensityRow
from kantor_worldsim.observers.metrics.mapping import MapMetrics, MapRow
from kantor_worldsim.record.records import Record

SIZE_IN = (14.0, 8.0)
DPI = 110
_TITLE_LETTERS = 130
"""Letters that fit on the title line at its full size."""
_GAP = "   ·   "
_ENDED = {"done": "energy spent", "limit": "time limit", "cut": "record cut"}
"""Reasons why a run ended without finishing."""
_ROWS_SHOWN = 4_000
_ROWS_NAMED, _LINES_SHOWN = 8, 40
"""Up to so many rows of outages have names; up to so many outages have vertical lines."""
_DEATHS = {"kill", "leave"}
"""Causes of outages that are drawn as deaths."""


def draw(records: Iterable[Record], path: Path, exact: Sequence[tuple[float, float]] = ()) -> None:
    """Write the picture of a run as PNG, 14 x 8 inches at 110 dpi.

    The records may stop anywhere. Without an opening there is nothing to draw, and no file.
    exact: times (s) with the exact distance (m) that was computed for them.
    """
    run = RunHistory.of(records)
    if run is None:
        return
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06)
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout=layout, facecolor="white")
    grid = figure.add_gridspec(2, 2, height_ratios=(0.08, 0.92), width_ratios=(1.65, 1.0))
    _write_title(figure.add_subfigure(grid[0, :]), run)
    _draw_map(figure.add_subfigure(grid[1, 0]), run)
    if isinstance(run.metrics, MapMetrics):
        _draw_exploration(figure.add_subfigure(grid[1, 1]), run, run.metrics)
    else:
        _draw_curves(figure.add_subfigure(grid[1, 1]), run, exact)
    figure.savefig(path, format="png", dpi=DPI)


def _write_title(place: SubFigure, run: RunHistory) -> None:
    """Write the mission and its outcome; they do not depend on the exchange."""
    mission = _mission(run)
    size = TITLE_PT * min(1.0, _TITLE_LETTERS / len(mission))
    place.text(0.012, 0.66, mission, size=size, weight="bold", color=INK, va="center")
    place.text(0.012, 0.16, _outcome(run), size=TITLE_PT - 1.5, color=INK, va="center")


def _mission(run: RunHistory) -> str:
    scenario, robots = run.scenario, run.scenario.robots.count
    merge = f"{scenario.merge} merge {'with' if scenario.claiming else 'without'} claims"
    parts = (
        scenario.name,
        f"seed {run.seed}",
        "1 robot" if robots == 1 else f"{robots} robots",
        scenario.coordination,
        *(() if scenario.mapping else (merge,)),
        f"{scenario.planner.name} planner",
    )
    return _GAP.join(parts)


def _outcome(run: RunHistory) -> str:
    result = run.metrics.result(exchange="", digest="", wall_s=0.0, record="", complaints=())
    parts = []
    if result.detection_rate is not None:
        targets = f"{result.detected:,} of {result.targets:,} targets detected"
        parts.append(f"{targets} ({100.0 * result.detection_rate:.1f} %)")
    if result.finished_tick is not None:
        parts.append(f"finished at tick {result.finished_tick:,}")
    else:
        parts.append(f"{_ENDED.get(result.ended, result.ended)} at tick {result.ticks:,}")
    if result.map is not None:
        parts.append(f"{100.0 * result.map.explored:.1f} % explored")
        parts.append(f"{result.map.distance_m:,.0f} m driven")
        return _GAP.join(parts)
    parts.append(f"mass left {100.0 * result.mass_left:.1f} %")
    bound_m = result.w_ub.paper
    digits = f"{bound_m:,.0f}" if bound_m >= 1000.0 else f"{bound_m:.4g}"
    parts.append(f"$W_\\mathrm{{UB}}$ {digits} m")
    return _GAP.join(parts)


def _draw_map(place: SubFigure, run: RunHistory) -> None:
    """Draw the map at the end of the run. Every mark has a label for the legend."""
    axes = place.subplots()
    if isinstance(run.metrics, MapMetrics):
        draw_known(axes, run.metrics.map_tracker, run.scenario.period_ns * 1e-9)
        draw_bumps(axes, run.metrics.map_tracker)
    else:
        draw_domain(axes, run)
        draw_samples(axes, run)
    draw_trails(axes, run)
    draw_deaths(axes, run)
    draw_targets(axes, run)
    draw_supervisor(axes, run)
    draw_radio(axes, run)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.02)
    axes.ticklabel_format(useOffset=False, style="plain")
    tidy(axes, "x, m", "y, m")
    handles, _ = axes.get_legend_handles_labels()
    trails = [handle for handle in handles if isinstance(handle, LineCollection)]
    if trails:
        add_caption(axes, trails, columns=5)
    add_legend(place, [handle for handle in handles if handle not in trails])


def _draw_curves(place: SubFigure, run: RunHistory, exact: Sequence[tuple[float, float]]) -> None:
    """Draw the measures of a run on a density over simulated time."""
    bounds, progress, mass = place.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.2, 1.0))
    rows = run.metrics.rows
    rows = rows[:-1][thinned(len(rows) - 1, _ROWS_SHOWN)] + rows[-1:]
    _draw_bounds(bounds, run, rows, exact)
    _draw_progress(progress, run, rows)
    _draw_mass(mass, rows)
    tidy(mass, "", "mass, %")
    _finish_curves(place, (bounds, progress, mass), run)


def _finish_curves(place: SubFigure, diagrams: Sequence[Axes], run: RunHistory) -> None:
    """Draw what all diagrams of a run share: the axis of time and the moments on it."""
    diagrams[-1].set_xlabel("simulated time, s", size=TEXT_PT, color=INK)
    end_s = max(run.end_ns, run.scenario.period_ns) * 1e-9
    diagrams[-1].set_xlim(0.0, 1.02 * end_s)  # so that marks at the very end are visible
    moments = [*_mark_moments(diagrams, run), *_mark_cuts(diagrams, run, end_s)]
    moments += _mark_outages(diagrams, run, end_s)
    if moments:
        add_legend(place, moments, widest=3)


def _draw_exploration(place: SubFigure, run: RunHistory, exploration: MapMetrics) -> None:
    """Draw the exploration of a map over simulated time."""
    explored, wtv, epv = place.subplots(3, 1, sharex=True, height_ratios=(1.7, 1.0, 1.0))
    rows = exploration.rows
    thin = thinned(len(rows), _ROWS_SHOWN)
    _draw_explored(explored, run, exploration, thin)
    for axes, values, label, colour in (
        (wtv, [row.wtv for row in rows], "WTV, ticks²", SECOND),
        (epv, [row.epv for row in rows], "EPV, %²", THIRD),
    ):
        _add_line(axes, rows[thin], values[thin], f"{label.partition(',')[0]} of 8 regions", colour)
        axes.set_ylim(bottom=0.0)
        tidy(axes, "", label)
        add_caption(axes, axes.lines)
    _finish_curves(place, (explored, wtv, epv), run)


def _draw_explored(axes: Axes, run: RunHistory, exploration: MapMetrics, thin: slice) -> None:
    """Draw the share that any robot has seen, tick by tick, and the share that each robot knows, row by row."""
    map_tracker, period_s = exploration.map_tracker, run.scenario.period_ns * 1e-9
    times_s = [row.time_s for row in exploration.rows[thin]]
    colours = team_colours(run.scenario.robots.count)
    known = np.array(exploration.shares[thin]).T
    for share, colour in zip(known, colours, strict=True):
        axes.plot(times_s, 100.0 * share, color=colour, lw=1.0, alpha=0.9, clip_on=False)
    axes.lines[0].set_label("a robot")
    seen = (
        100.0 * np.cumsum(np.bincount(map_tracker.stamps, minlength=1)) / max(1, map_tracker.total)
    )
    end = run.end_ns * 1e-9
    ticks_s = np.append(np.arange(seen.shape[0]) * period_s, max(end, 0.0))
    (union,) = axes.plot(ticks_s, np.append(seen, seen[-1]), color=FIRST, lw=2.0, label="any robot")
    handles = [union, axes.lines[0]]
    for share, tick, mark in ((95.0, map_tracker.t95_tick, "o"), (99.0, map_tracker.t99_tick, "s")):
        if tick is not None:
            label = f"{share:.0f} %: {tick * period_s:.1f} s"
            style: dict[str, Any] = {"ms": 6.0, "mfc": "white", "mec": FIRST, "label": label}
            handles += axes.plot([tick * period_s], [share], mark, zorder=4.0, **style)
    axes.set_ylim(0.0, 102.0)
    tidy(axes, "", "explored, %")
    add_caption(axes, handles, columns=2)


def _draw_bounds(
    axes: Axes, run: RunHistory, rows: Sequence[DensityRow], exact: Sequence[tuple[float, float]]
) -> None:
    equation = 6 if run.scenario.robots.count == 1 else 11 if run.scenario.centralized else 12
    lines = (
        (f"bound (eq. {equation})", [row.w_ub_paper for row in rows], FIRST, 2.4),
        ("tight bound", [row.w_ub_tight for row in rows], SECOND, 1.4),
        ("instant", [row.w_ub_instant for row in rows], THIRD, 1.1),
    )
    for label, values, colour, width in lines:
        _add_line(axes, rows, values, label, colour, width)
    if exact:
        axes.plot(*zip(*exact, strict=True), "o", ms=4.5, color=FOUND, label="exact distance")
    if any(row.w_ub_paper > 0.0 for row in rows):
        axes.set_yscale("log", nonpositive="mask")
    tidy(axes, "", "$W_\\mathrm{UB}$, m")
    add_caption(axes, axes.lines)


def _draw_progress(axes: Axes, run: RunHistory, rows: Sequence[DensityRow]) -> None:
    targets = run.setup.targets_m.shape[0]
    energy = run.scenario.steps_per_robot * run.scenario.robots.count
    if targets:
        detected = [100.0 * row.detected / targets for row in rows]
        _add_line(axes, rows, detected, f"detected, of {targets:,}", FOUND)
    spent = [100.0 * row.energy_spent / energy for row in rows]
    _add_line(axes, rows, spent, f"energy spent, of {energy:,}", FIRST)
    axes.set_ylim(0.0, 102.0)
    tidy(axes, "", "share, %")
    add_caption(axes, axes.lines)


def _draw_mass(axes: Axes, rows: Sequence[DensityRow]) -> None:
    _add_line(axes, rows, [100.0 * row.mass_left for row in rows], "mass left", FIRST)
    twice = [100.0 * row.mass_double_counted for row in rows]
    if any(twice):
        _add_line(axes, rows, twice, "mass counted twice", THIRD)
    axes.set_ylim(0.0, 1.02 * max(100.0, *twice))
    add_caption(axes, axes.lines)


def _mark_moments(diagrams: Sequence[Axes], run: RunHistory) -> list[Line2D]:
    """Draw vertical lines at the first contact and at the finish; the handles for the legend."""
    moments = (("first contact", run.contact_s, ":"), ("finished", run.finish_s, "--"))
    marks = []
    for name, at_s, style in moments:
        if at_s is not None:
            lines = [axes.axvline(at_s, color=FAINT, ls=style, lw=1.1) for axes in diagrams]
            lines[0].set_label(f"{name}, {at_s:.1f} s")
            marks.append(lines[0])
    return marks


def _mark_cuts(diagrams: Sequence[Axes], run: RunHistory, end_s: float) -> list[Patch]:
    """Shade the times in which a fault cut links; the patch for the legend."""
    cuts = [fault for fault in run.scenario.faults if isinstance(fault, Partition | OneWay)]
    cuts = [fault for fault in cuts if fault.from_s < end_s]
    for fault in cuts:
        until_s = end_s if fault.until_s is None else min(fault.until_s, end_s)
        for axes in diagrams:
            axes.axvspan(fault.from_s, until_s, color=CUT, alpha=0.25, lw=0.0, zorder=0.1)
    return [Patch(color=CUT, alpha=0.25, lw=0.0, label="links cut")] if cuts else []


def _mark_outages(diagrams: Sequence[Axes], run: RunHistory, end_s: float) -> list[Artist]:
    """Draw outages: a row of bars for each process below the upper edge of the first diagram, and thin lines.

    An outage of the supervisor or of world-sim affects all, so it is shaded over the whole height.
    """
    if not run.outages:
        return []
    names = [*run.scenario.roster, WORLD_SIM]
    rows = sorted({outage.who for outage in run.outages}, key=names.index)
    height = min(0.05, 0.5 / len(rows))
    top = diagrams[0]
    for who, cause, from_s, until_s in run.outages:
        last_s, row = (end_s if until_s is None else until_s), rows.index(who)
        colour = KILLED if cause in _DEATHS else FAINT
        low, high = 1.0 - height * (row + 0.9), 1.0 - height * (row + 0.1)
        top.axvspan(from_s, last_s, low, high, color=colour, alpha=0.8, lw=0.0, zorder=1.2)
        if len(rows) <= _ROWS_NAMED:
            style: dict[str, Any] = {"size": TEXT_PT - 2.5, "color": colour, "va": "bottom"}
            top.text(last_s, low, f" {who}", transform=top.get_xaxis_transform(), **style)
        for axes in diagrams if who in {SUPERVISOR, WORLD_SIM} else ():
            axes.axvspan(from_s, last_s, color=colour, alpha=0.1, lw=0.0, zorder=0.1)
        for axes in diagrams if len(run.outages) <= _LINES_SHOWN else ():
            axes.axvline(from_s, color=colour, lw=0.6, alpha=0.7, zorder=1.0)
    kinds = {outage.cause in _DEATHS for outage in run.outages}
    marks = ((True, KILLED, "killed"), (False, FAINT, "paused or away"))
    return [Patch(color=c, alpha=0.8, lw=0.0, label=text) for k, c, text in marks if k in kinds]


def _add_line(
    axes: Axes,
    rows: Sequence[DensityRow | MapRow],
    values: Sequence[float | None],
    label: str,
    colour: str,
    width: float = 1.4,
) -> None:
    """Draw a measure over time, with gaps where it has no value. A single row is drawn as a dot."""
    times_s = [row.time_s for row in rows]
    numbers = np.array(values, dtype=np.float64)
    if not np.isnan(numbers).all():
        marker = "o" if len(rows) == 1 else ""
        axes.plot(
            times_s,
            numbers,
            color=colour,
            lw=width,
            marker=marker,
            ms=4.0,
            clip_on=False,
            label=label,
        )
