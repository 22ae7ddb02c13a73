"""What robots saw and hold, followed from records: the same as a plain reading of them gives."""

import functools
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.mapping.fused_map import FusedMap
from kantor_fleet.execution.in_process_team import participant, play, team
from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN
from kantor_protocol.base.machine import Inputs, Outputs
from kantor_protocol.node.recovery import KillableNode
from kantor_protocol.replication.occupancy_log import OccupancyLog, entries
from kantor_protocol.replication.replica import Replica
from kantor_protocol.wire.messages import decode_gossip
from kantor_protocol.wire.version_vector import read_version_vector
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.observers.metrics.map_tracker import MapTracker
from kantor_worldsim.observers.metrics.map_tracker_kernels import AS_SENT, KIND
from kantor_worldsim.observers.metrics.mapping import MapMetrics
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.record.records import Batch, Opening, Record, StepRecord
from kantor_worldsim.world.maps import Ground, parts
from support.grounds import grounds
from support.missions import ROOMS, explored, on_map, setup_of
from support.replication.replicas import read_logs
from support.strategies import examples

Records = Sequence[Record]
RUNS = {
    "near": (),
    "centralized": ("coordination=centralized",),
    "alone": ("radio.range_m=0.01",),
    "ranges": ("planner=burgard", "radio.drop=0.2", "radio.delay_s=0.15"),
}


def surveyed(records: Records) -> MapTracker:
    map_tracker = MapTracker()
    pipeline = Pipeline(map_tracker)
    for record in records:
        pipeline.observe(record)
    return map_tracker


def acts_of(records: Records) -> list[tuple[int, StepRecord]]:
    """What robots did, each with its tick."""
    return [
        (record.now_ns // 100_000_000, step_record)
        for record in records
        if isinstance(record, Batch)
        for step_record in record.step_records
        if step_record.name != "supervisor"
    ]


class Witness:
    """The same, literally: sets of cells, logs as lists."""

    def __init__(self, records: Records) -> None:
        assert isinstance(records[0], Opening)
        scenario, ground = records[0].scenario, records[0].setup.ground
        assert ground is not None
        self.frame, names = ground.frame, scenario.robot_ids
        self.first: dict[int, int] = {}
        self.own: dict[str, set[int]] = {name: set() for name in names}
        logs: dict[str, dict[int, int]] = {name: {} for name in scenario.roster}
        version_vector = {name: [0] * len(scenario.roster) for name in names}
        evidence = {
            name: OccupancyLog(self.frame, scenario.sensor, ranges=scenario.learns_ranges)
            for name in names
        }
        last: dict[str, tuple[int, object]] = dict.fromkeys(names, (-1, None))
        for tick, step_record in acts_of(records):
            look, (step, pose) = step_record.observation, last[step_record.name]
            if look.step > step:
                last[step_record.name] = look.step, look.pose
                moved = look.pose != pose
                for entry in (
                    evidence[step_record.name].observe(look.scan, look.pose, moved=moved).tolist()
                ):
                    if entry < 2 * self.frame.cells:
                        self.first.setdefault(entry // 2, tick)
                        self.own[step_record.name].add(entry // 2)
            assert step_record.outputs is not None
            for envelope in step_record.outputs.outbox:
                news = decode_gossip(envelope.body)
                rows = read_logs(news.logs, valued=False)
                told = read_version_vector(news.version_vector, len(scenario.roster))
                assert rows is not None
                assert told is not None
                version_vector[step_record.name] = told
                for origin, position, entry, _ in rows.tolist():
                    logs[scenario.roster[origin]][position] = entry
        self.held = {
            name: self.own[name].union(
                logs[origin][i] // 2
                for origin, length in zip(scenario.roster, version_vector[name], strict=True)
                for i in range(length)
                if origin != name and logs[origin][i] < 2 * self.frame.cells
            )
            for name in names
        }


def in_survey(map_tracker: MapTracker) -> dict[int, int]:
    ticks = map_tracker.state.first_tick
    return {int(cell): int(ticks[cell]) for cell in np.flatnonzero(ticks >= 0)}


@pytest.mark.parametrize("run", list(RUNS))
def test_stamps_and_holdings_are_those_of_the_record(run: str) -> None:
    """Who saw what first, and who knows what by the logs that it says it holds."""
    records = explored(*RUNS[run])
    map_tracker, witness = surveyed(records), Witness(records)
    counts = map_tracker.observable.ravel()

    assert in_survey(map_tracker) == witness.first
    assert map_tracker.seen == sum(counts[cell] for cell in witness.first)
    for i, name in enumerate(witness.own):
        held = np.flatnonzero(map_tracker.state.held[i] & KIND)
        assert set(held.tolist()) == witness.held[name]
        assert map_tracker.held_cells[i] == counts[held].sum()
        assert map_tracker.own_cells[i] == sum(counts[cell] for cell in witness.own[name])


def test_robots_know_what_their_own_maps_show() -> None:
    """What a robot holds is what it makes a map of, void frontiers and all."""
    records = explored("radio.range_m=100")
    map_tracker = surveyed(records)
    frame = ROOMS.frame
    replica = Replica(1, 2, entries(frame), None, ledger=True, claims=False)
    chart = FusedMap(frame, 2)
    for place in (0, 1):
        count = map_tracker.state.written.item(place, AS_SENT)
        replica.store.length[place] = 0
        replica.reserve(count)
        replica.store.logs[place, :count, 0] = map_tracker.state.as_sent[place, :count]
        replica.store.length[place] = count
    chart.fold(replica)

    for place in (0, 1):
        assert np.array_equal(map_tracker.state.held[place] & KIND, chart.cells)


def _frontiers(ground: Ground, counts: npt.NDArray[np.bool_], known: npt.NDArray[np.bool_]) -> int:
    """Reachable known free cells with an unknown 4-neighbour, literally."""
    unknown = np.pad(~known, 1)
    beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
    return int((known & counts & (ground.cells == FREE) & beside).sum())


@pytest.mark.parametrize("run", list(RUNS))
def test_moments_are_those_of_the_stamps(run: str) -> None:
    """95 and 99 % and completion, tick by tick."""
    records = explored(*RUNS[run])
    map_tracker = surveyed(records)
    ticks, counts = map_tracker.state.first_tick, map_tracker.observable
    seen = [
        ((ticks >= 0) & (ticks <= tick) & counts.ravel()).sum() / map_tracker.total
        for tick in range(map_tracker.tick + 1)
    ]
    known = [(ticks >= 0) & (ticks <= tick) for tick in range(map_tracker.tick + 1)]
    left = [_frontiers(ROOMS, counts, now.reshape(counts.shape)) for now in known]

    assert map_tracker.t95_tick == next(i for i, share in enumerate(seen) if share >= 0.95)
    assert map_tracker.t99_tick == next(i for i, share in enumerate(seen) if share >= 0.99)
    assert map_tracker.completed_tick == next(i for i, many in enumerate(left) if i and not many)
    assert sorted(map_tracker.stamps.tolist()) == sorted(
        ticks[counts.ravel() & (ticks >= 0)].tolist()
    )


def test_every_robot_knows_later_than_the_first() -> None:
    """Cells that one robot has seen take a while to reach all; a robot that hears no other must see them itself."""
    together, alone = surveyed(explored()), surveyed(explored(*RUNS["alone"]))

    for map_tracker in (together, alone):
        assert map_tracker.t99_tick is not None
        assert map_tracker.all_t99_tick is not None
        assert map_tracker.all_t99_tick >= map_tracker.t99_tick
    assert alone.all_t99_tick > together.all_t99_tick


def test_ways_are_the_sum_of_moves() -> None:
    """From pose to pose as the world ruled them."""
    records = explored()
    map_tracker = surveyed(records)
    for i, name in enumerate(("r1", "r2")):
        places = [(1.5, 1.5) if i == 0 else (9.5, 1.5)]
        places += [
            (step_record.verdict.pose.x_m, step_record.verdict.pose.y_m)
            for _, step_record in acts_of(records)
            if step_record.name == name and step_record.verdict
        ]
        assert map_tracker.ways_m[i] == pytest.approx(
            sum(math.dist(a, b) for a, b in pairwise(places))
        )
        assert map_tracker.poses_m[i] == places[-1]


def test_bumps_are_counted_where_they_happen() -> None:
    """A ruling that says that a wall ended the move."""
    records = list(explored())
    batch = records[5]
    assert isinstance(batch, Batch)
    assert batch.step_records[0].verdict is not None
    bumped = msgspec.structs.replace(batch.step_records[0].verdict, bumped=True)
    step_record = msgspec.structs.replace(batch.step_records[0], verdict=bumped)
    records[5] = msgspec.structs.replace(batch, step_records=(step_record, *batch.step_records[1:]))

    assert surveyed(records).bumps == [(bumped.pose.x_m, bumped.pose.y_m)]


def test_metrics_keep_the_tracker_up_to_date() -> None:
    """Each record counts once."""
    metrics = MapMetrics()
    pipeline = Pipeline(metrics)
    for record in explored():
        pipeline.observe(record)

    once, kept = surveyed(explored()), metrics.map_tracker
    assert kept.seen == once.seen
    assert kept.log_bytes == once.log_bytes
    assert kept.ways_m == once.ways_m


@pytest.mark.parametrize("radio", [(), ("radio.range_m=0.01", "radio.beacon=state")])
def test_lost_steps_are_no_violations(radio: tuple[str, ...]) -> None:
    """A robot whose output was lost is asked again; it is not accused of that."""
    scenario = on_map(*radio)
    setup = setup_of(scenario)
    records: list[Record] = []
    simulation = Simulation(scenario, 1, setup, [records.append])
    build = functools.partial(participant, "r1", scenario, 1, setup)
    play_all = InProcessExchange(
        team(scenario, 1, setup) | {"r1": KillableNode(build, simulation.body("r1"))}
    )
    rounds = iter(range(10_000))

    def lossy(inputs: Mapping[str, Inputs]) -> Mapping[str, Outputs]:
        outputs = dict(play_all(inputs))
        if next(rounds) % 5 == 3:
            del outputs["r1"]
        return outputs

    reason = simulate(simulation, lossy, 1, lambda: False)

    assert reason == "done"
    assert check(records).violations == []


@given(grounds(), st.data())
@examples(25)
def test_any_small_map_is_explored_and_judged(ground: Ground, data: st.DataObject) -> None:
    """Robots finish with all seen that can be, the rules hold, and the survey is the record's."""
    labels, _ = parts(ground.cells)
    cells = np.flatnonzero(
        labels.ravel()
        == data.draw(st.sampled_from(sorted(set(labels[ground.cells == FREE].tolist()))))
    )
    starts = [ground.frame.centre_of(int(data.draw(st.sampled_from(cells.tolist())))) for _ in "12"]
    side_m = ground.frame.resolution_m
    scenario = on_map(
        f"starts.poses_m={[list(start) for start in starts]}",
        f"vehicle.speed_m_s={10.0 * side_m}",
        f"sensor.range_m={4.0 * side_m}",
    )
    records: list[Record] = []
    reason = play(scenario, 1, setup_of(scenario, ground), [records.append])
    map_tracker, witness = surveyed(records), Witness(records)

    assert reason == "done"
    assert check(records).violations == []
    assert in_survey(map_tracker) == witness.first
    assert map_tracker.seen == map_tracker.total
    assert map_tracker.completed_tick is not None


def test_kinds_are_two_bits() -> None:
    """What the survey packs into a byte fits the kinds of cells."""
    assert {UNKNOWN, FREE, OCCUPIED} == {UNKNOWN & KIND, FREE & KIND, OCCUPIED & KIND}
