"""The lockstep exchange: all participants that are due step, and time advances when they have answered."""

import time
from collections.abc import Mapping
from typing import NamedTuple

from kantor_protocol.base.machine import WORLD_SIM, Body, Inputs, Outputs, ParticipantId
from kantor_protocol.scenario.faults.processes import Disk
from kantor_protocol.wire.messages import VERSION, StepRequest
from kantor_worldsim.exchange.lobby import RETRY_S, Lobby
from kantor_worldsim.exchange.process_control import (
    CommandKind,
    ProcessCommand,
    ProcessController,
)

BARRIER_S = 10.0
"""Timeout of a step, from the last answer of anybody on: a participant that has not answered by then misses it, and is
silent until it answers. One that has left the bus has as long to come back: on a busy machine sessions of live processes
expire."""
_PATIENCE_MIN_S = 0.05
"""Whoever misses steps again and again is waited for half as long each time, down to this."""
_WAIT_S = 0.05
"""Longest wait for the next report, after which unanswered requests are checked again."""


class LockstepExchange:
    """Exchange and process control over the bus, with a barrier for each batch of steps.

    Nobody waits for a participant that is *silent*: it has missed a step, and has not made it since. It is asked now
    and then, and its answer counts in its next batch, whenever it comes.
    """

    def __init__(self, lobby: Lobby, controller: ProcessController) -> None:
        self._lobby = lobby
        self._controller = controller
        self._silent: set[ParticipantId] = set()
        self._patience_s = dict.fromkeys(lobby.roster, BARRIER_S)
        self._late: dict[ParticipantId, Outputs] = {}
        """Answers of silent participants that came between their batches."""
        self._asked: dict[ParticipantId, _Asked] = {}
        """The last request to each participant that has not answered it."""

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all participants of a batch. Those that return meanwhile, or are silent, are asked again."""
        lobby = self._lobby
        outputs: dict[ParticipantId, Outputs] = {}
        for name in inputs:
            if (late := self._late.pop(name, None)) is not None:
                self._take(name, late, inputs, outputs)
        heard_s, answers = time.monotonic(), 0
        while True:
            if len(outputs) > answers:  # a team that answers is busy, and not silent
                heard_s, answers = time.monotonic(), len(outputs)
            missing = [name for name in inputs if name not in outputs]
            self._ask({name: inputs[name] for name in missing})
            waited_s = time.monotonic() - heard_s
            awaited = {name for name in missing if self._is_awaited(name, waited_s)}
            if not awaited:
                break
            self._gather(awaited, inputs, outputs)
        for name in inputs:
            if name not in outputs and lobby.is_expected(name):
                self._go_on_without(name)
        lobby.forget_newcomers()
        return outputs

    def _gather(
        self,
        awaited: set[ParticipantId],
        inputs: Mapping[ParticipantId, Inputs],
        outputs: dict[ParticipantId, Outputs],
    ) -> None:
        """Take reports until all that are awaited have come, something else happens, or _WAIT_S have passed."""
        until_s = time.monotonic() + _WAIT_S
        while awaited and (report := self._lobby.next(until_s - time.monotonic())) is not None:
            name, made = report[0], report[1].outputs
            self._take(name, made, inputs, outputs)
            if name in outputs:
                awaited.discard(name)

    def _go_on_without(self, name: ParticipantId) -> None:
        """Give up a participant that has left, and wait no more for one that is silent."""
        lobby = self._lobby
        if name not in self._silent:
            self._patience_s[name] = max(_PATIENCE_MIN_S, self._patience_s[name] / 2.0)
        if lobby.has_left(name):
            lobby.give_up(name)
        elif name not in self._silent:
            self._silent.add(name)
            lobby.note_silence(name)

    def _take(
        self,
        name: ParticipantId,
        made: Outputs,
        inputs: Mapping[ParticipantId, Inputs],
        outputs: dict[ParticipantId, Outputs],
    ) -> None:
        """Take the outputs of a step, if they are those that are asked for, now or in a batch to come."""
        if name in inputs:
            if made.step == inputs[name].observation.step + 1:
                outputs[name] = made
                self._silent.discard(name)
                self._asked.pop(name, None)
        elif name in self._silent:
            self._late[name] = made

    def _is_awaited(self, name: ParticipantId, waited_s: float) -> bool:
        """Whether the barrier still waits for a participant; for silent ones only while nobody else is there."""
        lobby = self._lobby
        if not lobby.is_expected(name) or waited_s >= self._patience_s[name]:
            return False
        return name not in self._silent or not any(
            lobby.is_expected(other) and other not in self._silent for other in lobby.roster
        )

    def _ask(self, inputs: Mapping[ParticipantId, Inputs]) -> None:
        """Send requests to ready participants without outputs: at once, and again after a while or a return."""
        lobby, now_s = self._lobby, time.monotonic()
        for name, given in inputs.items():
            arrivals, step = lobby.arrivals(name), given.observation.step
            last = self._asked.get(name)
            fresh = last is None or last.step != step or now_s - last.asked_s > RETRY_S
            returned = last is not None and last.arrivals != arrivals
            if lobby.is_ready(name) and (fresh or returned):
                if fresh:  # who only says that it is back is granted nothing
                    lobby.grant_reply(name)
                self._asked[name] = _Asked(step, arrivals, now_s)
                silent = name in self._silent  # it may not read, either
                lobby.request(name, StepRequest(VERSION, given), blocking=not silent)

    def kill(self, name: ParticipantId) -> None:
        """Kill a process; world-sim's own kill does not return."""
        if name == WORLD_SIM:
            self._controller(ProcessCommand(CommandKind.RESTART_WORLD_SIM, WORLD_SIM))
            return
        lobby = self._lobby
        lobby.excuse(name)
        self._controller(ProcessCommand(CommandKind.KILL, name))
        complaint = f"{name} was killed and is still there"
        lobby.wait_for(lambda: not lobby.is_present(name), complaint)

    def start(self, name: ParticipantId, body: Body, disk: Disk) -> tuple[int, int]:
        """Start a process, and wait until it is ready."""
        lobby, arrivals = self._lobby, self._lobby.arrivals(name)
        self._controller(ProcessCommand(CommandKind.START, name, disk, body.step))
        complaint = f"{name} was started and did not come"
        lobby.wait_for(lambda: lobby.arrivals(name) > arrivals, complaint)
        lobby.expect(name)
        ready = lobby.last_ready(name)
        return ready.incarnation, ready.step

    def admits_impostor(self, name: ParticipantId) -> bool:
        """Start a second process under an id; whether it was admitted."""
        self._controller(ProcessCommand(CommandKind.START_IMPOSTOR, name))
        refused: bool | None = None

        def ended() -> bool:
            nonlocal refused
            refused = self._controller(ProcessCommand(CommandKind.IS_IMPOSTOR_REFUSED, name))
            return refused is not None

        self._lobby.wait_for(ended, f"{name}: what became of the impostor?")
        return not refused


class _Asked(NamedTuple):
    """A request for a step."""

    step: int
    """The step before."""
    arrivals: int
    """How often its participant had arrived by then."""
    asked_s: float
