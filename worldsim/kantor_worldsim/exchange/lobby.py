"""Who is on the bus: participants come through here, and so does all that they say."""

import time
from collections import deque
from collections.abc import Callable

import msgspec

from kantor_protocol.base.machine import WORLD_SIM, Body, ParticipantId
from kantor_protocol.transport.events import Flooded, Joined, Left, Received
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.transport.session import LEASE_MS, BusError
from kantor_protocol.wire.messages import (
    VERSION,
    Array,
    Mission,
    Progress,
    Ready,
    Refusal,
    RefusedError,
    Report,
    StartClock,
    Stop,
    decode_from_participant,
    encode,
)
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.config import MissionConfig, late
from kantor_worldsim.exchange.membership import REFUSALS, JoinDecision, Membership
from kantor_worldsim.exchange.process_control import ProcessController
from kantor_worldsim.observers.metrics.base import RunMetrics
from kantor_worldsim.observers.progress import progress
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.records import ProcessEvent, Record

RETURN_S = 20.0
"""How long to wait for a process that was started, or for the roster after world-sim was."""
COME_BACK_S = 3.0
"""How soon whoever is cut off because world-sim was frozen is back."""
PROGRESS_S = 0.2
"""From one word to observers to the next."""
AGAIN_S = 1.0
"""After so long, whoever is there and has not answered is told again. Behind a site's router a process may be
seen before it can be reached."""
POLL_S = 0.02
"""From one look at what is awaited to the next."""


class Lobby:
    """Who is on the bus: lets each participant in, one process at a time, and hands its messages on."""

    simulation: Simulation

    def __init__(
        self,
        host: HubRouter,
        plan: MissionConfig,
        recording: Recording,
        stopped: Callable[[], bool],
        show: Callable[[Progress], None],
        hands: ProcessController | None,
        say: Callable[[str], None],
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
        self._metrics: RunMetrics = recording.metrics
        self._show = show
        self._say = say
        self._admission = Membership(plan.scenario.roster)
        self._met: set[str] = set()
        """Nonces of the processes that have got ready."""
        self._briefed_s: dict[ParticipantId, float] = {}
        """When each that is there and not ready was told its mission."""
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
            if not isinstance(record, ProcessEvent) or record.who == WORLD_SIM:
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
            self.next(PROGRESS_S)

    def open(self, clock: Callable[[], int]) -> None:
        """The mission begins, or goes on: from now on comings and goings are on record.

        clock: simulated time, for the record.
        """
        self._clock = clock
        for name in self._plan.scenario.roster:
            absent = name not in self.ready and name not in self.excused
            if absent and name not in self._away and self.simulation.acted(name):
                self._note(name, "leave")
            if absent:
                self._away.add(name)
            elif name in self._away:
                self._come(name)
        self.simulation.gone = self.simulation.gone | self._away

    def next(self, timeout_s: float) -> tuple[ParticipantId, Report] | None:
        """The next report, or None when something else came or the timeout passed."""
        self._mind_own_absence()
        self._brief_again()
        event = self.host.next(timeout_s)
        self._looked_s = time.monotonic()
        if isinstance(event, Joined):
            self._join(event)
        elif isinstance(event, Left):
            self._leave(event)
        elif isinstance(event, Received):
            return self._hear(event)
        elif isinstance(event, Flooded):
            self._say(f"{event.name} floods the bus; what is beyond its quota is not taken in")
        return None

    def dismiss(self, reason: str, patience_s: float) -> None:
        """Tell everybody that the mission is over. patience_s: for those that have yet to come back."""
        self._clock = None  # the record has ended
        self._doubtful.clear()
        give_up = time.monotonic() + patience_s
        waiting = set(self._plan.scenario.roster)
        while waiting:
            for name in sorted(filter(self.is_there, waiting)):
                self.host.send(name, encode(Stop(VERSION, reason)), blocking=True)
                waiting.discard(name)
            waiting -= self.excused
            if time.monotonic() >= give_up:
                return
            self.next(POLL_S)

    def _mind_own_absence(self) -> None:
        """Who left while world-sim itself was frozen gets time to come back."""
        now_s = time.monotonic()
        if now_s - self._looked_s > LEASE_MS * 0.5e-3:
            self._sure_s = now_s + COME_BACK_S
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
        if entry is JoinDecision.UNKNOWN:
            self.refused += 1
        elif (
            entry is JoinDecision.BACK and nonce in self._met
        ):  # it was frozen or cut off and has its mission
            self._arrive(name, nonce)
        elif entry in {JoinDecision.NEW, JoinDecision.BACK}:
            self._brief(event)
        else:
            self._refuse(event, REFUSALS[entry])

    def _refuse(self, event: Joined, reason: str) -> None:
        refusal = Refusal(VERSION, event.nonce, reason)
        self.host.send(event.name, encode(refusal), blocking=True)

    def _brief_again(self) -> None:
        """Tell those that are there and not ready what may not have reached them."""
        now_s = time.monotonic()
        due = [name for name, told_s in self._briefed_s.items() if now_s - told_s > AGAIN_S]
        for name in due:
            nonce = self._admission.player(name)
            if nonce is None:
                del self._briefed_s[name]
            else:
                self._brief(Joined(name, nonce))

    def _brief(self, event: Joined) -> None:
        plan = self._plan
        self._briefed_s[event.name] = time.monotonic()
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
            self.simulation.body(event.name),
        )
        self.host.send(event.name, encode(mission), blocking=True)

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
        self.simulation.gone = self.simulation.gone | {name}
        self._note(name, "leave")

    def _hear(self, event: Received) -> tuple[ParticipantId, Report] | None:
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
        if not _follows(message, self.simulation.body(name)):
            self._refuse(
                Joined(name, message.nonce),
                "has another past than this run; delete its diary and start it again",
            )
            return
        self.told[name] = message
        self._arrive(name, message.nonce)

    def _arrive(self, name: ParticipantId, nonce: str) -> None:
        self.ready[name] = nonce
        self._briefed_s.pop(name, None)
        self._met.add(nonce)
        self.visits[name] += 1
        self._doubtful.discard(name)
        if self._clock is not None and name in self._away:
            self._come(name)
        self.newcomers.append(name)

    def _come(self, name: ParticipantId) -> None:
        self._away.discard(name)
        self.simulation.gone = self.simulation.gone - {name}
        self._note(name, "join")

    def _note(self, name: ParticipantId, what: str) -> None:
        """Put on record what nobody ordered."""
        assert self._clock is not None
        now_ns, told = max(self._clock(), self.simulation.now_ns), self.told.get(name)
        step = incarnation = 0
        if what == "join" and told is not None:  # one that was only frozen has told it long ago
            step, incarnation = max(told.step, self.simulation.body(name).step), told.incarnation
        self.simulation.note(ProcessEvent(now_ns, name, what, -1, step, incarnation))

    def go(self, name: ParticipantId, now_ns: int, speed: float, skew_ns: int) -> None:
        """Wall: start a participant's clock, or set the one that its machine reads."""
        look = self.simulation.look(name)
        message = StartClock(VERSION, self.ready[name], now_ns, speed, look, skew_ns)
        self.host.send(name, encode(message), blocking=True)

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
        if now - self._shown >= PROGRESS_S:
            self._shown = now
            message = progress(self._metrics, self._plan.scenario, phase, detail)
            self.host.publish_progress(encode(message))
            self._show(message)


def _follows(ready: Ready, body: Body) -> bool:
    """Whether a process goes on from where the world is: at most a step ahead, or one incarnation."""
    reborn = ready.incarnation == body.incarnation + 1
    return (ready.incarnation == body.incarnation or reborn) and ready.step - body.step in {0, 1}


def wait_for(lobby: Lobby, done: Callable[[], bool], complaint: str) -> None:
    """Serve the doorway until something has happened. Raises BusError."""
    give_up = time.monotonic() + RETURN_S
    while not done():
        if time.monotonic() >= give_up:
            raise BusError(f"{complaint}; see the logs")
        lobby.next(POLL_S)
