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
    return "  ·  ".join(parts)


def _outcome(run: _Run) -> str:
    result = run.metrics.result(
        exchange="", digest="", wall_s=0.0, record="whole", complaints=()
    )
    parts = []
    if result.detection_rate is not None:
        parts.append(
            f"{result.detected:,} of {result.targets:,} targets detected "
            f"({result.detection_rate:.1%})"
        )
    if result.finished_tick is not None:
        parts.append(f"finished at step {result.finished_tick:,}")
    else:
        parts.append(f"not finished at tick {result.ticks:,} ({_reason(run, result.ended)})")
    parts.append(f"$W_{{UB}}$ = {result.w_ub.paper:.4g}")
    return "  ·  ".join(parts)


def _reason(run: _Run, ended: str) -> str:
    """Why a run ended that did not finish."""
    words = {"done": "energy spent", "limit": "time limit", "cut": "record cut"}
    return words.get(ended, ended)
