"""World-sim as a process: it hosts the bus, gathers the roster, and runs the mission over it.

It can be killed at any time and go on from its journal. What a participant did counts once it is on
record, and only then is the participant told, so whoever comes back agrees with the record: a step that is not in
it is said again, and one that is in it is not done twice.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import Literal, NamedTuple

import msgspec

from kantor_protocol.bus import LEASE_MS, BusError, Heard, Host, Joined, Left
from kantor_protocol.faults import Clock, Disk, Impostor, Kill, Late, OnProcesses, kind_of
from kantor_protocol.machine import (
    WORLD_SIM,
    Body,
    Envelope,
    Inputs,
    Outputs,
    ParticipantId,
)
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
from kantor_protocol.process import INBOX_MAX
from kantor_protocol.scenario import Scenario
from kantor_worldsim.admission import REFUSALS, Admission, Entry
from kantor_worldsim.hands import Hands, Order
from kantor_worldsim.loop import simulate
from kantor_worldsim.metrics import Following, Result
from kantor_worldsim.outages import Deed, Outages, deeds_of
from kantor_worldsim.recording import Past, Recording
from kantor_worldsim.records import Incident, Record
from kantor_worldsim.stage import Stage, Step
from kantor_worldsim.world import Site

BARRIER_S = 10.0
"""Lockstep: a participant that has not answered by then misses the step."""
RETURN_S = 20.0
"""How long to wait for a process that was started, or for the roster after world-sim was."""
_COME_BACK_S = 3.0
"""How soon whoever is cut off because world-sim was frozen is back."""
_PROGRESS_S = 0.2
_POLL_S = 0.02
_CLOCK_TOLERANCE_NS = 500_000_000
"""Wall, in real time: how far ahead of world-sim's clock a robot's may be."""
_SKEW_MAX_NS = 2**52
_NEVER_NS = 2**62
_STEPS_TO_DIE = 3
"""Periods after which a process that makes no step dies without one."""
_ORDERS: dict[str, Literal["freeze", "thaw", "fill", "free", "pretend"]] = {
    "pause": "freeze",
    "resume": "thaw",
    "fill": "fill",
    "free": "free",
    "pretend": "pretend",
}


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
    past: Past | None = None,
    hands: Hands | None = None,
) -> Result:
    """Run a mission to its end, or until `stopped()`. The record is closed in every case.

    show: takes what observers on the bus are told as well. past: what recording has taken already; the
    mission goes on from there. hands: who carries out the scenario's faults of processes.
    """
    doorway = _Doorway(host, plan, recording, stopped, show, hands)
    listeners = [recording.take, doorway.tell]
    if past is None:
        stage = Stage(plan.scenario, plan.seed, plan.site, listeners)
    else:
        stage = Stage.resumed(plan.scenario, plan.seed, plan.site, past.records, listeners)
        doorway.recall(past.records)
    doorway.stage = stage
    stage.forget()
    doorway.gather(plan.patience_s if past is None else RETURN_S)
    if plan.exchange == "wall":
        reason = _Relay(doorway, stage, plan, resumed=past is not None).run()
    else:
        doorway.open(lambda: stage.done_ns)
        reason = simulate(stage, _Lockstep(doorway), plan.seed, stopped)
    doorway.dismiss(reason, 0.0 if past is None else _COME_BACK_S)
    recording.refused_at_door = doorway.refused
    result = recording.finish()
    doorway.tell_progress("over", reason)
    return result


class _Doorway:
    """Who is on the bus: lets each participant in, one process at a time, and hands its messages on."""

    stage: Stage

    def __init__(
        self,
        host: Host,
        plan: Plan,
        recording: Recording,
        stopped: Callable[[], bool],
        show: Callable[[Progress], None],
        hands: Hands | None,
    ) -> None:
        self.host = host
        self.stopped = stopped
        self.hands = hands
        self.ready: dict[ParticipantId, str] = {}
        """Nonce of the process that plays each participant and has its mission."""
        self.told: dict[ParticipantId, Ready] = {}
        """What each said when it got ready last."""
        self.visits: dict[ParticipantId, int] = dict.fromkeys(plan.scenario.roster, 0)
        """How often each has got ready."""
        self.excused: set[ParticipantId] = set()
        """Those that a fault has killed or frozen, or that are late; nobody minds that they are not there."""
        self.newcomers: deque[ParticipantId] = deque()
        """Who has got ready; for whoever keeps the time."""
        self.refused = 0
        """Messages that were malformed, or from a process that does not play that participant."""
        self._plan = plan
        self._run = recording.run
        self._metrics: Following = recording.metrics
        self._show = show
        self._admission = Admission(plan.scenario.roster)
        self._met: set[str] = set()
        """Nonces of the processes that have got ready."""
        self._away: set[ParticipantId] = set()
        """Those that left without an excuse, or never came."""
        self._doubtful: set[ParticipantId] = set()
        """Those that may seem to have left because world-sim itself was frozen."""
        self._looked_s = time.monotonic()
        self._sure_s = 0.0
        """When it is clear who has left."""
        self._clock: Callable[[], int] | None = None
        self._shown = 0.0
        self._starts = Array.of(plan.site.starts_m)
        self._samples = Array.of(plan.site.samples_m)
        self.recall(())

    def recall(self, records: tuple[Record, ...]) -> None:
        """Know who is excused and who is away from what is on record."""
        self.excused = set(late(self._plan.scenario))
        stopped = {"kill"} if self._plan.exchange == "lockstep" else {"kill", "pause", "slow"}
        for record in records:
            if not isinstance(record, Incident) or record.who == WORLD_SIM:
                continue
            if record.what in stopped:
                self.excused.add(record.who)
            elif record.what in {"start", "resume", "quicken"}:
                self.excused.discard(record.who)
            elif record.what == "leave":
                self._away.add(record.who)
            elif record.what == "join":
                self._away.discard(record.who)

    def gather(self, patience_s: float | None) -> None:
        """Wait for all who should be there, as long as patience lasts, and for one robot."""
        roster = self._plan.scenario.roster
        wanted = [name for name in roster if name not in self.excused | self._away]
        robots = set(self._plan.scenario.robot_ids)
        give_up = None if patience_s is None else time.monotonic() + patience_s
        while not self.stopped():
            missing = [name for name in wanted if name not in self.ready]
            late_now = give_up is not None and time.monotonic() >= give_up
            if not missing or (late_now and robots & set(self.ready)):
                break
            self._tell("waiting", ", ".join(missing))
            self.next(_PROGRESS_S)

    def open(self, clock: Callable[[], int]) -> None:
        """The mission begins, or goes on: from now on comings and goings are on record.

        clock: simulated time, for the record.
        """
        self._clock = clock
        for name in self._plan.scenario.roster:
            absent = name not in self.ready and name not in self.excused
            if absent and name not in self._away and self.stage.acted(name):
                self._note(name, "leave")
            if absent:
                self._away.add(name)
            elif name in self._away:
                self._come(name)
        self.stage.gone = self.stage.gone | self._away

    def next(self, timeout_s: float) -> tuple[ParticipantId, Report] | None:
        """The next report, or None when something else came or the timeout passed."""
        self._mind_own_absence()
        event = self.host.next(timeout_s)
        self._looked_s = time.monotonic()
        if isinstance(event, Joined):
            self._join(event)
        elif isinstance(event, Left):
            self._leave(event)
        elif isinstance(event, Heard):
            return self._hear(event)
        return None

    def dismiss(self, reason: str, patience_s: float) -> None:
        """Tell everybody that the mission is over. patience_s: for those that have yet to come back."""
        self._clock = None  # the record has ended
        self._doubtful.clear()
        give_up = time.monotonic() + patience_s
        waiting = set(self._plan.scenario.roster)
        while waiting:
            for name in sorted(filter(self.is_there, waiting)):
                self.host.send(name, encode(Stop(VERSION, reason)), patiently=True)
                waiting.discard(name)
            waiting -= self.excused
            if time.monotonic() >= give_up:
                return
            self.next(_POLL_S)

    def _mind_own_absence(self) -> None:
        """Who left while world-sim itself was frozen gets time to come back."""
        now_s = time.monotonic()
        if now_s - self._looked_s > LEASE_MS * 0.5e-3:
            self._sure_s = now_s + _COME_BACK_S
        elif self._doubtful and now_s >= self._sure_s:
            for name in sorted(self._doubtful):
                self._lose(name)
            self._doubtful.clear()

    def is_expected(self, name: ParticipantId) -> bool:
        """Whether a participant may answer."""
        return name in self.ready or name in self._doubtful

    def is_there(self, name: ParticipantId) -> bool:
        """Whether a process that plays a participant is on the bus."""
        return self._admission.player(name) is not None

    def _join(self, event: Joined) -> None:
        name, nonce = event
        entry = self._admission.join(name, nonce)
        if entry is Entry.UNKNOWN:
            self.refused += 1
        elif (
            entry is Entry.BACK and nonce in self._met
        ):  # it was frozen or cut off and has its mission
            self._arrive(name, nonce)
        elif entry in {Entry.NEW, Entry.BACK}:
            self._brief(event)
        else:
            self._refuse(event, REFUSALS[entry])

    def _refuse(self, event: Joined, reason: str) -> None:
        refusal = Refusal(VERSION, event.nonce, reason)
        self.host.send(event.name, encode(refusal), patiently=True)

    def _brief(self, event: Joined) -> None:
        plan = self._plan
        mission = Mission(
            VERSION,
            event.nonce,
            msgspec.structs.replace(plan.scenario, faults=()),  # nobody knows what is to come
            plan.seed,
            self._starts,
            self._samples,
            plan.exchange,
            plan.site.ground and plan.site.ground.frame,
            self._run,
            self.stage.body(event.name),
        )
        self.host.send(event.name, encode(mission), patiently=True)

    def _leave(self, event: Left) -> None:
        name = event.name
        if not self._admission.leave(name, event.nonce) or self.ready.pop(name, None) is None:
            return
        if self._clock is None or name in self.excused:
            return
        if time.monotonic() < self._sure_s:
            self._doubtful.add(name)
        else:
            self._lose(name)

    def _lose(self, name: ParticipantId) -> None:
        self._away.add(name)
        self.stage.gone = self.stage.gone | {name}
        self._note(name, "leave")

    def _hear(self, event: Heard) -> tuple[ParticipantId, Report] | None:
        try:
            message = decode_from_participant(event.payload)
        except RefusedError:
            self.refused += 1
            return None
        if not self._admission.plays(event.name, message.nonce):
            self.refused += 1
            return None
        if isinstance(message, Ready):
            self._get_ready(event.name, message)
            return None
        return (event.name, message) if event.name in self.ready else None

    def _get_ready(self, name: ParticipantId, message: Ready) -> None:
        if not _follows(message, self.stage.body(name)):
            self._refuse(
                Joined(name, message.nonce),
                "has another past than this run; delete its diary and start it again",
            )
            return
        self.told[name] = message
        self._arrive(name, message.nonce)

    def _arrive(self, name: ParticipantId, nonce: str) -> None:
        self.ready[name] = nonce
        self._met.add(nonce)
        self.visits[name] += 1
        self._doubtful.discard(name)
        if self._clock is not None and name in self._away:
            self._come(name)
        self.newcomers.append(name)

    def _come(self, name: ParticipantId) -> None:
        self._away.discard(name)
        self.stage.gone = self.stage.gone - {name}
        self._note(name, "join")

    def _note(self, name: ParticipantId, what: str) -> None:
        """Put on record what nobody ordered."""
        assert self._clock is not None
        now_ns, told = max(self._clock(), self.stage.now_ns), self.told.get(name)
        step = epoch = 0
        if what == "join" and told is not None:  # one that was only frozen has told it long ago
            step, epoch = max(told.step, self.stage.body(name).step), told.epoch
        self.stage.note(Incident(now_ns, name, what, -1, step, epoch))

    def go(self, name: ParticipantId, now_ns: int, speed: float, skew_ns: int) -> None:
        """Wall: start a participant's clock, or set the one that its machine reads."""
        look = self.stage.look(name)
        message = Go(VERSION, self.ready[name], now_ns, speed, look, skew_ns)
        self.host.send(name, encode(message), patiently=True)

    def tell(self, _record: object) -> None:
        """Publish progress now and then, once the mission has begun."""
        if self._clock is not None:
            self._tell("running", "")

    def tell_progress(self, phase: str, detail: str) -> None:
        """Publish progress now."""
        self._shown = 0.0
        self._tell(phase, detail)

    def _tell(self, phase: str, detail: str) -> None:
        now = time.monotonic()
        if now - self._shown >= _PROGRESS_S:
            self._shown = now
            message = progress(self._metrics, self._plan.scenario, phase, detail)
            self.host.publish_progress(encode(message))
            self._show(message)


def needs_hands(scenario: Scenario, exchange: str) -> str | None:
    """The first fault that only whoever has started the processes can carry out, as `faults[i]: kind`."""
    real = (Kill, Late, Impostor) if exchange == "lockstep" else OnProcesses
    for i, fault in enumerate(scenario.faults):
        if isinstance(fault, real) and not isinstance(fault, Clock):
            return f"faults[{i}]: {kind_of(fault)}"
    return None


def late(scenario: Scenario) -> Iterator[ParticipantId]:
    """Participants that are not there from the start."""
    for fault in scenario.faults:
        if isinstance(fault, Late):
            yield from fault.who


def _follows(ready: Ready, body: Body) -> bool:
    """Whether a process goes on from where the world is: at most a step ahead, or one incarnation."""
    reborn = ready.epoch == body.epoch + 1
    return (ready.epoch == body.epoch or reborn) and ready.step - body.step in {0, 1}


class _Lockstep:
    """The crew over the bus, with a barrier: everybody due steps, then all go on together."""

    def __init__(self, doorway: _Doorway) -> None:
        self._doorway = doorway

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all of a batch. Whoever comes back meanwhile is asked again."""
        doorway = self._doorway
        outputs: dict[ParticipantId, Outputs] = {}
        asked: dict[ParticipantId, int] = {}
        give_up = time.monotonic() + BARRIER_S
        while time.monotonic() < give_up:
            for name in inputs:
                visit = doorway.visits[name]
                if name in doorway.ready and name not in outputs and asked.get(name) != visit:
                    asked[name] = visit
                    doorway.host.send(name, encode(Turn(VERSION, inputs[name])), patiently=True)
            if all(name in outputs or not doorway.is_expected(name) for name in inputs):
                break
            report = doorway.next(0.05)
            while report is not None:
                name, step = report[0], report[1].outputs.step
                if name in inputs and step == inputs[name].observation.step + 1:
                    outputs[name] = report[1].outputs
                report = doorway.next(0.0)
        doorway.newcomers.clear()  # they start no clock
        return outputs

    def kill(self, name: ParticipantId) -> None:
        """End a process; world-sim's own does not return from here."""
        doorway = self._doorway
        if name == WORLD_SIM:
            self._order(Order("restart", WORLD_SIM))
            return
        doorway.excused.add(name)
        self._order(Order("kill", name))
        _await(doorway, lambda: not doorway.is_there(name), f"{name} was killed and is still there")

    def start(self, name: ParticipantId, body: Body, disk: Disk) -> tuple[int, int]:
        """Start a process, and wait until it is ready."""
        doorway, visit = self._doorway, self._doorway.visits[name]
        self._order(Order("start", name, disk, body.step))
        _await(
            doorway, lambda: doorway.visits[name] > visit, f"{name} was started and did not come"
        )
        doorway.excused.discard(name)
        told = doorway.told[name]
        return told.epoch, told.step

    def pretend(self, name: ParticipantId) -> bool:
        """Start a second process under an id, and see whether it is sent away."""
        self._order(Order("pretend", name))
        refused: bool | None = None

        def ended() -> bool:
            nonlocal refused
            refused = self._order(Order("refused", name))
            return refused is not None

        _await(self._doorway, ended, f"{name}: what became of the impostor?")
        return not refused

    def _order(self, order: Order) -> bool | None:
        hands = self._doorway.hands
        assert hands is not None, "faults of processes need hands"
        return hands(order)


def _await(doorway: _Doorway, done: Callable[[], bool], complaint: str) -> None:
    """Serve the doorway until something has happened. Raises BusError."""
    give_up = time.monotonic() + RETURN_S
    while not done():
        if time.monotonic() >= give_up:
            raise BusError(f"{complaint}; see the logs")
        doorway.next(_POLL_S)


class _Relay:
    """The wall exchange: every participant steps by its own clock.

    What it sends is ruled on and passed on when it arrives. Every inbox is recorded as the
    participant reports it. A step is accepted once, and the next only after it: until a participant has been
    told, it holds, and says its report again.
    """

    def __init__(self, doorway: _Doorway, stage: Stage, plan: Plan, *, resumed: bool) -> None:
        self._doorway = doorway
        self._stage = stage
        self._speed = plan.speed
        self._period_ns = plan.scenario.period_ns
        self._limit_ns = plan.scenario.limit_ns
        self._mail = {name: _Mail() for name in plan.scenario.roster}
        self._skews = dict.fromkeys(plan.scenario.roster, 0)
        """How far ahead each clock was told to be."""
        self._deeds = _Deeds(doorway, stage, plan)
        start_ns = self._resumed_ns() if resumed else 0
        self._origin_ns = time.monotonic_ns() - round(start_ns / self._speed)

    def _resumed_ns(self) -> int:
        """Have what was handed out before as it may be heard of yet; and the time to go on from."""
        stage, doorway = self._stage, self._doorway
        for name, mail in self._mail.items():
            mail.handed += stage.inputs(name, _NEVER_NS).inbox
        before_ns = stage.now_ns
        told_ns = max((told.now_ns for told in doorway.told.values()), default=0)
        start_ns = max(before_ns, told_ns, self._deeds.world_starts_ns or 0)
        if self._deeds.world_starts_ns is None:
            stage.note(Incident(before_ns, WORLD_SIM, "leave"))
            stage.note(Incident(start_ns, WORLD_SIM, "join"))
        return start_ns

    def run(self) -> str:
        doorway, deeds = self._doorway, self._deeds
        doorway.open(lambda: self._now_ns)
        deeds.do(self._now_ns)
        doorway.newcomers = deque(doorway.ready)
        while True:
            reason = self._reason()
            if reason is not None:
                self._stage.end(reason)
                return reason
            while doorway.newcomers:
                self._welcome(doorway.newcomers.popleft())
            report = doorway.next(self._patience_s())
            deeds.do(self._now_ns)
            if not deeds.world_is_down:  # what is said now is said again
                if report is not None:
                    self._settle(*report)
                self._deliver()

    @property
    def _now_ns(self) -> int:
        """Simulated time; it does not run back, whatever the clocks are."""
        by_clock_ns = round((time.monotonic_ns() - self._origin_ns) * self._speed)
        return max(by_clock_ns, self._stage.now_ns)

    def _reason(self) -> str | None:
        if self._stage.over:
            return self._stage.over
        if self._doorway.stopped():
            return "interrupted"
        return "limit" if self._now_ns > self._limit_ns else None

    def _patience_s(self) -> float:
        """Real seconds until there is something to do."""
        now_ns = self._now_ns
        due_ns = (self._stage.channel.next_due_ns(), self._deeds.next_ns(now_ns))
        waits_s = [(due - now_ns) * 1e-9 / self._speed for due in due_ns if due is not None]
        longest_s = _POLL_S if self._deeds.busy else _PROGRESS_S
        return min(longest_s, max(0.0, min(waits_s, default=longest_s)))

    def _welcome(self, name: ParticipantId) -> None:
        """Start the clock of whoever has got ready."""
        if name in self._doorway.ready:
            self._deeds.welcome(name)
            self._set_clock(name, self._now_ns)

    def _set_clock(self, name: ParticipantId, now_ns: int) -> None:
        self._skews[name] = self._deeds.skew_ns(name, now_ns)
        self._doorway.go(name, now_ns, self._speed, self._skews[name])

    def _settle(self, name: ParticipantId, report: Report) -> None:
        known = self._stage.body(name).step
        if report.outputs.step <= known:  # it has not heard yet that this was accepted
            self._hand(name)
        elif not self._deeds.dies(name):
            inputs = self._inputs(name, known, report)
            if inputs is None:
                self._doorway.refused += 1
                return
            self._stage.settle(self._now_ns, [Step(name, inputs, report.outputs, report.skew_ns)])
            self._hand(name)

    def _inputs(self, name: ParticipantId, known: int, report: Report) -> Inputs | None:
        """The inputs that the participant says it had, if it can have had them."""
        ahead_ns = report.now_ns - self._now_ns
        if report.observed != known or report.outputs.step != known + 1:
            return None
        if ahead_ns > _CLOCK_TOLERANCE_NS * self._speed or abs(report.skew_ns) > _SKEW_MAX_NS:
            return None
        inbox = self._mail[name].heard(report.heard)
        if inbox is None:
            return None
        return Inputs(report.now_ns + report.skew_ns, self._stage.look(name), inbox)

    def _deliver(self) -> None:
        """Hand on what is due at anybody."""
        due_ns, now_ns = self._stage.channel.next_due_ns(), self._now_ns
        if due_ns is None or due_ns > now_ns:
            return
        for name in self._stage.scenario.roster:
            if self._stage.channel.waits(name, now_ns):
                self._hand(name)

    def _hand(self, name: ParticipantId) -> None:
        """Tell a participant where it is, and hand it what has arrived."""
        now_ns, mail = self._now_ns, self._mail[name]
        given = self._stage.inputs(name, now_ns)
        mail.waiting += given.inbox
        if self._deeds.is_frozen(name):
            return  # it waits
        if name not in self._doorway.ready:
            mail.waiting.clear()  # what reaches nobody is lost
            return
        if self._deeds.skew_ns(name, now_ns) != self._skews[name]:
            self._set_clock(name, now_ns)
        turn = Turn(VERSION, msgspec.structs.replace(given, inbox=mail.hand()))
        self._doorway.host.send(name, encode(turn), patiently=False)


class _Mail:
    """What has arrived for a participant. Neither queue is longer than an inbox may be."""

    def __init__(self) -> None:
        self.waiting: deque[Envelope] = deque(maxlen=INBOX_MAX)
        """Not handed to it yet."""
        self.handed: deque[Envelope] = deque()
        """Handed to it, and not heard as far as is known, in order."""

    def hand(self) -> tuple[Envelope, ...]:
        """What is to be handed out now."""
        room = max(0, INBOX_MAX - len(self.handed))
        inbox = tuple([self.waiting.popleft() for _ in range(min(room, len(self.waiting)))])
        self.handed += inbox
        return inbox

    def heard(
        self, references: tuple[tuple[ParticipantId, int], ...]
    ) -> tuple[Envelope, ...] | None:
        """The inbox of these envelopes, if they were handed out in this order; what was skipped is lost."""
        inbox: list[Envelope] = []
        skipped = 0
        for envelope in self.handed:
            if len(inbox) == len(references):
                break
            skipped += 1
            if (envelope.source, envelope.sequence) == references[len(inbox)]:
                inbox.append(envelope)
        if len(inbox) < len(references):
            return None
        if references:
            self.handed = deque(islice(self.handed, skipped, None))
        return tuple(inbox)


class _Deeds:
    """The faults of processes on the wall: one deed after the other, and on record when it is done."""

    def __init__(self, doorway: _Doorway, stage: Stage, plan: Plan) -> None:
        self._doorway = doorway
        self._stage = stage
        self._scenario = plan.scenario
        self._speed = plan.speed
        self._outages = Outages(plan.scenario, done=stage.deeds)
        self._deed: Deed | None = None
        """What has been begun and is not done."""
        self._since_s = 0.0
        self._visit = 0
        self.world_is_down = False
        """On record it has not gone on yet."""
        self._paused: set[ParticipantId] = set()
        self._slow: set[ParticipantId] = set()
        self._held: set[ParticipantId] = set()
        """Those of the slow that are stopped now."""
        deeds = deeds_of(plan.scenario)
        for deed in deeds[: stage.deeds]:
            self._keep_count(deed)
        for name in sorted(self._slow):
            self._order(Order("thaw", name))  # the process before this one may have held it
        self.world_starts_ns = _world_starts_ns(deeds, stage.deeds)
        """When world-sim is to start again, if a fault has killed it."""

    @property
    def busy(self) -> bool:
        """Whether a deed is under way."""
        return self._deed is not None

    def next_ns(self, now_ns: int) -> int | None:
        """When there is something to do."""
        due_ns = None if self.busy else self._outages.next_ns
        if not self._slow:
            return due_ns
        period_ns = self._scenario.period_ns
        turn_ns = (now_ns // period_ns + 1) * period_ns
        return turn_ns if due_ns is None else min(due_ns, turn_ns)

    def skew_ns(self, name: ParticipantId, now_ns: int) -> int:
        """How far ahead a clock is to be."""
        return self._outages.skew_ns(name, now_ns)

    def is_frozen(self, name: ParticipantId) -> bool:
        """Whether a participant is stopped, or is back from that in a moment."""
        if name in self._paused or name in self._held:
            return True
        return name in self._slow and name not in self._doorway.ready

    def dies(self, name: ParticipantId) -> bool:
        """Kill a participant that was to die in this step, of which nobody hears."""
        deed = self._deed
        if deed is None or (deed.what, deed.who) != ("kill", name) or not deed.mid_step:
            return False
        self._order(Order("kill", name))
        return True

    def welcome(self, name: ParticipantId) -> None:
        """Whoever is there again is excused no more, unless it is about to go."""
        going = self._deed is not None and (self._deed.what, self._deed.who) == ("kill", name)
        if not going and name not in self._paused | self._slow:
            self._doorway.excused.discard(name)

    def do(self, now_ns: int) -> None:
        """Do what is due."""
        for name in sorted(self._slow):
            self._hold(name, held=self._outages.idle(name, now_ns))
        while self._deed is None or self._is_done(self._deed, now_ns):
            self._deed = None
            due_ns = self._outages.next_ns
            if due_ns is None or due_ns > now_ns:
                return
            self._deed = self._outages.pop()
            self._begin(self._deed, now_ns)

    def _begin(self, deed: Deed, now_ns: int) -> None:
        self._since_s = time.monotonic()
        who, doorway = deed.who, self._doorway
        self._keep_count(deed)
        if who == WORLD_SIM:
            self._begin_on_world_sim(deed, now_ns)
        elif deed.what == "kill":
            doorway.excused.add(who)
            if not deed.mid_step:
                self._order(Order("kill", who))
        elif deed.what == "start":
            self._visit = doorway.visits[who]
            self._order(Order("start", who, deed.disk, self._stage.body(who).step))
        elif deed.what in {"slow", "quicken"}:
            doorway.excused.add(who)
            self._hold(who, held=False)
        elif deed.what in _ORDERS:
            if deed.what == "pause":
                doorway.excused.add(who)
            self._order(Order(_ORDERS[deed.what], who))

    def _begin_on_world_sim(self, deed: Deed, now_ns: int) -> None:
        end_ns = self._scenario.faults[deed.fault].until_ns or now_ns
        after_s = max(0.0, (end_ns - now_ns) * 1e-9 / self._speed)
        if deed.what == "kill":
            self._note(deed, deed.what, now_ns)  # there is no later
            self._order(Order("restart", WORLD_SIM, after_s=after_s))
        elif deed.what == "pause":
            self._order(Order("rest", WORLD_SIM, after_s=after_s))

    def _is_done(self, deed: Deed, now_ns: int) -> bool:
        """Whether a deed is done; then it is on record."""
        doorway, who = self._doorway, deed.who
        waited_s = time.monotonic() - self._since_s
        what: str = deed.what
        epoch = step = 0
        if who == WORLD_SIM:
            done = True
        elif deed.what == "kill":
            done = not doorway.is_there(who)
            if deed.mid_step and waited_s > _STEPS_TO_DIE * self._period_s:
                self._order(Order("kill", who))  # it makes no more steps
        elif deed.what == "start":
            done = doorway.visits[who] > self._visit
            if done:
                epoch, step = doorway.told[who].epoch, doorway.told[who].step
        elif deed.what == "pretend":
            refused = self._order(Order("refused", who))
            done, what = refused is not None, "pretend" if refused else "let in"
        else:
            done = True
        if done:
            self._note(deed, what, now_ns, epoch, step)
        elif waited_s > RETURN_S + _STEPS_TO_DIE * self._period_s:
            raise BusError(f"{who}: {deed.what} does not come to an end; see the logs")
        return done

    @property
    def _period_s(self) -> float:
        return self._scenario.period_ns * 1e-9 / self._speed

    def _note(self, deed: Deed, what: str, now_ns: int, epoch: int = 0, step: int = 0) -> None:
        now_ns = max(now_ns, self._stage.now_ns)
        self._stage.note(Incident(now_ns, deed.who, what, deed.fault, step, epoch))

    def _keep_count(self, deed: Deed) -> None:
        """Know who is stopped by what."""
        if deed.who == WORLD_SIM:
            self.world_is_down = deed.what in {"kill", "pause"}
        elif deed.what == "pause":
            self._paused.add(deed.who)
        elif deed.what == "resume":
            self._paused.discard(deed.who)
        elif deed.what == "slow":
            self._slow.add(deed.who)
        elif deed.what == "quicken":
            self._slow.discard(deed.who)

    def _hold(self, name: ParticipantId, *, held: bool) -> None:
        if held != (name in self._held):
            self._order(Order("freeze" if held else "thaw", name))
            (self._held.add if held else self._held.discard)(name)

    def _order(self, order: Order) -> bool | None:
        assert self._doorway.hands is not None, "faults of processes need hands"
        return self._doorway.hands(order)


def _world_starts_ns(deeds: list[Deed], done: int) -> int | None:
    """When world-sim starts again, if it has been killed by then."""
    of_world = [(i, deed) for i, deed in enumerate(deeds) if deed.who == WORLD_SIM]
    killed = [deed.what for i, deed in of_world if i < done and deed.what in {"kill", "start"}]
    if killed[-1:] != ["kill"]:
        return None
    return next(deed.at_ns for i, deed in of_world if i >= done and deed.what == "start")


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
