"""The observers' own reader of the numbers in a gossip message, shared by checkers and map tracker.

Participants read the same bytes with other code (`wire/version_vector.py`, `replication`), so that a mistake
there does not pass unseen. The kernels are total: whatever the bytes, they stay inside them.
"""

import numpy as np

from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import read_int, read_uint

LOG_LENGTH_MAX = 1 << 40
"""Longer than any log."""
ANY_ORIGIN = 1 << 62
"""Above every incarnation id, for readers that judge origins themselves."""


@kernel
def count_incarnations(payload: bytes, at: int, end: int, participants: int, parts: int) -> int:
    """The incarnations that the version vector in payload[at:end] is about; 0 if it is malformed.

    parts: 2 if a claim stamp of each follows the log lengths, otherwise 1.
    """
    numbers = 0
    while 0 <= at < end:
        _value, at = read_uint(payload, at)
        numbers += 1
    blocks = numbers // (parts * participants)
    whole = at == end and numbers == blocks * parts * participants
    return blocks * participants if whole and blocks <= INCARNATIONS_MAX + 1 else 0


@kernel
def is_log(payload: bytes, at: int, end: int, numbers: int, origins: int) -> bool:
    """Whether payload[at:end] is a row of log suffixes (see `GossipMessage.logs`) of origins below `origins`.

    numbers: 2 if an entry is a sample and units, 1 if it is a cell; of cells none is left out.
    """
    while 0 <= at < end:
        origin, at = read_uint(payload, at)
        start, at = read_uint(payload, at)
        span, at = read_uint(payload, at)
        count, at = read_uint(payload, at)
        if at < 0 or origin >= origins or start > LOG_LENGTH_MAX or count > end - at:
            return False
        if numbers == 1 and count != span:
            return False
        for _ in range(numbers * count):
            _value, at = read_uint(payload, at)
    return at == end


@kernel
def _read_lengths(payload: bytes, lengths: np.ndarray) -> None:
    at = 0
    for origin in range(lengths.shape[0]):
        lengths[origin], at = read_uint(payload, at)


def incarnations_of(version_vector: bytes, participants: int, *, claims: bool) -> int:
    """The incarnations that a version vector is about; 0 if it is malformed."""
    parts = 2 if claims else 1
    return int(count_incarnations(version_vector, 0, len(version_vector), participants, parts))


def read_lengths(version_vector: bytes, participants: int, *, claims: bool) -> list[int] | None:
    """The log length of every incarnation in a version vector; None if it is malformed."""
    count = incarnations_of(version_vector, participants, claims=claims)
    if not count:
        return None
    lengths = np.zeros(count, dtype=np.int64)
    _read_lengths(version_vector, lengths)
    return [int(length) for length in lengths.tolist()]


@kernel
def _find_register(payload: bytes, origins: int, wanted: int, register: np.ndarray) -> int:
    at = 0
    for _ in range(origins):
        _stamp, at = read_uint(payload, at)
    found = 0
    while 0 <= at < len(payload):
        origin, at = read_uint(payload, at)
        stamp, at = read_uint(payload, at)
        numbers, at = read_uint(payload, at)
        if at < 0 or origin >= origins or stamp < 1 or numbers > register.shape[0]:
            return -1
        for i in range(numbers):
            number, at = read_int(payload, at)
            if origin == wanted:
                register[i] = number
        if origin == wanted:
            found = stamp
    return found if at >= 0 else -1


def read_register(
    registers: bytes, origins: int, width: int, wanted: int
) -> tuple[int, np.ndarray] | None:
    """Stamp and numbers (width,) of an origin's register; stamp 0 if it is absent, None if malformed.

    origins: the incarnations that the version vector beside it is about.
    """
    register = np.zeros(width, dtype=np.int64)
    stamp = int(_find_register(registers, origins, wanted, register))
    return None if stamp < 0 else (stamp, register)


def claims_of(claims: bytes) -> list[tuple[int, int, int, int]]:
    """The whole claims in a message: incarnation id of the origin, stamp, sample + 1, since_ns."""
    numbers, at = [], 0
    while 0 <= at < len(claims):
        number, at = read_uint(claims, at)
        numbers.append(number)
    whole = len(numbers) - len(numbers) % 4
    return [
        (numbers[i], numbers[i + 1], numbers[i + 2], numbers[i + 3]) for i in range(0, whole, 4)
    ]


def registers_of(registers: bytes, origins: int) -> list[tuple[int, ...]]:
    """The registers in a message: incarnation id of the origin, stamp, then the numbers; up to where it is malformed.

    origins: the incarnations that the version vector beside it is about.
    """
    at = 0
    for _ in range(origins):
        _stamp, at = read_uint(registers, at)
    found = []
    while 0 <= at < len(registers):
        origin, at = read_uint(registers, at)
        stamp, at = read_uint(registers, at)
        count, at = read_uint(registers, at)
        numbers: list[int] = []
        while 0 <= at <= len(registers) and len(numbers) < count:
            number, at = read_int(registers, at)
            numbers.append(number)
        if at >= 0:
            found.append((origin, stamp, *numbers))
    return found
