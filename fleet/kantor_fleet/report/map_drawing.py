"""Drawing of a run on its map: domain, samples, targets and trails at a moment of its history.

Positions are in the world frame, in metres.
"""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.patches import Rectangle

from kantor_fleet.report.history import Points, RunHistory
from kantor_fleet.report.style import (
    EMPTY,
    FAINT,
    FOUND,
    INK,
    KILLED,
    MISSED,
    TEAM,
    TEXT_PT,
    team_colours,
)
from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.grid import FREE
from kantor_worldsim.observers.metrics.map_tracker import MapTracker

_WEIGHT = ListedColormap(colormaps["YlOrBr"](np.linspace(0.2, 0.65, 256)))
"""Colours of the weight left in a sample, from almost none to all."""

_TIME = ListedColormap(0.5 + 0.5 * colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3])
"""Colours of the time at which a cell was first seen: pale, since trails lie over them."""
_WALL, _UNSEEN_WALL = 0.5, 0.88
"""Brightness of a known wall relative to floor seen at that time; grey of an unknown wall."""

_CELLS_SHOWN, _EDGES_SHOWN = 2_000, 100_000
_POINTS_SHOWN = 200_000
_STROKE_POINTS = 4_096
"""The rasterizer gives up on very long lines, so a trail is drawn in strokes."""


def draw_domain(axes: Axes, run: RunHistory) -> None:
    """Draw the domain, from which random starts are drawn, as an outline."""
    low, high = run.scenario.domain.min_m, run.scenario.domain.max_m
    outline = Rectangle(low, high[0] - low[0], high[1] - low[1], fill=False, ec=FAINT, zorder=0.5)
    outline.set(linewidth=0.8, linestyle=(0, (4, 3)))
    axes.add_patch(outline)


def draw_known(axes: Axes, map_tracker: MapTracker, period_s: float) -> None:
    """Draw the true walls as outlines, and known cells by the time at which a robot first saw them."""
    frame, cells = map_tracker.frame, map_tracker.ground.cells
    step = max(1, -(-max(frame.rows, frame.columns) // _CELLS_SHOWN))
    first_tick = map_tracker.state.first_tick.reshape(cells.shape)[::step, ::step]
    free = cells[::step, ::step] == FREE
    last = max(1, map_tracker.tick)
    last_s = last * period_s
    paint = ScalarMappable(Normalize(0.0, last_s), _TIME)
    times = _TIME(np.arange(_TIME.N))[:, :3]
    unseen = np.full((1, 3), 1.0), np.full((1, 3), _UNSEEN_WALL)
    palette = np.rint(255.0 * np.concatenate((times, _WALL * times, *unseen))).astype(np.uint8)
    shade = np.minimum(_TIME.N * first_tick.astype(np.int64) // last, _TIME.N - 1).astype(np.int16)
    shade[~free] += _TIME.N
    shade[first_tick < 0] = 2 * _TIME.N
    shade[(first_tick < 0) & ~free] = 2 * _TIME.N + 1
    colours = palette[shade]
    left, right, bottom, top = frame.extent_m
    right += (-frame.columns % step) * frame.resolution_m
    top += (-frame.rows % step) * frame.resolution_m
    axes.imshow(
        colours, origin="lower", extent=(left, right, bottom, top), interpolation="none", zorder=0.2
    )
    edges_m = _edges(map_tracker)
    if edges_m is not None:
        outlines = LineCollection(list(edges_m), colors=FAINT, linewidths=0.5, zorder=0.6)
        axes.add_collection(outlines)
    add_scale(axes, paint, "first seen at  0 s", f"{last_s:.4g} s")


def _edges(map_tracker: MapTracker) -> Points | None:
    """(E, 2, 2) borders between free cells and others, world frame; None if there are too many to be drawn."""
    frame = map_tracker.frame
    free = np.pad(map_tracker.ground.cells == FREE, 1)
    along, across = free[1:, 1:-1] != free[:-1, 1:-1], free[1:-1, 1:] != free[1:-1, :-1]
    if np.count_nonzero(along) + np.count_nonzero(across) > _EDGES_SHOWN:
        return None
    row, column = np.nonzero(along)
    level = np.stack((column, row, column + 1, row), axis=1)
    row, column = np.nonzero(across)
    upright = np.stack((column, row, column, row + 1), axis=1)
    cells = np.concatenate((level, upright)).reshape(-1, 2, 2)
    return np.asarray(cells * frame.resolution_m + np.array(frame.origin_m))


def draw_bumps(axes: Axes, map_tracker: MapTracker) -> None:
    """Mark the places where a wall ended a robot's move."""
    if map_tracker.bumps:
        xy_m = np.array(map_tracker.bumps)
        xy_m = xy_m[thinned(xy_m.shape[0], _POINTS_SHOWN)]
        size = _mark_size(xy_m.shape[0], 30.0)
        _add_marks(axes, xy_m, s=size, c=MISSED, marker="1", lw=1.1, zorder=4.5, label="bump")


def draw_trails(axes: Axes, run: RunHistory) -> None:
    """Draw every robot's trail, its start as a cross and its end as a dot."""
    few = len(run.trails) <= len(TEAM)
    colours = team_colours(len(run.trails))
    for (name, trail), colour in zip(run.trails.items(), colours, strict=True):
        line = LineCollection(_strokes(trail.xy_m), colors=colour, zorder=2.0)
        line.set(linewidth=0.9 if few else 0.4, alpha=0.8 if few else 0.6)
        line.set_label(name if few else "_")
        axes.add_collection(line)
    ends_m = np.array([trail.end_m for trail in run.trails.values()])
    size, edge = (60.0, 1.0) if few else (16.0, 0.5)
    _add_marks(
        axes,
        run.setup.starts_m,
        s=size,
        c=INK,
        marker="x",
        lw=1.5 * edge,
        zorder=4.0,
        label="start",
    )
    _add_marks(axes, ends_m, s=size, c=colours, edgecolors=INK, lw=edge, zorder=5.0)
    axes.plot([], [], "o", ms=7.0, mfc="white", mec=INK, mew=1.0, label="end")


def draw_deaths(axes: Axes, run: RunHistory) -> None:
    """Mark the places where robots were killed."""
    if run.deaths_m:
        xy_m = np.array(run.deaths_m)
        style: dict[str, Any] = {"marker": "X", "edgecolors": "white", "label": "killed"}
        size = _mark_size(xy_m.shape[0], 110.0)
        _add_marks(axes, xy_m, s=size, c=KILLED, lw=0.8, zorder=5.5, **style)


def draw_samples(axes: Axes, run: RunHistory, *, scale: bool = True) -> None:
    """Draw samples coloured by the weight left in them. scale: add the colour scale above the map."""
    xy_m = run.walked(run.setup.samples_m, run.scenario.samples.diffusion_m, Purpose.SAMPLE_WALK)
    thin = thinned(xy_m.shape[0], _POINTS_SHOWN)  # samples lie along a curve, so this is even
    xy_m, share = xy_m[thin], run.share_left[thin]
    size = _mark_size(xy_m.shape[0], 16.0)
    empty = share <= 0.0
    if empty.any():
        _add_marks(axes, xy_m[empty], s=size, c=EMPTY, zorder=1.0, label="sample used up")
    if not empty.all():
        marks = _add_marks(
            axes,
            xy_m[~empty],
            s=size,
            c=share[~empty],
            cmap=_WEIGHT,
            norm=Normalize(0.0, 1.0),
            zorder=1.5,
        )
        if scale:
            add_scale(axes, marks, "weight left  0 %", "100 %")
        else:
            label = "sample with weight left"
            axes.plot([], [], "o", ms=4.0, mew=0.0, color=_WEIGHT(1.0), label=label)


def add_scale(axes: Axes, marks: ScalarMappable, low: str, high: str) -> None:
    """Add a colour scale outside the map's upper right corner. low, high: the labels of its ends."""
    place = axes.inset_axes((0.86, 1.009, 0.14, 0.014))
    bar = axes.figure.colorbar(marks, cax=place, orientation="horizontal", ticks=[])
    bar.ax.set_xticks([])
    bar.outline.set_visible(False)
    style: dict[str, Any] = {
        "transform": place.transAxes,
        "va": "center",
        "size": TEXT_PT,
        "color": INK,
    }
    place.text(-0.04, 0.5, low, ha="right", **style)
    place.text(1.04, 0.5, high, ha="left", **style)


def draw_targets(axes: Axes, run: RunHistory) -> None:
    """Mark detected targets where they were found, the others where they are at the end."""
    finds = run.metrics.finds
    found_m = np.array([(x_m, y_m) for *_, x_m, y_m in finds]).reshape(-1, 2)
    ends_m = run.walked(run.setup.targets_m, run.scenario.targets.diffusion_m, Purpose.TARGET_WALK)
    missed_m = np.delete(ends_m, [target for _, _, target, _, _ in finds], axis=0)
    size = _mark_size(ends_m.shape[0], 24.0)
    if found_m.size:
        found_m = found_m[thinned(found_m.shape[0], _POINTS_SHOWN)]
        plus: dict[str, Any] = {"marker": "+", "lw": 0.9, "label": "target detected"}
        _add_marks(axes, found_m, s=size, c=FOUND, zorder=3.0, **plus)
    if missed_m.size:
        missed_m = missed_m[thinned(missed_m.shape[0], _POINTS_SHOWN)]
        _add_marks(axes, missed_m, s=size / 3.0, c=MISSED, zorder=3.0, label="not detected")


def draw_supervisor(axes: Axes, run: RunHistory) -> None:
    """Mark the place of the supervisor, if there is one."""
    placed = not run.scenario.mapping or run.scenario.supervisor.pose_m is not None
    if run.scenario.centralized and placed:
        x_m, y_m = run.scenario.supervisor_m
        axes.plot([x_m], [y_m], "*", ms=15.0, mfc="white", mec=INK, zorder=6.0, label="supervisor")


def draw_radio(axes: Axes, run: RunHistory) -> None:
    """Draw the radio range of the supervisor, or else that of each robot at its end."""
    scenario = run.scenario
    centres_m = [trail.end_m for trail in run.trails.values()]
    range_m = scenario.radio.range_m
    if scenario.centralized:
        centres_m, range_m = [scenario.supervisor_m], scenario.supervisor.range_m
    if len(scenario.roster) == 1 or not 0.0 < range_m < np.inf:
        return
    width_m = [2.0 * range_m]
    circles = EllipseCollection(
        width_m, width_m, [0.0], units="xy", offsets=centres_m, offset_transform=axes.transData
    )
    circles.set(facecolor="none", edgecolor=FAINT, linewidth=0.8, zorder=0.8)
    circles.set_alpha(0.8 if len(centres_m) <= len(TEAM) else 0.25)
    axes.add_collection(circles, autolim=False)  # it may be wider than the map
    axes.plot([], [], "o", ms=9.0, mfc="none", mec=FAINT, label=f"radio range {range_m:g} m")


def _add_marks(axes: Axes, xy_m: Points, *, lw: float = 0.0, **style: Any) -> PathCollection:
    return axes.scatter(xy_m[:, 0], xy_m[:, 1], linewidths=lw, **style)


def _strokes(trail_m: Points) -> list[Points]:
    """A trail as a list of connected pieces."""
    starts = range(0, max(1, trail_m.shape[0] - 1), _STROKE_POINTS)
    return [trail_m[i : i + _STROKE_POINTS + 1] for i in starts]


def _mark_size(count: int, most: float) -> float:
    """The area of a mark in square points: smaller if there are many."""
    return max(1.0, min(most, 30_000.0 / max(1, count)))


def thinned(count: int, most: int) -> slice:
    """A slice that keeps at most `most` of `count` items, evenly."""
    return slice(None, None, max(1, -(-count // most)))
