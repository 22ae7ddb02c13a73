"""A fleet on this machine: world-sim and every participant as a process of its own.

All children come from one fork server that has imported and compiled everything and opened nothing, and none of them
outlives this process. Their passwords are in memory only. This process also carries out world-sim's commands for a
scenario's faults of processes: it kills, stops and starts participants and world-sim itself, and restarts world-sim
from its journal after any kill.
"""

import contextlib
import os
import resource
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import NamedTuple

from kantor_fleet.execution.fork_server import StartError, pipe, start_process
from kantor_fleet.exits import Exit
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.processes.log import log_to
from kantor_fleet.processes.start_slots import take_slot
from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM, ParticipantId
from kantor_protocol.node import wal
from kantor_protocol.node.runner import RejectedError, StateError
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport import credentials
from kantor_protocol.transport.client import ObserverSession, observer_session
from kantor_protocol.transport.credentials import Identity, Password, public_key
from kantor_protocol.transport.endpoint import free_endpoint
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.transport.session import LEASE_MS, LOCKSTEP_LEASE_MS, BusError, be_light
from kantor_protocol.transport.zenoh_log import init_log
from kantor_protocol.wire import keys
from kantor_protocol.wire.messages import Progress, RefusedError, decode_progress
from kantor_worldsim.exchange.config import MissionConfig, late_participants
from kantor_worldsim.exchange.process_control import CommandKind, ProcessCommand, ProcessController
from kantor_worldsim.record.run_folder import RESULT, FolderLock

FLEET = "kantor"
_START_S = 60.0
_END_S = 5.0
_ORDER_S = 0.5
_CONNECT_S = 3.0
"""A world-sim that has ended meanwhile is noticed after so long."""
_LISTEN_S = 5.0
"""Longest wait for the endpoint of a world-sim that was killed to become free."""
_IMPOSTOR_S = 15.0
"""An impostor that still runs after so long was admitted."""
_RESTARTS_MAX = 20
"""Restarts of world-sim, at most, when it was killed and no fault is the cause."""
_SPARE_BYTES = 7
"""Bytes that a full disk still takes: less than an entry of a write-ahead log."""
STATE = "state"
"""Folder of the write-ahead logs in a run folder."""


class FleetConfig(NamedTuple):
    """The mission of a local fleet."""

    scenario: Scenario
    seed: int
    exchange: str
    speed: float
    folder: Path
    exact_every: int | None = None


class Fleet:
    """The processes of a local fleet."""

    def __init__(
        self,
        config: FleetConfig,
        connect: str,
        identities: Mapping[str, Password],
        lock: FolderLock | None = None,
    ) -> None:
        """Use `local_fleet` to start one. lock: of the run folder."""
        self.connect = connect
        self.observer: Identity = identities[credentials.OBSERVER]
        self._config = config
        self._identities = dict(identities)
        self._folder_lock = lock
        self._logs, self._state = config.folder / "logs", config.folder / STATE
        self._lock = threading.RLock()
        """Guards every start and every check of an exit code, which can be read only once."""
        self._stopping = threading.Event()
        self._restarts = 0
        self._down = False
        """World-sim is down, and will be restarted by a fault's schedule."""
        self._reported: set[ParticipantId] = set()
        self._excused: set[ParticipantId] = set()
        """Participants that were killed or stopped by command: their end is no failure."""
        self._frozen: set[ParticipantId] = set()
        self._impostors: dict[ParticipantId, tuple[ForkServerProcess, float]] = {}
        self.world_sim: ForkServerProcess
        self.participants: dict[ParticipantId, ForkServerProcess] = {}

    @property
    def world_sim_log(self) -> Path:
        """What world-sim has to say."""
        return self._logs / "worldsim.log"

    def start(self) -> None:
        """Start world-sim and all participants that are there from the start. Raises StartError."""
        self._logs.mkdir()
        self.world_sim = self._start_world_sim(resume=False)
        absent = set(late_participants(self._config.scenario))
        for name in self._config.scenario.roster:
            if name not in absent:
                self.participants[name] = self._start_participant(name, name, waits=True)

    def _start_world_sim(self, *, resume: bool) -> ForkServerProcess:
        ours, theirs = pipe(WORLD_SIM)
        with self._lock, theirs:
            process = start_process(
                WORLD_SIM,
                _be_world_sim,
                self._config,
                self.connect,
                self._identities,
                self.world_sim_log,
                theirs,
                resume,
                self._stopping.is_set(),
                self._folder_lock,
            )
        threading.Thread(target=self._serve, args=(ours, process), daemon=True).start()
        return process

    def _start_participant(
        self, name: ParticipantId, log: str, *, waits: bool = False
    ) -> ForkServerProcess:
        """Start a participant's process. waits: with the others of its fleet for a slot."""
        with self._lock:
            return start_process(
                log,
                _be_participant,
                self.connect,
                self._identities[name],
                self._logs / f"{log}.log",
                self._state,
                self._state if waits else None,
                LOCKSTEP_LEASE_MS if self._config.exchange == "lockstep" else LEASE_MS,
            )

    def newly_failed(self) -> list[tuple[ParticipantId, int]]:
        """Participants that have failed without a command since the last call, with their exit codes."""
        with self._lock:
            failed = [(name, code) for name, code in self._failed() if name not in self._reported]
        self._reported |= {name for name, _ in failed}
        return failed

    @property
    def any_failed(self) -> bool:
        """Whether a participant has failed without a command."""
        with self._lock:
            return any(self._failed())

    def _failed(self) -> Iterator[tuple[ParticipantId, int]]:
        for name, process in self.participants.items():
            if process.exitcode and name not in self._excused:
                yield name, process.exitcode

    def restart_killed(self) -> str | None:
        """Restart world-sim if it was killed and no fault is the cause; the signal."""
        with self._lock:
            code = self.world_sim.exitcode
            dead = code is not None and code < 0 and not self._down
            if not dead or self._stopping.is_set() or self._restarts == _RESTARTS_MAX:
                return None
            self._restarts += 1
            self.world_sim = self._start_world_sim(resume=True)
            return f"signal {-(code or 0)}"

    @property
    def runs(self) -> bool:
        """Whether world-sim runs, or will be restarted."""
        with self._lock:
            return self._down or self.world_sim.exitcode is None

    @property
    def deserted(self) -> bool:
        """Whether all participants' processes have ended."""
        with self._lock:
            return all(process.exitcode is not None for process in self.participants.values())

    def stop(self) -> None:
        """Ask world-sim to end the mission and close the record."""
        self._stopping.set()
        self._order_stop()

    def _order_stop(self) -> None:
        with self._lock:
            if not self._down and self.world_sim.exitcode is None:
                os.kill(self.world_sim.pid or 0, signal.SIGCONT)
                os.kill(self.world_sim.pid or 0, signal.SIGINT)

    def _processes(self) -> list[ForkServerProcess]:
        """All that have been started and not replaced."""
        impostors = (process for process, _ in self._impostors.values())
        started = [*self.participants.values(), *impostors]
        return [self.world_sim, *started] if hasattr(self, "world_sim") else started

    def kill(self) -> None:
        """End all processes at once, and give their descriptors back."""
        self._stopping.set()
        with self._lock:
            for process in self._processes():
                process.kill()
                process.join()
                process.close()

    def end(self) -> None:
        """Wait for all processes to end, then kill those that are left."""
        with self._lock:
            for name in self._frozen:
                self.participants[name].kill()
            processes = self._processes()
            give_up = time.monotonic() + _END_S
            while self._stopping.is_set() and self.world_sim.exitcode is None:
                self._order_stop()  # again: it may just have been started
                self.world_sim.join(_ORDER_S)
                if time.monotonic() >= give_up:
                    break
            for process in processes:
                process.join(max(0.0, give_up - time.monotonic()))
            for process in processes:
                if process.exitcode is None:
                    process.kill()
                    process.join()
        if (self._config.folder / RESULT).exists():
            shutil.rmtree(self._state, ignore_errors=True)

    # Commands of world-sim.

    def _serve(self, pipe: Connection, process: ForkServerProcess) -> None:
        """Carry out the commands of a world-sim process, as long as it lives."""
        with contextlib.suppress(EOFError, OSError, StartError), pipe:
            while True:
                command: ProcessCommand = pipe.recv()
                if command.kind is CommandKind.RESTART_WORLD_SIM:
                    self._restart(process, command.after_s)
                    return
                if command.kind is CommandKind.REST_WORLD_SIM:
                    self._rest(process, command.after_s)
                    pipe.send(None)
                else:
                    pipe.send(self._carry_out(command))

    def _restart(self, process: ForkServerProcess, after_s: float) -> None:
        with self._lock:
            self._down = True
            process.kill()
            process.join()
        self._stopping.wait(after_s)
        with self._lock:
            self._down = False
            self.world_sim = self._start_world_sim(resume=True)

    def _rest(self, process: ForkServerProcess, after_s: float) -> None:
        os.kill(process.pid or 0, signal.SIGSTOP)
        self._stopping.wait(after_s)
        os.kill(process.pid or 0, signal.SIGCONT)

    def _carry_out(self, command: ProcessCommand) -> bool | None:
        """Carry out a command to a participant's process; the answer."""
        name = command.who
        with self._lock:
            match command.kind:
                case CommandKind.IS_IMPOSTOR_REFUSED:
                    return self._impostor_refused(name)
                case CommandKind.START_IMPOSTOR:
                    impostor = self._start_participant(name, f"{name}-impostor")
                    self._impostors[name] = impostor, time.monotonic()
                case CommandKind.KILL:
                    self._kill(name)
                case CommandKind.START:
                    self._kill(name)
                    self._damage_log(command)
                    self.participants[name] = self._start_participant(name, name)
                    self._excused.discard(name)
                case _:
                    process = self.participants.get(name)
                    if process is not None and process.exitcode is None:
                        self._act_on(process.pid or 0, command)
        return None

    def _kill(self, name: ParticipantId) -> None:
        process = self.participants.get(name)
        self._excused.add(name)
        self._frozen.discard(name)
        if process is not None:
            process.kill()
            process.join()

    def _damage_log(self, command: ProcessCommand) -> None:
        """Leave of a participant's write-ahead log what the fault leaves."""
        path = self._log_of(command.who)
        with contextlib.suppress(FileNotFoundError):
            if command.disk == "lost":
                path.unlink()
            elif command.disk == "torn":
                wal.tear(path, command.step)

    def _act_on(self, pid: int, command: ProcessCommand) -> None:
        """Carry out a command to a process that lives."""
        match command.kind:
            case CommandKind.FREEZE:
                os.kill(pid, signal.SIGSTOP)
                self._frozen.add(command.who)
            case CommandKind.THAW:
                os.kill(pid, signal.SIGCONT)
                self._frozen.discard(command.who)
            case CommandKind.FILL_DISK | CommandKind.FREE_DISK:
                _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
                path = self._log_of(command.who)
                size = path.stat().st_size if path.exists() else 0
                free = command.kind is CommandKind.FREE_DISK
                room = hard if free else size + _SPARE_BYTES
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (room, hard))

    def _log_of(self, name: ParticipantId) -> Path:
        return self._state / f"{name}.diary"

    def _impostor_refused(self, name: ParticipantId) -> bool | None:
        impostor, since_s = self._impostors[name]
        if impostor.exitcode is not None:
            return impostor.exitcode == Exit.USAGE
        if time.monotonic() - since_s < _IMPOSTOR_S:
            return None
        impostor.kill()
        return False


@contextmanager
def local_fleet(config: FleetConfig, lock: FolderLock | None = None) -> Iterator[Fleet]:
    """Start a fleet; on leaving, no process of it is left. lock: of the run folder. Raises StartError."""
    identities = credentials.draw(FLEET, config.scenario.roster)
    fleet = Fleet(config, free_endpoint(), identities, lock)
    try:
        fleet.start()
    except BaseException:
        fleet.kill()
        raise
    try:
        try:
            yield fleet
        finally:
            fleet.stop()
            fleet.end()
    except KeyboardInterrupt:
        fleet.kill()
        raise


def watch_progress(fleet: Fleet) -> Iterator[Progress | None]:
    """Progress as world-sim reports it, as long as it runs; None when there was none for a while.

    Raises BusError if world-sim does not come up.
    """
    with ExitStack() as stack:
        watch, give_up = None, time.monotonic() + _START_S
        while fleet.runs:
            if watch is None:
                watch = _observer(fleet, stack, give_up)
            message = watch.next(0.1) if watch is not None else None
            try:
                yield decode_progress(message[1]) if message is not None else None
            except RefusedError:
                yield None


def _observer(fleet: Fleet, stack: ExitStack, give_up_s: float) -> ObserverSession | None:
    """An observer of world-sim's progress; None if it is not up yet. Raises BusError if that is too late."""
    key = keys.progress(FLEET)
    try:
        return stack.enter_context(observer_session(fleet.connect, fleet.observer, key, _CONNECT_S))
    except BusError:
        if time.monotonic() >= give_up_s:
            raise
        return None


def _be_world_sim(
    config: FleetConfig,
    listen: str,
    identities: Mapping[str, Password],
    log: Path,
    pipe: Connection,
    resume: bool,  # noqa: FBT001  a target of a process
    stopping: bool,  # noqa: FBT001
    _lock: FolderLock | None = None,  # held as long as this process lives
) -> None:
    from kantor_worldsim.engine.simulation import ForeignRecordError  # noqa: PLC0415  the fork server has it
    from kantor_worldsim.exchange.main import run  # noqa: PLC0415
    from kantor_worldsim.observers.recording import Recording  # noqa: PLC0415
    from kantor_worldsim.record.run_folder import OverError, Past, ResumeError  # noqa: PLC0415
    from kantor_worldsim.world.world import WorldSetup  # noqa: PLC0415

    say = log_to(log, "worldsim")
    init_log()
    scenario, seed = config.scenario, config.seed
    past = None
    if resume:
        try:
            past = Past.of(config.folder)
        except OverError as error:  # it was killed on its way out
            say(str(error))
            return
        except ResumeError:  # nothing has happened yet
            past = None
    setup = WorldSetup.of(scenario, seed) if past is None else past.opening.setup
    keys = {name: public_key(identities[name]) for name in scenario.roster}
    mission = MissionConfig(
        scenario, seed, setup, config.exchange, config.speed, keys=keys if scenario.signed else {}
    )
    # The terminal and the parent may both send the signal: one Ctrl-C must not count as two.
    with Interrupts(patient=True) as interrupts:
        if stopping:
            interrupts.code = Exit.INTERRUPTED
        try:
            with _host(identities, listen, scenario) as host:
                recording = Recording(
                    scenario,
                    seed,
                    config.exchange,
                    config.folder,
                    config.exact_every,
                    speed=config.speed,
                    past=past,
                )
                say(f"run {recording.run}" + (", resumed" if past is not None else ""))
                result = run(
                    host,
                    mission,
                    recording,
                    interrupts,
                    past=past,
                    controller=_controller(pipe),
                    say=say,
                )
        except BusError as error:
            say(str(error))
            sys.exit(Exit.UNREACHABLE)
        except ForeignRecordError as error:
            say(f"cannot go on with its record: {error}")
            sys.exit(Exit.USAGE)
    say(f"{result.ended}, digest {result.digest}")


def _host(identities: Mapping[str, Password], listen: str, scenario: Scenario) -> HubRouter:
    """The router, once its endpoint is free. Raises BusError."""
    identity = identities[credentials.HOST]
    give_up = time.monotonic() + _LISTEN_S
    with credentials.users_in_memory(identities) as users:
        while True:
            try:
                return HubRouter(identity, listen, users, scenario.roster)
            except BusError:
                if time.monotonic() >= give_up:
                    raise
                time.sleep(0.02)


def _controller(pipe: Connection) -> ProcessController:
    """World-sim's end of the pipe that carries commands."""

    def carry_out(command: ProcessCommand) -> bool | None:
        pipe.send(command)
        answer: bool | None = pipe.recv()
        return answer

    return carry_out


def _be_participant(
    connect: str, identity: Identity, log: Path, state: Path, slots: Path | None, lease_ms: int
) -> None:
    from kantor_agent.process import run as run_agent  # noqa: PLC0415  the fork server has it
    from kantor_supervisor.process import run as run_supervisor  # noqa: PLC0415

    be_light()
    write = log_to(log, identity.user)
    give_back = take_slot(slots) if slots else lambda: None

    def say(line: str) -> None:
        give_back()  # it is on the bus, or never will be
        write(line)

    init_log()
    run = run_supervisor if identity.user == SUPERVISOR else run_agent
    try:
        say(run(connect, identity, _START_S, say, state, lease_ms))
    except BusError as error:
        say(str(error))
        sys.exit(Exit.UNREACHABLE)
    except (RejectedError, StateError) as error:
        say(str(error))
        sys.exit(Exit.USAGE)
