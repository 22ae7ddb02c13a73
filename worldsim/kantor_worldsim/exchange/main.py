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
    doorway = Lobby(host, plan, recording, stopped, show, hands, say)
    listeners = [recording.take, doorway.tell]
    if past is None:
        stage = Simulation(plan.scenario, plan.seed, plan.site, listeners)
    else:
        stage = Simulation.resumed(plan.scenario, plan.seed, plan.site, past.records, listeners)
        doorway.recall(past.records)
    doorway.stage = stage
    stage.forget()
    doorway.gather(plan.patience_s if past is None else RETURN_S)
    if plan.exchange == "wall":
        reason = RealtimeExchange(doorway, stage, plan, resumed=past is not None).run()
    else:
        doorway.open(lambda: stage.done_ns)
        reason = simulate(stage, LockstepExchange(doorway), plan.seed, stopped)
    doorway.dismiss(reason, 0.0 if past is None else COME_BACK_S)
    recording.refused_at_door = doorway.refused
    recording.excess = host.excess
    result = recording.finish()
    doorway.tell_progress("over", reason)
    return result
