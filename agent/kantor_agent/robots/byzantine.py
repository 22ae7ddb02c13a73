"""A robot that lies: an honest machine within, and what it says of the mission changed on the way out.

The honest machine goes on with its own inputs, so that its body, its energy and its log are what the world knows. The
lies of `scenario/faults/liars.py` are told in its messages, within their windows, by the clock that it reads. All draws
are keyed: the same lies are told in every exchange, and by a machine that is restored from its write-ahead log.

The lie in a log is one of contents, never of length: what the others acknowledge is the same, so that the honest
machine goes on with their answers. It signs what it states: its attestation is of the log that it shows.
"""

from typing import Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_agent.robots import decoded_parts as parts
from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.machine import (
    EVERYBODY,
    Envelope,
    Inputs,
    Outputs,
    ParticipantId,
    Pose,
    StateMachine,
)
from kantor_protocol.replication.occupancy_log import RANGE_BINS
from kantor_protocol.replication.proofs import Chain
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import BLOCK, SAMPLE, STAMP
from kantor_protocol.scenario.faults.liars import Lie, lies_of
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import HASH_BYTES, UNSIGNED, Attestation
from kantor_protocol.wire.messages import OUTBOX_MAX, GossipMessage, decode_gossip, encode_gossip
from kantor_protocol.wire.signatures import SIGNATURE_BYTES

SPELL_STEPS = 24
"""For so many steps the same receivers are deceived, or met with silence."""
_DECEIVED = 0.5
"""The share of receivers in a spell."""
_CHANGED = 0.3
"""The share of the entries in which a fork differs."""
_JUMPS = 0.25
"""The share of steps in which a robot teleports."""
_JUMP_STEPS = 1e6
"""How far, in steps at full speed: nobody has been away for so long."""
_AHEAD = 16
"""By so much a stamp in another's name is ahead of those that are known."""
_BOLD_SHARE = 0.5
"""Of the robots that overstate, so many do it beyond their energy."""
_BOUNDLESS = 1 << 62
_INVENTED = 3
"""Entries that are invented at the end of another's log, at most."""

_OVERSTATED, _FORKED, _FORK_ENTRY, _SPELL, _JUMP, _TO_CLAIM, _VICTIM, _MADE_UP, _BOLD = range(9)
"""Subjects of draws."""

Log = npt.NDArray[np.signedinteger]
"""(length, 2) entries: index and value."""


class HonestRobot(Protocol):
    """What is within: a robot of this package."""

    @property
    def replica(self) -> Replica:
        """What it knows of all participants."""
        ...

    def step(self, inputs: Inputs, /) -> Outputs:
        """Make one step."""
        ...

    def validate(self) -> None:
        """Assert its invariants."""
        ...


def as_declared(
    me: ParticipantId, scenario: Scenario, seed: int, machine: HonestRobot
) -> StateMachine:
    """The machine itself, or the liar that the scenario makes of it."""
    if lies_of(me, scenario.faults):
        return ByzantineRobot(me, scenario, seed, machine)
    return machine


class ByzantineRobot:
    """A robot that lies as its scenario says. `step` is its only entrance."""

    def __init__(
        self, me: ParticipantId, scenario: Scenario, seed: int, machine: HonestRobot
    ) -> None:
        self.told = 0
        """Steps in which it has told a lie."""
        self._machine = machine
        self._lies = lies_of(me, scenario.faults)
        self._others = tuple(name for name in scenario.roster if name != me)
        self._place, self._roster = scenario.roster.index(me), len(scenario.roster)
        self._seed = seed
        self._scenario = scenario
        self._valued = not scenario.mapping
        self._jump_m = _JUMP_STEPS * scenario.vehicle.speed_m_s * scenario.clock.period_s
        nothing = np.zeros((0, 2), dtype=np.int64)
        self._stated: tuple[Log, Log] = (nothing, nothing)
        """Its log as it states it, and as it states it to those that it deceives by a fork; nothing: as it is."""

    def step(self, inputs: Inputs, /) -> Outputs:
        """One step of the honest machine, and the lies about it."""
        outputs = self._machine.step(inputs)
        told = frozenset(each.lie for each in self._lies if each.holds(inputs.now_ns))
        self._state_log(told)
        pose = self._pose(outputs) if "teleport" in told else outputs.pose
        outbox: list[Envelope] = []
        lied = pose != outputs.pose
        for envelope in outputs.outbox:
            copies, lie = self._copies(envelope, outputs.step, pose, told)
            outbox += copies
            lied |= lie
        self.told += lied
        numbered = tuple(
            msgspec.structs.replace(each, sequence=OUTBOX_MAX * (outputs.step - 1) + 1 + i)
            for i, each in enumerate(outbox[:OUTBOX_MAX])
        )
        return msgspec.structs.replace(outputs, pose=pose, outbox=numbered)

    def validate(self) -> None:
        """Assert the invariants of the honest machine."""
        self._machine.validate()

    @property
    def _replica(self) -> Replica:
        return self._machine.replica

    def _draw(self, subject: int, one: int, other: int = 0) -> float:
        """In [0, 1)."""
        who = self._place * 16 + subject
        return float(uniform(self._seed, Purpose.LIE.value, who, one, other))

    def _whole(self, below: int, subject: int, one: int, other: int = 0) -> int:
        return int(self._draw(subject, one, other) * below)

    # What it does.

    def _pose(self, outputs: Outputs) -> Pose:
        """A pose that it cannot have reached, now and then."""
        if self._draw(_JUMP, outputs.step) >= _JUMPS:
            return outputs.pose
        return msgspec.structs.replace(outputs.pose, x_m=outputs.pose.x_m + self._jump_m)

    def _deceives(self, receiver: ParticipantId, step: int) -> bool:
        """Whether a receiver is one of those that a fork or silence is for, in this spell."""
        place = self._scenario.roster.index(receiver)
        return self._draw(_SPELL, step // SPELL_STEPS, place) < _DECEIVED

    def _copies(
        self, envelope: Envelope, step: int, pose: Pose, told: frozenset[Lie]
    ) -> tuple[list[Envelope], bool]:
        """What is sent instead of an envelope, and whether there is a lie in it."""
        honest = decode_gossip(envelope.body)
        message = msgspec.structs.replace(honest, x_m=pose.x_m, y_m=pose.y_m)
        if "claim" in told:
            message = self._claiming(message, step)
        if "rewrite" in told:
            message = self._rewritten(message, step)
        bodies = [encode_gossip(self._shown(message, log)) for log in self._stated]
        lied = self._of_others(message) != self._of_others(honest)
        if not told & {"fork", "silence"}:
            return [msgspec.structs.replace(envelope, body=bodies[0])], lied or self._differs(
                message, 0
            )
        receivers = self._others if envelope.target == EVERYBODY else (envelope.target,)
        first = step % len(receivers)
        copies = []
        for receiver in (*receivers[first:], *receivers[:first]):
            deceived = self._deceives(receiver, step)
            if deceived and "silence" in told:
                lied = True
                continue
            version = int(deceived and "fork" in told)
            lied |= self._differs(message, version)
            copies.append(msgspec.structs.replace(envelope, target=receiver, body=bodies[version]))
        return copies, lied

    # Its own log.

    def _state_log(self, told: frozenset[Lie]) -> None:
        """Add to the stated logs what the honest machine has written, as the lies of this step have it."""
        known, me = self._stated[0].shape[0], self._replica.config.me
        length = int(self._replica.store.length[me])
        if length == known or not (self._tells("overstate") or self._tells("fork")):
            return
        entries = self._replica.store.logs[me, known:length]
        stated = entries.astype(np.int64)
        if self._tells("overstate"):
            stated = self._overstated(stated, known, now="overstate" in told)
        forked = self._forked(stated, known) if self._tells("fork") else stated
        self._stated = (
            np.concatenate((self._stated[0], stated)),
            np.concatenate((self._stated[1], forked)),
        )

    def _tells(self, lie: Lie) -> bool:
        """Whether it ever tells a lie."""
        return any(each.lie == lie for each in self._lies)

    def _overstated(self, entries: Log, first: int, *, now: bool) -> Log:
        """Whole points, shipped to samples that are drawn; of a careful one as long as it could have energy for them."""
        stated, config = entries.copy(), self._replica.config
        left = self._scenario.steps_per_robot * config.value_max - int(self._stated[0][:, 1].sum())
        if self._draw(_BOLD, 0) < _BOLD_SHARE:
            left = _BOUNDLESS
        for i in range(entries.shape[0]):
            if now:
                sample = self._whole(config.bound, _OVERSTATED, first + i)
                stated[i] = sample, config.value_max
            stated[i, 1] = min(stated[i, 1], left)
            left -= int(stated[i, 1])
        return stated

    def _forked(self, entries: Log, first: int) -> Log:
        """The same spending on other samples; on a map cells that repeat the entry before."""
        forked, config = entries.copy(), self._replica.config
        for i in range(entries.shape[0]):
            if self._draw(_FORKED, first + i) >= _CHANGED:
                continue
            if not self._scenario.mapping:
                forked[i, 0] = self._whole(config.bound, _FORK_ENTRY, first + i)
            elif i and max(entries[i - 1, 0], entries[i, 0]) < 2 * (config.bound - RANGE_BINS) // 6:
                forked[i] = forked[i - 1]
        return forked

    def _shown(self, message: GossipMessage, log: Log) -> GossipMessage:
        """A message that shows a log of its own, and attests to it."""
        me = self._replica.config.me
        suffixes = parts.suffixes_in(message.logs, valued=self._valued)
        shown = [
            each._replace(entries=_entries(log[each.start : each.start + each.span]))
            if each.origin == me and log.shape[0]
            else each
            for each in suffixes
        ]
        logs = parts.packed_suffixes(shown, valued=self._valued)
        attestations = tuple(
            self._attested(each, message, log) if each.origin == me else each
            for each in message.attestations
        )
        return msgspec.structs.replace(message, logs=logs, attestations=attestations)

    def _attested(self, own: Attestation, message: GossipMessage, log: Log) -> Attestation:
        """Its attestation of what it shows, to be signed."""
        if log.shape[0]:
            chain = Chain(valued=self._valued)
            own = msgspec.structs.replace(own, log=chain.hash(log.astype(np.int32), own.length))
        for claim in parts.claims_in(message.claims):
            if claim.origin == own.origin:
                own = msgspec.structs.replace(
                    own, claim=(claim.stamp, claim.sample, claim.since_ns)
                )
        return own

    def _differs(self, message: GossipMessage, version: int) -> bool:
        """Whether a message shows another log than the robot's own."""
        log = self._stated[version]
        own = self._replica.store.logs[self._replica.config.me] if log.shape[0] else log
        return any(
            (log[start : start + span] != own[start : start + span]).any()
            for origin, start, span, _ in parts.suffixes_in(message.logs, valued=self._valued)
            if origin == self._replica.config.me and log.shape[0]
        )

    # What it says of others.

    def _of_others(self, message: GossipMessage) -> tuple[object, ...]:
        """What a message says of others: a lie in it can be proven."""
        claims = [each for each in parts.claims_in(message.claims) if self._foreign(each.origin)]
        return message.version_vector, message.logs, claims, message.registers

    def _foreign(self, origin: int) -> bool:
        return origin % self._roster != self._place

    def _claiming(self, message: GossipMessage, step: int) -> GossipMessage:
        """Claim what others have claimed, as if before them, and claim and write registers in their names.

        Every other spell only the former, since a message with the latter may be refused whole.
        """
        claims, registers = message.claims, message.registers
        for_others = step // SPELL_STEPS % 2 == 0
        if self._scenario.claiming:
            told_of = self._claims(parts.claims_in(claims), step, for_others=for_others)
            claims = parts.packed_claims(told_of)
        if registers and for_others:
            replica = self._replica
            stamps, told = parts.registers_in(registers, replica.origins)
            for origin in np.flatnonzero(replica.registers.stamps).tolist():
                if self._foreign(origin):
                    stamp = int(replica.registers.stamps[origin]) + _AHEAD
                    values = replica.registers.values[origin].tolist()
                    told.append(parts.Register(origin, stamp, _grown(values)))
            registers = parts.packed_registers(stamps, _fitting(told))
        return msgspec.structs.replace(message, claims=claims, registers=registers)

    def _claims(
        self, claims: list[parts.Claim], step: int, *, for_others: bool
    ) -> list[parts.Claim]:
        config, known = self._replica.config, self._replica.store.claims
        wanted = [
            int(known[SAMPLE, origin])
            for origin in np.flatnonzero((known[STAMP] > 0) & (known[SAMPLE] >= 0)).tolist()
            if self._foreign(origin)
        ]
        told = []
        for each in claims:
            if each.origin == config.me and wanted:
                sample = wanted[self._whole(len(wanted), _TO_CLAIM, step)] + 1
                told.append(each._replace(sample=sample, since_ns=0))
            elif each.origin == config.me or not for_others:
                told.append(each)
        for origin in np.flatnonzero(known[STAMP]).tolist() if for_others else ():
            if self._foreign(origin):
                stamp = min(int(known[STAMP, origin]) + _AHEAD, config.stamp_max)
                sample = 1 + self._whole(config.bound, _TO_CLAIM, step, 1 + origin)
                told.append(parts.Claim(origin, stamp, sample, 0))
        return told

    def _rewritten(self, message: GossipMessage, step: int) -> GossipMessage:
        """Change what others have said, or make up what they have not, and attest it for them."""
        if self._replica.config.ledger:
            suffixes = parts.suffixes_in(message.logs, valued=self._valued)
            if any(self._foreign(each.origin) for each in suffixes):
                changed = [self._changed(each) for each in suffixes]
                logs = parts.packed_suffixes(changed, valued=self._valued)
                message = msgspec.structs.replace(message, logs=logs)
            else:
                message = self._inventing(message, suffixes, step)
        claims = parts.packed_claims(
            each._replace(sample=1 + each.sample % self._replica.config.bound)
            if self._foreign(each.origin)
            else each
            for each in parts.claims_in(message.claims)
        )
        registers = message.registers
        if registers:
            stamps, told = parts.registers_in(registers, self._replica.origins)
            registers = parts.packed_registers(
                stamps,
                (
                    each._replace(numbers=_grown(each.numbers))
                    if self._foreign(each.origin)
                    else each
                    for each in told
                ),
            )
        return msgspec.structs.replace(message, claims=claims, registers=registers)

    def _changed(self, suffix: parts.Suffix) -> parts.Suffix:
        """A suffix of another's log with other entries."""
        if not self._foreign(suffix.origin):
            return suffix
        bound = self._replica.config.bound
        return suffix._replace(entries=[((i + 1) % bound, value) for i, value in suffix.entries])

    def _inventing(
        self, message: GossipMessage, suffixes: list[parts.Suffix], step: int
    ) -> GossipMessage:
        """A message with a log of another that is longer than it is; in a signed mission with a forged attestation."""
        replica, config = self._replica, self._replica.config
        others = [place for place in range(self._roster) if place != self._place]
        victim = others[self._whole(len(others), _VICTIM, step)]
        held, count = int(replica.store.length[victim]), 1 + self._whole(_INVENTED, _MADE_UP, step)
        if held + count > config.length_max:
            return message
        samples = [self._whole(config.bound, _MADE_UP, step, 1 + i) for i in range(count)]
        invented = np.array([(sample, config.value_max) for sample in samples], dtype=np.int32)
        log = np.concatenate((replica.store.logs[victim, :held], invented))
        start = held - held % BLOCK if self._scenario.signed else held
        suffix = parts.Suffix(victim, start, held + count - start, _entries(log[start:]))
        lengths = parts.uints_in(message.version_vector)
        lengths[victim] += count
        logs = parts.packed_suffixes([*suffixes, suffix], valued=self._valued)
        longer = msgspec.structs.replace(
            message, logs=logs, version_vector=parts.packed_uints(lengths)
        )
        forges = self._scenario.signed and victim not in {i.origin for i in message.attestations}
        return self._forging(longer, victim, log, start) if forges else longer

    def _forging(self, message: GossipMessage, victim: int, log: Log, start: int) -> GossipMessage:
        """A message with an attestation in another's name, and the proof that goes with it.

        At its end it is signed with the liar's own key; before its own one it has a signature of nobody.
        """
        chain, me = Chain(valued=self._valued), self._replica.config.me
        own = tuple(each for each in message.attestations if each.origin == me)
        forged = Attestation(
            origin=victim,
            step=message.step,
            length=log.shape[0],
            log=chain.hash(log, log.shape[0]),
            register=bytes(HASH_BYTES) if self._scenario.register_width else b"",
            signature=bytes([1]) * SIGNATURE_BYTES if own else UNSIGNED,
        )
        others = message.attestations[: len(message.attestations) - len(own)]
        return msgspec.structs.replace(
            message,
            proofs=(*message.proofs, chain.hash(log, start)),
            attestations=(*others, forged, *own),
        )


def _entries(log: Log) -> list[tuple[int, int]]:
    return [(index, value) for index, value in log.tolist()]


def _grown(numbers: list[int]) -> list[int]:
    """Another register that is well-formed: the first number, which bounds sums, is one more."""
    return [numbers[0] + 1, *numbers[1:]] if numbers else [1]


def _fitting(registers: list[parts.Register]) -> list[parts.Register]:
    """As many registers as a message has room for."""
    return registers[:8]
