"""What a world-sim process is to run, and what it needs for that."""

from collections.abc import Iterator
from typing import NamedTuple

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.processes import ClockFault, Impostor, Kill, Late, OnProcesses
from kantor_protocol.scenario.faults.schedule import kind_of
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.world import WorldSetup


class MissionConfig(NamedTuple):
    """What a world-sim process is to run."""

    scenario: Scenario
    seed: int
    site: WorldSetup
    exchange: str
    """`lockstep` or `wall`."""
    speed: float = 1.0
    """Wall: simulated seconds in a real one."""
    patience_s: float | None = None
    """How long to wait for the whole roster before starting without the rest; None: for ever."""


def needs_process_control(scenario: Scenario, exchange: str) -> str | None:
    """The first fault that only whoever has started the processes can carry out, as `faults[i]: kind`."""
    real = (Kill, Late, Impostor) if exchange == "lockstep" else OnProcesses
    for i, fault in enumerate(scenario.faults):
        if isinstance(fault, real) and not isinstance(fault, ClockFault):
            return f"faults[{i}]: {kind_of(fault)}"
    return None


def late(scenario: Scenario) -> Iterator[ParticipantId]:
    """Participants that are not there from the start."""
    for fault in scenario.faults:
        if isinstance(fault, Late):
            yield from fault.who
