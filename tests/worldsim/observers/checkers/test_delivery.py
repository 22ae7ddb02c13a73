"""The rule on deliveries: an inbox holds what was sent, decided and due, once and in order."""

from collections.abc import Callable

import msgspec
import pytest

from kantor_worldsim.radio.channel import DROPPED, DeliveryDecision
from kantor_worldsim.record.records import Record
from support.broken_records import (
    BrokenRecord,
    BrokenRecords,
    add_decision,
    heard,
    outputs,
    put,
    put_step,
)
from support.records import Records, batches, step_records
from support.variants import KILLED, KILLED_MID_STEP, OUT_OF_RANGE

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


# What a participant receives.


@breaks("delivery", run=OUT_OF_RANGE)
def _receives_what_the_radio_did_not_deliver(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[5], heard(("r2", 5)))


@breaks("delivery")
def _receives_an_envelope_twice(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_step(records, step_record, heard(*step_record.heard, step_record.heard[0]))


@breaks("delivery")
def _receives_an_envelope_again_later(records: Records) -> list[Record]:
    early, late = step_records(records, "r1")[5:7]
    return put_step(records, late, heard(*late.heard, *early.heard))


@breaks("delivery", run=("radio.delay_s=0.25",))
def _receives_an_envelope_before_it_is_due(records: Records) -> list[Record]:
    early, late = step_records(records, "r1")[3:5]
    swapped = put_step(records, early, heard(*early.heard, late.heard[0]))
    return put_step(swapped, late, heard(*late.heard[1:]))


@breaks("delivery")
def _does_not_receive_what_had_arrived(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_step(records, step_record, heard(*step_record.heard[1:]))


@breaks("delivery")
def _receives_envelopes_out_of_order(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    return put_step(records, step_record, heard(*reversed(step_record.heard)))


@breaks("delivery", run=KILLED)
def _receives_what_arrived_while_it_was_dead(records: Records) -> list[Record]:
    step_record = next(
        step_record
        for step_record in step_records(records, "r2")
        if step_record.now_ns > 1_100_000_000
    )
    lost = next(
        (decision.source, decision.sequence)
        for batch in batches(records)
        for decision in batch.decisions
        if decision.target == "r2" and decision.due_ns == 600_000_000
    )
    return put_step(records, step_record, heard(lost, *step_record.heard))


@breaks("delivery", run=KILLED_MID_STEP)
def _steps_without_what_its_step_request_carried(records: Records) -> list[Record]:
    step_record = next(
        step_record
        for step_record in step_records(records, "r2")
        if step_record.now_ns == 500_000_000 and step_record.outputs
    )
    return put_step(records, step_record, heard(*step_record.heard[1:]))


# What the radio decides, and what a participant sends.


@breaks("delivery")
def _received_envelope_was_dropped(records: Records) -> list[Record]:
    batch = batches(records)[3]
    dropped = msgspec.structs.replace(batch.decisions[0], due_ns=DROPPED)
    decisions = (dropped, *batch.decisions[1:])
    return put(records, batch, msgspec.structs.replace(batch, decisions=decisions))


@breaks("delivery", run=("radio.duplicate=0.999",))
def _receives_more_copies_than_were_decided(records: Records) -> list[Record]:
    batch = batches(records)[3]
    return put(records, batch, msgspec.structs.replace(batch, decisions=batch.decisions[1:]))


@breaks("delivery")
def _delivered_what_was_never_sent(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_decision(records, first, DeliveryDecision("r1", 77, "r2", first.now_ns))


@breaks("delivery")
def _delivered_to_an_unknown_participant(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_decision(records, first, DeliveryDecision("r1", 1, "r9", first.now_ns))


@breaks("delivery", run=("coordination=centralized",))
def _delivered_to_another_target(records: Records) -> list[Record]:
    first = batches(records)[0]
    return add_decision(records, first, DeliveryDecision("r1", 1, "r2", first.now_ns))


@breaks("delivery", run=OUT_OF_RANGE)
def _uses_a_sequence_number_twice(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    (envelope,) = step_record.outputs.outbox
    again = msgspec.structs.replace(envelope, sequence=2)
    return put_step(records, step_record, outputs(outbox=(again,)))


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])
