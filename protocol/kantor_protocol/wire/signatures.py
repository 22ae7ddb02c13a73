"""Signatures: Ed25519 keys from a secret, P-256 keys from a certificate, and one check for both. Deterministic.

A public key is one byte for its kind, then the key: 32 bytes of Ed25519, or a compressed point of P-256. A signature is
64 bytes: of P-256 the numbers r and s, with the nonce of RFC 6979. A message is signed by its key's owner, at the edge
of a process: no state machine knows a private key.
"""

from functools import lru_cache
from typing import Protocol

SIGNATURE_BYTES = 64
KEY_BYTES_MAX = 34
_CHECKED_MAX = 1 << 14
"""Answers that are remembered: the same word comes again and again, and in one process to many participants."""


class SigningKey(Protocol):
    """A private key; see `signing_keys.py`."""

    @property
    def public(self) -> bytes:
        """Its public key."""
        ...

    def sign(self, statement: bytes, /) -> bytes:
        """The signature of a statement."""
        ...


@lru_cache(maxsize=_CHECKED_MAX)
def is_signed(public: bytes, statement: bytes, signature: bytes) -> bool:
    """Whether the owner of a public key has signed a statement; False for a key or a signature that is none."""
    from kantor_protocol.wire.signing_keys import verifies  # noqa: PLC0415  open runs need no OpenSSL

    return len(signature) == SIGNATURE_BYTES and verifies(public, statement, signature)
