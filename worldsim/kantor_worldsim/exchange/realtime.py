"""The realtime exchange: every participant steps by its own clock, and world-sim relays in time for its next step."""

import time
from collections import deque
from collections.abc import Callable, Iterable
from itertools import islice

from kantor_protocol.base.machine import NEVER_NS, WORLD_SIM, Envelope, Inputs, ParticipantId
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.wire.messages import INBOX_MAX, VERSION, Report, StepRequest
from kantor_worldsim.engine.simulation import Simulation, Step
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.fault_injector import FaultInjector
from kantor_worldsim.exchange.lobby import POLL_S, Lobby
from kantor_worldsim.exchange.pace import Pace
from kantor_worldsim.exchange.process_control import ProcessController
from kantor_worldsim.observers.progress import PROGRESS_S
from kantor_worldsim.radio.fault_kernels import DUE_MAX_NS
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.record.records import ProcessEvent

_CLOCK_TOLERANCE_NS = 500_000_000
"""In real time: how far a robot's clock may be ahead of world-sim's."""
_SKEW_MAX_NS = 2**52
_GATHER = 0.1
"""Part of a participant's period in which reports gather to a batch: every answer has that much less time."""


class RealtimeExchange:
    """Relays between participants that step by their own clocks.

    Reports are settled in batches, and messages are relayed with the acknowledgement of the receiver's last step or
    shortly before its next one. Inboxes are recorded as participants report them. A step
    is accepted once, and the next only after it: a participant takes no step before its last one is
    acknowledged, and repeats its report until then.
    """

    def __init__(
        self,
        lobby: Lobby,
        simulation: Simulation,
        config: MissionConfig,
        controller: ProcessController,
        stopped: Callable[[], bool],
        *,
        resumed: bool,
    ) -> None:
        self._lobby = lobby
        self._simulation = simulation
        self._stopped = stopped
        self._speed = config.speed
        self._period_ns = config.scenario.period_ns
        self._limit_ns = config.scenario.limit_ns
        self._outboxes = {name: Outbox() for name in config.scenario.roster}
        self._skews_ns = dict.fromkeys(config.scenario.roster, 0)
        """Skew that each participant's clock was set to."""
        self._injector = FaultInjector(lobby, simulation, config, controller)
        start_ns = self._resumed_ns() if resumed else 0
        self._origin_ns = time.monotonic_ns() - round(start_ns / self._speed)
        clocks = step_clocks(config.scenario, config.seed)
        self._paces = {name: Pace(clock, start_ns) for name, clock in clocks.items()}
        self._moved_ns = dict.fromkeys(clocks, 0)
        """Time of each participant's last accepted step in this process of world-sim, by its own clock."""
        turns = len(clocks) if config.scenario.clock.order == "turn" else 1
        beat_ns = min(clock.period_ns for clock in clocks.values()) / turns
        self._gather_s = min(POLL_S, _GATHER * beat_ns * 1e-9 / self._speed)
        """Real time from one batch of reports to the next, at least."""
        self._needed_ns = dict.fromkeys(clocks, 0)
        """Time from which on each participant needs what has arrived, for its next step."""
        self._delivery_ns = NEVER_NS
        """Time of the next delivery."""

    def _resumed_ns(self) -> int:
        """Restore what had been handed out, as participants may still report it; the time to go on from."""
        simulation = self._simulation
        for name, outbox in self._outboxes.items():
            outbox.handed += simulation.inputs(name, DUE_MAX_NS).inbox[-2 * INBOX_MAX :]
        stopped_ns, restart_ns = simulation.now_ns, self._injector.world_starts_ns
        start_ns = max(stopped_ns, self._lobby.running_ns(self._speed), restart_ns or 0)
        if restart_ns is None:
            simulation.note(ProcessEvent(stopped_ns, WORLD_SIM, ProcessEventKind.LEAVE))
            simulation.note(ProcessEvent(start_ns, WORLD_SIM, ProcessEventKind.JOIN))
        return start_ns

    def run(self) -> str:
        """Relay until the mission is over; the reason."""
        lobby, injector = self._lobby, self._injector
        if not self._stopped():  # who is not there yet has not left an interrupted mission
            lobby.open(lambda: self._now_ns)
        injector.advance(self._now_ns)
        lobby.announce_all()
        self._welcome_newcomers()
        while True:
            reason = self._reason()
            if reason is not None:
                self._simulation.end(reason)
                return reason
            reports = lobby.reports(self._timeout_s(), self._gather_s)
            injector.advance(self._now_ns)
            self._welcome_newcomers()  # a participant's first message must start its clock
            if not injector.world_is_down:  # a report that is lost now is repeated
                self._settle(reports)
                self._deliver()

    @property
    def _now_ns(self) -> int:
        """Simulated time; it never falls, whatever the clocks do."""
        by_clock_ns = round((time.monotonic_ns() - self._origin_ns) * self._speed)
        return max(by_clock_ns, self._simulation.now_ns)

    def _reason(self) -> str | None:
        if self._simulation.over:
            return self._simulation.over
        if self._stopped():
            return "interrupted"
        return "limit" if self._now_ns > self._limit_ns else None

    def _timeout_s(self) -> float:
        """Real seconds until there is something to do."""
        now_ns = self._now_ns
        longest_s = POLL_S if self._injector.busy else PROGRESS_S
        delivery_s = max(self._gather_s, self._real_s(self._delivery_ns - now_ns))
        fault_ns = self._injector.next_ns(now_ns)
        fault_s = longest_s if fault_ns is None else max(0.0, self._real_s(fault_ns - now_ns))
        return min(longest_s, delivery_s, fault_s)

    def _real_s(self, simulated_ns: int) -> float:
        return simulated_ns * 1e-9 / self._speed

    def _welcome_newcomers(self) -> None:
        """Start the clocks of participants that became ready."""
        while (name := self._lobby.pop_newcomer()) is not None:
            if self._lobby.is_ready(name):
                self._injector.welcome(name)
                self._paces[name].restart()
                self._set_clock(name, self._now_ns)

    def _set_clock(self, name: ParticipantId, now_ns: int) -> None:
        self._skews_ns[name] = self._injector.skew_ns(name, now_ns)
        self._lobby.start_clock(name, now_ns, self._speed, self._skews_ns[name])

    def _settle(self, reports: Iterable[tuple[ParticipantId, Report]]) -> None:
        """Settle the steps that are reported in one batch, and acknowledge them once they are on record."""
        now_ns = self._now_ns
        steps: dict[ParticipantId, Step] = {}
        reported: dict[ParticipantId, None] = {}
        for name, report in reports:
            done = self._simulation.body(name).step
            if report.outputs.step <= done or name in steps:
                reported[name] = None  # the acknowledgement has not arrived yet
            elif (step := self._step(name, report, done, now_ns)) is not None:
                steps[name] = step
                reported[name] = None
        if steps:
            self._simulation.settle(now_ns, steps.values())
        for name in reported:
            self._hand(name, now_ns)

    def _step(self, name: ParticipantId, report: Report, done: int, now_ns: int) -> Step | None:
        """The step that a participant reports, if it may be settled now. done: its last step on record."""
        if self._injector.kills_in_step(name):
            return None
        pace = self._paces[name]
        if not pace.permits(report.now_ns, now_ns):
            return None  # it is repeated, and its time may come
        inputs = self._inputs(name, done, report, now_ns)
        if inputs is None:
            self._lobby.refused += 1
            return None
        pace.count(report.now_ns, now_ns)
        self._needed_ns[name] = pace.delivery_ns(now_ns)
        self._moved_ns[name] = report.now_ns
        return Step(name, inputs, report.outputs, report.skew_ns)

    def _inputs(self, name: ParticipantId, done: int, report: Report, now_ns: int) -> Inputs | None:
        """The inputs that a participant reports, if they are possible."""
        if report.observed != done or report.now_ns < self._moved_ns[name]:
            return None
        ahead_ns = report.now_ns - now_ns
        if ahead_ns > _CLOCK_TOLERANCE_NS * self._speed or abs(report.skew_ns) > _SKEW_MAX_NS:
            return None
        inbox = self._outboxes[name].received(report.heard)
        if inbox is None:
            return None
        return Inputs(report.now_ns + report.skew_ns, self._simulation.look(name), inbox)

    def _deliver(self) -> None:
        """Hand out what has arrived at participants that are about to step. It can wait until then."""
        now_ns, next_ns, needed_ns = self._now_ns, NEVER_NS, self._needed_ns
        for name, arrival_ns in self._simulation.channel.arrivals():
            if arrival_ns <= now_ns and needed_ns[name] <= now_ns:
                self._hand(name, now_ns)
            else:
                next_ns = min(next_ns, max(arrival_ns, needed_ns[name]))
        self._delivery_ns = next_ns

    def _hand(self, name: ParticipantId, now_ns: int) -> None:
        """Send a participant its observation, which acknowledges its step, and the envelopes that have arrived."""
        outbox = self._outboxes[name]
        outbox.waiting += self._simulation.channel.collect(name, now_ns)
        if self._injector.is_frozen(name):
            return  # the envelopes wait
        if not self._lobby.is_ready(name):
            outbox.waiting.clear()  # envelopes for an absent participant are lost
            return
        if self._injector.skew_ns(name, now_ns) != self._skews_ns[name]:
            self._set_clock(name, now_ns)
        inputs = Inputs(now_ns, self._simulation.look(name), outbox.hand())
        self._lobby.request(name, StepRequest(VERSION, inputs), blocking=False)


class Outbox:
    """Envelopes for a participant. Neither queue is longer than an inbox may be."""

    def __init__(self) -> None:
        self.waiting: deque[Envelope] = deque(maxlen=INBOX_MAX)
        """Arrived, and not handed out yet."""
        self.handed: deque[Envelope] = deque()
        """Handed out, and not reported as received so far, in order."""

    def hand(self) -> tuple[Envelope, ...]:
        """The envelopes to hand out now."""
        room = max(0, INBOX_MAX - len(self.handed))
        inbox = tuple([self.waiting.popleft() for _ in range(min(room, len(self.waiting)))])
        self.handed += inbox
        return inbox

    def received(
        self, references: tuple[tuple[ParticipantId, int], ...]
    ) -> tuple[Envelope, ...] | None:
        """The inbox that a participant reports, if it was handed out in this order; skipped envelopes are lost."""
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
