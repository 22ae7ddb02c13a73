"""`kantor run`: a mission from its start to its picture."""

import time
from pathlib import Path

from kantor_fleet.execution.fork_server import await_fork_server
from kantor_fleet.execution.in_process_team import play
from kantor_fleet.execution.preload import warm_up
from kantor_fleet.exits import Exit, warn
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.processes.local import FleetConfig, local_fleet, watch_progress
from kantor_fleet.report.progress import ProgressView
from kantor_fleet.report.summary import conclude, exit_code_of, read_result
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.session import BusError
from kantor_worldsim.observers.progress import progress
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.records import Record
from kantor_worldsim.record.run_folder import folder_for
from kantor_worldsim.world.world import WorldSetup

_SHOW_S = 0.2


def run(
    scenario: Scenario, seed: int, exchange: str, speed: float, out: Path, exact_every: int | None
) -> Exit:
    """Run a mission and leave its run folder; the exit code. Raises ScenarioError, BusError, OSError.

    exchange: its name on record. exact_every: periods between exact distances, 0 for the end only.
    """
    setup = WorldSetup.of(scenario, seed)
    warn(setup.warnings)
    folder = folder_for(scenario, seed, out)
    with Interrupts() as interrupts:
        if exchange == "in-process":
            recording = Recording(scenario, seed, exchange, folder, exact_every)
            code = _run_in_process(scenario, seed, setup, recording, interrupts)
        else:
            config = FleetConfig(scenario, seed, exchange, speed, folder, exact_every)
            code = _run_processes(config, interrupts)
        conclude(folder)
        return interrupts.code or code


def _run_in_process(
    scenario: Scenario, seed: int, setup: WorldSetup, recording: Recording, interrupts: Interrupts
) -> Exit:
    with ProgressView(scenario.name) as view:
        warm_up()
        shown_s = time.monotonic()

        def show(_record: Record) -> None:
            nonlocal shown_s
            if time.monotonic() - shown_s >= _SHOW_S:
                shown_s = time.monotonic()
                view.show(progress(recording.metrics, scenario, "running", ""))

        reason = play(scenario, seed, setup, [recording.observe, show], stopped=interrupts)
        view.show(progress(recording.metrics, scenario, "over", reason))
    return exit_code_of(recording.finish())


def _run_processes(config: FleetConfig, interrupts: Interrupts) -> Exit:
    with ProgressView(config.scenario.name) as view:
        view.note("starting the fleet (the first time, kernels are compiled: about half a minute)")
        await_fork_server()
        if interrupts():
            return Exit.INTERRUPTED
        with local_fleet(config) as fleet:
            stopping = False
            try:
                for message in watch_progress(fleet):
                    if message is not None:
                        view.show(message)
                    for name, failure in fleet.newly_failed():
                        view.note(f"{name} ended with {_cause(failure)}; the others go on")
                    if (ended := fleet.restart_killed()) is not None:
                        view.note(f"world-sim ended with {ended}; it goes on from its record")
                    waiting = message is not None and message.phase == "waiting"
                    if not stopping and (interrupts() or (waiting and fleet.deserted)):
                        stopping = True
                        view.note("ending the mission")
                        fleet.stop()
            except BusError:
                view.note(f"world-sim is not there; see {config.folder / 'logs' / 'worldsim.log'}")
            fleet.end()
            code = fleet.world_sim.exitcode
            failed = fleet.any_failed
    result = read_result(config.folder)
    if code or result is None:
        return Exit(code) if code in set(Exit) else Exit.PROCESS_FAILED
    return Exit.PROCESS_FAILED if failed else exit_code_of(result)


def _cause(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
