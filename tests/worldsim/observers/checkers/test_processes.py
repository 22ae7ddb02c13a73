"""Rules on processes: their events and wrong clocks are those that faults cause, and none acts while it is stopped."""

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from kantor_protocol.scenario.faults.processes import Kill
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.record.records import Batch, ProcessEvent, Record
from support.broken_records import (
    BrokenRecord,
    BrokenRecords,
    fields,
    gossip,
    outputs,
    put,
    put_step,
    with_faults,
)
from support.records import Records, batches, process_events, step_records
from support.variants import (
    CLOCK_WRONG,
    DISK_FULL,
    DISK_LOST,
    IMPOSTOR,
    KILLED,
    LATE,
    MERGES,
    OUT_OF_RANGE,
    PAUSED,
    WORLD_SIM_KILLED,
)

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


def change_event(records: Records, of_kind: str, **values: Any) -> list[Record]:
    """The records with the first process event of a kind changed."""
    event = process_events(records, of_kind)[0]
    return put(records, event, msgspec.structs.replace(event, **values))


def delay_event(records: Records, kind: str) -> list[Record]:
    """The records with a process event that comes only after the next batch with a step."""
    event = process_events(records, kind)[0]
    at = list(records).index(event)
    after = next(
        i for i, r in enumerate(records) if i > at and isinstance(r, Batch) and r.step_records
    )
    later = msgspec.structs.replace(event, now_ns=records[after].now_ns)  # type: ignore[union-attr]
    return [*records[:at], *records[at + 1 : after + 1], later, *records[after + 1 :]]


# Causes of process events.


@breaks("incident")
def _no_fault_causes_the_event(records: Records) -> list[Record]:
    event = ProcessEvent(batches(records)[7].now_ns, "r1", ProcessEventKind.SLOW)
    return [*records[:9], event, *records[9:]]


@breaks("incident")
def _event_of_an_unknown_participant(records: Records) -> list[Record]:
    event = ProcessEvent(batches(records)[7].now_ns, "r9", ProcessEventKind.LEAVE)
    return [*records[:9], event, *records[9:]]


@breaks("incident", run=IMPOSTOR)
def _event_of_another_process(records: Records) -> list[Record]:
    return change_event(records, "pretend", who="r1")


@breaks("incident", run=IMPOSTOR)
def _event_comes_too_early(records: Records) -> list[Record]:
    event = process_events(records)[0]
    early = msgspec.structs.replace(event, now_ns=0)
    return [records[0], early, *(record for record in records[1:] if record is not event)]


@breaks("incident", run=IMPOSTOR)
def _event_comes_twice(records: Records) -> list[Record]:
    event = process_events(records)[0]
    at = list(records).index(event)
    return [*records[:at], event, *records[at:]]


@breaks("incident", run=IMPOSTOR)
def _event_never_comes(records: Records) -> list[Record]:
    return [record for record in records if record is not process_events(records)[0]]


# Processes that are stopped.


@breaks("dead", run=PAUSED)
def _steps_while_it_is_paused(records: Records) -> list[Record]:
    return delay_event(records, "resume")


@breaks("dead", run=DISK_FULL)
def _steps_while_its_disk_is_full(records: Records) -> list[Record]:
    return delay_event(records, "free")


@breaks("dead", run=(*LATE, *OUT_OF_RANGE))
def _steps_before_it_has_joined(records: Records) -> list[Record]:
    return stepping_before_the_start(records)


@breaks("dead", run=(*KILLED, *OUT_OF_RANGE))
def _steps_while_it_is_dead(records: Records) -> list[Record]:
    return stepping_before_the_start(records)


def stepping_before_the_start(records: Records) -> list[Record]:
    """The records with a start that comes after a step."""
    start = process_events(records, "start")[0]
    first = next(s for s in step_records(records, "r2") if s.now_ns > start.now_ns)
    return change_event(delay_event(records, "start"), "start", step=first.outputs.step)


@breaks("dead", run=WORLD_SIM_KILLED)
def _world_sim_decides_while_it_is_down(records: Records) -> list[Record]:
    return delay_event(records, "start")


# Incarnations.


@breaks("epoch", run=DISK_LOST)
def _new_incarnation_with_its_disk_kept(records: Records) -> list[Record]:
    return with_faults(records, Kill(who=("r2",), from_s=0.5, until_s=1.1))


@breaks("epoch", run=KILLED)
def _same_incarnation_after_a_lost_disk(records: Records) -> list[Record]:
    return with_faults(records, Kill(who=("r2",), from_s=0.5, until_s=1.1, disk="lost"))


@breaks("epoch", "weights", "ledger", run=KILLED)
def _new_incarnation_with_what_the_former_one_held(records: Records) -> list[Record]:
    return change_event(_same_incarnation_after_a_lost_disk(records), "start", incarnation=1)


@breaks("epoch", run=KILLED)
def _goes_on_from_a_later_step(records: Records) -> list[Record]:
    return change_event(records, "start", step=process_events(records, "start")[0].step + 2)


@breaks("order", "epoch", "hold", run=DISK_LOST)
def _new_incarnation_counts_steps_from_one(records: Records) -> list[Record]:
    steps, again = 0, change_event(records, "start", step=0)
    for step_record in step_records(records, "r2"):
        if step_record.now_ns > 1_100_000_000:
            steps += 1
            again = put_step(again, step_record, outputs(step=steps))
    return again


@breaks("epoch")
def _sends_as_another_incarnation(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_step(records, step_record, gossip(step_record, incarnation=1))


@breaks("epoch", run=MERGES["min"])
def _sends_as_another_incarnation_without_a_ledger(records: Records) -> list[Record]:
    return _sends_as_another_incarnation(records)


@breaks("epoch", run=IMPOSTOR)
def _impostor_is_admitted(records: Records) -> list[Record]:
    return change_event(records, "pretend", kind=ProcessEventKind.IMPOSTOR_ADMITTED)


# Clocks.


@breaks("clock")
def _clock_is_wrong_without_a_fault(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[5], fields(skew_ns=1))


@breaks("clock", run=CLOCK_WRONG)
def _clock_is_less_wrong_than_its_fault_makes_it(records: Records) -> list[Record]:
    step_record = next(
        step_record for step_record in step_records(records, "r2") if step_record.skew_ns
    )
    return put_step(records, step_record, fields(skew_ns=step_record.skew_ns - 1))


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])
