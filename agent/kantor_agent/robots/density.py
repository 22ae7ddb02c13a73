"""A robot: one pure state machine."""

import numpy as np
import numpy.typing as npt

from kantor_agent.belief.belief import Belief
from kantor_agent.planners.base import Goal
from kantor_agent.planners.registry import PLANNERS
from kantor_agent.vehicles import LATER_NS, VEHICLES
from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.machine import Body, Inputs, Observation, Outputs, ParticipantId, State
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.replication.gossip import Gossip, build_replica
from kantor_protocol.replication.replica_kernels import NOBODY
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.weights import Units, WeightsPublisher

_WALK_STEPS_MAX = 32
"""Samples walk at most so many steps in one of the robot's, and never back. Who joins late, or has a clock
that was behind, catches up within a few steps; who had a clock that was ahead waits until it is time."""


class DensityRobot:
    """A robot of a scenario. `step` is its only entrance.

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
    ) -> None:
        """body: what it takes over. samples_m: (N, 2), world frame, at time 0."""
        units = Units.of(scenario.energy.points, samples_m.shape[0])
        replica = build_replica(me, scenario, units, samples_m.shape[0], body.incarnation)
        walk = RandomWalk(
            samples_m,
            scenario.samples.diffusion_m,
            scenario.period_ns,
            seed,
            Purpose.SAMPLE_WALK,
            most_steps=_WALK_STEPS_MAX,
        )
        self._replica, self._belief = replica, Belief(walk, units, replica)
        self._radio = Gossip(me, scenario, body.incarnation)
        self._planner = PLANNERS[scenario.planner.name](scenario)
        self._vehicle = VEHICLES[scenario.vehicle.name](scenario.vehicle)
        self._publisher = WeightsPublisher(
            replica.weights, scenario.publish.weights_every, scenario.publish.keyframe_every
        )
        self._budget = scenario.steps_per_robot
        self._period_ns = scenario.period_ns
        # Who takes over a body on its way does not know when that moved last, and holds for a step.
        self._now_ns = 0 if body.step == 0 else LATER_NS
        self._step, self._pose, self._energy_spent = body.step, body.pose, body.energy_spent
        self._goal: Goal | None = None

    def step(self, inputs: Inputs, /) -> Outputs:
        """One step; see the class."""
        self._radio.receive(inputs.inbox, self._replica.merge)
        self._locate(inputs.observation)
        self._belief.advance(inputs.now_ns)
        elapsed_ns = max(0, min(inputs.now_ns - self._now_ns, self._period_ns))
        self._now_ns, self._step = inputs.now_ns, self._step + 1
        spent = self._explore(elapsed_ns * 1e-9) if self._state is State.EXPLORING else b""
        return self._publish(spent)

    @property
    def _state(self) -> State:
        if self._belief.empty:
            return State.FINISHED
        return State.EXHAUSTED if self._energy_spent >= self._budget else State.EXPLORING

    def _locate(self, observation: Observation) -> None:
        """Take the pose that the world accepted. A late word on an older step changes nothing."""
        if observation.step == self._step:
            self._pose = observation.pose

    def _explore(self, dt_s: float) -> bytes:
        """Choose a goal, move towards it, ship one point from where the robot then is."""
        self._goal = self._planner.choose(self._belief, self._pose, self._now_ns)
        if self._goal is not None:
            self._pose = self._vehicle.drive(self._pose, self._goal.x_m, self._goal.y_m, dt_s)
        self._energy_spent += 1
        return self._belief.spend(self._pose.x_m, self._pose.y_m)

    def _publish(self, spent: bytes) -> Outputs:
        state, replica = self._state, self._replica
        if state is not State.EXPLORING:
            self._goal = None
            replica.claim(NOBODY, self._now_ns)
        lowered = replica.packed_lowered()
        weights = self._publisher.step(replica.lowered(), last=state is not State.EXPLORING)
        envelope = self._radio.compose(replica, self._step, self._pose)
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
            refused=self._radio.refused,
        )
