"""World-sim as a process: it hosts the bus, gathers the roster, and runs the mission over it."""

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import msgspec

from kantor_protocol.bus import Heard, Host, Joined, Left
from kantor_protocol.machine import Inputs, Observation, Outputs, ParticipantId
from kantor_protocol.messages import (
    VERSION,
    Array,
    Go,
    Mission,
    Progress,
    Ready,
    Refusal,
    RefusedError,
    Report,
    Stop,
    Turn,
    decode_from_participant,
    encode,
)
from kantor_protocol.scenario import Scenario
from kantor_worldsim.loop import simulate
from kantor_worldsim.metrics import Following, Result
from kantor_worldsim.recording import Recording
from kantor_worldsim.stage import Stage, Step
from kantor_worldsim.world import Site

BARRIER_S = 10.0
"""Lockstep: a participant that has not answered by then misses the step."""
_PROGRESS_S = 0.2
_CLOCK_TOLERANCE_NS = 500_000_000
"""Wall, in real time: how far ahead of world-sim's clock a robot's may be."""


class Plan(NamedTuple):
    """What a world-sim process is to run."""

    scenario: Scenario
    seed: int
    site: Site
    exchange: str
    """`lockstep` or `wall`."""
    speed: float = 1.0
    """Wall: simulated seconds in a real one."""
    patience_s: float | None = None
    """How long to wait for the whole roster before starting without the rest; None: for ever."""


def _unseen(_progress: Progress) -> None:
    """Progress that nobody here looks at."""


def run(
    host: Host,
    plan: Plan,
    recording: Recording,
    stopped: Callable[[], bool],
    show: Callable[[Progress], None] = _unseen,
) -> Result:
    """Run a mission to its end, or until `stopped()`. The record is closed in every case.

    show: takes what observers on the bus are told as well.
    """
    doorway = _Doorway(host, plan, recording.metrics, stopped, show)
    doorway.gather()
    stage = Stage(plan.scenario, plan.seed, plan.site, [recording.take, doorway.tell])
    doorway.stage = stage
    doorway.mark_gone()
    if plan.exchange == "wall":
        reason = _Relay(doorway, stage, plan).run()
    else:
        reason = simulate(stage, _Lockstep(doorway), plan.seed, stopped)
    doorway.dismiss(reason)
    recording.refused_at_door = doorway.refused
    result = recording.finish()
    doorway.tell_progress("over", reason)
    return result


class _Doorway:
    """Who is on the bus: lets each participant in once, and hands its messages on."""

    def __init__(
        self,
        host: Host,
        plan: Plan,
        metrics: Following,
        stopped: Callable[[], bool],
        show: Callable[[Progress], None],
    ) -> None:
        self.host = host
        self.stage: Stage | None = None
        self.stopped = stopped
        self.ready: dict[ParticipantId, str] = {}
        """Nonce of the process that plays each participant and has its mission."""
        self.refused = 0
        """Messages that were malformed, or from a process that does not play that participant."""
        self.first_looks: dict[ParticipantId, Observation] = {}
        """Wall: what each participant sees before its first step."""
        self._plan = plan
        self._metrics = metrics
        self._show = show
        self._nonces: dict[ParticipantId, str] = {}
        self._briefed: set[str] = set()
        """Nonces of the processes that have been given the mission."""
        self._started = False
        self._told = 0.0
        self._starts = Array.of(plan.site.starts_m)
        self._samples = Array.of(plan.site.samples_m)

    def gather(self) -> None:
        """Wait for the whole roster, as long as the plan's patience lasts, and for one robot."""
        roster = set(self._plan.scenario.roster)
        robots = set(self._plan.scenario.robot_ids)
        patience_s = self._plan.patience_s
        give_up = None if patience_s is None else time.monotonic() + patience_s
        while set(self.ready) != roster and not self.stopped():
            late = give_up is not None and time.monotonic() >= give_up
            if late and robots & set(self.ready):
                break
            self.next(_PROGRESS_S)
            missing = sorted(roster - set(self.ready), key=self._plan.scenario.roster.index)
            self._tell("waiting", ", ".join(missing))
        self._started = True

    def mark_gone(self) -> None:
        """Bring the stage's list of absent participants up to date."""
        if self.stage is not None:
            self.stage.gone = set(self._plan.scenario.roster) - set(self.ready)

    def next(self, timeout_s: float) -> tuple[ParticipantId, Report] | None:
        """The next report, or None when something else came or the timeout passed."""
        event = self.host.next(timeout_s)
        if isinstance(event, Joined):
            self._join(event)
        elif isinstance(event, Left):
            self._leave(event)
        elif isinstance(event, Heard):
            return self._hear(event)
        return None

    def dismiss(self, reason: str) -> None:
        """Tell everybody that the mission is over."""
        for name in self._nonces:
            self.host.send(name, encode(Stop(VERSION, reason)), patiently=True)

    def _join(self, event: Joined) -> None:
        name, nonce = event
        if name not in self._plan.scenario.roster:
            self.refused += 1
        elif nonce in self._briefed:  # it was frozen or cut off for a while and has its mission
            self._nonces[name] = self.ready[name] = nonce
            self.mark_gone()
        elif name in self._nonces:
            self._refuse(
                event, "is on the bus already; stop the other process or choose another id"
            )
        elif self.stage is not None and self.stage.acted(name):
            self._refuse(event, "has acted before; a restarted robot would forget what it spent")
        else:
            self._brief(event)

    def _refuse(self, event: Joined, reason: str) -> None:
        refusal = Refusal(VERSION, event.nonce, reason)
        self.host.send(event.name, encode(refusal), patiently=True)

    def _brief(self, event: Joined) -> None:
        plan = self._plan
        self._nonces[event.name] = event.nonce
        self._briefed.add(event.nonce)
        mission = Mission(
            VERSION,
            event.nonce,
            msgspec.structs.replace(plan.scenario, faults=()),  # nobody knows what is to come
            plan.seed,
            self._starts,
            self._samples,
            plan.exchange,
            plan.site.ground and plan.site.ground.frame,
        )
        self.host.send(event.name, encode(mission), patiently=True)

    def _leave(self, event: Left) -> None:
        if self._nonces.get(event.name) == event.nonce:
            del self._nonces[event.name]
            self.ready.pop(event.name, None)
            self.mark_gone()

    def _hear(self, event: Heard) -> tuple[ParticipantId, Report] | None:
        try:
            message = decode_from_participant(event.payload)
        except RefusedError:
            self.refused += 1
            return None
        if self._nonces.get(event.name) != message.nonce:
            self.refused += 1
            return None
        if isinstance(message, Ready):
            self.ready[event.name] = message.nonce
            self.mark_gone()
            if self._started and self.stage is not None and self._plan.exchange == "wall":
                self.go(event.name)
            return None
        return event.name, message

    def go(self, name: ParticipantId) -> None:
        """Wall: start a participant's clock."""
        now_ns = self.stage.now_ns if self.stage is not None else 0
        look = self.first_looks.get(name)
        message = Go(VERSION, self.ready[name], now_ns, self._plan.speed, look)
        self.host.send(name, encode(message), patiently=True)

    def tell(self, _record: object) -> None:
        """Publish progress now and then."""
        self._tell("running", "")

    def tell_progress(self, phase: str, detail: str) -> None:
        """Publish progress now."""
        self._told = 0.0
        self._tell(phase, detail)

    def _tell(self, phase: str, detail: str) -> None:
        now = time.monotonic()
        if now - self._told >= _PROGRESS_S:
            self._told = now
            message = progress(self._metrics, self._plan.scenario, phase, detail)
            self.host.publish_progress(encode(message))
            self._show(message)


class _Lockstep:
    """The exchange over the bus with a barrier: everybody due steps, then all go on together."""

    def __init__(self, doorway: _Doorway) -> None:
        self._doorway = doorway

    def __call__(self, inputs: Mapping[ParticipantId, Inputs]) -> Mapping[ParticipantId, Outputs]:
        doorway = self._doorway
        waiting = [name for name in inputs if name in doorway.ready]
        for name in waiting:
            doorway.host.send(name, encode(Turn(VERSION, inputs[name])), patiently=True)
        outputs: dict[ParticipantId, Outputs] = {}
        give_up = time.monotonic() + BARRIER_S
        while len(outputs) < len(waiting) and time.monotonic() < give_up:
            report = doorway.next(0.05)
            if report is not None and report[0] in waiting:
                outputs[report[0]] = report[1].outputs
            elif any(name not in doorway.ready for name in waiting):
                waiting = [name for name in waiting if name in doorway.ready or name in outputs]
        return outputs


class _Relay:
    """The wall exchange: every participant steps by its own clock.

    What it sends is ruled on and passed on when it arrives. Every inbox is recorded as the
    participant reports it.
    """

    def __init__(self, doorway: _Doorway, stage: Stage, plan: Plan) -> None:
        self._doorway = doorway
        self._stage = stage
        self._speed = plan.speed
        self._limit_ns = plan.scenario.limit_ns
        self._origin_ns = time.monotonic_ns()
        self._observed: dict[ParticipantId, dict[int, Observation]] = {}
        self._handed: dict[ParticipantId, list[Inputs]] = {}
        for name in plan.scenario.roster:
            given = stage.inputs(name, 0)
            self._observed[name] = {0: given.observation}
            doorway.first_looks[name] = given.observation
            self._handed[name] = []

    def run(self) -> str:
        for name in tuple(self._doorway.ready):
            self._doorway.go(name)
        while True:
            reason = self._reason()
            if reason is not None:
                self._stage.end(reason)
                return reason
            report = self._doorway.next(self._patience_s())
            if report is not None:
                self._settle(*report)
            self._deliver()

    @property
    def _now_ns(self) -> int:
        return round((time.monotonic_ns() - self._origin_ns) * self._speed)

    def _reason(self) -> str | None:
        if self._stage.over:
            return self._stage.over
        if self._doorway.stopped():
            return "interrupted"
        return "limit" if self._now_ns > self._limit_ns else None

    def _patience_s(self) -> float:
        due_ns = self._stage.channel.next_due_ns()
        if due_ns is None:
            return _PROGRESS_S
        return min(_PROGRESS_S, max(0.0, (due_ns - self._now_ns) * 1e-9 / self._speed))

    def _settle(self, name: ParticipantId, report: Report) -> None:
        inputs = self._inputs(name, report)
        ahead_ns = report.now_ns - self._now_ns
        if inputs is None or ahead_ns > _CLOCK_TOLERANCE_NS * self._speed:
            self._doorway.refused += 1
            return
        self._stage.settle(
            max(self._now_ns, self._stage.now_ns), [Step(name, inputs, report.outputs)]
        )
        self._hand(name, self._now_ns)

    def _inputs(self, name: ParticipantId, report: Report) -> Inputs | None:
        """The inputs that the participant says it had, if it can have had them."""
        observation = self._observed[name].get(report.observed)
        if observation is None:
            return None
        handed = [envelope for inputs in self._handed[name] for envelope in inputs.inbox]
        inbox = []
        for source, sequence in report.heard:
            place = next(
                (
                    i
                    for i, envelope in enumerate(handed)
                    if (envelope.source, envelope.sequence) == (source, sequence)
                ),
                None,
            )
            if place is None:
                return None
            inbox.append(handed.pop(place))
        self._handed[name] = [Inputs(0, observation, tuple(handed))] if handed else []
        old = [step for step in self._observed[name] if step < report.observed]
        for step in old:
            del self._observed[name][step]
        return Inputs(report.now_ns, observation, tuple(inbox))

    def _deliver(self) -> None:
        """Hand on what is due at anybody."""
        due_ns, now_ns = self._stage.channel.next_due_ns(), self._now_ns
        if due_ns is None or due_ns > now_ns:
            return
        for name in self._stage.scenario.roster:
            if self._stage.channel.waits(name, now_ns):
                self._hand(name, now_ns)

    def _hand(self, name: ParticipantId, now_ns: int) -> None:
        inputs = self._stage.inputs(name, now_ns)
        self._observed[name][inputs.observation.step] = inputs.observation
        if name not in self._doorway.ready:
            return
        if inputs.inbox:
            self._handed[name].append(inputs)
        self._doorway.host.send(name, encode(Turn(VERSION, inputs)), patiently=False)


def progress(metrics: Following, scenario: Scenario, phase: str, detail: str) -> Progress:
    """How a mission goes, for observers."""
    glance = metrics.glance()
    energy_total = 0 if scenario.mapping else scenario.steps_per_robot * scenario.robots.count
    return Progress(
        VERSION,
        now_ns=glance.now_ns,
        phase=phase,
        detail=detail,
        energy_spent=glance.energy_spent,
        energy_total=energy_total,
        detected=glance.detected,
        targets=glance.targets,
        w_ub=glance.w_ub,
        links=glance.links,
        messages_per_s=glance.messages_per_s,
        robots_done=glance.robots_done,
        robots=scenario.robots.count,
        mass_left=glance.mass_left,
        distance_m=glance.distance_m,
    )
