"""A run on the map: its domain, samples, targets and ways, as its records leave them.

Positions are in the world frame, in metres.
"""

from array import array
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection, LineCollection, PathCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.patches import Rectangle

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
from kantor_protocol.base.machine import SUPERVISOR, ParticipantId, State
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.base.varint import Pairs
from kantor_protocol.scenario.faults.processes import Late
from kantor_worldsim.observers.metrics.map_tracker import MapTracker
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import metrics_of
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, Record, StepRecord

_WEIGHT = ListedColormap(colormaps["YlOrBr"](np.linspace(0.2, 0.65, 256)))
"""The weight left in a sample, from hardly any to all."""

_TIME = ListedColormap(0.5 + 0.5 * colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3])
"""When a cell was first seen: pale, since the robots' ways lie over it."""
_WALL, _UNSEEN_WALL = 0.5, 0.88
"""How much darker a known wall is than the floor of that time; the grey of an unknown one."""

_CELLS_SHOWN, _EDGES_SHOWN = 2_000, 100_000
_POINTS_SHOWN = 200_000
_STROKE_POINTS = 4_096
"""The rasterizer gives up on very long lines, so a trail is drawn in strokes."""
_GRAIN = 1.0 / 4_000
"""A trail keeps a point for each such share of the domain's diagonal: below a pixel."""

Points = npt.NDArray[np.float64]


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


class Outage(NamedTuple):
    """A time in which a process did nothing."""

    who: ParticipantId
    what: str
    """How it began: kill, pause, fill, leave."""
    from_s: float
    until_s: float | None
    """None: it did not come back."""


_ENDS = {"start", "resume", "free", "join"}


class RunHistory:
    """What the picture needs to know of a run."""

    def __init__(self, opening: Opening) -> None:
        self.scenario, self.seed, self.site = opening.scenario, opening.seed, opening.site
        self.metrics = metrics_of(self.scenario)
        self.end_ns = 0
        self.contact_s: float | None = None
        """When a robot first took in a message."""
        grain_m = _GRAIN * self._diagonal_m
        starts_m = zip(self.scenario.robot_ids, self.site.starts_m.tolist(), strict=True)
        self.trails = {name: Trail(x_m, y_m, grain_m) for name, (x_m, y_m) in starts_m}
        self.outages: list[Outage] = []
        """In order of their ends; those without an end come last."""
        self.deaths_m: list[tuple[float, float]] = []
        """Where robots were when they were killed."""
        self._away: dict[ParticipantId, tuple[str, float]] = {
            name: ("late", 0.0)
            for fault in self.scenario.faults
            if isinstance(fault, Late)
            for name in fault.who
        }
        self._units = opening.units
        self._left = np.full(self.site.samples_m.shape[0], self._units.sample, dtype=np.int64)
        self._finished_ns: dict[ParticipantId, int] = {}
        self._pairs = Pairs()
        self._pipeline = Pipeline(self.metrics)
        self._pipeline.observe(opening)

    @classmethod
    def of(cls, records: Iterable[Record]) -> "RunHistory | None":
        """Follow records to their end; None if they do not even open."""
        following = iter(records)
        opening = next(following, None)
        if not isinstance(opening, Opening):
            return None
        run = cls(opening)
        for record in following:
            run.follow(record)
        for name, (what, from_s) in run._away.items():
            run.outages.append(Outage(name, what, from_s, None))
        return run

    @property
    def _diagonal_m(self) -> float:
        """Of what the picture shows."""
        if self.site.ground is not None:
            return self.site.ground.frame.diagonal_m
        domain = self.scenario.domain
        return float(np.hypot(*np.subtract(domain.max_m, domain.min_m)))

    @property
    def finish_s(self) -> float | None:
        """When the last robot saw no weight left, or no frontier to go to, if all came to see that."""
        if len(self._finished_ns) < self.scenario.robots.count:
            return None
        return max(self._finished_ns.values()) * 1e-9

    @property
    def share_left(self) -> Points:
        """(N,) of the weight that a sample had, what is left of it in the common view."""
        return np.asarray(np.maximum(self._left, 0) / self._units.sample)

    def walked(self, points_m: Points, diffusion_m: float, purpose: Purpose) -> Points:
        """Where points of time 0 are at the end."""
        walk = RandomWalk(points_m, diffusion_m, self.scenario.period_ns, self.seed, purpose)
        walk.advance(self.end_ns)
        return walk.xy_m

    def follow(self, record: Record) -> None:
        """Take in one record after the opening."""
        self._pipeline.observe(record)
        if isinstance(record, ProcessEvent):
            self._befall(record)
        if not isinstance(record, Opening):
            self.end_ns = max(self.end_ns, record.now_ns)
        if isinstance(record, Batch):
            for step_record in record.step_records:
                self._follow_act(step_record)

    def _befall(self, incident: ProcessEvent) -> None:
        name, what, now_s = incident.who, incident.kind, incident.now_ns * 1e-9
        if what in {"kill", "pause", "fill", "leave"}:
            self._away.setdefault(name, (what, now_s))
            if what == "kill" and name in self.trails:
                self.deaths_m.append(self.trails[name].end_m)
        elif what in _ENDS and name in self._away:
            before, from_s = self._away.pop(name)
            self.outages.append(Outage(name, before, from_s, now_s))

    def _follow_act(self, step_record: StepRecord) -> None:
        outputs, verdict = step_record.outputs, step_record.verdict
        if outputs is None or verdict is None:
            return
        if self.scenario.merge == "min":
            self._lower(outputs.lowered)
        elif not {"step", "energy", "units"} & set(verdict.violations):
            self._spend(outputs.spent)
        if step_record.name == SUPERVISOR:
            return
        self.trails[step_record.name].extend(verdict.pose.x_m, verdict.pose.y_m)
        if step_record.heard and self.contact_s is None:
            self.contact_s = step_record.now_ns * 1e-9
        if outputs.state is State.FINISHED:
            self._finished_ns.setdefault(step_record.name, step_record.now_ns)

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


def draw_domain(axes: Axes, run: RunHistory) -> None:
    """The outline that random starts are drawn from."""
    low, high = run.scenario.domain.min_m, run.scenario.domain.max_m
    outline = Rectangle(low, high[0] - low[0], high[1] - low[1], fill=False, ec=FAINT, zorder=0.5)
    outline.set(linewidth=0.8, linestyle=(0, (4, 3)))
    axes.add_patch(outline)


def draw_known(axes: Axes, map_tracker: MapTracker, period_s: float) -> None:
    """The true walls as outlines; what is known by the time at which somebody first saw it."""
    frame, cells = map_tracker.frame, map_tracker.ground.cells
    step = max(1, -(-max(frame.rows, frame.columns) // _CELLS_SHOWN))
    first_tick = map_tracker.state.first_tick.reshape(cells.shape)[::step, ::step]
    free, known = cells[::step, ::step] == FREE, first_tick >= 0
    last_s = max(1, map_tracker.tick) * period_s
    paint = ScalarMappable(Normalize(0.0, last_s), _TIME)
    colours = paint.to_rgba(first_tick * period_s)[..., :3]
    colours = np.where(free[..., None], colours, _WALL * colours)
    colours = np.where(known[..., None], colours, np.where(free[..., None], 1.0, _UNSEEN_WALL))
    left, right, bottom, top = frame.extent_m
    right += (-frame.columns % step) * frame.resolution_m
    top += (-frame.rows % step) * frame.resolution_m
    axes.imshow(
        colours, origin="lower", extent=(left, right, bottom, top), interpolation="none", zorder=0.2
    )
    edges_m = _edges(map_tracker)
    if edges_m.shape[0] <= _EDGES_SHOWN:
        outlines = LineCollection(list(edges_m), colors=FAINT, linewidths=0.5, zorder=0.6)
        axes.add_collection(outlines)
    add_scale(axes, paint, "first seen at  0 s", f"{last_s:.4g} s")


def _edges(map_tracker: MapTracker) -> Points:
    """(E, 2, 2) borders between free cells and others, world frame."""
    frame = map_tracker.frame
    free = np.pad(map_tracker.ground.cells == FREE, 1)
    row, column = np.nonzero(free[1:, 1:-1] != free[:-1, 1:-1])
    level = np.stack((column, row, column + 1, row), axis=1)
    row, column = np.nonzero(free[1:-1, 1:] != free[1:-1, :-1])
    upright = np.stack((column, row, column, row + 1), axis=1)
    cells = np.concatenate((level, upright)).reshape(-1, 2, 2)
    return np.asarray(cells * frame.resolution_m + np.array(frame.origin_m))


def draw_bumps(axes: Axes, map_tracker: MapTracker) -> None:
    """Where robots ended a move at a wall."""
    if map_tracker.bumps:
        xy_m = np.array(map_tracker.bumps)
        xy_m = xy_m[thinned(xy_m.shape[0], _POINTS_SHOWN)]
        size = _mark_size(xy_m.shape[0], 30.0)
        _add_marks(axes, xy_m, s=size, c=MISSED, marker="1", lw=1.1, zorder=4.5, label="bump")


def draw_trails(axes: Axes, run: RunHistory) -> None:
    """Every robot's way, its start a cross, its end a dot."""
    few = len(run.trails) <= len(TEAM)
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
        c=INK,
        marker="x",
        lw=1.5 * edge,
        zorder=4.0,
        label="start",
    )
    _add_marks(axes, ends_m, s=size, c=colours, edgecolors=INK, lw=edge, zorder=5.0)
    axes.plot([], [], "o", ms=7.0, mfc="white", mec=INK, mew=1.0, label="end")


def draw_deaths(axes: Axes, run: RunHistory) -> None:
    """Where robots were when they were killed."""
    if run.deaths_m:
        xy_m = np.array(run.deaths_m)
        style: dict[str, Any] = {"marker": "X", "edgecolors": "white", "label": "killed"}
        size = _mark_size(xy_m.shape[0], 110.0)
        _add_marks(axes, xy_m, s=size, c=KILLED, lw=0.8, zorder=5.5, **style)


def draw_samples(axes: Axes, run: RunHistory, *, scale: bool = True) -> None:
    """Samples by the weight that is left in them. scale: tell above the map what the colours mean."""
    xy_m = run.walked(run.site.samples_m, run.scenario.samples.diffusion_m, Purpose.SAMPLE_WALK)
    thin = thinned(xy_m.shape[0], _POINTS_SHOWN)  # they lie along a curve, so this is even
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
    """What colours mean, in the map's upper right corner, outside. low, high: the words at its ends."""
    place = axes.inset_axes((0.86, 1.009, 0.14, 0.014))
    bar = axes.figure.colorbar(marks, cax=place, orientation="horizontal", ticks=[])
    bar.ax.set_xticks([])
    bar.outline.set_visible(False)
    words: dict[str, Any] = {
        "transform": place.transAxes,
        "va": "center",
        "size": TEXT_PT,
        "color": INK,
    }
    place.text(-0.04, 0.5, low, ha="right", **words)
    place.text(1.04, 0.5, high, ha="left", **words)


def draw_targets(axes: Axes, run: RunHistory) -> None:
    """Detected targets where they were found, the others where they are at the end."""
    finds = run.metrics.finds
    found_m = np.array([(x_m, y_m) for *_, x_m, y_m in finds]).reshape(-1, 2)
    ends_m = run.walked(run.site.targets_m, run.scenario.targets.diffusion_m, Purpose.TARGET_WALK)
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
    """Where the supervisor stands, if there is one."""
    placed = not run.scenario.mapping or run.scenario.supervisor.pose_m is not None
    if run.scenario.centralized and placed:
        x_m, y_m = run.scenario.supervisor_m
        axes.plot([x_m], [y_m], "*", ms=15.0, mfc="white", mec=INK, zorder=6.0, label="supervisor")


def draw_radio(axes: Axes, run: RunHistory) -> None:
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
    circles.set(facecolor="none", edgecolor=FAINT, linewidth=0.8, zorder=0.8)
    circles.set_alpha(0.8 if len(centres_m) <= len(TEAM) else 0.25)
    axes.add_collection(circles, autolim=False)  # it may be wider than the map
    axes.plot([], [], "o", ms=9.0, mfc="none", mec=FAINT, label=f"radio range {range_m:g} m")


def _add_marks(axes: Axes, xy_m: Points, *, lw: float = 0.0, **style: Any) -> PathCollection:
    return axes.scatter(xy_m[:, 0], xy_m[:, 1], linewidths=lw, **style)


def _strokes(way_m: Points) -> list[Points]:
    """A way in pieces that join."""
    starts = range(0, max(1, way_m.shape[0] - 1), _STROKE_POINTS)
    return [way_m[i : i + _STROKE_POINTS + 1] for i in starts]


def _mark_size(count: int, most: float) -> float:
    """The area of a mark in square points: smaller in a crowd."""
    return max(1.0, min(most, 30_000.0 / max(1, count)))


def thinned(count: int, most: int) -> slice:
    """Every so many of `count`, to be at most `most`."""
    return slice(None, None, max(1, -(-count // most)))
