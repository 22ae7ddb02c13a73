"""The supervisor as a process."""

from collections.abc import Callable
from pathlib import Path

from kantor_protocol.base.machine import Body, StateMachine
from kantor_protocol.node.runner import participate
from kantor_protocol.transport.credentials import Identity
from kantor_protocol.wire.messages import Mission
from kantor_supervisor.density import DensitySupervisor


def run(
    connect: str,
    identity: Identity,
    connect_timeout_s: float,
    say: Callable[[str], None],
    state: Path,
    lease_ms: int | None = None,
) -> str:
    """Play the supervisor until the mission is over; returns why it ended.

    state: folder of its write-ahead log. lease_ms: after which it is missed. Raises BusError, RejectedError and StateError.
    """

    def build(mission: Mission, body: Body) -> StateMachine:
        me, scenario = identity.user, mission.scenario
        identities = mission.identities
        if mission.frame is not None:
            from kantor_supervisor.mapping import MappingSupervisor  # noqa: PLC0415  only on a map

            return MappingSupervisor(me, scenario, mission.seed, body, mission.frame, identities)
        return DensitySupervisor(me, scenario, body, mission.samples.shape[0], identities)

    return participate(connect, identity, build, connect_timeout_s, say, state, lease_ms)
