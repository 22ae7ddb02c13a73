"""The robot that explores a density: one pure state machine."""

import numpy as np
import numpy.typing as npt

from kantor_agent.belief.belief import Belief
from kantor_agent.planners.base import Goal
from kantor_agent.planners.registry import PLANNERS
from kantor_agent.vehicles import VEHICLES, StepTimer
from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.machine import Body, Inputs, Observation, Outputs, ParticipantId, State
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.replication.gossip import Gossip, build_replica
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import NO_INDEX
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Identities
from kantor_protocol.wire.weights import Units, WeightsPublisher

_WALK_STEPS_MAX = 32
"""Steps of the random walk of samples in one step of the robot, at most, and never back. A robot that joins
late, or whose clock was behind, catches up within a few steps; one whose clock was ahead waits until it is time."""


class DensityRobot:
    """A robot of a scenario with a density. `step` is its only entrance.

    A step: take in the inbox and the observation, update the belief, choose a goal, move, spend
    weight at the new pose, publish.
    """

    def __init__(
        self,
        me: ParticipantId,
        scenario: Scenario,
        seed: int,
        body: Body,
        samples_m: npt.NDArray[np.float64],
        identities: Identities | None = None,
    ) -> None:
        """body: the one that the robot takes over. samples_m: (N, 2), world frame, at time 0.

        identities: see Gossip.
        """
        units = Units.of(scenario.energy.points, samples_m.shape[0])
        replica = build_replica(me, scenario, units, samples_m.shape[0], body.incarnation)
        random_walk = RandomWalk(
            samples_m,
            scenario.samples.diffusion_m,
            scenario.period_ns,
            seed,
            Purpose.SAMPLE_WALK,
            most_steps=_WALK_STEPS_MAX,
        )
        self._replica = replica
        self._belief = Belief(random_walk, units, replica)
        """Over `_replica`; consistent with it between two steps."""
        self._gossip = Gossip(me, scenario, body.incarnation, identities)
        self._planner = PLANNERS[scenario.planner.name](scenario)
        self._vehicle = VEHICLES[scenario.vehicle.name](scenario.vehicle)
        self._publisher = WeightsPublisher(
            replica.weights, scenario.publish.weights_every, scenario.publish.keyframe_every
        )
        self._budget = scenario.steps_per_robot
        self._timer = StepTimer(scenario.period_ns, body)
        self._now_ns = 0
        self._step, self._pose, self._energy_spent = body.step, body.pose, body.energy_spent
        self._goal: Goal | None = None
        """Where the last step headed; None in a robot that rests."""

    def step(self, inputs: Inputs, /) -> Outputs:
        """One step; see the class."""
        self._gossip.receive(inputs.inbox, self._replica)
        self._locate(inputs.observation)
        self._belief.advance(inputs.now_ns)
        elapsed_s = self._timer.elapsed_s(inputs.now_ns)
        self._now_ns, self._step = inputs.now_ns, self._step + 1
        spent = self._explore(elapsed_s) if self._state is State.EXPLORING else b""
        return self._publish(spent)

    @property
    def replica(self) -> Replica:
        """What it knows of all participants; for reading."""
        return self._replica

    def validate(self) -> None:
        """Assert what the parts say of themselves and of one another; true between two steps."""
        self._replica.validate()
        self._gossip.validate(self._replica)
        self._belief.validate()
        assert self._belief.replica is self._replica
        assert self._goal is None or self._state is State.EXPLORING

    @property
    def _state(self) -> State:
        if self._belief.empty:
            return State.FINISHED
        return State.EXHAUSTED if self._energy_spent >= self._budget else State.EXPLORING

    def _locate(self, observation: Observation) -> None:
        """Take the pose that world-sim accepted. A late observation, of an older step, changes nothing."""
        if observation.step == self._step:
            self._pose = observation.pose

    def _explore(self, dt_s: float) -> bytes:
        """Choose a goal, move towards it, ship one point from the new pose."""
        self._goal = self._planner.choose(self._belief, self._pose, self._now_ns)
        if self._goal is not None:
            self._pose = self._vehicle.drive(self._pose, self._goal.x_m, self._goal.y_m, dt_s)
        self._energy_spent += 1
        return self._belief.spend(self._pose.x_m, self._pose.y_m)

    def _publish(self, spent: bytes) -> Outputs:
        state, replica = self._state, self._replica
        if state is not State.EXPLORING:
            self._goal = None
            replica.claim(NO_INDEX, self._now_ns)
        lowered = replica.packed_lowered()
        weights = self._publisher.step(replica.lowered(), last=state is not State.EXPLORING)
        final = state is not State.EXPLORING
        envelope = self._gossip.compose(replica, self._step, self._pose, final=final)
        replica.end_step()
        return Outputs(
            step=self._step,
            pose=self._pose,
            goal=None if self._goal is None else (self._goal.x_m, self._goal.y_m),
            spent=spent,
            lowered=lowered,
            weights=weights,
            outbox=(envelope,),
            energy_spent=self._energy_spent,
            state=state,
            refused=self._gossip.refused,
        )
