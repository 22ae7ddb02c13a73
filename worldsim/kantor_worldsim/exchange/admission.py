"""Admission of reports: what a participant may say is what it can have done, by the record so far. Pure.

World-sim relays what participants send to each other. A report that is unsound, or of which an envelope claims what
cannot be, is refused whole, before it touches anything: its participant is not acknowledged, and nobody else hears of
it. An honest participant never sends such a report.

1. Sizes are within what a mission of this scenario can need, and a move within what a vehicle drives in one period of
   its clock, however long its robot was silent.
2. Envelopes are the sender's own, numbered upwards, and no receiver would refuse one of them.
3. An envelope speaks of incarnations that were there; of logs, claims and registers as far as their origins have
   written them; and an entry of a log is the one that its origin has consumed (ledger) or has sent first (map).
   With merge = "min" no weight is below what all spending leaves.
4. With `trust = "signed"` every attestation in an envelope is signed by its origin, in this run, and the own one is of
   this step and of the log as it was consumed (ledger).

A robot that lies by a fault of the scenario is let through with its lies, and so are those who pass them on in good
faith. But nobody, a liar neither, sends what could break a record or a resumption: what is too large, malformed, or about
incarnations that never were.
"""

import contextlib
import math
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import EVERYBODY, Outputs, ParticipantId, Pose
from kantor_protocol.base.varint import Pairs, sum_pairs
from kantor_protocol.replication.gossip import MessageCheck, log_length_max
from kantor_protocol.replication.occupancy_log import entries
from kantor_protocol.replication.proofs import Chain, blocks
from kantor_protocol.replication.replica_kernels import BLOCK
from kantor_protocol.scenario.faults.liars import FALSE_LOGS, liars_of
from kantor_protocol.scenario.schema import ENERGY_MAX, Scenario
from kantor_protocol.wire.attestations import Attestation, Identities, hash_of, is_genuine
from kantor_protocol.wire.messages import (
    OUTBOX_MAX,
    GossipMessage,
    RefusedError,
    check_outputs,
    decode_gossip,
)
from kantor_protocol.wire.weights import weights_bytes_max
from kantor_worldsim.exchange.admission_kernels import (
    BARE,
    NO_INCARNATION,
    REASONS,
    judge,
    learn,
    spend,
)
from kantor_worldsim.record.process_events import TAKE_OVER
from kantor_worldsim.record.records import Batch, ProcessEvent, Record
from kantor_worldsim.world.world import WorldSetup, rounding_m, units_of

_ROUNDING = 1e-5
_PAIR_BYTES_MAX = 20
"""Of a sample and its units."""

Entries = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]
"""Samples, and units of each."""


class Judged(NamedTuple):
    """What the next step of a participant was found to hold."""

    outputs: Outputs
    own: int
    """The incarnation id that made it."""
    spent: Entries | None
    messages: list[GossipMessage]
    """Those that receivers take."""


class Admission:
    """Judges reports by the records of a mission, all of which it observes."""

    def __init__(
        self, scenario: Scenario, setup: WorldSetup, identities: Identities | None = None
    ) -> None:
        """Nothing has happened yet. identities: with `trust = "signed"`."""
        self._identities = identities
        self._roster = scenario.roster
        roster, self._samples = len(scenario.roster), setup.samples_m.shape[0]
        units = None if setup.ground else units_of(scenario, self._samples)
        indices = entries(setup.ground.frame) if setup.ground else self._samples
        self._places = {name: place for place, name in enumerate(scenario.roster)}
        self._targets = frozenset((*scenario.roster, EVERYBODY))
        self._point_units = units.point if units else 0
        self._budget = scenario.steps_per_robot
        self._ledger = scenario.merge == "ledger" and not scenario.mapping
        """Whether logs are what was spent, entry for entry."""
        self._way_max_m = scenario.vehicle.speed_m_s * scenario.clock.period_s * (1.0 + _ROUNDING)
        self._poses = setup.poses(scenario)
        self._receivers = MessageCheck(scenario, units, indices, identities)
        boundless = msgspec.structs.replace(scenario.energy, steps=ENERGY_MAX)
        self._well_formed = MessageCheck(
            msgspec.structs.replace(scenario, energy=boundless), units, indices
        )
        self._settings = np.array(
            [
                roster,
                self._ledger or scenario.mapping,
                scenario.mapping,
                scenario.claiming,
                units.sample if units else 0,
                log_length_max(scenario, units, indices),
            ],
            dtype=np.int64,
        )
        self._logs = np.zeros((roster, 256, 1 if scenario.mapping else 2), dtype=np.int32)
        """(ids, rows, 2 or 1) the entries of each log as its origin wrote them; with merge = "min" nothing."""
        self._written = np.zeros(roster, dtype=np.int64)
        """(ids,) entries of each log."""
        self._consumed = np.zeros(self._samples, dtype=np.int64)
        """(N,) units shipped by all."""
        self._stamps = np.zeros((2, roster), dtype=np.int64)
        """(2, ids) of the newest claim and register of each origin."""
        self._incarnations = dict.fromkeys(scenario.roster, 0)
        self._points = dict.fromkeys(scenario.roster, 0)
        """Points that each has shipped."""
        self._sequences = dict.fromkeys(scenario.roster, 0)
        """The number of the last envelope of each."""
        self._judged: dict[ParticipantId, Judged] = {}
        """The step of each that was judged last, if it is not settled."""
        self._pairs = Pairs()
        self._chains: dict[int, Chain] = {}
        """By incarnation id: the hashes of its log, as far as it is settled."""
        self._unsettled = 0
        """Entries at the end of the own log that only the step has that is being judged."""
        self._liars = liars_of(scenario.faults)
        forgers = liars_of(scenario.faults, *FALSE_LOGS)
        self._false_logs = np.array([name in forgers for name in scenario.roster])
        """(roster,) whose logs others may pass on that are not what was consumed, or sent first."""
        self._spreads = not scenario.signed and bool(self._liars)
        """Whether liars are believed in what they say of others, so that the honest say it too."""

    def observe(self, record: Record) -> None:
        """Follow one record."""
        if isinstance(record, ProcessEvent):
            self._follow_event(record)
        elif isinstance(record, Batch):
            for step_record in record.step_records:
                if step_record.outputs is not None and step_record.name in self._places:
                    self._follow(step_record.name, step_record.outputs)
                    if step_record.verdict is not None:
                        self._poses[step_record.name] = step_record.verdict.pose

    def refusal_reason(self, name: ParticipantId, outputs: Outputs) -> str:
        """Why the next step of a participant is refused; empty if it may be settled."""
        try:
            check_outputs(outputs)
        except RefusedError as error:
            return str(error)
        return (
            self._refusal_of_sizes(outputs)
            or (name not in self._liars and self._refusal_of_move(self._poses[name], outputs.pose))
            or self._refusal_of_numbers(name, outputs)
            or self._refusal_of_contents(name, outputs)
        )

    def _refusal_of_sizes(self, outputs: Outputs) -> str:
        if max(len(outputs.spent), len(outputs.lowered)) > _PAIR_BYTES_MAX * self._samples:
            return "more entries than there are samples"
        if len(outputs.weights) > weights_bytes_max(self._samples):
            return "a weights message that is longer than any"
        if len(outputs.outbox) > OUTBOX_MAX:
            return f"{len(outputs.outbox)} envelopes in one step"
        return ""

    def _refusal_of_move(self, start: Pose, end: Pose) -> str:
        way_m = math.hypot(end.x_m - start.x_m, end.y_m - start.y_m)
        possible_m = self._way_max_m + rounding_m(start)
        return "" if way_m <= possible_m else f"a move of {way_m:.6g} m in one step"

    def _refusal_of_numbers(self, name: ParticipantId, outputs: Outputs) -> str:
        before = self._sequences[name]
        for envelope in outputs.outbox:
            if envelope.source != name:
                return "an envelope in the name of another"
            if envelope.target not in self._targets:
                return "an envelope for nobody in the team"
            if not before < envelope.sequence <= OUTBOX_MAX * outputs.step:
                return f"envelope {envelope.sequence} after {before}"
            before = envelope.sequence
        return ""

    def _refusal_of_contents(self, name: ParticipantId, outputs: Outputs) -> str:
        spent = self._spent_in(name, outputs)
        if spent is None:
            return "spending that does not decode"
        own = self._id_of(name)
        self._spend(own, spent)
        self._unsettled = spent[0].size
        reason, messages = self._refusal_of_envelopes(name, outputs, own)
        self._spend(own, spent, back=True)
        if not reason:
            self._judged[name] = Judged(outputs, own, spent, messages)
        return reason

    def _refusal_of_envelopes(
        self, name: ParticipantId, outputs: Outputs, own: int
    ) -> tuple[str, list[GossipMessage]]:
        """Why an envelope is refused; and the messages in those before it."""
        lenient = name in self._liars or self._spreads
        messages: list[GossipMessage] = []
        for envelope in outputs.outbox:
            try:
                message = decode_gossip(envelope.body)
            except RefusedError as error:
                return f"a malformed envelope ({error})", messages
            if reason := self._refusal_of(name, message, own, outputs.step, lenient=lenient):
                return reason, messages
            messages.append(message)
        return "", messages

    def _refusal_of(
        self, source: ParticipantId, message: GossipMessage, own: int, step: int, *, lenient: bool
    ) -> str:
        """Why a message is refused. lenient: it may say what is not so."""
        if message.incarnation != own // len(self._places):
            return f"an envelope of incarnation {message.incarnation}"
        if reason := self._refusal_of_attestations(source, message):
            return reason
        if not self._receivers_of(source).passes(own, message):
            return "a malformed envelope"
        arrays = (self._logs, self._written, self._consumed, self._stamps, self._false_logs)
        content = (*_parts(message), message.registers)
        code = int(judge(*arrays, self._settings, *content, own, step))
        if lenient and code != NO_INCARNATION:
            return ""
        return REASONS[code] or self._refusal_of_own_word(message, own, step)

    def _receivers_of(self, name: ParticipantId) -> MessageCheck:
        """The checks that a message has to pass; a liar may say what it cannot prove."""
        return self._well_formed if name in self._liars else self._receivers

    def _refusal_of_attestations(self, source: ParticipantId, message: GossipMessage) -> str:
        if message.attestations and self._identities is None:
            return "an attestation, and trust is open"
        if source in self._liars:
            return ""
        for attestation in message.attestations:
            name = self._roster[attestation.origin % len(self._roster)]
            if self._identities is None or not is_genuine(self._identities, name, attestation):
                return f"an attestation that {name} has not signed"
        return ""

    def _refusal_of_own_word(self, message: GossipMessage, own: int, step: int) -> str:
        for attestation in message.attestations:
            if attestation.origin != own:
                continue
            if attestation.step != step:
                return f"an attestation of step {attestation.step}"
            if self._ledger and not self._is_log(own, attestation):
                return "an attestation of another log than its own"
        return ""

    def _is_log(self, own: int, attestation: Attestation) -> bool:
        """Whether an attestation is of the own log, with what this step ships."""
        log, length = self._logs[own], int(self._written[own])
        chain = self._chains.setdefault(own, Chain(valued=True))
        settled = (length - self._unsettled) // BLOCK
        link = chain.hash(log, settled * BLOCK)
        for number in range(settled, blocks(length)):
            link = hash_of(link, chain.block(log, number, length))
        return (attestation.length, attestation.log) == (length, link)

    def _follow_event(self, event: ProcessEvent) -> None:
        if event.kind not in TAKE_OVER or event.who not in self._places:
            return
        if self._incarnations[event.who] < event.incarnation <= INCARNATIONS_MAX:
            self._incarnations[event.who] = event.incarnation
            ids = (event.incarnation + 1) * len(self._places)
            more = ids - self._written.shape[0]
            if more > 0:
                self._logs = np.pad(self._logs, ((0, more), (0, 0), (0, 0)))
                self._written = np.pad(self._written, (0, more))
                self._stamps = np.pad(self._stamps, ((0, 0), (0, more)))

    def _follow(self, name: ParticipantId, outputs: Outputs) -> None:
        """Follow a step that was settled: an older version may have settled what is refused now."""
        own = self._id_of(name)
        judged = self._judged.pop(name, None)
        if judged is None or judged.outputs is not outputs or judged.own != own:
            messages = self._messages_in(name, outputs, own)
            judged = Judged(outputs, own, self._spent_in(name, outputs), messages)
        if judged.spent is not None and judged.spent[0].size:
            self._points[name] += 1
            self._spend(own, judged.spent)
        for envelope in outputs.outbox:
            if envelope.source == name:
                self._sequences[name] = max(self._sequences[name], envelope.sequence)
        for message in judged.messages:
            self._learn(message, own)

    def _messages_in(self, name: ParticipantId, outputs: Outputs, own: int) -> list[GossipMessage]:
        """The messages that a step sends, without those that nobody would take."""
        receivers, messages = self._receivers_of(name), []
        for envelope in outputs.outbox:
            if envelope.source != name:
                continue
            with contextlib.suppress(RefusedError):
                message = decode_gossip(envelope.body)
                if message.incarnation == own // len(self._places) and receivers.passes(
                    own, message
                ):
                    messages.append(message)
        return messages

    def _learn(self, message: GossipMessage, own: int) -> None:
        if self._settings[BARE]:
            self._make_room(int(self._written[own]) + len(message.logs))
        vector, logs, _ = _parts(message)
        arrays = (self._logs, self._written, self._stamps, self._settings)
        learn(*arrays, vector, logs, message.registers, own)

    def _id_of(self, name: ParticipantId) -> int:
        """The incarnation id of a participant's newest incarnation."""
        return self._incarnations[name] * len(self._places) + self._places[name]

    def _spent_in(self, name: ParticipantId, outputs: Outputs) -> Entries | None:
        """What a step ships, if the world lets it; None if it does not decode."""
        nothing = np.zeros(0, dtype=np.int64)
        entries = self._pairs.decode(outputs.spent, self._samples)
        if entries is None:
            return None
        shipped = 0 < sum_pairs(outputs.spent, self._samples) <= self._point_units
        if not shipped or self._points[name] >= self._budget:
            return nothing, nothing
        return entries[0].copy(), entries[1].copy()

    def _spend(self, own: int, spent: Entries, *, back: bool = False) -> None:
        """Count what a step ships; back: take it back, since the step is only judged."""
        samples, units = spent
        if not samples.size:
            return
        if self._ledger and not back:
            self._make_room(int(self._written[own]) + samples.size)
        arrays = (self._logs, self._written, self._consumed)
        spend(*arrays, self._ledger, samples, units, own, back)

    def _make_room(self, needed: int) -> None:
        """Make room for so many entries in every log."""
        rows = self._logs.shape[1]
        if needed > rows:
            self._logs = np.pad(self._logs, ((0, 0), (0, 2 * needed - rows), (0, 0)))


def _parts(message: GossipMessage) -> tuple[bytes, bytes, bytes]:
    return message.version_vector, message.logs, message.claims
