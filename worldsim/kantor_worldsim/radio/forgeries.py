"""Forged envelopes: extra envelopes that no participant sent and that every receiver must refuse.

A catalogue of envelopes that a broken or hostile peer could send. Every participant of every mission refuses each
of them, by every merge rule and with every planner: a forgery is counted and changes nothing. Forgeries depend on
keyed draws and on the message with which they arrive.
"""

import math
from collections.abc import Callable

from msgspec.structs import replace

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, WORLD_SIM, Envelope, ParticipantId
from kantor_protocol.wire.attestations import without_signatures
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

_EMPTY_MESSAGE = GossipMessage(VERSION, 0, 0.0, 0.0, b"", b"", b"")
_STRANGERS = ("r0", "mallory", WORLD_SIM, SUPERVISOR, "r1 ", "R1", "r999999", "r\u0661", "r1" * 64)
_OVERSIZED = bytes(BODY_BYTES_MAX + 1)
_NOISE_BYTES_MAX = 96
_NESTED = 10_000
_FIELDS, _UNPROVEN = 11, encode(()) + encode(())
"""Of a gossip message, with its tag and its proofs. Its last two fields when they are empty."""

# LEB128.
_NOT_ENDING = b"\x80"
_OF_70_BITS = b"\xff" * 9 + b"\x7f"
_OF_63_BITS = b"\xff" * 8 + b"\x7f"
_UNKNOWN_ORIGIN = b"\xff\xff\xff\x7f"
"""2**28 - 1: no roster has such an index, with all its incarnations."""


class ForgeryDraws:
    """Keyed draws for one forgery."""

    def __init__(self, seed: int, link: int, sequence: int, index: int) -> None:
        """link, sequence: of the message with which it arrives. index: its lower 16 bits count the draws."""
        self._key = seed, Purpose.FORGERY.value, link, sequence
        self._index = index

    def share(self) -> float:
        """Draw uniformly from [0, 1)."""
        draw: float = uniform(*self._key, self._index)
        self._index += 1
        return draw

    def below(self, count: int) -> int:
        """Draw an integer uniformly from [0, count)."""
        return int(self.share() * count)


Forger = Callable[[ForgeryDraws, bytes, GossipMessage], bytes]
"""Makes a body that must be refused from a sound one, which is also given decoded."""


def _empty(_draws: ForgeryDraws, _body: bytes, _message: GossipMessage) -> bytes:
    return b""


def _noise(draws: ForgeryDraws, _body: bytes, _message: GossipMessage) -> bytes:
    length = 1 + draws.below(_NOISE_BYTES_MAX)
    noise = b"".join([draws.below(1 << 48).to_bytes(6, "big") for _ in range(0, length, 6)])[
        :length
    ]
    return b"" if _is_gossip(noise) else noise


def _cut_short(draws: ForgeryDraws, body: bytes, _message: GossipMessage) -> bytes:
    return body[: draws.below(len(body))]


def _other_version(draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    return encode_gossip(replace(message, version=VERSION + (1, -1, 2**40)[draws.below(3)]))


def _position_not_finite(draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    place_m = (math.nan, math.inf, -math.inf)[draws.below(3)]
    return encode_gossip(
        replace(message, y_m=place_m) if draws.below(2) else replace(message, x_m=place_m)
    )


def _negative_step(_draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    return encode_gossip(replace(message, step=-1))


def _impossible_incarnation(draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    return encode_gossip(
        replace(message, incarnation=(INCARNATIONS_MAX + 1, -1, 2**40)[draws.below(3)])
    )


def _other_kind(_draws: ForgeryDraws, body: bytes, _message: GossipMessage) -> bytes:
    return encode(body)


def _vector_of_wrong_length(_draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    """One entry more: each incarnation adds an entry for the whole roster, which is more than one participant."""
    return encode_gossip(replace(message, version_vector=message.version_vector + b"\0"))


def _huge_number_in_vector(_draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    return encode_gossip(replace(message, version_vector=_OF_70_BITS + message.version_vector[1:]))


def _log_of_unknown_origin(_draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    return encode_gossip(replace(message, logs=message.logs + _UNKNOWN_ORIGIN + b"\0\0\0"))


def _claim_of_unknown_origin(_draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    return encode_gossip(replace(message, claims=message.claims + _UNKNOWN_ORIGIN + b"\1\0\0"))


def _endless_log(_draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    """A log from an absurd position on, and absurdly long."""
    return encode_gossip(replace(message, logs=b"\0" + _OF_63_BITS * 3 + message.logs))


def _huge_number_in_log(_draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    return encode_gossip(replace(message, logs=message.logs + b"\0" + _OF_70_BITS))


def _log_cut_in_a_number(draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    return encode_gossip(
        replace(message, logs=message.logs[: draws.below(len(message.logs) + 1)] + _NOT_ENDING)
    )


def _register_cut_in_a_number(draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    cut = draws.below(len(message.registers) + 1)
    return encode_gossip(replace(message, registers=message.registers[:cut] + _NOT_ENDING))


def _nested(_draws: ForgeryDraws, _body: bytes, message: GossipMessage) -> bytes:
    """Nested arrays without an end, in place of proofs."""
    fields = encode(replace(message, incarnation=0, proofs=(), attestations=()))[
        1 : -len(_UNPROVEN)
    ]
    return bytes([0x90 + _FIELDS]) + fields + b"\x91" * _NESTED


def _oversized(_draws: ForgeryDraws, _body: bytes, _message: GossipMessage) -> bytes:
    return _OVERSIZED


FORGERS: tuple[Forger, ...] = (
    _empty,
    _noise,
    _cut_short,
    _other_version,
    _position_not_finite,
    _negative_step,
    _impossible_incarnation,
    _other_kind,
    _vector_of_wrong_length,
    _huge_number_in_vector,
    _log_of_unknown_origin,
    _claim_of_unknown_origin,
    _endless_log,
    _huge_number_in_log,
    _log_cut_in_a_number,
    _register_cut_in_a_number,
    _nested,
    _oversized,
)
"""The last one is rare."""


def strangers(roster: tuple[ParticipantId, ...]) -> tuple[ParticipantId, ...]:
    """Names that no participant has, EVERYBODY among them."""
    return (EVERYBODY, *(name for name in _STRANGERS if name not in roster))


def forge(
    draws: ForgeryDraws, envelope: Envelope, names: tuple[ParticipantId, ...]
) -> tuple[str, bytes]:
    """Source and body of the forgery that arrives with an envelope.

    names: strangers, in whose name the body of the envelope may be repeated unchanged.
    """
    if draws.share() < OVERSIZED_SHARE:
        return envelope.source, _oversized(draws, envelope.body, _EMPTY_MESSAGE)
    which = draws.below(len(FORGERS) + 1)
    if which >= len(FORGERS) - 1:  # a stranger is as likely as any two forgeries
        return names[draws.below(len(names))], envelope.body
    return envelope.source, forged(FORGERS[which], draws, envelope.body)


def forged(forger: Forger, draws: ForgeryDraws, body: bytes) -> bytes:
    """The forgery that a forger makes from a body, which need not be a gossip message.

    It is made without signatures, of which it could keep a part that nobody takes for one: records depend on no key.
    """
    body = without_signatures(body)
    try:
        message = decode_gossip(body)
    except RefusedError:
        message = _EMPTY_MESSAGE
    return forger(draws, body, message)


def _is_gossip(body: bytes) -> bool:
    try:
        decode_gossip(body)
    except RefusedError:
        return False
    return True
