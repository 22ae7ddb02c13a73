"""Decoders of messages: gossip, what participants and world-sim send each other, arrays and weights."""

from pathlib import Path

import msgspec

from fuzz.decoding import Decode
from kantor_protocol.wire.attestations import attestations_in, sign_body, without_signatures
from kantor_protocol.wire.messages import (
    Array,
    Mission,
    RefusedError,
    decode_from_participant,
    decode_gossip,
    decode_to_participant,
    encode,
    encode_gossip,
)
from kantor_protocol.wire.signatures import SIGNATURE_BYTES
from kantor_protocol.wire.signing_keys import Ed25519Key
from kantor_protocol.wire.weights import WeightsSubscriber

_KEY = Ed25519Key(bytes(32))


def gossip(content: bytes) -> None:
    """A gossip message that is decoded and encoded again stays as it is."""
    message = decode_gossip(content)
    assert decode_gossip(encode_gossip(message)) == message, "gossip that changes on the way"


def signatures(content: bytes) -> bool:
    """Signing changes the last bytes alone, and without signatures a body is the same whoever has signed it."""
    bare = without_signatures(content)
    assert without_signatures(bare) == bare, "signatures that are there after all"
    signed = sign_body("run", bare, _KEY)
    assert len(signed) == len(bare)
    assert signed[:-SIGNATURE_BYTES] == bare[:-SIGNATURE_BYTES], "more has changed than a signature"
    assert without_signatures(signed) == bare, "a signature that stays"
    return bool(attestations_in(content))


def from_participant(content: bytes) -> None:
    """A report or `Ready` that is decoded and encoded again stays as it is."""
    message = decode_from_participant(content)
    assert decode_from_participant(encode(message)) == message, "a message that changes on the way"


def to_participant(content: bytes) -> None:
    """The arrays of a mission can be opened, or are refused."""
    message = decode_to_participant(content)
    if isinstance(message, Mission):
        message.starts.open("<f8", 2)
        message.samples.open("<f8", 2)


_ARRAY = msgspec.msgpack.Decoder(Array)


def array_content(content: bytes) -> bool:
    """An array is opened with all of its content, or refused."""
    try:
        array = _ARRAY.decode(content)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False  # which the targets of messages judge
    for dtype, dimensions in (("<f8", 2), ("u1", 2), ("<f8", 1)):
        try:
            opened = array.open(dtype, dimensions)
        except RefusedError:
            continue
        assert opened.ndim == dimensions
        assert opened.nbytes == len(array.content)
        return True
    return False


def weights(_folder: Path) -> Decode:
    """A subscriber to weights; a refused message changes nothing."""
    subscriber = WeightsSubscriber()

    def take(content: bytes) -> bool:
        before = subscriber.weights
        taken = subscriber.apply(content)
        assert taken or subscriber.weights is None or subscriber.weights is before
        assert not taken or (subscriber.weights is not None and subscriber.weights.min() >= 0)
        return taken

    return take
