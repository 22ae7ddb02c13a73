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

    def build(mission: Mission, body: Body) -> StateMachine:
        me, scenario, seed = identity.user, mission.scenario, mission.seed
        if mission.frame is not None:
            from kantor_agent.mapper import Mapper  # noqa: PLC0415  only where there is a map

            return Mapper(me, scenario, seed, body, mission.frame)
        return Agent(me, scenario, seed, body, mission.samples.open("<f8", 2))

    return participate(connect, identity, build, patience_s, say, state)
