"""Parts of gossip messages, encoded in plain Python: an encoder of the wire format that shares nothing with the kernels."""

from kantor_protocol.replication.replica import Replica
from support.references.plain_varint import leb128, zigzag
from support.replication import replicas

Message = tuple[bytes, bytes, bytes]
Entry = tuple[int, int]


def suffix(origin: int, start: int, entries: list[Entry], span: int | None = None) -> bytes:
    """A log suffix: origin, start, span, count, then (difference of sample, value)."""
    head = (origin, start, len(entries) if span is None else span, len(entries))
    content = b"".join(leb128(number) for number in head)
    before = 0
    for index, value in entries:
        step, before = index - before, index
        content += leb128(zigzag(step)) + leb128(value)
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
