"""The lockstep exchange: all participants that are due step, and time advances when they have answered."""

import time
from collections.abc import Mapping

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
"""Timeout of a step: a participant that has not answered by then misses it."""
_WAIT_S = 0.05
"""Longest wait for the next report, after which unanswered requests are checked again."""


class LockstepExchange:
    """Exchange and process control over the bus, with a barrier for each batch of steps."""

    def __init__(self, lobby: Lobby, controller: ProcessController) -> None:
        self._lobby = lobby
        self._controller = controller

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all participants of a batch. Those that return meanwhile, or are silent, are asked again."""
        lobby = self._lobby
        outputs: dict[ParticipantId, Outputs] = {}
        asked: dict[ParticipantId, tuple[int, float]] = {}
        give_up = time.monotonic() + BARRIER_S
        while time.monotonic() < give_up:
            self._ask(inputs, outputs, asked)
            if all(name in outputs or not lobby.is_expected(name) for name in inputs):
                break
            report = lobby.next(_WAIT_S)
            while report is not None:
                name, step = report[0], report[1].outputs.step
                if name in inputs and step == inputs[name].observation.step + 1:
                    outputs[name] = report[1].outputs
                report = lobby.next(0.0)
        lobby.forget_newcomers()
        return outputs

    def _ask(
        self,
        inputs: Mapping[ParticipantId, Inputs],
        outputs: Mapping[ParticipantId, Outputs],
        asked: dict[ParticipantId, tuple[int, float]],
    ) -> None:
        """Send requests to ready participants without outputs: at once, and again after a while or a return."""
        lobby, now_s = self._lobby, time.monotonic()
        for name in inputs:
            arrivals = lobby.arrivals(name)
            arrivals_then, asked_s = asked.get(name, (-1, 0.0))
            due = arrivals_then != arrivals or now_s - asked_s > RETRY_S
            if lobby.is_ready(name) and name not in outputs and due:
                asked[name] = arrivals, now_s
                lobby.request(name, StepRequest(VERSION, inputs[name]), blocking=True)

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
