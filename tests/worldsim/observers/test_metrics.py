"""Metrics of a run: the views, the bytes, the counts of the record, and the events of processes."""

from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from kantor_fleet.execution.in_process_team import play, team
from kantor_fleet.report.summary import summary
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.base.machine import (
    EVERYBODY,
    SUPERVISOR,
    Envelope,
    Observation,
    Outputs,
    Pose,
    State,
)
from kantor_protocol.base.varint import Pairs
from kantor_protocol.wire.weights import WeightsSubscriber
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.checkers.state import FORGED_FIRST
from kantor_worldsim.observers.metrics.density import DensityMetrics
from kantor_worldsim.observers.metrics.result import Rejoining, Result
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.radio.channel import DROPPED
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, Record, StepRecord
from kantor_worldsim.world.world import StepVerdict, WorldSetup
from support.line_mission import PERIOD_NS, LineMission, measured, result_of
from support.records import Play
from support.strategies import mission

# Views.


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
@pytest.mark.parametrize("merge", [("merge=ledger",), ("merge=min", "claims=false")])
def test_views_follow_the_robots(coordination: str, merge: tuple[str, ...]) -> None:
    """At every step the vector rebuilt from `lowered` is the one that the robot holds."""
    scenario = mission(
        f"coordination={coordination}",
        "samples.count=60",
        "energy.points=90",
        "radio.drop=0.3",
        "publish.weights_every=3",
        *merge,
    )
    setup = WorldSetup.of(scenario, 1)
    machines = team(scenario, 1, setup)
    subscribers = {name: WeightsSubscriber() for name in scenario.roster}
    pairs = Pairs()
    units = 3
    views = {name: np.full(60, units, dtype=np.int64) for name in scenario.roster}
    compared = 0

    def compare(record: Record) -> None:
        nonlocal compared
        for step_record in record.step_records if isinstance(record, Batch) else ():
            assert step_record.outputs is not None
            lowered = pairs.decode(step_record.outputs.lowered, 60)
            assert lowered is not None
            views[step_record.name][lowered[0]] = lowered[1]
            held = weights_of(machines[step_record.name])
            assert views[step_record.name].tolist() == held.tolist()
            if step_record.outputs.weights:
                assert subscribers[step_record.name].apply(step_record.outputs.weights)
                assert published(subscribers[step_record.name]) == held.tolist()
            compared += 1

    simulation = Simulation(scenario, 1, setup, [compare])
    exchange = InProcessExchange(machines)
    simulate(simulation, exchange, 1, lambda: False, exchange)

    assert compared > 80


def weights_of(machine: object) -> npt.NDArray[np.int64]:
    """The weights that a robot or the supervisor holds, from inside."""
    belief = getattr(machine, "_belief", None)
    replica = getattr(machine, "_replica", None) or belief.replica
    held: npt.NDArray[np.int64] = replica.weights
    return held


def published(subscriber: WeightsSubscriber) -> list[int] | None:
    return None if subscriber.weights is None else subscriber.weights.tolist()


# Whole runs.


@pytest.fixture(scope="module")
def full_runs() -> Callable[[str], Result]:
    """Whole packaged missions, seed 0, each run once."""
    results: dict[str, Result] = {}

    def run(name: str) -> Result:
        if name not in results:
            scenario = find(name)
            setup = WorldSetup.of(scenario, 0)
            recording = Recording(scenario, 0, "in-process")
            play(scenario, 0, setup, [recording.observe])
            results[name] = recording.finish()
        return results[name]

    return run


@pytest.mark.papers
@pytest.mark.xdist_group("full-runs")
@pytest.mark.parametrize(
    "name", ["paper-centralized", "paper-decentralized", "paper-timevarying", "fleet"]
)
def test_weights_cost_at_most_eight_bytes_a_robot_and_tick(
    full_runs: Callable[[str], Result], name: str
) -> None:
    """The bytes by which observers follow the weight vector, not 16 kB a tick; and no rule is broken."""
    result = full_runs(name)

    assert 1.0 < result.bytes_per_robot_tick.weights <= 8.0
    assert result.bytes_per_robot_tick.total > result.bytes_per_robot_tick.weights
    assert (result.ended, result.violations, result.messages_refused) == ("done", 0, 0)


@pytest.mark.papers
@pytest.mark.xdist_group("full-runs")
def test_result_has_the_stable_names(full_runs: Callable[[str], Result]) -> None:
    """result.json is read by other programs: names come, none goes."""
    names = """
        scenario seed exchange clock planner merge robots ticks finished_tick detected targets
        detection_rate w_ub w1_exact energy_spent mass_left mass_double_counted
        bytes_per_robot_tick deliveries drops out_of_range_refused violations digest wall_s
    """
    tree = msgspec.to_builtins(full_runs("fleet"))

    assert set(names.split()) <= set(tree)
    assert set(tree["w_ub"]) == {"paper", "tight", "final_instant"}
    assert set(tree["bytes_per_robot_tick"]) == {"weights", "total"}


# Counts.


def test_counts_are_those_of_the_record(played: Play) -> None:
    """Deliveries, drops, range, finds, energy and contact are counted from the record alone."""
    records = played("radio.range_m=60", "radio.drop=0.4", "sensor.range_m=20")
    result = result_of(measured(records))
    batches = [record for record in records if isinstance(record, Batch)]
    decisions = [decision for batch in batches for decision in batch.decisions]
    step_records = [step_record for batch in batches for step_record in batch.step_records]
    opening = records[0]
    assert isinstance(opening, Opening)
    finds = [find for found in opening.first_look.values() for find in found]
    finds += [
        find
        for step_record in step_records
        if step_record.verdict
        for find in step_record.verdict.found
    ]
    steps = [
        step_record.outputs.step
        for step_record in step_records
        if step_record.outputs and step_record.heard
    ]

    assert result.drops == sum(decision.due_ns == DROPPED for decision in decisions)
    assert result.deliveries + result.drops == len(decisions)
    assert result.out_of_range_refused == sum(batch.out_of_range for batch in batches)
    assert (result.detected, result.targets) == (len(finds), 40)
    assert result.detection_rate == len(finds) / 40
    assert result.energy_spent == sum(
        bool(step_record.outputs and step_record.outputs.spent) for step_record in step_records
    )
    assert result.first_contact_tick == steps[0]
    assert (
        result.finished_tick
        == max(step_record.outputs.step for step_record in step_records if step_record.outputs)
        > 20
    )


def test_absences_and_refused_messages_are_counted() -> None:
    """Participants without outputs, and messages that robots and world-sim refused."""
    line = LineMission()
    line.pipeline.observe(Batch(PERIOD_NS, (), (), 0, absent=("r1", "r2")))
    pose = Pose(0.0, 0.0)
    refusing = Outputs(1, pose, refused=3)
    step_record = StepRecord("r1", PERIOD_NS, Observation(0, pose), (), refusing, StepVerdict(pose))
    line.pipeline.observe(Batch(2 * PERIOD_NS, (step_record,), (), 0))
    line.pipeline.observe(Batch(3 * PERIOD_NS, (step_record,), (), 0))
    line.rows()

    assert result_of(line.metrics).absences == 2
    assert result_of(line.metrics).messages_refused == 3


def test_unfinished_team_has_no_finishing_tick() -> None:
    """Exhausted robots rest, but they have not finished; nor has a team of which one has not."""
    line = LineMission()
    pose = Pose(0.0, 0.0)
    for name, state in (("r1", State.FINISHED), ("r2", State.EXHAUSTED)):
        outputs = Outputs(1, pose, state=state)
        step_record = StepRecord(
            name, PERIOD_NS, Observation(0, pose), (), outputs, StepVerdict(pose)
        )
        line.pipeline.observe(Batch(PERIOD_NS, (step_record,), (), 0))
    line.rows()

    assert result_of(line.metrics).finished_tick is None
    assert line.metrics.snapshot().robots_done == 2


def test_bytes_are_payload_on_the_bus() -> None:
    """Weights and all radio bodies of the robots, by step; the supervisor's are not counted."""
    line = LineMission("coordination=centralized")
    pose = Pose(0.0, 0.0)
    outbox = (Envelope("r1", 1, EVERYBODY, bytes(20)), Envelope("r1", 2, "r2", bytes(10)))
    for name in ("r1", "r2", SUPERVISOR):
        outputs = Outputs(1, pose, weights=bytes(6), outbox=outbox if name != "r2" else ())
        step_record = StepRecord(
            name, PERIOD_NS, Observation(0, pose), (), outputs, StepVerdict(pose)
        )
        line.pipeline.observe(Batch(PERIOD_NS, (step_record,), (), 0))
    line.rows()
    wire = result_of(line.metrics).bytes_per_robot_tick

    assert (wire.weights, wire.total) == (6.0, 21.0)


# Processes.

ALL_PROCESS_FAULTS = (
    (
        "faults=[{kind='kill', who=['r2'], from_s=0.55, until_s=1.12, disk='lost'},"
        "{kind='kill', who=['r1'], from_s=0.5, until_s=1.15}, {kind='late', who=['r3'], until_s=0.4},"
        "{kind='pause', who=['r3'], from_s=1.0, until_s=1.5}, {kind='impostor', who=['r1'], from_s=2.0},"
        "{kind='clock', who=['r3'], from_s=2.0, until_s=2.2, offset_s=-1.0},"
        "{kind='slow', who=['r1'], from_s=2.0, until_s=2.5, every=2},"
        "{kind='full-disk', who=['r2'], from_s=2.0, until_s=2.5}, {kind='hostile', probability=0.2},"
        "{kind='kill', who=['worldsim'], from_s=3.0, until_s=3.1},"
        "{kind='kill', who=['r2'], from_s=1000.0}]"
    ),
    "limit_s=2000",
)


def test_process_events_are_counted_by_fault(played: Play) -> None:
    """By fault and kind; restarts, new incarnations, and the times until a process stepped again."""
    records = played(*ALL_PROCESS_FAULTS)
    result = result_of(measured(records))

    def counted(name: str) -> dict[str, int]:
        counts = msgspec.structs.asdict(result.faults[name])
        return {kind: number for kind, number in counts.items() if number}

    assert counted("0 kill") == {"killed": 1, "started": 1}
    assert counted("2 late") == {"started": 1}
    assert counted("3 pause") == {"paused": 1, "resumed": 1}
    assert counted("4 impostor") == {"refused": 1}
    assert counted("5 clock") == {"skewed": 1, "righted": 1}
    assert counted("6 slow") == {"slowed": 1, "quickened": 1}
    assert counted("7 full-disk") == {"filled": 1, "freed": 1}
    assert set(counted("8 hostile")) == {"forged"}
    assert counted("9 kill") == {"killed": 1, "started": 1}
    assert counted("10 kill") == {}
    assert (result.restarts, result.incarnations, result.violations) == (3, 1, 0)
    assert result.rejoin_s is not None
    assert result.rejoin_s.count == 2
    assert result.rejoin_s.max_s == pytest.approx(0.08)  # killed at 0.55 s: at 1.12 s, 1.2 s
    assert result.messages_refused == sum(
        decision.sequence >= FORGED_FIRST and decision.due_ns != DROPPED
        for record in records
        if isinstance(record, Batch)
        for decision in record.decisions
    ) - _forgeries_not_received(records)
    assert "1 new incarnation" in summary(result)


def _forgeries_not_received(records: Sequence[Record]) -> int:
    """Forged messages that reached a process that was dead, or at rest for good."""
    batches = [record for record in records if isinstance(record, Batch)]
    heard = sum(
        n >= FORGED_FIRST
        for b in batches
        for step_record in b.step_records
        for _, n in step_record.heard
    )
    delivered = [v for b in batches for v in b.decisions if v.due_ns != DROPPED]
    return sum(decision.sequence >= FORGED_FIRST for decision in delivered) - heard


def test_view_of_a_new_incarnation_is_full_again(played: Play) -> None:
    """What the former incarnation had learnt does not count until the new one learns it again."""
    records = played(*ALL_PROCESS_FAULTS, "merge=min", "claims=false")
    metrics = DensityMetrics()
    pipeline = Pipeline(metrics)
    before = after = 0
    for record in records:
        before = int(metrics._tally.views[1].sum()) if isinstance(record, ProcessEvent) else before
        pipeline.observe(record)
        if isinstance(record, ProcessEvent) and record.incarnation:
            after = int(metrics._tally.views[1].sum())
            break

    assert before < after == metrics._units.whole
    assert metrics._tally.least.tolist() == metrics._tally.views.min(axis=0).tolist()


def test_times_to_rejoin_are_quantiles_that_happened() -> None:
    """The median and the 99th percentile are among the times."""
    hundred = Rejoining.of([10_000_000 * (i + 1) for i in range(100)])

    assert hundred == Rejoining(count=100, median_s=0.51, p99_s=1.0, max_s=1.0)
    assert Rejoining.of([5_000_000]) == Rejoining(count=1, median_s=0.005, p99_s=0.005, max_s=0.005)
    assert Rejoining.of([]) is None


# Rows.


def test_a_run_with_files_keeps_few_rows_in_memory(tmp_path: Path) -> None:
    """The first and the last ones, from which the summary and the rate of messages are the same as from all."""
    scenario = mission("linger_s=6")
    recordings = [Recording(scenario, 0, "in-process", folder) for folder in (tmp_path, None)]
    play(scenario, 0, WorldSetup.of(scenario, 0), [each.observe for each in recordings])
    for each in recordings:
        each.finish()
    few, all_of_them = (each.metrics for each in recordings)
    lines = (tmp_path / "metrics.csv").read_text(encoding="utf-8").splitlines()

    assert few.rows[0] == all_of_them.rows[0]
    assert few.rows[-10:] == all_of_them.rows[-10:]
    assert len(few.rows) <= 21 < len(all_of_them.rows) == len(lines) - 1
    assert few.snapshot() == all_of_them.snapshot()
