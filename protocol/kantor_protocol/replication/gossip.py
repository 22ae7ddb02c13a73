"""A participant's end of the radio: envelopes in and out, with the check at the door."""

import math
from collections.abc import Callable, Iterable

from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Envelope, ParticipantId, Pose
from kantor_protocol.replication.registers import Registers
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import NOBODY
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import (
    VERSION,
    GossipMessage,
    RefusedError,
    decode_gossip,
    encode_gossip,
)
from kantor_protocol.wire.weights import Units

CONTACT_PERIODS = 8
"""Whoever was not heard for more of the own steps is out of contact."""

Learn = Callable[[int, bytes, bytes, bytes, bytes], bool]
"""Takes in a message by the slot of its sender and the parts of its News; see `Replica.learn`."""


class Gossip:
    """Turns what a replica has to say into envelopes, and envelopes into what it learns.

    A robot with a supervisor talks to it alone. When it has not heard it for a while it talks to everybody,
    until it hears it again: what a supervisor missed meanwhile it gets as any neighbour does.
    """

    def __init__(self, me: ParticipantId, scenario: Scenario, incarnation: int = 0) -> None:
        """epoch: which incarnation speaks."""
        self.refused = 0
        """Messages that were malformed, too old or from nobody in the roster."""
        roster = scenario.roster
        self._me, self._incarnation, self._origins = me, incarnation, len(roster)
        self._places = {name: i for i, name in enumerate(roster) if name != me}
        self._supervisor = self._supervisor_slot = self._places.get(SUPERVISOR, NOBODY)
        """Its place, and the slot of its newest incarnation; NOBODY without one."""
        self._unheard_steps = -ack_timeout_steps(me, scenario)  # the first word takes its time
        """Own steps since the supervisor was heard."""

    def hear(self, inbox: Iterable[Envelope], learn: Learn) -> None:
        """Have every sound message of a step learned; count the others."""
        self._unheard_steps += 1
        for envelope in inbox:
            place = self._places.get(envelope.source)
            try:
                news = decode_gossip(envelope.body)
            except RefusedError:
                place = None
            if place is None:
                self.refused += 1
                continue
            slot = place + news.incarnation * self._origins
            if not learn(slot, news.version_vector, news.logs, news.claims, news.registers):
                self.refused += 1
            elif place == self._supervisor:
                self._supervisor_slot = max(self._supervisor_slot, slot)
                self._unheard_steps = 0

    def say(self, replica: Replica, step: int, pose: Pose) -> Envelope:
        """What whoever it talks to lacks."""
        alone = self._supervisor == NOBODY or self._unheard_steps > CONTACT_PERIODS
        slot = NOBODY if alone else self._supervisor_slot
        target = EVERYBODY if alone else SUPERVISOR
        version_vector, logs, claims = replica.compose(slot)
        news = GossipMessage(
            version=VERSION,
            step=step,
            x_m=pose.x_m,
            y_m=pose.y_m,
            version_vector=version_vector,
            logs=logs,
            claims=claims,
            registers=replica.registers.compose(slot),
            incarnation=self._incarnation,
        )
        return Envelope(source=self._me, sequence=step, target=target, body=encode_gossip(news))


def build_replica(
    me: ParticipantId, scenario: Scenario, units: Units | None, samples: int, incarnation: int = 0
) -> Replica:
    """An empty replica for an incarnation of a participant of a scenario; see Replica."""
    origins = len(scenario.roster)
    slot = incarnation * origins + scenario.roster.index(me)
    relay, beacon = me == SUPERVISOR, scenario.radio.beacon == "state"
    patience = ack_timeout_steps(me, scenario)
    return Replica(
        slot,
        origins,
        samples,
        units,
        ledger=scenario.mapping or scenario.merge == "ledger",
        claims=scenario.claiming,
        relay=relay,
        beacon=beacon,
        patience_steps=patience,
        registers=Registers(
            slot,
            origins,
            scenario.register_width,
            sums=not scenario.mapping,
            relay=relay,
            beacon=beacon,
            patience_steps=patience,
        ),
    )


def ack_timeout_steps(me: ParticipantId, scenario: Scenario) -> int:
    """Own steps until an answer is due: the way there and back, and the other's next step."""
    radio, clock = scenario.radio, scenario.clock
    way_s = radio.delay_s + radio.jitter_s
    slowest_s = clock.period_s * (1.0 + clock.spread + clock.drift_ppm * 1e-6) + clock.jitter_s
    own_s = step_clocks(scenario, 0)[me].period_ns * 1e-9 if me == SUPERVISOR else clock.period_s
    return 1 + math.ceil((2.0 * way_s + slowest_s) / own_s - 1e-9)
