"""Metrics of a mission on a density, from its records alone (Kabir & Lee, section VI)."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from kantor_protocol.base.kernels import kernel, sum_kernel
from kantor_worldsim.observers.metrics import wasserstein_exact
from kantor_worldsim.observers.metrics.base import RunMetrics
from kantor_worldsim.observers.metrics.result import Bounds
from kantor_worldsim.observers.metrics.tally import DELIVERIES, DROPS, ENERGY, LEAST, UNITS
from kantor_worldsim.observers.metrics.wasserstein_bounds import Auction, measure
from kantor_worldsim.radio.channel import links
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import DecodedRecord
from kantor_worldsim.record.records import Batch, Opening

_PAIRS_PER_ROW = 200_000
"""Robot-sample distances that one row of metrics may cost when the period is chosen by size."""


_BLOCK = 1024
"""Samples that a row of metrics takes at a time."""


class DensityRow(NamedTuple):
    """One row of metrics.csv."""

    tick: int
    time_s: float
    energy_spent: int
    detected: int
    w_ub_paper: float
    w_ub_tight: float | None
    w_ub_instant: float
    mass_left: float
    mass_double_counted: float
    links: int
    deliveries: int
    drops: int
    w_ub_local_min: float | None
    w_ub_local_max: float | None
    w1_exact: float | None = None


@sum_kernel
def _weighed(units: np.ndarray, way_m: np.ndarray) -> float:
    total = 0.0
    for j in range(way_m.shape[0]):
        total += units[j] * way_m[j]
    return total


@kernel
def _rest(true_left: np.ndarray) -> int:
    """Units that are truly left."""
    rest = 0
    for j in range(true_left.shape[0]):
        rest += max(true_left[j], 0)
    return rest


@kernel
def _sum_common(
    xy_m: np.ndarray,
    samples_m: np.ndarray,
    common: np.ndarray,
    first: int,
    xyu: np.ndarray,
    way_m: np.ndarray,
    whole: int,
    paper: np.ndarray,
) -> None:
    """Every robot ships the same weights: add the block that begins at `first`."""
    for j in range(way_m.shape[0]):
        xyu[0, j], xyu[1, j] = samples_m[first + j, 0], samples_m[first + j, 1]
        xyu[2, j] = max(common[first + j], 0)
    for i in range(xy_m.shape[0]):
        measure(xyu[0], xyu[1], xy_m[i], way_m)
        paper[i] += _weighed(xyu[2], way_m) / whole


@kernel
def _sum_views(
    xy_m: np.ndarray,
    samples_m: np.ndarray,
    views: np.ndarray,
    first: int,
    near: np.ndarray,
    xyu: np.ndarray,
    way_m: np.ndarray,
    whole: int,
    paper: np.ndarray,
    local: np.ndarray,
) -> None:
    """Every robot ships by its own view: add the block that begins at `first`."""
    last = first + way_m.shape[0]
    for j in range(way_m.shape[0]):
        xyu[0, j], xyu[1, j] = samples_m[first + j, 0], samples_m[first + j, 1]
    for i in range(xy_m.shape[0]):
        measure(xyu[0], xyu[1], xy_m[i], way_m)
        own = _weighed(views[i, first:last], way_m) / whole
        paper[i] += own
        for k in range(xy_m.shape[0]):
            if k == i:
                local[k] += own
            elif near[i, k]:
                local[k] += _weighed(views[k, first:last], way_m) / whole


@kernel
def _sum_up(
    shipped_by: np.ndarray,
    xy_m: np.ndarray,
    views: np.ndarray,
    least: np.ndarray,
    true_left: np.ndarray,
    samples_m: np.ndarray,
    whole: int,
    range_m: float,
    centralized: bool,
    ledger: bool,
    near: np.ndarray,
    xyu: np.ndarray,
    way_m: np.ndarray,
    paper: np.ndarray,
    local: np.ndarray,
) -> None:
    """The pending terms, mass times the distance to a robot, over all samples.

    For each robot in paper: by the common weights or its own view; in local: eq. 12, what the robots in
    its range have shipped and their terms by its own view. near: (m, m) room for the robots in range of each.
    xyu (3, B), way_m (B,): room for one block of samples, which stays in the cache while all robots and
    views meet in it.
    """
    robots = xy_m.shape[0]
    paper[:] = 0.0
    local[:] = 0.0
    for k in range(robots):
        for i in range(robots):
            apart_m = math.hypot(xy_m[i, 0] - xy_m[k, 0], xy_m[i, 1] - xy_m[k, 1])
            near[i, k] = i == k or apart_m <= range_m
            if near[i, k]:
                local[k] += shipped_by[i]
    first = 0
    while first < samples_m.shape[0]:
        way = way_m[: min(way_m.shape[0], samples_m.shape[0] - first)]
        if centralized:
            common = true_left if ledger else least
            _sum_common(xy_m, samples_m, common, first, xyu, way, whole, paper)
        else:
            _sum_views(xy_m, samples_m, views, first, near, xyu, way, whole, paper, local)
        first += way.shape[0]


class DensityMetrics(RunMetrics):
    """Follows the records of one run that explores a density."""

    columns = DensityRow._fields
    rows: list[DensityRow]

    def __init__(
        self,
        exact_every: int | None = None,
        on_row: Callable[[DensityRow], None] = lambda _row: None,
    ) -> None:
        """exact_every: periods from one exact distance to the next; 0: at the end only; None: never.

        on_row: called with each row when it is complete.
        """
        super().__init__(on_row)
        self._exact_every = exact_every

    def _begin(self, opening: Opening) -> None:
        scenario = opening.scenario
        robots, samples = scenario.robots.count, self._walk.xy_m.shape[0]
        self._terms = np.zeros((2, robots))
        self._to_sum_up = (
            *self._tally[3:],
            self._walk.xy_m,
            self._units.whole,
            scenario.radio.range_m,
            scenario.centralized,
            scenario.merge == "ledger",
            np.zeros((robots, robots), dtype=np.bool_),
            np.zeros((3, _BLOCK)),
            np.zeros(_BLOCK),
            *self._terms,
        )
        size = samples * robots // _PAIRS_PER_ROW
        self._every = scenario.metrics.every or max(1, size)
        self._auction = Auction(robots, samples, self._every)
        self._points: list[tuple[float, float, int]] = []

    def _attend(self, _batch: Batch, decoded: DecodedRecord) -> None:
        if self._exact_every is not None:
            self._note_points(of.ColumnarBatch(*decoded.columns))

    def _note_points(self, columns: of.ColumnarBatch) -> None:
        """Where a point was shipped, and how many units."""
        for row in range(columns.sizes[of.STEP_RECORDS]):
            step_record = columns.step_records[row]
            if (
                step_record[of.PLACE] >= 0
                and step_record[of.SPENT_COUNT] > 0
                and not step_record[of.UNSHIPPED]
            ):
                shipped = columns.pairs[
                    step_record[of.SPENT] : step_record[of.SPENT] + step_record[of.SPENT_COUNT]
                ]
                x, y = columns.poses_m[row, :2].tolist()
                self._points.append((x, y, int(shipped[:, of.UNITS].sum())))

    def _row(self, *, last: bool = False) -> None:
        tally, scenario, whole = self._tally, self._scenario, self._units.whole
        counts = tally.counts.tolist()
        true_rest = _rest(tally.true_left)
        # The common view: the minimum of all views, or with a ledger the truth.
        left = true_rest if scenario.merge == "ledger" else counts[LEAST]
        shipped, shipped_now = tally.shipped.tolist()
        tight = None
        if scenario.samples.diffusion_m == 0.0 and true_rest == whole - counts[UNITS]:
            rest = self._auction.cost(self._walk.xy_m, tally.xy_m, tally.true_left)
            tight = shipped + rest / whole
        local: list[float] = []
        if tight is not None and scenario.centralized and scenario.merge == "ledger":
            pending = sum((self._auction.ways / whole).tolist())  # one pass for both
        else:
            _sum_up(*self._to_sum_up)
            pending = sum(self._terms[0].tolist())
            local = [] if scenario.centralized else self._terms[1].tolist()
        self._add_row(
            DensityRow(
                tick=self._tick,
                time_s=self._tick * self._period_ns * 1e-9,
                energy_spent=counts[ENERGY],
                detected=len(self.finds),
                w_ub_paper=shipped + pending,
                w_ub_tight=tight,
                w_ub_instant=shipped_now + pending,
                mass_left=left / whole,
                mass_double_counted=(counts[UNITS] - (whole - left)) / whole,
                links=links(tally.xy_m, scenario.radio.range_m),
                deliveries=counts[DELIVERIES],
                drops=counts[DROPS],
                w_ub_local_min=min(local, default=None),
                w_ub_local_max=max(local, default=None),
                w1_exact=self._exact() if self._exact_due(last=last) else None,
            )
        )

    def _exact_due(self, *, last: bool) -> bool:
        if self._exact_every is None:
            return False
        return last or (self._exact_every > 0 and self._tick % self._exact_every == 0)

    def _exact(self) -> float:
        """W_1 between the samples and the robots' ensemble; see the module."""
        robots_m, samples_m = self._tally.xy_m, self._walk.xy_m
        robots = robots_m.shape[0]
        shipped = np.array(self._points, dtype=np.float64).reshape(-1, 3)
        left = float(np.maximum(self._tally.true_left, 0).sum())
        return wasserstein_exact.w1(
            np.concatenate((shipped[:, :2], robots_m)),
            np.concatenate((shipped[:, 2], np.full(robots, left / robots))),
            samples_m,
            np.ones(samples_m.shape[0]),
        )

    def _snapshot_of(self) -> dict[str, Any]:
        return {"w_ub": self.rows[-1].w_ub_paper, "mass_left": self.rows[-1].mass_left}

    def _measured(self) -> dict[str, Any]:
        last, scenario = self.rows[-1], self._scenario
        return {
            "w_ub_start": self.rows[0].w_ub_paper,
            "w_ub": Bounds(last.w_ub_paper, last.w_ub_tight, last.w_ub_instant),
            "w1_exact": last.w1_exact,
            "energy_total": scenario.steps_per_robot * scenario.robots.count,
            "mass_left": last.mass_left,
            "mass_double_counted": last.mass_double_counted,
        }
