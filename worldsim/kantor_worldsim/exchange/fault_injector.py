"""The faults of processes on the wall, carried out by whoever has hands."""

import time
from typing import Literal

from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.transport.session import BusError
from kantor_worldsim.engine.process_faults import ProcessFaults, ScheduledProcessFault, schedule_of
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.lobby import RETURN_S, Lobby
from kantor_worldsim.exchange.process_control import ProcessCommand
from kantor_worldsim.record.records import ProcessEvent

_STEPS_TO_DIE = 3
"""Periods after which a process that makes no step dies without one."""
_ORDERS: dict[str, Literal["freeze", "thaw", "fill", "free", "pretend"]] = {
    "pause": "freeze",
    "resume": "thaw",
    "fill": "fill",
    "free": "free",
    "pretend": "pretend",
}


class FaultInjector:
    """The faults of processes on the wall: one deed after the other, and on record when it is done."""

    def __init__(self, lobby: Lobby, simulation: Simulation, plan: MissionConfig) -> None:
        self._lobby = lobby
        self._simulation = simulation
        self._scenario = plan.scenario
        self._speed = plan.speed
        self._outages = ProcessFaults(plan.scenario, done=simulation.deeds)
        self._deed: ScheduledProcessFault | None = None
        """What has been begun and is not done."""
        self._since_s = 0.0
        self._visit = 0
        self.world_is_down = False
        """On record it has not gone on yet."""
        self._paused: set[ParticipantId] = set()
        self._slow: set[ParticipantId] = set()
        self._held: set[ParticipantId] = set()
        """Those of the slow that are stopped now."""
        deeds = schedule_of(plan.scenario)
        for deed in deeds[: simulation.deeds]:
            self._keep_count(deed)
        for name in sorted(self._slow):
            self._order(
                ProcessCommand("thaw", name)
            )  # the process before this one may have held it
        self.world_starts_ns = world_starts_ns(deeds, simulation.deeds)
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
        return name in self._slow and name not in self._lobby.ready

    def dies(self, name: ParticipantId) -> bool:
        """Kill a participant that was to die in this step, of which nobody hears."""
        deed = self._deed
        if deed is None or (deed.what, deed.who) != ("kill", name) or not deed.mid_step:
            return False
        self._order(ProcessCommand("kill", name))
        return True

    def welcome(self, name: ParticipantId) -> None:
        """Whoever is there again is excused no more, unless it is about to go."""
        going = self._deed is not None and (self._deed.what, self._deed.who) == ("kill", name)
        if not going and name not in self._paused | self._slow:
            self._lobby.excused.discard(name)

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

    def _begin(self, deed: ScheduledProcessFault, now_ns: int) -> None:
        self._since_s = time.monotonic()
        who, lobby = deed.who, self._lobby
        self._keep_count(deed)
        if who == WORLD_SIM:
            self._begin_on_world_sim(deed, now_ns)
        elif deed.what == "kill":
            lobby.excused.add(who)
            if not deed.mid_step:
                self._order(ProcessCommand("kill", who))
        elif deed.what == "start":
            self._visit = lobby.visits[who]
            self._order(ProcessCommand("start", who, deed.disk, self._simulation.body(who).step))
        elif deed.what in {"slow", "quicken"}:
            lobby.excused.add(who)
            self._hold(who, held=False)
        elif deed.what in _ORDERS:
            if deed.what == "pause":
                lobby.excused.add(who)
            self._order(ProcessCommand(_ORDERS[deed.what], who))

    def _begin_on_world_sim(self, deed: ScheduledProcessFault, now_ns: int) -> None:
        end_ns = self._scenario.faults[deed.fault].until_ns or now_ns
        after_s = max(0.0, (end_ns - now_ns) * 1e-9 / self._speed)
        if deed.what == "kill":
            self._note(deed, deed.what, now_ns)  # there is no later
            self._order(ProcessCommand("restart", WORLD_SIM, after_s=after_s))
        elif deed.what == "pause":
            self._order(ProcessCommand("rest", WORLD_SIM, after_s=after_s))

    def _is_done(self, deed: ScheduledProcessFault, now_ns: int) -> bool:
        """Whether a deed is done; then it is on record."""
        lobby, who = self._lobby, deed.who
        waited_s = time.monotonic() - self._since_s
        what: str = deed.what
        incarnation = step = 0
        if who == WORLD_SIM:
            done = True
        elif deed.what == "kill":
            done = not lobby.is_there(who)
            if deed.mid_step and waited_s > _STEPS_TO_DIE * self._period_s:
                self._order(ProcessCommand("kill", who))  # it makes no more steps
        elif deed.what == "start":
            done = lobby.visits[who] > self._visit
            if done:
                incarnation, step = lobby.told[who].incarnation, lobby.told[who].step
        elif deed.what == "pretend":
            refused = self._order(ProcessCommand("refused", who))
            done, what = refused is not None, "pretend" if refused else "let in"
        else:
            done = True
        if done:
            self._note(deed, what, now_ns, incarnation, step)
        elif waited_s > RETURN_S + _STEPS_TO_DIE * self._period_s:
            raise BusError(f"{who}: {deed.what} does not come to an end; see the logs")
        return done

    @property
    def _period_s(self) -> float:
        return self._scenario.period_ns * 1e-9 / self._speed

    def _note(
        self,
        deed: ScheduledProcessFault,
        what: str,
        now_ns: int,
        incarnation: int = 0,
        step: int = 0,
    ) -> None:
        now_ns = max(now_ns, self._simulation.now_ns)
        self._simulation.note(ProcessEvent(now_ns, deed.who, what, deed.fault, step, incarnation))

    def _keep_count(self, deed: ScheduledProcessFault) -> None:
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
            self._order(ProcessCommand("freeze" if held else "thaw", name))
            (self._held.add if held else self._held.discard)(name)

    def _order(self, order: ProcessCommand) -> bool | None:
        assert self._lobby.hands is not None, "faults of processes need hands"
        return self._lobby.hands(order)


def world_starts_ns(deeds: list[ScheduledProcessFault], done: int) -> int | None:
    """When world-sim starts again, if it has been killed by then."""
    of_world = [(i, deed) for i, deed in enumerate(deeds) if deed.who == WORLD_SIM]
    killed = [deed.what for i, deed in of_world if i < done and deed.what in {"kill", "start"}]
    if killed[-1:] != ["kill"]:
        return None
    return next(deed.at_ns for i, deed in of_world if i >= done and deed.what == "start")
