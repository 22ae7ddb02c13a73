"""What a mapping run is measured by: WTV and EPV against their definitions, counts by hand."""

import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.base.grid import Frame
from kantor_protocol.base.machine import Observation, Outputs, Pose, State
from kantor_worldsim.observers.checkers.checker import Checker
from kantor_worldsim.observers.metrics.density import DensityMetrics
from kantor_worldsim.observers.metrics.mapping import SHAPES, MapMetrics, MapRow
from kantor_worldsim.observers.metrics.result import MapResult, Result
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import Recording, metrics_of
from kantor_worldsim.radio.channel import DROPPED
from kantor_worldsim.record.records import Batch, Ending, Opening, Record, StepRecord, opening_of
from kantor_worldsim.world.world import StepVerdict
from support.missions import ROOMS, explored, on_map, setup_of
from support.strategies import mission

PERIOD_NS = 100_000_000
Records = Sequence[Record]


def measured(records: Records) -> MapMetrics:
    metrics = MapMetrics()
    pipeline = Pipeline(metrics)
    for record in records:
        pipeline.observe(record)
    return metrics


def result_of(metrics: MapMetrics) -> Result:
    return metrics.result(exchange="-", digest="-", wall_s=0.0, record="whole", complaints=())


def map_of(metrics: MapMetrics) -> MapResult:
    found = result_of(metrics).map
    assert found is not None
    return found


# WTV and EPV, literally.


def blocks(frame: Frame, shape: tuple[int, int]) -> list[npt.NDArray[np.intp]]:
    """The cells of each block of the map."""
    row, column = np.divmod(np.arange(frame.cells), frame.columns)
    block = (row * shape[0] // frame.rows) * shape[1] + column * shape[1] // frame.columns
    return [np.flatnonzero(block == i) for i in range(shape[0] * shape[1])]


def literal(
    first: npt.NDArray[np.int32],
    counts: npt.NDArray[np.bool_],
    poses_m: Sequence[tuple[float, float]],
    tick: int,
    shape: tuple[int, int],
) -> tuple[float, float]:
    """WTV and EPV of a moment (eq. 8, 9). first: (cells,) stamps, later ones not yet made."""
    frame = ROOMS.frame
    waits, percents = [], []
    for block in blocks(frame, shape):
        cells = [cell for cell in block.tolist() if counts[cell]]
        if not cells:
            continue
        w = []
        for cell in cells:
            x_m, y_m = frame.centre_of(cell)
            away = min(math.hypot(x_m - x, y_m - y) for x, y in poses_m) / frame.resolution_m
            w.append(float(first[cell]) if 0 <= first[cell] <= tick else tick + away)
        waits.append(np.mean(w))
        known = [0 <= first[cell] <= tick for cell in cells]
        percents.append(100.0 * np.mean(known))
    return float(np.var(waits)), float(np.var(percents))


def literal_final(
    first: npt.NDArray[np.int32], counts: npt.NDArray[np.bool_], shape: tuple[int, int]
) -> float:
    """Eq. 10."""
    seen = [
        [first[cell] for cell in block if counts[cell] and first[cell] >= 0]
        for block in blocks(ROOMS.frame, shape)
    ]
    return float(np.var([np.mean(w) for w in seen if w]))


def poses_by_tick(records: Records) -> list[list[tuple[float, float]]]:
    """Where the robots are at the end of each tick, from 0 on."""
    poses = {"r1": (1.5, 1.5), "r2": (9.5, 1.5)}
    by_tick = [list(poses.values())]
    for record in records:
        if isinstance(record, Batch):
            for step_record in record.step_records:
                if step_record.name in poses and step_record.verdict is not None:
                    poses[step_record.name] = (
                        step_record.verdict.pose.x_m,
                        step_record.verdict.pose.y_m,
                    )
            tick = record.now_ns // PERIOD_NS
            by_tick[tick:] = [list(poses.values())]
    return by_tick


@pytest.mark.parametrize("every", [1, 10])
def test_variances_are_their_definitions(every: int) -> None:
    """WTV and EPV of every row and over time, for every number of regions."""
    records = explored(f"metrics.every={every}")
    metrics, poses = measured(records), poses_by_tick(records)
    first = metrics.map_tracker.state.first_tick
    counts = metrics.map_tracker.observable.ravel()
    means = map_of(metrics)

    for i, shape in enumerate(SHAPES):
        found = {
            row.tick: literal(first, counts, poses[row.tick], row.tick, shape)
            for row in metrics.rows
        }
        if shape == (2, 4):
            assert [(row.wtv, row.epv) for row in metrics.rows] == [
                pytest.approx(found[row.tick]) for row in metrics.rows
            ]
        over_time = [value for tick, value in found.items() if tick and tick % every == 0]
        wtv, epv = np.mean(over_time, axis=0)
        name = f"r{2 ** (i + 1)}"
        assert getattr(means.wtv_mean, name) == pytest.approx(wtv)
        assert getattr(means.epv_mean, name) == pytest.approx(epv)
        assert getattr(means.wtv_final, name) == pytest.approx(literal_final(first, counts, shape))
        assert getattr(means.epv_final, name) == pytest.approx(found[metrics.rows[-1].tick][1])


def test_final_variance_is_of_true_stamps_alone() -> None:
    """A mission that was cut: what was never seen does not count, nor a region of nothing else."""
    records = [*explored()[:6], Ending(5 * PERIOD_NS, "interrupted")]
    metrics = measured(records)
    first, counts = metrics.map_tracker.state.first_tick, metrics.map_tracker.observable.ravel()

    assert 0.0 < metrics.rows[-1].explored < 1.0
    for i, shape in enumerate(SHAPES):
        found = getattr(map_of(metrics).wtv_final, f"r{2 ** (i + 1)}")
        assert found == pytest.approx(literal_final(first, counts, shape))
    assert map_of(metrics).completed_tick is None
    assert map_of(metrics).t99_tick is None


def test_short_mission_has_means_of_its_end() -> None:
    """Over before the first row that would count."""
    metrics = measured([*explored()[:4], Ending(3 * PERIOD_NS, "interrupted")])

    assert map_of(metrics).wtv_mean.r8 == metrics.rows[-1].wtv


# Rows and counts.


def test_row_every_ten_ticks_tells_how_its_tick_ended() -> None:
    """Tick 0, every tenth, and the end; what is seen later is not in it."""
    records = explored()
    metrics, end = measured(records), records[-1].now_ns // PERIOD_NS
    first, counts = metrics.map_tracker.state.first_tick, metrics.map_tracker.observable.ravel()

    assert [row.tick for row in metrics.rows] == [*range(0, end, 10), end]
    for row in metrics.rows:
        seen = ((first >= 0) & (first <= row.tick) & counts).sum()
        assert row.explored == seen / metrics.map_tracker.total
        assert row.explored_least <= row.explored
        assert row.time_s == pytest.approx(0.1 * row.tick)
    assert metrics.rows[0].explored == 0.0
    assert metrics.rows[-1].explored == 1.0


def test_generic_counts_are_those_of_the_record() -> None:
    """Deliveries, drops, bytes, contact and the end, whatever is explored."""
    records = explored("radio.drop=0.3")
    batches = [record for record in records if isinstance(record, Batch)]
    decisions = [decision for batch in batches for decision in batch.decisions]
    step_records = [step_record for batch in batches for step_record in batch.step_records]
    bodies = [
        len(e.body)
        for step_record in step_records
        if step_record.outputs
        for e in step_record.outputs.outbox
    ]
    result = result_of(measured(records))

    assert result.drops == sum(decision.due_ns == DROPPED for decision in decisions) > 0
    assert result.deliveries == len(decisions) - result.drops
    assert result.bytes_per_robot_tick.total == pytest.approx(sum(bodies) / len(step_records))
    assert result.bytes_per_robot_tick.weights == 0.0
    assert result.first_contact_tick == next(
        step_record.outputs.step for step_record in step_records if step_record.heard
    )
    assert result.out_of_range_refused == sum(batch.out_of_range for batch in batches)
    assert (result.ended, result.ticks) == ("done", batches[-1].now_ns // PERIOD_NS)
    assert result.finished_tick == max(
        next(
            step_record.outputs.step
            for step_record in step_records
            if step_record.name == name and step_record.outputs.state is State.FINISHED
        )
        for name in ("r1", "r2")
    )
    assert (result.energy_spent, result.energy_total, result.w_ub.paper) == (0, 0, 0.0)
    assert result.mass_left == 0.0


def test_own_bytes_of_maps_are_counted() -> None:
    """What robots send of logs, without the rest of a message and without the supervisor's."""
    from kantor_protocol.wire.messages import decode_gossip

    records = explored("coordination=centralized")
    step_records = [
        step_record
        for batch in records
        if isinstance(batch, Batch)
        for step_record in batch.step_records
        if step_record.name != "supervisor"
    ]
    sent = [
        len(decode_gossip(e.body).logs)
        for step_record in step_records
        if step_record.outputs
        for e in step_record.outputs.outbox
    ]
    found = map_of(measured(records)).log_bytes_per_robot_tick

    assert found == pytest.approx(sum(sent) / len(step_records))


def test_overlap_is_what_was_seen_twice() -> None:
    """The sum of the cells that each robot saw itself over the cells that any saw; a robot alone has none."""
    metrics = measured(explored("radio.range_m=0.01"))
    own = metrics.map_tracker.own_cells.sum()
    alone = measured(explored("robots.count=1", "starts.poses_m=[[1.5, 1.5]]"))

    assert map_of(metrics).overlap == pytest.approx(own / metrics.map_tracker.seen - 1.0)
    assert map_of(metrics).overlap > 0.9
    assert map_of(alone).overlap == 0.0


# By hand: one robot that does as it is told.


class Errand:
    """A run of one robot whose every step is given."""

    def __init__(self) -> None:
        self.scenario = on_map("robots.count=1", "starts.poses_m=[[1.5, 8.5]]", "metrics.every=1")
        self.metrics = MapMetrics()
        self.pipeline = Pipeline(self.metrics)
        self.pipeline.observe(opening_of(self.scenario, 1, setup_of(self.scenario), {"r1": ()}))
        self.tick = 0
        self.pose = Pose(1.5, 8.5)

    def step(
        self,
        x_m: float,
        goal_m: tuple[float, float] | None = None,
        state: State = State.EXPLORING,
        *,
        bumped: bool = False,
    ) -> None:
        """One period: to x in the upper rooms."""
        look = Observation(self.tick, self.pose)
        self.tick, self.pose = self.tick + 1, Pose(x_m, 8.5)
        outputs = Outputs(self.tick, self.pose, goal=goal_m, state=state)
        verdict = StepVerdict(self.pose, bumped=bumped)
        step_record = StepRecord("r1", self.tick * PERIOD_NS, look, (), outputs, verdict)
        self.pipeline.observe(Batch(self.tick * PERIOD_NS, (step_record,), (), 0))

    def end(self) -> MapResult:
        self.pipeline.observe(Ending(self.tick * PERIOD_NS, "limit"))
        return map_of(self.metrics)


def test_distance_is_what_is_driven() -> None:
    """There and back is twice the way."""
    errand = Errand()
    for x_m in (2.5, 3.5, 2.0, 2.0):
        errand.step(x_m)
    found = errand.end()

    assert found.distance_m == found.longest_m == pytest.approx(3.5)
    assert [row.distance_m for row in errand.metrics.rows] == [
        pytest.approx(way) for way in (0.0, 1.0, 2.0, 3.5, 3.5)
    ]


FAR, FARTHER, NEAR = (6.5, 8.5), (14.5, 8.5), (5.5, 8.5)


@pytest.mark.parametrize(
    ("goals", "switches"),
    [
        ((FAR, FAR, FARTHER), 1),
        ((FAR, NEAR, FAR), 0),  # within a sensor range
        ((FAR, None, FARTHER), 0),  # it was idle in between
        ((FAR, FARTHER, FAR), 2),
        (((2.5, 8.5), FARTHER), 0),  # it had come there
    ],
)
def test_switch_is_a_goal_given_up_for_a_far_one(
    goals: tuple[tuple[float, float] | None, ...], switches: int
) -> None:
    """More than a sensor range away, before the robot had come within a cell."""
    errand = Errand()
    for goal_m in goals:
        errand.step(1.6, goal_m)

    assert errand.end().switches == switches


def test_stall_is_the_longest_stand_before_the_end() -> None:
    """A robot that has finished may stand as long as it likes."""
    errand = Errand()
    for x_m in (2.5, 2.5, 2.5, 2.5, 3.5, 3.5, 4.5):
        errand.step(x_m)
    for _ in range(9):
        errand.step(4.5, state=State.FINISHED)

    assert errand.end().stall_ticks == 3


def test_bumps_are_counted() -> None:
    """Moves that a wall ended."""
    errand = Errand()
    errand.step(1.1, bumped=True)
    errand.step(1.1, bumped=True)
    errand.step(2.5)

    assert errand.end().bumps == 2


# In its place.


def test_class_is_chosen_by_what_is_explored() -> None:
    """A density has bounds, a map has regions."""
    assert isinstance(metrics_of(mission()), DensityMetrics)
    assert isinstance(metrics_of(on_map()), MapMetrics)


def test_glance_has_distance_and_share() -> None:
    """Cheap at any time, also before anything."""
    assert MapMetrics().snapshot().mass_left == 1.0
    metrics = measured(explored())
    snapshot = metrics.snapshot()

    assert snapshot.mass_left == 0.0
    assert snapshot.distance_m == metrics.rows[-1].distance_m
    assert snapshot.robots_done == 2
    assert snapshot.messages_per_s > 0.0


def test_run_folder_has_rows_and_result(tmp_path: Path) -> None:
    """metrics.csv has a map's columns, result.json its part, and metrics and checker share one map tracker."""
    scenario = on_map()
    recording = Recording(scenario, 1, "in-process", tmp_path)
    play(scenario, 1, setup_of(scenario), [recording.observe])
    result = recording.finish()
    head, *lines = (tmp_path / "metrics.csv").read_text(encoding="utf-8").splitlines()
    stored = msgspec.json.decode((tmp_path / "result.json").read_bytes(), type=Result)

    assert head.split(",") == list(MapRow._fields)
    assert len(lines) == len(measured(explored()).rows)
    assert stored == result
    assert result.violations == 0
    assert result.map == map_of(measured(explored()))


def test_checker_that_reads_the_tracker_of_metrics_finds_what_one_with_its_own_finds() -> None:
    """Metrics come first and keep the tracker: rows and violations are the same."""
    metrics, alone = MapMetrics(), MapMetrics()
    reading, own = Checker(metrics.map_tracker), Checker()
    both, checked = Pipeline(metrics, reading), Pipeline(own)
    measured_alone = Pipeline(alone)
    for record in explored():
        both.observe(record)
        checked.observe(record)
        measured_alone.observe(record)

    assert metrics.rows == alone.rows
    assert reading.violations == own.violations == []
    assert reading.count == own.count


def test_opening_alone_can_be_measured() -> None:
    """A run that was cut at once."""
    opening = explored()[0]
    assert isinstance(opening, Opening)
    metrics = measured([opening])

    assert metrics.rows[-1].explored == 0.0
    assert map_of(metrics).wtv_final.r64 == 0.0
    assert map_of(metrics).stall_ticks == 0
