"""World-sim as a process: it hosts the bus, gathers the roster, and runs the mission over it.

It can be killed at any time and go on from its journal. What a participant did counts once it is on
record, and only then is the participant told, so whoever comes back agrees with the record: a step that is not in
it is said again, and one that is in it is not done twice.
"""

from collections.abc import Callable

from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.transport.rate_limit import rate_limits
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.wire.messages import Progress
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.lobby import COME_BACK_S, RETURN_S, Lobby
from kantor_worldsim.exchange.lockstep import LockstepExchange
from kantor_worldsim.exchange.process_control import ProcessController
from kantor_worldsim.exchange.realtime import RealtimeExchange
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.run_folder import Past


def _unseen(_progress: Progress) -> None:
    """Progress that nobody here looks at."""


def _unsaid(_line: str) -> None:
    """News that nobody here reads."""


def run(
    host: HubRouter,
    plan: MissionConfig,
    recording: Recording,
    stopped: Callable[[], bool],
    show: Callable[[Progress], None] = _unseen,
    past: Past | None = None,
    hands: ProcessController | None = None,
    say: Callable[[str], None] = _unsaid,
) -> Result:
    """Run a mission to its end, or until `stopped()`. The record is closed in every case.

    show: takes what observers on the bus are told as well. past: what recording has taken already; the
    mission goes on from there. hands: who carries out the scenario's faults of processes.
    say: takes one line of news for a person.
    """
    host.limit(rate_limits(step_clocks(plan.scenario, plan.seed), plan.exchange, plan.speed))
    lobby = Lobby(host, plan, recording, stopped, show, hands, say)
    observers = [recording.observe, lobby.tell]
    if past is None:
        simulation = Simulation(plan.scenario, plan.seed, plan.site, observers)
    else:
        simulation = Simulation.resumed(
            plan.scenario, plan.seed, plan.site, past.records, observers
        )
        lobby.recall(past.records)
    lobby.simulation = simulation
    simulation.forget()
    lobby.gather(plan.patience_s if past is None else RETURN_S)
    if plan.exchange == "wall":
        reason = RealtimeExchange(lobby, simulation, plan, resumed=past is not None).run()
    else:
        lobby.open(lambda: simulation.done_ns)
        reason = simulate(simulation, LockstepExchange(lobby), plan.seed, stopped)
    lobby.dismiss(reason, 0.0 if past is None else COME_BACK_S)
    recording.refused_at_door = lobby.refused
    recording.excess = host.excess
    result = recording.finish()
    lobby.tell_progress("over", reason)
    return result
