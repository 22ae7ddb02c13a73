"""The judgement of a broken record, which the tests of all rules share."""

from collections.abc import Callable

import pytest

from support.broken_records import BrokenRecord
from support.checkers import rules
from support.records import Play


@pytest.fixture
def judge(played: Play) -> Callable[[BrokenRecord], None]:
    """Require that a record breaks no rule as it was played, and then exactly the rules of the case."""

    def judge(case: BrokenRecord) -> None:
        records = played(*case.run)

        assert rules(records) == set()
        assert rules(case.break_record(records)) == case.rules

    return judge
