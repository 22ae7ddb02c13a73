"""The supervisor of the centralized variant (Kabir & Lee, Algorithm 2): one more participant.

It hears every robot, merges what they know by the mission's rule (eq. 8), and tells all of them
(eq. 9). It is a relay with a place of its own; a robot cannot tell its word from a neighbour's.
"""

from kantor_protocol.base.machine import Body, Inputs, Outputs, ParticipantId, State
from kantor_protocol.replication.gossip import Gossip, build_replica
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.weights import Units, WeightsPublisher


class DensitySupervisor:
    """The supervisor of a scenario. `step` is its only entrance."""

    def __init__(self, me: ParticipantId, scenario: Scenario, body: Body, samples: int) -> None:
        """body: what it takes over. samples: N."""
        units = Units.of(scenario.energy.points, samples)
        self._replica = build_replica(me, scenario, units, samples, body.incarnation)
        self._radio = Gossip(me, scenario, body.incarnation)
        self._publisher = WeightsPublisher(
            self._replica.weights,
            scenario.publish.weights_every,
            scenario.publish.keyframe_every,
        )
        self._step, self._pose = body.step, body.pose

    def step(self, inputs: Inputs, /) -> Outputs:
        """Take in what the robots sent, tell everybody what they lack."""
        self._step += 1
        self._radio.receive(inputs.inbox, self._replica.merge)
        finished = self._replica.empty
        outputs = Outputs(
            step=self._step,
            pose=self._pose,
            lowered=self._replica.packed_lowered(),
            weights=self._publisher.step(self._replica.lowered(), last=finished),
            outbox=(self._radio.compose(self._replica, self._step, self._pose),),
            state=State.FINISHED if finished else State.EXPLORING,
            refused=self._radio.refused,
        )
        self._replica.end_step()
        return outputs
