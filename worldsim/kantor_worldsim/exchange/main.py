"""The world-sim process: it hosts the bus, gathers the roster, and runs the mission.

It can be killed at any time and resume from its journal. A step counts once it is on record, and only then is
its participant sent an acknowledgement, so that a participant that connects again agrees with the record: a step
that is not in it is reported again, and one that is in it is not made twice.
"""

from collections.abc import Callable

from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.transport.rate_limit import rate_limits
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.wire.messages import Progress, encode
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.admission import Admission
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.lobby import COME_BACK_S, RETURN_S, Lobby
from kantor_worldsim.exchange.lockstep import LockstepExchange
from kantor_worldsim.exchange.process_control import ProcessController, no_controller
from kantor_worldsim.exchange.realtime import RealtimeExchange
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.progress import ProgressReporter
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.run_folder import Past


def run(
    host: HubRouter,
    config: MissionConfig,
    recording: Recording,
    stopped: Callable[[], bool],
    show: Callable[[Progress], None] = lambda _progress: None,
    past: Past | None = None,
    controller: ProcessController = no_controller,
    say: Callable[[str], None] = lambda _line: None,
) -> Result:
    """Run a mission to its end, or until `stopped()`. The record is closed in every case.

    show: receives the same progress as observers on the bus. past: records that recording has observed already; the
    mission resumes from there. controller: carries out the scenario's faults of processes.
    say: receives one line for a person to read.
    """
    scenario, seed = config.scenario, config.seed
    host.limit(rate_limits(step_clocks(scenario, seed), config.exchange, config.speed))

    def publish(progress: Progress) -> None:
        host.publish_progress(encode(progress))
        show(progress)

    reporter = ProgressReporter(recording.metrics, scenario, publish)
    run_name = recording.run
    identities = past.identities if past is not None else config.identities(run_name)
    admission = Admission(scenario, config.setup, identities)
    observers = (recording.observe, reporter.observe, admission.observe)
    if past is None:
        simulation = Simulation(scenario, seed, config.setup, observers, identities)
    else:
        simulation = Simulation.resumed(scenario, seed, config.setup, past.records, observers)
    simulation.forget()
    lobby = Lobby(host, config, run_name, simulation, reporter, stopped, say, admission, identities)
    if past is not None:
        for record in past.records:
            admission.observe(record)
        lobby.recall(past.records)
    lobby.gather(config.start_after_s if past is None else RETURN_S)
    if config.exchange == "wall":
        resumed = past is not None
        relay = RealtimeExchange(lobby, simulation, config, controller, stopped, resumed=resumed)
        reason = relay.run()
    else:
        if not stopped():  # who is not there yet has not left an interrupted mission
            lobby.open(lambda: simulation.done_ns)
        lockstep = LockstepExchange(lobby, controller)
        reason = simulate(simulation, lockstep, seed, stopped, lockstep)
    lobby.dismiss(reason, 0.0 if past is None else COME_BACK_S)
    recording.refused_at_door = lobby.refused
    recording.excess, recording.refused_reports = host.excess, lobby.refused_reports
    recording.silences = lobby.silences
    result = recording.finish()
    reporter.report("over", reason, at_once=True)
    return result
