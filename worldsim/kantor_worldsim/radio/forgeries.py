"""Forged envelopes: what nobody sent and nobody may take in.

A catalogue of what a broken or hostile peer could send. Every participant of every mission refuses each of
them, whatever it merges and whatever its planner shares: a forgery is counted and changes nothing. What is
forged rests on keyed draws, and on the message that it comes extra.
"""

import math
from collections.abc import Callable

from msgspec.structs import replace

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, WORLD_SIM, Envelope, ParticipantId
from kantor_protocol.wire.messages import (
    BODY_BYTES_MAX,
    VERSION,
    GossipMessage,
    RefusedError,
    decode_gossip,
    encode,
    encode_gossip,
)

OVERSIZED_SHARE = 1 / 256
"""Share of forgeries that are too large. Each stays in the record with all its bytes, so there are few."""

_NO_NEWS = GossipMessage(VERSION, 0, 0.0, 0.0, b"", b"", b"")
_STRANGERS = ("r0", "mallory", WORLD_SIM, SUPERVISOR, "r1 ", "R1", "r999999", "r\u0661", "r1" * 64)
_OVERSIZED = bytes(BODY_BYTES_MAX + 1)
_NOISE_BYTES_MAX = 96
_NESTED = 10_000
_FIELDS = 11
"""One more than news has: what comes behind its fields is skipped."""

# LEB128.
_NOT_ENDING = b"\x80"
_OF_70_BITS = b"\xff" * 9 + b"\x7f"
_OF_63_BITS = b"\xff" * 8 + b"\x7f"
_NO_ORIGIN = b"\xff\xff\xff\x7f"
"""2**28 - 1: no roster has such a place, not with all its incarnations."""


class ForgeryDraws:
    """Keyed draws for one forgery."""

    def __init__(self, seed: int, link: int, sequence: int, index: int) -> None:
        """link, sequence: of what it comes extra. index: of which the lower 16 bits count the draws."""
        self._key = seed, Purpose.FORGERY.value, link, sequence
        self._index = index

    def share(self) -> float:
        """In [0, 1)."""
        draw: float = uniform(*self._key, self._index)
        self._index += 1
        return draw

    def below(self, count: int) -> int:
        """In [0, count)."""
        return int(self.share() * count)


Forger = Callable[[ForgeryDraws, bytes, GossipMessage], bytes]
"""Makes a body to be refused of a sound one, given also as what it says."""


def _nothing(_dice: ForgeryDraws, _body: bytes, _news: GossipMessage) -> bytes:
    return b""


def _noise(dice: ForgeryDraws, _body: bytes, _news: GossipMessage) -> bytes:
    length = 1 + dice.below(_NOISE_BYTES_MAX)
    noise = b"".join([dice.below(1 << 48).to_bytes(6, "big") for _ in range(0, length, 6)])[:length]
    return b"" if _is_news(noise) else noise


def _cut_short(dice: ForgeryDraws, body: bytes, _news: GossipMessage) -> bytes:
    return body[: dice.below(len(body))]


def _another_version(dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    return encode_gossip(replace(news, version=VERSION + (1, -1, 2**40)[dice.below(3)]))


def _nowhere(dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    place_m = (math.nan, math.inf, -math.inf)[dice.below(3)]
    return encode_gossip(
        replace(news, y_m=place_m) if dice.below(2) else replace(news, x_m=place_m)
    )


def _before_the_start(_dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    return encode_gossip(replace(news, step=-1))


def _of_no_incarnation(dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    return encode_gossip(
        replace(news, incarnation=(INCARNATIONS_MAX + 1, -1, 2**40)[dice.below(3)])
    )


def _another_kind(_dice: ForgeryDraws, body: bytes, _news: GossipMessage) -> bytes:
    return encode(body)


def _vector_of_wrong_length(_dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    """Incarnations make it longer by the whole roster; who has a peer is not alone in one."""
    return encode_gossip(replace(news, version_vector=news.version_vector + b"\0"))


def _huge_number_in_vector(_dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    return encode_gossip(replace(news, version_vector=_OF_70_BITS + news.version_vector[1:]))


def _log_of_nobody(_dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    return encode_gossip(replace(news, logs=news.logs + _NO_ORIGIN + b"\0\0\0"))


def _claim_of_nobody(_dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    return encode_gossip(replace(news, claims=news.claims + _NO_ORIGIN + b"\1\0\0"))


def _endless_log(_dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    """From an absurd position on, absurdly long."""
    return encode_gossip(replace(news, logs=b"\0" + _OF_63_BITS * 3 + news.logs))


def _huge_number_in_log(_dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    return encode_gossip(replace(news, logs=news.logs + b"\0" + _OF_70_BITS))


def _log_cut_in_a_number(dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    return encode_gossip(
        replace(news, logs=news.logs[: dice.below(len(news.logs) + 1)] + _NOT_ENDING)
    )


def _register_cut_in_a_number(dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    cut = dice.below(len(news.registers) + 1)
    return encode_gossip(replace(news, registers=news.registers[:cut] + _NOT_ENDING))


def _nested(_dice: ForgeryDraws, _body: bytes, news: GossipMessage) -> bytes:
    """Beyond the fields that are known, arrays within arrays that do not end."""
    fields = encode(replace(news, incarnation=0))[1:]
    return bytes([0x90 + _FIELDS]) + fields + b"\x91" * _NESTED


def _oversized(_dice: ForgeryDraws, _body: bytes, _news: GossipMessage) -> bytes:
    return _OVERSIZED


FORGERS: tuple[Forger, ...] = (
    _nothing,
    _noise,
    _cut_short,
    _another_version,
    _nowhere,
    _before_the_start,
    _of_no_incarnation,
    _another_kind,
    _vector_of_wrong_length,
    _huge_number_in_vector,
    _log_of_nobody,
    _claim_of_nobody,
    _endless_log,
    _huge_number_in_log,
    _log_cut_in_a_number,
    _register_cut_in_a_number,
    _nested,
    _oversized,
)
"""The last one is rare."""


def strangers(roster: tuple[ParticipantId, ...]) -> tuple[ParticipantId, ...]:
    """Names that nobody has, EVERYBODY among them."""
    return (EVERYBODY, *(name for name in _STRANGERS if name not in roster))


def forge(
    dice: ForgeryDraws, envelope: Envelope, names: tuple[ParticipantId, ...]
) -> tuple[str, bytes]:
    """Source and body of what comes beside an envelope.

    names: strangers, in whose name the very body of the envelope comes again.
    """
    if dice.share() < OVERSIZED_SHARE:
        return envelope.source, _oversized(dice, envelope.body, _NO_NEWS)
    which = dice.below(len(FORGERS) + 1)
    if which >= len(FORGERS) - 1:  # a stranger is as likely as any two forgeries
        return names[dice.below(len(names))], envelope.body
    return envelope.source, forged(FORGERS[which], dice, envelope.body)


def forged(forger: Forger, dice: ForgeryDraws, body: bytes) -> bytes:
    """What a forger makes of a body, which may itself be none."""
    try:
        news = decode_gossip(body)
    except RefusedError:
        news = _NO_NEWS
    return forger(dice, body, news)


def _is_news(body: bytes) -> bool:
    try:
        decode_gossip(body)
    except RefusedError:
        return False
    return True
