"""The checker of mapping runs is silent on a sound record, and finds each rule that is broken alone."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
import pytest

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.base.grid import FREE, OCCUPIED
from kantor_protocol.base.machine import Envelope, Pose, State
from kantor_protocol.base.varint import put_int
from kantor_protocol.replication.occupancy_log import dead_frontier
from kantor_protocol.wire.messages import (
    Array,
    GossipMessage,
    RefusedError,
    decode_gossip,
    encode_gossip,
)
from kantor_protocol.wire.version_vector import read_version_vector
from kantor_worldsim.observers.checkers.checker import Checker, check
from kantor_worldsim.observers.checkers.mapping import MapChecker
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, Record, StepRecord
from support.broken_records import Change, outputs, put_step, verdict
from support.checkers import listed, rules
from support.grounds import drawn
from support.missions import ROOMS, explored, on_map, setup_of
from support.records import Records, batches, gossip_of, step_records, uints
from support.replication.replicas import read_logs

ALONE = ("radio.range_m=0.01", "radio.beacon=state")
"""No robot hears another, and each sends all that it knows all the time."""
RADIOS = {
    "near": (),
    "everywhere": ("radio.range_m=100",),
    "alone": ALONE,
    "lossy": ("radio.drop=0.3", "radio.duplicate=0.3", "radio.delay_s=0.15", "radio.jitter_s=0.2"),
    "sight": ("radio.line_of_sight=true", "radio.range_m=100"),
    "walls": ("radio.wall_loss_m=3", "radio.range_m=12"),
    "centralized": ("coordination=centralized",),
}
PLANNERS = ("frontier", "burgard", "market", "kmeans", "hungarian")


# Ways to change a record.


def opened(records: Records, **values: Any) -> list[Record]:
    """The records with another opening."""
    return [msgspec.structs.replace(records[0], **values), *records[1:]]


def goes(x_m: float, y_m: float) -> Change:
    """A change of where the world says a robot is."""
    return verdict(pose=Pose(x_m, y_m))


def hurried(records: Records, step_record: StepRecord, change: Change) -> list[Record]:
    """The records with one step record changed, in a world without a speed limit."""
    return put_step(opened(records, scenario=on_map("vehicle.speed_m_s=1000")), step_record, change)


def says(change: Callable[[GossipMessage], GossipMessage]) -> Change:
    """A change of the message that a robot sends."""

    def changed(step_record: StepRecord) -> StepRecord:
        assert step_record.outputs is not None
        (envelope,) = step_record.outputs.outbox
        body = encode_gossip(change(decode_gossip(envelope.body)))
        sent: tuple[Envelope, ...] = (msgspec.structs.replace(envelope, body=body),)
        return outputs(outbox=sent)(step_record)

    return changed


def suffix(origin: int, start: int, entries: Sequence[int]) -> bytes:
    """A part of a log, see GossipMessage."""
    out, at, before = np.zeros(10 * len(entries), dtype=np.uint8), 0, 0
    for entry in entries:
        at = put_int(out, at, entry - before)
        before = entry
    return uints(origin, start, len(entries), len(entries)) + out[:at].tobytes()


def having(gossip: GossipMessage, **lengths: int) -> GossipMessage:
    """The message with other lengths in its version vector; r1, r2: by how much they differ."""
    version_vector = read_version_vector(gossip.version_vector, 2)
    assert version_vector is not None
    told = [length + lengths.get(f"r{i}", 0) for i, length in enumerate(version_vector, 1)]
    return msgspec.structs.replace(gossip, version_vector=uints(*told))


def own_log(step_record: StepRecord, origin: int = 0) -> list[int]:
    """What a robot sends of its own log."""
    rows = read_logs(gossip_of(step_record).logs, valued=False)
    assert rows is not None
    return [int(entry) for who, _, entry, _ in rows if who == origin]


def logging(
    log: Sequence[int], origin: int = 0, start: int = 0
) -> Callable[[GossipMessage], GossipMessage]:
    """A change of the logs that are sent: one suffix instead."""
    return lambda gossip: msgspec.structs.replace(gossip, logs=suffix(origin, start, log))


# Records that break a rule.


def _stands_in_wall(records: Records) -> list[Record]:
    return hurried(records, step_records(records, "r1")[-1], goes(0.5, 0.5))


def _leaves_map(records: Records) -> list[Record]:
    return hurried(records, step_records(records, "r1")[-1], goes(-3.0, 1.5))


def _is_nowhere(records: Records) -> list[Record]:
    return hurried(records, step_records(records, "r1")[-1], goes(math.nan, math.inf))


def _goes_through_wall(records: Records) -> list[Record]:
    """From the lower left room straight into the lower right one, where no door is."""
    step_record = next(
        step_record
        for step_record in step_records(records, "r1")
        if step_record.verdict and step_record.verdict.pose.x_m < 6.0
    )
    last = step_records(records, "r1").index(step_record)
    assert step_record.verdict is not None
    short = [record for record in records[: 2 + last] if not isinstance(record, Opening)]
    return hurried(
        [records[0], *short], step_record, goes(13.5, step_record.verdict.pose.y_m - 0.2)
    )


def _tells_another_kind(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    log = own_log(step_record)
    return put_step(records, step_record, says(logging([*log[:-1], log[-1] ^ 1])))


def _leaves_one_out(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    log = own_log(step_record)
    return put_step(records, step_record, says(logging([*log[:3], *log[4:]])))


def _tells_too_much(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_step(records, step_record, says(logging([*own_log(step_record), 2 * 17])))


def _calls_far_frontier_none(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    far = dead_frontier(ROOMS.frame, ROOMS.frame.cell_of(14.5, 1.5))
    change = says(lambda gossip: having(logging([*own_log(step_record), far])(gossip), r1=1))
    return put_step(records, step_record, change)


def _calls_near_frontier_none(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[-1]
    near = dead_frontier(ROOMS.frame, ROOMS.frame.cell_of(2.5, 2.5))
    change = says(lambda gossip: having(logging([*own_log(step_record), near])(gossip), r1=1))
    return put_step(records, step_record, change)


def _starts_late(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_step(records, step_record, says(logging(own_log(step_record), start=10_000)))


def _sends_rubbish(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_step(
        records, step_record, says(lambda gossip: msgspec.structs.replace(gossip, logs=b"\xff"))
    )


def _sends_weights(records: Records) -> list[Record]:
    """A suffix of entries with a value each, as on a density."""
    step_record = step_records(records, "r1")[5]
    valued = uints(0, 0, 1, 1) + uints(4, 1)
    return put_step(
        records, step_record, says(lambda gossip: msgspec.structs.replace(gossip, logs=valued))
    )


def _hides_a_scan(records: Records) -> list[Record]:
    """Its version vector stays behind its scans."""
    before, step_record = next(
        (before, step_record)
        for before, step_record in zip(
            step_records(records, "r1"), step_records(records, "r1")[1:], strict=False
        )
        if gossip_of(before).version_vector[0:2] != gossip_of(step_record).version_vector[0:2]
    )
    version_vector = gossip_of(before).version_vector
    return put_step(
        records,
        step_record,
        says(lambda gossip: msgspec.structs.replace(gossip, version_vector=version_vector)),
    )


def _forgets(records: Records) -> list[Record]:
    return put_step(
        records, step_records(records, "r1")[-1], says(lambda gossip: having(gossip, r2=-1))
    )


def _sees_what_is_not_there(records: Records) -> list[Record]:
    """The true map has a free cell less than the robots saw, far from all ways."""
    stood_m = [
        step_record.verdict.pose
        for batch in batches(records)
        for step_record in batch.step_records
        if step_record.verdict
    ]
    away_m = {
        (x, y): min(math.hypot(pose.x_m - x, pose.y_m - y) for pose in stood_m)
        for x, y in map(ROOMS.frame.centre_of, np.flatnonzero(ROOMS.cells == FREE).tolist())
    }
    x_m, y_m = max(away_m, key=lambda place: away_m[place])
    return _redrawn(records, x_m, y_m, FREE, OCCUPIED)


def _sees_what_is_no_wall(records: Records) -> list[Record]:
    return _redrawn(records, 12.5, 2.5, OCCUPIED, FREE)


def _redrawn(records: Records, x_m: float, y_m: float, old: int, new: int) -> list[Record]:
    cells = ROOMS.cells.copy()
    cell = ROOMS.frame.cell_of(x_m, y_m)
    assert cells.flat[cell] == old
    cells.flat[cell] = new
    return opened(records, ground=Array.of(cells))


def _holds_more_than_there_is(records: Records) -> list[Record]:
    return put_step(
        records, step_records(records, "r1")[-1], says(lambda gossip: having(gossip, r2=1))
    )


def _forwards_something_else(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[-1]
    return put_step(records, step_record, says(logging([2 * 17], origin=1)))


def _forwards_too_much(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[-1]
    return put_step(records, step_record, says(logging([2 * 17], origin=1, start=10_000)))


def _gives_up(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]

    def change(step_record: StepRecord) -> StepRecord:
        assert step_record.outputs is not None
        rests = msgspec.structs.replace(step_record.outputs, state=State.FINISHED)
        return msgspec.structs.replace(step_record, outputs=rests)

    return put_step(records, step_record, change)


def _minds_walls(*overrides: str) -> Callable[[Records], list[Record]]:
    """The record of a radio that goes through walls, as if it minded them."""
    return lambda records: opened(records, scenario=on_map(*RADIOS["everywhere"], *overrides))


BROKEN: dict[str, tuple[tuple[str, ...], Callable[[Records], list[Record]]]] = {
    "wall-stands": (ALONE, _stands_in_wall),
    "wall-outside": (ALONE, _leaves_map),
    "wall-nowhere": (ALONE, _is_nowhere),
    "wall-through": (ALONE, _goes_through_wall),
    "map-another-kind": (ALONE, _tells_another_kind),
    "map-left-out": (ALONE, _leaves_one_out),
    "map-too-much": (ALONE, _tells_too_much),
    "map-far-void": (ALONE, _calls_far_frontier_none),
    "map-gap": (ALONE, _starts_late),
    "map-rubbish": (ALONE, _sends_rubbish),
    "map-weights": (ALONE, _sends_weights),
    "map-hidden-scan": (ALONE, _hides_a_scan),
    "map-forgets": ((), _forgets),
    "truth-floor": ((), _sees_what_is_not_there),
    "truth-wall": ((), _sees_what_is_no_wall),
    "union-more": ((), _holds_more_than_there_is),
    "union-another": ((), _forwards_something_else),
    "union-too-much": ((), _forwards_too_much),
    "sight-line": (RADIOS["everywhere"], _minds_walls("radio.line_of_sight=true")),
    "sight-loss": (RADIOS["everywhere"], _minds_walls("radio.wall_loss_m=95")),
    "sight-shrunk": (
        RADIOS["everywhere"],
        _minds_walls("radio.wall_loss_m=9", "faults=[{kind = 'range', range_m = 20.0}]"),
    ),
    "finish": ((), _gives_up),
}


@pytest.mark.parametrize("radio", list(RADIOS))
@pytest.mark.parametrize("planner", PLANNERS)
def test_sound_record_breaks_no_rule(planner: str, radio: str) -> None:
    """Robots that keep the rules are not accused."""
    checker = check(explored(f"planner={planner}", *RADIOS[radio]))

    assert checker.violations == []
    assert checker.count == 0


def test_noise_is_no_lie() -> None:
    """With noise a scan may be wrong, and a robot may finish in error."""
    assert rules(explored("sensor.noise_m=0.4", "limit_s=20")) == set()


@pytest.mark.parametrize("name", list(BROKEN))
def test_broken_rule_is_named(name: str) -> None:
    """A record that breaks a rule is judged by violations of this rule, and of no other."""
    run, broken = BROKEN[name]
    records = explored(*run)

    assert rules(records) == set()
    also = {"speed"} if name == "wall-nowhere" else set()  # farther than a robot can go
    assert rules(broken(records)) == {name.partition("-")[0]} | also


def test_every_rule_can_be_broken() -> None:
    """No rule is without a record that breaks it."""
    assert listed(MapChecker) == {name.partition("-")[0] for name in BROKEN}


def test_frontier_may_be_called_none_from_beside_it() -> None:
    """A robot that stood there may say so, at any place of its log."""
    assert rules(_calls_near_frontier_none(explored(*ALONE))) == set()


def test_frontier_may_be_declared_dead_after_heading_for_it_in_vain() -> None:
    """A robot that has had the same goal for `planner.patience` steps may give it up from afar."""
    slow = (*ALONE, "vehicle.speed_m_s=4")
    records = explored(*slow)
    steps = step_records(records, "r1")
    first = next(
        i for i, step_record in enumerate(steps) if step_record.outputs and step_record.outputs.goal
    )
    step_record = steps[first + 1]
    assert step_record.outputs is not None
    assert step_record.outputs.goal is not None
    assert step_record.outputs.goal == steps[first].outputs.goal  # type: ignore[union-attr]
    cell = ROOMS.frame.cell_of(*step_record.outputs.goal)
    tells = logging([*own_log(step_record), dead_frontier(ROOMS.frame, cell)])
    given_up = put_step(records, step_record, says(lambda gossip: having(tells(gossip), r1=1)))

    def accused(records: Records) -> bool:
        return any("declares a frontier dead" in line for line in check(records).violations)

    assert accused(given_up)
    assert not accused(opened(given_up, scenario=on_map(*slow, "planner.patience=1")))


def test_rules_of_every_run_hold_on_maps() -> None:
    """A jump is against the speed limit, whatever is explored."""
    records = explored(*ALONE)
    jumps = put_step(records, step_records(records, "r1")[-1], goes(5.5, 10.5))

    assert "speed" in rules(jumps)


def test_violation_has_rule_time_participant_and_text() -> None:
    """A violation is one line."""
    violations = check(_forwards_something_else(explored())).violations

    assert violations[0].startswith("union: t=")
    assert violations[0].endswith("r1: forwards an entry at 0 of r2's log that r2 never sent")


def test_broken_record_is_counted_to_its_end() -> None:
    """A hundred violations are kept, all are counted."""
    records = explored()
    cells = np.where(ROOMS.cells == FREE, OCCUPIED, FREE).astype(np.uint8)
    checker = check(opened(records, ground=Array.of(cells)))

    assert len(checker.violations) == 100
    assert checker.count > 120


def test_mission_without_a_way_out_is_sound() -> None:
    """Robots shut into one cell each have finished as soon as they look around."""
    ground = drawn("#####", "#.#.#", "#####")
    scenario = on_map("starts.poses_m=[[1.5, 1.5], [3.5, 1.5]]")
    records: list[Record] = []
    play(scenario, 1, setup_of(scenario, ground), [records.append])

    assert rules(records) == set()


def test_opening_without_a_map_is_refused() -> None:
    """A record that cannot be judged is no crash later on."""
    with pytest.raises(RefusedError, match="no map in its opening"):
        check(opened(explored(), ground=None))


def test_checker_survives_messages_that_do_not_decode() -> None:
    """Whatever is in the logs, kernels stay inside their arrays."""
    records = explored()
    rng = np.random.default_rng(3)
    checker = Checker()
    pipeline = Pipeline(checker)
    for record in records:
        told = record
        if isinstance(record, Batch):
            step_records = tuple(
                says(
                    lambda gossip: msgspec.structs.replace(
                        gossip,
                        version_vector=rng.bytes(int(rng.integers(0, 9))),
                        logs=rng.bytes(int(rng.integers(0, 30))),
                    )
                )(step_record)
                for step_record in record.step_records
            )
            told = msgspec.structs.replace(record, step_records=step_records)
        pipeline.observe(told)

    assert checker.count > 0


PROCESS_FAULTS = {
    "robot forgets": "{kind='kill', who=['r2'], from_s=0.75, until_s=1.5, disk='lost'}",
    "robots forget twice": (
        "{kind='kill', who=['r2'], from_s=0.75, until_s=1.5, disk='lost'},"
        "{kind='kill', who=['r1', 'r2'], from_s=1.9, until_s=2.5, disk='torn'}"
    ),
    "world dies": (
        "{kind='kill', who=['worldsim'], from_s=0.75, until_s=1.5}, {kind='late', who=['r1'],"
        "until_s=0.6}, {kind='hostile', probability=0.5}"
    ),
}


@pytest.mark.parametrize("faults", PROCESS_FAULTS)
@pytest.mark.parametrize("planner", ["frontier", "kmeans"])
def test_process_faults_on_maps_break_no_rule(faults: str, planner: str) -> None:
    """A new incarnation begins with an empty map and a log of its own."""
    records = explored(f"faults=[{PROCESS_FAULTS[faults]}]", f"planner.name={planner}")

    assert check(records).violations == []


def test_supervisor_that_forgets_is_not_accused() -> None:
    """What its former incarnation held is not asked of it."""
    fault = "{kind='kill', who=['supervisor'], from_s=0.75, until_s=1.5, disk='torn'}"
    records = explored(f"faults=[{fault}]", "coordination=centralized")

    assert check(records).violations == []


def test_robot_that_goes_on_with_its_old_log_is_named() -> None:
    """Two incarnations never share a log."""
    fault = "{kind='kill', who=['r2'], from_s=0.75, until_s=1.5}"
    records = explored(f"faults=[{fault}]")
    start = next(r for r in records if isinstance(r, ProcessEvent) and r.kind == "start")
    renumbered = msgspec.structs.replace(start, incarnation=1)
    told = [renumbered if record is start else record for record in records]

    assert {"map", "epoch"} <= {each.partition(":")[0] for each in check(told).violations}
