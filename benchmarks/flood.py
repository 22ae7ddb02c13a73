"""Cost of a robot that floods the bus for the other robots, with and without the flood in one mission.

    python benchmarks/flood.py [--quick] [--beside]

A realtime mission with five robots on the real bus. Four are honest; the fifth has joined with its own
credentials and is hostile. Windows with and without its flood alternate, so that both see the same machine. A
*tick* is the time from a robot's first report of a step until it has received world-sim's acceptance of it.

A robot would be another machine: its own use of a core is not what is measured. The flooder therefore has a core
to itself and all other processes share the rest; `--beside` lets it compete for all of them. Exits with 1 if a
flood at least doubles the p99 of ticks, or memory grows.
"""

import argparse
import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zenoh
from lockstep_speed import running
from tables import Table, show, verdict

from kantor_protocol.base.machine import Outputs, Pose
from kantor_protocol.transport import client, credentials
from kantor_protocol.transport.client import ParticipantSession, participant_session
from kantor_protocol.transport.endpoint import await_endpoint, free_endpoint
from kantor_protocol.transport.zenoh_log import init_log
from kantor_protocol.wire import keys
from kantor_protocol.wire.messages import (
    VERSION,
    Mission,
    Ready,
    Report,
    StepRequest,
    Stop,
    ToParticipant,
    decode_to_participant,
    encode,
)

HONEST, FLOODER = ("r1", "r2", "r3", "r4"), "r5"
FLEET = "kantor"
SPEED = 4.0
"""Simulated seconds in a real one: a step every 25 ms."""
WINDOW_S = 2.0
SETTLE_S = 0.25
"""At the beginning of a window, not counted."""
START_S = 60.0
RATIO_MAX = 2.0
GROWTH_MAX_MIB = 32.0
SMALL_PER_S = 10_000
BURST_S = 1e-3
MIB = 1 << 20
SMALL, LARGE = bytes(100), bytes(MIB)


class Flood(NamedTuple):
    """The messages of the flooder."""

    name: str
    on: tuple[str, ...]
    """Kinds of keys."""
    payload: bytes | None
    """Bytes of a message; None: valid reports of a step that was reported long ago."""
    per_s: float
    """Messages a second; inf: as fast as possible."""


FLOODS = (
    Flood("reports, 10,000/s", ("tx",), None, SMALL_PER_S),
    Flood("junk on tx, 10,000/s", ("tx",), SMALL, SMALL_PER_S),
    Flood("1 MiB on tx", ("tx",), LARGE, float("inf")),
    Flood("pose and weights, 10,000/s", ("pose", "weights"), SMALL, SMALL_PER_S),
    Flood("1 MiB on pose and weights", ("pose", "weights"), LARGE, float("inf")),
    Flood("1 MiB on tx, gigabit", ("tx",), LARGE, 119),
    Flood("tokens, 10,000/s", ("alive",), None, SMALL_PER_S),
)


class Window(NamedTuple):
    """A time with or without a flood; seconds of the monotonic clock."""

    from_s: float
    until_s: float
    sent: int
    """Messages of the flood."""


class Use(NamedTuple):
    """Resources that world-sim has used up to a moment."""

    at_s: float
    cpu_s: float
    rss_mib: float


class Timed(ParticipantSession):
    """A robot's session that measures the time of its steps."""

    ticks: list[tuple[float, float]]
    """For each step, the time of its first report and the time until its acceptance, in seconds."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        type(self).ticks = []
        self._step, self._said_s = 0, 0.0

    def send(self, payload: bytes, *, blocking: bool) -> None:
        """Note the time of the first report of a step."""
        message = _FROM.decode(payload)
        if isinstance(message, Report) and message.outputs.step > self._step:
            self._step, self._said_s = message.outputs.step, time.monotonic()
        super().send(payload, blocking=blocking)

    def next(self, timeout_s: float | None) -> bytes | None:
        """Note the time at which its acceptance is received."""
        payload = super().next(timeout_s)
        if payload is not None and self._said_s:
            message: ToParticipant = decode_to_participant(payload)
            if isinstance(message, StepRequest) and message.inputs.observation.step >= self._step:
                self.ticks.append((self._said_s, time.monotonic() - self._said_s))
                self._said_s = 0.0
        return payload


_FROM = msgspec.msgpack.Decoder(Report | Ready)


def measure(*, quick: bool, beside: bool, floods: tuple[Flood, ...] = FLOODS) -> Table:
    """One mission for each flood."""
    rounds = 2 if quick else 5
    rows, met = [], True
    for flood in floods:
        ticks, windows, uses = _mission(flood, rounds, beside=beside)
        calm, rough = (_latencies(ticks, windows[first::2]) for first in (0, 1))
        p99s = [_p99(_latencies(ticks, [window])) for window in windows]
        ratio = float(np.median(np.divide(p99s[1::2], p99s[::2])))
        rss = [_peak(uses, windows[first::2]) for first in (0, 1)]
        fine = ratio < RATIO_MAX and rss[1] - rss[0] < GROWTH_MAX_MIB
        met = met and fine
        rows.append(
            (
                flood.name,
                f"{sum(w.sent for w in windows) / sum(w.until_s - w.from_s for w in windows[1::2]):,.0f}",
                f"{len(calm)}+{len(rough)}",
                f"{1e3 * np.median(calm):.1f}",
                f"{1e3 * np.median(rough):.1f}",
                f"{1e3 * np.median(p99s[::2]):.1f}",
                f"{1e3 * np.median(p99s[1::2]):.1f}",
                f"{ratio:.2f}",
                *(f"{100 * _load(uses, windows[first::2]):.0f}" for first in (0, 1)),
                *(f"{mib:.0f}" for mib in rss),
                verdict(met=fine),
            )
        )
        show(Table(flood.name, tuple("" for _ in rows[-1]), [rows[-1]]))
    return Table(
        f"flood: ticks of four honest robots, the flooder {'beside them' if beside else 'on its own core'}",
        (
            "flood", "sent/s", "ticks", "p50 ms", "flooded", "p99 ms", "flooded", "ratio",
            "cpu %", "flooded", "MiB", "flooded", "",
        ),
        rows,
        (
            "p99: the median over windows, ratio: over pairs of windows that follow each other",
            "cpu, MiB: of world-sim, which is the router",
        ),
        met,
    )  # fmt: skip


def _p99(latencies: list[float]) -> float:
    return float(np.percentile(latencies, 99))


def _latencies(ticks: list[tuple[float, float]], windows: list[Window]) -> list[float]:
    return [
        took_s
        for said_s, took_s in ticks
        if any(w.from_s + SETTLE_S <= said_s < w.until_s for w in windows)
    ]


def _peak(uses: list[Use], windows: list[Window]) -> float:
    return max(u.rss_mib for u in uses if any(w.from_s <= u.at_s < w.until_s for w in windows))


def _load(uses: list[Use], windows: list[Window]) -> float:
    """Cores that world-sim keeps busy."""
    busy_s = total_s = 0.0
    for w in windows:
        inside = [u for u in uses if w.from_s + SETTLE_S <= u.at_s < w.until_s]
        busy_s += inside[-1].cpu_s - inside[0].cpu_s
        total_s += inside[-1].at_s - inside[0].at_s
    return busy_s / total_s


def _mission(
    flood: Flood, rounds: int, *, beside: bool
) -> tuple[list[tuple[float, float]], list[Window], list[Use]]:
    """Ticks of the honest robots, windows (without and with flood in turn), and resources of world-sim."""
    cores = sorted(os.sched_getaffinity(0))
    ours, theirs = (cores, cores) if beside else (cores[:-1] or cores, cores[-1:])
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="kantor-flood-") as name:
        folder = Path(name)
        secrets = folder / "credentials"
        endpoint = free_endpoint()
        world = context.Process(target=_be_world, args=(ours, endpoint, secrets, folder / "runs"))
        pipes = {who: context.Pipe(duplex=False) for who in HONEST}
        robots = [
            context.Process(target=_be_robot, args=(ours, endpoint, secrets, who, folder, pipes[who][1]))
            for who in HONEST
        ]  # fmt: skip
        tap, end = context.Pipe()
        flooder = context.Process(
            target=_be_flooder, args=(theirs, endpoint, secrets, flood, rounds, end)
        )
        with running([world]):
            _await((secrets / f"{FLOODER}.toml").exists)
            await_endpoint(endpoint, START_S)
            with running([*robots, flooder]):
                uses: list[Use] = []
                while not tap.poll(0.05):
                    uses.append(_use(world.pid or 0))
                    if not flooder.is_alive():
                        raise RuntimeError("the flooder has ended")
                windows = tap.recv()
                os.kill(world.pid or 0, signal.SIGINT)
                ticks = [tick for receive, _ in pipes.values() for tick in receive.recv()]
                world.join(START_S)
    return ticks, windows, uses


def _await(done: Callable[[], bool]) -> None:
    give_up = time.monotonic() + START_S
    while not done():
        if time.monotonic() > give_up:
            raise RuntimeError("world-sim did not start")
        time.sleep(0.02)


def _use(pid: int) -> Use:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks, pages = int(fields[11]) + int(fields[12]), int(fields[21])
    page_bytes = os.sysconf("SC_PAGE_SIZE")
    return Use(time.monotonic(), ticks / os.sysconf("SC_CLK_TCK"), pages * page_bytes / MIB)


def _be_world(cores: list[int], listen: str, secrets: Path, out: Path) -> None:
    from kantor_fleet.processes.standalone import host_standalone  # noqa: PLC0415  robots do without it
    from kantor_fleet.scenarios.catalog import find  # noqa: PLC0415

    os.sched_setaffinity(0, cores)
    scenario = find("fleet", ("limit_s=100000", "energy.points=50000", "energy.steps=50000"))
    out.mkdir()
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
    host_standalone(scenario, 0, "wall", SPEED, listen, secrets, FLEET, None, out, None)


def _be_robot(
    cores: list[int], connect: str, secrets: Path, who: str, folder: Path, out: Connection
) -> None:
    from kantor_agent.process import run  # noqa: PLC0415

    os.sched_setaffinity(0, cores)
    client.ParticipantSession = Timed  # type: ignore[misc]
    init_log()
    run(connect, credentials.find(secrets, who), START_S, lambda _: None, folder / "state")
    out.send(Timed.ticks)


def _be_flooder(
    cores: list[int], connect: str, secrets: Path, flood: Flood, rounds: int, out: Connection
) -> None:
    os.sched_setaffinity(0, cores)
    init_log()
    identity = credentials.find(secrets, FLOODER)
    with participant_session(connect, identity, "flood", START_S) as line:
        mission = _await_message(line, Mission)
        line.send(encode(Ready(VERSION, "flood")), blocking=True)
        _await_message(line, StepRequest, Ready(VERSION, "flood"))
        time.sleep(2.0)
        assert isinstance(mission, Mission)
        old = encode(Report(VERSION, "flood", Outputs(0, Pose(0.0, 0.0))))
        payload = old if flood.payload is None else flood.payload
        put: list[Callable[[], object]] = [
            Tokens(line, keys.alive(FLEET, FLOODER, "more"))
            if kind == "alive"
            else partial(
                line._session.put,
                f"kantor/v1/{identity.fleet}/{FLOODER}/{kind}",
                payload,
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=True,
            )
            for kind in flood.on
        ]
        windows = []
        for number in range(2 * rounds):
            from_s = time.monotonic()
            sent = _flood(put, flood.per_s) if number % 2 else _rest()
            windows.append(Window(from_s, time.monotonic(), sent))
        out.send(windows)
        while not isinstance(_next(line), Stop):
            pass


class Tokens:
    """Joins and leaves repeatedly."""

    def __init__(self, line: ParticipantSession, key: str) -> None:
        self._liveliness = line._session.liveliness()
        self._key = key
        self._held: list[Any] = []

    def __call__(self) -> None:
        """Joins or leaves."""
        if self._held:
            self._held.pop().undeclare()
        else:
            self._held.append(self._liveliness.declare_token(self._key))


def _await_message(line: ParticipantSession, kind: type, _said: object = None) -> object:
    give_up = time.monotonic() + START_S
    while time.monotonic() < give_up:
        message = _next(line)
        if kind is StepRequest and message is not None:
            return message
        if isinstance(message, kind):
            return message
    raise RuntimeError(f"no {kind.__name__} came")


def _next(line: ParticipantSession) -> ToParticipant | None:
    payload = line.next(1.0)
    return None if payload is None else decode_to_participant(payload)


def _rest() -> int:
    time.sleep(WINDOW_S)
    return 0


def _flood(put: list[Callable[[], object]], per_s: float) -> int:
    start_s, sent = time.monotonic(), 0
    while (elapsed_s := time.monotonic() - start_s) < WINDOW_S:
        if sent >= per_s * elapsed_s:
            time.sleep(BURST_S)
            continue
        put[sent % len(put)]()
        sent += 1
    return sent


def main() -> int:
    """Measure and print; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description="What a flood costs the others.")
    parser.add_argument("--quick", action="store_true", help="shorter")
    parser.add_argument("--beside", action="store_true", help="the flooder competes for all cores")
    parser.add_argument("--only", type=int, help="one flood, from 0")
    options = parser.parse_args()
    floods = FLOODS if options.only is None else (FLOODS[options.only],)
    table = measure(quick=options.quick, beside=options.beside, floods=floods)
    show(table)
    return 0 if table.met else 1


if __name__ == "__main__":
    sys.exit(main())
