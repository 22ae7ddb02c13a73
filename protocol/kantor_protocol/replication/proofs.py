"""Proofs: what a message says of others, checked against their attestations by one who holds nothing.

The hash of a log is a chain over blocks of BLOCK entries: h_0 = hash_of(b""), h_j = hash_of(h_{j-1}, hash_of(block j));
the last block may be shorter. An entry is two little-endian int32, index and value, or on a map the index alone. The
hash of a register is that of all its numbers, as little-endian int64.

The proof of a suffix is the hash of all entries before it, then the hash of each block after it. A suffix begins where
a block begins, and ends with the attested log or with a block.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.machine import SUPERVISOR, ParticipantId
from kantor_protocol.replication.parts import (
    Part,
    entries_of,
    registers_in,
    speaks_of_others,
    suffixes_in,
)
from kantor_protocol.replication.registers import OTHERS_MAX, Register, read_register
from kantor_protocol.replication.replica_kernels import (
    BLOCK,
    ENTRIES_MAX,
    NO_INDEX,
    ReplicaConfig,
)
from kantor_protocol.wire.attestations import (
    HASH_BYTES,
    Attestation,
    Identities,
    hash_of,
    is_attested,
)
from kantor_protocol.wire.messages import GossipMessage
from kantor_protocol.wire.version_vector import count_ids

ATTESTATIONS_MAX = 3 * OTHERS_MAX + 1
"""In one message: for logs, registers and claims of others, and the sender's own."""
_NUMBER_MAX = 1 << 62

Entries = npt.NDArray[np.int32]
"""(k, 2) indices and values of a log; values are 0 where entries have none."""
Parts = tuple[bytes, bytes, bytes]
"""Logs, claims and registers of a message."""


# Hashes.


class Chain:
    """The hashes of the beginnings of one log."""

    def __init__(self, *, valued: bool) -> None:
        """valued: its entries have values."""
        self._valued = valued
        self._links = [hash_of(b"")]
        """The hash of each number of whole blocks, from none on."""

    def hash(self, log: Entries, length: int) -> bytes:
        """The hash of the first entries. log: the same as ever, or longer."""
        whole, rest = divmod(length, BLOCK)
        for number in range(len(self._links) - 1, whole):
            self._links.append(hash_of(self._links[number], self.block(log, number, length)))
        if not rest:
            return self._links[whole]
        return hash_of(self._links[whole], self.block(log, whole, length))

    def block(self, log: Entries, number: int, length: int) -> bytes:
        """The hash of one block of the first entries."""
        block = log[number * BLOCK : min(length, (number + 1) * BLOCK)]
        return _block_hash(block, valued=self._valued)


def blocks(entries: int) -> int:
    """The number of blocks, the last of which may be shorter."""
    return -(-entries // BLOCK)


def register_hash(register: Register) -> bytes:
    """The hash of (width,) numbers."""
    return hash_of(register.astype("<i8", copy=False).tobytes())


def _block_hash(block: Entries, *, valued: bool) -> bytes:
    return hash_of((block if valued else block[:, 0]).astype("<i4", copy=False).tobytes())


# Messages.


class Rules(NamedTuple):
    """By what the messages of a run are judged."""

    run: str
    keys: tuple[bytes, ...]
    """The public key of each place in the roster."""
    supervisor: int
    """Its place, or NO_INDEX."""
    config: ReplicaConfig
    width: int
    """Integers in a register."""

    @classmethod
    def of(
        cls,
        identities: Identities,
        roster: Sequence[ParticipantId],
        config: ReplicaConfig,
        width: int,
    ) -> "Rules":
        """The rules of a run. Raises KeyError for a participant without a key."""
        keys = tuple(identities.keys[name] for name in roster)
        place = roster.index(SUPERVISOR) if SUPERVISOR in roster else NO_INDEX
        return cls(identities.run, keys, place, config, width)

    @property
    def valued(self) -> bool:
        """Whether entries of logs have values."""
        return self.config.value_max > 0

    def covered(self, message: GossipMessage) -> int:
        """The number of incarnation ids that the sender of a message knows; negative if it is malformed."""
        parts = 2 if self.config.claims else 1
        return count_ids(message.version_vector, self.config.roster, parts)

    def believe(self, source: int) -> bool:
        """Whether an origin is believed whatever it says of others."""
        return source % self.config.roster == self.supervisor


class ProvenSuffix(NamedTuple):
    """Entries of another's log, as it has attested them."""

    part: Part
    entries: Entries
    before: bytes
    """The hash of all entries before them."""


class Word(NamedTuple):
    """What a message says."""

    attestations: tuple[Attestation, ...]
    parts: Parts
    """What needs no proof."""
    suffixes: Sequence[ProvenSuffix] = ()
    registers: Sequence[Part] = ()
    """Of others, as they have attested them."""


def parts_of(message: GossipMessage) -> Parts:
    """The parts of a message that a replica merges."""
    return message.logs, message.claims, message.registers


def needs_no_proof(rules: Rules, source: int, message: GossipMessage) -> bool:
    """Whether the parts of a message are of its source alone, or of one who is believed. source: incarnation id."""
    if rules.believe(source):
        return True
    covered = rules.covered(message) if message.registers else 0
    return not speaks_of_others(*parts_of(message), covered, rules.valued, source)


def read_word(rules: Rules, source: int, message: GossipMessage) -> Word | None:
    """What a message says; None if an honest sender never sends it. source: the sender's incarnation id."""
    covered, attestations = rules.covered(message), message.attestations
    by_origin = {each.origin: each for each in attestations}
    others = [origin for origin in by_origin if origin != source]
    if (
        not 0 <= source < covered
        or not len(by_origin) == len(attestations) <= ATTESTATIONS_MAX
        or len(message.proofs) != len(others)
        or not all(is_sound(rules, covered, each) for each in attestations)
    ):
        return None
    if needs_no_proof(rules, source, message):
        return None if any(message.proofs) else Word(attestations, parts_of(message))
    proofs = {origin: proof for origin, proof in zip(others, message.proofs, strict=True) if proof}
    suffixes = _read_suffixes(rules, source, message.logs, by_origin, proofs)
    registers = _read_registers(rules, source, message.registers, covered, by_origin)
    of_others = speaks_of_others(b"", message.claims, b"", covered, rules.valued, source)
    if suffixes is None or registers is None or of_others:
        return None
    logs = _without(message.logs, [each.part for each in suffixes])
    own = logs, message.claims, _without(message.registers, registers)
    return Word(attestations, own, suffixes, registers)


def is_sound(rules: Rules, covered: int, attestation: Attestation) -> bool:
    """Whether an attestation is within bounds, and signed. covered: incarnation ids that there are."""
    config, (stamp, sample, since_ns) = rules.config, attestation.claim
    return (
        0 <= attestation.origin < covered
        and 0 <= attestation.step < _NUMBER_MAX
        and 0 <= attestation.length <= (config.length_max if config.ledger else 0)
        and len(attestation.log) == HASH_BYTES
        and 0 <= stamp <= (config.stamp_max if config.claims else 0)
        and 0 <= sample <= config.bound
        and 0 <= since_ns < _NUMBER_MAX
        and 0 <= attestation.register_stamp < _NUMBER_MAX
        and len(attestation.register) == (HASH_BYTES if rules.width else 0)
        and is_attested(rules.run, attestation, rules.keys[attestation.origin % config.roster])
    )


def _read_suffixes(
    rules: Rules,
    source: int,
    logs: bytes,
    by_origin: Mapping[int, Attestation],
    proofs: Mapping[int, bytes],
) -> list[ProvenSuffix] | None:
    """The suffixes of others; None unless each has one proof, and that comes to what is attested."""
    parts = suffixes_in(logs, valued=rules.valued)
    if parts is None:
        return None
    parts = [part for part in parts if part.origin != source]
    if sorted(part.origin for part in parts) != sorted(proofs):
        return None
    suffixes = []
    for part in parts:
        suffix = _read_suffix(rules, logs, part, by_origin[part.origin], proofs[part.origin])
        if suffix is None:
            return None
        suffixes.append(suffix)
    return suffixes


def _read_suffix(
    rules: Rules, logs: bytes, part: Part, attestation: Attestation, proof: bytes
) -> ProvenSuffix | None:
    """A suffix, if its proof comes to what is attested."""
    end, config = part.first + part.size, rules.config
    if (
        part.first % BLOCK
        or not 0 < part.size <= ENTRIES_MAX
        or end > attestation.length
        or (end < attestation.length and end % BLOCK)
        or len(proof) != HASH_BYTES * (1 + blocks(attestation.length) - blocks(end))
    ):
        return None
    entries = entries_of(logs, part, config.bound, config.value_max)
    if entries is None:
        return None
    before, *after = (proof[at : at + HASH_BYTES] for at in range(0, len(proof), HASH_BYTES))
    whole = (entries[at : at + BLOCK] for at in range(0, part.size, BLOCK))
    hashes = [*(_block_hash(block, valued=rules.valued) for block in whole), *after]
    link = before
    for each in hashes:
        link = hash_of(link, each)
    return ProvenSuffix(part, entries, before) if link == attestation.log else None


def _read_registers(
    rules: Rules,
    source: int,
    registers: bytes,
    covered: int,
    by_origin: Mapping[int, Attestation],
) -> list[Part] | None:
    """The registers of others; None unless each is the attested one, and there once."""
    parts = registers_in(registers, covered)
    if parts is None:
        return None
    parts = [part for part in parts if part.origin != source]
    if len({part.origin for part in parts}) != len(parts):
        return None
    for part in parts:
        attestation = by_origin.get(part.origin)
        found = read_register(registers, covered, rules.width, part.origin)
        if attestation is None or found is None or found[0] != attestation.register_stamp:
            return None
        if register_hash(found[1]) != attestation.register:
            return None
    return parts


def _without(content: bytes, parts: Sequence[Part]) -> bytes:
    """A part of a message without some suffixes or registers."""
    edges = [0, *(edge for part in parts for edge in (part.begin, part.end)), len(content)]
    return b"".join(content[i:j] for i, j in zip(edges[::2], edges[1::2], strict=True))
