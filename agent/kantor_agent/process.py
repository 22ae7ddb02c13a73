"""A robot as a process."""

from collections.abc import Callable
from pathlib import Path

from kantor_agent.core import Agent
from kantor_protocol.credentials import Identity
from kantor_protocol.machine import Body, StateMachine
from kantor_protocol.messages import Mission
from kantor_protocol.process import participate


def run(
    connect: str, identity: Identity, patience_s: float, say: Callable[[str], None], state: Path
) -> str:
    """Be the robot of this identity until the mission is over; why it ended.

    state: folder of its diary. Raises BusError, NotWantedError and StateError.
    """

    def build(mission: Mission, _body: Body) -> StateMachine:
        starts_m = mission.starts.open("<f8", 2)
        x_m, y_m = starts_m[mission.scenario.robot_ids.index(identity.user)].tolist()
        if mission.frame is not None:
            from kantor_agent.mapper import Mapper  # noqa: PLC0415  only where there is a map

            return Mapper(identity.user, mission.scenario, mission.seed, (x_m, y_m), mission.frame)
        samples_m = mission.samples.open("<f8", 2)
        return Agent(identity.user, mission.scenario, mission.seed, (x_m, y_m), samples_m)

    return participate(connect, identity, build, patience_s, say, state)
