"""The supervisor as a process."""

from collections.abc import Callable
from pathlib import Path

from kantor_protocol.credentials import Identity
from kantor_protocol.machine import Body, StateMachine
from kantor_protocol.messages import Mission
from kantor_protocol.process import participate
from kantor_supervisor.core import Supervisor


def run(
    connect: str, identity: Identity, patience_s: float, say: Callable[[str], None], state: Path
) -> str:
    """Be the supervisor until the mission is over; why it ended.

    state: folder of its diary. Raises BusError, NotWantedError and StateError.
    """

    def build(mission: Mission, body: Body) -> StateMachine:
        me, scenario = identity.user, mission.scenario
        if mission.frame is not None:
            from kantor_supervisor.allocation import Allocation  # noqa: PLC0415  only on a map

            return Allocation(me, scenario, mission.seed, body, mission.frame)
        return Supervisor(me, scenario, body, mission.samples.shape[0])

    return participate(connect, identity, build, patience_s, say, state)
