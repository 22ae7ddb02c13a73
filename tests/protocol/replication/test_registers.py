"""Registers: the newest value of every origin reaches all, whatever the radio does.

Content that a test writes itself comes from `content`, an encoder of the wire format that shares
nothing with the kernels. The reference for a sum is a plain sum.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.replication.registers import NUMBER_MAX, STAMP_MAX, Registers, read_register
from support.references.plain_varint import leb128, zigzag
from support.strategies import examples

WIDTH = 3

AMOUNTS = st.integers(0, 9).flatmap(
    lambda bound: st.tuples(
        st.just(bound), st.integers(-bound, bound), st.integers(-bound, bound)
    ).map(list)
)
"""What one write adds: the first number bounds the others."""


def team(
    origins: int, *, relay: int | None = None, beacon: bool = False, timeout_steps: int = 2
) -> list[Registers]:
    """Empty registers of a team; one of them may relay."""
    return [
        Registers(
            me, origins, WIDTH, relay=me == relay, beacon=beacon, ack_timeout_steps=timeout_steps
        )
        for me in range(origins)
    ]


def add(held: Registers, *amounts: int) -> None:
    """One write."""
    held.add(np.array(amounts, dtype=np.int64))


def hear(held: Registers, source: int, said: bytes) -> None:
    """Take in what must be sound."""
    told = held.stamps.shape[0]
    assert held.is_well_formed(said, told)
    held.merge(source, said, told)


def register(origin: int, stamp: int, *numbers: int) -> bytes:
    """Origin, stamp, how many numbers, the numbers zigzag-folded."""
    counted = (origin, stamp, len(numbers), *map(zigzag, numbers))
    return b"".join(map(leb128, counted))


def content(stamps: list[int], *registers: bytes) -> bytes:
    """What a message carries."""
    return b"".join(map(leb128, stamps)) + b"".join(registers)


def snapshot(held: Registers) -> list[object]:
    """All that is held and known."""
    arrays = (
        held.values,
        held.total,
        held.stamps,
        held._known,
        held._received,
        held._updated,
        held._sent,
    )
    return [array.tolist() for array in arrays]


def told(said: bytes, origins: int) -> set[int]:
    """Whose registers a message carries."""
    found = {origin: read_register(said, origins, WIDTH, origin) for origin in range(origins)}
    return {origin for origin, read in found.items() if read is not None and read[0]}


def speak(made: list[Registers], hears: dict[int, list[int]] | None = None) -> list[set[int]]:
    """A round: all send, then all in range receive. The origins whose registers each one sent."""
    said = [held.compose() for held in made]
    for source, word in enumerate(said):
        made[source].end_step()
        for target, held in enumerate(made):
            if target != source and (hears is None or source in hears[target]):
                hear(held, source, word)
    return [told(word, len(made)) for word in said]


IN_A_ROW = {0: [1], 1: [0, 2], 2: [1]}


def test_the_format_is_what_the_page_says() -> None:
    """Stamps of all origins, then origin, stamp and numbers, folded."""
    one, two = team(2)
    add(one, 200, -3, 200)
    hear(one, 1, two.compose())

    assert one.compose() == content([1, 0], register(0, 1, 200, -3, 200))


def test_a_write_counts_and_adds() -> None:
    """The own register is the sum of its writes; the total is the sum over origins."""
    one, two = team(2)
    add(one, 5, -2, 1)
    add(one, 5, 4, -5)
    add(two, 1, 1, 1)
    hear(one, 1, content([0, 1], register(1, 1, 1, 1, 1)))

    assert one.values.tolist() == [[10, 2, -4], [1, 1, 1]]
    assert (one.total.tolist(), one.stamps.tolist()) == ([11, 3, -3], [2, 1])


def test_while_nothing_is_received_only_stamps_are_sent() -> None:
    """A register takes a kilobyte; a stamp is enough to be found by."""
    one, _ = team(2)
    add(one, 1, 1, 1)

    assert one.compose() == content([1, 0])


def test_beacon_tells_everything_into_the_dark() -> None:
    """With `state` one message informs a robot that comes into range, also of others."""
    one, _two, _three = team(3, beacon=True)
    add(one, 1, 0, 0)
    hear(one, 1, content([0, 1, 0], register(1, 1, 2, 0, 0)))
    for _ in range(20):
        one.end_step()

    assert told(one.compose(), 3) == {0, 1}
    assert told(one.compose(2), 3) == set()


def test_a_register_is_sent_once_and_again_after_the_timeout() -> None:
    """Without an acknowledgement it is repeated; with one it is not."""
    one, two = team(2, timeout_steps=3)
    add(one, 1, 0, 0)
    hear(one, 1, two.compose())
    rounds = []
    for _ in range(5):
        rounds.append(told(one.compose(), 2))
        one.end_step()

    assert rounds == [{0}, set(), set(), {0}, set()]
    hear(one, 1, content([1, 0]))
    for _ in range(5):
        one.end_step()
        assert told(one.compose(), 2) == set()


def test_a_silent_participant_is_no_neighbour() -> None:
    """A neighbour is an origin that was heard within the timeout and four steps."""
    one, two = team(2)
    hear(one, 1, two.compose())
    for _ in range(7):
        one.end_step()
    add(one, 1, 0, 0)

    assert told(one.compose(), 2) == set()


def test_a_relay_forwards_at_once_a_robot_when_it_has_grown_stale() -> None:
    """Who hears the origin itself needs no second copy of each step."""
    for relay, first in ((1, 2), (None, 7)):
        made = team(3, relay=relay)
        forwarded = []
        for _ in range(9):
            add(made[0], 1, 0, 0)
            forwarded.append(0 in speak(made, IN_A_ROW)[1])

        assert forwarded.index(True) in (first - 1, first)


def test_among_robots_that_all_hear_each_other_nothing_is_forwarded() -> None:
    """Each sends its own, each step, and no more."""
    made = team(4)
    for step in range(20):
        for held in made:
            add(held, 1, 0, 0)
        spoken = speak(made)

        assert spoken == ([{i} for i in range(4)] if step else [set()] * 4)


def test_a_message_to_one_participant_has_what_it_lacks() -> None:
    """To a supervisor: what others lack is no reason."""
    one, two, three = team(3)
    add(one, 1, 0, 0)
    hear(one, 1, two.compose())
    hear(one, 2, three.compose())
    hear(one, 2, content([1, 0, 0]))

    assert told(one.compose(2), 3) == set()
    assert told(one.compose(1), 3) == {0}


def test_what_does_not_fit_follows_with_the_next_message() -> None:
    """A thousand numbers and 70 origins: each message within bounds, in turn those of all."""
    width, origins = 1024, 70
    one = Registers(0, origins, width, relay=True)
    numbers = [NUMBER_MAX, *[-NUMBER_MAX] * (width - 1)]
    for origin in range(1, origins):
        hear(one, origin, content([0] * origins, register(origin, 1, *numbers)))
    seen: set[int] = set()
    for _ in range(60):
        for origin in range(1, origins):
            hear(one, origin, content([0] * origins))
        said = one.compose()
        one.end_step()
        assert len(said) <= 48 * 1024
        assert one.is_well_formed(said, origins)
        seen |= {o for o in range(origins) if read_register(said, origins, width, o)[0]}  # type: ignore[index]

    assert seen == set(range(1, origins))


def test_without_registers_none_is_sent_and_none_merged() -> None:
    """Width 0: a mission whose planner shares none."""
    held = Registers(0, 3, 0)

    assert held.compose() == b""
    assert not held.is_well_formed(content([0, 0, 0]), 3)


@examples(80)
@given(
    writes=st.lists(st.tuples(st.integers(0, 2), AMOUNTS), max_size=12),
    order=st.randoms(use_true_random=False),
)
def test_loss_repetition_and_order_change_nothing_but_time(
    writes: list[tuple[int, list[int]]], order: object
) -> None:
    """Any messages, any number of times, in any order: all end with the plain sums."""
    made = team(3, beacon=True)
    air: list[tuple[int, bytes]] = []
    for who, amounts in writes:
        add(made[who], *amounts)
        air.append((who, made[who].compose()))
    delivered = [message for message in air * 2 if order.random() < 0.6]  # type: ignore[attr-defined]
    order.shuffle(delivered)  # type: ignore[attr-defined]
    for source, word in delivered:
        for target, held in enumerate(made):
            if target != source:
                hear(held, source, word)
                assert held.total.tolist() == held.values.sum(axis=0).tolist()
    for _ in range(30):  # a good radio, for a while
        speak(made)

    truth = [
        np.array([amounts for who, amounts in writes if who == i], dtype=np.int64)
        .reshape(-1, WIDTH)
        .sum(axis=0)
        .tolist()
        for i in range(3)
    ]
    for held in made:
        assert held.values.tolist() == truth
        assert held.total.tolist() == np.sum(truth, axis=0).tolist()


@examples(30)
@given(seed=st.integers(0, 2**32 - 1), drop=st.sampled_from([0.0, 0.3, 0.7]))
def test_a_chain_converges_under_loss(seed: int, drop: float) -> None:
    """News travels over several hops; what is lost is told again."""
    random = np.random.default_rng(seed)
    made = team(4)
    for round_ in range(200):
        if round_ < 10:
            for held in made:
                add(held, 2, int(random.integers(-2, 3)), 1)
        said = [held.compose() for held in made]
        for source, word in enumerate(said):
            made[source].end_step()
            for target in (source - 1, source + 1):
                if 0 <= target < 4 and random.random() >= drop:
                    hear(made[target], source, word)
    truth = [held.values[held.me].tolist() for held in made]

    assert all(held.values.tolist() == truth for held in made)
    assert all(told(held.compose(), 4) == set() for held in made)


MALFORMED = {
    "cut-stamps": b"\x00",
    "cut-number": content([0, 0], register(1, 1, 5, 1, 1))[:-1],
    "cut-inside-a-number": content([0, 0], register(1, 1, 300, 1, 200))[:-1],
    "a-number-more": content([0, 0], register(1, 1, 5, 1, 1, 1)),
    "of-no-origin": content([0, 0], register(2, 1, 5, 1, 1)),
    "never-written": content([0, 0], register(1, 0, 5, 1, 1)),
    "stamp-beyond-reason": content([0, 0], register(1, STAMP_MAX + 1, 5, 1, 1)),
    "known-stamp-beyond-reason": content([0, STAMP_MAX + 1]),
    "endless-integer": content([0, 0]) + b"\xff" * 20,
    "negative-count": content([0, 0], register(1, 1, -1, 0, 0)),
    "sum-beyond-the-count": content([0, 0], register(1, 1, 5, 1, -6)),
    "count-beyond-reason": content([0, 0], register(1, 1, NUMBER_MAX + 1, 0, 0)),
    "sound-then-not": content([0, 0], register(1, 1, 5, 1, 1), register(1, 2, 5, 1, 6)),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_content_is_unsound(name: str) -> None:
    """The whole is refused, also what was sound in it."""
    one, _ = team(2)

    assert not one.is_well_formed(MALFORMED[name], 2)


@examples(300)
@given(noise=st.binary(max_size=60), whole=st.booleans())
def test_any_bytes_are_sound_or_refused(*, noise: bytes, whole: bool) -> None:
    """Kernels are total; what is sound keeps the sums exact."""
    one, _ = team(2)
    add(one, 1, 0, 0)
    said = content([0, 3], noise) if whole else noise
    before = snapshot(one)
    sound = one.is_well_formed(said, 2)

    assert snapshot(one) == before
    if sound:
        one.merge(1, said, 2)
        assert one.total.tolist() == one.values.sum(axis=0).tolist()
        assert one.values[0].tolist() == [1, 0, 0]
    assert read_register(noise, 2, WIDTH, 1) is None or len(noise) >= 2


def test_no_participant_writes_the_register_of_another() -> None:
    """What comes back of the own register is left, however new it claims to be."""
    one, _ = team(2)
    add(one, 1, 1, 1)
    hear(one, 1, content([9, 0], register(0, 9, 5, 5, 5)))

    assert one.values[0].tolist() == [1, 1, 1]


@examples(60)
@given(stamps=st.permutations(range(1, 6)))
def test_the_newest_wins_in_any_order(stamps: list[int]) -> None:
    """By the origin's stamp, not by arrival."""
    one, _ = team(2)
    for stamp in stamps:
        hear(one, 1, content([0, stamp], register(1, stamp, 10 * stamp, stamp, -stamp)))

    assert one.values[1].tolist() == [50, 5, -5]
    assert one.total.tolist() == [50, 5, -5]


# Registers that are written, not added to.


def test_a_register_is_replaced_and_loses_its_zeros() -> None:
    """The newest whole value holds, shorter ones too; zeros at the end are not sent."""
    one = Registers(0, 2, WIDTH, sums=False)
    two = Registers(1, 2, WIDTH, sums=False)
    hear(one, 1, two.compose())
    one.write([-7, 9, 4])
    hear(two, 0, one.compose())
    assert two.values[0].tolist() == [-7, 9, 4]
    one.end_step()
    one.write([5])

    said = one.compose()
    assert said == content([2, 0], register(0, 2, 5))
    hear(two, 0, said)
    assert (two.values[0].tolist(), two.total.tolist()) == ([5, 0, 0], [5, 0, 0])
    assert (one.values[0].tolist(), one.total.tolist()) == ([5, 0, 0], [5, 0, 0])


def test_age_tells_how_long_nothing_new_came() -> None:
    """In own steps; negative while nothing was ever heard. Old news do not renew it."""
    one = Registers(0, 2, WIDTH, sums=False)
    two = Registers(1, 2, WIDTH, sums=False)
    assert one.age_steps(1) < 0
    hear(two, 0, one.compose())
    two.write([1])
    said = two.compose()
    hear(one, 1, said)
    assert one.age_steps(1) == 0
    for _ in range(3):
        one.end_step()
    hear(one, 1, said)
    assert one.age_steps(1) == 3


def test_more_numbers_than_a_register_has_are_refused() -> None:
    """The message is malformed."""
    held = Registers(0, 2, WIDTH, sums=False)

    assert not held.is_well_formed(content([0, 1], register(1, 1, 1, 2, 3, 4)), 2)
    assert held.is_well_formed(content([0, 1], register(1, 1, 1, -2, 3)), 2)
