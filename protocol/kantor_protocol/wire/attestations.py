"""Attestations: what an origin says of its own state at one of its steps, signed, so that others can pass it on.

A state machine leaves the signature of its own attestation empty (UNSIGNED). It is the end of the envelope's body, and
whoever runs the machine signs it there (`sign_body`). Records are compared and digested without signatures
(`without_signatures`): they depend on keys, and keys are no part of a mission.
"""

import hashlib

import msgspec

from kantor_protocol.base.machine import ParticipantId
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
    """Hash of these entries, HASH_BYTES long; see `replication/attested.py`."""
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


def signed(run: str, attestation: Attestation, key: SigningKey) -> Attestation:
    """An attestation with its signature."""
    signature = key.sign(statement(run, attestation))
    return msgspec.structs.replace(attestation, signature=signature)


def hash_of(*parts: bytes) -> bytes:
    """The hash of some bytes, HASH_BYTES long."""
    return hashlib.blake2b(b"".join(parts), digest_size=HASH_BYTES).digest()
