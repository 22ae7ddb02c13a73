"""The virtual loop: discrete events in simulated time, the same for every exchange."""

import heapq
from bisect import bisect_left
from collections.abc import Callable, Mapping
from itertools import groupby
from operator import itemgetter
from typing import Protocol, cast

import msgspec

from kantor_protocol.base.machine import WORLD_SIM, Body, Exchange, Inputs, Outputs, ParticipantId
from kantor_protocol.scenario.clocks import StepClock, step_clocks
from kantor_protocol.scenario.faults.processes import Disk
from kantor_worldsim.engine.process_faults import ProcessFaults, ScheduledProcessFault
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.record.records import ProcessEvent

_NEVER_NS = 2**63 - 1


_STEPS = range(1, 2**40)


decode_outputs = msgspec.msgpack.Decoder(Outputs).decode
"""The stage checks their numbers."""


class Crew(Protocol):
    """Who runs the participants of a mission: has them step, and ends and starts them on order."""

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all of a batch; a missing output is a value, see `Exchange`."""
        ...

    def kill(self, name: ParticipantId) -> None:
        """End a process at once. World-sim's does not return where it is a process of its own."""
        ...

    def start(self, name: ParticipantId, body: Body, disk: Disk) -> tuple[int, int]:
        """Start a process for a body, with what is left of its snapshot; its (epoch, step)."""
        ...

    def pretend(self, name: ParticipantId) -> bool:
        """Have a second process ask to join under this id; whether it was let in."""
        ...


class Agenda:
    """Who is due when: the next step of every clock."""

    def __init__(self, owned: Mapping[ParticipantId, StepClock], from_ns: int = 0) -> None:
        """from_ns: whatever was due before is done."""
        self._clocks = owned
        self._due = []
        for order, (name, clock) in enumerate(owned.items()):
            step = _STEPS[bisect_left(_STEPS, from_ns, key=clock.due_ns)] if from_ns > 0 else 1
            self._due.append((clock.due_ns(step), order, step, name))
        heapq.heapify(self._due)

    @property
    def next_ns(self) -> int:
        """When the next participant is due."""
        return self._due[0][0]

    def batch(
        self, lookahead_ns: int, before_ns: int = _NEVER_NS
    ) -> list[tuple[int, ParticipantId]]:
        """Everybody due before a message sent at the earliest of them could arrive, by (time, roster).

        The batch ends before a participant's second step, so that time never runs back, and before
        before_ns, which is later than the earliest.
        """
        due = self._due
        first_ns = due[0][0]
        until_ns = min(first_ns + lookahead_ns, before_ns)
        batch: list[tuple[int, ParticipantId]] = []
        while due[0][0] < until_ns or due[0][0] == first_ns:
            due_ns, order, step, name = due[0]
            next_ns = self._clocks[name].due_ns(step + 1)
            heapq.heapreplace(due, (next_ns, order, step + 1, name))
            until_ns = min(until_ns, next_ns)
            batch.append((due_ns, name))
        return batch


def simulate(
    simulation: Simulation, exchange: Exchange, seed: int, stopped: Callable[[], bool]
) -> str:
    """Run until every robot rests, the limit is reached or `stopped()`; the reason, also recorded.

    simulation: new, or resumed. exchange: a Crew, where the scenario has faults of processes.
    """
    return _Mission(simulation, exchange, seed, stopped).run()


class _Mission:
    """A mission turn by turn. Beside the stage it knows nothing but functions of time."""

    def __init__(
        self, simulation: Simulation, exchange: Exchange, seed: int, stopped: Callable[[], bool]
    ) -> None:
        self._exchange = exchange
        self._crew = cast("Crew", exchange)
        self._clocks = step_clocks(simulation.scenario, seed)
        self._stopped = stopped
        self._go_on(simulation)

    def _go_on(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._agenda = Agenda(self._clocks, simulation.done_ns)
        self._outages = ProcessFaults(simulation.scenario, done=simulation.deeds)

    def run(self) -> str:
        while True:
            step_ns, deed_ns = self._agenda.next_ns, self._outages.next_ns
            if reason := self._reason(step_ns if deed_ns is None else min(step_ns, deed_ns)):
                self._simulation.end(reason)
                return reason
            if deed_ns is None:
                self._step(self._agenda.batch(self._simulation.channel.lookahead_ns))
            elif deed_ns > step_ns:
                self._step(self._agenda.batch(self._simulation.channel.lookahead_ns, deed_ns))
            else:
                self._do(self._outages.pop())

    def _reason(self, next_ns: int) -> str | None:
        if over := self._simulation.over:
            return over
        if next_ns > self._simulation.limit_ns:
            return "limit"
        return "interrupted" if self._stopped() else None

    def _step(self, batch: list[tuple[int, ParticipantId]]) -> None:
        """Let everybody in a batch step who can, then let it happen moment by moment.

        There is no reason yet to end before its first moment.
        """
        outages, simulation = self._outages, self._simulation
        quiet = outages.quiet(batch[0][0], batch[-1][0])
        due = batch if quiet else [event for event in batch if self._is_asked(*event)]
        turns = {
            name: simulation.turn(name, due_ns, outages.skew_ns(name, due_ns))
            for due_ns, name in due
        }
        outputs = self._exchange({name: turn.inputs for name, turn in turns.items()})
        if outages.some_die_mid_step and not quiet:
            outputs = self._cut_short(due, outputs)
        for moment_ns, acting in groupby(due, key=itemgetter(0)):
            if moment_ns > batch[0][0] and self._reason(moment_ns):
                break  # what was looked ahead to does not happen
            simulation.settle(
                moment_ns, [turns[name].answered(outputs.get(name)) for _, name in acting]
            )

    def _is_asked(self, due_ns: int, name: ParticipantId) -> bool:
        return not self._outages.idle(name, due_ns) or self._dies(due_ns, name)

    def _dies(self, due_ns: int, name: ParticipantId) -> bool:
        """Whether a participant dies in this step. Who has a turn to answer is dead already."""
        outages = self._outages
        if not outages.dies(name, due_ns) or outages.idle(WORLD_SIM, due_ns):
            return False
        return self._simulation.unanswered(name) is None

    def _cut_short(
        self, due: list[tuple[int, ParticipantId]], outputs: Mapping[ParticipantId, Outputs]
    ) -> Mapping[ParticipantId, Outputs]:
        """Kill whoever dies in its step, before anybody hears of that."""
        dying = {name for due_ns, name in due if self._dies(due_ns, name)}
        if not dying:
            return outputs
        for name in self._clocks:
            if name in dying:
                self._crew.kill(name)
        return {name: told for name, told in outputs.items() if name not in dying}

    def _do(self, deed: ScheduledProcessFault) -> None:
        if deed.what == "kill":
            self._kill(deed)
        elif deed.what == "start" and deed.who != WORLD_SIM:
            self._start(deed)
        elif deed.what == "pretend" and self._crew.pretend(deed.who):
            self._note(deed, "let in")
        else:
            self._note(deed, deed.what)

    def _kill(self, deed: ScheduledProcessFault) -> None:
        self._note(deed, deed.what)
        if deed.who == WORLD_SIM:
            self._crew.kill(WORLD_SIM)
            self._go_on(self._simulation.rebuilt())
        elif not deed.mid_step or self._simulation.unanswered(deed.who):
            self._crew.kill(deed.who)

    def _start(self, deed: ScheduledProcessFault) -> None:
        """Start a process, and have it answer what it was asked."""
        simulation, who = self._simulation, deed.who
        if deed.mid_step and not simulation.unanswered(who):  # it had no step to die in
            self._crew.kill(who)
        incarnation, step = self._crew.start(who, simulation.body(who), deed.disk)
        simulation.note(ProcessEvent(deed.at_ns, who, "start", deed.fault, step, incarnation))
        if asked := simulation.unanswered(who):
            outputs = self._exchange({who: asked.inputs}).get(who)
            simulation.settle(deed.at_ns, [asked.answered(outputs)])

    def _note(self, deed: ScheduledProcessFault, what: str) -> None:
        self._simulation.note(ProcessEvent(deed.at_ns, deed.who, what, deed.fault))
