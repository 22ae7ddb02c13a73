"""The rule on registers: the sums that a spectral robot sends are those over the places where it chose."""

from collections.abc import Callable

import numpy as np

from kantor_protocol.base.machine import Envelope, Outputs, ParticipantId
from kantor_protocol.replication.cosine_basis import rectangle_of, visit_at
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import RefusedError, decode_gossip
from kantor_worldsim.observers.metrics.gossip_reader import incarnations_of, read_register
from kantor_worldsim.record.records import StepRecord

Report = Callable[[str, ParticipantId, str], None]
"""Takes the rule, the participant and the text of a violation."""


class RegisterChecker:
    """Follows the visits of all robots and compares them with the registers that they send."""

    def __init__(self, scenario: Scenario, report: Report) -> None:
        self._scenario, self._report = scenario, report
        self._roster = len(scenario.roster)
        self._rectangle = rectangle_of(scenario.domain)
        self._sums: dict[int, np.ndarray] = {}
        """(width,) by incarnation id."""

    def check(
        self, step_record: StepRecord, outputs: Outputs, incarnation_id: int, points: int
    ) -> None:
        """Check one step; points: shipped by this incarnation so far, the step included."""
        width = self._scenario.register_width
        sums = self._sums.setdefault(incarnation_id, np.zeros(width, dtype=np.int64))
        if outputs.spent:  # it chose where it was observed last
            pose, modes = step_record.observation.pose, self._scenario.planner.modes
            sums += visit_at(pose.x_m, pose.y_m, self._rectangle, modes)
        for envelope in outputs.outbox:
            sent = self._sent(envelope, incarnation_id)
            if sent is None:
                self._report("register", step_record.name, "sends a message that does not decode")
            elif sent[0] and sent[1].tobytes() != sums.tobytes():
                self._report("register", step_record.name, "its sums are not those over its places")
            elif sent[0] and sent[0] != points:
                self._report("register", step_record.name, f"writes {sent[0]} of {points}")

    def _sent(self, envelope: Envelope, incarnation_id: int) -> tuple[int, np.ndarray] | None:
        """Stamp and numbers of an incarnation's register in a message; None if it does not decode."""
        try:
            gossip = decode_gossip(envelope.body)
        except RefusedError:
            return None
        claims = self._scenario.claiming
        origins = incarnations_of(gossip.version_vector, self._roster, claims=claims)
        if not origins:
            return None
        width = self._scenario.register_width
        return read_register(gossip.registers, origins, width, incarnation_id)
