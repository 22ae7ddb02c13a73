"""The lobby: membership of participants' processes to the bus, and the messages that they send.

Every message of a participant passes through the lobby, which drops what is malformed or comes from a process that
does not play the participant. The exchanges learn from it which participants are ready.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable

import msgspec

from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import EVERYBODY, WORLD_SIM, Body, Outputs, ParticipantId
from kantor_protocol.scenario.faults.liars import lies_of
from kantor_protocol.transport.events import Event, Flooded, Joined, Left, Received
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.transport.session import LEASE_MS, BusError
from kantor_protocol.wire.attestations import Identities
from kantor_protocol.wire.messages import (
    VERSION,
    Array,
    Mission,
    Ready,
    Refusal,
    RefusedError,
    Report,
    StartClock,
    StepRequest,
    Stop,
    decode_from_participant,
    encode,
)
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.admission import Admission
from kantor_worldsim.exchange.config import MissionConfig, late_participants
from kantor_worldsim.exchange.membership import REFUSALS, JoinDecision, Membership
from kantor_worldsim.observers.metrics.result import RefusedReports
from kantor_worldsim.observers.progress import PROGRESS_S, ProgressReporter
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.record.records import ProcessEvent, Record

RETURN_S = 20.0
"""Timeout for a process that was started, and for the roster after world-sim was."""
COME_BACK_S = 3.0
"""Time in which a process that was disconnected because world-sim was frozen connects again."""
RETRY_S = 1.0
"""After so long, a process that has not answered is sent its message again. Behind a site's router a process may be
seen before it can be reached."""
POLL_S = 0.02
"""Interval at which an awaited condition is checked."""
_REASONS_MAX = 5
"""Reasons for refused reports of one participant that are kept."""


class Lobby:
    """Admits one process at a time for each participant, and passes its messages on."""

    def __init__(
        self,
        host: HubRouter,
        config: MissionConfig,
        run: str,
        simulation: Simulation,
        reporter: ProgressReporter,
        stopped: Callable[[], bool],
        say: Callable[[str], None],
        admission: Admission | None = None,
        identities: Identities | None = None,
    ) -> None:
        """run: the run's name, which processes compare with that in their write-ahead log. say: prints a line.

        admission: has observed all records so far; by default one of a mission that begins. identities: with
        `trust = "signed"`.
        """
        self.refused = 0
        """Messages that were malformed, or from a process that does not play that participant."""
        self._host = host
        self._config = config
        self._run = run
        self._simulation = simulation
        self._reporter = reporter
        self._stopped = stopped
        self._say = say
        self._admission = admission or Admission(config.scenario, config.setup, identities)
        self._keys = identities.keys if identities is not None else {}
        self._refused_reports: dict[ParticipantId, RefusedReports] = {}
        self._silences: dict[ParticipantId, int] = {}
        self._unsound: set[ParticipantId] = set()
        """Participants whose last report was refused."""
        self._membership = Membership(config.scenario.roster)
        self._ready: dict[ParticipantId, str] = {}
        """Nonce of the process that plays each ready participant: on the bus, and with its mission."""
        self._last_ready: dict[ParticipantId, Ready] = {}
        """The last Ready message of each participant."""
        self._ready_at_ns: dict[ParticipantId, int] = {}
        """When it came, by the monotonic clock."""
        self._arrivals: dict[ParticipantId, int] = dict.fromkeys(config.scenario.roster, 0)
        """Number of times that each participant became ready."""
        self._excused: set[ParticipantId] = set()
        """Participants that a fault has killed or frozen, or that are late: their absence is no event."""
        self._share = 1.0 / max(1, len(config.scenario.roster) - 1)
        """Work of an envelope to one participant, over that of one to the whole team."""
        self._gathered: deque[Event] = deque()
        """Events that have come, and wait until the reports before them are settled."""
        self._newcomers: deque[ParticipantId] = deque()
        """Participants that became ready, until the exchange asks for them."""
        self._briefed_s: dict[ParticipantId, float] = {}
        """Time at which each present participant that is not ready was sent its mission."""
        self._away: set[ParticipantId] = set()
        """Participants that left without an excuse, or never came."""
        self._doubtful: set[ParticipantId] = set()
        """Participants that have left and may come back: in lockstep all, otherwise while world-sim may itself have
        been frozen."""
        self._is_lockstep = config.exchange == "lockstep"
        self._checked_s = time.monotonic()
        self._certain_s = 0.0
        """Time from which on an absence is certain."""
        self._clock: Callable[[], int] | None = None
        """Simulated time for events on record; None before the mission and after it."""
        self._starts = Array.of(config.setup.starts_m)
        self._samples = Array.of(config.setup.samples_m)
        self._excused |= set(late_participants(config.scenario))

    def recall(self, records: Iterable[Record]) -> None:
        """Restore from the records of a resumed run which participants are excused and which are away."""
        stops = {ProcessEventKind.KILL}
        if self._config.exchange == "wall":
            stops |= {ProcessEventKind.PAUSE, ProcessEventKind.SLOW}
        for record in records:
            if not isinstance(record, ProcessEvent) or record.who == WORLD_SIM:
                continue
            match record.kind:
                case kind if kind in stops:
                    self._excused.add(record.who)
                case ProcessEventKind.START | ProcessEventKind.RESUME | ProcessEventKind.QUICKEN:
                    self._excused.discard(record.who)
                case ProcessEventKind.LEAVE:
                    self._away.add(record.who)
                case ProcessEventKind.JOIN:
                    self._away.discard(record.who)

    def gather(self, timeout_s: float | None) -> None:
        """Wait for all participants that are expected; after the timeout, for at least one robot."""
        wanted = [
            name for name in self._config.scenario.roster if name not in self._excused | self._away
        ]
        robots = set(self._config.scenario.robot_ids)
        give_up = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._stopped():
            missing = [name for name in wanted if name not in self._ready]
            timed_out = give_up is not None and time.monotonic() >= give_up
            if not missing or (timed_out and robots & set(self._ready)):
                break
            self._reporter.report("waiting", ", ".join(missing))
            self.next(PROGRESS_S)

    def open(self, clock: Callable[[], int]) -> None:
        """Begin or resume the mission: from now on arrivals and departures are on record.

        clock: simulated time, for the record.
        """
        self._clock = clock
        self._reporter.running = True
        for name in self._config.scenario.roster:
            absent = name not in self._ready and name not in self._excused
            if absent and name not in self._away and self._simulation.acted(name):
                self._note(name, ProcessEventKind.LEAVE)
            elif not absent and self._is_reborn(name):
                self._lose(name)
            if absent:
                self._away.add(name)
            elif name in self._away:
                self._come_back(name)
        self._simulation.leave(self._away)

    def next(self, timeout_s: float) -> tuple[ParticipantId, Report] | None:
        """The next report, or None when something else came or the timeout passed."""
        self._settle_doubts()
        self._brief_again()
        event = self._gathered.popleft() if self._gathered else self._host.next(timeout_s)
        self._checked_s = time.monotonic()
        return self._take(event)

    def reports(self, timeout_s: float, every_s: float) -> list[tuple[ParticipantId, Report]]:
        """The reports that have come, none after an arrival or a departure that came later than them.

        Waits up to the timeout if nothing has come, and until `every_s` after the last ones.
        """
        self._settle_doubts()
        self._brief_again()
        if not self._gathered:
            self._gathered.extend(self._host.drain(timeout_s, every_s))
        self._checked_s = time.monotonic()
        reports: list[tuple[ParticipantId, Report]] = []
        while self._gathered and (not reports or isinstance(self._gathered[0], Received)):
            report = self._take(self._gathered.popleft())
            if report is not None:
                reports.append(report)
        return reports

    def _take(self, event: Event | None) -> tuple[ParticipantId, Report] | None:
        match event:
            case Joined():
                self._join(event)
            case Left():
                self._leave(event)
            case Received():
                return self._receive(event)
            case Flooded():
                self._say(f"{event.name} floods the bus; what is beyond its quota is not taken in")
        return None

    def wait_for(self, done: Callable[[], bool], complaint: str) -> None:
        """Serve the lobby until something has happened. Raises BusError after RETURN_S."""
        give_up = time.monotonic() + RETURN_S
        while not done():
            if time.monotonic() >= give_up:
                raise BusError(f"{complaint}; see the logs")
            self.next(POLL_S)

    def dismiss(self, reason: str, timeout_s: float) -> None:
        """Tell all participants that the mission is over. timeout_s: for those that have yet to come back."""
        self._clock = None  # the record has ended
        self._reporter.running = False
        self._doubtful.clear()
        give_up = time.monotonic() + timeout_s
        waiting = set(self._config.scenario.roster)
        while waiting:
            for name in sorted(filter(self.is_present, waiting)):
                self._host.send(name, encode(Stop(VERSION, reason)), blocking=True)
                waiting.discard(name)
            waiting -= self._excused
            if time.monotonic() >= give_up:
                return
            self.next(POLL_S)

    # For the exchanges.

    @property
    def roster(self) -> tuple[ParticipantId, ...]:
        """All participants of the mission."""
        return self._config.scenario.roster

    def has_left(self, name: ParticipantId) -> bool:
        """Lockstep: whether a participant has left the bus, and has not been given up."""
        return name in self._doubtful

    def give_up(self, name: ParticipantId) -> None:
        """Lockstep: put on record that a participant has left."""
        self._doubtful.discard(name)
        self._lose(name)

    def is_ready(self, name: ParticipantId) -> bool:
        """Whether a participant's process is on the bus and has its mission."""
        return name in self._ready

    def is_expected(self, name: ParticipantId) -> bool:
        """Whether a participant may answer, and has not just answered with what is refused."""
        return name in self._ready.keys() | self._doubtful and name not in self._unsound

    def is_present(self, name: ParticipantId) -> bool:
        """Whether a process that plays a participant is on the bus."""
        return self._membership.player(name) is not None

    def arrivals(self, name: ParticipantId) -> int:
        """Number of times that a participant became ready."""
        return self._arrivals[name]

    def last_ready(self, name: ParticipantId) -> Ready:
        """The last Ready message of a participant that has been ready."""
        return self._last_ready[name]

    def running_ns(self, speed: float) -> int:
        """The simulated time now by the clocks of those that became ready: their median, which no single one can push.

        0 if no clock runs. speed: simulated seconds in a real one.
        """
        now_ns, ready = time.monotonic_ns(), self._last_ready.items()
        running_ns = sorted(
            message.now_ns + round((now_ns - self._ready_at_ns[name]) * speed)
            for name, message in ready
            if message.now_ns > 0
        )
        return running_ns[(len(running_ns) - 1) // 2] if running_ns else 0

    def excuse(self, name: ParticipantId) -> None:
        """Expect a participant to be absent, because of a fault."""
        self._excused.add(name)

    def expect(self, name: ParticipantId) -> None:
        """Expect a participant to be present again."""
        self._excused.discard(name)

    def pop_newcomer(self) -> ParticipantId | None:
        """The next participant that became ready, each time once."""
        return self._newcomers.popleft() if self._newcomers else None

    def announce_all(self) -> None:
        """Let all ready participants be newcomers once more."""
        self._newcomers = deque(self._ready)

    def forget_newcomers(self) -> None:
        """Drop the newcomers; in lockstep no clock is started for them."""
        self._newcomers.clear()

    @property
    def refused_reports(self) -> dict[ParticipantId, RefusedReports]:
        """The reports that were refused, of each participant that sent any."""
        return dict(self._refused_reports)

    @property
    def silences(self) -> dict[ParticipantId, int]:
        """How often each participant did not answer in time, of those that ever did not."""
        return dict(self._silences)

    def note_silence(self, name: ParticipantId) -> None:
        """Count that a participant did not answer in time, and name it, once."""
        if name not in self._silences:
            self._say(f"{name} does not answer; the others go on without it until it does")
        self._silences[name] = self._silences.get(name, 0) + 1

    def grant_reply(self, name: ParticipantId) -> None:
        """Let a participant answer its next step request, whatever its quota says."""
        self._host.grant_reply(name)

    def request(self, name: ParticipantId, request: StepRequest, *, blocking: bool) -> None:
        """Send a participant a step request."""
        self._host.send(name, encode(request), blocking=blocking)

    def start_clock(self, name: ParticipantId, now_ns: int, speed: float, skew_ns: int) -> None:
        """Realtime: start a ready participant's clock, or set it."""
        look = self._simulation.look(name)
        message = StartClock(VERSION, self._ready[name], now_ns, speed, look, skew_ns)
        self._host.send(name, encode(message), blocking=True)

    # Arrivals and departures.

    def _settle_doubts(self) -> None:
        """Give processes that were disconnected while world-sim itself was frozen time to connect again."""
        if self._is_lockstep:
            return  # it decides itself how long it waits
        now_s = time.monotonic()
        if now_s - self._checked_s > LEASE_MS * 0.5e-3:
            self._certain_s = now_s + COME_BACK_S
        elif self._doubtful and now_s >= self._certain_s:
            for name in sorted(self._doubtful):
                self._lose(name)
            self._doubtful.clear()

    def _join(self, event: Joined) -> None:
        name, nonce = event
        decision = self._membership.join(name, nonce)
        ready = self._last_ready.get(name)
        has_mission = ready is not None and ready.nonce == nonce  # it was frozen or disconnected
        if decision is JoinDecision.UNKNOWN:
            self.refused += 1
        elif decision is JoinDecision.BACK and has_mission:
            self._arrive(name, nonce)
        elif decision in {JoinDecision.NEW, JoinDecision.BACK}:
            self._brief(event)
        else:
            self._refuse(event, REFUSALS[decision])

    def _refuse(self, event: Joined, reason: str) -> None:
        refusal = Refusal(VERSION, event.nonce, reason)
        self._host.send(event.name, encode(refusal), blocking=True)

    def _brief_again(self) -> None:
        """Send the mission again to present participants that are not ready; it may not have reached them."""
        now_s = time.monotonic()
        due = [name for name, sent_s in self._briefed_s.items() if now_s - sent_s > RETRY_S]
        for name in due:
            nonce = self._membership.player(name)
            if nonce is None:
                del self._briefed_s[name]
            else:
                self._brief(Joined(name, nonce))

    def _brief(self, event: Joined) -> None:
        """Send a process its mission, without faults, which no participant knows ahead, but with its own lies."""
        config = self._config
        self._briefed_s[event.name] = time.monotonic()
        mission = Mission(
            VERSION,
            event.nonce,
            msgspec.structs.replace(
                config.scenario, faults=lies_of(event.name, config.scenario.faults)
            ),
            config.seed,
            self._starts,
            self._samples,
            config.exchange,
            config.setup.ground and config.setup.ground.frame,
            self._run,
            self._simulation.body(event.name),
            self._keys,
        )
        self._host.send(event.name, encode(mission), blocking=True)

    def _leave(self, event: Left) -> None:
        name = event.name
        if not self._membership.leave(name, event.nonce) or self._ready.pop(name, None) is None:
            return
        if self._clock is None or name in self._excused:
            return
        if self._is_lockstep or time.monotonic() < self._certain_s:
            self._doubtful.add(name)
        else:
            self._lose(name)

    def _lose(self, name: ParticipantId) -> None:
        self._away.add(name)
        self._simulation.leave((name,))
        self._note(name, ProcessEventKind.LEAVE)

    def _receive(self, event: Received) -> tuple[ParticipantId, Report] | None:
        try:
            message = decode_from_participant(event.payload)
        except RefusedError:
            self.refused += 1
            return None
        if not self._membership.plays(event.name, message.nonce):
            self.refused += 1
            return None
        if isinstance(message, Ready):
            self._get_ready(event.name, message)
            return None
        if event.name not in self._ready or not self._admits(event.name, message.outputs):
            return None
        return event.name, message

    def _admits(self, name: ParticipantId, outputs: Outputs) -> bool:
        """Whether the outputs in a report may be settled, or are those of a step that is settled already."""
        done = self._simulation.body(name).step
        if outputs.step <= done:
            return True
        if not self._host.charge(name, self._work_of(outputs)):
            return False
        if outputs.step == done + 1:
            reason = self._admission.refusal_reason(name, outputs)
        else:
            reason = f"step {outputs.step} after {done}"
        if reason:
            self._refuse_report(name, reason)
            return False
        self._unsound.discard(name)
        return True

    def _work_of(self, outputs: Outputs) -> float:
        """Receivers of the envelopes of a step, over those of one envelope to the whole team."""
        targets = [envelope.target for envelope in outputs.outbox]
        return sum(1.0 if target == EVERYBODY else self._share for target in targets)

    def _refuse_report(self, name: ParticipantId, reason: str) -> None:
        """Count a report that no honest participant sends, and name its sender, once."""
        self.refused += 1
        self._unsound.add(name)
        before = self._refused_reports.get(name, RefusedReports(0, ()))
        if not before.count:
            self._say(f"{name} sends what it cannot, and it is not taken in: {reason}")
        reasons = tuple(dict.fromkeys((*before.reasons, reason)))[:_REASONS_MAX]
        self._refused_reports[name] = RefusedReports(before.count + 1, reasons)

    def _get_ready(self, name: ParticipantId, message: Ready) -> None:
        if reason := _objection(message, self._simulation.body(name)):
            self._refuse(Joined(name, message.nonce), reason)
            return
        self._last_ready[name], self._ready_at_ns[name] = message, time.monotonic_ns()
        self._arrive(name, message.nonce)

    def _arrive(self, name: ParticipantId, nonce: str) -> None:
        if self._clock is not None and self._is_reborn(name):
            self._lose(name)  # its predecessor has left, and that was not seen
        self._ready[name] = nonce
        self._briefed_s.pop(name, None)
        self._arrivals[name] += 1
        self._doubtful.discard(name)
        if self._clock is not None and name in self._away:
            self._come_back(name)
        self._newcomers.append(name)

    def _is_reborn(self, name: ParticipantId) -> bool:
        """Whether a participant comes as an incarnation that is not on record, and no event will say so."""
        ready = self._last_ready.get(name)
        if ready is None or name in self._away | self._excused:
            return False
        return ready.incarnation > self._simulation.body(name).incarnation

    def _come_back(self, name: ParticipantId) -> None:
        self._away.discard(name)
        self._simulation.come_back(name)
        self._note(name, ProcessEventKind.JOIN)

    def _note(self, name: ParticipantId, kind: ProcessEventKind) -> None:
        """Record an arrival or a departure that no fault is the cause of."""
        assert self._clock is not None
        now_ns, ready = max(self._clock(), self._simulation.now_ns), self._last_ready.get(name)
        step = incarnation = 0
        if kind == ProcessEventKind.JOIN and ready is not None:
            # A process that was only frozen was ready long ago.
            step = max(ready.step, self._simulation.body(name).step)
            incarnation = ready.incarnation
        self._simulation.note(ProcessEvent(now_ns, name, kind, -1, step, incarnation))


def _objection(ready: Ready, body: Body) -> str:
    """Why a process cannot go on from the world's state; empty if it can.

    It can if it is at most one step ahead, as the same incarnation or the next one.
    """
    reborn = ready.incarnation == body.incarnation + 1
    if reborn and ready.incarnation > INCARNATIONS_MAX:
        return f"has lost its write-ahead log {INCARNATIONS_MAX} times; it takes no more part in this run"
    if (ready.incarnation == body.incarnation or reborn) and ready.step - body.step in {0, 1}:
        return ""
    return "its write-ahead log is of another run; delete its .diary file and start it again"
