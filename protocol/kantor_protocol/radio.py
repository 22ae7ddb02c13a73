"""A participant's end of the radio: envelopes in and out, with the check at the door."""

import math
from collections.abc import Callable, Iterable

from kantor_protocol.clock import clocks
from kantor_protocol.machine import SUPERVISOR, Envelope, ParticipantId, Pose
from kantor_protocol.messages import VERSION, News, RefusedError, decode_news, encode_news
from kantor_protocol.registers import Registers
from kantor_protocol.replica import NOBODY, Replica
from kantor_protocol.scenario import Scenario
from kantor_protocol.weights import Units


class Radio:
    """Turns what a replica has to say into envelopes, and envelopes into what it learns."""

    def __init__(self, me: ParticipantId, roster: tuple[ParticipantId, ...]) -> None:
        self.refused = 0
        """Messages that were malformed, too old or from nobody in the roster."""
        self._me = me
        self._places = {name: i for i, name in enumerate(roster) if name != me}

    def hear(self, inbox: Iterable[Envelope], learn: Callable[[int, News], bool]) -> None:
        """Pass every sound message on to `learn(place in the roster, news)`; count the others."""
        for envelope in inbox:
            source = self._places.get(envelope.source)
            try:
                taken = source is not None and learn(source, decode_news(envelope.body))
            except RefusedError:
                taken = False
            self.refused += not taken

    def say(self, replica: Replica, target: ParticipantId, step: int, pose: Pose) -> Envelope:
        """What the target, or everybody in range, lacks."""
        place = self._places.get(target, NOBODY)
        have, logs, claims = replica.compose(place)
        news = News(
            version=VERSION,
            step=step,
            x_m=pose.x_m,
            y_m=pose.y_m,
            have=have,
            logs=logs,
            claims=claims,
            registers=replica.registers.compose(place),
        )
        return Envelope(source=self._me, sequence=step, target=target, body=encode_news(news))


def replica_of(me: ParticipantId, scenario: Scenario, units: Units | None, samples: int) -> Replica:
    """An empty replica for a participant of a scenario; see Replica."""
    place, origins = scenario.roster.index(me), len(scenario.roster)
    relay, beacon = me == SUPERVISOR, scenario.radio.beacon == "state"
    patience = patience_steps(me, scenario)
    return Replica(
        place,
        origins,
        samples,
        units,
        ledger=scenario.mapping or scenario.merge == "ledger",
        claims=scenario.claiming,
        relay=relay,
        beacon=beacon,
        patience_steps=patience,
        registers=Registers(
            place,
            origins,
            scenario.register_width,
            sums=not scenario.mapping,
            relay=relay,
            beacon=beacon,
            patience_steps=patience,
        ),
    )


def patience_steps(me: ParticipantId, scenario: Scenario) -> int:
    """Own steps until an answer is due: the way there and back, and the other's next step."""
    radio, clock = scenario.radio, scenario.clock
    way_s = radio.delay_s + radio.jitter_s
    slowest_s = clock.period_s * (1.0 + clock.spread + clock.drift_ppm * 1e-6) + clock.jitter_s
    own_s = clocks(scenario, 0)[me].period_ns * 1e-9 if me == SUPERVISOR else clock.period_s
    return 1 + math.ceil((2.0 * way_s + slowest_s) / own_s - 1e-9)
