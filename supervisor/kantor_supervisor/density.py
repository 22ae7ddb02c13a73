"""The supervisor of a mission on a density (Kabir & Lee, Algorithm 2): one more participant.

It hears every robot, merges what they know by the mission's rule (eq. 8), and sends the result to all of
them (eq. 9). It is a relay with a place of its own; a robot treats its messages as those of a neighbour.
"""

from kantor_protocol.base.machine import Body, Inputs, Outputs, ParticipantId, State
from kantor_protocol.replication.gossip import Gossip, build_replica
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Identities
from kantor_protocol.wire.weights import Units, WeightsPublisher


class DensitySupervisor:
    """The supervisor of a scenario with a density. `step` is its only entrance."""

    def __init__(
        self,
        me: ParticipantId,
        scenario: Scenario,
        body: Body,
        samples: int,
        identities: Identities | None = None,
    ) -> None:
        """body: the one that the supervisor takes over. samples: N. identities: see Gossip."""
        units = Units.of(scenario.energy.points, samples)
        self._replica = build_replica(me, scenario, units, samples, body.incarnation)
        self._gossip = Gossip(me, scenario, body.incarnation, identities)
        self._publisher = WeightsPublisher(
            self._replica.weights,
            scenario.publish.weights_every,
            scenario.publish.keyframe_every,
        )
        self._step, self._pose = body.step, body.pose

    def step(self, inputs: Inputs, /) -> Outputs:
        """Take in what the robots sent, send every robot what it lacks."""
        self._step += 1
        self._gossip.receive(inputs.inbox, self._replica)
        finished = self._replica.empty
        outputs = Outputs(
            step=self._step,
            pose=self._pose,
            lowered=self._replica.packed_lowered(),
            weights=self._publisher.step(self._replica.lowered(), last=finished),
            outbox=(self._gossip.compose(self._replica, self._step, self._pose),),
            state=State.FINISHED if finished else State.EXPLORING,
            refused=self._gossip.refused,
        )
        self._replica.end_step()
        return outputs

    def validate(self) -> None:
        """Assert what its parts say of themselves; true between two steps."""
        self._replica.validate()
        self._gossip.validate(self._replica)
