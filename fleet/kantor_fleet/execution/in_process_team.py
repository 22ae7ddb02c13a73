"""The participants of a scenario as objects, and their mission inside one process."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial

from kantor_agent.robots.density import DensityRobot
from kantor_agent.robots.mapping import MappingRobot
from kantor_protocol.base.machine import SUPERVISOR, Body, ParticipantId, StateMachine
from kantor_protocol.node.recovery import KillableNode
from kantor_protocol.scenario.faults.processes import Kill
from kantor_protocol.scenario.schema import Scenario
from kantor_supervisor.density import DensitySupervisor
from kantor_supervisor.mapping import MappingSupervisor
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Observer, Simulation
from kantor_worldsim.exchange.in_process import in_process
from kantor_worldsim.world.world import WorldSetup


def team(scenario: Scenario, seed: int, site: WorldSetup) -> dict[ParticipantId, StateMachine]:
    """All participants of the roster; those that the scenario kills are killable."""
    killed = {name for fault in scenario.faults if isinstance(fault, Kill) for name in fault.who}
    made: dict[ParticipantId, StateMachine] = {}
    for name, pose in site.poses(scenario).items():
        build, body = partial(participant, name, scenario, seed, site), Body(pose)
        made[name] = KillableNode(build, body) if name in killed else build(body)
    return made


def participant(
    name: ParticipantId, scenario: Scenario, seed: int, site: WorldSetup, body: Body
) -> StateMachine:
    """A participant that takes over a body."""
    frame = site.ground.frame if site.ground is not None else None
    if name == SUPERVISOR:
        if frame is not None:
            return MappingSupervisor(name, scenario, seed, body, frame)
        return DensitySupervisor(name, scenario, body, site.samples_m.shape[0])
    if frame is not None:
        return MappingRobot(name, scenario, seed, body, frame)
    return DensityRobot(name, scenario, seed, body, site.samples_m)


def play(
    scenario: Scenario,
    seed: int,
    site: WorldSetup,
    observers: Iterable[Observer],
    *,
    machines: Mapping[ParticipantId, StateMachine] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> str:
    """Run a mission in this process; why it ended. machines: by default the team of the scenario."""
    simulation = Simulation(scenario, seed, site, observers)
    return simulate(simulation, in_process(machines or team(scenario, seed, site)), seed, stopped)
