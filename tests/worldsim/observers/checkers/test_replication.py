"""The rule on ledgers: what a participant sends and holds of a log is what its origin has consumed."""

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from kantor_protocol.wire.version_vector import read_version_vector
from kantor_worldsim.record.records import Record
from support.broken_records import BrokenRecord, BrokenRecords, gossip, outputs, put_step
from support.records import (
    Records,
    consumed,
    entries,
    gossip_of,
    pairs,
    step_records,
    uints,
)
from support.replication.replicas import read_logs
from support.variants import DISK_LOST

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


# The logs in messages.


@breaks("ledger")
def _sends_another_log_than_it_consumed(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[0]
    (sample, units), *_ = entries(step_record.outputs.spent)
    log = uints(0, 0, 1, 1) + pairs((sample, units % 2 + 1))
    return put_step(records, step_record, gossip(step_record, logs=log))


@breaks("ledger")
def _sends_entries_that_it_never_made(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[0]
    log = uints(0, 500, 1, 1) + pairs((0, 1))
    return put_step(records, step_record, gossip(step_record, logs=log))


@breaks("ledger")
def _forwards_entries_that_their_origin_never_made(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    log = uints(1, 0, 1, 1) + pairs((59, 1))
    return put_step(records, step_record, gossip(step_record, logs=log))


@breaks("ledger")
def _sends_a_body_that_does_not_decode(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    (envelope,) = step_record.outputs.outbox
    garbled = msgspec.structs.replace(envelope, body=b"\xc1")
    return put_step(records, step_record, outputs(outbox=(garbled,)))


@breaks("ledger")
def _sends_logs_that_do_not_decode(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    return put_step(records, step_record, gossip(step_record, logs=b"\x80"))


def test_logs_in_messages_are_read_as_rows() -> None:
    """A suffix is origin, start, span, count and packed pairs."""
    log = uints(1, 7, 2, 2) + pairs((3, 2), (1, 1))
    rows = read_logs(log)

    assert rows is not None
    assert rows.tolist() == [[1, 7, 3, 2], [1, 8, 1, 1]]


# Version vectors.


@breaks("ledger")
def _holds_more_of_a_log_than_there_is(records: Records) -> list[Record]:
    last = step_records(records, "r1")[-1]
    sent = gossip_of(last).version_vector
    own, *others = read_version_vector(sent, 3) or []
    stamps = sent[len(uints(own, *others)) :]
    more = uints(own, others[0] + 1, others[1]) + stamps
    return put_step(records, last, gossip(last, version_vector=more))


@breaks("ledger", run=DISK_LOST)
def _forgets_the_log_of_its_former_incarnation(records: Records) -> list[Record]:
    last = step_records(records, "r2")[-1]
    sent = gossip_of(last).version_vector
    lengths = read_version_vector(sent, 6) or []
    stamps = sent[len(uints(*lengths)) :]
    less = uints(lengths[0], 0, *lengths[2:]) + stamps
    return put_step(records, last, gossip(last, version_vector=less))


@breaks("ledger")
def _holds_entries_of_an_unknown_incarnation(records: Records) -> list[Record]:
    last = step_records(records, "r1")[-1]
    lengths = read_version_vector(gossip_of(last).version_vector, 3) or []
    invented = uints(*lengths, 1, 0, 0, *([0] * 6))
    return put_step(records, last, gossip(last, version_vector=invented))


# Spending, logs and weights agree.


@breaks("ledger", "weights")
def _ends_with_more_than_its_logs_leave(records: Records) -> list[Record]:
    step_record = [
        step_record for step_record in step_records(records, "r1") if step_record.outputs.lowered
    ][-1]
    return put_step(records, step_record, outputs(lowered=b""))


@breaks("ledger", "credit")
def _consumes_another_sample_than_its_log_says(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[0]
    other = int(np.argmin(consumed(records, step_record.now_ns)))
    (_, units), *rest = entries(step_record.outputs.spent)
    return put_step(records, step_record, outputs(spent=pairs((other, units), *rest)))


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])
