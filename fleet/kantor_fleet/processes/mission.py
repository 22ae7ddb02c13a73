"""`kantor run`: a mission from its start to its picture."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.util import get_temp_dir
from pathlib import Path
from typing import NamedTuple

from kantor_fleet.execution.fork_server import await_fork_server
from kantor_fleet.execution.in_process_team import play
from kantor_fleet.execution.leftovers import Leftovers
from kantor_fleet.execution.preload import kinds_of, warm_up
from kantor_fleet.exits import Exit, warn
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.processes.local import Fleet, FleetConfig, local_fleet, watch_progress
from kantor_fleet.report.progress import ProgressView
from kantor_fleet.report.summary import conclude, exit_code_of, read_result
from kantor_protocol.compilation.kernel_store import is_complete
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.session import BusError
from kantor_worldsim.observers.progress import progress
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.records import Record
from kantor_worldsim.record.run_folder import FolderLock, folder_for, is_empty, remove_if_empty
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
    terms = _Terms(scenario, seed, exchange, speed, out, exact_every)
    with Interrupts() as interrupts:
        if exchange == "in-process":
            return _run_in_process(terms, setup, interrupts)
        return _run_processes(terms, interrupts)


class _Terms(NamedTuple):
    """A mission, and where its folder is made."""

    scenario: Scenario
    seed: int
    exchange: str
    speed: float
    out: Path
    exact_every: int | None


@contextmanager
def _run_folder(
    terms: _Terms,
    interrupts: Interrupts,
    announce: Callable[[Path], None] = lambda _folder: None,
) -> Iterator[tuple[Path, FolderLock]]:
    """A new run folder, which is removed if nothing has happened in its run when a signal or an error ends it."""
    folder = folder_for(terms.scenario, terms.seed, terms.out, announce)
    with FolderLock(folder) as lock:
        try:
            yield folder, lock
        except BaseException:
            remove_if_empty(folder)
            raise
        if interrupts():
            remove_if_empty(folder)


def _run_in_process(terms: _Terms, setup: WorldSetup, interrupts: Interrupts) -> Exit:
    kinds = kinds_of(terms.scenario)
    if not all(map(is_complete, kinds)):  # else each kernel is loaded when it is called
        with interrupts.at_once():
            warm_up(kinds)
    with _run_folder(terms, interrupts) as (folder, _):
        code = _play(terms, setup, interrupts, folder)
        conclude(folder)
    return interrupts.code or code


def _play(terms: _Terms, setup: WorldSetup, interrupts: Interrupts, folder: Path) -> Exit:
    """Play and record a mission. What its observers hold, such as maps, is gone afterwards."""
    scenario, seed = terms.scenario, terms.seed
    with ProgressView(scenario.name) as view:
        recording = Recording(scenario, seed, terms.exchange, folder, terms.exact_every)
        shown_s = time.monotonic()

        def show(_record: Record) -> None:
            nonlocal shown_s
            if time.monotonic() - shown_s >= _SHOW_S:
                shown_s = time.monotonic()
                view.show(progress(recording.metrics, scenario, "running", ""))

        reason = play(scenario, seed, setup, [recording.observe, show], stopped=interrupts)
        view.show(progress(recording.metrics, scenario, "over", reason))
    return exit_code_of(recording.finish())


def _run_processes(terms: _Terms, interrupts: Interrupts) -> Exit:
    with ExitStack() as stack:
        leftovers = stack.enter_context(Leftovers(Path(get_temp_dir())))
        view = stack.enter_context(ProgressView(terms.scenario.name))
        view.note("starting the fleet (the first time, kernels are compiled: about half a minute)")
        with interrupts.at_once():
            await_fork_server(kinds_of(terms.scenario))
        folder, lock = stack.enter_context(_run_folder(terms, interrupts, leftovers.add_run))
        scenario, seed, exchange, speed, _, exact_every = terms
        config = FleetConfig(scenario, seed, exchange, speed, folder, exact_every)
        with local_fleet(config, lock) as fleet:
            _watch(fleet, view, interrupts)
            fleet.end()
            code = _code_of(fleet, folder)
        view.close()
        if not is_empty(folder):
            conclude(folder)
    return interrupts.code or code


def _watch(fleet: Fleet, view: ProgressView, interrupts: Interrupts) -> None:
    """Show how the mission goes and see to it that it ends."""
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
            if stopping:
                fleet.stop()  # again and again: world-sim may just have been started
    except BusError:
        view.note(f"world-sim is not there; see {fleet.world_sim_log}")


def _code_of(fleet: Fleet, folder: Path) -> Exit:
    """The exit code of a fleet that has ended."""
    code, result = fleet.world_sim.exitcode, read_result(folder)
    if code == Exit.UNREACHABLE:
        return Exit.UNREACHABLE
    if code or result is None:
        cause = _cause(code or 0)
        print(f"kantor: world-sim ended with {cause}; see {fleet.world_sim_log}", file=sys.stderr)
        return Exit.PROCESS_FAILED
    return Exit.PROCESS_FAILED if fleet.any_failed else exit_code_of(result)


def _cause(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
