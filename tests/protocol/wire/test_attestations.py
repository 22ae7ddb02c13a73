"""Attestations at the edge: signed where a body ends, and nothing of a record depends on signatures."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import Envelope, Outputs, Pose
from kantor_protocol.wire.attestations import (
    UNSIGNED,
    Attestation,
    Identities,
    attestations_in,
    is_genuine,
    sign_body,
    signed,
    signed_outputs,
    unsigned_outputs,
    without_signatures,
)
from kantor_protocol.wire.messages import GossipMessage, decode_gossip, encode_gossip
from kantor_protocol.wire.signing_keys import Ed25519Key
from support.strategies import ATTESTATIONS, NEWS, examples

KEY, OTHER = Ed25519Key(bytes(32)), Ed25519Key(bytes(31) + b"\x01")
RUN = "a run"
OWN = Attestation(1, 16, 3, bytes(16))


def with_attestations(news: GossipMessage, *attestations: Attestation) -> GossipMessage:
    """The message with these attestations."""
    return msgspec.structs.replace(news, attestations=attestations)


@examples(100)
@given(news=NEWS, own=ATTESTATIONS)
def test_a_body_is_signed_at_its_end(news: GossipMessage, own: Attestation) -> None:
    """Of the same length, signed by the sender, and all else as it was."""
    own = msgspec.structs.replace(own, signature=UNSIGNED)
    message = with_attestations(news, *news.attestations, own)
    body = encode_gossip(message)

    made = sign_body(RUN, body, KEY)

    assert len(made) == len(body)
    assert decode_gossip(made) == with_attestations(
        message, *news.attestations, signed(RUN, own, KEY)
    )
    assert sign_body(RUN, made, OTHER) is made, "it is signed already"
    identities = Identities(RUN, {"r1": KEY.public, "r2": OTHER.public})
    attested = attestations_in(made)[-1]
    assert is_genuine(identities, "r1", attested)
    assert not is_genuine(identities, "r2", attested)
    assert not is_genuine(identities, "r3", attested)
    assert not is_genuine(Identities("another run", identities.keys), "r1", attested)


@examples(100)
@given(news=NEWS)
def test_without_signatures_only_signatures_are_gone(news: GossipMessage) -> None:
    """They are zero bytes then, and the message is still one."""
    body = encode_gossip(news)
    bare = without_signatures(body)

    unsigned = [msgspec.structs.replace(each, signature=UNSIGNED) for each in news.attestations]
    assert decode_gossip(bare) == with_attestations(news, *unsigned)
    assert without_signatures(bare) == bare
    assert news.attestations or bare is body


@given(body=st.binary(max_size=60))
@examples(200)
def test_any_other_body_is_left_alone(body: bytes) -> None:
    """What is no message, and messages that end in zeros but not in an attestation."""
    for odd in (body, body + UNSIGNED, b"\x9c" + body, b"\x9c" + body + b"\xc4\x40" + UNSIGNED):
        assert sign_body(RUN, odd, KEY) is odd
        assert without_signatures(odd) is odd


@pytest.mark.parametrize(
    "nested", [b"\x9c" + b"\x91" * 100_000, b"\x9c" + b"\x01" * 10 + b"\x91" * 9]
)
def test_nesting_ends_nothing(nested: bytes) -> None:
    """A body of arrays in arrays is no message."""
    assert attestations_in(nested) == ()


def outputs_of(*bodies: bytes) -> Outputs:
    """Outputs that send these bodies."""
    outbox = tuple(Envelope("r1", i + 1, "", body) for i, body in enumerate(bodies))
    return Outputs(1, Pose(0.0, 0.0), outbox=outbox)


def test_outputs_without_attestations_are_the_same_object() -> None:
    """An open step costs no copy."""
    plain = GossipMessage(1, 1, 0.0, 0.0, b"", b"", b"")
    outputs = outputs_of(encode_gossip(plain))

    assert signed_outputs(RUN, outputs, KEY) is outputs
    assert unsigned_outputs(outputs) is outputs


def test_signing_and_taking_signatures_away_are_inverse() -> None:
    """What is compared of a record is what the state machine put out, whoever signed it."""
    plain = GossipMessage(1, 1, 0.0, 0.0, b"", b"", b"")
    outputs = outputs_of(encode_gossip(plain), encode_gossip(with_attestations(plain, OWN)))

    one, other = (signed_outputs(RUN, outputs, key) for key in (KEY, OTHER))

    assert one != other
    assert one != outputs
    assert unsigned_outputs(one) == unsigned_outputs(other) == outputs
    assert signed_outputs(RUN, outputs, KEY) == one, "deterministic"
