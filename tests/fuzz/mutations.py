"""Bad inputs made of good ones: a few microseconds each, the same for the same seed.

A good input is known with its *spans*: where the values in it begin and end (msgpack values, LEB128
numbers, lines and words of a text). Mutations move, repeat, replace and cut whole values as well as single
bits, so that most inputs are wrong in one place only and get deep into a decoder.
"""

import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import msgspec

Span = tuple[int, int]
Draw = Callable[[], float]
"""Uniform in [0, 1)."""

_LONGEST = 1 << 16
"""Mutations make nothing longer; what is oversized on purpose comes as a token."""


class Good(NamedTuple):
    """A good input."""

    content: bytes
    spans: tuple[Span, ...]


class Grammar(NamedTuple):
    """What inputs of a kind are made of."""

    goods: tuple[Good, ...]
    tokens: tuple[bytes, ...]
    """What may stand in the place of a value."""


# Spans.


def msgpack_spans(content: bytes) -> tuple[Span, ...]:
    """Every value, containers whole, and the numbers in whatever is made of bytes."""
    spans: list[Span] = []
    at = 0
    while at < len(content):
        at = _walk(content, at, spans)
    return tuple(spans)


def _walk(content: bytes, at: int, spans: list[Span]) -> int:
    first, start = content[at], at
    at += 1
    kind, count = _head(first)
    if isinstance(count, str):
        width = int(count)
        count = int.from_bytes(content[at : at + width], "big")
        at += width
    if kind == "items":
        for _ in range(count):
            at = _walk(content, at, spans)
    elif kind == "bytes":
        spans += [(at + low, at + high) for low, high in number_spans(content[at : at + count])]
        at += count
    else:
        at += count
    spans.append((start, at))
    return at


def _head(first: int) -> tuple[str, int | str]:
    """What follows a first byte: items, bytes or skipped, and how many or the width of that number."""
    if 0x80 <= first <= 0x8F:
        return "items", 2 * (first & 15)
    if 0x90 <= first <= 0x9F:
        return "items", first & 15
    if 0xA0 <= first <= 0xBF:
        return "skipped", first & 31
    wide: dict[int, tuple[str, int | str]] = {
        0xC4: ("bytes", "1"),
        0xC5: ("bytes", "2"),
        0xC6: ("bytes", "4"),
        0xD9: ("skipped", "1"),
        0xDA: ("skipped", "2"),
        0xDB: ("skipped", "4"),
        0xDC: ("items", "2"),
        0xDD: ("items", "4"),
        0xCA: ("skipped", 4),
        0xCB: ("skipped", 8),
        **{0xCC + i: ("skipped", 1 << i) for i in range(4)},
        **{0xD0 + i: ("skipped", 1 << i) for i in range(4)},
    }
    return wide.get(first, ("skipped", 0))


def number_spans(content: bytes) -> tuple[Span, ...]:
    """LEB128 numbers."""
    ends = [i + 1 for i, byte in enumerate(content) if byte < 128]
    return tuple(zip([0, *ends], ends, strict=False))


def text_spans(content: bytes) -> tuple[Span, ...]:
    """Lines, and words in them."""
    spans, at = [], 0
    for line in content.splitlines(keepends=True):
        spans.append((at, at + len(line)))
        start = at
        for word in line.split(b" "):
            spans.append((start, start + len(word.rstrip(b"\n"))))
            start += len(word) + 1
        at += len(line)
    return tuple(span for span in spans if span[1] > span[0])


def even_spans(content: bytes) -> tuple[Span, ...]:
    """Of what has no values that we know: pieces of four bytes."""
    return tuple((at, at + 4) for at in range(0, len(content) - 3, 4))


# Tokens.


def leb(value: int) -> bytes:
    """LEB128."""
    out = bytearray()
    while value >= 128:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


_EDGES = (0, 1, 2, 3, 5, 127, 128, 255, 256, 2**16 - 1, 2**31 - 1, 2**31, 2**32, 2**40, 2**40 + 1)
_NUMBERS = (*_EDGES, 2**52, 2**52 + 1, 2**53, 2**62, 2**62 + 1, 2**63 - 1)
LEB_TOKENS = (
    *map(leb, (*_NUMBERS, 2**63, 2**64 - 1, 2**64, 2**70)),
    b"\x80" * 9 + b"\x00",  # longer than it need be
    b"\x80\x00",
    b"\xff" * 10,
    b"\xff" * 30,
    b"\x80",
)

_pack = msgspec.msgpack.encode
MSGPACK_TOKENS = (
    *(_pack(number) for edge in _NUMBERS for number in (edge, -edge)),
    *map(_pack, (2**63, 2**64 - 1, -(2**63), None, True, False)),
    *map(_pack, (0.0, -0.0, 1.5, 1e308, -1e308, 5e-324, float("nan"), float("inf"), -float("inf"))),
    *(b"\xca\x7f\x80\x00\x00", b"\xca\x7f\xc0\x00\x00", b"\xca\x3f\x80\x00\x00"),  # single floats
    *map(_pack, ("", "r1", "r2", "r9", "supervisor", "é", "x" * 300, b"", b"\x00", b"\xff" * 300)),
    *map(_pack, ([], [[]], [0] * 20, {}, {"a": 1}, {1: 2})),
    *(b"\xa2\xff\xfe", b"\xa1\x80"),  # texts that are none
    *(b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdc\xff\xff"),  # items that never come
    *(b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc9\xff\xff\xff\xff\x01"),
    *(b"\xc1", b"\xd4\x01\x00", b"\xd8\x01" + bytes(16), b"\xc7\x00\x05"),
    *(b"\xd6\xff\x00\x00\x00\x01", b"\xd7\xff" + bytes(8), b"\xc7\x0c\xff" + b"\xff" * 12),  # times
    *(b"\x91" * 40 + b"\xc0", b"\x91" * 1100 + b"\xc0", b"\x81\xc0" * 600 + b"\xc0"),
    *LEB_TOKENS,
)


# Mutations.


def flip(content: bytes, spans: Sequence[Span], draw: Draw) -> bytes:
    """One bit."""
    if not content:
        return b"\x00"
    at = int(draw() * len(content))
    return content[:at] + bytes((content[at] ^ 1 << int(draw() * 8),)) + content[at + 1 :]


def overwrite(content: bytes, spans: Sequence[Span], draw: Draw) -> bytes:
    """One byte."""
    at = int(draw() * (len(content) + 1))
    return content[:at] + bytes((int(draw() * 256),)) + content[at + 1 :]


def cut(content: bytes, spans: Sequence[Span], draw: Draw) -> bytes:
    """The end is missing, or something in the middle."""
    low = int(draw() * (len(content) + 1))
    if draw() < 0.6:
        return content[:low]
    return content[:low] + content[low + 1 + int(draw() * 8) :]


def append(content: bytes, spans: Sequence[Span], draw: Draw) -> bytes:
    """More than there should be."""
    return content + bytes(int(draw() * 256) for _ in range(1 + int(draw() * 6)))


def leave_out(content: bytes, spans: Sequence[Span], draw: Draw) -> bytes:
    """A value."""
    low, high = spans[int(draw() * len(spans))]
    return content[:low] + content[high:]


def repeat(content: bytes, spans: Sequence[Span], draw: Draw) -> bytes:
    """A value twice, or often."""
    low, high = spans[int(draw() * len(spans))]
    times = 2 if draw() < 0.8 else int(2 + draw() * 40)
    return content[:low] + content[low:high] * times + content[high:]


def move(content: bytes, spans: Sequence[Span], draw: Draw) -> bytes:
    """A value in the place of another one."""
    low, high = spans[int(draw() * len(spans))]
    start, end = spans[int(draw() * len(spans))]
    return content[:low] + content[start:end] + content[high:]


_BLIND = (flip, overwrite, cut, append)
_WHOLE = (leave_out, repeat, move)


class Mutations:
    """Inputs of one kind."""

    def __init__(self, grammar: Grammar) -> None:
        self._goods = grammar.goods
        self._tokens = grammar.tokens

    def batch(self, name: object, count: int) -> list[bytes]:
        """So many inputs; the same for the same name."""
        draw = random.Random(str(name)).random
        return [self._one(draw) for _ in range(count)]

    def _one(self, draw: Draw) -> bytes:
        goods = self._goods
        content, spans = goods[int(draw() * len(goods))]
        chance = draw()
        if chance < 0.02:
            return content
        if chance < 0.03:
            return bytes(int(draw() * 256) for _ in range(int(draw() * 40)))
        for _ in range(1 if chance < 0.6 else 2 if chance < 0.85 else 4):
            content = self._change(content, spans, draw)
        return content if len(content) <= _LONGEST else content[:_LONGEST]

    def _change(self, content: bytes, spans: Sequence[Span], draw: Draw) -> bytes:
        chance = draw()
        if chance < 0.3 or not spans:
            return _BLIND[int(draw() * 4)](content, spans, draw)
        if chance < 0.5:
            return _WHOLE[int(draw() * 3)](content, spans, draw)
        low, high = spans[int(draw() * len(spans))]
        if chance < 0.85:  # another value instead, or beside
            token = self._tokens[int(draw() * len(self._tokens))]
            return content[:low] + token + content[high if chance < 0.78 else low :]
        other, places = self._goods[int(draw() * len(self._goods))]
        start, end = places[int(draw() * len(places))] if places else (0, len(other))
        if chance < 0.97:  # a value of another input
            return content[:low] + other[start:end] + content[high:]
        return content[:low] + other[start:]


class Framed:
    """Inputs of several fields, each mutated for itself; msgpack holds them together."""

    def __init__(
        self,
        goods: Sequence[tuple[bytes, ...]],
        tokens: tuple[bytes, ...],
        spans: Callable[[bytes], tuple[Span, ...]] = number_spans,
    ) -> None:
        self._goods = goods
        fields = range(len(goods[0]))
        self._fields = [
            Mutations(Grammar(tuple(Good(good[i], spans(good[i])) for good in goods), tokens))
            for i in fields
        ]

    def batch(self, name: object, count: int) -> list[bytes]:
        """So many inputs; the same for the same name."""
        draw = random.Random(str(name)).random
        return [self._one(draw) for _ in range(count)]

    def _one(self, draw: Draw) -> bytes:
        fields = list(self._goods[int(draw() * len(self._goods))])
        for _ in range(1 if draw() < 0.7 else 2):
            i = int(draw() * len(fields))
            fields[i] = self._fields[i]._one(draw)
        return _pack(fields)


unframe = msgspec.msgpack.Decoder(tuple[bytes, ...]).decode


def pick(contents: Iterable[bytes], most: int, longest: int) -> Iterator[bytes]:
    """Different ones that are not too long, from the shortest to the longest."""
    known = sorted(set(contents), key=lambda content: (len(content), content))
    short = [content for content in known if len(content) <= longest] or known[:1]
    step = max(1.0, (len(short) - 1) / max(1, most - 1))
    yield from (short[round(i * step)] for i in range(min(most, len(short))))
