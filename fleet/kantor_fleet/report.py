"""report.png: one picture of a run, drawn from its records and nothing else.

Left the map as the run left it, right how it got there. Positions are in the world frame, in
metres; times are simulated seconds.
"""

from array import array
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection
from matplotlib.colors import ListedColormap, Normalize, to_hex
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from kantor_protocol.keyed import Purpose
from kantor_protocol.machine import SUPERVISOR, ParticipantId, State
from kantor_protocol.packing import Pairs
from kantor_protocol.walk import Walk
from kantor_worldsim.metrics import Metrics, Row
from kantor_worldsim.records import Act, Batch, Ending, Opening, Record

SIZE_IN = (14.0, 8.0)
DPI = 110

_TEXT_PT, _SMALL_PT, _TITLE_PT = 9.5, 8.5, 12.5
_TITLE_LETTERS = 130
"""What fits on a line of that size."""
_INK, _FAINT, _EMPTY = "#222222", "#8c8c8c", "#d9d9d9"
_FOUND, _MISSED = "#00875a", "#111111"
_FIRST, _SECOND, _THIRD = _INK, "#3f90da", "#e76300"
"""The lines of a diagram, in this order."""
_TEAM = (
    "#3f90da",
    "#ffa90e",
    "#bd1f01",
    "#832db6",
    "#a96b59",
    "#e76300",
    "#b9ac70",
    "#92dadd",
    "#717581",
    "#94a4a2",
)
"""Petroff's ten colours, told apart with any colour vision; the greys last, for samples are grey."""
_WEIGHT = ListedColormap(colormaps["YlOrBr"](np.linspace(0.2, 0.65, 256)))
"""The weight left in a sample, from hardly any to all."""

_GAP = "   ·   "
_ENDED = {"done": "energy spent", "limit": "time limit", "cut": "record cut"}
"""Why a run ended that did not finish."""

_POINTS_SHOWN = 200_000
_ROWS_SHOWN = 4_000
_STROKE_POINTS = 4_096
"""The rasterizer gives up on very long lines, so a trail is drawn in strokes."""
_GRAIN = 1.0 / 4_000
"""A trail keeps a point for each such share of the domain's diagonal: below a pixel."""

Points = npt.NDArray[np.float64]


def draw(records: Iterable[Record], path: Path) -> None:
    """Write the picture of a run as PNG, 14 x 8 inches at 110 dpi.

    The records may stop anywhere. Without an opening there is nothing to draw, and no file.
    """
    run = Run.of(records)
    if run is None:
        return
    layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06)
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout=layout, facecolor="white")
    grid = figure.add_gridspec(2, 2, height_ratios=(0.08, 0.92), width_ratios=(1.65, 1.0))
    _write_title(figure.add_subfigure(grid[0, :]), run)
    _draw_map(figure.add_subfigure(grid[1, 0]), run)
    _draw_curves(figure.add_subfigure(grid[1, 1]), run)
    figure.savefig(path, format="png", dpi=DPI)


class Trail:
    """The way of one robot, at the resolution of the picture, however many steps it made."""

    def __init__(self, x_m: float, y_m: float, grain_m: float) -> None:
        self.end_m = (x_m, y_m)
        self._kept = array("d", self.end_m)
        self._grain_m = grain_m

    def extend(self, x_m: float, y_m: float) -> None:
        """Go on to a place."""
        self.end_m = (x_m, y_m)
        if max(abs(x_m - self._kept[-2]), abs(y_m - self._kept[-1])) >= self._grain_m:
            self._kept.extend(self.end_m)

    @property
    def xy_m(self) -> Points:
        """(P, 2) from start to end."""
        return np.array([*self._kept, *self.end_m]).reshape(-1, 2)


class Run:
    """What the picture needs to know of a run."""

    def __init__(self, opening: Opening) -> None:
        self.scenario, self.seed, self.site = opening.scenario, opening.seed, opening.site
        self.metrics = Metrics()
        self.end_ns = 0
        self.contact_s: float | None = None
        """When a robot first took in a message."""
        domain = self.scenario.domain
        grain_m = _GRAIN * float(np.hypot(*np.subtract(domain.max_m, domain.min_m)))
        starts_m = zip(self.scenario.robot_ids, self.site.starts_m.tolist(), strict=True)
        self.trails = {name: Trail(x_m, y_m, grain_m) for name, (x_m, y_m) in starts_m}
        self._units = opening.units
        self._left = np.full(self.site.samples_m.shape[0], self._units.sample, dtype=np.int64)
        self._finished_ns: dict[ParticipantId, int] = {}
        self._pairs = Pairs()
        self.metrics.take(opening)

    @classmethod
    def of(cls, records: Iterable[Record]) -> "Run | None":
        """Follow records to their end; None if they do not even open."""
        following = iter(records)
        opening = next(following, None)
        if not isinstance(opening, Opening):
            return None
        run = cls(opening)
        for record in following:
            run.follow(record)
        return run

    @property
    def finish_s(self) -> float | None:
        """When the last robot saw no weight left, if all came to see that."""
        if len(self._finished_ns) < self.scenario.robots.count:
            return None
        return max(self._finished_ns.values()) * 1e-9

    @property
    def share_left(self) -> Points:
        """(N,) of the weight that a sample had, what is left of it in the common view."""
        return np.asarray(np.maximum(self._left, 0) / self._units.sample)

    def walked(self, points_m: Points, diffusion_m: float, purpose: Purpose) -> Points:
        """Where points of time 0 are at the end."""
        walk = Walk(points_m, diffusion_m, self.scenario.period_ns, self.seed, purpose)
        walk.advance(self.end_ns)
        return walk.xy_m

    def follow(self, record: Record) -> None:
        """Take in one record after the opening."""
        self.metrics.take(record)
        if isinstance(record, Batch | Ending):
            self.end_ns = max(self.end_ns, record.now_ns)
        if isinstance(record, Batch):
            for act in record.acts:
                self._follow_act(act)

    def _follow_act(self, act: Act) -> None:
        outputs, ruling = act.outputs, act.ruling
        if outputs is None or ruling is None:
            return
        if self.scenario.merge == "min":
            self._lower(outputs.lowered)
        elif not {"step", "energy", "units"} & set(ruling.violations):
            self._spend(outputs.spent)
        if act.name == SUPERVISOR:
            return
        self.trails[act.name].extend(ruling.pose.x_m, ruling.pose.y_m)
        if act.heard and self.contact_s is None:
            self.contact_s = act.now_ns * 1e-9
        if outputs.state is State.FINISHED:
            self._finished_ns.setdefault(act.name, act.now_ns)

    def _lower(self, packed: bytes) -> None:
        """With the minimum merge, the common view is the least that anybody has published."""
        pairs = self._pairs.decode(packed, self._left.shape[0])
        if pairs is not None:
            np.minimum.at(self._left, *pairs)

    def _spend(self, packed: bytes) -> None:
        """With a ledger, the common view is what all have truly spent."""
        pairs = self._pairs.decode(packed, self._left.shape[0])
        if pairs is not None:
            np.subtract.at(self._left, *pairs)


def _write_title(place: SubFigure, run: Run) -> None:
    """What was run, and what came of it, whatever exchange ran it."""
    what = _what(run)
    size = _TITLE_PT * min(1.0, _TITLE_LETTERS / len(what))
    place.text(0.012, 0.66, what, size=size, weight="bold", color=_INK, va="center")
    place.text(0.012, 0.16, _outcome(run), size=_TITLE_PT - 1.5, color=_INK, va="center")


def _what(run: Run) -> str:
    scenario, robots = run.scenario, run.scenario.robots.count
    parts = (
        scenario.name,
        f"seed {run.seed}",
        "1 robot" if robots == 1 else f"{robots} robots",
        scenario.coordination,
        f"{scenario.merge} merge {'with' if scenario.claiming else 'without'} claims",
        f"{scenario.planner.name} planner",
    )
    return _GAP.join(parts)


def _outcome(run: Run) -> str:
    result = run.metrics.result(exchange="", digest="", wall_s=0.0, record="", complaints=())
    parts = []
    if result.detection_rate is not None:
        targets = f"{result.detected:,} of {result.targets:,} targets detected"
        parts.append(f"{targets} ({100.0 * result.detection_rate:.1f} %)")
    if result.finished_tick is not None:
        parts.append(f"finished at tick {result.finished_tick:,}")
    else:
        parts.append(f"{_ENDED.get(result.ended, result.ended)} at tick {result.ticks:,}")
    parts.append(f"mass left {100.0 * result.mass_left:.1f} %")
    bound_m = result.w_ub.paper
    digits = f"{bound_m:,.0f}" if bound_m >= 1000.0 else f"{bound_m:.4g}"
    parts.append(f"$W_\\mathrm{{UB}}$ {digits} m")
    return _GAP.join(parts)


def _draw_map(place: SubFigure, run: Run) -> None:
    """The map as the run left it. Every mark names itself for the legend."""
    axes = place.subplots()
    _draw_domain(axes, run)
    _draw_trails(axes, run)
    _draw_samples(axes, run)
    _draw_targets(axes, run)
    _draw_supervisor(axes, run)
    _draw_radio(axes, run)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.02)
    axes.ticklabel_format(useOffset=False, style="plain")
    _tidy(axes, "x, m", "y, m")
    handles, _ = axes.get_legend_handles_labels()
    ways = [handle for handle in handles if isinstance(handle, LineCollection)]
    if ways:
        _add_caption(axes, ways, columns=5)
    _add_legend(place, [handle for handle in handles if handle not in ways])


def _draw_domain(axes: Axes, run: Run) -> None:
    low, high = run.scenario.domain.min_m, run.scenario.domain.max_m
    outline = Rectangle(low, high[0] - low[0], high[1] - low[1], fill=False, ec=_FAINT, zorder=0.5)
    outline.set(linewidth=0.8, linestyle=(0, (4, 3)))
    axes.add_patch(outline)


def _draw_trails(axes: Axes, run: Run) -> None:
    """Every robot's way, its start a cross, its end a dot."""
    few = len(run.trails) <= len(_TEAM)
    colours = team_colours(len(run.trails))
    for (name, trail), colour in zip(run.trails.items(), colours, strict=True):
        way = LineCollection(_strokes(trail.xy_m), colors=colour, zorder=2.0)
        way.set(linewidth=0.9 if few else 0.4, alpha=0.8 if few else 0.6)
        way.set_label(name if few else "_")
        axes.add_collection(way)
    ends_m = np.array([trail.end_m for trail in run.trails.values()])
    size, edge = (60.0, 1.0) if few else (16.0, 0.5)
    _add_marks(
        axes,
        run.site.starts_m,
        s=size,
        c=_INK,
        marker="x",
        lw=1.5 * edge,
        zorder=4.0,
        label="start",
    )
    _add_marks(axes, ends_m, s=size, c=colours, edgecolors=_INK, lw=edge, zorder=5.0)
    axes.plot([], [], "o", ms=7.0, mfc="white", mec=_INK, mew=1.0, label="end")


def _draw_samples(axes: Axes, run: Run) -> None:
    """Samples by the weight that is left in them."""
    xy_m = run.walked(run.site.samples_m, run.scenario.samples.diffusion_m, Purpose.SAMPLE_WALK)
    thin = _thinned(xy_m.shape[0], _POINTS_SHOWN)  # they lie along a curve, so this is even
    xy_m, share = xy_m[thin], run.share_left[thin]
    size = _mark_size(xy_m.shape[0], 16.0)
    empty = share <= 0.0
    if empty.any():
        _add_marks(axes, xy_m[empty], s=size, c=_EMPTY, zorder=1.0, label="sample used up")
    if not empty.all():
        scale = Normalize(0.0, 1.0)
        marks = _add_marks(
            axes, xy_m[~empty], s=size, c=share[~empty], cmap=_WEIGHT, norm=scale, zorder=1.5
        )
        _add_scale(axes, marks)


def _add_scale(axes: Axes, marks: PathCollection) -> None:
    """What the samples' colours mean, in the map's upper right corner, outside."""
    place = axes.inset_axes((0.86, 1.009, 0.14, 0.014))
    bar = axes.figure.colorbar(marks, cax=place, orientation="horizontal", ticks=[0.0, 1.0])
    bar.ax.set_xticks([])
    bar.outline.set_visible(False)
    words: dict[str, Any] = {
        "transform": place.transAxes,
        "va": "center",
        "size": _TEXT_PT,
        "color": _INK,
    }
    place.text(-0.04, 0.5, "weight left  0 %", ha="right", **words)
    place.text(1.04, 0.5, "100 %", ha="left", **words)


def _draw_targets(axes: Axes, run: Run) -> None:
    """Detected targets where they were found, the others where they are at the end."""
    finds = run.metrics.finds
    found_m = np.array([(x_m, y_m) for *_, x_m, y_m in finds]).reshape(-1, 2)
    ends_m = run.walked(run.site.targets_m, run.scenario.targets.diffusion_m, Purpose.TARGET_WALK)
    missed_m = np.delete(ends_m, [target for _, _, target, _, _ in finds], axis=0)
    size = _mark_size(ends_m.shape[0], 24.0)
    if found_m.size:
        found_m = found_m[_thinned(found_m.shape[0], _POINTS_SHOWN)]
        plus: dict[str, Any] = {"marker": "+", "lw": 0.9, "label": "target detected"}
        _add_marks(axes, found_m, s=size, c=_FOUND, zorder=3.0, **plus)
    if missed_m.size:
        missed_m = missed_m[_thinned(missed_m.shape[0], _POINTS_SHOWN)]
        _add_marks(axes, missed_m, s=size / 3.0, c=_MISSED, zorder=3.0, label="not detected")


def _draw_supervisor(axes: Axes, run: Run) -> None:
    if run.scenario.centralized:
        x_m, y_m = run.scenario.supervisor_m
        axes.plot([x_m], [y_m], "*", ms=15.0, mfc="white", mec=_INK, zorder=6.0, label="supervisor")


def _draw_radio(axes: Axes, run: Run) -> None:
    """How far the supervisor is heard, or else each robot from where it ended."""
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
    circles.set(facecolor="none", edgecolor=_FAINT, linewidth=0.8, zorder=0.8)
    circles.set_alpha(0.8 if len(centres_m) <= len(_TEAM) else 0.25)
    axes.add_collection(circles, autolim=False)  # it may be wider than the map
    axes.plot([], [], "o", ms=9.0, mfc="none", mec=_FAINT, label=f"radio range {range_m:g} m")


def _draw_curves(place: SubFigure, run: Run) -> None:
    """What the run measured, over simulated time."""
    bounds, progress, mass = place.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.2, 1.0))
    rows = run.metrics.rows
    rows = rows[:-1][_thinned(len(rows) - 1, _ROWS_SHOWN)] + rows[-1:]
    _draw_bounds(bounds, run, rows)
    _draw_progress(progress, run, rows)
    _draw_mass(mass, rows)
    _tidy(mass, "simulated time, s", "mass, %")
    end_s = max(run.end_ns, run.scenario.period_ns) * 1e-9
    mass.set_xlim(0.0, 1.02 * end_s)  # so that what happens at the very end is seen
    moments = _mark_moments((bounds, progress, mass), run)
    if moments:
        _add_legend(place, moments)


def _draw_bounds(axes: Axes, run: Run, rows: Sequence[Row]) -> None:
    equation = 6 if run.scenario.robots.count == 1 else 11 if run.scenario.centralized else 12
    lines = (
        (f"bound (eq. {equation})", [row.w_ub_paper for row in rows], _FIRST, 2.4),
        ("tight bound", [row.w_ub_tight for row in rows], _SECOND, 1.4),
        ("instant", [row.w_ub_instant for row in rows], _THIRD, 1.1),
    )
    for label, values, colour, width in lines:
        _add_line(axes, rows, values, label, colour, width)
    if any(row.w_ub_paper > 0.0 for row in rows):
        axes.set_yscale("log", nonpositive="mask")
    _tidy(axes, "", "$W_\\mathrm{UB}$, m")
    _add_caption(axes, axes.lines)


def _draw_progress(axes: Axes, run: Run, rows: Sequence[Row]) -> None:
    targets = run.site.targets_m.shape[0]
    energy = run.scenario.steps_per_robot * run.scenario.robots.count
    if targets:
        detected = [100.0 * row.detected / targets for row in rows]
        _add_line(axes, rows, detected, f"detected, of {targets:,}", _FOUND)
    spent = [100.0 * row.energy_spent / energy for row in rows]
    _add_line(axes, rows, spent, f"energy spent, of {energy:,}", _FIRST)
    axes.set_ylim(0.0, 102.0)
    _tidy(axes, "", "share, %")
    _add_caption(axes, axes.lines)


def _draw_mass(axes: Axes, rows: Sequence[Row]) -> None:
    _add_line(axes, rows, [100.0 * row.mass_left for row in rows], "mass left", _FIRST)
    twice = [100.0 * row.mass_double_counted for row in rows]
    if any(twice):
        _add_line(axes, rows, twice, "mass counted twice", _THIRD)
    axes.set_ylim(0.0, 1.02 * max(100.0, *twice))
    _add_caption(axes, axes.lines)


def _mark_moments(diagrams: Sequence[Axes], run: Run) -> list[Line2D]:
    """Vertical lines where something happened; one of each for the legend."""
    moments = (("first contact", run.contact_s, ":"), ("finished", run.finish_s, "--"))
    marks = []
    for name, at_s, style in moments:
        if at_s is not None:
            lines = [axes.axvline(at_s, color=_FAINT, ls=style, lw=1.1) for axes in diagrams]
            lines[0].set_label(f"{name}, {at_s:.1f} s")
            marks.append(lines[0])
    return marks


def _add_marks(axes: Axes, xy_m: Points, *, lw: float = 0.0, **style: Any) -> PathCollection:
    return axes.scatter(xy_m[:, 0], xy_m[:, 1], linewidths=lw, **style)


def _add_line(
    axes: Axes,
    rows: Sequence[Row],
    values: Sequence[float | None],
    label: str,
    colour: str,
    width: float = 1.4,
) -> None:
    """A measurement over time; where it is no number, nothing. One row alone shows as a dot."""
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


def _add_caption(axes: Axes, handles: Sequence[Artist], columns: int = 3) -> None:
    """The legend of a diagram, above it, where no line can run into it."""
    axes.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
        borderpad=0.0,
        ncols=columns,
        frameon=False,
        fontsize=_TEXT_PT,
        handlelength=1.4,
        columnspacing=1.4,
        labelcolor=_INK,
    )


def _add_legend(place: SubFigure, handles: Sequence[Artist]) -> None:
    """The legend of a part of the picture, below it, in one row or two."""
    legend = place.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles) if len(handles) <= 6 else 4,
        frameon=False,
        fontsize=_TEXT_PT,
        handlelength=1.6,
        columnspacing=1.6,
        labelcolor=_INK,
    )
    for handle in legend.legend_handles:
        if isinstance(handle, PathCollection):  # a crowd's marks are too small to tell
            handle.set_sizes(np.maximum(handle.get_sizes(), 12.0))


def _tidy(axes: Axes, x_label: str, y_label: str) -> None:
    """Quiet axes: two spines, small ticks."""
    axes.set_xlabel(x_label, size=_TEXT_PT, color=_INK)
    axes.set_ylabel(y_label, size=_TEXT_PT, color=_INK)
    axes.tick_params(labelsize=_SMALL_PT, labelcolor=_INK, color=_FAINT, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_FAINT)


def team_colours(robots: int) -> list[str]:
    """One colour each. Beyond ten they only tell neighbours apart, along a cyclic map."""
    if robots <= len(_TEAM):
        return list(_TEAM[:robots])
    golden = 0.6180339887498949  # its multiples fall evenly, and far from the one before
    around = golden * np.arange(robots) % 1.0
    # Twilight is pale at 0 and dark at 1/2; keep to its blue and its red side.
    places = np.where(around < 0.5, 0.12, 0.28) + 0.6 * around
    return [to_hex(colour) for colour in colormaps["twilight"](places)]


def _strokes(way_m: Points) -> list[Points]:
    """A way in pieces that join."""
    starts = range(0, max(1, way_m.shape[0] - 1), _STROKE_POINTS)
    return [way_m[i : i + _STROKE_POINTS + 1] for i in starts]


def _mark_size(count: int, most: float) -> float:
    """The area of a mark in square points: smaller in a crowd."""
    return max(1.0, min(most, 30_000.0 / max(1, count)))


def _thinned(count: int, most: int) -> slice:
    """Every so many of `count`, to be at most `most`."""
    return slice(None, None, max(1, -(-count // most)))
