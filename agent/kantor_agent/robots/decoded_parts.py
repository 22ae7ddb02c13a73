"""The parts of a gossip message as lists, and back: for who changes what another program says (`byzantine.py`).

Only the robot's own messages are read here, which are well-formed.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from kantor_protocol.base.varint import put_uint, read_int, read_pair, read_uint

_NUMBER_BYTES = 10
"""Of one number, at most."""


class Suffix(NamedTuple):
    """A suffix of a log; see `GossipMessage.logs`."""

    origin: int
    start: int
    span: int
    entries: list[tuple[int, int]]
    """Index and value; in a log of bare indices the value is 0."""


class Claim(NamedTuple):
    """A claim; see `GossipMessage.claims`."""

    origin: int
    stamp: int
    sample: int
    """One more than the sample; 0: none."""
    since_ns: int


class Register(NamedTuple):
    """A register; see `GossipMessage.registers`."""

    origin: int
    stamp: int
    numbers: list[int]


def suffixes_in(logs: bytes, *, valued: bool) -> list[Suffix]:
    """The suffixes of a message. valued: entries have values."""
    suffixes, at = [], 0
    while at < len(logs):
        (origin, start, span, count), at = _uints(logs, at, 4)
        entries, index = [], 0
        for _ in range(count):
            index, value, at = read_pair(logs, at, index, valued)
            entries.append((index, value))
        suffixes.append(Suffix(origin, start, span, entries))
    return suffixes


def packed_suffixes(suffixes: Iterable[Suffix], *, valued: bool) -> bytes:
    """Suffixes as in a message."""
    numbers: list[int] = []
    for origin, start, span, entries in suffixes:
        numbers += [origin, start, span, len(entries)]
        before = 0
        for index, value in entries:
            numbers += [_folded(index - before), value] if valued else [_folded(index - before)]
            before = index
    return packed_uints(numbers)


def claims_in(claims: bytes) -> list[Claim]:
    """The claims of a message."""
    numbers = uints_in(claims)
    return [Claim(*numbers[i : i + 4]) for i in range(0, len(numbers), 4)]


def packed_claims(claims: Iterable[Claim]) -> bytes:
    """Claims as in a message."""
    return packed_uints(number for claim in claims for number in claim)


def registers_in(registers: bytes, origins: int) -> tuple[list[int], list[Register]]:
    """The stamps of so many origins, and the registers of a message."""
    stamps, at = _uints(registers, 0, origins)
    found = []
    while at < len(registers):
        (origin, stamp, count), at = _uints(registers, at, 3)
        numbers = []
        for _ in range(count):
            number, at = read_int(registers, at)
            numbers.append(number)
        found.append(Register(origin, stamp, numbers))
    return stamps, found


def packed_registers(stamps: Iterable[int], registers: Iterable[Register]) -> bytes:
    """Stamps and registers as in a message."""
    numbers = list(stamps)
    for origin, stamp, values in registers:
        numbers += [origin, stamp, len(values), *map(_folded, values)]
    return packed_uints(numbers)


def uints_in(content: bytes) -> list[int]:
    """All numbers of a version vector or of claims."""
    numbers, at = [], 0
    while at < len(content):
        number, at = read_uint(content, at)
        numbers.append(number)
    return numbers


def packed_uints(numbers: Iterable[int]) -> bytes:
    """Numbers as LEB128."""
    listed = list(numbers)
    out, at = np.zeros(_NUMBER_BYTES * len(listed), dtype=np.uint8), 0
    for number in listed:
        at = put_uint(out, at, number)
    return out[:at].tobytes()


def _uints(content: bytes, at: int, count: int) -> tuple[list[int], int]:
    numbers = []
    for _ in range(count):
        number, at = read_uint(content, at)
        numbers.append(number)
    return numbers, at


def _folded(number: int) -> int:
    return number << 1 if number >= 0 else (-number << 1) - 1
