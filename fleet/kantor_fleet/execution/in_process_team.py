"""The participants of a scenario as objects, and a mission of theirs inside one process."""

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
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.world.world import WorldSetup


def team(scenario: Scenario, seed: int, setup: WorldSetup) -> dict[ParticipantId, StateMachine]:
    """All participants of the roster; a `KillableNode` for each that the scenario kills."""
    killed = {name for fault in scenario.faults if isinstance(fault, Kill) for name in fault.who}
    made: dict[ParticipantId, StateMachine] = {}
    for name, pose in setup.poses(scenario).items():
        build, body = partial(participant, name, scenario, seed, setup), Body(pose)
        made[name] = KillableNode(build, body) if name in killed else build(body)
    return made


def participant(
    name: ParticipantId, scenario: Scenario, seed: int, setup: WorldSetup, body: Body
) -> StateMachine:
    """The state machine of a participant that takes over a body."""
    frame = setup.ground.frame if setup.ground is not None else None
    if name == SUPERVISOR:
        if frame is not None:
            return MappingSupervisor(name, scenario, seed, body, frame)
        return DensitySupervisor(name, scenario, body, setup.samples_m.shape[0])
    if frame is not None:
        return MappingRobot(name, scenario, seed, body, frame)
    return DensityRobot(name, scenario, seed, body, setup.samples_m)


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
    simulation = Simulation(scenario, seed, setup, observers)
    exchange = InProcessExchange(machines or team(scenario, seed, setup))
    return simulate(simulation, exchange, seed, stopped, exchange)
