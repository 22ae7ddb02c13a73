"""The relay of the wall exchange: who steps when is up to the participants."""

import time
from collections import deque
from itertools import islice

import msgspec

from kantor_protocol.base.machine import WORLD_SIM, Envelope, Inputs, ParticipantId
from kantor_protocol.node.wall_clock import INBOX_MAX
from kantor_protocol.wire.messages import VERSION, Report, StepRequest, encode
from kantor_worldsim.engine.simulation import Simulation, Step
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.fault_injector import FaultInjector
from kantor_worldsim.exchange.lobby import POLL_S, PROGRESS_S, Lobby
from kantor_worldsim.record.records import ProcessEvent

_CLOCK_TOLERANCE_NS = 500_000_000
"""Wall, in real time: how far ahead of world-sim's clock a robot's may be."""
_SKEW_MAX_NS = 2**52
_NEVER_NS = 2**62


class RealtimeExchange:
    """The wall exchange: every participant steps by its own clock.

    What it sends is ruled on and passed on when it arrives. Every inbox is recorded as the
    participant reports it. A step is accepted once, and the next only after it: until a participant has been
    told, it holds, and says its report again.
    """

    def __init__(
        self, lobby: Lobby, simulation: Simulation, plan: MissionConfig, *, resumed: bool
    ) -> None:
        self._lobby = lobby
        self._simulation = simulation
        self._speed = plan.speed
        self._period_ns = plan.scenario.period_ns
        self._limit_ns = plan.scenario.limit_ns
        self._mail = {name: Mail() for name in plan.scenario.roster}
        self._skews = dict.fromkeys(plan.scenario.roster, 0)
        """How far ahead each clock was told to be."""
        self._deeds = FaultInjector(lobby, simulation, plan)
        start_ns = self._resumed_ns() if resumed else 0
        self._origin_ns = time.monotonic_ns() - round(start_ns / self._speed)

    def _resumed_ns(self) -> int:
        """Have what was handed out before as it may be heard of yet; and the time to go on from."""
        simulation, lobby = self._simulation, self._lobby
        for name, mail in self._mail.items():
            mail.handed += simulation.inputs(name, _NEVER_NS).inbox
        before_ns = simulation.now_ns
        told_ns = max((told.now_ns for told in lobby.told.values()), default=0)
        start_ns = max(before_ns, told_ns, self._deeds.world_starts_ns or 0)
        if self._deeds.world_starts_ns is None:
            simulation.note(ProcessEvent(before_ns, WORLD_SIM, "leave"))
            simulation.note(ProcessEvent(start_ns, WORLD_SIM, "join"))
        return start_ns

    def run(self) -> str:
        """Relay until the mission is over; why it is."""
        lobby, deeds = self._lobby, self._deeds
        lobby.open(lambda: self._now_ns)
        deeds.do(self._now_ns)
        lobby.newcomers = deque(lobby.ready)
        while True:
            reason = self._reason()
            if reason is not None:
                self._simulation.end(reason)
                return reason
            while lobby.newcomers:
                self._welcome(lobby.newcomers.popleft())
            report = lobby.next(self._patience_s())
            deeds.do(self._now_ns)
            if not deeds.world_is_down:  # what is said now is said again
                if report is not None:
                    self._settle(*report)
                self._deliver()

    @property
    def _now_ns(self) -> int:
        """Simulated time; it does not run back, whatever the clocks are."""
        by_clock_ns = round((time.monotonic_ns() - self._origin_ns) * self._speed)
        return max(by_clock_ns, self._simulation.now_ns)

    def _reason(self) -> str | None:
        if self._simulation.over:
            return self._simulation.over
        if self._lobby.stopped():
            return "interrupted"
        return "limit" if self._now_ns > self._limit_ns else None

    def _patience_s(self) -> float:
        """Real seconds until there is something to do."""
        now_ns = self._now_ns
        due_ns = (self._simulation.channel.next_due_ns(), self._deeds.next_ns(now_ns))
        waits_s = [(due - now_ns) * 1e-9 / self._speed for due in due_ns if due is not None]
        longest_s = POLL_S if self._deeds.busy else PROGRESS_S
        return min(longest_s, max(0.0, min(waits_s, default=longest_s)))

    def _welcome(self, name: ParticipantId) -> None:
        """Start the clock of whoever has got ready."""
        if name in self._lobby.ready:
            self._deeds.welcome(name)
            self._set_clock(name, self._now_ns)

    def _set_clock(self, name: ParticipantId, now_ns: int) -> None:
        self._skews[name] = self._deeds.skew_ns(name, now_ns)
        self._lobby.go(name, now_ns, self._speed, self._skews[name])

    def _settle(self, name: ParticipantId, report: Report) -> None:
        known = self._simulation.body(name).step
        if report.outputs.step <= known:  # it has not heard yet that this was accepted
            self._hand(name)
        elif not self._deeds.dies(name):
            inputs = self._inputs(name, known, report)
            if inputs is None:
                self._lobby.refused += 1
                return
            self._simulation.settle(
                self._now_ns, [Step(name, inputs, report.outputs, report.skew_ns)]
            )
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
        return Inputs(report.now_ns + report.skew_ns, self._simulation.look(name), inbox)

    def _deliver(self) -> None:
        """Hand on what is due at anybody."""
        due_ns, now_ns = self._simulation.channel.next_due_ns(), self._now_ns
        if due_ns is None or due_ns > now_ns:
            return
        for name in self._simulation.scenario.roster:
            if self._simulation.channel.waits(name, now_ns):
                self._hand(name)

    def _hand(self, name: ParticipantId) -> None:
        """Tell a participant where it is, and hand it what has arrived."""
        now_ns, mail = self._now_ns, self._mail[name]
        given = self._simulation.inputs(name, now_ns)
        mail.waiting += given.inbox
        if self._deeds.is_frozen(name):
            return  # it waits
        if name not in self._lobby.ready:
            mail.waiting.clear()  # what reaches nobody is lost
            return
        if self._deeds.skew_ns(name, now_ns) != self._skews[name]:
            self._set_clock(name, now_ns)
        turn = StepRequest(VERSION, msgspec.structs.replace(given, inbox=mail.hand()))
        self._lobby.host.send(name, encode(turn), blocking=False)


class Mail:
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
