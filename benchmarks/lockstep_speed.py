"""Ticks a second in lockstep with a process for every robot, beside a bare Zenoh barrier.

The barrier is the least that any lockstep over Zenoh must do, in the same topology: a router that puts
64 bytes to each client and goes on when each has answered with 64 bytes; no access control, no codec,
no robots. Clients start from the same fork server with the same light runtime, and as in kantor a
callback only enqueues. Both are measured for the same number of seconds, one after the other.
"""

import json
import queue
import statistics
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import zenoh
from tables import Table

from kantor_fleet.execution.fork_server import await_fork_server
from kantor_fleet.processes.local import FleetConfig, local_fleet, watch_progress
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.endpoint import free_endpoint
from kantor_protocol.transport.session import be_light

COUNTS = (5, 20, 100)
COUNTS_QUICK = (5, 20)
PAYLOAD = bytes(64)
BLOCK = zenoh.CongestionControl.BLOCK
START_S = 90.0
"""Time within which all processes must have joined."""
MISSION_S = 120.0
"""Time after which a mission that has not ended is an error."""


class Pace(NamedTuple):
    """The speed of a mission or of the barrier."""

    rounds_per_s: float
    rounds: int


def measure(*, quick: bool) -> Table:
    """Ticks and rounds a second; the median of the repetitions, taken in turn."""
    await_fork_server()
    seconds, repeats = (3.0, 1) if quick else (6.0, 3)
    rows = []
    for count in COUNTS_QUICK if quick else COUNTS:
        bare, ours = [], []
        for _ in range(repeats):
            bare.append(_barrier(count, seconds))
            ours.append(_mission(count, seconds))
        barrier = statistics.median(pace.rounds_per_s for pace in bare)
        ticks = statistics.median(pace.rounds_per_s for pace in ours)
        ratio = statistics.median(
            one.rounds_per_s / other.rounds_per_s for one, other in zip(ours, bare, strict=True)
        )
        rows.append(
            (
                f"{count}",
                f"{ticks:,.0f}",
                f"{barrier:,.0f}",
                f"{ratio:.2f}",
                f"{ticks * count:,.0f}",
                f"{1e6 / (ticks * count):.0f}",
                f"{min(pace.rounds for pace in ours)}",
            )
        )
    return Table(
        "lockstep: a process for every robot, wall time",
        (
            "robots",
            "ticks/s",
            "bare barrier, rounds/s",
            "ratio",
            "robot-steps/s",
            "us/robot-step",
            "ticks measured",
        ),
        rows,
        (
            "kantor with access control, record on disk, metrics and checker; robots hear those in range",
        ),
    )


def _scenario(count: int) -> Scenario:
    """The default world with so many robots, too much to do for the time that is measured."""
    overrides = (
        f"robots.count={count}",
        "starts.random=true",
        "samples.count=20000",
        "energy.points=50000",
        "energy.steps=50000",
        "metrics.every=10",
        "limit_s=100000",
    )
    return find("fleet", overrides)


def _mission(count: int, seconds: float) -> Pace:
    """Ticks a second of a mission under way, from its progress messages."""
    scenario = _scenario(count)
    marks: list[tuple[float, int]] = []
    with tempfile.TemporaryDirectory(prefix="kantor-speed-") as folder:
        config = FleetConfig(scenario, 0, "lockstep", 1.0, Path(folder))
        with local_fleet(config) as fleet:
            give_up = time.monotonic() + MISSION_S
            for progress in watch_progress(fleet):
                now = time.monotonic()
                if progress is not None and progress.phase == "running" and progress.now_ns > 0:
                    marks.append((now, progress.now_ns))
                if now > give_up or (marks and now - marks[0][0] >= seconds):
                    break
    if len(marks) < 2:
        raise RuntimeError(f"{count} robots: the mission was not under way within {MISSION_S} s")
    (start, start_ns), (end, end_ns) = marks[0], marks[-1]
    ticks = (end_ns - start_ns) // scenario.period_ns
    return Pace(ticks / (end - start), ticks)


def _barrier(count: int, seconds: float) -> Pace:
    """Rounds a second of the bare barrier."""
    endpoint = free_endpoint()
    context = get_context("forkserver")
    receive, send = context.Pipe(duplex=False)
    hub = context.Process(target=_be_hub, args=(endpoint, count, seconds, send))
    clients = [context.Process(target=_be_client, args=(endpoint, i)) for i in range(count)]
    with running([hub, *clients]):
        if not receive.poll(START_S + 2.0 * seconds):
            raise RuntimeError(f"{count} clients: the barrier did not end")
        return Pace(*json.loads(receive.recv_bytes()))


@contextmanager
def running(processes: Sequence[BaseProcess]) -> Iterator[None]:
    """Start processes; on leaving, none of them is left."""
    try:
        for process in processes:
            process.start()
        yield
    finally:
        for process in processes:
            if process.pid is not None:
                process.kill()
                process.join()


def _be_hub(endpoint: str, count: int, seconds: float, send: Connection) -> None:
    answers: queue.SimpleQueue[str] = queue.SimpleQueue()

    def on_answer(sample: zenoh.Sample) -> None:
        answers.put(str(sample.key_expr))

    session = zenoh.open(_config("router", endpoint))
    _subscriber = session.declare_subscriber("bench/*/*", on_answer)
    here: set[str] = set()
    while len(here) < count:
        here.add(answers.get(timeout=START_S))
    rounds, start = 0, time.monotonic()
    while time.monotonic() - start < seconds:
        for i in range(count):
            session.put(f"bench/{i}/rx/turn", PAYLOAD, congestion_control=BLOCK, express=True)
        missing = count
        while missing:
            missing -= answers.get(timeout=START_S).endswith("/tx")
        rounds += 1
    elapsed_s = time.monotonic() - start
    send.send_bytes(json.dumps((rounds / elapsed_s, rounds)).encode())
    time.sleep(START_S)  # until it is ended: clients log errors when a router closes


def _be_client(endpoint: str, number: int) -> None:
    be_light()
    turns: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def on_turn(sample: zenoh.Sample) -> None:
        turns.put(sample.payload.to_bytes())

    session = _patient_open(_config("client", endpoint))
    _subscriber = session.declare_subscriber(f"bench/{number}/rx/turn", on_turn)
    # Repeated, since the hub may subscribe a moment after clients can connect.
    while turns.empty():
        session.put(f"bench/{number}/here", PAYLOAD)
        time.sleep(0.1)
    while True:
        turns.get(timeout=START_S)
        session.put(f"bench/{number}/tx", PAYLOAD, congestion_control=BLOCK, express=True)


def _patient_open(config: zenoh.Config) -> zenoh.Session:
    """A client's session as soon as the router is there."""
    give_up = time.monotonic() + START_S
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            if time.monotonic() >= give_up:
                raise
        time.sleep(0.1)


def _config(mode: str, endpoint: str) -> zenoh.Config:
    """The settings of kantor's bus that concern speed."""
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "listen/endpoints": [endpoint] if mode == "router" else [],
        "connect/endpoints": [endpoint] if mode == "client" else [],
    }
    if mode == "router":
        settings |= {
            "scouting/delay": 0,
            "open/return_conditions": {"connect_scouted": False, "declares": False},
        }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config
