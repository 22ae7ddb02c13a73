"""The participants of a scenario as objects, and a mission of theirs inside one process."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial

from kantor_agent.core import Agent
from kantor_agent.mapper import Mapper
from kantor_protocol.faults import Kill
from kantor_protocol.life import Mortal
from kantor_protocol.machine import SUPERVISOR, Body, ParticipantId, Pose, StateMachine
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
    for name in scenario.roster:
        build = partial(participant, name, scenario, seed, site)
        made[name] = Mortal(build, _birth(name, scenario, site)) if name in killed else build()
    return made


def _birth(name: ParticipantId, scenario: Scenario, site: Site) -> Body:
    if name == SUPERVISOR:
        return Body(Pose(*scenario.supervisor_m))
    return Body(Pose(*site.starts_m[scenario.robot_ids.index(name)].tolist()))


def participant(
    name: ParticipantId, scenario: Scenario, seed: int, site: Site, body: Body | None = None
) -> StateMachine:
    """One participant as it is at time 0."""
    if body is not None and (body.step or body.epoch):
        raise NotImplementedError("a new incarnation")
    frame = site.ground.frame if site.ground is not None else None
    if name == SUPERVISOR:
        if frame is not None:
            return Allocation(name, scenario, seed, frame)
        return Supervisor(name, scenario, site.samples_m.shape[0])
    x_m, y_m = site.starts_m[scenario.robot_ids.index(name)].tolist()
    if frame is not None:
        return Mapper(name, scenario, seed, (x_m, y_m), frame)
    return Agent(name, scenario, seed, (x_m, y_m), site.samples_m)


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
