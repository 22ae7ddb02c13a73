"""Authentic knowledge: of another origin counts what it says itself, and what it has attested, whoever brings it.

With `trust = "signed"`. The bus proves who sends a message, so that a sender's own log, claim and register are its word.
What it brings of others is believed if their *attestations* cover it (`wire/attestations.py`), so that who forwards
cannot rewrite.

The hash of a log
-----------------
A chain over blocks of BLOCK entries: h_0 = hash_of(b""), h_j = hash_of(h_{j-1}, hash_of(block j)); the last block may be
shorter. An entry is two little-endian int32, index and value, or on a map the index alone. The hash of a register is
that of all its numbers, as little-endian int64.

Attesting
---------
A participant that sends to all in range, and hears any, attests its log, claim and register when it did so
`attested_every` steps ago or more, and when its state has become final. With merge = "min" logs are never forwarded, and length is 0.

Forwarding
----------
1. Of another's log at most what the newest attestation covers; of its register the contents at the attested stamp; its
   claim within the attestation. The attestation goes with each of them, and by itself only for a claim.
2. A suffix begins where a block begins, and ends with the attested log or with a block. Its proof is the hash of all
   before it, then the hash of each block after it. So a message proves by itself what its attestations cover: hashes that
   do not come to the attested one are the fault of who forwards, and the message is refused whole.
3. What is proven and contradicts what is held of its origin is the fault of the origin: it has *forked*, has told
   two stories. It is remembered, nothing more is taken of it but from itself, and the rest of the message is merged.

The supervisor is believed whatever it says, and sends without proofs.
"""

from collections.abc import Container, Mapping, Sequence
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_protocol.base.machine import SUPERVISOR, ParticipantId
from kantor_protocol.replication.parts import (
    Part,
    entries_of,
    packed_claims,
    registers_in,
    speaks_of_others,
    suffixes_in,
)
from kantor_protocol.replication.registers import OTHERS_MAX, Register, read_register
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import (
    BLOCK,
    ENTRIES_MAX,
    NO_INDEX,
    SAMPLE,
    SINCE_NS,
    STAMP,
    STEP,
    ReplicaConfig,
)
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import (
    HASH_BYTES,
    UNSIGNED,
    Attestation,
    Identities,
    hash_of,
    is_attested,
    statement,
)
from kantor_protocol.wire.messages import GossipMessage
from kantor_protocol.wire.version_vector import count_ids

ATTESTATIONS_MAX = 3 * OTHERS_MAX + 1
"""In one message: for logs, registers and claims of others, and the sender's own."""
_EVERY_STEPS, _EVERY_STEPS_ON_MAPS = 20, 4
"""On a map a robot's register has to be heard of again before it counts as out of contact."""
_NUMBER_MAX = 1 << 62

Log = npt.NDArray[np.int32]
"""(capacity, 2) indices and values."""
Parts = tuple[bytes, bytes, bytes]
"""Logs, claims and registers of a message."""


def attested_every(scenario: Scenario) -> int:
    """Own steps from one attestation of a participant to its next."""
    return _EVERY_STEPS_ON_MAPS if scenario.mapping else _EVERY_STEPS


class Chain:
    """The hashes of the prefixes of one log."""

    def __init__(self, *, valued: bool) -> None:
        """valued: its entries have values."""
        self._valued = valued
        self._links = [hash_of(b"")]
        """Of so many whole blocks."""

    def hash(self, log: Log, length: int) -> bytes:
        """The hash of its first entries. log: the same as ever, or longer."""
        whole, rest = divmod(length, BLOCK)
        for j in range(len(self._links), whole + 1):
            self._links.append(hash_of(self._links[-1], self.block(log, j - 1, length)))
        if not rest:
            return self._links[whole]
        return hash_of(self._links[whole], self.block(log, whole, length))

    def block(self, log: Log, number: int, length: int) -> bytes:
        """The hash of a block of its first entries."""
        entries = log[number * BLOCK : min(length, (number + 1) * BLOCK)]
        return block_hash(entries, valued=self._valued)


def block_hash(entries: Log, *, valued: bool) -> bytes:
    """The hash of the entries of a block."""
    return hash_of((entries if valued else entries[:, 0]).astype("<i4", copy=False).tobytes())


def register_hash(register: Register) -> bytes:
    """The hash of (width,) numbers."""
    return hash_of(register.astype("<i8", copy=False).tobytes())


class Rules(NamedTuple):
    """By what messages of a run are judged; they never change."""

    run: str
    keys: tuple[bytes, ...]
    """Of each place in the roster."""
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


class ProvenSuffix(NamedTuple):
    """Entries of another's log, as it has attested them."""

    part: Part
    entries: Log
    base: bytes
    """The hash of all entries before them."""


class Word(NamedTuple):
    """What a message has, proven by itself: for one who holds nothing."""

    attestations: tuple[Attestation, ...]
    parts: Parts
    """What needs no proof: of the source alone, or of the supervisor."""
    suffixes: tuple[ProvenSuffix, ...] = ()
    registers: tuple[Part, ...] = ()
    """Of others."""


def read_word(rules: Rules, source: int, message: GossipMessage) -> Word | None:
    """What a message has; None if an honest sender never sends it. source: its sender's incarnation id."""
    config, attestations = rules.config, message.attestations
    covered = count_ids(message.version_vector, config.roster, 2 if config.claims else 1)
    by_origin = {each.origin: each for each in attestations}
    others = [origin for origin in by_origin if origin != source]
    if (
        not 0 <= source < covered
        or not len(by_origin) == len(attestations) <= ATTESTATIONS_MAX
        or len(message.proofs) != len(others)
        or not all(_is_sound(rules, covered, each) for each in attestations)
    ):
        return None
    if is_own_word(rules, source, message):
        return None if any(message.proofs) else Word(attestations, parts_of(message))
    proofs = {origin: proof for origin, proof in zip(others, message.proofs, strict=True) if proof}
    suffixes = _read_suffixes(rules, source, message.logs, by_origin, proofs)
    registers = _read_registers(rules, source, message.registers, covered, by_origin)
    if suffixes is None or registers is None:
        return None
    if speaks_of_others(b"", message.claims, b"", covered, rules.valued, source):
        return None
    own = _without(message.logs, [each.part for each in suffixes])
    parts = own, message.claims, _without(message.registers, registers)
    return Word(attestations, parts, tuple(suffixes), tuple(registers))


def is_own_word(rules: Rules, source: int, message: GossipMessage) -> bool:
    """Whether the parts of a message need no proof: they are of its source alone, or of the supervisor."""
    config, covered = rules.config, 0
    if source % config.roster == rules.supervisor:
        return True
    if message.registers:
        covered = count_ids(message.version_vector, config.roster, 2 if config.claims else 1)
    return not speaks_of_others(*parts_of(message), covered, rules.valued, source)


def parts_of(message: GossipMessage) -> Parts:
    """The parts of a message that are merged."""
    return message.logs, message.claims, message.registers


def _is_sound(rules: Rules, covered: int, attestation: Attestation) -> bool:
    """Whether an attestation is within bounds and signed by its origin's participant."""
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
    proven = [_proven(rules, logs, part, by_origin[part.origin], proofs) for part in parts]
    return None if None in proven else [each for each in proven if each is not None]


def _proven(
    rules: Rules,
    logs: bytes,
    part: Part,
    attestation: Attestation,
    proofs: Mapping[int, bytes],
) -> ProvenSuffix | None:
    """A suffix, if its proof comes to what is attested."""
    end, config, proof = part.first + part.size, rules.config, proofs[part.origin]
    rest = -(-attestation.length // BLOCK) - -(-end // BLOCK)
    if (
        part.first % BLOCK
        or not 0 < part.size <= ENTRIES_MAX
        or end > attestation.length
        or (end < attestation.length and end % BLOCK)
        or len(proof) != HASH_BYTES * (1 + rest)
    ):
        return None
    entries = entries_of(logs, part, config.bound, config.value_max)
    if entries is None:
        return None
    base, *hashes = (proof[at : at + HASH_BYTES] for at in range(0, len(proof), HASH_BYTES))
    blocks = (entries[at : at + BLOCK] for at in range(0, part.size, BLOCK))
    link = base
    for block in (*(block_hash(block, valued=rules.valued) for block in blocks), *hashes):
        link = hash_of(link, block)
    return ProvenSuffix(part, entries, base) if link == attestation.log else None


def _read_registers(
    rules: Rules,
    source: int,
    registers: bytes,
    covered: int,
    by_origin: Mapping[int, Attestation],
) -> list[Part] | None:
    """The registers of others; None unless each is the attested one."""
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
    """A part of a message without some of its own parts."""
    edges = [0, *(edge for part in parts for edge in (part.begin, part.end)), len(content)]
    return b"".join(content[i:j] for i, j in zip(edges[::2], edges[1::2], strict=True))


class Attested:
    """What one participant holds that others have attested, and the messages by which it passes it on."""

    def __init__(self, me: ParticipantId, scenario: Scenario, identities: Identities) -> None:
        """Nothing has been attested yet."""
        assert identities.keys.keys() >= set(scenario.roster), "every participant has a public key"
        self._identities, self._roster = identities, scenario.roster
        self._place = scenario.roster.index(me)
        self._every = attested_every(scenario)
        self._due_step, self._final = self._place % self._every, False
        """From when on it attests again; whether its state is final."""
        self._rules: Rules | None = None
        self.newest: dict[int, Attestation] = {}
        """By origin: the newest attestation that covers no more than what is held. Never of the own id."""
        self.forked: dict[int, Attestation] = {}
        """By origin that has forked: an attestation that contradicts what is held of it."""
        self._chains: dict[int, Chain] = {}
        """By origin: of its log as it is held."""
        self._claimed = np.zeros(len(scenario.roster), dtype=np.int64)
        """(n,) by origin: the stamp of the claim in the newest attestation, 0 if it claims no sample."""
        self._sent = np.zeros((2, len(scenario.roster)), dtype=np.int64)
        """(2, n) the stamp of the claim with which each attestation was last sent, and the step."""

    # Receiving.

    def merge(self, replica: Replica, source: int, message: GossipMessage) -> bool:
        """Merge a message of an origin, but what is unproven; False, and nothing changed, when it must be refused."""
        rules = self._rules_of(replica)
        proven = message.attestations or message.proofs
        if not proven and is_own_word(rules, source, message):
            return replica.merge(source, message.version_vector, *parts_of(message))
        word = read_word(rules, source, message)
        if word is None:
            return False
        lies = {
            each.origin: each
            for each in word.attestations
            if each.origin != source and self._contradicts(replica, each)
        }
        by_origin = {each.origin: each for each in word.attestations}
        for suffix in word.suffixes:
            if self._differs(replica, suffix):
                lies[suffix.part.origin] = by_origin[suffix.part.origin]
        parts = self._believed(replica, source, message, word, {*lies, *self.forked})
        if not replica.merge(source, message.version_vector, *parts):
            return False
        for origin, attestation in lies.items():
            self.forked.setdefault(origin, attestation)
        self._widen(replica.origins)
        for attestation in word.attestations:
            self._take(replica, attestation)
        return True

    def _rules_of(self, replica: Replica) -> Rules:
        if self._rules is None:
            width = replica.registers.total.shape[0]
            self._rules = Rules.of(self._identities, self._roster, replica.config, width)
        return self._rules

    def _believed(
        self,
        replica: Replica,
        source: int,
        message: GossipMessage,
        word: Word,
        doubted: Container[int],
    ) -> Parts:
        """The parts of a message that are merged: nothing of origins that are doubted, but from themselves."""
        logs, claims, registers = word.parts
        for suffix in word.suffixes:
            part = suffix.part
            if part.origin not in doubted:
                logs += message.logs[part.begin : part.end]
        for part in word.registers:
            if part.origin not in doubted:
                registers += message.registers[part.begin : part.end]
        attested = [
            (each.origin, *each.claim)
            for each in word.attestations
            if each.claim[0] and each.origin != source and each.origin not in doubted
        ]
        if attested:
            claims += packed_claims(attested)
        return logs, claims, registers

    def _held(self, replica: Replica, origin: int) -> int:
        """Entries held of a log that can be attested."""
        if not replica.config.ledger or origin >= replica.origins:
            return 0
        return int(replica.store.length[origin])

    def _hash(self, replica: Replica, origin: int, length: int) -> bytes:
        """The hash of what is held of a log, up to a length."""
        chain = self._chains.setdefault(origin, Chain(valued=replica.config.value_max > 0))
        log = replica.store.logs[origin if length else 0]
        return chain.hash(log, length)

    def _differs(self, replica: Replica, suffix: ProvenSuffix) -> bool:
        """Whether a proven suffix contradicts what is held of its origin's log."""
        origin, start, held = (
            suffix.part.origin,
            suffix.part.first,
            self._held(replica, suffix.part.origin),
        )
        if origin == replica.config.me or start > held:
            return False
        end = min(held, start + suffix.part.size)
        if self._hash(replica, origin, start) != suffix.base:
            return True
        return (
            bool((replica.store.logs[origin, start:end] != suffix.entries[: end - start]).any())
            if end > start
            else False
        )

    def _contradicts(self, replica: Replica, attestation: Attestation) -> bool:
        """Whether an attestation contradicts what is held of its origin."""
        origin, newest = attestation.origin, self.newest.get(attestation.origin)
        if origin == replica.config.me or attestation == newest:
            return False
        if newest is not None and not _agree(newest, attestation):
            return True
        if attestation.length <= self._held(replica, origin) and attestation.log != self._hash(
            replica, origin, attestation.length
        ):
            return True
        registers = replica.registers
        return (
            attestation.register_stamp > 0
            and registers.total.size > 0
            and origin < replica.origins
            and registers.stamps[origin] == attestation.register_stamp
            and register_hash(registers.values[origin]) != attestation.register
        )

    def _take(self, replica: Replica, attestation: Attestation) -> None:
        """Keep an attestation if it is the newest, and note a fork. The message it came in has been merged."""
        origin, registers = attestation.origin, replica.registers
        if origin == replica.config.me or origin in self.forked:
            return
        if self._contradicts(replica, attestation):
            self.forked[origin] = attestation
            return
        newest = self.newest.get(origin)
        if attestation.length > self._held(replica, origin):
            return
        if newest is not None and attestation.step < newest.step:
            return
        self.newest[origin] = attestation
        self._claimed[origin] = attestation.claim[0] if attestation.claim[1] else 0
        if replica.config.proving:
            replica.offered[origin] = attestation.length
            if registers.total.size:
                registers.offer(origin, attestation.register_stamp)

    def _widen(self, origins: int) -> None:
        more = origins - self._claimed.shape[0]
        if more > 0:
            self._claimed = np.pad(self._claimed, (0, more))
            self._sent = np.pad(self._sent, ((0, 0), (0, more)))

    # Sending.

    def attest(
        self, replica: Replica, message: GossipMessage, *, to_all: bool, final: bool
    ) -> GossipMessage:
        """A message with the attestations and proofs that it needs.

        message: what the replica has composed last. to_all: it is for all in range. final: the state of its sender is.
        """
        if final and not self._final:
            self._final, self._due_step = True, message.step
        own = []
        if to_all and message.step >= self._due_step and replica.in_contact:
            own, self._due_step = [self._own(replica, message.step)], message.step + self._every
        proofs = self._proofs(replica, message) if replica.config.proving else {}
        if not own and not proofs:
            return message
        others = [self.newest[origin] for origin in proofs]
        return msgspec.structs.replace(
            message, proofs=tuple(proofs.values()), attestations=(*others, *own)
        )

    def _own(self, replica: Replica, step: int) -> Attestation:
        """What this participant says of itself, to be signed."""
        me, config, registers = replica.config.me, replica.config, replica.registers
        length, width = self._held(replica, me), registers.total.size
        sample, since_ns, stamp = replica.store.claims[[SAMPLE, SINCE_NS, STAMP], me].tolist()
        return Attestation(
            origin=me,
            step=step,
            length=length,
            log=self._hash(replica, me, length),
            claim=(stamp, sample + 1, since_ns) if config.claims else (0, 0, 0),
            register_stamp=int(registers.stamps[me]) if width else 0,
            register=register_hash(registers.values[me]) if width else b"",
            signature=UNSIGNED,
        )

    def _proofs(self, replica: Replica, message: GossipMessage) -> dict[int, bytes]:
        """By other origin that a message has to prove something of: the proof of its suffix, or nothing."""
        config = replica.config
        if not self.newest:
            return {}
        proofs = dict.fromkeys(replica.claims_to_prove(self._claimed, self._sent), b"")
        logs, registers, covered = message.logs, message.registers, replica.origins
        valued = config.value_max > 0
        if speaks_of_others(logs, b"", registers, covered, valued, config.me):
            for part in registers_in(registers, covered) or ():
                proofs.setdefault(part.origin, b"")
            for part in suffixes_in(logs, valued=valued) or ():
                if part.origin != config.me:
                    proofs[part.origin] = self._proof(replica, part)
            proofs.pop(config.me, None)
        for origin in proofs:
            self._sent[:, origin] = self._claimed[origin], replica.store.counters[STEP]
        return proofs

    def _proof(self, replica: Replica, suffix: Part) -> bytes:
        """The hash of a log before a suffix, and of each block after it."""
        origin, length = suffix.origin, self.newest[suffix.origin].length
        log, end = replica.store.logs[origin], suffix.first + suffix.size
        base = self._hash(replica, origin, suffix.first)
        after = range(-(-end // BLOCK), -(-length // BLOCK))
        chain = self._chains[origin]
        return base + b"".join(chain.block(log, number, length) for number in after)

    # Invariants.

    def validate(self, replica: Replica) -> None:
        """Assert what the sentences at the attributes state. For tests: it takes long."""
        me, rules, registers = replica.config.me, self._rules_of(replica), replica.registers
        assert me not in self.newest
        assert me not in self.forked
        for origin, chain in self._chains.items():
            held = self._held(replica, origin)
            log = replica.store.logs[origin if held else 0]
            assert chain.hash(log, held) == Chain(valued=rules.valued).hash(log, held)
        for origin, attestation in self.newest.items():
            assert attestation.origin == origin < replica.origins
            assert _is_sound(rules, replica.origins, attestation)
            assert attestation.length <= self._held(replica, origin)
            assert attestation.log == self._hash(replica, origin, attestation.length)
            assert self._claimed[origin] == (attestation.claim[0] if attestation.claim[1] else 0)
            if registers.total.size and replica.config.proving and registers.offered_stamps[origin]:
                assert registers.offered_stamps[origin] == attestation.register_stamp
                assert register_hash(registers.offered[origin]) == attestation.register
        for origin, attestation in self.forked.items():
            assert attestation.origin == origin < replica.origins
            assert _is_sound(rules, replica.origins, attestation)
        others = np.arange(replica.origins) != me
        unattested = others & ~np.isin(np.arange(replica.origins), list(self.newest))
        if replica.config.proving:
            lengths = [self.newest[i].length for i in self.newest]
            assert replica.offered[list(self.newest)].tolist() == lengths
            assert not replica.offered[unattested].any()
            assert not registers.offered_stamps[unattested].any()


def _agree(one: Attestation, other: Attestation) -> bool:
    """Whether an honest origin can have made both: nothing is shorter or older later on."""
    before, after = sorted((one, other), key=lambda each: each.step)
    if before.step == after.step:
        return statement("", before) == statement("", after)
    return (
        before.length <= after.length
        and before.claim[0] <= after.claim[0]
        and before.register_stamp <= after.register_stamp
    )
