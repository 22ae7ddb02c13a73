"""Authentic knowledge: of another origin counts what it says itself, and what it has attested, whoever brings it.

With `trust = "signed"`. The bus proves who sends a message, so that a sender's own log, claim and register are its word.
What it brings of others counts if their *attestations* cover it (`wire/attestations.py`): who forwards cannot rewrite.

Attesting
---------
A participant that sends to all in range, and hears any of them, attests its log, claim and register: whenever it did so
`attested_every` steps ago or more, and when its state has become final. With merge = "min" logs are never forwarded,
and of one no entry is attested.

Forwarding
----------
1. Of another's log at most what its newest attestation covers is sent; of its register the contents at the attested
   stamp; its claim within the attestation. The attestation goes with each of them, and by itself only for a claim.
2. With a suffix goes its proof (`proofs.py`), so that a message proves by itself what its attestations cover. Hashes that
   do not come to the attested one are the fault of who forwards: the message is refused whole.
3. What is proven and contradicts what is held of its origin is the fault of the origin: it has *forked*, has told
   two stories. It is remembered, nothing more is taken of it but from itself, and the rest of the message is merged.

The supervisor is believed whatever it says, and sends without proofs.
"""

from collections.abc import Container

import msgspec
import numpy as np

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.replication.parts import (
    Part,
    packed_claims,
    registers_in,
    speaks_of_others,
    suffixes_in,
)
from kantor_protocol.replication.proofs import (
    Chain,
    Entries,
    Parts,
    ProvenSuffix,
    Rules,
    Word,
    blocks,
    is_sound,
    needs_no_proof,
    parts_of,
    read_word,
    register_hash,
)
from kantor_protocol.replication.registers import STALE_STEPS
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import OFFERED, SAMPLE, SINCE_NS, STAMP, STEP
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Attestation, Identities, statement
from kantor_protocol.wire.messages import GossipMessage

_EVERY_STEPS = 20
"""An attestation has a hundred bytes: so it costs five a step, and what is forwarded with it a few more."""
_EVERY_STEPS_ON_MAPS = STALE_STEPS + 1
"""On a map registers say who is in contact: they are attested as often as others forward them."""


def attested_every(scenario: Scenario) -> int:
    """Own steps from one attestation of a participant to its next, at least."""
    return _EVERY_STEPS_ON_MAPS if scenario.mapping else _EVERY_STEPS


class Attested:
    """What others have attested to one participant, and how it tells what is true and passes it on.

    It goes with one replica, which every call gets.
    """

    def __init__(self, me: ParticipantId, scenario: Scenario, identities: Identities) -> None:
        """Nothing has been attested yet."""
        assert identities.keys.keys() >= set(scenario.roster), "a participant without a public key"
        self._identities, self._roster = identities, scenario.roster
        self._rules: Rules | None = None
        self._every = attested_every(scenario)
        self._due_step = scenario.roster.index(me) % self._every
        """From when on it attests again; at first staggered by place."""
        self._final = False
        """Whether its state is final."""
        self.newest: dict[int, Attestation] = {}
        """By origin, never the own id: the newest attestation that covers no more than what is held of its log."""
        self.forked: dict[int, Attestation] = {}
        """By origin that has forked, never the own id: an attestation that contradicts what is held of it."""
        self._chains: dict[int, Chain] = {}
        """By origin: of its log as it is held."""
        self._claimed = np.zeros(len(scenario.roster), dtype=np.int64)
        """(n,) for each origin the stamp of the claim in its newest attestation, 0 if that claims no sample."""
        self._sent = np.zeros((2, len(scenario.roster)), dtype=np.int64)
        """(2, n) the stamp of the claim with which each attestation was last sent, and the step."""

    # Receiving.

    def merge(self, replica: Replica, source: int, message: GossipMessage) -> bool:
        """Merge what counts in a message of an origin; False, and nothing changed, when it must be refused."""
        rules = self._rules_of(replica)
        plain = not message.attestations and not message.proofs
        if plain and needs_no_proof(rules, source, message):
            return replica.merge(source, message.version_vector, *parts_of(message))
        word = read_word(rules, source, message)
        if word is None:
            return False
        forked = self._forked_by(replica, source, word)
        parts = _believed(source, message, word, {*self.forked, *forked})
        if not replica.merge(source, message.version_vector, *parts):
            return False
        self.forked |= forked
        self._widen(replica.origins)
        for attestation in word.attestations:
            self._take(replica, attestation)
        return True

    def _rules_of(self, replica: Replica) -> Rules:
        if self._rules is None:
            width = replica.registers.total.shape[0]
            self._rules = Rules.of(self._identities, self._roster, replica.config, width)
        return self._rules

    def _forked_by(self, replica: Replica, source: int, word: Word) -> dict[int, Attestation]:
        """The origins, but the source, of which a message proves something that contradicts what is held."""
        differing = {each.part.origin for each in word.suffixes if self._differs(replica, each)}
        return {
            each.origin: each
            for each in word.attestations
            if each.origin not in {source, *self.forked}
            and (each.origin in differing or self._contradicts(replica, each))
        }

    def _differs(self, replica: Replica, suffix: ProvenSuffix) -> bool:
        """Whether a suffix contradicts what is held of its origin's log."""
        origin, start = suffix.part.origin, suffix.part.first
        held = self._held(replica, origin)
        if origin == replica.config.me or origin >= replica.origins or start > held:
            return False
        both = suffix.entries[: held - start]
        log = replica.store.logs[origin, start : start + both.shape[0]]
        return self._hash(replica, origin, start) != suffix.before or bool((log != both).any())

    def _contradicts(self, replica: Replica, attestation: Attestation) -> bool:
        """Whether an attestation contradicts what is held of its origin."""
        origin, newest = attestation.origin, self.newest.get(attestation.origin)
        if origin == replica.config.me or attestation == newest or origin >= replica.origins:
            return False
        if newest is not None and not _agree(newest, attestation):
            return True
        length, registers = attestation.length, replica.registers
        is_held = length <= self._held(replica, origin)
        if is_held and attestation.log != self._hash(replica, origin, length):
            return True
        if not registers.total.size or attestation.register_stamp != registers.stamps[origin]:
            return False
        return attestation.register != register_hash(registers.values[origin])

    def _take(self, replica: Replica, attestation: Attestation) -> None:
        """Keep an attestation if it is the newest. The message that it came with has been merged."""
        origin, newest = attestation.origin, self.newest.get(attestation.origin)
        if origin == replica.config.me or origin in self.forked:
            return
        if self._contradicts(replica, attestation):
            self.forked[origin] = attestation
            return
        is_newest = newest is None or attestation.step >= newest.step
        if not is_newest or attestation.length > self._held(replica, origin):
            return
        self.newest[origin] = attestation
        self._claimed[origin] = attestation.claim[0] if attestation.claim[1] else 0
        if replica.config.proving:
            replica.store.sending[OFFERED, origin] = attestation.length
            replica.registers.offer(origin, attestation.register_stamp)

    def _held(self, replica: Replica, origin: int) -> int:
        """Entries held of a log that may be attested."""
        if not replica.config.ledger or origin >= replica.origins:
            return 0
        return replica.store.length.item(origin)

    def _hash(self, replica: Replica, origin: int, length: int) -> bytes:
        """The hash of the first entries held of a log."""
        chain = self._chains.setdefault(origin, Chain(valued=replica.config.value_max > 0))
        return chain.hash(_log(replica, origin), length)

    def _widen(self, origins: int) -> None:
        """Make room for this many origins."""
        more = origins - self._claimed.shape[0]
        if more > 0:
            self._claimed = np.pad(self._claimed, (0, more))
            self._sent = np.pad(self._sent, ((0, 0), (0, more)))

    # Sending.

    def attest(
        self, replica: Replica, message: GossipMessage, *, to_all: bool, final: bool
    ) -> GossipMessage:
        """A message with the attestations and proofs that it needs; the own one is to be signed.

        message: what the replica has composed last. to_all: for all in range. final: the state of its sender is.
        """
        step = message.step
        if final and not self._final:
            self._final, self._due_step = True, step
        own: tuple[Attestation, ...] = ()
        if to_all and step >= self._due_step and replica.in_contact:
            own, self._due_step = (self._own(replica, step),), step + self._every
        proofs = self._proofs(replica, message) if replica.config.proving else {}
        if not own and not proofs:
            return message
        others = (self.newest[origin] for origin in proofs)
        return msgspec.structs.replace(
            message, proofs=tuple(proofs.values()), attestations=(*others, *own)
        )

    def _own(self, replica: Replica, step: int) -> Attestation:
        """What this participant says of itself."""
        me, registers = replica.config.me, replica.registers
        length, has_registers = self._held(replica, me), registers.total.size > 0
        sample, since_ns, stamp = replica.store.claims[[SAMPLE, SINCE_NS, STAMP], me].tolist()
        return Attestation(
            origin=me,
            step=step,
            length=length,
            log=self._hash(replica, me, length),
            claim=(stamp, sample + 1, since_ns) if replica.config.claims else (0, 0, 0),
            register_stamp=registers.stamps.item(me) if has_registers else 0,
            register=register_hash(registers.values[me]) if has_registers else b"",
        )

    def _proofs(self, replica: Replica, message: GossipMessage) -> dict[int, bytes]:
        """By other origin whose attestation a message needs: the proof of its suffix, or nothing."""
        if not self.newest:
            return {}
        self._widen(replica.origins)
        me, valued = replica.config.me, replica.config.value_max > 0
        logs, registers, covered = message.logs, message.registers, replica.origins
        proofs = dict.fromkeys(replica.claims_to_prove(self._claimed, self._sent), b"")
        if speaks_of_others(logs, b"", registers, covered, valued, me):
            proofs |= {part.origin: b"" for part in registers_in(registers, covered) or ()}
            suffixes = [
                part for part in suffixes_in(logs, valued=valued) or () if part.origin != me
            ]
            proofs |= {part.origin: self._proof(replica, part) for part in suffixes}
            proofs.pop(me, None)
        for origin in proofs:
            self._sent[:, origin] = self._claimed[origin], replica.store.counters[STEP]
        return proofs

    def _proof(self, replica: Replica, suffix: Part) -> bytes:
        """The hash of a log before a suffix, then of each block after it."""
        origin, length = suffix.origin, self.newest[suffix.origin].length
        log, before = _log(replica, origin), self._hash(replica, origin, suffix.first)
        after = range(blocks(suffix.first + suffix.size), blocks(length))
        chain = self._chains[origin]
        return before + b"".join(chain.block(log, number, length) for number in after)

    # Invariants.

    def validate(self, replica: Replica) -> None:
        """Assert what the sentences at the attributes here, in Replica and in Registers state of one another."""
        me, rules, origins = replica.config.me, self._rules_of(replica), replica.origins
        for origin, attestation in (*self.newest.items(), *self.forked.items()):
            assert attestation.origin == origin != me
            assert is_sound(rules, origins, attestation)
        for origin, chain in self._chains.items():
            log, held = _log(replica, origin), self._held(replica, origin)
            assert chain.hash(log, held) == Chain(valued=rules.valued).hash(log, held)
        for origin, attestation in self.newest.items():
            assert attestation.length <= self._held(replica, origin)
            assert attestation.log == self._hash(replica, origin, attestation.length)
        claims = {i: each.claim[0] for i, each in self.newest.items() if each.claim[1]}
        expected = [claims.get(origin, 0) for origin in range(self._claimed.shape[0])]
        assert self._claimed.tolist() == expected
        assert self._sent.shape == (2, len(expected))
        if replica.config.proving:
            self._validate_offers(replica)

    def _validate_offers(self, replica: Replica) -> None:
        """Of others is offered what the newest attestations cover, and no more."""
        me, registers = replica.config.me, replica.registers
        for origin, length in enumerate(replica.store.sending[OFFERED].tolist()):
            newest = self.newest.get(origin)
            assert origin == me or length == (newest.length if newest else 0)
        for origin, stamp in enumerate(registers.offered_stamps.tolist()):
            if stamp and origin != me:
                assert stamp == self.newest[origin].register_stamp
                assert register_hash(registers.offered[origin]) == self.newest[origin].register


def _log(replica: Replica, origin: int) -> Entries:
    """The log of an origin; with merge = "min" any, since no entry of one is attested."""
    return replica.store.logs[origin if replica.config.ledger else 0]


def _believed(source: int, message: GossipMessage, word: Word, doubted: Container[int]) -> Parts:
    """The parts of a message that are merged: of origins that are doubted nothing, but from themselves."""
    logs, claims, registers = word.parts
    for part in (suffix.part for suffix in word.suffixes if suffix.part.origin not in doubted):
        logs += message.logs[part.begin : part.end]
    for part in (part for part in word.registers if part.origin not in doubted):
        registers += message.registers[part.begin : part.end]
    attested = [
        (each.origin, *each.claim)
        for each in word.attestations
        if each.claim[0] and each.origin != source and each.origin not in doubted
    ]
    return logs, claims + packed_claims(attested) if attested else claims, registers


def _agree(one: Attestation, other: Attestation) -> bool:
    """Whether an honest origin can have made both: nothing of it is shorter or older later on."""
    before, after = sorted((one, other), key=lambda each: each.step)
    if before.step == after.step:
        return statement("", before) == statement("", after)
    return (
        before.length <= after.length
        and before.claim[0] <= after.claim[0]
        and before.register_stamp <= after.register_stamp
    )
