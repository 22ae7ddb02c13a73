"""Participants that go on as new incarnations: what their messages hold, and what others make of them.

Incarnation ids are counted by hand here: incarnation e of place i in a roster of n is e n + i.
"""

import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.incarnations import INCARNATIONS_MAX, known_ids
from kantor_protocol.replication.registers import Registers, read_register
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import NO_INDEX, spend
from kantor_protocol.wire.version_vector import covered_ids, read_version_vector
from kantor_protocol.wire.weights import Units
from support.replication import replicas
from support.strategies import examples

N = 6
UNITS = Units.of(8, N)
"""Four units a sample, three a point."""
ROSTER = 3
WIDTH = 2

MODES = pytest.mark.parametrize("ledger", [True, False], ids=["ledger", "min"])
CLAIMS = pytest.mark.parametrize("claims", [True, False], ids=["claims", "no-claims"])


def replica(
    incarnation_id: int,
    *,
    ledger: bool = True,
    claims: bool = True,
    width: int = 0,
    relay: bool = False,
) -> Replica:
    """An empty replica of an incarnation."""
    registers = Registers(incarnation_id, ROSTER, width, relay=relay)
    return Replica(
        incarnation_id,
        ROSTER,
        N,
        UNITS,
        ledger=ledger,
        claims=claims,
        relay=relay,
        registers=registers,
    )


def buy(held: Replica, sample: int, units: int) -> None:
    """Spend, as far as there is weight in this view."""
    units = min(units, int(held.weights[sample]))
    if units > 0:
        held.reserve(1)
        spend(held.store, held.config, sample, units)


def tell(held: Replica, *others: Replica, target: int = NO_INDEX) -> None:
    """One message to others, and the end of the step."""
    word = (*held.compose(target), held.registers.compose(target))
    held.end_step()
    for other in others:
        assert other.merge(held.config.me, *word)


def whole_log(held: Replica) -> bytes:
    """The own log as one suffix: origin, start, span, count, then (folded difference, units); small numbers."""
    entries = replicas.entries(held, held.config.me)
    content, before = [held.config.me, 0, len(entries), len(entries)], 0
    for sample, units in entries:
        step, before = sample - before, sample
        content += [2 * step if step >= 0 else -2 * step - 1, units]
    return bytes(content) if entries else b""


def snapshot(held: Replica) -> list[Any]:
    """All that is held and known."""
    registers = held.registers
    arrays = [*held.store, registers.values, registers.stamps, registers.total]
    return [(array.shape, array.tolist()) for array in arrays]


def test_incarnation_ids_come_in_blocks_of_the_roster() -> None:
    """One for each incarnation, up to the last that there may be."""
    assert [known_ids(incarnation_id, 3) for incarnation_id in (0, 2, 3, 8, 47)] == [3, 3, 6, 9, 48]
    for incarnation_id in (-1, 3 * (INCARNATIONS_MAX + 1)):
        with pytest.raises(ValueError, match="incarnation"):
            known_ids(incarnation_id, 3)
    with pytest.raises(ValueError, match="incarnation 16"):
        replica(ROSTER * 16)


@CLAIMS
def test_a_vector_covers_a_number_of_incarnation_ids(*, claims: bool) -> None:
    """As many numbers as ids, twice as many with claims, whatever their length."""
    parts = 2 if claims else 1
    for blocks in range(1, INCARNATIONS_MAX + 2):
        numbers = b"\x85\x01" + bytes(parts * 3 * blocks - 1)
        assert covered_ids(numbers, 3, claims=claims) == 3 * blocks
    for content in (b"", bytes(parts * 3 - 1), bytes(parts * 3 * 17), b"\x80" * 3, b"\xff" * 12):
        assert covered_ids(content, 3, claims=claims) is None


def test_a_new_incarnation_covers_twice_as_many_ids() -> None:
    """Its own log is at its own id; its predecessor's log is another's."""
    one = replica(ROSTER + 1)
    buy(one, 2, 3)
    version_vector = one.compose(0)[0]

    assert version_vector == bytes([0, 0, 0, 0, 1, 0]) + bytes(6)
    assert read_version_vector(version_vector, 6) == [0, 0, 0, 0, 1, 0]


@CLAIMS
@MODES
def test_shorter_vectors_are_of_who_holds_nothing_beyond(*, ledger: bool, claims: bool) -> None:
    """Who has not heard of an incarnation holds nothing of it, and is told."""
    young, old, other = (replica(origin, ledger=ledger, claims=claims) for origin in (4, 0, 2))
    for held in (young, old):
        buy(held, held.config.me, 1)
    young.claim(4, 5)
    old.claim(0, 7)
    tell(old, young, other)
    assert (young.origins, old.origins) == (6, 3)
    known = young.store.known[0].reshape(2, 6)
    assert known[:, 3:].tolist() == [[0] * 3] * 2
    tell(young, old)

    assert (young.origins, old.origins, other.origins) == (6, 6, 3)
    assert (old.weights[4], old.store.length[4]) == (3, 1)
    # What was known of others is where it belongs in the wider table.
    tell(old, other, young)
    tell(other, old)
    known = old.store.known.reshape(6, 2, 6)
    lengths, stamps = other.store.length, other.store.claims[2]
    assert known[2, 0].tolist() == lengths.tolist()
    assert known[2, 1].tolist() == (stamps.tolist() if claims else [0] * 6)


@CLAIMS
@MODES
def test_vectors_of_odd_lengths_change_nothing(*, ledger: bool, claims: bool) -> None:
    """No whole number of rosters, more incarnations than there may be, or none."""
    parts = 2 if claims else 1
    held = replica(0, ledger=ledger, claims=claims, width=WIDTH)
    buy(held, 1, 2)
    before = snapshot(held)
    for numbers in range(parts * ROSTER * (INCARNATIONS_MAX + 2) + 2):
        sound = numbers > 0 and numbers % (parts * ROSTER) == 0 and numbers <= parts * ROSTER * 16
        if not sound:
            assert not held.merge(1, bytes(numbers), b"", b"", bytes(numbers))
            assert not held.merge(1, bytes(numbers), b"", b"")
    assert snapshot(held) == before


HOSTILE = {
    "source-that-it-does-not-know": (4, bytes(6), b"", b"", b""),
    "log-that-it-does-not-know": (1, bytes(6), bytes([3, 0, 1, 1, 0, 1]), b"", b""),
    "claim-that-it-does-not-know": (1, bytes(6), b"", bytes([3, 1, 1, 0]), b""),
    "cut-log-of-a-newcomer": (4, bytes(12), bytes([4, 0, 1, 1, 0]), b"", b""),
    "sample-outside-in-a-newcomer's-log": (4, bytes(12), bytes([4, 0, 1, 1, 2 * N, 1]), b"", b""),
    "cut-claim-of-a-newcomer": (4, bytes(12), b"", bytes([4, 1, 1]), b""),
    "cut-register-of-a-newcomer": (4, bytes(12), b"", b"", bytes(6) + bytes([4, 1, 1])),
    "register-that-it-does-not-know": (1, bytes(6), b"", b"", bytes(3) + bytes([3, 1, 0])),
    "stamps-of-fewer": (4, bytes(12), b"", b"", bytes(5)),
    "own-id": (0, bytes(6), b"", b"", b""),
}


@pytest.mark.parametrize("name", HOSTILE)
@MODES
def test_hostile_words_make_no_room(*, ledger: bool, name: str) -> None:
    """A message is checked whole before there is room for more incarnations."""
    held = replica(0, ledger=ledger, width=WIDTH)
    buy(held, 1, 2)
    before = snapshot(held)

    assert not held.merge(*HOSTILE[name])
    assert snapshot(held) == before


@examples(300)
@given(data=st.data(), ledger=st.booleans())
def test_any_bytes_are_survived_and_refused_whole(*, ledger: bool, data: st.DataObject) -> None:
    """Two blocks of ids or three, noise beside: taken in whole or not at all; the sums stay exact."""
    held, other = (replica(origin, ledger=ledger, width=WIDTH) for origin in (0, 4))
    buy(other, 3, 2)
    other.registers.add(np.array([3, -2]))
    sound = (*other.compose(0), other.registers.compose(0))
    sizes = [st.binary(max_size=30), st.sampled_from([6, 12, 18]).map(bytes), st.just(b"")]
    parts = [data.draw(st.one_of(st.just(part), *sizes)) for part in sound]
    before, weights = snapshot(held), held.weights.tolist()
    if not held.merge(data.draw(st.integers(-1, 50)), *parts):
        assert snapshot(held) == before

    assert all(x <= y for x, y in zip(held.weights.tolist(), weights, strict=True))
    registers = held.registers
    assert registers.total.tolist() == registers.values.sum(axis=0).tolist()
    assert registers.stamps.shape[0] == held.origins
    said = (*held.compose(), registers.compose())
    assert replica(1, ledger=ledger, width=WIDTH).merge(0, *said)


def test_boast_about_the_own_log_is_left() -> None:
    """A sender that claims to hold more of a log than was written gets nothing, and harms none."""
    held = replica(0)
    buy(held, 1, 2)
    before = replicas.entries(held, 0)

    assert held.merge(1, bytes([9, 0, 0, 9, 0, 0]), bytes([0, 0, 2, 2, 0, 1, 0, 1]), b"")
    assert (replicas.entries(held, 0), held.compose()[1]) == (before, b"")
    assert held.weights.tolist() == [4, 2, 4, 4, 4, 4]


def test_old_words_of_the_dead_are_data() -> None:
    """A message that was under way when its sender died is heard like any other, again and again."""
    dead, reader, young = replica(1), replica(0), replica(ROSTER + 1)
    buy(dead, 2, 3)
    words = dead.compose(0)
    buy(young, 2, 1)
    tell(young, reader, target=0)
    for _ in range(2):
        assert reader.merge(1, *words)

    assert (replicas.entries(reader, 1), replicas.entries(reader, 4)) == ([(2, 3)], [(2, 1)])
    assert reader.weights[2] == 0


def test_a_new_incarnation_merges_what_its_predecessor_sent() -> None:
    """Its predecessor's log comes back from peers, and is never told twice."""
    dead, reader = replica(1), replica(0)
    buy(dead, 2, 3)
    tell(dead, reader, target=0)
    young = replica(ROSTER + 1)
    for _ in range(6):
        tell(young, reader)
        tell(reader, young)

    assert replicas.entries(young, 1) == [(2, 3)]
    assert young.weights.tolist() == reader.weights.tolist()
    assert young.compose()[1] == reader.compose()[1] == b""


def test_claim_of_the_dead_expires() -> None:
    """It is neither given up nor renewed; also its successor need not wait longer."""
    dead, reader, young = replica(1), replica(0), replica(ROSTER + 1)
    dead.claim(3, 100)
    tell(dead, reader)
    taken = []
    for _ in range(40):
        taken.append(
            (3 in replicas.claimed_by_others(reader), 3 in replicas.claimed_by_others(young))
        )
        tell(young, reader)
        tell(reader, young)

    assert taken[0] == (True, False)
    assert [any(pair) for pair in taken].index(False) <= 30
    assert not any(any(pair) for pair in taken[30:])


def test_claim_before_time_0_is_sent_as_of_time_0() -> None:
    """A clock may run behind; a message holds no negative time."""
    one, two = replica(0), replica(1)
    one.claim(3, -(10**13))
    tell(one, two)

    assert replicas.claimed_by_others(two) == [3]
    assert two.store.claims[1, 0] == 0


# Registers.


def test_register_of_the_newest_incarnation_that_has_written() -> None:
    """Until a newcomer has told anything, the word of the one before it holds."""
    held, dead, young = replica(0, width=WIDTH), replica(1, width=WIDTH), replica(7, width=WIDTH)
    for other in (dead, young):
        tell(held, other)
    assert held.registers.newest(1) == 1
    dead.registers.add(np.array([1, 0]))
    tell(dead, held)
    tell(young, held)
    assert held.registers.newest(1) == 1
    young.registers.add(np.array([5, -5]))
    tell(held, young)
    tell(young, held)

    assert (held.registers.newest(1), held.registers.newest(2), held.registers.newest(0)) == (
        7,
        2,
        0,
    )
    assert young.registers.newest(1) == 7
    assert held.registers.total.tolist() == [6, -5]
    word = held.registers.compose()
    assert read_register(word, held.origins, WIDTH, 9) == (0, pytest.approx([0, 0]))


@examples(60)
@given(
    deeds=st.lists(
        st.tuples(st.integers(0, 2), st.sampled_from(["spend", "die", "tell"]), st.integers(0, 5)),
        max_size=30,
    ),
    drop=st.sampled_from([0.0, 0.3]),
    ledger=st.booleans(),
    luck=st.randoms(use_true_random=False),
)
def test_all_end_with_all_that_the_living_know(
    *, deeds: list[tuple[int, str, int]], drop: float, ledger: bool, luck: random.Random
) -> None:
    """Whichever robots die and whenever: equal weights, equal registers, sums over all incarnations exact."""
    made = [replica(place, ledger=ledger, width=WIDTH) for place in range(ROSTER)]
    for who, deed, sample in deeds:
        held = made[who]
        if deed == "spend":
            buy(held, sample, 1 + sample % 3)
            held.registers.add(np.array([2, sample - 3 if sample > 0 else 0]))
        elif deed == "die" and held.config.me < 4 * ROSTER:
            made[who] = replica(held.config.me + ROSTER, ledger=ledger, width=WIDTH)
        else:
            tell(held, *(other for other in made if other is not held and luck.random() >= drop))
        for one in made:
            registers = one.registers
            assert registers.total.tolist() == registers.values.sum(axis=0).tolist()
    known = [
        max(
            (held.registers.values[origin].tolist() for held in made if origin < held.origins),
            default=[],
        )
        for origin in range(max(held.origins for held in made))
    ]
    for _ in range(30):
        for held in made:
            tell(held, *(other for other in made if other is not held))

    for held in made:
        assert held.weights.tolist() == made[0].weights.tolist()
        assert held.registers.values.tolist() == known
        assert held.registers.total.tolist() == np.sum(known, axis=0).tolist()


@examples(60)
@given(
    parts=st.lists(
        st.tuples(st.integers(0, 8), st.integers(0, N - 1), st.integers(1, 3)), max_size=20
    ),
    luck=st.randoms(use_true_random=False),
)
def test_whole_state_is_the_join_of_its_deltas(
    parts: list[tuple[int, int, int]], luck: random.Random
) -> None:
    """ledger: nine writers of three incarnations each; words in any order, then all at once."""
    writers = [replica(origin) for origin in range(3 * ROSTER)]
    words: list[tuple[int, tuple[bytes, bytes, bytes]]] = []
    for origin, sample, units in parts:
        buy(writers[origin], sample, units)
        words.append((origin, writers[origin].compose(2)))
    bit_by_bit, at_once = replica(4 * ROSTER + 2), replica(4 * ROSTER + 2)
    for _ in range(len(words) + 1):
        luck.shuffle(words)
        for origin, word in words:
            assert bit_by_bit.merge(origin, *word)
    told = b"".join(whole_log(writer) for writer in writers)
    assert at_once.merge(0, bytes(2 * 3 * ROSTER), told, b"")

    for origin in range(3 * ROSTER):
        assert (
            replicas.entries(bit_by_bit, origin)
            == replicas.entries(at_once, origin)
            == replicas.entries(writers[origin], origin)
        )
    assert at_once.weights.tolist() == bit_by_bit.weights.tolist()
