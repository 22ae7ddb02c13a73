"""Private keys, and the check of signatures, by OpenSSL: imported by who signs or checks, since it takes megabytes."""

from functools import lru_cache

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ec import (
    ECDSA,
    SECP256R1,
    EllipticCurvePrivateKey,
    EllipticCurvePublicKey,
)
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.asymmetric.utils import (
    decode_dss_signature,
    encode_dss_signature,
)
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    PublicFormat,
    load_pem_private_key,
)

_ED25519, _P256 = b"\x01", b"\x02"
_HASH = ECDSA(SHA256(), deterministic_signing=True)
_NUMBER_BYTES = 32


class Ed25519Key:
    """A key that is made from a secret."""

    def __init__(self, secret: bytes) -> None:
        """secret: 32 bytes."""
        self._key = Ed25519PrivateKey.from_private_bytes(secret)
        self.public = _ED25519 + self._key.public_key().public_bytes_raw()

    def sign(self, statement: bytes, /) -> bytes:
        """The signature of a statement."""
        return self._key.sign(statement)


class CertificateKey:
    """The key of a certificate."""

    def __init__(self, pem: bytes) -> None:
        """pem: the private key, on P-256. Raises ValueError."""
        match load_pem_private_key(pem, None):
            case EllipticCurvePrivateKey(curve=SECP256R1()) as key:
                self._key = key
            case _:
                raise ValueError("a key that is not on P-256")
        self.public = public_key_of(self._key.public_key())

    def sign(self, statement: bytes, /) -> bytes:
        """The signature of a statement."""
        r, s = decode_dss_signature(self._key.sign(statement, _HASH))
        return r.to_bytes(_NUMBER_BYTES, "big") + s.to_bytes(_NUMBER_BYTES, "big")


def public_key_of(key: EllipticCurvePublicKey) -> bytes:
    """The public key of a certificate."""
    return _P256 + key.public_bytes(Encoding.X962, PublicFormat.CompressedPoint)


def verifies(public: bytes, statement: bytes, signature: bytes) -> bool:
    """Whether the owner of a public key has made a signature of SIGNATURE_BYTES for a statement."""
    try:
        key = _opened(public)
        if isinstance(key, Ed25519PublicKey):
            key.verify(signature, statement)
        else:
            halves = (signature[:_NUMBER_BYTES], signature[_NUMBER_BYTES:])
            r, s = (int.from_bytes(half, "big") for half in halves)
            key.verify(encode_dss_signature(r, s), statement, _HASH)
    except (ValueError, InvalidSignature):
        return False
    return True


@lru_cache(maxsize=4096)
def _opened(public: bytes) -> Ed25519PublicKey | EllipticCurvePublicKey:
    """Raises ValueError."""
    if public[:1] == _ED25519:
        return Ed25519PublicKey.from_public_bytes(public[1:])
    if public[:1] == _P256:
        return EllipticCurvePublicKey.from_encoded_point(SECP256R1(), public[1:])
    raise ValueError("a public key of an unknown kind")
