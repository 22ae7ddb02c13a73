"""Metrics of a mission on a density, from its records alone (Kabir & Lee, section VI)."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel, sum_kernel
from kantor_worldsim.observers.metrics import wasserstein_exact
from kantor_worldsim.observers.metrics.base import RunMetrics
from kantor_worldsim.observers.metrics.result import Bounds
from kantor_worldsim.observers.metrics.tally import (
    DELIVERIES,
    DROPS,
    ENERGY,
    LEAST,
    UNITS,
    RunTally,
)
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


class Near(NamedTuple):
    """The other robots in range of each."""

    first: npt.NDArray[np.int64]
    """(m + 1,): where those of a robot begin; the last is their number."""
    robots: npt.NDArray[np.int64]
    """(rows,), in rising order for each."""


@kernel
def _find_near(xy_m: np.ndarray, range_m: float, first: np.ndarray, near: np.ndarray) -> int:
    """Fill the arrays of a Near; the number of rows, of which those beyond the room are only counted."""
    count = 0
    for i in range(xy_m.shape[0]):
        first[i] = count
        for k in range(xy_m.shape[0]):
            dx_m, dy_m = xy_m[i, 0] - xy_m[k, 0], xy_m[i, 1] - xy_m[k, 1]
            beyond = abs(dx_m) > range_m or abs(dy_m) > range_m  # most are, and need no root
            if k != i and not beyond and math.hypot(dx_m, dy_m) <= range_m:
                if count < near.shape[0]:
                    near[count] = k
                count += 1
    first[xy_m.shape[0]] = count
    return count


class _Room(NamedTuple):
    """Room for one block of B samples, which stays in the cache while all robots and views meet in it."""

    xyu: npt.NDArray[np.float64]
    """(3, B)"""
    way_m: npt.NDArray[np.float64]
    """(B,)"""


@kernel
def _sum_common(
    xy_m: np.ndarray, samples_m: np.ndarray, common: np.ndarray, first: int, room: _Room,
    whole: int, paper: np.ndarray,
) -> None:  # fmt: skip
    """Every robot ships the same weights: add the block that begins at `first`."""
    xyu, way_m = room
    for j in range(way_m.shape[0]):
        xyu[0, j], xyu[1, j] = samples_m[first + j, 0], samples_m[first + j, 1]
        xyu[2, j] = max(common[first + j], 0)
    for i in range(xy_m.shape[0]):
        measure(xyu[0], xyu[1], xy_m[i], way_m)
        paper[i] += _weighed(xyu[2], way_m) / whole


@kernel
def _sum_views(
    tally: RunTally, samples_m: np.ndarray, first: int, near: Near, room: _Room, whole: int,
    terms: np.ndarray,
) -> None:  # fmt: skip
    """Every robot ships by its own view: add the block that begins at `first`."""
    xyu, way_m, views = room.xyu, room.way_m, tally.views
    last = first + way_m.shape[0]
    for j in range(way_m.shape[0]):
        xyu[0, j], xyu[1, j] = samples_m[first + j, 0], samples_m[first + j, 1]
    for i in range(tally.xy_m.shape[0]):
        measure(xyu[0], xyu[1], tally.xy_m[i], way_m)
        own = _weighed(views[i, first:last], way_m) / whole
        terms[0, i] += own
        terms[1, i] += own
        for at in range(near.first[i], near.first[i + 1]):
            k = near.robots[at]
            terms[1, k] += _weighed(views[k, first:last], way_m) / whole


@kernel
def _sum_up(
    so_far: tuple[Any, ...],
    samples_m: np.ndarray,
    centralized: bool,
    ledger: bool,
    whole: int,
    around: tuple[Any, ...],
    block: tuple[Any, ...],
    terms: np.ndarray,
) -> None:
    """The pending terms, mass times the distance to a robot, over all samples.

    For each robot in terms[0]: by the common weights or its own view; in terms[1]: eq. 12, what the robots in
    its range have shipped and their terms by its own view. so_far, around, block: the fields of a RunTally, a Near
    and a _Room.
    """
    tally, near, room = RunTally(*so_far), Near(*around), _Room(*block)
    terms[:] = 0.0
    for k in range(0 if centralized else tally.xy_m.shape[0]):
        own = False
        for at in range(near.first[k], near.first[k + 1]):
            if not own and near.robots[at] > k:
                terms[1, k] += tally.shipped_by[k]
                own = True
            terms[1, k] += tally.shipped_by[near.robots[at]]
        if not own:
            terms[1, k] += tally.shipped_by[k]
    first = 0
    while first < samples_m.shape[0]:
        size = min(room.way_m.shape[0], samples_m.shape[0] - first)
        part = _Room(room.xyu, room.way_m[:size])
        if centralized:
            common = tally.true_left if ledger else tally.least
            _sum_common(tally.xy_m, samples_m, common, first, part, whole, terms[0])
        else:
            _sum_views(tally, samples_m, first, near, part, whole, terms)
        first += size


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
        self._near = Near(np.zeros(robots + 1, dtype=np.int64), np.zeros(robots, dtype=np.int64))
        self._room = tuple(_Room(np.zeros((3, _BLOCK)), np.zeros(_BLOCK)))
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
            place, count = int(step_record["place"]), int(step_record["spent_count"])
            if place >= 0 and count > 0 and not step_record["unshipped"]:
                first = int(step_record["spent"])
                shipped = columns.pairs[first : first + count]
                x, y = columns.poses_m[row, :2].tolist()
                self._points.append((x, y, int(shipped["units"].sum())))

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
            self._sum_up()
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

    def _sum_up(self) -> None:
        scenario = self._scenario
        if not scenario.centralized:
            self._find_near()
        _sum_up(
            self._fields,
            self._walk.xy_m,
            scenario.centralized,
            scenario.merge == "ledger",
            self._units.whole,
            tuple(self._near),
            self._room,
            self._terms,
        )

    def _find_near(self) -> None:
        xy_m, range_m = self._tally.xy_m, self._scenario.radio.range_m
        rows = _find_near(xy_m, range_m, *self._near)
        if rows > self._near.robots.shape[0]:
            self._near = self._near._replace(robots=np.zeros(2 * rows, dtype=np.int64))
            _find_near(xy_m, range_m, *self._near)

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
