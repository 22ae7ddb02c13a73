"""The index of deliveries: the same rows as a plain search finds, whatever comes and goes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kantor_worldsim.observers.checkers.delivery_index import (
    add_to_index,
    first_slot,
    index_deliveries,
    next_slot,
    remove_row,
)
from kantor_worldsim.observers.checkers.state import DELIVERY
from support.strategies import examples

ROOM = 16
NUMBERS = st.integers(-2, 3), st.integers(0, 4) | st.integers(0, 2**62)
CHANGES = st.lists(st.tuples(st.booleans(), *NUMBERS), max_size=120)


def found(deliveries: np.ndarray, slots: np.ndarray, source: int, sequence: int) -> list[int]:
    """The rows of a source and sequence, by the index."""
    rows, slot = [], first_slot(source, sequence, slots)
    while slots[slot] != 0:
        row = int(slots[slot]) - 1
        rows += [row] if deliveries[row].tolist()[:2] == (source, sequence) else []
        slot = next_slot(slot, slots)
    return sorted(rows)


@given(CHANGES)
@examples(300)
def test_the_index_finds_what_a_search_finds(changes: list[tuple[bool, int, int]]) -> None:
    """After any additions and removals, and after it was made anew; copies are found, all of them."""
    deliveries = np.zeros(ROOM, dtype=DELIVERY)
    slots = np.zeros(2 * ROOM, dtype=np.int64)
    count = 0
    for adds, source, sequence in changes:
        if adds and count < ROOM:
            deliveries[count] = source, sequence, 0, 0
            add_to_index(deliveries, slots, count)
            count += 1
        elif not adds and count:
            count -= 1
            remove_row(deliveries, slots, sequence % (count + 1), count)
        keys = {row[:2] for row in deliveries[:count].tolist()} | {(source, sequence)}
        for key in keys:
            expected = [i for i in range(count) if deliveries[i].tolist()[:2] == key]
            assert found(deliveries, slots, *key) == expected
    again = np.zeros_like(slots)
    index_deliveries(deliveries, again, count)
    assert np.count_nonzero(again) == np.count_nonzero(slots) == count
