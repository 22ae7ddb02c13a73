"""Malformed messages are refused whole, and a refused message changes nothing."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.replication.replica import Replica
from support.references.plain_gossip import Message, claim, suffix, version_vector
from support.replication.small_replicas import (
    MODES,
    UNITS,
    N,
    replica,
    snapshot,
    spend_each,
    weights_of,
)
from support.strategies import examples


def replica_with_message(*, ledger: bool, claims: bool) -> tuple[Replica, Message]:
    """A replica with a past, and a sound message for it from participant 1."""
    a, b = (replica(i, 3, ledger=ledger, claims=claims) for i in range(2))
    spend_each(a, [(0, 1), (3, 2)])
    spend_each(b, [(3, 1), (4, 2), (5, 3)])
    b.claim(5, 100)
    a.claim(2, 90)
    b.merge(0, *a.compose())
    a.merge(1, *b.compose())
    spend_each(b, [(0, 2), (1, 3)])
    b.end_step()
    b.claim(1, 200)
    return a, b.compose()


@pytest.mark.parametrize("claims", [True, False])
@MODES
@examples(150)
@given(data=st.data())
def test_malformed_message_changes_nothing_at_all(
    *, ledger: bool, claims: bool, data: st.DataObject
) -> None:
    """A message is checked whole before any of it is applied; any bytes are survived."""
    held, sound = replica_with_message(ledger=ledger, claims=claims)
    parts = [data.draw(st.just(part) | st.binary(max_size=40)) for part in sound]
    before, weights = snapshot(held), weights_of(held)
    taken = held.merge(1, *parts)

    if not taken:
        assert snapshot(held) == before
    assert all(new <= old for new, old in zip(weights_of(held), weights, strict=True))
    held.compose()
    held.end_step()


@pytest.mark.parametrize("claims", [True, False])
@MODES
@examples(150)
@given(part=st.integers(0, 2), at=st.integers(0, 100), byte=st.integers(0, 255))
def test_damaged_message_is_taken_whole_or_not_at_all(
    *, ledger: bool, claims: bool, part: int, at: int, byte: int
) -> None:
    """One byte changed: if the message is refused, no other part of it was applied."""
    held, sound = replica_with_message(ledger=ledger, claims=claims)
    parts = [bytearray(content) for content in sound]
    if parts[part]:
        parts[part][at % len(parts[part])] = byte
    before = snapshot(held)
    if not held.merge(1, *map(bytes, parts)):
        assert snapshot(held) == before


@pytest.mark.parametrize("part", [0, 1, 2])
@MODES
def test_cut_message_changes_nothing_at_all(*, ledger: bool, part: int) -> None:
    """The last byte of any part is missing: the whole message is refused."""
    held, sound = replica_with_message(ledger=ledger, claims=True)
    parts = [content[:-1] if i == part else content for i, content in enumerate(sound)]
    before = snapshot(held)

    assert not held.merge(1, *parts)
    assert snapshot(held) == before
    assert held.merge(1, *sound)


MALFORMED_LOGS = {
    "origin-outside-the-roster": suffix(3, 0, [(0, 1)]),
    "sample-outside": suffix(1, 0, [(N, 1)]),
    "sample-below-0": suffix(1, 0, [(-1, 1)]),
    "more-units-than-can-be": suffix(1, 0, [(0, UNITS.sample + 1)]),
    "fewer-entries-than-counted": suffix(1, 0, [(0, 1), (1, 1)])[:-2],
    "more-entries-than-the-span": suffix(1, 0, [(0, 1), (1, 1)], span=1),
    "log-of-impossible-length": suffix(1, 1 << 41, [(0, 1)]),
    "second-suffix-cut": suffix(1, 0, [(0, 1)]) + b"\x01",
}


@pytest.mark.parametrize("name", MALFORMED_LOGS)
@MODES
def test_malformed_suffix_is_refused(*, ledger: bool, name: str) -> None:
    """Every number in a suffix is checked against what can be."""
    held = replica(0, 3, ledger=ledger)
    before = snapshot(held)

    assert not held.merge(1, version_vector(3), MALFORMED_LOGS[name], b"")
    assert snapshot(held) == before


def test_ledger_entry_is_at_most_a_point() -> None:
    """No robot ships more than a point to one sample at once."""
    held = replica(0, 2, ledger=True)

    assert not held.merge(1, version_vector(2), suffix(1, 0, [(0, UNITS.point + 1)]), b"")
    assert held.merge(1, version_vector(2), suffix(1, 0, [(0, UNITS.point)]), b"")


@pytest.mark.parametrize(
    "content", [claim(3, 1, 0, 0), claim(1, 1, N, 0), claim(1, 1, 0, 5)[:-1], b"\xff" * 9]
)
def test_malformed_claim_is_refused(content: bytes) -> None:
    """An origin outside the roster, a sample that does not exist, a cut register."""
    held = replica(0, 3, ledger=True)
    before = snapshot(held)

    assert not held.merge(1, version_vector(3), suffix(1, 0, [(0, 1)]), content)
    assert snapshot(held) == before


@pytest.mark.parametrize("content", [b"", bytes(5), bytes(7), b"\x80" * 6])
def test_version_vector_of_another_length_is_refused(content: bytes) -> None:
    """One number for each log and, with claims, one for each register."""
    held = replica(0, 3, ledger=True)

    assert not held.merge(1, content, b"", b"")
    assert held.merge(1, version_vector(3), b"", b"")


@MODES
def test_malformed_message_takes_no_room(*, ledger: bool) -> None:
    """A long refused message leaves no more behind than a short one."""
    held = replica(0, 3, ledger=ledger)
    before = snapshot(held)

    assert not held.merge(1, version_vector(3), b"\xff" * 20_000, b"")
    assert snapshot(held) == before
