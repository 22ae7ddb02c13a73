"""report.png: one picture of a run, drawn from its records and nothing else.

Left the map as the run left it, right how it got there. Positions are in the world frame, in
metres; times are simulated seconds.
"""

from array import array
from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import ListedColormap, Normalize, to_hex
from matplotlib.figure import Figure, SubFigure
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

_INK, _FAINT, _GONE = "#222222", "#8a8a8a", "#dcdcdc"
_FOUND, _MISSED = "#00875a", "#111111"
_BOUND, _TIGHT, _INSTANT = _INK, "#3f90da", "#e76300"
_TEXT_PT, _SMALL_PT, _TITLE_PT = 9.5, 8.5, 13.0

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
_LEFT = ListedColormap(matplotlib.colormaps["YlOrBr"](np.linspace(0.25, 0.85, 256)))
"""Weight left, from hardly any to all."""

_GAP = "  ·  "
_ENDED = {"done": "energy spent", "limit": "time limit", "cut": "record cut"}
"""Why a run ended that did not finish."""

_POINTS_SHOWN = 200_000
_ROWS_SHOWN = 4_000
_STROKE_POINTS = 4_096
"""Agg gives up on very long lines, so a trail is drawn in strokes."""
_GRAIN = 1.0 / 4_000
"""A trail keeps a point for each such share of the domain's diagonal: below a pixel."""

Points = npt.NDArray[np.float64]


def draw(records: Iterable[Record], path: Path) -> None:
    """Write the picture of a run as PNG, 14 x 8 inches at 110 dpi.

    The records may stop anywhere after the opening. Raises ValueError without an opening.
    """
    run = _Run.of(records)
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained", facecolor="white")
    title, body = figure.subfigures(2, 1, height_ratios=(0.09, 0.91))
    left, right = body.subfigures(1, 2, width_ratios=(1.6, 1.0))
    _write_title(title, run)
    _draw_map(left, run)
    _draw_curves(right, run)
    figure.savefig(path, format="png", dpi=DPI)


class _Trail:
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


class _Run:
    """What the picture needs to know of a run."""

    def __init__(self, opening: Opening) -> None:
        self.scenario, self.seed, self.site = opening.scenario, opening.seed, opening.site
        self.metrics = Metrics()
        self.end_ns = 0
        self.contact_s: float | None = None
        """When a robot first took in a message."""
        domain = self.scenario.domain
        grain_m = _GRAIN * float(np.hypot(*np.subtract(domain.max_m, domain.min_m)))
        self.trails = {
            name: _Trail(x, y, grain_m)
            for name, (x, y) in zip(
                self.scenario.robot_ids, self.site.starts_m.tolist(), strict=True
            )
        }
        self._units = opening.units
        self._left = np.full(self.site.samples_m.shape[0], self._units.sample, dtype=np.int64)
        self._finished_ns: dict[ParticipantId, int] = {}
        self._pairs = Pairs()
        self.metrics.take(opening)

    @classmethod
    def of(cls, records: Iterable[Record]) -> "_Run":
        """Follow records to their end."""
        following = iter(records)
        opening = next(following, None)
        if not isinstance(opening, Opening):
            raise ValueError("a record without an opening: there is nothing to draw")
        run = cls(opening)
        for record in following:
            run._follow(record)
        return run

    @property
    def rows(self) -> list[Row]:
        """The measurements; at least the one of time 0."""
        return self.metrics.rows

    @property
    def end_s(self) -> float:
        """Where the time axis ends, after 0."""
        return max(self.end_ns, self.scenario.period_ns) * 1e-9

    @property
    def finish_s(self) -> float | None:
        """When the last robot saw no weight left, if all came to see that."""
        if len(self._finished_ns) < self.scenario.robots.count:
            return None
        return max(self._finished_ns.values()) * 1e-9

    @property
    def share_left(self) -> Points:
        """(N,) of the weight that a sample had, what the common view says is left of it."""
        return np.maximum(self._left, 0) / self._units.sample

    def walked(self, points_m: Points, diffusion_m: float, purpose: Purpose) -> Points:
        """Where points of time 0 are at the end."""
        walk = Walk(points_m, diffusion_m, self.scenario.period_ns, self.seed, purpose)
        walk.advance(self.end_ns)
        return walk.xy_m

    def _follow(self, record: Record) -> None:
        self.metrics.take(record)
        if isinstance(record, Batch):
            self.end_ns = max(self.end_ns, record.now_ns)
            for act in record.acts:
                self._follow_act(act)
        elif isinstance(record, Ending):
            self.end_ns = max(self.end_ns, record.now_ns)

    def _follow_act(self, act: Act) -> None:
        if act.outputs is None or act.ruling is None:
            return
        self._follow_weights(act)
        if act.name == SUPERVISOR:
            return
        self.trails[act.name].extend(act.ruling.pose.x_m, act.ruling.pose.y_m)
        if act.heard and self.contact_s is None:
            self.contact_s = act.now_ns * 1e-9
        if act.outputs.state is State.FINISHED:
            self._finished_ns.setdefault(act.name, act.now_ns)

    def _follow_weights(self, act: Act) -> None:
        """The common view: with a ledger the true remainder, else the least that anybody published."""
        assert act.outputs is not None and act.ruling is not None
        ledger = self.scenario.merge == "ledger"
        if ledger and {"step", "energy", "units"} & set(act.ruling.violations):
            return
        packed = act.outputs.spent if ledger else act.outputs.lowered
        pairs = self._pairs.decode(packed, self._left.shape[0])
        if pairs is None:
            return
        if ledger:
            np.subtract.at(self._left, *pairs)
        else:
            np.minimum.at(self._left, *pairs)


def _write_title(place: SubFigure, run: _Run) -> None:
    """What was run, and what came of it, whatever exchange ran it."""
    place.text(0.012, 0.62, _what(run), size=_TITLE_PT, weight="bold", color=_INK, va="center")
    place.text(0.012, 0.14, _outcome(run), size=_TITLE_PT - 2.0, color=_INK, va="center")


def _what(run: _Run) -> str:
    scenario, robots = run.scenario, run.scenario.robots.count
    parts = (
        scenario.name,
        f"seed {run.seed}",
        "1 robot" if robots == 1 else f"{robots} robots",
        scenario.coordination,
        f"{scenario.merge} merge {'with' if scenario.claims else 'without'} claims",
        f"{scenario.planner.name} planner",
    )
    return _GAP.join(parts)


def _outcome(run: _Run) -> str:
    result = run.metrics.result(exchange="", digest="", wall_s=0.0, record="", complaints=())
    parts = []
    if result.detection_rate is not None:
        parts.append(
            f"{result.detected:,} of {result.targets:,} targets detected "
            f"({result.detection_rate:.1%})"
        )
    if result.finished_tick is not None:
        parts.append(f"finished at tick {result.finished_tick:,}")
    else:
        parts.append(f"{_ENDED.get(result.ended, result.ended)} at tick {result.ticks:,}")
    parts.append(f"mass left {result.mass_left:.1%}")
    parts.append(f"$W_{{UB}}$ {result.w_ub.paper:.4g}")
    return _GAP.join(parts)


def _draw_map(place: SubFigure, run: _Run) -> None:
    """The map as the run left it. Every mark names itself for the legend."""
    axes = place.subplots()
    _draw_domain(axes, run)
    _draw_radio(axes, run)
    _draw_samples(axes, run)
    _draw_trails(axes, run)
    _draw_targets(axes, run)
    if run.scenario.centralized:
        _mark(axes, np.array([run.scenario.supervisor_m]), "supervisor", "*", 190.0, "white")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.02)
    axes.ticklabel_format(useOffset=False, style="plain")
    _tidy(axes, "x, m", "y, m")
    handles, _ = axes.get_legend_handles_labels()
    _legend(place, handles, "outside lower center", columns=7)


def _draw_domain(axes: Axes, run: _Run) -> None:
    low, high = run.scenario.domain.min_m, run.scenario.domain.max_m
    width_m, height_m = high[0] - low[0], high[1] - low[1]
    dashes = {"edgecolor": _FAINT, "linewidth": 0.8, "linestyle": (0, (4, 3))}
    axes.add_patch(Rectangle(low, width_m, height_m, fill=False, zorder=0.5, **dashes))


def _draw_radio(axes: Axes, run: _Run) -> None:
    """How far those who send are heard: the supervisor, or each robot from its end pose."""
    scenario = run.scenario
    centres_m = [trail.end_m for trail in run.trails.values()]
    range_m = scenario.radio.range_m
    if scenario.centralized:
        centres_m, range_m = [scenario.supervisor_m], scenario.supervisor.range_m
    elif len(centres_m) == 1:
        return
    if not 0.0 < range_m < np.inf:
        return
    line = {"linewidth": 0.8, "alpha": 0.7 if len(centres_m) <= len(_TEAM) else 0.3}
    circles = EllipseCollection(
        [2.0 * range_m],
        [2.0 * range_m],
        [0.0],
        units="xy",
        offsets=centres_m,
        offset_transform=axes.transData,
        facecolors="none",
        edgecolors=_FAINT,
        zorder=0.8,
        **line,
    )
    axes.add_collection(circles, autolim=False)  # it may be wider than the map
    label = f"radio range {range_m:g} m"
    axes.plot([], [], "o", ms=9.0, mfc="none", mec=_FAINT, mew=0.8, label=label)


def _draw_samples(axes: Axes, run: _Run) -> None:
    """Samples by the weight that is left."""
    xy_m = run.walked(run.site.samples_m, run.scenario.samples.diffusion_m, Purpose.SAMPLE_WALK)
    thin = _thinned(xy_m.shape[0], _POINTS_SHOWN)  # sorted along a curve, so this thins evenly
    xy_m, share = xy_m[thin], run.share_left[thin]
    size = float(np.clip(30_000.0 / xy_m.shape[0], 1.0, 16.0))
    empty = share <= 0.0
    if empty.any():
        axes.scatter(*xy_m[empty].T, s=size, c=_EMPTY, lw=0.0, zorder=1.0, label="sample used up")
    if not empty.all():
        scale = {"cmap": _WEIGHT, "norm": Normalize(0.0, 1.0)}
        marks = axes.scatter(*xy_m[~empty].T, s=size, c=share[~empty], lw=0.0, zorder=1.5, **scale)
        _draw_scale(axes, marks)


def _draw_scale(axes: Axes, marks: PathCollection) -> None:
    figure = axes.figure
    bar = figure.colorbar(marks, ax=axes, shrink=0.4, aspect=30.0, pad=0.015)
    bar.set_ticks([0.0, 0.5, 1.0], labels=["0 %", "50 %", "100 %"])
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=_SMALL_PT, labelcolor=_INK, color=_FAINT)
    bar.ax.set_ylabel("weight left in a sample", size=_TEXT_PT, color=_INK)


def _draw_trails(axes: Axes, run: _Run) -> None:
    """Every robot's way, its start a cross, its end a dot."""
    robots = len(run.trails)
    few = robots <= len(_TEAM)
    colours = _team_colours(robots)
    for (name, trail), colour in zip(run.trails.items(), colours, strict=True):
        axes.add_collection(
            LineCollection(
                _strokes(trail.xy_m),
                colors=colour,
                linewidths=0.9 if few else 0.4,
                alpha=0.8 if few else 0.6,
                label=name if few else None,
                zorder=2.0,
            )
        )
    size = 60.0 if few else 18.0
    starts_m = run.site.starts_m
    ends_m = np.array([trail.end_m for trail in run.trails.values()])
    axes.scatter(*starts_m.T, s=size, c=_INK, marker="x", lw=size / 40.0, zorder=4.0, label="start")
    axes.scatter(*ends_m.T, s=size, c=colours, ec=_INK, lw=0.8, zorder=5.0)
    axes.plot([], [], "o", ms=7.0, mfc="white", mec=_INK, mew=0.8, label="end")


def _draw_targets(axes: Axes, run: _Run) -> None:
    """Detected targets where they were found, the others where they are now."""
    finds = run.metrics.finds
    found_m = np.array([(x, y) for *_, x, y in finds]).reshape(-1, 2)
    site, diffusion_m = run.site, run.scenario.targets.diffusion_m
    missed_m = np.delete(
        run.walked(site.targets_m, diffusion_m, Purpose.TARGET_WALK),
        [target for _, _, target, _, _ in finds],
        axis=0,
    )
    _mark(axes, found_m, "detected", "+", 24.0, _FOUND)
    _mark(axes, missed_m, "not detected", ".", 20.0, _MISSED)


def _draw_curves(place: SubFigure, run: _Run) -> None:
    """What the run measured, over simulated time."""
    axes = place.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.2, 1.0))
    rows = run.rows[_thinned(len(run.rows) - 1, _ROWS_SHOWN)] + run.rows[-1:]
    _draw_bounds(axes[0], run, rows)
    _draw_progress(axes[1], run, rows)
    _draw_mass(axes[2], run, rows)
    for each in axes:
        each.set_xlim(0.0, run.end_s)
    _draw_moments(place, axes, run)
    place.align_ylabels(list(axes))
