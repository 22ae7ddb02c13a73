"""Variable-length integers: exact both ways, total on any bytes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.varint import (
    MALFORMED,
    Pairs,
    put_int,
    put_uint,
    read_int,
    read_uint,
    sum_pairs,
)
from support.references.plain_varint import leb128, zigzag
from support.strategies import COUNTS, examples

BOUND = 5000
SIGNED = st.integers(-(2**62), 2**62 - 1)
PAIRS = st.lists(st.tuples(st.integers(0, BOUND - 1), COUNTS), max_size=80)


def packed(pairs: list[tuple[int, int]]) -> bytes:
    """Pairs as the code under test writes them."""
    index = np.array([i for i, _ in pairs], dtype=np.int64)
    value = np.array([v for _, v in pairs], dtype=np.int64)
    return Pairs().encode(index, value, len(pairs))


def unpacked(content: bytes, bound: int = BOUND) -> list[tuple[int, int]] | None:
    """Pairs as the code under test reads them."""
    arrays = Pairs().decode(content, bound)
    if arrays is None:
        return None
    return list(zip(arrays[0].tolist(), arrays[1].tolist(), strict=True))


@examples(150)
@given(value=COUNTS)
def test_unsigned_number_is_leb128(value: int) -> None:
    """Numbers up to 2^63 - 1 are written as LEB128 and read back."""
    out = np.zeros(10, dtype=np.uint8)
    end = put_uint(out, 0, value)

    assert out[:end].tobytes() == leb128(value)
    assert read_uint(np.frombuffer(leb128(value), dtype=np.uint8), 0) == (value, end)


@examples(150)
@given(value=SIGNED | st.sampled_from([-(2**62), 2**62 - 1, -1, 0, 1]))
def test_signed_number_is_folded(value: int) -> None:
    """0, -1, 1, -2, … become 0, 1, 2, 3, … so that small differences stay short."""
    out = np.zeros(10, dtype=np.uint8)
    end = put_int(out, 0, value)
    folded = leb128(zigzag(value))

    assert out[:end].tobytes() == folded
    assert read_int(np.frombuffer(folded, dtype=np.uint8), 0) == (value, end)


@examples(200)
@given(content=st.binary(max_size=30), at=st.integers(-3, 40))
def test_reading_a_number_is_total(content: bytes, at: int) -> None:
    """Any bytes, any position: a number with a later position in the buffer, or MALFORMED."""
    buffer = np.frombuffer(content, dtype=np.uint8)
    for value, end in (read_uint(buffer, at), read_int(buffer, at)):
        assert (value, end) == (0, MALFORMED) or 0 <= at < end <= min(len(content), at + 9)


@pytest.mark.parametrize("content", [b"\x80", b"\xff" * 8, b"\x80" * 9 + b"\x01", b"\xff" * 20])
def test_number_that_is_cut_or_too_long_is_malformed(content: bytes) -> None:
    """A number ends within nine bytes, or it is none."""
    assert read_uint(np.frombuffer(content, dtype=np.uint8), 0) == (0, MALFORMED)


@examples(100)
@given(pairs=PAIRS)
def test_pairs_come_back_as_they_were(pairs: list[tuple[int, int]]) -> None:
    """Indices in any order, values of any size."""
    assert unpacked(packed(pairs)) == pairs


@examples(300)
@given(content=st.binary(max_size=300), bound=st.integers(0, 300))
def test_reading_pairs_is_total(content: bytes, bound: int) -> None:
    """Any bytes: None, or pairs within the bound that mean the same when written again."""
    pairs = unpacked(content, bound)
    if pairs is not None:
        assert all(0 <= index < bound and value >= 0 for index, value in pairs)
        assert unpacked(packed(pairs), bound) == pairs


@examples(100)
@given(pairs=PAIRS)
def test_cut_pairs_are_malformed_or_a_beginning(pairs: list[tuple[int, int]]) -> None:
    """Losing the tail never invents a pair."""
    whole = packed(pairs)
    for end in range(len(whole)):
        kept = unpacked(whole[:end])

        assert kept is None or kept == pairs[: len(kept)]


@pytest.mark.parametrize("index", [BOUND, BOUND + 1, 2**40, -1, -(2**40)])
def test_index_outside_the_bound_is_malformed(index: int) -> None:
    """An index is in [0, bound), also when it is the second one."""
    assert unpacked(packed([(index, 1)])) is None
    assert unpacked(packed([(7, 1), (index, 1)])) is None


def test_nothing_is_no_bytes() -> None:
    """No pairs are written as nothing and nothing is read as no pairs."""
    assert packed([]) == b""
    assert unpacked(b"") == []


def test_room_grows_with_what_comes() -> None:
    """The same object packs and unpacks more than it was made for."""
    room = Pairs(capacity=2)
    index = np.arange(1000, dtype=np.int64)
    content = room.encode(index, index, 1000)
    arrays = room.decode(content, 1000)

    assert arrays is not None
    assert [a.tolist() for a in arrays] == [index.tolist(), index.tolist()]


@given(content=st.binary(max_size=60) | PAIRS.map(packed), bound=st.integers(1, 2 * BOUND))
def test_sum_is_that_of_the_pairs(content: bytes, bound: int) -> None:
    """Summed without unpacking: the same, or malformed, or more than anybody may ship."""
    pairs = unpacked(content, bound)
    total = MALFORMED if pairs is None else sum(value for _, value in pairs)

    assert sum_pairs(content, bound) == (total if total <= 2**62 else MALFORMED)
