"""Keyed randomness: Philox4x32-10 as published, and draws that depend on their key alone."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given

from kantor_protocol.base.counter_rng import Purpose, generator, philox, to_unit, uniform
from support.references.plain_philox import philox_plain
from support.strategies import SEEDS, WORDS, examples

Words = tuple[int, int, int, int]

KNOWN_ANSWERS = {
    "zeros": (
        (0, 0, 0, 0),
        (0, 0),
        (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8),
    ),
    "ones": (
        (0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF),
        (0xFFFFFFFF, 0xFFFFFFFF),
        (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD),
    ),
    "digits-of-pi": (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
}
"""philox4x32-10 of the file kat_vectors of Random123 (Salmon et al., SC'11)."""


@pytest.mark.parametrize("name", KNOWN_ANSWERS)
def test_plain_form_gives_the_published_answers(name: str) -> None:
    """Philox4x32-10 in plain integers equals Random123's known answers."""
    counter, key, block = KNOWN_ANSWERS[name]

    assert philox_plain(key[1] << 32 | key[0], counter) == block


@examples(200)
@given(seed=SEEDS, purpose=WORDS, who=WORDS, step=WORDS, index=WORDS)
def test_compiled_form_equals_the_plain_one(
    seed: int, purpose: int, who: int, step: int, index: int
) -> None:
    """The compiled kernel gives the words of the plain form, two by two, for every key."""
    a, b, c, d = philox_plain(seed, (purpose, who, step, index))

    assert philox(seed, purpose, who, step, index) == (b << 32 | a, d << 32 | c)


@examples(200)
@given(seed=SEEDS, who=WORDS, step=WORDS, index=WORDS)
def test_draw_is_the_upper_53_bits_of_the_first_word(
    seed: int, who: int, step: int, index: int
) -> None:
    """A draw lies in [0, 1) and is a function of its key and counter alone."""
    low, high, _, _ = philox_plain(seed, (Purpose.DROP, who, step, index))
    draw = uniform(seed, int(Purpose.DROP), who, step, index)

    assert draw == ((high << 32 | low) >> 11) / 2**53
    assert 0.0 <= draw < 1.0


@pytest.mark.parametrize(("word", "draw"), [(0, 0.0), (2**64 - 1, 1.0 - 2.0**-53), (2**63, 0.5)])
def test_ends_of_the_unit_interval(word: int, draw: float) -> None:
    """0 can be drawn, 1 cannot."""
    assert to_unit(np.uint64(word)) == draw


def test_draws_are_spread_evenly() -> None:
    """20 000 draws fall into 20 bins as evenly as chance allows (chi-square, 1 in 1000)."""
    draws = [uniform(5, int(Purpose.SAMPLE_WALK), 0, 1, j) for j in range(20_000)]
    bins = Counter(int(20.0 * draw) for draw in draws)
    chi_square = sum((bins[i] - 1000) ** 2 / 1000 for i in range(20))

    assert sorted(bins) == list(range(20))
    assert chi_square < 43.8


def test_no_part_of_the_counter_is_ignored() -> None:
    """Purpose, participant, step, index and seed each change the draw."""
    keys = [(2, 3, 4, 5, 6), (7, 3, 4, 5, 6), (2, 7, 4, 5, 6), (2, 3, 7, 5, 6), (2, 3, 4, 7, 6)]

    assert len({uniform(*key) for key in [*keys, (2, 3, 4, 5, 7)]}) == 6


def test_purposes_do_not_share_draws() -> None:
    """Every purpose has a first word of its own, and so has numpy's generator for it."""
    first = {purpose: generator(9, purpose).random() for purpose in Purpose}

    assert len(set(first.values())) == len(Purpose)
    assert first == {purpose: generator(9, purpose).random() for purpose in Purpose}
