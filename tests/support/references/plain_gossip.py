"""Parts of gossip messages, encoded in plain Python: an encoder of the wire format that shares nothing with the kernels."""

from kantor_protocol.replication.replica import Replica
from support.replication import replicas

Message = tuple[bytes, bytes, bytes]
Entry = tuple[int, int]


def leb128(value: int) -> bytes:
    """Seven bits a byte, low bits first, the high bit on all but the last."""
    out = bytearray()
    while value > 127:
        out.append(value % 128 + 128)
        value //= 128
    return bytes([*out, value])


def suffix(origin: int, start: int, entries: list[Entry], span: int | None = None) -> bytes:
    """A log suffix: origin, start, span, count, then (difference of sample, value)."""
    head = (origin, start, len(entries) if span is None else span, len(entries))
    content = b"".join(leb128(number) for number in head)
    before = 0
    for index, value in entries:
        step, before = index - before, index
        content += leb128(2 * step if step >= 0 else -2 * step - 1) + leb128(value)
    return content


def claim(origin: int, stamp: int, sample: int, since_ns: int) -> bytes:
    """A claim register: origin, stamp, sample + 1, since."""
    return b"".join(leb128(number) for number in (origin, stamp, sample + 1, since_ns))


def version_vector(origins: int, *, claims: bool = True) -> bytes:
    """A version vector that claims to hold nothing."""
    return bytes(2 * origins if claims else origins)


def full_message(held: Replica) -> Message:
    """Everything that a replica holds of logs, as one message; it acknowledges nothing."""
    config, origins = held.config, held.store.length.shape[0]
    sent = range(origins) if config.ledger else [config.me]
    logs = b"".join(suffix(origin, 0, replicas.entries(held, origin)) for origin in sent)
    return version_vector(origins, claims=config.claims), logs, b""
