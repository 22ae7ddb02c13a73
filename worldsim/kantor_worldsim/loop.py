"""The virtual loop: discrete events in simulated time, the same for every exchange."""

import heapq
from bisect import bisect_left
from collections.abc import Callable, Mapping
from itertools import groupby
from operator import itemgetter
from typing import Protocol, cast

import msgspec

from kantor_protocol.clock import Clock, clocks
from kantor_protocol.faults import Disk
from kantor_protocol.life import Mortal
from kantor_protocol.machine import (
    WORLD_SIM,
    Body,
    Exchange,
    Inputs,
    Outputs,
    ParticipantId,
    StateMachine,
)
from kantor_protocol.messages import decode_inputs, encode
from kantor_worldsim.outages import Deed, Outages
from kantor_worldsim.records import Incident
from kantor_worldsim.stage import Stage, Step

_NEVER_NS = 2**63 - 1
_STEPS = range(1, 2**40)

_decode_outputs = msgspec.msgpack.Decoder(Outputs).decode
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


def in_process(machines: Mapping[ParticipantId, StateMachine]) -> Crew:
    """The crew without processes. Whom the scenario has killed must be a `Mortal`."""
    return _InProcess(machines)


class _InProcess:
    """The crew without processes. Everything passes the codec, so nothing is shared."""

    def __init__(self, machines: Mapping[ParticipantId, StateMachine]) -> None:
        self._machines = machines

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all of a batch."""
        machines = self._machines
        return {
            name: _decode_outputs(encode(machines[name].step(decode_inputs(encode(given)))))
            for name, given in inputs.items()
        }

    def kill(self, name: ParticipantId) -> None:
        """End a participant; nothing has to be done to world-sim, which is rebuilt."""
        if name != WORLD_SIM:
            self._mortal(name).kill()

    def start(self, name: ParticipantId, body: Body, disk: Disk) -> tuple[int, int]:
        """Start one that was killed, or is late."""
        machine = self._machines[name]
        if not isinstance(machine, Mortal):  # it has been there all the time, and was not asked
            return body.epoch, body.step
        return machine.start(body, disk)

    def pretend(self, _name: ParticipantId) -> bool:
        """There is no door here."""
        return False

    def _mortal(self, name: ParticipantId) -> Mortal:
        machine = self._machines[name]
        if not isinstance(machine, Mortal):
            raise TypeError(f"{name} is killed in this scenario; hand over a life.Mortal")
        return machine


class Agenda:
    """Who is due when: the next step of every clock."""

    def __init__(self, owned: Mapping[ParticipantId, Clock], from_ns: int = 0) -> None:
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


def simulate(stage: Stage, exchange: Exchange, seed: int, stopped: Callable[[], bool]) -> str:
    """Run until every robot rests, the limit is reached or `stopped()`; the reason, also recorded.

    stage: new, or resumed. exchange: a Crew, where the scenario has faults of processes.
    """
    return _Mission(stage, exchange, seed, stopped).run()


class _Mission:
    """A mission turn by turn. Beside the stage it knows nothing but functions of time."""

    def __init__(
        self, stage: Stage, exchange: Exchange, seed: int, stopped: Callable[[], bool]
    ) -> None:
        self._exchange = exchange
        self._crew = cast("Crew", exchange)
        self._clocks = clocks(stage.scenario, seed)
        self._stopped = stopped
        self._go_on(stage)

    def _go_on(self, stage: Stage) -> None:
        self._stage = stage
        self._agenda = Agenda(self._clocks, stage.done_ns)
        self._outages = Outages(stage.scenario, done=stage.deeds)

    def run(self) -> str:
        while True:
            step_ns, deed_ns = self._agenda.next_ns, self._outages.next_ns
            if deed_ns is None:
                deed_ns = _NEVER_NS
            if reason := self._reason(min(step_ns, deed_ns)):
                self._stage.end(reason)
                return reason
            if deed_ns <= step_ns:
                self._do(self._outages.pop())
            else:
                self._step(self._agenda.batch(self._stage.channel.lookahead_ns, deed_ns))

    def _reason(self, next_ns: int) -> str | None:
        if over := self._stage.over:
            return over
        if next_ns > self._stage.limit_ns:
            return "limit"
        return "interrupted" if self._stopped() else None

    def _step(self, batch: list[tuple[int, ParticipantId]]) -> None:
        """Let everybody in a batch step who can, then let it happen moment by moment."""
        outages, stage = self._outages, self._stage
        turns: list[tuple[int, Step]] = []
        dying: list[ParticipantId] = []
        for due_ns, name in batch:
            if outages.idle(name, due_ns):
                if not self._dies(name, due_ns):
                    continue
                dying.append(name)
            turns.append((due_ns, stage.turn(name, due_ns, outages.skew_ns(name, due_ns))))
        if not turns:
            return
        outputs = dict(self._exchange({turn.name: turn.inputs for _, turn in turns}))
        for name in dying:
            outputs.pop(name, None)
            self._crew.kill(name)
        for moment_ns, due in groupby(turns, key=itemgetter(0)):
            if self._reason(moment_ns):  # what was looked ahead to does not happen
                break
            stage.settle(
                moment_ns, [turn._replace(outputs=outputs.get(turn.name)) for _, turn in due]
            )

    def _dies(self, name: ParticipantId, now_ns: int) -> bool:
        """Whether a participant is to die in its next step. Who has a turn to answer is dead."""
        return self._outages.dies(name, now_ns) and self._stage.unanswered(name) is None

    def _do(self, deed: Deed) -> None:
        if deed.what == "kill":
            self._kill(deed)
        elif deed.what == "start" and deed.who != WORLD_SIM:
            self._start(deed)
        elif deed.what == "pretend" and self._crew.pretend(deed.who):
            self._note(deed, "let in")
        else:
            self._note(deed, deed.what)

    def _kill(self, deed: Deed) -> None:
        self._note(deed, deed.what)
        if deed.who == WORLD_SIM:
            self._crew.kill(WORLD_SIM)
            self._go_on(self._stage.rebuilt())
        elif not deed.mid_step or self._stage.unanswered(deed.who):
            self._crew.kill(deed.who)

    def _start(self, deed: Deed) -> None:
        """Start a process, and have it answer what it was asked."""
        stage, who = self._stage, deed.who
        if deed.mid_step and not stage.unanswered(who):  # it had no step to die in
            self._crew.kill(who)
        epoch, step = self._crew.start(who, stage.body(who), deed.disk)
        stage.note(Incident(deed.at_ns, who, "start", deed.fault, step, epoch))
        if asked := stage.unanswered(who):
            outputs = self._exchange({who: asked.inputs}).get(who)
            stage.settle(deed.at_ns, [asked._replace(outputs=outputs)])

    def _note(self, deed: Deed, what: str) -> None:
        self._stage.note(Incident(deed.at_ns, deed.who, what, deed.fault))
