"""What a run is measured by: the bounds by hand, the views, the bytes, the counts."""

from collections.abc import Callable, Iterable, Sequence
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
    ParticipantId,
    Pose,
    State,
)
from kantor_protocol.base.varint import Pairs
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.weights import WeightsSubscriber
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.checkers.state import FORGED_FIRST
from kantor_worldsim.observers.metrics.density import DensityMetrics, DensityRow
from kantor_worldsim.observers.metrics.result import Rejoining, Result
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.radio.channel import DROPPED, DeliveryDecision
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    Opening,
    ProcessEvent,
    Record,
    StepRecord,
    opening_of,
)
from kantor_worldsim.world.world import StepVerdict, WorldSetup
from support.strategies import mission

Play = Callable[..., tuple[Record, ...]]
PERIOD_NS = 100_000_000


def result_of(metrics: DensityMetrics) -> Result:
    return metrics.result(exchange="-", digest="-", wall_s=0.0, record="whole", complaints=())


def measured(records: Iterable[Record]) -> DensityMetrics:
    """What records are measured by."""
    metrics = DensityMetrics()
    pipeline = Pipeline(metrics)
    for record in records:
        pipeline.observe(record)
    return metrics


def packed(*pairs: tuple[int, int]) -> bytes:
    index = np.array([i for i, _ in pairs], dtype=np.int64)
    value = np.array([v for _, v in pairs], dtype=np.int64)
    return Pairs().encode(index, value, len(pairs))


# Two samples on a line, by hand: r1 comes from the left, r2 from the right.

LINE = """
name = "line"
merge = "min"
claims = false
domain = {min_m = [0.0, 0.0], max_m = [40.0, 1.0]}
robots = {count = 2}
starts = {poses_m = [[0.0, 0.0], [40.0, 0.0]]}
energy = {points = 4}
samples = {count = 2}
density = [{mean_m = [0.0, 0.0], variance_m2 = [1.0, 1.0]}]
metrics = {every = 1}
"""
SAMPLES_M = ((10.0, 0.0), (30.0, 0.0))
"""N = 2 and M = 4: two units a sample, one a point; a unit is a quarter of the mass."""


class Line:
    """A run on the line whose every act is given."""

    def __init__(self, *overrides: str) -> None:
        scenario = parse(LINE, "line", overrides)
        setup = WorldSetup(
            np.array(SAMPLES_M), np.zeros((0, 2)), np.array([[0.0, 0.0], [40.0, 0.0]])
        )
        self.metrics = DensityMetrics()
        self.pipeline = Pipeline(self.metrics)
        self.pipeline.observe(opening_of(scenario, 1, setup, {"r1": (), "r2": ()}))
        self.tick = 0

    def play(self, *step_records: StepRecord) -> None:
        """One period."""
        self.tick += 1
        self.pipeline.observe(Batch(self.tick * PERIOD_NS, step_records, (), 0))

    def step_record(
        self,
        name: ParticipantId,
        x_m: float,
        sample: int,
        left: int,
        violations: tuple[str, ...] = (),
    ) -> StepRecord:
        """A robot goes to x and ships one unit to a sample, of which its view then holds `left`."""
        pose = Pose(x_m, 0.0)
        return StepRecord(
            name,
            self.tick * PERIOD_NS,
            Observation(self.tick, pose),
            (),
            Outputs(self.tick + 1, pose, spent=packed((sample, 1)), lowered=packed((sample, left))),
            StepVerdict(pose, violations=violations),
        )

    def rows(self) -> list[DensityRow]:
        self.pipeline.observe(Ending(self.tick * PERIOD_NS, "done"))
        return self.metrics.rows


def bounds(rows: Sequence[DensityRow]) -> list[tuple[float, float | None, float]]:
    return [(row.w_ub_paper, row.w_ub_tight, row.w_ub_instant) for row in rows]


def test_bounds_by_hand_without_a_supervisor() -> None:
    """Eq. 12 over the team: each robot's own vector counts whole, or its share of the true rest.

    Start: each robot has 10 m and 30 m to half the mass each, 20 together. Tick 1: both go 5 m and
    ship a quarter of the mass over 5 m. Each still counts the other's sample as full. Tick 2: both
    stand on their samples.
    """
    line = Line()
    line.play(line.step_record("r1", 5.0, 0, 1), line.step_record("r2", 35.0, 1, 1))
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 30.0, 1, 0))

    # pending at 1: 1/4 * 5 + 2/4 * 25 for each; of the true rest: 1/4 * 5 for each
    # pending at 2: 2/4 * 20 for each; of the true rest: nothing
    assert bounds(line.rows()) == [
        (40.0, 10.0, 40.0),
        (2.5 + 27.5, 2.5 + 2.5, 2.5 + 27.5),
        (2.5 + 20.0, 2.5, 20.0),
    ]


def test_bounds_by_hand_with_a_supervisor() -> None:
    """Eq. 11: every robot counts the common weights, which are the least of all views."""
    line = Line("coordination=centralized")
    line.play(line.step_record("r1", 5.0, 0, 1), line.step_record("r2", 35.0, 1, 1))
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 30.0, 1, 0))

    assert bounds(line.rows()) == [
        (40.0, 10.0, 40.0),
        (2.5 + 15.0, 2.5 + 2.5, 2.5 + 15.0),
        (2.5, 2.5, 0.0),
    ]


def test_tight_bound_ends_when_a_sample_is_filled_twice() -> None:
    """From the tick on in which more is shipped to a sample than it takes, there is none."""
    line = Line()
    line.play(line.step_record("r1", 10.0, 0, 1), line.step_record("r2", 30.0, 1, 1))
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 20.0, 0, 1))
    line.play(line.step_record("r1", 20.0, 1, 1), line.step_record("r2", 10.0, 1, 0))
    rows = line.rows()

    assert [row.w_ub_tight is None for row in rows] == [False, False, True, True]
    assert [row.mass_double_counted for row in rows] == [0.0, 0.0, 0.25, 0.5]
    assert [row.mass_left for row in rows] == [1.0, 0.5, 0.25, 0.0]


def test_ledger_counts_what_was_really_shipped() -> None:
    """With the ledger the mass left is the truth, whatever the views hold."""
    line = Line("merge=ledger")
    line.play(line.step_record("r1", 10.0, 0, 1), line.step_record("r2", 10.0, 0, 1))
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 30.0, 1, 1))
    rows = line.rows()

    assert [row.mass_left for row in rows] == [1.0, 0.5, 0.25]
    assert [row.mass_double_counted for row in rows] == [0.0, 0.0, 0.25]


def test_mass_left_is_that_of_the_least_view_even_if_views_rise() -> None:
    """A record that is not sound is measured as it stands: the minimum over all views, sample by sample."""
    line = Line()
    line.play(line.step_record("r1", 10.0, 0, 0), line.step_record("r2", 10.0, 0, 1))
    line.play(line.step_record("r1", 10.0, 0, 2), line.step_record("r2", 10.0, 1, 1))
    line.play(line.step_record("r2", 10.0, 0, 2))

    assert [row.mass_left for row in line.rows()] == [1.0, 0.5, 0.5, 0.75]


@pytest.mark.parametrize("violation", ["step", "energy", "units"])
def test_refused_spending_counts_for_nothing(violation: str) -> None:
    """What the world did not let happen is neither shipped nor energy."""
    line = Line()
    line.play(
        line.step_record("r1", 0.0, 0, 1, (violation,)),
        line.step_record("r2", 40.0, 1, 1, ("speed",)),
    )
    rows = line.rows()

    assert rows[-1].energy_spent == 1
    assert rows[-1].w_ub_paper == 2.5 + 0.25 * (10 + 2 * 30) + 0.25 * (10 + 2 * 30)
    assert result_of(line.metrics).violations == 2


def test_cost_is_taken_where_the_sample_then_is() -> None:
    """Samples that walk are shipped to, and counted, where they are at the time of the step."""
    records = list(_walking_run())
    opening = records[0]
    assert isinstance(opening, Opening)
    rows = measured(records).rows

    assert rows[0].w_ub_paper == pytest.approx(plain_bound(opening))
    assert rows[-1].w_ub_paper < 0.7 * rows[0].w_ub_paper


def _walking_run() -> Iterable[Record]:
    scenario = mission("samples.diffusion_m=3.0", "metrics.every=1")
    records: list[Record] = []
    setup = WorldSetup.of(scenario, 1)
    play(scenario, 1, setup, [records.append])
    return records


# The start.


def plain_bound(opening: Opening) -> float:
    """Eq. 6, 11 and 12 at t = 0: all mass, over its distance to every robot, summed."""
    setup = opening.setup
    way_m = np.linalg.norm(setup.starts_m[:, None] - setup.samples_m[None], axis=2)
    return float(way_m.sum() / setup.samples_m.shape[0])


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
@pytest.mark.parametrize("merge", [("merge=ledger",), ("merge=min", "claims=false")])
def test_bound_at_the_start_is_the_plain_formula(
    played: Play, coordination: str, merge: tuple[str, ...]
) -> None:
    """W_UB(0) = sum over robots and samples of n_0 times the distance, for every variant."""
    records = played(f"coordination={coordination}", *merge)
    opening = records[0]
    assert isinstance(opening, Opening)
    first = measured(records).rows[0]

    assert first.w_ub_paper == pytest.approx(plain_bound(opening), rel=1e-12)
    assert first.w_ub_instant == first.w_ub_paper
    assert first.w_ub_tight is not None
    assert first.w_ub_tight <= first.w_ub_paper / 3.0 * (1.0 + 1e-12)


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
            fallen = pairs.decode(step_record.outputs.lowered, 60)
            assert fallen is not None
            views[step_record.name][fallen[0]] = fallen[1]
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
    """What a robot or the supervisor holds, from inside."""
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
    """What observers are told of the weight vector, not 16 kB a tick; and no rule is broken."""
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
    """Who gave no outputs, and what robots and world-sim turned away."""
    line = Line()
    line.pipeline.observe(Batch(PERIOD_NS, (), (), 0, absent=("r1", "r2")))
    pose = Pose(0.0, 0.0)
    refusing = Outputs(1, pose, refused=3)
    step_record = StepRecord("r1", PERIOD_NS, Observation(0, pose), (), refusing, StepVerdict(pose))
    line.pipeline.observe(Batch(2 * PERIOD_NS, (step_record,), (), 0))
    line.pipeline.observe(Batch(3 * PERIOD_NS, (step_record,), (), 0))
    line.rows()

    assert result_of(line.metrics).absences == 2
    assert result_of(line.metrics).messages_refused == 3


STRUCK = (
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


def test_what_befell_processes_is_counted(played: Play) -> None:
    """By fault and deed; who came back, as which incarnation, and how soon it stepped again."""
    records = played(*STRUCK)
    result = result_of(measured(records))

    def told(name: str) -> dict[str, int]:
        counts = msgspec.structs.asdict(result.faults[name])
        return {deed: number for deed, number in counts.items() if number}

    assert told("0 kill") == {"killed": 1, "started": 1}
    assert told("2 late") == {"started": 1}
    assert told("3 pause") == {"paused": 1, "resumed": 1}
    assert told("4 impostor") == {"refused": 1}
    assert told("5 clock") == {"skewed": 1, "righted": 1}
    assert told("6 slow") == {"slowed": 1, "quickened": 1}
    assert told("7 full-disk") == {"filled": 1, "freed": 1}
    assert set(told("8 hostile")) == {"forged"}
    assert told("9 kill") == {"killed": 1, "started": 1}
    assert told("10 kill") == {}
    assert (result.restarts, result.incarnations, result.violations) == (3, 1, 0)
    assert result.rejoin_s is not None
    assert result.rejoin_s.count == 2
    assert result.rejoin_s.max_s == pytest.approx(0.08)  # killed at 0.55 s: at 1.12 s, 1.2 s
    assert result.messages_refused == sum(
        decision.sequence >= FORGED_FIRST and decision.due_ns != DROPPED
        for record in records
        if isinstance(record, Batch)
        for decision in record.decisions
    ) - _unheard(records)
    assert "1 new incarnation" in summary(result)


def _unheard(records: Sequence[Record]) -> int:
    """Forged messages that reached a process that was dead, or at rest for good."""
    batches = [record for record in records if isinstance(record, Batch)]
    heard = sum(
        n >= FORGED_FIRST
        for b in batches
        for step_record in b.step_records
        for _, n in step_record.heard
    )
    ruled = [v for b in batches for v in b.decisions if v.due_ns != DROPPED]
    return sum(decision.sequence >= FORGED_FIRST for decision in ruled) - heard


def test_times_to_rejoin_are_quantiles_that_happened() -> None:
    """The median and the 99th percentile are among the times."""
    hundred = Rejoining.of([10_000_000 * (i + 1) for i in range(100)])

    assert hundred == Rejoining(count=100, median_s=0.51, p99_s=1.0, max_s=1.0)
    assert Rejoining.of([5_000_000]) == Rejoining(count=1, median_s=0.005, p99_s=0.005, max_s=0.005)
    assert Rejoining.of([]) is None


def test_view_of_a_new_incarnation_is_full_again(played: Play) -> None:
    """What it had learnt counts no more, until it learns it again."""
    records = played(*STRUCK, "merge=min", "claims=false")
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


def test_unfinished_team_has_no_finishing_tick() -> None:
    """Exhausted robots rest, but they have not finished; nor has a team of which one has not."""
    line = Line()
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
    line = Line("coordination=centralized")
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


# Rows.


def test_rows_come_once_a_period_from_the_start_to_the_end(played: Play) -> None:
    """With metrics.every = 1 there is a row for time 0 and one for every tick, the last included."""
    rows = measured(played("metrics.every=1")).rows

    assert [row.tick for row in rows] == list(range(len(rows)))
    assert [row.time_s for row in rows] == pytest.approx([0.1 * i for i in range(len(rows))])
    assert (rows[0].energy_spent, rows[0].mass_left) == (0, 1.0)
    assert rows[-1].mass_left == 0.0


@pytest.mark.parametrize("every", [2, 7])
def test_rows_may_be_fewer(played: Play, every: int) -> None:
    """Every so many ticks, and the last one. The tight bound's prices follow the rows, it may differ."""
    whole = measured(played("metrics.every=1")).rows
    rows = measured(played(f"metrics.every={every}")).rows
    ticks = sorted({*range(0, len(whole), every), len(whole) - 1})

    assert [row.tick for row in rows] == ticks
    loose = [row._replace(w_ub_tight=None) for row in rows]
    assert loose == [whole[tick]._replace(w_ub_tight=None) for tick in ticks]
    for row, tick in zip(rows, ticks, strict=True):
        assert (row.w_ub_tight is None) == (whole[tick].w_ub_tight is None)


def test_bound_and_mass_never_rise_in_turn(played: Play) -> None:
    """In turn, with all robots in range, nothing is filled twice: the tight bound stays to the end."""
    rows = measured(played("metrics.every=1", "clock.order=turn")).rows
    masses = [row.mass_left for row in rows]

    assert masses == sorted(masses, reverse=True)
    assert all(row.w_ub_tight is not None for row in rows)
    assert all(row.w_ub_tight <= row.w_ub_paper for row in rows if row.w_ub_tight is not None)


def test_glance_before_anything_is_empty() -> None:
    """Progress can be asked for at any time."""
    assert DensityMetrics().snapshot().energy_spent == 0


def test_glance_tells_the_rate_of_deliveries() -> None:
    """Deliveries a simulated second, over the last rows."""
    line = Line()
    decisions = (DeliveryDecision("r1", 1, "r2", 0), DeliveryDecision("r2", 1, "r1", DROPPED))
    for tick in range(1, 31):
        line.pipeline.observe(Batch(tick * PERIOD_NS, (), decisions, 0))
    snapshot = line.metrics.snapshot()

    assert snapshot.messages_per_s == pytest.approx(10.0)
    assert snapshot.now_ns == 29 * PERIOD_NS


def test_period_of_rows_is_chosen_by_size() -> None:
    """A large mission is measured less often, so that measuring stays cheap."""

    def every(scenario: Scenario) -> int:
        metrics = measured(_opening_alone(scenario))
        return metrics._every

    assert every(mission()) == 1
    assert every(mission("samples.count=200000")) == 3


def _opening_alone(scenario: Scenario) -> list[Record]:
    setup = WorldSetup.of(scenario, 1)
    return [opening_of(scenario, 1, setup, dict.fromkeys(scenario.robot_ids, ()))]


def test_metrics_file_has_the_rows(tmp_path: Path) -> None:
    """metrics.csv is the rows, one line each, an empty cell where there is no value."""
    scenario = mission("merge=min", "claims=false", "metrics.every=1")
    setup = WorldSetup.of(scenario, 1)
    recording = Recording(scenario, 1, "in-process", tmp_path)
    play(scenario, 1, setup, [recording.observe])
    recording.finish()
    head, *lines = (tmp_path / "metrics.csv").read_text(encoding="utf-8").splitlines()
    rows = recording.metrics.rows
    cells = [line.split(",") for line in lines]
    tight = DensityRow._fields.index("w_ub_tight")

    assert head.split(",") == list(DensityRow._fields)
    assert [line[tight] == "" for line in cells] == [row.w_ub_tight is None for row in rows]
    assert [float(line[4]) for line in cells] == [row.w_ub_paper for row in rows]
