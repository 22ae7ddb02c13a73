"""The injector of process faults in real time: it has scheduled events carried out on real processes."""

import time

from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.transport.session import BusError
from kantor_worldsim.engine.process_faults import ProcessFaults, ScheduledProcessFault, schedule_of
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.lobby import RETURN_S, Lobby
from kantor_worldsim.exchange.process_control import (
    CommandKind,
    ProcessCommand,
    ProcessController,
)
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.record.records import ProcessEvent

_STEPS_TO_DIE = 3
"""Periods after which a process that makes no step is killed outside of one."""
_COMMANDS = {
    ProcessEventKind.PAUSE: CommandKind.FREEZE,
    ProcessEventKind.RESUME: CommandKind.THAW,
    ProcessEventKind.FILL: CommandKind.FILL_DISK,
    ProcessEventKind.FREE: CommandKind.FREE_DISK,
    ProcessEventKind.IMPOSTOR_REFUSED: CommandKind.START_IMPOSTOR,
}
"""Events that are one command to a participant's process."""


class FaultInjector:
    """Injects process faults one after the other; each is recorded when it is done."""

    def __init__(
        self,
        lobby: Lobby,
        simulation: Simulation,
        config: MissionConfig,
        controller: ProcessController,
    ) -> None:
        self._lobby = lobby
        self._simulation = simulation
        self._controller = controller
        self._scenario = config.scenario
        self._speed = config.speed
        self._faults = ProcessFaults(config.scenario, done=simulation.faults_done)
        self._current: ScheduledProcessFault | None = None
        """The event that was begun and is not done."""
        self._since_s = 0.0
        """Time at which it was begun."""
        self._arrivals = 0
        """Arrivals of its participant at that time."""
        self.world_is_down = False
        """Whether, on record, world-sim is killed or paused."""
        self._paused: set[ParticipantId] = set()
        self._slow: set[ParticipantId] = set()
        self._held: set[ParticipantId] = set()
        """Slow participants whose processes are stopped now."""
        schedule = schedule_of(config.scenario)
        for scheduled in schedule[: simulation.faults_done]:
            self._track(scheduled)
        for name in sorted(self._slow):  # an earlier process of world-sim may have stopped it
            self._command(CommandKind.THAW, name)
        self.world_starts_ns = world_starts_ns(schedule, simulation.faults_done)
        """Time at which world-sim is to start again, if a fault has killed it."""

    @property
    def busy(self) -> bool:
        """Whether an event was begun and is not done."""
        return self._current is not None

    def next_ns(self, now_ns: int) -> int | None:
        """Time at which there is something to do."""
        due_ns = None if self.busy else self._faults.next_ns
        if not self._slow:
            return due_ns
        period_ns = self._scenario.period_ns
        turn_ns = (now_ns // period_ns + 1) * period_ns
        return turn_ns if due_ns is None else min(due_ns, turn_ns)

    def skew_ns(self, name: ParticipantId, now_ns: int) -> int:
        """Skew that a participant's clock is to have."""
        return self._faults.skew_ns(name, now_ns)

    def is_frozen(self, name: ParticipantId) -> bool:
        """Whether a participant is stopped, or was a moment ago and is not ready yet."""
        if name in self._paused or name in self._held:
            return True
        return name in self._slow and not self._lobby.is_ready(name)

    def kills_in_step(self, name: ParticipantId) -> bool:
        """Kill a participant that is to die in the step that it reports; whether it does."""
        if not self._is_killing(name) or self._current is None or not self._current.mid_step:
            return False
        self._command(CommandKind.KILL, name)
        return True

    def welcome(self, name: ParticipantId) -> None:
        """Expect a participant that is present again, unless it is about to be stopped."""
        if not self._is_killing(name) and name not in self._paused | self._slow:
            self._lobby.expect(name)

    def advance(self, now_ns: int) -> None:
        """Begin and complete the events that are due."""
        for name in sorted(self._slow):
            self._hold(name, held=self._faults.idle(name, now_ns))
        while self._current is None or self._is_done(self._current, now_ns):
            self._current = None
            due_ns = self._faults.next_ns
            if due_ns is None or due_ns > now_ns:
                return
            self._current = self._faults.pop()
            self._begin(self._current, now_ns)

    def _is_killing(self, name: ParticipantId) -> bool:
        current = self._current
        return current is not None and (current.kind, current.who) == (ProcessEventKind.KILL, name)

    def _begin(self, scheduled: ScheduledProcessFault, now_ns: int) -> None:
        self._since_s = time.monotonic()
        who, kind, lobby = scheduled.who, scheduled.kind, self._lobby
        self._track(scheduled)
        if who == WORLD_SIM:
            self._begin_on_world_sim(scheduled, now_ns)
            return
        if kind in {ProcessEventKind.KILL, ProcessEventKind.PAUSE}:
            lobby.excuse(who)
        match kind:
            case ProcessEventKind.KILL:
                if not scheduled.mid_step:
                    self._command(CommandKind.KILL, who)
            case ProcessEventKind.START:
                self._arrivals = lobby.arrivals(who)
                step = self._simulation.body(who).step
                self._controller(ProcessCommand(CommandKind.START, who, scheduled.disk, step))
            case ProcessEventKind.SLOW | ProcessEventKind.QUICKEN:
                lobby.excuse(who)
                self._hold(who, held=False)
            case _ if kind in _COMMANDS:
                self._command(_COMMANDS[kind], who)

    def _begin_on_world_sim(self, scheduled: ScheduledProcessFault, now_ns: int) -> None:
        end_ns = self._scenario.faults[scheduled.fault].until_ns or now_ns
        after_s = max(0.0, (end_ns - now_ns) * 1e-9 / self._speed)
        if scheduled.kind == ProcessEventKind.KILL:
            self._note(scheduled, scheduled.kind, now_ns)  # the command does not return
            self._command(CommandKind.RESTART_WORLD_SIM, WORLD_SIM, after_s)
        elif scheduled.kind == ProcessEventKind.PAUSE:
            self._command(CommandKind.REST_WORLD_SIM, WORLD_SIM, after_s)

    def _is_done(self, scheduled: ScheduledProcessFault, now_ns: int) -> bool:
        """Whether an event is done; then it is recorded. Raises BusError after a timeout."""
        lobby, who = self._lobby, scheduled.who
        waited_s = time.monotonic() - self._since_s
        kind, incarnation, step = scheduled.kind, 0, 0
        done = True
        if who == WORLD_SIM:
            pass
        elif kind == ProcessEventKind.KILL:
            done = not lobby.is_present(who)
            if scheduled.mid_step and waited_s > _STEPS_TO_DIE * self._period_s:
                self._command(CommandKind.KILL, who)  # it makes no more steps
        elif kind == ProcessEventKind.START:
            done = lobby.arrivals(who) > self._arrivals
            if done:
                ready = lobby.last_ready(who)
                incarnation, step = ready.incarnation, ready.step
        elif kind == ProcessEventKind.IMPOSTOR_REFUSED:
            refused = self._command(CommandKind.IS_IMPOSTOR_REFUSED, who)
            done = refused is not None
            kind = kind if refused else ProcessEventKind.IMPOSTOR_ADMITTED
        if done:
            self._note(scheduled, kind, now_ns, incarnation, step)
        elif waited_s > RETURN_S + _STEPS_TO_DIE * self._period_s:
            raise BusError(f"{who}: {scheduled.kind} does not come to an end; see the logs")
        return done

    @property
    def _period_s(self) -> float:
        return self._scenario.period_ns * 1e-9 / self._speed

    def _note(
        self,
        scheduled: ScheduledProcessFault,
        kind: ProcessEventKind,
        now_ns: int,
        incarnation: int = 0,
        step: int = 0,
    ) -> None:
        now_ns = max(now_ns, self._simulation.now_ns)
        event = ProcessEvent(now_ns, scheduled.who, kind, scheduled.fault, step, incarnation)
        self._simulation.note(event)

    def _track(self, scheduled: ScheduledProcessFault) -> None:
        """Track which processes are down, paused or slow."""
        who = scheduled.who
        if who == WORLD_SIM:
            self.world_is_down = scheduled.kind in {ProcessEventKind.KILL, ProcessEventKind.PAUSE}
            return
        match scheduled.kind:
            case ProcessEventKind.PAUSE:
                self._paused.add(who)
            case ProcessEventKind.RESUME:
                self._paused.discard(who)
            case ProcessEventKind.SLOW:
                self._slow.add(who)
            case ProcessEventKind.QUICKEN:
                self._slow.discard(who)

    def _hold(self, name: ParticipantId, *, held: bool) -> None:
        """Stop a slow process, or let it run."""
        if held != (name in self._held):
            self._command(CommandKind.FREEZE if held else CommandKind.THAW, name)
            (self._held.add if held else self._held.discard)(name)

    def _command(self, kind: CommandKind, who: ParticipantId, after_s: float = 0.0) -> bool | None:
        return self._controller(ProcessCommand(kind, who, after_s=after_s))


def world_starts_ns(schedule: list[ScheduledProcessFault], done: int) -> int | None:
    """Time at which world-sim starts again, if the events that are done have killed it."""
    down = (ProcessEventKind.KILL, ProcessEventKind.START)
    of_world = [(i, e) for i, e in enumerate(schedule) if e.who == WORLD_SIM and e.kind in down]
    past = [event.kind for i, event in of_world if i < done]
    if past[-1:] != [ProcessEventKind.KILL]:
        return None
    return next(
        event.at_ns for i, event in of_world if i >= done and event.kind == ProcessEventKind.START
    )
