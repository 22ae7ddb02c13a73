"""The participants of a scenario as objects, and a mission of theirs inside one process."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial

from kantor_agent.core import Agent
from kantor_agent.mapper import Mapper
from kantor_protocol.faults import Kill
from kantor_protocol.life import Mortal
from kantor_protocol.machine import SUPERVISOR, Body, ParticipantId, StateMachine
from kantor_protocol.scenario import Scenario
from kantor_supervisor.allocation import Allocation
from kantor_supervisor.core import Supervisor
from kantor_worldsim.loop import in_process, simulate
from kantor_worldsim.stage import Listener, Stage
from kantor_worldsim.world import Site


def team(scenario: Scenario, seed: int, site: Site) -> dict[ParticipantId, StateMachine]:
    """Everybody in the roster; whom the scenario has killed can be killed."""
    killed = {name for fault in scenario.faults if isinstance(fault, Kill) for name in fault.who}
    made: dict[ParticipantId, StateMachine] = {}
    for name, pose in site.poses(scenario).items():
        build, body = partial(participant, name, scenario, seed, site), Body(pose)
        made[name] = Mortal(build, body) if name in killed else build(body)
    return made


def participant(
    name: ParticipantId, scenario: Scenario, seed: int, site: Site, body: Body
) -> StateMachine:
    """One participant as it takes over a body."""
    frame = site.ground.frame if site.ground is not None else None
    if name == SUPERVISOR:
        if frame is not None:
            return Allocation(name, scenario, seed, body, frame)
        return Supervisor(name, scenario, body, site.samples_m.shape[0])
    if frame is not None:
        return Mapper(name, scenario, seed, body, frame)
    return Agent(name, scenario, seed, body, site.samples_m)


def play(
    scenario: Scenario,
    seed: int,
    site: Site,
    listeners: Iterable[Listener],
    *,
    machines: Mapping[ParticipantId, StateMachine] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> str:
    """A mission in this process; why it ended. machines: the team, unless others take its place."""
    stage = Stage(scenario, seed, site, listeners)
    return simulate(stage, in_process(machines or team(scenario, seed, site)), seed, stopped)
