"""Variable-length integers, as every compact part of a message carries them.

LEB128: seven bits a byte, low bits first, the high bit set on all bytes but the last. Signed
differences are zigzag-folded first. The kernels are total: whatever the bytes, they stay inside
their buffers, and a malformed input gives a negative position.
"""

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel

MALFORMED = -1
_SUM_MAX = 1 << 62


@kernel
def put_uint(out: np.ndarray, at: int, value: int) -> int:
    """Write a value >= 0 at position `at`; the position after it. `out` needs 10 free bytes."""
    while value >= 128:
        out[at] = np.uint8((value & 127) | 128)
        at += 1
        value >>= 7
    out[at] = np.uint8(value)
    return at + 1


@kernel
def put_int(out: np.ndarray, at: int, value: int) -> int:
    """Write a signed value, zigzag-folded."""
    return put_uint(out, at, value << 1 if value >= 0 else ((-value) << 1) - 1)


@kernel
def read_uint(buffer: bytes | np.ndarray, at: int) -> tuple[int, int]:
    """Read a value below 2**63 from `at`: (value, position after it), or (0, MALFORMED)."""
    value = 0
    shift = 0
    if at < 0:
        return 0, MALFORMED
    while at < len(buffer) and shift < 63:
        byte = np.int64(buffer[at])
        at += 1
        value |= int((byte & 127) << shift)
        if byte < 128:
            return value, at
        shift += 7
    return 0, MALFORMED


@kernel
def read_int(buffer: bytes | np.ndarray, at: int) -> tuple[int, int]:
    """Read a signed value; see `read_uint`."""
    folded, at = read_uint(buffer, at)
    if folded & 1:
        return -(folded >> 1) - 1, at
    return folded >> 1, at


@kernel
def skip_numbers(buffer: bytes | np.ndarray, at: int, count: int) -> int:
    """The position behind `count` numbers that are known to be well-formed, or the end."""
    while count > 0 and at < len(buffer):
        count -= buffer[at] < 128
        at += 1
    return at


@kernel
def read_pair(
    buffer: bytes | np.ndarray, at: int, before: int, valued: bool
) -> tuple[int, int, int]:
    """Read one of the pairs that follow each other: (index, value, position after it); see `pack_pairs`.

    before: the index of the pair before, 0 for the first. valued: pairs have values; else bare indices, of value 0.
    """
    step, at = read_int(buffer, at)
    value = 0
    if valued:
        value, at = read_uint(buffer, at)
    return before + step, value, at


@kernel
def pack_pairs(index: np.ndarray, value: np.ndarray, count: int, out: np.ndarray) -> int:
    """Write `count` pairs (index as difference to the one before, value >= 0); the bytes used."""
    at = 0
    before = 0
    for i in range(count):
        at = put_int(out, at, index[i] - before)
        at = put_uint(out, at, value[i])
        before = index[i]
    return at


@kernel
def unpack_pairs(buffer: bytes, bound: int, index: np.ndarray, value: np.ndarray) -> int:
    """Read pairs until the buffer ends; their count, or MALFORMED.

    Malformed is a cut number, an index outside [0, bound), or more pairs than `index` holds.
    """
    at = 0
    before = 0
    count = 0
    while at < len(buffer):
        before, amount, at = read_pair(buffer, at, before, True)
        if at < 0 or before < 0 or before >= bound or count >= index.shape[0]:
            return MALFORMED
        index[count] = before
        value[count] = amount
        count += 1
    return count


@kernel
def sum_pairs(buffer: bytes, bound: int) -> int:
    """The sum of all values, or MALFORMED, see `unpack_pairs`; also when it passes 2**62."""
    at = 0
    index = 0
    total = 0
    while at < len(buffer):
        index, amount, at = read_pair(buffer, at, index, True)
        if at < 0 or index < 0 or index >= bound or amount > _SUM_MAX - total:
            return MALFORMED
        total += amount
    return total


class Pairs:
    """Reusable room for packed (index, value) pairs: encode from arrays, decode to array views."""

    def __init__(self, capacity: int = 64) -> None:
        self._out = np.zeros(20 * capacity, dtype=np.uint8)
        self._index = np.zeros(capacity, dtype=np.int64)
        self._value = np.zeros(capacity, dtype=np.int64)

    def encode(
        self, index: npt.NDArray[np.signedinteger], value: npt.NDArray[np.signedinteger], count: int
    ) -> bytes:
        """The first `count` pairs as bytes."""
        if not count:
            return b""
        if self._out.shape[0] < 20 * count:
            self._out = np.zeros(40 * count, dtype=np.uint8)
        used = pack_pairs(index, value, count, self._out)
        return self._out[:used].tobytes()

    def decode(
        self, packed: bytes, bound: int
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None:
        """(index, value) as views valid until the next call, or None when malformed."""
        if len(packed) > 2 * self._index.shape[0]:  # a pair takes two bytes at least
            self._index = np.zeros(len(packed), dtype=np.int64)
            self._value = np.zeros(len(packed), dtype=np.int64)
        count = unpack_pairs(packed, bound, self._index, self._value)
        if count < 0:
            return None
        return self._index[:count], self._value[:count]
