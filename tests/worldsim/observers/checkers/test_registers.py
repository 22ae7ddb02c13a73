"""The rule on registers: the sums that a spectral robot sends are those over the places where it chose."""

from collections.abc import Callable

import msgspec
import pytest

from kantor_protocol.base.machine import Pose
from kantor_protocol.replication.cosine_basis import VISIT
from kantor_protocol.replication.registers import read_register
from kantor_worldsim.record.records import Record
from support.broken_records import BrokenRecord, BrokenRecords, fields, gossip, put_step
from support.records import Records, gossip_of, own_register, step_records, uints
from support.variants import DISK_LOST, SPECTRAL

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


@breaks("register", run=SPECTRAL)
def _counts_a_place_where_it_was_not(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    moved = msgspec.structs.replace(step_record.observation, pose=Pose(1.0, 2.0))
    return put_step(records, step_record, fields(observation=moved))


@breaks("register", run=SPECTRAL)
def _sends_sums_that_are_not_its_own(records: Records) -> list[Record]:
    step_record = [
        step_record for step_record in step_records(records, "r1") if own_register(step_record)
    ][-1]
    sums = bytes([0]) + bytes([own_register(step_record)]) + uints(2 * VISIT, *[0] * 8)
    return put_step(records, step_record, gossip(step_record, registers=bytes(3) + sums))


@breaks("register", run=SPECTRAL)
def _says_that_it_wrote_more_often(records: Records) -> list[Record]:
    step_record = [
        step_record for step_record in step_records(records, "r1") if own_register(step_record)
    ][-1]
    sent = gossip_of(step_record).registers
    before, stamp, rest = sent[:4], sent[4], sent[5:]
    more = before + bytes([stamp + 1]) + rest
    return put_step(records, step_record, gossip(step_record, registers=more))


@breaks("register", run=SPECTRAL)
def _sends_registers_that_do_not_decode(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[3]
    return put_step(records, step_record, gossip(step_record, registers=b"\x80"))


@breaks("register", run=(*DISK_LOST, *SPECTRAL))
def _goes_on_with_the_sums_of_its_former_incarnation(records: Records) -> list[Record]:
    step_record = next(
        step_record
        for step_record in reversed(step_records(records, "r2"))
        if own_register(step_record, 6, 4)
    )
    _, sums = read_register(gossip_of(step_record).registers, 6, 9, 4) or (0, [])
    writes = own_register(step_record, 6, 4)
    register = uints(0, 0, 0, 0, 0, 0, 4, writes, 1, 2 * (sums[0] + VISIT))
    return put_step(records, step_record, gossip(step_record, registers=register))


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])
