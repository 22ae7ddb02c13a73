"""The parts of a message, one by one: suffixes of logs, claims and registers of single origins, and their bytes.

Kernels are total: whatever the bytes, they stay inside their buffers, and say MALFORMED of what they cannot read.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import MALFORMED, put_uint, read_pair, read_uint, skip_numbers

_PARTS_MAX = 512
"""More parts of one kind are in no message with proofs."""
_CLAIM_BYTES = 40
"""Of four numbers, at most."""


class Part(NamedTuple):
    """A suffix or a register in a message."""

    origin: int
    first: int
    """A suffix: position of its first entry. A register: its stamp."""
    size: int
    """Entries, or numbers."""
    begin: int
    end: int
    """Its bytes."""


@kernel
def _scan_suffixes(logs: bytes, valued: bool, parts: np.ndarray) -> int:
    """Write (origin, start, count, begin, end) of each suffix; their number, or MALFORMED."""
    found = 0
    at = 0
    while at < len(logs):
        begin = at
        origin, at = read_uint(logs, at)
        start, at = read_uint(logs, at)
        _span, at = read_uint(logs, at)
        count, at = read_uint(logs, at)
        if at < 0 or count > len(logs) or found >= parts.shape[0]:
            return MALFORMED
        at = skip_numbers(logs, at, 2 * count if valued else count)
        parts[found, 0], parts[found, 1], parts[found, 2] = origin, start, count
        parts[found, 3], parts[found, 4] = begin, at
        found += 1
    return found


@kernel
def _scan_registers(registers: bytes, covered: int, parts: np.ndarray) -> int:
    """Write (origin, stamp, numbers, begin, end) of each register; their number, or MALFORMED."""
    found = 0
    at = skip_numbers(registers, 0, covered)
    while at < len(registers):
        begin = at
        origin, at = read_uint(registers, at)
        stamp, at = read_uint(registers, at)
        count, at = read_uint(registers, at)
        if at < 0 or count > len(registers) or found >= parts.shape[0]:
            return MALFORMED
        at = skip_numbers(registers, at, count)
        parts[found, 0], parts[found, 1], parts[found, 2] = origin, stamp, count
        parts[found, 3], parts[found, 4] = begin, at
        found += 1
    return found


@kernel
def speaks_of_others(
    logs: bytes, claims: bytes, registers: bytes, covered: int, valued: bool, source: int
) -> bool:
    """Whether a message has a suffix, a claim or a register of any origin but its source, or is malformed.

    covered: incarnation ids that the sender knows. valued: entries of logs have values.
    """
    at = 0
    while at < len(logs):
        origin, at = read_uint(logs, at)
        for _ in range(2):
            _number, at = read_uint(logs, at)
        count, at = read_uint(logs, at)
        if at < 0 or origin != source or count > len(logs):
            return True
        at = skip_numbers(logs, at, 2 * count if valued else count)
    at = 0
    while at < len(claims):
        origin, at = read_uint(claims, at)
        if at < 0 or origin != source:
            return True
        at = skip_numbers(claims, at, 3)
    at = skip_numbers(registers, 0, covered)
    while at < len(registers):
        origin, at = read_uint(registers, at)
        _stamp, at = read_uint(registers, at)
        count, at = read_uint(registers, at)
        if at < 0 or origin != source or count > len(registers):
            return True
        at = skip_numbers(registers, at, count)
    return False


@kernel
def _read_entries(logs: bytes, at: int, bound: int, value_max: int, entries: np.ndarray) -> int:
    """Read the entries of a suffix, from its first byte on; the position after them, or MALFORMED."""
    for _ in range(4):
        _number, at = read_uint(logs, at)
    index = 0
    for i in range(entries.shape[0]):
        index, value, at = read_pair(logs, at, index, value_max > 0)
        if at < 0 or index < 0 or index >= bound or value > value_max:
            return MALFORMED
        entries[i, 0], entries[i, 1] = np.int32(index), np.int32(value)
    return at


@kernel
def _put_claims(claims: np.ndarray, out: np.ndarray) -> int:
    at = 0
    for i in range(claims.shape[0]):
        for j in range(claims.shape[1]):
            at = put_uint(out, at, claims[i, j])
    return at


def suffixes_in(logs: bytes, *, valued: bool) -> list[Part] | None:
    """The suffixes in a message; None if it is malformed. valued: entries have values."""
    parts = np.zeros((_PARTS_MAX, 5), dtype=np.int64)
    return _listed(parts, _scan_suffixes(logs, valued, parts))


def registers_in(registers: bytes, covered: int) -> list[Part] | None:
    """The registers in a message; None if it is malformed. covered: incarnation ids that its sender knows."""
    parts = np.zeros((_PARTS_MAX, 5), dtype=np.int64)
    return _listed(parts, _scan_registers(registers, covered, parts))


def _listed(parts: npt.NDArray[np.int64], found: int) -> list[Part] | None:
    return None if found < 0 else [Part(*numbers) for numbers in parts[:found].tolist()]


def entries_of(
    logs: bytes, suffix: Part, bound: int, value_max: int
) -> npt.NDArray[np.int32] | None:
    """(size, 2) entries of a suffix, indices and values; None if it is malformed.

    bound, value_max: see ReplicaConfig.
    """
    entries = np.zeros((suffix.size, 2), dtype=np.int32)
    end = _read_entries(logs, suffix.begin, bound, value_max, entries)
    return entries if end == suffix.end else None


def packed_claims(claims: Sequence[tuple[int, int, int, int]]) -> bytes:
    """Claims as a message has them: incarnation id, stamp, sample + 1, since_ns."""
    numbers = np.array(claims, dtype=np.int64).reshape(-1, 4)
    out = np.zeros(_CLAIM_BYTES * numbers.shape[0], dtype=np.uint8)
    return out[: _put_claims(numbers, out)].tobytes()
