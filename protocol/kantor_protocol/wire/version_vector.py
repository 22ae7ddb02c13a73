"""Version vectors: how much of each incarnation's log, claim and register the sender of a message holds.

A version vector is a row of LEB128 integers, for all incarnation ids that its sender knows, in order: first one log
length for each, then, in missions with claims, one claim stamp for each. These two are its *parts*. All production
code reads version vectors here.
"""

import numpy as np

from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import MALFORMED, read_uint


@kernel
def count_ids(version_vector: bytes, roster: int, parts: int) -> int:
    """The number of incarnation ids that a version vector covers, from the last bytes of its integers; or MALFORMED.

    roster: participants in the roster. parts: 2 in missions with claims, 1 without.
    """
    numbers = 0
    length = 0
    for i in range(len(version_vector)):
        length += 1
        if version_vector[i] < 128:
            numbers += 1
            length = 0
        elif length >= 9:  # see `read_uint`
            return MALFORMED
    block = roster * parts
    if length > 0 or numbers == 0 or numbers % block or numbers > block * (INCARNATIONS_MAX + 1):
        return MALFORMED
    return numbers // parts


@kernel
def read_entries(version_vector: bytes, at: int, entries: np.ndarray) -> int:
    """Read as many integers as `entries` has room for, from position `at`; the position after them, or MALFORMED."""
    for i in range(entries.shape[0]):
        entries[i], at = read_uint(version_vector, at)
    return at


@kernel
def raise_entries(version_vector: bytes, at: int, entries: np.ndarray, largest: int) -> int:
    """Read like `read_entries`, and raise each entry to what was read, but to `largest` at most."""
    for i in range(entries.shape[0]):
        value, at = read_uint(version_vector, at)
        entries[i] = max(entries[i], min(value, largest))
    return at


def covered_ids(version_vector: bytes, roster: int, *, claims: bool) -> int | None:
    """The number of incarnation ids that a version vector covers; None if it is malformed.

    roster: participants in the roster. claims: whether the mission has claims.
    """
    count = count_ids(version_vector, roster, 2 if claims else 1)
    return None if count < 0 else count


def read_version_vector(version_vector: bytes, count: int) -> list[int] | None:
    """The log lengths in a version vector, by incarnation id; None if it is malformed.

    count: incarnation ids to read, see `covered_ids`.
    """
    lengths = np.zeros(count, dtype=np.int64)
    at = read_entries(version_vector, 0, lengths)
    return None if at < 0 else lengths.tolist()
