"""Attestations: what an origin says of its own state at one of its steps, signed, so that others can pass it on.

A state machine leaves the signature of its own attestation empty (UNSIGNED). It is the end of the envelope's body, and
whoever runs the machine signs it there (`sign_body`). Records are compared and digested without signatures
(`without_signatures`): they depend on keys, and keys are no part of a mission.
"""

import hashlib
from collections.abc import Callable

import msgspec
from msgspec import Raw

from kantor_protocol.base.machine import Envelope, Outputs, ParticipantId
from kantor_protocol.wire.signatures import SIGNATURE_BYTES, SigningKey, is_signed

HASH_BYTES = 16
UNSIGNED = bytes(SIGNATURE_BYTES)
"""In place of a signature: none yet."""
_DOMAIN = b"kantor attestation 1\0"


class Identities(msgspec.Struct, frozen=True, array_like=True, tag="identities"):
    """Whose word counts in a run with `trust = "signed"`."""

    run: str
    """The name of this run of the mission: the context of signatures."""
    keys: dict[ParticipantId, bytes]
    """The public key of every participant, see `signatures.py`."""


class Attestation(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The state of one origin, by its own word."""

    origin: int
    """Its incarnation id."""
    step: int
    length: int
    """Entries of its log."""
    log: bytes
    """Hash of these entries, HASH_BYTES long; see `replication/proofs.py`."""
    claim: tuple[int, int, int] = (0, 0, 0)
    """Stamp, sample + 1 (0: none), since_ns; as in `GossipMessage.claims`."""
    register_stamp: int = 0
    register: bytes = b""
    """Hash of its numbers, HASH_BYTES long; empty in a mission without registers."""
    signature: bytes = UNSIGNED


def statement(run: str, attestation: Attestation) -> bytes:
    """What is signed. run: the name of this run of the mission, so that no word counts in another."""
    unsigned = msgspec.structs.replace(attestation, signature=b"")
    return _DOMAIN + msgspec.msgpack.encode((run, unsigned))


def is_attested(run: str, attestation: Attestation, public: bytes) -> bool:
    """Whether the owner of a public key has signed an attestation."""
    return is_signed(public, statement(run, attestation), attestation.signature)


def is_genuine(identities: Identities, origin: ParticipantId, attestation: Attestation) -> bool:
    """Whether an attestation is of this run and signed by the participant that it is of."""
    return is_attested(identities.run, attestation, identities.keys.get(origin, b""))


def signed(run: str, attestation: Attestation, key: SigningKey) -> Attestation:
    """An attestation with its signature."""
    signature = key.sign(statement(run, attestation))
    return msgspec.structs.replace(attestation, signature=signature)


def hash_of(*parts: bytes) -> bytes:
    """The hash of some bytes, HASH_BYTES long."""
    return hashlib.blake2b(b"".join(parts), digest_size=HASH_BYTES).digest()


# Bodies of envelopes. Attestations are the last field of a message, and a message without any has a shorter head.

_HEADS = frozenset(bytes([0x90 + fields]) for fields in (12, 13, 14, 15))
"""The first bytes of messages that may have attestations."""
_NOT_SIGNED = b"\xc4" + bytes([SIGNATURE_BYTES]) + UNSIGNED
"""The end of a message whose sender has yet to sign it."""
_FIELDS = msgspec.msgpack.Decoder(list[Raw])
_ATTESTATIONS = msgspec.msgpack.Decoder(tuple[Attestation, ...])
_UNDECODABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)

_encode = msgspec.msgpack.encode


def sign_body(run: str, body: bytes, key: SigningKey) -> bytes:
    """The body with the sender's own attestation signed, if it has one that is not; else as it is."""
    if not body.endswith(_NOT_SIGNED) or not (attestations := attestations_in(body)):
        return body
    return body[:-SIGNATURE_BYTES] + key.sign(statement(run, attestations[-1]))


def without_signatures(body: bytes) -> bytes:
    """The body with all signatures zeroed; one without attestations as it is."""
    attestations = attestations_in(body)
    if not attestations:
        return body
    unsigned = [msgspec.structs.replace(each, signature=UNSIGNED) for each in attestations]
    return body[: -len(_encode(attestations))] + _encode(unsigned)


def attestations_in(body: bytes) -> tuple[Attestation, ...]:
    """The attestations at the end of a body; none in one that is not encoded as they are."""
    if body[:1] not in _HEADS:
        return ()
    try:
        attestations = _ATTESTATIONS.decode(_FIELDS.decode(body)[-1])
    except _UNDECODABLE:
        return ()
    return attestations if body.endswith(_encode(attestations)) else ()


def signed_outputs(run: str, outputs: Outputs, key: SigningKey) -> Outputs:
    """The outputs with the sender's own attestations signed."""
    return _with_bodies(outputs, lambda body: sign_body(run, body, key))


def unsigned_outputs(outputs: Outputs) -> Outputs:
    """The outputs with all signatures zeroed."""
    return _with_bodies(outputs, without_signatures)


def unsigned_envelope(envelope: Envelope) -> Envelope:
    """The envelope with all signatures zeroed."""
    return _with_body(envelope, without_signatures)


def _with_bodies(outputs: Outputs, change: Callable[[bytes], bytes]) -> Outputs:
    """Outputs whose envelopes have changed; themselves if none can have attestations."""
    for envelope in outputs.outbox:
        if envelope.body[:1] in _HEADS:
            outbox = tuple([_with_body(each, change) for each in outputs.outbox])
            return msgspec.structs.replace(outputs, outbox=outbox)
    return outputs


def _with_body(envelope: Envelope, change: Callable[[bytes], bytes]) -> Envelope:
    body = change(envelope.body)
    return envelope if body is envelope.body else msgspec.structs.replace(envelope, body=body)
