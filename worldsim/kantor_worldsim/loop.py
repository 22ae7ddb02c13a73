"""The virtual loop: discrete events in simulated time, the same for every exchange."""

import heapq
from collections.abc import Callable, Mapping
from itertools import groupby
from operator import itemgetter
from typing import Protocol

import msgspec

from kantor_protocol.clock import Clock, clocks
from kantor_protocol.faults import Disk
from kantor_protocol.machine import Body, Exchange, Inputs, Outputs, ParticipantId, StateMachine
from kantor_protocol.messages import decode_inputs, encode
from kantor_worldsim.stage import Stage, Step

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


def in_process(machines: Mapping[ParticipantId, StateMachine]) -> Exchange:
    """The exchange without processes. Everything passes the codec, so nothing is shared."""

    def exchange(inputs: Mapping[ParticipantId, Inputs]) -> Mapping[ParticipantId, Outputs]:
        return {
            name: _decode_outputs(encode(machines[name].step(decode_inputs(encode(given)))))
            for name, given in inputs.items()
        }

    return exchange


class Agenda:
    """Who is due when: the next step of every clock."""

    def __init__(self, owned: Mapping[ParticipantId, Clock]) -> None:
        self._clocks = owned
        self._due = [(clock.due_ns(1), i, 1, name) for i, (name, clock) in enumerate(owned.items())]
        heapq.heapify(self._due)

    @property
    def next_ns(self) -> int:
        """When the next participant is due."""
        return self._due[0][0]

    def batch(self, lookahead_ns: int) -> list[tuple[int, ParticipantId]]:
        """Everybody due before a message sent at the earliest of them could arrive, by (time, roster).

        The batch ends before a participant's second step, so that time never runs back.
        """
        due = self._due
        first_ns = due[0][0]
        until_ns = first_ns + lookahead_ns
        batch: list[tuple[int, ParticipantId]] = []
        while due[0][0] < until_ns or due[0][0] == first_ns:
            due_ns, order, step, name = due[0]
            next_ns = self._clocks[name].due_ns(step + 1)
            heapq.heapreplace(due, (next_ns, order, step + 1, name))
            until_ns = min(until_ns, next_ns)
            batch.append((due_ns, name))
        return batch


def simulate(stage: Stage, exchange: Exchange, seed: int, stopped: Callable[[], bool]) -> str:
    """Run until every robot rests, the limit is reached or `stopped()`; the reason, also recorded."""
    agenda = Agenda(clocks(stage.scenario, seed))
    while not (reason := _reason(stage, agenda.next_ns, stopped)):
        batch = agenda.batch(stage.channel.lookahead_ns)
        inputs = {name: stage.inputs(name, due_ns) for due_ns, name in batch}
        outputs = exchange(inputs)
        for moment_ns, due in groupby(batch, key=itemgetter(0)):
            if _reason(stage, moment_ns, stopped):  # what was looked ahead to does not happen
                break
            steps = [Step(name, inputs[name], outputs.get(name)) for _, name in due]
            stage.settle(moment_ns, steps)
    stage.end(reason)
    return reason


def _reason(stage: Stage, next_ns: int, stopped: Callable[[], bool]) -> str | None:
    if over := stage.over:
        return over
    if next_ns > stage.limit_ns:
        return "limit"
    return "interrupted" if stopped() else None
