"""Rules on links: nothing is delivered beyond the range, or over a link that a fault cuts."""

from collections.abc import Callable

import msgspec
import pytest

from kantor_protocol.base.machine import SUPERVISOR
from kantor_protocol.scenario.faults.links import Partition, Range
from kantor_worldsim.radio.channel import DROPPED, DeliveryDecision
from kantor_worldsim.record.records import Batch, Record, StepRecord
from support.broken_records import (
    LATE_NS,
    BrokenRecord,
    BrokenRecords,
    add_decision,
    put,
    with_faults,
    with_scenario,
)
from support.records import Records, batches
from support.variants import RADIOS

SHORTER = ("faults=[{kind = 'range', range_m = 75.0, until_s = 0.15}]",)
HALVES = ("faults=[{kind = 'partition', shape = 'halves', until_s = 0.15}]",)
FLAPPING = ("faults=[{kind = 'partition', shape = 'halves', flap_s = 0.2}]",)
ONE_WAY = ("faults=[{kind = 'one-way', senders = ['r1'], receivers = ['r3']}]",)

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


# Range.


@breaks("range", run=RADIOS["short"])
def _delivered_beyond_the_range(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_decision(records, first, DeliveryDecision("r1", 1, "r2", LATE_NS))


@breaks("range", run=("coordination=centralized", "supervisor.range_m=20"))
def _delivered_to_a_far_supervisor(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_decision(records, first, DeliveryDecision("r1", 1, SUPERVISOR, LATE_NS))


@breaks("range")
def _range_of_robots_is_shorter(records: Records) -> list[Record]:
    return with_scenario(records, radio={"range_m": 50.0})


@breaks("range", run=("coordination=centralized",))
def _range_of_the_supervisor_is_shorter(records: Records) -> list[Record]:
    return with_scenario(records, supervisor={"range_m": 5.0})


@breaks("range", run=SHORTER)
def _delivered_beyond_the_range_that_a_fault_leaves(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_decision(records, first, DeliveryDecision("r1", 1, "r2", LATE_NS))


@breaks("range")
def _fault_shortens_the_range_of_robots(records: Records) -> list[Record]:
    return with_faults(records, Range(range_m=50.0, from_s=0.5))


@breaks("range", run=("coordination=centralized", "supervisor.range_m=100"))
def _fault_shortens_the_range_of_the_supervisor(records: Records) -> list[Record]:
    return with_faults(records, Range(factor=0.25, robots=("r2",)))


# Cut links.


def first_drop_delivered(records: Records) -> list[Record]:
    """The records with the first drop as a delivery."""
    batch = next(b for b in batches(records) if any(d.due_ns == DROPPED for d in b.decisions))
    dropped = next(d for d in batch.decisions if d.due_ns == DROPPED)
    delivered = msgspec.structs.replace(dropped, due_ns=LATE_NS)
    decisions = tuple(delivered if d is dropped else d for d in batch.decisions)
    return put(records, batch, msgspec.structs.replace(batch, decisions=decisions))


@breaks("cut", run=HALVES)
def _delivered_across_a_partition(records: Records) -> list[Record]:
    return first_drop_delivered(records)


@breaks("cut", run=FLAPPING)
def _delivered_across_a_partition_that_flaps(records: Records) -> list[Record]:
    return first_drop_delivered(records)


@breaks("cut", run=ONE_WAY)
def _delivered_against_a_one_way_link(records: Records) -> list[Record]:
    return first_drop_delivered(records)


@breaks("cut", run=HALVES)
def _partition_lasts_longer(records: Records) -> list[Record]:
    return with_faults(records, Partition(shape="halves", until_s=0.25))


@breaks("cut")
def _replayed_across_a_partition(records: Records) -> list[Record]:
    """r3 is cut off in the fifth batch, and an envelope of r1 reaches it there a second time."""
    fifth = batches(records)[4]
    cut = Partition(shape="isolate", robots=("r3",), from_s=0.45, until_s=0.55)
    apart = msgspec.structs.replace(
        fifth, decisions=tuple(d for d in fifth.decisions if "r3" not in (d.source, d.target))
    )
    isolated = put(records, fifth, apart)
    sixth = batches(isolated)[5]
    steps = tuple(only_delivered(step_record, apart) for step_record in sixth.step_records)
    isolated = put(isolated, sixth, msgspec.structs.replace(sixth, step_records=steps))
    replay = DeliveryDecision("r1", 2, "r3", LATE_NS)
    return add_decision(with_faults(isolated, cut), apart, replay)


def only_delivered(step_record: StepRecord, batch: Batch) -> StepRecord:
    """The step record without what a batch did not deliver to its participant."""
    delivered = {(d.source, d.sequence) for d in batch.decisions if d.target == step_record.name}
    return msgspec.structs.replace(
        step_record, heard=tuple(ref for ref in step_record.heard if ref in delivered)
    )


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])
