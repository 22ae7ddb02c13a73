"""A participant's end of the radio: envelopes in and out, every received message checked before it is merged."""

import math
from collections.abc import Iterable, Mapping

import numpy as np

from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Envelope, ParticipantId, Pose
from kantor_protocol.replication.attested import Attested
from kantor_protocol.replication.proofs import Rules, read_word
from kantor_protocol.replication.registers import Registers, are_registers
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import (
    HISTORY,
    LENGTH_MAX,
    NO_INDEX,
    UNITS_MAX,
    ReplicaArrays,
    ReplicaConfig,
    is_mergeable,
)
from kantor_protocol.scenario.clocks import step_clocks, steps_max
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Attestation, Identities
from kantor_protocol.wire.messages import (
    VERSION,
    GossipMessage,
    RefusedError,
    decode_gossip,
    encode_gossip,
)
from kantor_protocol.wire.version_vector import count_ids
from kantor_protocol.wire.weights import Units

CONTACT_PERIODS = 8
"""A participant from which no message came for more of the own steps is out of contact."""


class Gossip:
    """Makes envelopes of what a replica composes, and has it merge the envelopes that arrive.

    A robot with a supervisor sends to it alone. When it has received nothing from it for a while it sends to all in
    range, until it receives from it again: what a supervisor missed meanwhile it gets as any neighbour does.
    """

    def __init__(
        self,
        me: ParticipantId,
        scenario: Scenario,
        incarnation: int = 0,
        identities: Identities | None = None,
    ) -> None:
        """incarnation: the one that sends. identities: with `trust = "signed"`, and only then."""
        assert scenario.signed == (identities is not None), "a signed mission needs identities"
        self.refused = 0
        """Messages that were malformed, too old or from no other participant of the roster."""
        self._attested = Attested(me, scenario, identities) if identities else None
        roster = scenario.roster
        self._me, self._incarnation, self._roster = me, incarnation, len(roster)
        self._places = {name: i for i, name in enumerate(roster) if name != me}
        self._supervisor = self._supervisor_id = self._places.get(SUPERVISOR, NO_INDEX)
        """Its place, and the id of its newest incarnation; NO_INDEX without one."""
        self._unheard_steps = -ack_timeout_steps(me, scenario)  # its first message takes its time
        """Own steps since a message of the supervisor was received."""

    @property
    def forked(self) -> Mapping[int, Attestation]:
        """The origins that have told two stories, each with an attestation that shows it; see `attested.py`."""
        return {} if self._attested is None else self._attested.forked

    def receive(self, inbox: Iterable[Envelope], replica: Replica) -> None:
        """Have every well-formed message of a step merged; count the others."""
        self._unheard_steps += 1
        attested = self._attested
        for envelope in inbox:
            place = self._places.get(envelope.source)
            try:
                message = decode_gossip(envelope.body)
            except RefusedError:
                place = None
            if place is None:
                self.refused += 1
                continue
            source = place + message.incarnation * self._roster
            if attested is None:
                parts = (message.version_vector, message.logs, message.claims, message.registers)
                taken = replica.merge(source, *parts)
            else:
                taken = attested.merge(replica, source, message)
            if not taken:
                self.refused += 1
            elif place == self._supervisor:
                self._supervisor_id = max(self._supervisor_id, source)
                self._unheard_steps = 0

    def compose(self, replica: Replica, step: int, pose: Pose, *, final: bool = False) -> Envelope:
        """The envelope of one step, with what its receivers lack. final: the state of its sender is."""
        to_all = self._supervisor == NO_INDEX or self._unheard_steps > CONTACT_PERIODS
        receiver = NO_INDEX if to_all else self._supervisor_id
        target = EVERYBODY if to_all else SUPERVISOR
        version_vector, logs, claims = replica.compose(receiver)
        message = GossipMessage(
            version=VERSION,
            step=step,
            x_m=pose.x_m,
            y_m=pose.y_m,
            version_vector=version_vector,
            logs=logs,
            claims=claims,
            registers=replica.registers.compose(receiver),
            incarnation=self._incarnation,
        )
        if self._attested is not None:
            message = self._attested.attest(replica, message, to_all=to_all, final=final)
        return Envelope(source=self._me, sequence=step, target=target, body=encode_gossip(message))

    def validate(self, replica: Replica) -> None:
        """Assert what it says of a replica that it has received and composed for."""
        if self._attested is not None:
            self._attested.validate(replica)


def build_replica(
    me: ParticipantId, scenario: Scenario, units: Units | None, samples: int, incarnation: int = 0
) -> Replica:
    """An empty replica for an incarnation of a participant of a scenario; see Replica."""
    roster = len(scenario.roster)
    incarnation_id = incarnation * roster + scenario.roster.index(me)
    relay, beacon = me == SUPERVISOR, scenario.radio.beacon == "state"
    timeout_steps = ack_timeout_steps(me, scenario)
    proving = scenario.signed and not relay
    return Replica(
        incarnation_id,
        roster,
        samples,
        units,
        ledger=scenario.mapping or scenario.merge == "ledger",
        claims=scenario.claiming,
        relay=relay,
        beacon=beacon,
        ack_timeout_steps=timeout_steps,
        length_max=log_length_max(scenario, units, samples),
        stamp_max=steps_max(scenario),
        spend_max=spend_max(scenario, units),
        proving=proving,
        registers=Registers(
            incarnation_id,
            roster,
            scenario.register_width,
            sums=not scenario.mapping,
            relay=relay,
            beacon=beacon,
            ack_timeout_steps=timeout_steps,
            stamp_max=steps_max(scenario),
            proving=proving,
        ),
    )


_ENTRIES_PER_CELL = 32
"""On a map with a noisy sensor a cell may change its kind many times."""
_RANGES_PER_STEP = 8
"""More than any scan shares."""


def log_length_max(scenario: Scenario, units: Units | None, samples: int) -> int:
    """No origin of a mission writes more entries. units, samples: see `build_replica`.

    On a map: a small multiple of the cells, and a few ranges in each step. ledger: an entry ships one unit at least,
    and the energy of the team lasts for so many. min: every entry lowers a weight by one unit at least.
    """
    if units is None:
        return _ENTRIES_PER_CELL * samples + _RANGES_PER_STEP * steps_max(scenario)
    if scenario.merge == "ledger":
        points = max(scenario.energy.points, scenario.steps_per_robot)
        return min(points * units.point, LENGTH_MAX)
    return min(samples * units.sample, LENGTH_MAX)


def spend_max(scenario: Scenario, units: Units | None) -> int:
    """No participant of a mission ships more units, all its incarnations together. units: see `build_replica`."""
    if units is None or scenario.merge != "ledger":
        return UNITS_MAX
    return min(scenario.steps_per_robot * units.point, UNITS_MAX)


class MessageCheck:
    """The checks of every receiver on arrival, for one who is no participant and holds nothing."""

    def __init__(
        self,
        scenario: Scenario,
        units: Units | None,
        samples: int,
        identities: Identities | None = None,
    ) -> None:
        """units, samples: see `build_replica`. identities: given them, what is said of others must be proven."""
        self._roster = len(scenario.roster)
        self._parts = 2 if scenario.claiming else 1
        self._width = scenario.register_width
        self._sums = not scenario.mapping
        self._stamp_max = steps_max(scenario)
        ledger = scenario.mapping or scenario.merge == "ledger"
        config = ReplicaConfig(
            me=NO_INDEX,
            ledger=ledger,
            claims=scenario.claiming,
            relay=False,
            beacon=False,
            ack_timeout_steps=1,
            value_max=0 if units is None else units.point if ledger else units.sample,
            bound=samples,
            roster=self._roster,
            length_max=log_length_max(scenario, units, samples),
            stamp_max=self._stamp_max,
            spend_max=spend_max(scenario, units),
            proving=scenario.signed,
        )
        self._rules = identities and Rules.of(identities, scenario.roster, config, self._width)
        self._fields = (*_nothing_held(self._roster), np.array(config, dtype=np.int64))

    def passes(self, source: int, message: GossipMessage) -> bool:
        """Whether every participant but its sender would take a message. source: the sender's incarnation id."""
        vector, registers = message.version_vector, message.registers
        if registers:
            covered = count_ids(vector, self._roster, self._parts)
            if not are_registers(
                registers, covered, self._width, sums=self._sums, stamp_max=self._stamp_max
            ):
                return False
        if self._rules and read_word(self._rules, source, message) is None:
            return False
        return bool(is_mergeable(*self._fields, vector, message.logs, message.claims, source))


def _nothing_held(origins: int) -> ReplicaArrays:
    """Arrays without an entry, which checks may read."""
    none32, none64 = np.zeros(0, dtype=np.int32), np.zeros(3, dtype=np.int64)
    return ReplicaArrays(
        weights=none32,
        logs=np.zeros((1, 1, 2), dtype=np.int32),
        length=np.zeros(origins, dtype=np.int64),
        known=np.zeros((1, 1), dtype=np.int32),
        sending=np.zeros((HISTORY, origins), dtype=np.int64),
        claims=np.zeros((4, origins), dtype=np.int64),
        lowered=none32,
        mark=none32,
        counters=none64,
    )


def ack_timeout_steps(me: ParticipantId, scenario: Scenario) -> int:
    """Own steps until an acknowledgement is due: the way there and back, and the other's next step."""
    radio, clock = scenario.radio, scenario.clock
    way_s = radio.delay_s + radio.jitter_s
    slowest_s = clock.period_s * (1.0 + clock.spread + clock.drift_ppm * 1e-6) + clock.jitter_s
    own_s = step_clocks(scenario, 0)[me].period_ns * 1e-9 if me == SUPERVISOR else clock.period_s
    return 1 + math.ceil((2.0 * way_s + slowest_s) / own_s - 1e-9)
