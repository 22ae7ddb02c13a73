"""The event loop of virtual time: discrete events in simulated nanoseconds, the same for every exchange."""

import heapq
from bisect import bisect_left
from collections.abc import Callable, Mapping
from itertools import groupby
from operator import itemgetter
from typing import Protocol

from kantor_protocol.base.machine import (
    NEVER_NS,
    WORLD_SIM,
    Body,
    Exchange,
    Outputs,
    ParticipantId,
)
from kantor_protocol.scenario.clocks import StepClock, step_clocks
from kantor_protocol.scenario.faults.processes import Disk
from kantor_worldsim.engine.process_faults import ProcessFaults, ScheduledProcessFault
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.record.records import ProcessEvent

_STEPS = range(1, 2**40)


class ProcessControl(Protocol):
    """Control of the processes of a mission, as its scheduled process faults need it."""

    def kill(self, name: ParticipantId) -> None:
        """Kill a process. Where world-sim is a process of its own, its kill does not return."""
        ...

    def start(self, name: ParticipantId, body: Body, disk: Disk) -> tuple[int, int]:
        """Start a process that takes over a body with what is left on its disk; its (incarnation, last step)."""
        ...

    def admits_impostor(self, name: ParticipantId) -> bool:
        """Whether a second process that asks to join under this id is admitted."""
        ...


class Agenda:
    """The next step of every participant's clock, by time."""

    def __init__(self, clocks: Mapping[ParticipantId, StepClock], from_ns: int = 0) -> None:
        """from_ns: steps that were due before are done."""
        self._clocks = clocks
        self._due = []
        for order, (name, clock) in enumerate(clocks.items()):
            step = _STEPS[bisect_left(_STEPS, from_ns, key=clock.due_ns)] if from_ns > 0 else 1
            self._due.append((clock.due_ns(step), order, step, name))
        heapq.heapify(self._due)

    @property
    def next_ns(self) -> int:
        """Time of the next step."""
        return self._due[0][0]

    def batch(
        self, lookahead_ns: int, before_ns: int = NEVER_NS
    ) -> list[tuple[int, ParticipantId]]:
        """Steps due before a message sent at the earliest of them could arrive, by (time, roster).

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
    simulation: Simulation,
    exchange: Exchange,
    seed: int,
    stopped: Callable[[], bool],
    control: ProcessControl | None = None,
) -> str:
    """Run until every robot rests, the limit is reached or `stopped()`; the reason, also recorded.

    simulation: new, or resumed. control: needed where the scenario has faults of processes.
    """
    return _Mission(simulation, exchange, seed, stopped, control).run()


class _Mission:
    """A mission batch by batch. Its state is the simulation and functions of time."""

    def __init__(
        self,
        simulation: Simulation,
        exchange: Exchange,
        seed: int,
        stopped: Callable[[], bool],
        control: ProcessControl | None,
    ) -> None:
        self._exchange = exchange
        self._process_control = control
        self._clocks = step_clocks(simulation.scenario, seed)
        self._stopped = stopped
        self._continue(simulation)

    @property
    def _control(self) -> ProcessControl:
        if self._process_control is None:
            raise TypeError("the scenario has faults of processes; pass a process control")
        return self._process_control

    def _continue(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._agenda = Agenda(self._clocks, simulation.done_ns)
        self._faults = ProcessFaults(simulation.scenario, done=simulation.faults_done)

    def run(self) -> str:
        while True:
            step_ns, fault_ns = self._agenda.next_ns, self._faults.next_ns
            if reason := self._reason(step_ns if fault_ns is None else min(step_ns, fault_ns)):
                self._simulation.end(reason)
                return reason
            lookahead_ns = self._simulation.channel.lookahead_ns
            if fault_ns is None:
                self._step(self._agenda.batch(lookahead_ns))
            elif fault_ns > step_ns:
                self._step(self._agenda.batch(lookahead_ns, fault_ns))
            else:
                self._inject(self._faults.pop())

    def _reason(self, next_ns: int) -> str | None:
        if over := self._simulation.over:
            return over
        if next_ns > self._simulation.limit_ns:
            return "limit"
        return "interrupted" if self._stopped() else None

    def _step(self, batch: list[tuple[int, ParticipantId]]) -> None:
        """Step the participants of a batch that can step, then settle the steps moment by moment.

        There is no reason yet to end before its first moment.
        """
        faults, simulation = self._faults, self._simulation
        quiet = faults.quiet(batch[0][0], batch[-1][0])
        due = batch if quiet else [event for event in batch if self._is_asked(*event)]
        requests = {
            name: simulation.request(name, due_ns, faults.skew_ns(name, due_ns))
            for due_ns, name in due
        }
        outputs = self._exchange({name: request.inputs for name, request in requests.items()})
        if faults.some_die_mid_step and not quiet:
            outputs = self._kill_mid_step(due, outputs)
        for moment_ns, acting in groupby(due, key=itemgetter(0)):
            if moment_ns > batch[0][0] and self._reason(moment_ns):
                break  # steps that were only looked ahead to are not settled
            simulation.settle(
                moment_ns, [requests[name].answered(outputs.get(name)) for _, name in acting]
            )

    def _is_asked(self, due_ns: int, name: ParticipantId) -> bool:
        return not self._faults.idle(name, due_ns) or self._dies(due_ns, name)

    def _dies(self, due_ns: int, name: ParticipantId) -> bool:
        """Whether a participant is killed in this step. One with an unanswered request is dead already."""
        faults = self._faults
        if not faults.dies(name, due_ns) or faults.idle(WORLD_SIM, due_ns):
            return False
        return self._simulation.unanswered(name) is None

    def _kill_mid_step(
        self, due: list[tuple[int, ParticipantId]], outputs: Mapping[ParticipantId, Outputs]
    ) -> Mapping[ParticipantId, Outputs]:
        """Kill the participants that die in their step; their outputs reach no one."""
        dying = {name for due_ns, name in due if self._dies(due_ns, name)}
        if not dying:
            return outputs
        for name in self._clocks:
            if name in dying:
                self._control.kill(name)
        return {name: made for name, made in outputs.items() if name not in dying}

    def _inject(self, scheduled: ScheduledProcessFault) -> None:
        match scheduled.kind:
            case ProcessEventKind.KILL:
                self._kill(scheduled)
            case ProcessEventKind.START if scheduled.who != WORLD_SIM:
                self._start(scheduled)
            case ProcessEventKind.IMPOSTOR_REFUSED if self._control.admits_impostor(scheduled.who):
                self._note(scheduled, ProcessEventKind.IMPOSTOR_ADMITTED)
            case kind:
                self._note(scheduled, kind)

    def _kill(self, scheduled: ScheduledProcessFault) -> None:
        self._note(scheduled, scheduled.kind)
        if scheduled.who == WORLD_SIM:
            self._control.kill(WORLD_SIM)
            self._continue(self._simulation.rebuilt())
        elif not scheduled.mid_step or self._simulation.unanswered(scheduled.who):
            self._control.kill(scheduled.who)

    def _start(self, scheduled: ScheduledProcessFault) -> None:
        """Start a process, and have it answer the request that it left unanswered."""
        simulation, who = self._simulation, scheduled.who
        if scheduled.mid_step and not simulation.unanswered(who):  # it had no step to die in
            self._control.kill(who)
        incarnation, step = self._control.start(who, simulation.body(who), scheduled.disk)
        simulation.note(
            ProcessEvent(
                scheduled.at_ns, who, ProcessEventKind.START, scheduled.fault, step, incarnation
            )
        )
        if request := simulation.unanswered(who):
            outputs = self._exchange({who: request.inputs}).get(who)
            simulation.settle(scheduled.at_ns, [request.answered(outputs)])

    def _note(self, scheduled: ScheduledProcessFault, kind: ProcessEventKind) -> None:
        event = ProcessEvent(scheduled.at_ns, scheduled.who, kind, scheduled.fault)
        self._simulation.note(event)
