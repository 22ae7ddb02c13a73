"""`kantor tap`: whatever is on the bus is shown as one line of printable characters."""

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_fleet.processes.tap import describe
from support.strategies import examples

LINE_MAX = 12_000
"""Of a line in which every character is escaped."""


def nested_bodies(depth: int) -> bytes:
    """A radio body in a radio body, and so on."""
    body = b"x"
    for _ in range(depth):
        body = bytes(msgpack.packb([1, 1, body]))
    return body


HOSTILE = {
    "a key that cannot be hashed": b"\x81\x90\xc0",
    "nested arrays": b"\x91" * 500 + b"\xc0",
    "nested too deeply": b"\x91" * 5000 + b"\xc0",
    "bodies in bodies": nested_bodies(400),
    "escape sequences in a key": msgpack.packb({"\x1b]0;owned\x07\x1b[2J\x1b[31mFAKE\x1b[0m": 1}),
    "a line in a key": msgpack.packb({"\n    0.100  r1         tx       forged": 1}),
    "letters that turn the line around": msgpack.packb({"\u202egnorw": "\x9b2J\u2028"}),
    "a long text": msgpack.packb("A" * 1_000_000),
    "a long key": msgpack.packb({"A" * 1_000_000: 1}),
    "a long extension": msgpack.packb(msgpack.ExtType(5, b"A" * 1_000_000)),
    "a moment": msgpack.packb(msgpack.Timestamp(2**33, 1)),
    "a moment that is none": b"\xc7\x0c\xff" + b"\xff" * 12,
    "no UTF-8": b"\xa2\xff\xfe",
    "a surrogate": b"\xa3\xed\xa0\x80",
    "a map of many": msgpack.packb({i: i for i in range(10_000)}),
    "a wide tree": msgpack.packb([[[[["A" * 80] * 20] * 20] * 20] * 20]),
    "an array without end": b"\xdd\xff\xff\xff\xff",
    "nothing": b"",
}


def assert_one_line(payload: bytes) -> str:
    """The description of a payload, which is printable and not long."""
    line = describe(payload)
    assert line.startswith(f"{len(payload)} B")
    assert line.isprintable()
    assert len(line) <= LINE_MAX
    return line


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_message_is_one_line(name: str) -> None:
    """No exception, no control character, no end of line; long and deep values are cut."""
    assert_one_line(HOSTILE[name])


@examples(300)
@given(st.binary(max_size=300))
def test_any_bytes_are_one_line(payload: bytes) -> None:
    """Whatever a participant puts on its own keys."""
    assert_one_line(payload)


LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(), st.binary()
)


@examples(300)
@given(st.recursive(LEAVES, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
def test_any_content_is_one_line(content: object) -> None:
    """Whatever msgpack can hold."""
    assert_one_line(bytes(msgpack.packb(content)))


def test_a_message_is_shown_with_its_values() -> None:
    """Lists, maps, texts, numbers, and the body of an envelope."""
    payload = msgpack.packb([6, 1, {"r1": 2.5}, msgpack.packb([1, 1, 7]), b"\xff" * 30])
    line = assert_one_line(bytes(payload))

    assert line == f"{len(payload)} B  [6, 1, {{'r1': 2.5}}, <[1, 1, 7]>, 0x{'ff' * 24}…(30 B)]"
