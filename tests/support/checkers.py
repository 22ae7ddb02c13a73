"""The rules that a record breaks, and the rules that a checker has."""

import inspect
from collections.abc import Iterable

from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.record.records import Record


def rules(records: Iterable[Record]) -> set[str]:
    """The rules that a record breaks."""
    return {violation.partition(":")[0] for violation in check(records).violations}


def listed(checker: type) -> set[str]:
    """The rules that a checker's docstring lists. Python 3.13 takes its indentation off, earlier ones do not."""
    text = inspect.getdoc(checker)
    assert text is not None
    lines = text.partition("-----\n")[2].splitlines()
    return {line.split()[0] for line in lines if line[:1].isalpha()}
