"""A fleet on this machine: world-sim and every participant as a process of its own.

All children come from one fork server that has imported and compiled everything and opened nothing.
"""

import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import NamedTuple

from kantor_fleet.exits import Exit
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.log import log_to
from kantor_protocol import bus, credentials, keys
from kantor_protocol.machine import SUPERVISOR, ParticipantId
from kantor_protocol.messages import Progress, RefusedError, decode_progress
from kantor_protocol.scenario import Scenario

FLEET = "kantor"
_START_S = 60.0
_GOODBYE_S = 5.0
# One worker serves all of Zenoh in a participant: fewer threads, fewer wake-ups.
_LIGHT_RUNTIME = (
    "(app: (worker_threads: 1), acc: (handover: app), tx: (handover: app), "
    "rx: (handover: app), net: (handover: app))"
)


class Order(NamedTuple):
    """What a local fleet is to run."""

    scenario: Scenario
    seed: int
    exchange: str
    speed: float
    folder: Path
    exact_every: int | None = None


class Fleet:
    """The processes of a local fleet."""

    def __init__(self, order: Order, connect: str, secrets: Path) -> None:
        """Use `local_fleet` to start one."""
        self.connect = connect
        self.observer = credentials.find(secrets, credentials.OBSERVER)
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["kantor_fleet.preloaded"])
        logs = order.folder / "logs"
        logs.mkdir()
        self.world_sim = self._start(
            "worldsim", _be_world_sim, order, connect, secrets, logs / "worldsim.log"
        )
        self.participants: dict[ParticipantId, ForkServerProcess] = {
            name: self._start(name, _be_participant, connect, secrets, name, logs / f"{name}.log")
            for name in order.scenario.roster
        }
        self._mourned: set[ParticipantId] = set()

    def _start(self, name: str, target: object, *arguments: object) -> ForkServerProcess:
        process = self._context.Process(target=target, args=arguments, name=f"kantor-{name}")  # type: ignore[arg-type]
        process.start()
        return process

    def newly_failed(self) -> list[tuple[ParticipantId, int]]:
        """Participants that have ended badly since the last call, with their exit codes."""
        failed = [
            (name, process.exitcode)
            for name, process in self.participants.items()
            if process.exitcode and name not in self._mourned
        ]
        self._mourned |= {name for name, _ in failed}
        return failed

    @property
    def any_failed(self) -> bool:
        """Whether a participant has ended badly."""
        return any(process.exitcode for process in self.participants.values())

    def stop(self) -> None:
        """Ask world-sim to end the mission and close the record."""
        pid = self.world_sim.pid
        if pid is not None and self.world_sim.exitcode is None:
            os.kill(pid, signal.SIGINT)

    def disband(self) -> None:
        """Wait for everybody to go, and make them."""
        processes = [self.world_sim, *self.participants.values()]
        for act in (None, "terminate", "kill"):
            for process in processes:
                if act is not None and process.exitcode is None:
                    getattr(process, act)()
            give_up = time.monotonic() + _GOODBYE_S
            for process in processes:
                process.join(max(0.0, give_up - time.monotonic()))


@contextmanager
def local_fleet(order: Order) -> Iterator[Fleet]:
    """Start a fleet; on leaving, no process of it is left."""
    with tempfile.TemporaryDirectory(prefix="kantor-") as folder:
        secrets = Path(folder)
        credentials.issue(secrets, FLEET, order.scenario.roster)
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        fleet = Fleet(order, bus.free_endpoint(), secrets)
        try:
            yield fleet
        finally:
            fleet.stop()
            fleet.disband()


def watch_progress(fleet: Fleet) -> Iterator[Progress | None]:
    """What world-sim tells, as long as it runs; None when there was nothing for a while.

    Raises BusError if world-sim does not come up.
    """
    key = keys.progress(FLEET)
    with bus.watch(fleet.connect, fleet.observer, key, _START_S) as watch:
        while fleet.world_sim.exitcode is None:
            message = watch.next(0.1)
            try:
                yield decode_progress(message[1]) if message is not None else None
            except RefusedError:
                yield None


def _be_world_sim(order: Order, listen: str, secrets: Path, log: Path) -> None:
    from kantor_worldsim.process import Plan, run  # noqa: PLC0415  the fork server has it
    from kantor_worldsim.recording import Recording  # noqa: PLC0415
    from kantor_worldsim.world import Site  # noqa: PLC0415

    say = log_to(log, "worldsim")
    bus.init_log()
    scenario, seed = order.scenario, order.seed
    plan = Plan(scenario, seed, Site.of(scenario, seed), order.exchange, order.speed)
    identity = credentials.find(secrets, credentials.HOST)
    users = credentials.users_file(secrets)
    # The terminal and the parent may both say so: one Ctrl-C must not count as two.
    with Interrupts(patient=True) as interrupts:
        try:
            with bus.Host(identity, listen, users, scenario.roster) as host:
                recording = Recording(
                    scenario, seed, order.exchange, order.folder, order.exact_every
                )
                result = run(host, plan, recording, interrupts)
        except bus.BusError as error:
            say(str(error))
            sys.exit(Exit.UNREACHABLE)
    say(f"{result.ended}, digest {result.digest}")


def _be_participant(connect: str, secrets: Path, name: ParticipantId, log: Path) -> None:
    from kantor_agent.process import run as run_agent  # noqa: PLC0415  the fork server has it
    from kantor_supervisor.process import run as run_supervisor  # noqa: PLC0415

    # The terminal's Ctrl-C reaches everybody; a participant goes when world-sim says so.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ.setdefault("ZENOH_RUNTIME", _LIGHT_RUNTIME)
    say = log_to(log, name)
    bus.init_log()
    run = run_supervisor if name == SUPERVISOR else run_agent
    try:
        say(run(connect, credentials.find(secrets, name), _START_S, say))
    except bus.BusError as error:
        say(str(error))
        sys.exit(Exit.UNREACHABLE)
