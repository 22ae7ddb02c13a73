"""What has been sent, as runs of numbers: the same envelopes as a dictionary of them holds."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kantor_fleet.scenarios.catalog import find
from kantor_worldsim.observers.checkers.delivery import find_posted, insert_posted, target_of
from kantor_worldsim.observers.checkers.state import CheckerState
from kantor_worldsim.record.columnar import ALL_PLACES, UNKNOWN_PLACE
from kantor_worldsim.record.records import opening_of
from kantor_worldsim.world.world import WorldSetup
from support.strategies import examples

NUMBERS = st.lists(st.tuples(st.integers(0, 12), st.integers(-1, 2)), max_size=20)


def begun() -> CheckerState:
    """The state at the start of a small mission."""
    scenario = find("fleet", ("samples.count=10", "energy.points=10", "energy.steps=10"))
    return CheckerState.of(opening_of(scenario, 0, WorldSetup.of(scenario, 0), {}))


STATE = begun()


def runs() -> list[list[int]]:
    """The runs of the first participant."""
    count = int(STATE.participants[0]["posted"])
    return [list(run) for run in STATE.posted[0, :count].tolist()]


@given(NUMBERS)
@examples(300)
def test_runs_hold_what_was_sent(sent: list[tuple[int, int]]) -> None:
    """In any order, also numbers that are used again: then the last envelope counts."""
    STATE.participants["posted"] = 0
    plain: dict[int, int] = {}
    for sequence, target in sent:
        insert_posted(STATE, 0, sequence, target)
        plain[sequence] = target

    for sequence in range(-1, 15):
        assert (find_posted(STATE, 0, sequence) >= 0) == (sequence in plain)
        assert target_of(STATE, 0, sequence) == plain.get(sequence, UNKNOWN_PLACE)
    numbers = [number for first, last, _ in runs() for number in range(first, last + 1)]
    assert numbers == sorted(plain)


def test_who_talks_to_everybody_needs_one_row() -> None:
    """However long it does; and another one when it turns to the supervisor."""
    STATE.participants["posted"] = 0
    for sequence in np.arange(1, 2000).tolist():
        insert_posted(STATE, 0, sequence, ALL_PLACES if sequence < 1000 else 5)

    assert runs() == [[1, 999, ALL_PLACES], [1000, 1999, 5]]
