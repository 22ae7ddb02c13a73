"""A mission on the real bus with honest robots and one hostile participant, measured in alternating windows.

The hostile participant has joined with its own credentials. Windows with and without its attack alternate, so that
both see the same machine. A *tick* is the time from a robot's first report of a step until it has received
world-sim's acceptance of it.

A robot would be another machine: its own use of a core is not what is measured. The hostile participant therefore has
a core to itself, and all other processes share the rest; *beside* them it competes for all of them.
"""

import contextlib
import json
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np
import zenoh
from lockstep_speed import running

from kantor_fleet.security.authority import Wanted, issue
from kantor_protocol.base.machine import Observation, Outputs, ParticipantId, StateMachine
from kantor_protocol.transport import client, credentials
from kantor_protocol.transport.client import ParticipantSession, participant_session
from kantor_protocol.transport.endpoint import await_endpoint, free_endpoint
from kantor_protocol.transport.session import BusError
from kantor_protocol.transport.zenoh_log import init_log
from kantor_protocol.wire import keys
from kantor_protocol.wire.messages import (
    VERSION,
    Mission,
    Ready,
    Report,
    StartClock,
    StepRequest,
    Stop,
    decode_to_participant,
    encode,
)

HONEST, HOSTILE = ("r1", "r2", "r3", "r4"), "r5"
FLEET = "kantor"
SPEED = 4.0
"""Simulated seconds in a real one: a step every 25 ms."""
SETTLE_S = 0.25
"""At the beginning of a window, not counted."""
START_S = 60.0
_OVERRIDES = (
    "limit_s=100000", "energy.points=50000", "energy.steps=50000", "radio.range_m=2400",
)  # fmt: skip
"""A long mission in which all hear one another."""
MIB = 1 << 20
_PAUSE_S = 1e-3
"""Of an attack that is ahead of its rate."""
_CALM_S = 2.0
"""From the first step to the first window."""
_SAMPLE_S = 0.05


class Window(NamedTuple):
    """A time with or without the attack; seconds of the monotonic clock."""

    from_s: float
    until_s: float
    sent: int
    """How often the attack was carried out."""


class Use(NamedTuple):
    """Resources that a process has used up to a moment."""

    at_s: float
    cpu_s: float
    rss_mib: float


Ticks = list[tuple[float, float]]
"""Of a robot: the time of each first report, and the time until its acceptance, in seconds. Of a process that joins
again and again: the same for attempts and starts of its clock."""


class Measured(NamedTuple):
    """A mission with an attack."""

    prelude: Window
    """Before the first window: what an attack needs to begin."""
    windows: list[Window]
    """Without and with the attack in turn."""
    ticks: dict[ParticipantId, Ticks]
    joins: Ticks
    uses: dict[str, list[Use]]
    """Of world-sim and of the honest robots."""
    lines: list[str]
    """What world-sim printed."""
    result: dict[str, Any]
    """result.json."""

    @property
    def calm(self) -> list[Window]:
        """Windows without the attack."""
        return self.windows[::2]

    @property
    def rough(self) -> list[Window]:
        """Windows with the attack."""
        return self.windows[1::2]

    @property
    def sent_per_s(self) -> float:
        """How often the attack was carried out in a second."""
        return sum(w.sent for w in self.rough) / sum(w.until_s - w.from_s for w in self.rough)

    def steps_per_s(self, window: Window) -> float:
        """Accepted steps of an honest robot in a second of a window: the mean over robots."""
        from_s = window.from_s + SETTLE_S
        count = sum(from_s <= s < window.until_s for ticks in self.ticks.values() for s, _ in ticks)
        return count / len(self.ticks) / (window.until_s - from_s)

    def longest_gap_s(self, windows: Iterable[Window]) -> float:
        """The longest time in these windows in which an honest robot reported no new step."""
        gaps = [0.0]
        for w in windows:
            for ticks in self.ticks.values():
                inside = [s for s, _ in ticks if w.from_s < s < w.until_s]
                gaps.append(float(np.diff([w.from_s, *inside, w.until_s]).max()))
        return max(gaps)

    def cores(self, windows: Iterable[Window]) -> float:
        """Cores that world-sim keeps busy."""
        busy_s = total_s = 0.0
        for w in windows:
            uses = self.uses["worldsim"]
            inside = [u for u in uses if w.from_s + SETTLE_S <= u.at_s < w.until_s]
            busy_s += inside[-1].cpu_s - inside[0].cpu_s
            total_s += inside[-1].at_s - inside[0].at_s
        return busy_s / total_s

    def peak_mib(self, who: str, windows: Iterable[Window]) -> float:
        """The largest resident memory of a process in these windows."""
        return max(
            u.rss_mib for w in windows for u in self.uses[who] if w.from_s <= u.at_s < w.until_s
        )

    def growth_mib(self, who: str) -> float:
        """How far the resident memory of a process has risen above that in the first window."""
        return self.peak_mib(who, self.windows[1:]) - self.peak_mib(who, self.windows[:1])


def within(ticks: Iterable[tuple[float, float]], windows: Iterable[Window]) -> list[float]:
    """The times that took those that began in these windows."""
    spans = [(w.from_s + SETTLE_S, w.until_s) for w in windows]
    return [took_s for said_s, took_s in ticks if any(a <= said_s < b for a, b in spans)]


@dataclass(frozen=True)
class Attack(ABC):
    """What a hostile participant does in every second window."""

    name: str
    per_s: float
    """How often in a second; inf: as fast as possible."""
    exchange: ClassVar[str] = "wall"
    protocol: ClassVar[str] = "tcp"
    """`tcp` with passwords, or `tls` with certificates."""
    window_s: ClassVar[float] = 2.0
    joins: ClassVar[bool] = False
    """Whether another process joins again and again, instead of the last of the honest robots."""
    kills: ClassVar[bool] = False
    """Whether world-sim is killed after the last window, and resumed."""
    culprits: ClassVar[frozenset[ParticipantId]] = frozenset({HOSTILE})
    """The participants that are to be named."""

    @abstractmethod
    def begin(self, hostile: "Hostile") -> Callable[[], object]:
        """What is to be done so often; called once the mission is under way, before the first window."""

    def rest(self, hostile: "Hostile") -> None:  # noqa: B027  most have nothing to end
        """End a window with the attack."""


class Hostile:
    """A participant that has joined with its own credentials, and has not made a step of its own accord.

    A thread reads what world-sim sends. In lockstep it answers requests as an honest robot does, unless `mute`.
    """

    def __init__(
        self, line: ParticipantSession, connect: str, identity: credentials.Identity
    ) -> None:
        """line: of a process that has just joined."""
        self.line, self.connect, self.identity = line, connect, identity
        self.mute = False
        self.over = threading.Event()
        """The mission has ended."""
        self.asked_ns = -1
        """Time in the last request; in real time, also that at which the clock was started."""
        self.observation: Observation | None = None
        self.held: list[Any] = []
        """What an attack holds."""
        self._start_ns, self._start_s = 0, 0.0
        self.mission = _await_mission(line)
        self._robot: StateMachine | None = None
        self._made: Outputs | None = None
        self.send(encode(Ready(VERSION, line.nonce)))
        threading.Thread(target=self._read, daemon=True).start()

    @property
    def step(self) -> int:
        """The last step that world-sim has accepted."""
        return 0 if self.observation is None else self.observation.step

    @property
    def now_ns(self) -> int:
        """Simulated time; realtime exchange."""
        return self._start_ns + round((time.monotonic() - self._start_s) * SPEED * 1e9)

    def send(self, payload: bytes, kind: str = "tx") -> None:
        """Put a message on an own key."""
        key = f"kantor/v1/{self.identity.fleet}/{self.identity.user}/{kind}"
        self.session.put(
            key, payload, congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )

    def await_request(self, arrived: Callable[["Hostile"], bool]) -> None:
        """Wait until the last request is as wanted."""
        _await(partial(arrived, self), "world-sim does not ask")

    @property
    def session(self) -> zenoh.Session:
        """The session on the bus."""
        return self.line._session

    def _read(self) -> None:
        while not self.over.is_set():
            payload = self.line.next(1.0)
            message = None if payload is None else decode_to_participant(payload)
            if isinstance(message, Stop):
                self.over.set()
            elif isinstance(message, StartClock):
                self._start_ns, self._start_s = message.now_ns, time.monotonic()
                self.observation, self.asked_ns = message.observation, message.now_ns
            elif isinstance(message, StepRequest):
                self.observation = message.inputs.observation
                self.asked_ns = message.inputs.now_ns
                if self.mission.exchange == "lockstep" and not self.mute:
                    self._answer(message)

    def _answer(self, request: StepRequest) -> None:
        if self._robot is None:
            self._robot = _robot_of(self.mission)
        if self._made is None or self._made.step == self.step:  # else the request is repeated
            self._made = self._robot.step(request.inputs)
        self.send(encode(Report(VERSION, self.line.nonce, self._made)))


def _robot_of(mission: Mission) -> StateMachine:
    from kantor_agent.robots.density import DensityRobot  # noqa: PLC0415  only lockstep needs it

    samples_m = mission.samples.open("<f8", 2)
    return DensityRobot(HOSTILE, mission.scenario, mission.seed, mission.body, samples_m)


def _await_mission(line: ParticipantSession) -> Mission:
    give_up = time.monotonic() + START_S
    while time.monotonic() < give_up:
        payload = line.next(1.0)
        message = None if payload is None else decode_to_participant(payload)
        if isinstance(message, Mission) and message.nonce == line.nonce:
            return message
    raise RuntimeError("no mission came")


class Timed(ParticipantSession):
    """A robot's session that measures the time of its steps."""

    ticks: Ticks

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
            message = decode_to_participant(payload)
            if isinstance(message, StepRequest) and message.inputs.observation.step >= self._step:
                self.ticks.append((self._said_s, time.monotonic() - self._said_s))
                self._said_s = 0.0
        return payload


_FROM = msgspec.msgpack.Decoder(Report | Ready)


def mission_with(attack: Attack, rounds: int, *, beside: bool) -> Measured:
    """Run a mission with so many windows without and as many with an attack. beside: on the cores of all others."""
    cores = sorted(os.sched_getaffinity(0))
    ours, theirs = (cores, cores) if beside else (cores[:-1] or cores, cores[-1:])
    context = multiprocessing.get_context("spawn")
    honest = HONEST[:-1] if attack.joins else HONEST
    with tempfile.TemporaryDirectory(prefix="kantor-hostile-") as name, ExitStack() as stack:
        folder = Path(name)
        place = _Place(free_endpoint(attack.protocol), folder)
        if attack.protocol == "tls":
            issue(place.secrets, Wanted(FLEET, len(HONEST) + 1), datetime.now(UTC))
        pipes: dict[str, Connection] = {}

        def process(who: str, target: Callable[..., None], *arguments: object) -> BaseProcess:
            pipes[who], end = context.Pipe(duplex=False)
            return context.Process(target=target, args=(*arguments, end))

        world = context.Process(target=_be_world, args=(ours, place, attack.exchange))
        robots = {who: process(who, _be_robot, ours, place, who) for who in honest}
        attacker = process(HOSTILE, _be_hostile, theirs, place, attack, rounds)
        others = [process("joiner", _be_joiner, ours, place, HONEST[-1])] if attack.joins else []
        stack.enter_context(running([world]))
        _await((place.secrets / f"{HOSTILE}.toml").exists, "world-sim does not start")
        await_endpoint(place.endpoint, START_S)
        stack.enter_context(running([*robots.values(), attacker, *others]))
        pids = {"worldsim": world.pid, **{who: robot.pid for who, robot in robots.items()}}
        uses: dict[str, list[Use]] = {who: [] for who in pids}
        while not pipes[HOSTILE].poll(_SAMPLE_S):
            for who, pid in pids.items():
                uses[who].append(_use(pid or 0))
        try:
            prelude, *windows = pipes[HOSTILE].recv()
        except EOFError:
            raise RuntimeError(f"the attacker has ended; world-sim: {place.lines()[-3:]}") from None
        if attack.kills:
            world.kill()
            world.join()
            count = len(place.lines())
            world = context.Process(target=_be_resumed, args=(ours, place))
            stack.enter_context(running([world]))
            _await(lambda: place.is_under_way(count), "world-sim does not resume")
        os.kill(world.pid or 0, signal.SIGINT)
        ticks = {who: pipes[who].recv() for who in robots}
        joins = pipes["joiner"].recv() if attack.joins else []
        world.join(START_S)
        return Measured(prelude, windows, ticks, joins, uses, place.lines(), place.result())


class _Place(NamedTuple):
    """Where a mission is."""

    endpoint: str
    folder: Path

    @property
    def secrets(self) -> Path:
        return self.folder / "credentials"

    @property
    def output(self) -> Path:
        return self.folder / "worldsim.txt"

    def lines(self) -> list[str]:
        return self.output.read_text().splitlines()

    def is_under_way(self, count: int) -> bool:
        """Whether progress is printed after so many lines."""
        return any(line.startswith("t=") and "explored" in line for line in self.lines()[count:])

    def result(self) -> dict[str, Any]:
        (path,) = self.folder.glob("runs/*/result.json")
        result: dict[str, Any] = json.loads(path.read_text())
        return result


def _await(done: Callable[[], bool], complaint: str) -> None:
    give_up = time.monotonic() + START_S
    while not done():
        if time.monotonic() > give_up:
            raise RuntimeError(complaint)
        time.sleep(0.02)


def _use(pid: int) -> Use:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    ticks, pages = int(fields[11]) + int(fields[12]), int(fields[21])
    page_bytes = os.sysconf("SC_PAGE_SIZE")
    return Use(time.monotonic(), ticks / os.sysconf("SC_CLK_TCK"), pages * page_bytes / MIB)


def _print_into(path: Path) -> None:
    """Append what this process prints to a file."""
    with path.open("a") as output:
        os.dup2(output.fileno(), sys.stdout.fileno())
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]


def _be_world(cores: list[int], place: _Place, exchange: str) -> None:
    from kantor_fleet.processes.standalone import host_standalone  # noqa: PLC0415  robots do without it
    from kantor_fleet.scenarios.catalog import find  # noqa: PLC0415

    os.sched_setaffinity(0, cores)
    scenario = find("fleet", _OVERRIDES)
    out = place.folder / "runs"
    out.mkdir()
    _print_into(place.output)
    host_standalone(
        scenario, 0, exchange, SPEED, place.endpoint, place.secrets, FLEET, None, out, None
    )


def _be_resumed(cores: list[int], place: _Place) -> None:
    from kantor_fleet.processes.standalone import resume_standalone  # noqa: PLC0415  robots do without it

    os.sched_setaffinity(0, cores)
    _print_into(place.output)
    (run,) = (place.folder / "runs").iterdir()
    resume_standalone(run, place.endpoint, place.secrets, FLEET)


def _be_robot(cores: list[int], place: _Place, who: str, out: Connection) -> None:
    from kantor_agent.process import run  # noqa: PLC0415

    os.sched_setaffinity(0, cores)
    client.ParticipantSession = Timed  # type: ignore[misc]
    init_log()
    identity = credentials.find(place.secrets, who)
    run(place.endpoint, identity, START_S, lambda _: None, place.folder / "state")
    out.send(Timed.ticks)


def _be_joiner(cores: list[int], place: _Place, who: str, out: Connection) -> None:
    """Join again and again until the mission is over, each time as a new process that does not make a step."""
    os.sched_setaffinity(0, cores)
    init_log()
    identity = credentials.find(place.secrets, who)
    joins: Ticks = []
    with contextlib.suppress(BusError):  # world-sim has ended
        while True:
            start_s = time.monotonic()
            if not _join(place.endpoint, identity, f"join{len(joins)}"):
                break
            joins.append((start_s, time.monotonic() - start_s))
            time.sleep(_SAMPLE_S)
    out.send(joins)


def _join(connect: str, identity: credentials.Identity, nonce: str) -> bool:
    """Join, until the clock is started; False if the mission is over."""
    with participant_session(connect, identity, nonce, START_S) as line:
        while True:
            payload = line.next(START_S)
            message = None if payload is None else decode_to_participant(payload)
            if message is None or isinstance(message, Stop):
                return False
            if isinstance(message, StartClock):
                return True
            if isinstance(message, Mission):
                line.send(encode(Ready(VERSION, nonce)), blocking=True)


def _be_hostile(
    cores: list[int], place: _Place, attack: Attack, rounds: int, out: Connection
) -> None:
    os.sched_setaffinity(0, cores)
    init_log()
    identity = credentials.find(place.secrets, HOSTILE)
    with participant_session(place.endpoint, identity, "hostile", START_S) as line:
        hostile = Hostile(line, place.endpoint, identity)
        hostile.await_request(lambda h: h.asked_ns >= 0)
        time.sleep(_CALM_S)
        began_s = time.monotonic()
        act = attack.begin(hostile)
        windows = [Window(began_s, time.monotonic(), 0)]
        for number in range(2 * rounds):
            from_s = time.monotonic()
            sent = _carry_out(act, attack) if number % 2 else _rest(attack)
            windows.append(Window(from_s, time.monotonic(), sent))
            if number % 2:
                attack.rest(hostile)
        out.send(windows)
        hostile.over.wait(START_S)


def _rest(attack: Attack) -> int:
    time.sleep(attack.window_s)
    return 0


def _carry_out(act: Callable[[], object], attack: Attack) -> int:
    start_s, sent = time.monotonic(), 0
    while (elapsed_s := time.monotonic() - start_s) < attack.window_s:
        if sent >= attack.per_s * elapsed_s:
            time.sleep(_PAUSE_S)
            continue
        act()
        sent += 1
    return sent


class Tokens:
    """Other processes under the own id, which join and leave in turn."""

    def __init__(self, hostile: Hostile) -> None:
        """None has joined."""
        self._hostile = hostile
        self._held: list[Any] = []
        self._count = 0

    def __call__(self) -> None:
        """Join as another process, or leave."""
        if self._held:
            self._held.pop().undeclare()
            return
        self._count += 1
        key = keys.alive(FLEET, HOSTILE, f"more{self._count}")
        self._held.append(self._hostile.session.liveliness().declare_token(key))
