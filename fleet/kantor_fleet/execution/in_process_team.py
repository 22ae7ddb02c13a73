"""The participants of a scenario as objects, and a mission of theirs inside one process.

With `trust = "signed"` their keys follow from the seed: here they keep nobody out, and the same mission gives the same
signatures.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from kantor_agent.robots.byzantine import ByzantineRobot, as_declared
from kantor_agent.robots.density import DensityRobot
from kantor_agent.robots.mapping import MappingRobot
from kantor_protocol.base.machine import SUPERVISOR, Body, ParticipantId, StateMachine
from kantor_protocol.node.recovery import KillableNode
from kantor_protocol.node.signing import Signing
from kantor_protocol.scenario.faults.processes import Kill
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Identities
from kantor_protocol.wire.signatures import SigningKey
from kantor_supervisor.density import DensitySupervisor
from kantor_supervisor.mapping import MappingSupervisor
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Observer, Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.world.world import WorldSetup


def team(scenario: Scenario, seed: int, setup: WorldSetup) -> dict[ParticipantId, StateMachine]:
    """All participants of the roster; a `KillableNode` for each that the scenario kills."""
    killed = {name for fault in scenario.faults if isinstance(fault, Kill) for name in fault.who}
    identities = team_identities(scenario, seed)
    made: dict[ParticipantId, StateMachine] = {}
    for name, pose in setup.poses(scenario).items():
        build = partial(_member, name, scenario, seed, setup, identities)
        made[name] = KillableNode(build, Body(pose)) if name in killed else build(Body(pose))
    return made


def team_identities(scenario: Scenario, seed: int) -> Identities | None:
    """Whose word counts in a mission in this process; None with `trust = "open"`."""
    if not scenario.signed:
        return None
    keys = {name: _key(seed, name).public for name in scenario.roster}
    return Identities(f"{scenario.name}, seed {seed}", keys)


def _key(seed: int, name: ParticipantId) -> SigningKey:
    from kantor_protocol.wire.signing_keys import Ed25519Key  # noqa: PLC0415  open runs need no key

    secret = hashlib.blake2b(name.encode(), digest_size=32, key=seed.to_bytes(8, "little"))
    return Ed25519Key(secret.digest())


def _member(
    name: ParticipantId,
    scenario: Scenario,
    seed: int,
    setup: WorldSetup,
    identities: Identities | None,
    body: Body,
) -> StateMachine:
    """A participant that signs, if the mission is signed."""
    machine = participant(name, scenario, seed, setup, body, identities)
    return machine if identities is None else Signing(machine, identities.run, _key(seed, name))


def participant(
    name: ParticipantId,
    scenario: Scenario,
    seed: int,
    setup: WorldSetup,
    body: Body,
    identities: Identities | None = None,
) -> StateMachine:
    """The state machine of a participant that takes over a body. identities: with `trust = "signed"`."""
    frame = setup.ground.frame if setup.ground is not None else None
    if name == SUPERVISOR:
        if frame is not None:
            return MappingSupervisor(name, scenario, seed, body, frame, identities)
        return DensitySupervisor(name, scenario, body, setup.samples_m.shape[0], identities)
    robot: DensityRobot | MappingRobot
    if frame is not None:
        robot = MappingRobot(name, scenario, seed, body, frame, identities)
    else:
        robot = DensityRobot(name, scenario, seed, body, setup.samples_m, identities)
    return as_declared(name, scenario, seed, robot)


def lies_told(member: StateMachine) -> int:
    """Steps in which a member of a team has lied, by its own count; 0 for the honest and the dead."""
    machine: object = member
    while hasattr(machine, "machine"):
        machine = machine.machine
    return machine.told if isinstance(machine, ByzantineRobot) else 0


def play(
    scenario: Scenario,
    seed: int,
    setup: WorldSetup,
    observers: Iterable[Observer],
    *,
    machines: Mapping[ParticipantId, StateMachine] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> str:
    """Run a mission in this process; the reason of its end. machines: instead of the scenario's team."""
    simulation = Simulation(scenario, seed, setup, observers, team_identities(scenario, seed))
    exchange = InProcessExchange(machines or team(scenario, seed, setup))
    return simulate(simulation, exchange, seed, stopped, exchange)
