"""Logs of bare entries: replicated as a ledger is, without weights (missions with a map)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.replication.replica import Replica
from support.replication.replicas import entries, read_logs
from support.strategies import examples

BOUND = 50


def replica(me: int, origins: int = 3, *, relay: bool = False, timeout_steps: int = 2) -> Replica:
    """Of entries below 50."""
    return Replica(
        me,
        origins,
        BOUND,
        None,
        ledger=True,
        claims=False,
        relay=relay,
        ack_timeout_steps=timeout_steps,
    )


def log(held: Replica, origin: int) -> list[int]:
    """The entries that a replica holds of an origin's log."""
    return [index for index, _ in entries(held, origin)]


def test_an_entry_is_one_number_on_the_air() -> None:
    """Origin, start, span, count; then a folded difference for each, and no values."""
    one = replica(0, 2)
    one.append(np.array([7, 8, 5]))
    version_vector, logs, claims = one.compose(1)

    assert (version_vector, logs, claims) == (bytes([3, 0]), bytes([0, 0, 3, 3, 14, 2, 5]), b"")
    rows = read_logs(logs, valued=False)
    assert rows is not None
    assert rows[:, :3].tolist() == [[0, 0, 7], [0, 1, 8], [0, 2, 5]]


def test_nothing_is_repeated_before_an_answer_is_due() -> None:
    """There are dozens of entries a step: they go out once, and again only without an acknowledgement."""
    one, two = replica(0, 2), replica(1, 2)
    assert one.merge(1, *two.compose())
    one.append(np.array([3, 4]))
    sizes = []
    for _ in range(4):
        sizes.append(len(one.compose()[1]))
        one.end_step()

    assert sizes[0] > 0
    assert sizes[1] == 0
    assert max(sizes[2:]) > 0


@pytest.mark.parametrize(
    "logs",
    [
        bytes([1, 0, 1, 1, 2 * BOUND]),
        bytes([1, 0, 2, 2, 4]),
        bytes([1, 0, 1, 1, 1]),
        bytes([3, 0, 1, 1, 4]),
        bytes([1, 0, 2, 1, 4]),
    ],
    ids=["beyond", "cut", "negative", "stranger", "gap"],
)
def test_what_is_malformed_changes_nothing(logs: bytes) -> None:
    """A message is taken in whole or not at all."""
    held = replica(0)

    assert not held.merge(1, bytes(3), logs, b"")
    assert log(held, 1) == []


@examples(60)
@given(
    written=st.lists(
        st.tuples(st.integers(0, 2), st.lists(st.integers(0, BOUND - 1), max_size=40)), max_size=12
    ),
    lost=st.sets(st.integers(0, 80)),
)
def test_all_end_with_all_logs(written: list[tuple[int, list[int]]], lost: set[int]) -> None:
    """In a row, where the ends never hear each other, whatever is lost: in the end all hold all."""
    made = [replica(me) for me in range(3)]
    truth: list[list[int]] = [[], [], []]
    message = 0
    for step in range(len(written) + 60):
        if step < len(written):
            who, entries = written[step]
            made[who].append(np.array(entries, dtype=np.int64))
            truth[who] += entries
        said = [held.compose() for held in made]
        for source, word in enumerate(said):
            made[source].end_step()
            for target in (source - 1, source + 1):
                message += 1
                if 0 <= target < 3 and message not in lost:
                    assert made[target].merge(source, *word)

    for held in made:
        assert [log(held, origin) for origin in range(3)] == truth
