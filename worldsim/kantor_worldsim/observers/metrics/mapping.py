"""Metrics of a mission on a map, from its records alone (Puig, Garcia, Wu, section 4).

The map is cut into 2, 4 … 64 blocks of equal size; of each only the cells that can ever be seen count,
and a block without any is left out. With w the tick at which a cell was first seen, and
w' = t + e for a cell not yet seen, e the distance in cells from its middle to the closest robot:

WTV
    Eq. 8-9: the population variance over the blocks of the mean of w or w' over a block's cells.
final WTV
    Eq. 10: the same of w alone, over what has been seen by the end.
EPV
    The population variance over the blocks of the explored share in percent.

Means over time are over the rows at multiples of `metrics.every`, 10 by default, that of tick 0 aside.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import State
from kantor_worldsim.observers.metrics.base import RunMetrics
from kantor_worldsim.observers.metrics.map_tracker import MapTracker
from kantor_worldsim.observers.metrics.result import STUCK, Bounds, ByRegions, MapResult
from kantor_worldsim.radio.channel import Walls, links
from kantor_worldsim.record.columnar import DecodedRecord
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, StepRecord

EVERY = 10
"""Periods from one row to the next."""

SHAPES = ((1, 2), (2, 2), (2, 4), (4, 4), (4, 8), (8, 8))
"""Blocks of a map: rows and columns."""
_SHOWN = 2
"""The shape in the rows: 8 blocks."""
_FINEST = 8


class MapRow(NamedTuple):
    """One row of metrics.csv."""

    tick: int
    time_s: float
    explored: float
    explored_least: float
    """The share that the least informed robot knows."""
    distance_m: float
    overlap: float
    wtv: float
    """8 blocks."""
    epv: float
    detected: int
    links: int
    deliveries: int
    drops: int


@kernel
def _count_blocks(
    counting: np.ndarray, block_rows: np.ndarray, block_columns: np.ndarray, counts: np.ndarray
) -> None:
    """Count the cells (rows, columns) that count in each of the finest blocks (64,)."""
    rows, columns = counting.shape
    for row in range(rows):
        for column in range(columns):
            counts[_FINEST * block_rows[row] + block_columns[column]] += counting[row, column]


@kernel
def _sum_blocks(
    counting: np.ndarray,
    block_rows: np.ndarray,
    block_columns: np.ndarray,
    first_tick: np.ndarray,
    robots_uv: np.ndarray,
    tick: int,
    sums: np.ndarray,
) -> None:
    """Sum up the finest blocks. counting (rows, columns): the cells that count.

    robots_uv (n, 2): in cells, column axis first. sums (3, 64): cells seen, their w, the w' of the others.
    """
    rows, columns = counting.shape
    sums[:] = 0.0
    for row in range(rows):
        for column in range(columns):
            if not counting[row, column]:
                continue
            block = _FINEST * block_rows[row] + block_columns[column]
            first = first_tick[row * columns + column]
            if first >= 0:
                sums[0, block] += 1.0
                sums[1, block] += first
                continue
            least = math.inf
            for robot in range(robots_uv.shape[0]):
                du, dv = robots_uv[robot, 0] - (column + 0.5), robots_uv[robot, 1] - (row + 0.5)
                least = min(least, du * du + dv * dv)
            sums[2, block] += tick + math.sqrt(least)


def _merged(finest: npt.NDArray[np.float64], shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """(…, 64) sums of the finest blocks as sums of fewer."""
    rows, columns = shape
    square = finest.reshape(-1, rows, _FINEST // rows, columns, _FINEST // columns)
    return np.asarray(square.sum(axis=(2, 4)).reshape(finest.shape[0], -1))


def _variance(sums: npt.NDArray[np.float64], counts: npt.NDArray[np.float64]) -> float:
    """The variance of the means of regions that have any cells."""
    there = counts > 0.0
    means = sums[there] / counts[there]
    if not means.shape[0]:
        return 0.0
    apart = (
        means - np.add.reduce(means) / means.shape[0]
    )  # as `np.var`, which takes three times as long
    return float(np.add.reduce(apart * apart) / means.shape[0])


class _Pace:
    """The progress of one robot: its goal, and since when it stands still."""

    def __init__(self, xy_m: tuple[float, float]) -> None:
        self.xy_m = xy_m
        self.moved_ns = 0
        self.goal_m: tuple[float, float] | None = None
        self.arrived = False


class MapMetrics(RunMetrics):
    """Follows the records of one run that explores a map."""

    columns = MapRow._fields
    rows: list[MapRow]

    def __init__(
        self,
        on_row: Callable[[MapRow], None] = lambda _row: None,
    ) -> None:
        """on_row: called with each row when it is complete."""
        super().__init__(on_row)
        self.map_tracker = MapTracker()
        """Follows the same records; observers after this one may read it."""
        self.shares: list[list[float]] = []
        """For each row, the share that each robot knows."""
        self.stall_ns = 0
        """The longest that a robot stood still that had not finished."""
        self.switches = 0

    def _begin(self, opening: Opening) -> None:
        self.map_tracker.open(opening)
        scenario, frame = opening.scenario, self.map_tracker.frame
        self._every = scenario.metrics.every or EVERY
        self._robots = scenario.robots.count
        self._blocks = (
            _FINEST * np.arange(frame.rows) // frame.rows,
            _FINEST * np.arange(frame.columns) // frame.columns,
        )
        """(rows,) and (columns,): the row and the column of blocks in which a cell lies."""
        self._counts = np.zeros(_FINEST**2)
        _count_blocks(self.map_tracker.observable, *self._blocks, self._counts)
        self._sums = np.zeros((3, _FINEST**2))
        self._over_time = np.zeros((2, len(SHAPES)))
        """Sums of WTV and EPV."""
        self._samples = 0
        self._now = np.zeros((2, len(SHAPES)))
        starts_m = opening.setup.starts_m.tolist()
        self._paces = {
            name: _Pace((x, y)) for name, (x, y) in zip(scenario.robot_ids, starts_m, strict=True)
        }
        self._range_m = scenario.sensor.range_m
        self._walls = Walls.of(scenario.radio, self.map_tracker.ground)
        self._resolution_m = frame.resolution_m

    def _attend(self, batch: Batch, decoded: DecodedRecord) -> None:
        # The row of a tick was made before: it has the state at the end of that tick.
        self.map_tracker.observe(decoded)
        for step_record in batch.step_records:
            pace = self._paces.get(step_record.name)
            if pace is not None:
                self._keep_pace(pace, step_record)

    def _follow_event(self, event: ProcessEvent) -> None:
        super()._follow_event(event)
        self.map_tracker.follow_event(event)

    def _keep_pace(self, pace: _Pace, step_record: StepRecord) -> None:
        """Whether a robot has changed its mind before the move, and whether it moves."""
        if step_record.outputs is None or step_record.verdict is None:
            return
        goal_m = step_record.outputs.goal
        if goal_m != pace.goal_m:
            if goal_m is not None and pace.goal_m is not None and not pace.arrived:
                self.switches += math.dist(goal_m, pace.goal_m) > self._range_m
            pace.goal_m, pace.arrived = goal_m, False
        xy_m = step_record.verdict.pose.x_m, step_record.verdict.pose.y_m
        if xy_m != pace.xy_m or step_record.outputs.state is not State.EXPLORING:
            pace.xy_m, pace.moved_ns = xy_m, step_record.now_ns
        else:
            self.stall_ns = max(self.stall_ns, step_record.now_ns - pace.moved_ns)
        if goal_m is not None and math.dist(goal_m, xy_m) <= self._resolution_m:
            pace.arrived = True

    def _row(self, *, last: bool = False) -> None:
        map_tracker = self.map_tracker
        self._measure(sample=self._tick > 0 and (not last or self._tick % self._every == 0))
        self.shares.append((map_tracker.held_cells / max(1, map_tracker.total)).tolist())
        self._add_row(
            MapRow(
                tick=self._tick,
                time_s=self._tick * self._period_ns * 1e-9,
                explored=map_tracker.seen / max(1, map_tracker.total),
                explored_least=min(self.shares[-1]),
                distance_m=math.fsum(map_tracker.ways_m),
                overlap=self._overlap,
                wtv=self._now.item(0, _SHOWN),
                epv=self._now.item(1, _SHOWN),
                detected=len(self.finds),
                links=links(self._tally.xy_m, self._scenario.radio.range_m, self._walls),
                deliveries=self.deliveries,
                drops=self.drops,
            )
        )

    @property
    def _overlap(self) -> float:
        seen = self.map_tracker.seen
        return int(self.map_tracker.own_cells.sum()) / seen - 1.0 if seen else 0.0

    def _measure(self, *, sample: bool) -> None:
        """WTV and EPV now. sample: they count in the means over time."""
        map_tracker = self.map_tracker
        origin_m = np.array(map_tracker.frame.origin_m)
        _sum_blocks(
            map_tracker.observable,
            *self._blocks,
            map_tracker.state.first_tick,
            (np.array(map_tracker.poses_m) - origin_m) / map_tracker.frame.resolution_m,
            self._tick,
            self._sums,
        )
        explored, seen_w, unseen_w = self._sums
        table = np.stack((self._counts, seen_w + unseen_w, 100.0 * explored))
        for i, shape in enumerate(SHAPES):
            cells, waits, percents = _merged(table, shape)
            self._now[:, i] = _variance(waits, cells), _variance(percents, cells)
        if sample:
            self._over_time += self._now
            self._samples += 1

    def _final_wtv(self) -> ByRegions:
        explored, seen_w, _ = self._sums
        merged = [_merged(np.stack((seen_w, explored)), shape) for shape in SHAPES]
        return ByRegions(*(_variance(waits, cells) for waits, cells in merged))

    def _snapshot_of(self) -> dict[str, Any]:
        last = self.rows[-1]
        return {"w_ub": 0.0, "mass_left": 1.0 - last.explored, "distance_m": last.distance_m}

    def _ended(self) -> str:
        """The reason on record; but robots that rest, although they could see more, are stuck."""
        reason = super()._ended()
        return STUCK if reason == "done" and self.map_tracker.unseen else reason

    def _measured(self) -> dict[str, Any]:
        map_tracker, last = self.map_tracker, self.rows[-1]
        mean = self._over_time / self._samples if self._samples else self._now
        return {
            "w_ub_start": 0.0,
            "w_ub": Bounds(0.0, None, 0.0),
            "w1_exact": None,
            "energy_total": 0,
            "mass_left": 1.0 - last.explored,
            "mass_double_counted": 0.0,
            "map": MapResult(
                explored=last.explored,
                completed_tick=map_tracker.completed_tick,
                t95_tick=map_tracker.t95_tick,
                t99_tick=map_tracker.t99_tick,
                all_t99_tick=map_tracker.all_t99_tick,
                distance_m=last.distance_m,
                longest_m=max(map_tracker.ways_m),
                overlap=last.overlap,
                bumps=len(map_tracker.bumps),
                switches=self.switches,
                stall_ticks=self.stall_ns // self._period_ns,
                log_bytes_per_robot_tick=map_tracker.log_bytes / max(1, self.steps),
                wtv_final=self._final_wtv(),
                wtv_mean=ByRegions(*mean[0].tolist()),
                epv_final=ByRegions(*self._now[1].tolist()),
                epv_mean=ByRegions(*mean[1].tolist()),
                unseen=map_tracker.unseen,
                frontiers_left=map_tracker.frontiers,
            ),
        }
