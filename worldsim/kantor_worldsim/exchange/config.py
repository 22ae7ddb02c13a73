"""The mission that a world-sim process runs, and what it needs for that."""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import NamedTuple

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.processes import (
    ClockFault,
    Impostor,
    Kill,
    Late,
    OnProcesses,
)
from kantor_protocol.scenario.faults.schedule import kind_of
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Identities
from kantor_worldsim.world.world import WorldSetup


class MissionConfig(NamedTuple):
    """The mission that a world-sim process runs."""

    scenario: Scenario
    seed: int
    setup: WorldSetup
    exchange: str
    """`lockstep` or `wall`, as records spell it."""
    speed: float = 1.0
    """Realtime: simulated seconds in a real one."""
    start_after_s: float | None = None
    """Real seconds after which the mission starts without the missing participants; None: never."""
    keys: Mapping[ParticipantId, bytes] = MappingProxyType({})
    """With `trust = "signed"`: the public key of every participant; empty for one whose word does not count."""

    def identities(self, run: str) -> Identities | None:
        """Whose word counts in a run that begins; None with `trust = "open"`."""
        return Identities(run, dict(self.keys)) if self.scenario.signed else None


def needs_process_control(scenario: Scenario, exchange: str) -> str | None:
    """The first fault that only the process that started the fleet can inject, as `faults[i]: kind`."""
    real = (Kill, Late, Impostor) if exchange == "lockstep" else OnProcesses
    for i, fault in enumerate(scenario.faults):
        if isinstance(fault, real) and not isinstance(fault, ClockFault):
            return f"faults[{i}]: {kind_of(fault)}"
    return None


def late_participants(scenario: Scenario) -> Iterator[ParticipantId]:
    """Participants that are not there from the start."""
    for fault in scenario.faults:
        if isinstance(fault, Late):
            yield from fault.who
