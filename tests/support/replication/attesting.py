"""Participants that attest: replicas with a key each, and what they say and hear, without robots around them."""

import hashlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from kantor_protocol.base.machine import (
    Envelope,
    Inputs,
    Outputs,
    ParticipantId,
    Pose,
    StateMachine,
)
from kantor_protocol.replication.gossip import Gossip, build_replica
from kantor_protocol.replication.replica_kernels import SAMPLE, SINCE_NS, STAMP, spend
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import UNSIGNED, Identities, signed
from kantor_protocol.wire.messages import GossipMessage, decode_gossip, encode_gossip
from kantor_protocol.wire.signing_keys import Ed25519Key
from kantor_protocol.wire.weights import Units

RUN = "a run"


def key_of(name: ParticipantId) -> Ed25519Key:
    """The private key of a participant."""
    return Ed25519Key(hashlib.blake2b(name.encode(), digest_size=32).digest())


def identities_of(scenario: Scenario) -> Identities | None:
    """What the participants of a signed mission are given."""
    if not scenario.signed:
        return None
    return Identities(RUN, {name: key_of(name).public for name in scenario.roster})


def signed_body(name: ParticipantId, body: bytes) -> bytes:
    """A body with its sender's own attestation signed, if it has one."""
    if not body.endswith(b"\xc4\x40" + UNSIGNED):
        return body
    message = decode_gossip(body)
    *others, own = message.attestations
    return encode_gossip(replace(message, attestations=(*others, signed(RUN, own, key_of(name)))))


class Signing:
    """A participant, and who runs it: its outputs are signed."""

    def __init__(self, name: ParticipantId, machine: StateMachine) -> None:
        self._name, self._machine = name, machine

    def step(self, inputs: Inputs, /) -> Outputs:
        """One step."""
        outputs = self._machine.step(inputs)
        outbox = (replace(each, body=signed_body(self._name, each.body)) for each in outputs.outbox)
        return replace(outputs, outbox=tuple(outbox))

    def validate(self) -> None:
        """As of the participant."""
        self._machine.validate()  # type: ignore[attr-defined]


class Member:
    """One participant. Its log, claims and registers are also kept here, as they were written."""

    def __init__(
        self,
        name: ParticipantId,
        scenario: Scenario,
        samples: int,
        units: Units | None = None,
        incarnation: int = 0,
    ) -> None:
        """samples, units: as of `build_replica`."""
        self.name, self.scenario, self.units = name, scenario, units
        self.replica = build_replica(name, scenario, units, samples, incarnation)
        self.gossip = Gossip(name, scenario, incarnation, identities_of(scenario))
        self.me = self.replica.config.me
        self.step, self.spent = 0, 0
        self.validates = True
        """Whether it is validated after all that it says and hears."""
        self.log: list[tuple[int, int]] = []
        self.claims: set[tuple[int, int, int]] = {(0, -1, 0)}
        """(stamp, sample, since_ns)"""
        self.registers: dict[int, list[int]] = {0: [0] * scenario.register_width}
        """By stamp."""

    def buy(self, sample: int, wanted: int) -> None:
        """Spend, as far as there is weight in the own view and energy."""
        assert self.units is not None
        budget = self.scenario.steps_per_robot * self.units.point - self.spent
        units = min(wanted, budget, int(self.replica.weights[sample]))
        if units > 0:
            self.replica.reserve(1)
            spend(self.replica.store, self.replica.config, sample, units)
            self.log.append((sample, units))
            self.spent += units

    def append(self, indices: Sequence[int]) -> None:
        """Append bare indices to the own log."""
        self.replica.append(np.array(indices, dtype=np.int64))
        self.log += [(index, 0) for index in indices]

    def claim(self, sample: int) -> None:
        """Claim a sample, or none."""
        self.replica.claim(sample, self.step)
        self.claims.add(claim_of(self.replica, self.me))

    def write(self, amounts: Sequence[int]) -> None:
        """Add to the own register."""
        registers = self.replica.registers
        registers.add(np.array(amounts, dtype=np.int64))
        self.registers[int(registers.stamps[self.me])] = registers.values[self.me].tolist()

    def hear(self, *envelopes: Envelope) -> int:
        """Take envelopes in; how many were refused."""
        before = self.gossip.refused
        self.gossip.receive(envelopes, self.replica)
        self._validate()
        return self.gossip.refused - before

    def speak(self, *, final: bool = False) -> Envelope:
        """End a step: its envelope, signed."""
        self.step += 1
        envelope = self.gossip.compose(self.replica, self.step, Pose(0.0, 0.0), final=final)
        self.replica.end_step()
        self._validate()
        return replace(envelope, body=signed_body(self.name, envelope.body))

    def _validate(self) -> None:
        if self.validates:
            self.gossip.validate(self.replica)

    def held_log(self, origin: int) -> list[tuple[int, int]]:
        """What is held of a log."""
        store = self.replica.store
        if origin >= self.replica.origins:
            return []
        return [tuple(entry) for entry in store.logs[origin, : store.length[origin]].tolist()]


def claim_of(held: Any, origin: int) -> tuple[int, int, int]:
    """(stamp, sample, since_ns) of a claim as a replica holds it."""
    stamp, sample, since_ns = held.store.claims[[STAMP, SAMPLE, SINCE_NS], origin].tolist()
    return stamp, sample, since_ns


def message_of(envelope: Envelope) -> GossipMessage:
    """What an envelope says."""
    return decode_gossip(envelope.body)


def changed(envelope: Envelope, **fields: Any) -> Envelope:
    """An envelope whose message has other fields."""
    return replace(envelope, body=encode_gossip(replace(message_of(envelope), **fields)))


def talk(members: Iterable[Member], rounds: int) -> None:
    """Let neighbours in a line hear each other, without losses."""
    line = list(members)
    for _ in range(rounds):
        said = [member.speak() for member in line]
        for i, member in enumerate(line):
            member.hear(*said[max(0, i - 1) : i], *said[i + 1 : i + 2])
