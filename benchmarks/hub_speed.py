"""Capacity of one hub: robots times rate that world-sim relays in realtime, and its cost.

World-sim is the real one in a process of its own: router, access control, lobby, relay, radio, checkers,
record on disk. Robots are real clients of its bus with the real planner; many of them share a process and one
loop, so that the machine has time left for the hub. Their clocks differ by up to 5 % and jitter, as robots' do.

`answer` is the time from a robot's report until the robot has received world-sim's answer. A robot without it
holds when its next step is due, so a rate is carried if 99 in 100 answers take less than a period.
"""

import gc
import math
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from tables import Table

from kantor_agent.robots.density import DensityRobot
from kantor_fleet.execution.fork_server import await_fork_server
from kantor_fleet.scenarios.catalog import find
from kantor_fleet.security import authority
from kantor_protocol.base.machine import Body, Envelope, Inputs, Pose
from kantor_protocol.node.recovery import InMemoryLog, RecoverableNode
from kantor_protocol.node.runner import RETRY_S
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.load import from_tree
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport import credentials
from kantor_protocol.transport.client import ParticipantSession, participant_session
from kantor_protocol.transport.endpoint import free_endpoint
from kantor_protocol.transport.router import HubRouter, SiteRouter
from kantor_protocol.transport.session import be_light
from kantor_protocol.transport.zenoh_log import init_log
from kantor_protocol.wire.messages import (
    VERSION,
    Mission,
    PoseMessage,
    Ready,
    Report,
    StartClock,
    StepRequest,
    Stop,
    decode_to_participant,
    encode,
)
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.main import run
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup

COUNTS, COUNTS_QUICK = (10, 50, 100, 200), (10, 50)
LINKS = ("tcp", "tls", "site")
"""Passwords over TCP; certificates over TLS; and the same with a site's router between all robots and the hub."""
RATES_HZ = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0)
SITE_MAX = 100
"""Robots behind one site."""
WARM_S, MEASURED_S = 1.0, 3.0
"""Real seconds of a mission that are left out, and that are measured."""
START_S = 60.0
ROBOTS_PER_PROCESS = 50
FLEET = "hub"
PERIOD_S = 0.1
"""Period of the scenario. Other rates are the same mission at another speed."""
DEGREE = 5.0
"""Robots in range of one, on average, where they start."""
SIDE_M, CLUSTERS = 8000.0, 8
POLL_S = 0.001


class Load(NamedTuple):
    """One mission."""

    count: int
    rate_hz: float
    link: str
    """One of LINKS."""


class Cost(NamedTuple):
    """Cost of one mission for the hub."""

    steps: int
    """Robot-ticks that it settled."""
    cpu_s: float
    """CPU time of the whole process, Zenoh's threads included."""
    main_s: float
    """CPU time of the thread that relays."""
    real_s: float


class Pace(NamedTuple):
    """Measures of one mission at the robots."""

    cost: Cost
    answers_s: list[float]
    """Times from a report to its answer."""
    held: int
    """Steps that were due and were held, since world-sim's answer had not arrived."""
    site_cpu_s: float | None = None
    """CPU time of a site's router, from its start to its end."""

    @property
    def p99_s(self) -> float:
        """Within which 99 of 100 answers came."""
        if len(self.answers_s) < 100:
            return math.inf
        return statistics.quantiles(self.answers_s, n=100)[98]

    @property
    def us(self) -> float:
        """CPU of the hub per robot-tick."""
        return 1e6 * self.cost.cpu_s / self.cost.steps

    @property
    def site_us(self) -> float | None:
        """CPU of the site per robot-tick, handshakes included."""
        if self.site_cpu_s is None:
            return None
        return 1e6 * self.site_cpu_s / max(1, len(self.answers_s))


def measure(*, quick: bool) -> Table:
    """For each number of robots the highest rate that is carried, and the cost of a robot-tick there."""
    await_fork_server()
    rows = []
    for link in LINKS:
        for count in COUNTS_QUICK if quick else COUNTS:
            if link == "site" and count > SITE_MAX:
                continue
            load, pace = _highest(count, link)
            cost = pace.cost
            per_core = cost.steps / cost.cpu_s
            rows.append(
                (
                    link,
                    f"{count}",
                    f"{load.rate_hz:.0f}" if _carries(load, pace) else "-",
                    f"{count * load.rate_hz:,.0f}",
                    f"{cost.steps / cost.real_s:,.0f}",
                    f"{1e3 * statistics.median(pace.answers_s or [math.inf]):.1f}",
                    f"{1e3 * pace.p99_s:.1f}",
                    f"{100 * pace.held / max(1, len(pace.answers_s) + pace.held):.1f}",
                    f"{pace.us:.0f}",
                    f"{1e6 * cost.main_s / cost.steps:.0f}",
                    f"{per_core:,.0f}",
                    "" if pace.site_us is None else f"{pace.site_us:.0f}",
                )
            )
    return Table(
        "hub: robots times rate that one world-sim carries in realtime",
        (
            "link",
            "robots",
            "highest rate, Hz",
            "requested, robot-ticks/s",
            "done/s",
            "answer p50, ms",
            "p99, ms",
            "held, %",
            "hub CPU, us/robot-tick",
            "of that its loop",
            "robot-ticks per CPU second",
            "site CPU, us/robot-tick",
        ),
        rows,
        (
            "site: by TLS, with a site's router between all robots and the hub",
            f"rates tried: {', '.join(f'{rate:g}' for rate in RATES_HZ)} Hz, {MEASURED_S:g} s each;",
            "carried: p99 of answers below a period, and 95 % of the steps done;",
            "robots share the machine with the hub: the rate is what both together reach.",
        ),
    )


def _highest(count: int, link: str) -> tuple[Load, Pace]:
    """The highest rate that is carried; or the lowest, if none is. It starts where a core would do it."""
    tried: dict[int, tuple[Load, Pace]] = {}

    def attempt(rung: int) -> bool:
        load = Load(count, RATES_HZ[rung], link)
        tried[rung] = load, _mission(load)
        return _carries(*tried[rung])

    rung = min(range(len(RATES_HZ)), key=lambda i: abs(math.log(RATES_HZ[i] * count / 2000.0)))
    if attempt(rung):
        while rung + 1 < len(RATES_HZ) and attempt(rung + 1):
            rung += 1
        return tried[rung]
    while rung and not attempt(rung - 1):
        rung -= 1
    return tried[max(0, rung - 1)]


def _carries(load: Load, pace: Pace) -> bool:
    done = pace.cost.steps / pace.cost.real_s
    return pace.p99_s < 1.0 / load.rate_hz and done > 0.95 * load.count * load.rate_hz


def _mission(load: Load) -> Pace:
    """A mission with the hub in one process, the robots in a few, and perhaps a site in one."""
    names = _scenario(load).robot_ids
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        place = Path(folder)
        hub, connect = _endpoint(load), _endpoint(load)
        _issue(load, place)
        hub_pipe = _start(stack, _be_hub, load, hub, place)
        site_pipe = None
        if load.link == "site":
            site_pipe = _start(stack, _be_site, hub, connect, place)
        robots = [
            _start(stack, _be_robots, some, connect if site_pipe else hub, place)
            for some in batched(names, ROBOTS_PER_PROCESS)
        ]
        cost = _told(hub_pipe, load)
        parts = []
        for pipe in robots:
            pipe.send(None)  # robots that missed the end of the mission end as well
            parts.append(_told(pipe, load))
        answers_s = [answer for part, _ in parts for answer in part]
        pace = Pace(cost, answers_s, sum(held for _, held in parts))
        if site_pipe is not None:
            site_pipe.send(None)
            pace = pace._replace(site_cpu_s=_told(site_pipe, load))
    return pace


def batched(names: Sequence[str], size: int) -> Iterator[Sequence[str]]:
    """In groups of at most so many."""
    for first in range(0, len(names), size):
        yield names[first : first + size]


def _told(pipe: Connection, load: Load) -> Any:
    if not pipe.poll(START_S + WARM_S + MEASURED_S):
        raise RuntimeError(f"{load}: the mission did not end")
    return pipe.recv()


def _start(stack: ExitStack, target: Callable[..., None], *arguments: object) -> Connection:
    context = get_context("forkserver")
    ours, theirs = context.Pipe()
    process = context.Process(target=target, args=(*arguments, theirs))
    process.start()
    theirs.close()
    stack.callback(process.join, 5.0)
    stack.callback(process.kill)
    return ours


def _endpoint(load: Load) -> str:
    """A free loopback endpoint."""
    return free_endpoint("tcp" if load.link == "tcp" else "tls")


def _issue(load: Load, place: Path) -> None:
    """Identities for all processes."""
    names = _scenario(load).robot_ids
    if load.link == "tcp":
        credentials.issue(place, FLEET, names)
    else:
        sites = (f"north={','.join(names)}",) if load.link == "site" else ()
        authority.issue(place, authority.Wanted(FLEET, load.count, sites=sites), authority.today())


def _scenario(load: Load) -> Scenario:
    """Robots anywhere in a domain with many clusters of samples."""
    range_m = math.sqrt(DEGREE * SIDE_M**2 / max(1, load.count - 1) / math.pi)
    centres_m = [SIDE_M * (i + 0.5) / CLUSTERS for i in range(CLUSTERS)]
    density = [
        {"mean_m": [x_m, y_m], "variance_m2": [40_000.0, 40_000.0]}
        for x_m in centres_m
        for y_m in centres_m
    ]
    tree = to_tree(find("fleet"))
    tree |= {
        "name": "hub",
        "domain": {"min_m": [0.0, 0.0], "max_m": [SIDE_M, SIDE_M]},
        "robots": {"count": load.count},
        "starts": {"random": True},
        "samples": {"count": 2000},
        "energy": {"points": 2_000_000, "steps": 2_000_000},
        "radio": {"range_m": range_m},
        "density": density,
        "metrics": {},
        "clock": {"period_s": PERIOD_S, "spread": 0.05, "jitter_s": 0.05},
        "limit_s": (WARM_S + MEASURED_S) * PERIOD_S * load.rate_hz,
    }
    return from_tree(tree, "hub")


# The hub's process.


def _be_hub(load: Load, endpoint: str, place: Path, pipe: Connection) -> None:
    init_log()
    scenario, folder = _scenario(load), place / "run"
    folder.mkdir()
    plan = MissionConfig(scenario, 0, WorldSetup.of(scenario, 0), "wall", load.rate_hz * PERIOD_S)
    recording = Recording(scenario, 0, "wall", folder, speed=plan.speed)
    meter = _Meter(lambda: recording.metrics.steps)
    users, host = credentials.users_file(place), credentials.find(place, credentials.HOST)
    with HubRouter(host, endpoint, users, scenario.roster) as router:
        result = run(router, plan, recording, lambda: False, meter.look)
        if result.violations:
            raise RuntimeError(f"{load}: {result.complaints[0]}")
        pipe.send(meter.cost)


class _Meter:
    """Resources of the hub between the end of the warm-up and its last progress message."""

    def __init__(self, steps: Callable[[], int]) -> None:
        self._steps = steps
        self._seen: list[Cost] = []

    def look(self, progress: object) -> None:
        """Take a sample with each progress message."""
        if getattr(progress, "phase", "") == "running":
            reading = Cost(self._steps(), time.process_time(), time.thread_time(), time.monotonic())
            if not self._seen or reading.real_s > self._seen[0].real_s + WARM_S:
                self._seen.append(reading)

    @property
    def cost(self) -> Cost:
        """The cost between the first and the last sample that are measured; a busy machine has fewer."""
        first, last = (self._seen[1:] or self._seen)[0], self._seen[-1]
        spent = Cost(*(b - a for a, b in zip(first, last, strict=True)))
        return spent._replace(steps=max(1, spent.steps), real_s=max(PERIOD_S, spent.real_s))


def _be_site(connect: str, listen: str, place: Path, pipe: Connection) -> None:
    init_log()
    identity = credentials.find(place, "site-north")
    assert isinstance(identity, credentials.Certificate)
    with SiteRouter(identity, connect, listen, START_S):
        pipe.recv()
        pipe.send(time.process_time())
        os._exit(0)


# The robots' processes.


def _be_robots(names: Sequence[str], endpoint: str, place: Path, pipe: Connection) -> None:
    be_light()
    init_log()
    with ExitStack() as stack:
        robots = [stack.enter_context(_robot(name, endpoint, place)) for name in names]
        gc.freeze()
        while not pipe.poll():
            acted = [robot.step_record() for robot in robots]
            if not any(acted):
                time.sleep(POLL_S)
        pipe.send(([answer for r in robots for answer in r.answers_s], sum(r.held for r in robots)))
        os._exit(0)  # closing a hundred sessions one by one takes longer than the mission


@contextmanager
def _robot(name: str, endpoint: str, place: Path) -> "Iterator[_Robot]":
    nonce = f"{os.getpid()}-{threading.get_native_id()}"
    with participant_session(endpoint, credentials.find(place, name), nonce, START_S) as line:
        yield _Robot(line, name)


class _Robot:
    """A realtime participant in a loop that it shares; without a write-ahead log on disk."""

    def __init__(self, line: ParticipantSession, name: str) -> None:
        self._line, self._name = line, name
        self._life: RecoverableNode | None = None
        self._go: StartClock | None = None
        self._inbox: list[Envelope] = []
        self._said_s = 0.0
        self._waits = False
        self.answers_s: list[float] = []
        self.held = 0
        self.over = False

    def step_record(self) -> bool:
        """Handle messages, and step if that is due; whether there was anything to do."""
        busy = False
        while (payload := self._line.next(0.0)) is not None:
            self._handle(decode_to_participant(payload))
            busy = True
        if self._life is not None and self._go is not None and not self.over:
            busy = self._step(self._life) or busy
        return busy

    def _handle(self, message: object) -> None:
        if isinstance(message, Mission):
            self._prepare(message)
        elif isinstance(message, StartClock):
            self._start(message)
        elif isinstance(message, StepRequest) and self._life is not None:
            self._inbox += message.inputs.inbox
            self._observation = message.inputs.observation
            if self._waits and self._observation.step == self._life.step_count:
                self._waits = False
                self.answers_s.append(time.monotonic() - self._said_s)
        elif isinstance(message, Stop):
            self.over = True

    def _prepare(self, mission: Mission) -> None:
        scenario, i = mission.scenario, mission.scenario.robot_ids.index(self._name)
        pose = Pose(*mission.starts.open("<f8", 2)[i].tolist())
        samples_m = mission.samples.open("<f8", 2)

        def build(body: Body) -> DensityRobot:
            return DensityRobot(self._name, scenario, mission.seed, body, samples_m)

        self._life = RecoverableNode(build, InMemoryLog(), mission.body or Body(pose))
        self._clock = step_clocks(scenario, mission.seed)[self._name]
        self._line.send(encode(Ready(VERSION, self._line.nonce)), blocking=True)

    def _start(self, go: StartClock) -> None:
        assert go.observation is not None
        self._go, self._observation = go, go.observation
        self._origin_ns = time.monotonic_ns() - round(go.now_ns / go.speed)
        self._ordinal = 1
        self._skip(go.now_ns)

    def _skip(self, now_ns: int) -> None:
        while self._clock.due_ns(self._ordinal) <= now_ns:
            self._ordinal += 1

    def _step(self, life: RecoverableNode) -> bool:
        assert self._go is not None
        now_ns = round((time.monotonic_ns() - self._origin_ns) * self._go.speed)
        if now_ns < self._clock.due_ns(self._ordinal):
            if self._waits and time.monotonic() - self._again_s > RETRY_S:
                self._say()
            return False
        self._skip(now_ns)
        if self._waits:
            self.held += 1
            return False
        inputs = Inputs(now_ns, self._observation, tuple(self._inbox))
        self._inbox.clear()
        outputs = life.step(inputs)
        received = tuple((envelope.source, envelope.sequence) for envelope in inputs.inbox)
        self._report = encode(
            Report(
                VERSION, self._line.nonce, outputs, inputs.now_ns, received, inputs.observation.step
            )
        )
        self._said_s, self._waits = time.monotonic(), True
        self._say()
        pose = PoseMessage(VERSION, outputs.step, now_ns, outputs.pose)
        self._line.publish_pose(encode(pose))
        if outputs.weights:
            self._line.publish_weights(outputs.weights)
        return True

    def _say(self) -> None:
        self._again_s = time.monotonic()
        self._line.send(self._report, blocking=False)
