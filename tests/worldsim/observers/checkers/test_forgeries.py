"""The rule on forgeries: a participant refuses what is forged and nothing else, and only a fault forges."""

from collections.abc import Callable

import msgspec
import pytest

from kantor_protocol.base.machine import Envelope
from kantor_worldsim.record.records import Record
from support.broken_records import (
    BrokenRecord,
    BrokenRecords,
    outputs,
    put,
    put_step,
    with_faults,
)
from support.records import Records, batches, step_records
from support.variants import HOSTILE

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


@breaks("refusal")
def _refuses_a_sound_message(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[-1], outputs(refused=1))


@breaks("refusal", run=HOSTILE)
def _accepts_a_forgery(records: Records) -> list[Record]:
    refused = max(step_record.outputs.refused for step_record in step_records(records, "r1"))
    accepting = next(
        step_record
        for step_record in step_records(records, "r1")
        if step_record.outputs.refused == refused
    )
    return put_step(records, accepting, outputs(refused=refused - 1))


@breaks("refusal", run=HOSTILE)
def _forged_without_a_fault(records: Records) -> list[Record]:
    return with_faults(records)


@breaks("refusal", run=HOSTILE)
def _forged_under_a_number_that_is_sent(records: Records) -> list[Record]:
    batch = next(batch for batch in batches(records) if batch.injected)
    more = (*batch.injected, Envelope("r1", 3, "", b""))
    return put(records, batch, msgspec.structs.replace(batch, injected=more))


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])
