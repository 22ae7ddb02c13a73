"""A robot as a process."""

from collections.abc import Callable
from pathlib import Path

from kantor_agent.robots.byzantine import HonestRobot, as_declared
from kantor_agent.robots.density import DensityRobot
from kantor_protocol.base.machine import Body, StateMachine
from kantor_protocol.node.runner import participate
from kantor_protocol.transport.credentials import Identity
from kantor_protocol.wire.messages import Mission


def run(
    connect: str,
    identity: Identity,
    connect_timeout_s: float,
    say: Callable[[str], None],
    state: Path,
    lease_ms: int | None = None,
) -> str:
    """Play the robot of this identity until the mission is over; returns why it ended.

    state: folder of its write-ahead log. lease_ms: after which it is missed. Raises BusError, RejectedError and StateError.
    """

    def build(mission: Mission, body: Body) -> StateMachine:
        me, scenario, seed = identity.user, mission.scenario, mission.seed
        robot: HonestRobot
        if mission.frame is not None:
            from kantor_agent.robots.mapping import MappingRobot  # noqa: PLC0415  only where there is a map

            robot = MappingRobot(me, scenario, seed, body, mission.frame, mission.identities)
        else:
            samples_m = mission.samples.open("<f8", 2)
            robot = DensityRobot(me, scenario, seed, body, samples_m, mission.identities)
        return as_declared(me, scenario, seed, robot)

    return participate(connect, identity, build, connect_timeout_s, say, state, lease_ms)
