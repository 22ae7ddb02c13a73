"""The supervisor as a process."""

from collections.abc import Callable

from kantor_protocol.credentials import Identity
from kantor_protocol.machine import StateMachine
from kantor_protocol.messages import Mission
from kantor_protocol.process import participate
from kantor_supervisor.core import Supervisor


def run(connect: str, identity: Identity, patience_s: float, say: Callable[[str], None]) -> str:
    """Be the supervisor until the mission is over; why it ended.

    Raises BusError and NotWantedError.
    """

    def build(mission: Mission) -> StateMachine:
        if mission.frame is not None:
            from kantor_supervisor.allocation import Allocation  # noqa: PLC0415  only on a map

            return Allocation(identity.user, mission.scenario, mission.seed, mission.frame)
        return Supervisor(identity.user, mission.scenario, mission.samples.shape[0])

    return participate(connect, identity, build, patience_s, say)
