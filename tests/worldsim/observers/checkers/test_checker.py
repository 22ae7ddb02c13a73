"""The checker as a whole: the order of records, the count of violations, and no rule without a record that breaks it."""

from collections.abc import Callable

import msgspec
import pytest

from kantor_worldsim.observers.checkers.checker import Checker, check
from kantor_worldsim.observers.checkers.lies import LiarChecker
from kantor_worldsim.record.records import Record
from support.broken_records import BrokenRecord, BrokenRecords, put
from support.checkers import listed
from support.records import Play, Records, batches
from support.variants import OUT_OF_RANGE
from worldsim.observers.checkers import (
    test_conservation,
    test_delivery,
    test_forgeries,
    test_lies,
    test_links,
    test_motion,
    test_processes,
    test_registers,
    test_replication,
)

BROKEN = BrokenRecords()
breaks = BROKEN.breaks

ALL_BROKEN = (
    BROKEN,
    test_conservation.BROKEN,
    test_delivery.BROKEN,
    test_forgeries.BROKEN,
    test_lies.BROKEN,
    test_links.BROKEN,
    test_motion.BROKEN,
    test_processes.BROKEN,
    test_registers.BROKEN,
    test_replication.BROKEN,
)
"""The broken records of every file of this folder."""

BROKEN_BY_ROWS = {"bound"}
"""Rules on rows of metrics, which no record breaks: see `test_wasserstein_exact.py`."""


@breaks("order", run=OUT_OF_RANGE)
def _time_runs_back(records: Records) -> list[Record]:
    batch = batches(records)[4]
    return put(records, batch, msgspec.structs.replace(batch, now_ns=batch.now_ns - 300_000_000))


@breaks("order")
def _no_opening(records: Records) -> list[Record]:
    return list(records[1:])


@breaks("order")
def _second_opening(records: Records) -> list[Record]:
    return [records[0], *records]


@breaks("order")
def _batch_after_the_ending(records: Records) -> list[Record]:
    return [*records, records[-2]]


@breaks("order")
def _second_ending(records: Records) -> list[Record]:
    return [*records, records[-1]]


@pytest.mark.parametrize("name", list(BROKEN.cases))
def test_broken_rule_is_named(judge: Callable[[BrokenRecord], None], name: str) -> None:
    """A record that breaks a rule brings violations that name this rule, and no other."""
    judge(BROKEN.cases[name])


def test_every_rule_can_be_broken() -> None:
    """No rule of the checker is without a record that breaks it."""
    rules = listed(Checker) | listed(LiarChecker)
    assert rules - {"silence"} == BROKEN_BY_ROWS.union(*(broken.rules() for broken in ALL_BROKEN))


def test_broken_record_is_counted_to_its_end(played: Play) -> None:
    """A hundred violations are kept, all are counted."""
    records = played()
    checker = check([*records, *(records[-1] for _ in range(150))])

    assert (len(checker.violations), checker.count) == (100, 150)
