"""The lockstep exchange: everybody due steps, then all go on together."""

import time
from collections.abc import Mapping

from kantor_protocol.base.machine import WORLD_SIM, Body, Inputs, Outputs, ParticipantId
from kantor_protocol.scenario.faults.processes import Disk
from kantor_protocol.wire.messages import VERSION, StepRequest, encode
from kantor_worldsim.exchange.lobby import AGAIN_S, Lobby, wait_for
from kantor_worldsim.exchange.process_control import ProcessCommand

BARRIER_S = 10.0
"""Lockstep: a participant that has not answered by then misses the step."""


class LockstepExchange:
    """The crew over the bus, with a barrier: everybody due steps, then all go on together."""

    def __init__(self, lobby: Lobby) -> None:
        self._lobby = lobby

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all of a batch. Whoever comes back meanwhile, or is silent, is asked again."""
        lobby = self._lobby
        outputs: dict[ParticipantId, Outputs] = {}
        asked: dict[ParticipantId, tuple[int, float]] = {}
        give_up = time.monotonic() + BARRIER_S
        while time.monotonic() < give_up:
            now_s = time.monotonic()
            for name in inputs:
                visit = lobby.visits[name]
                before, asked_s = asked.get(name, (-1, 0.0))
                due = before != visit or now_s - asked_s > AGAIN_S
                if name in lobby.ready and name not in outputs and due:
                    asked[name] = visit, now_s
                    lobby.host.send(name, encode(StepRequest(VERSION, inputs[name])), blocking=True)
            if all(name in outputs or not lobby.is_expected(name) for name in inputs):
                break
            report = lobby.next(0.05)
            while report is not None:
                name, step = report[0], report[1].outputs.step
                if name in inputs and step == inputs[name].observation.step + 1:
                    outputs[name] = report[1].outputs
                report = lobby.next(0.0)
        lobby.newcomers.clear()  # they start no clock
        return outputs

    def kill(self, name: ParticipantId) -> None:
        """End a process; world-sim's own does not return from here."""
        lobby = self._lobby
        if name == WORLD_SIM:
            self._order(ProcessCommand("restart", WORLD_SIM))
            return
        lobby.excused.add(name)
        self._order(ProcessCommand("kill", name))
        wait_for(lobby, lambda: not lobby.is_there(name), f"{name} was killed and is still there")

    def start(self, name: ParticipantId, body: Body, disk: Disk) -> tuple[int, int]:
        """Start a process, and wait until it is ready."""
        lobby, visit = self._lobby, self._lobby.visits[name]
        self._order(ProcessCommand("start", name, disk, body.step))
        wait_for(lobby, lambda: lobby.visits[name] > visit, f"{name} was started and did not come")
        lobby.excused.discard(name)
        told = lobby.told[name]
        return told.incarnation, told.step

    def pretend(self, name: ParticipantId) -> bool:
        """Start a second process under an id, and see whether it is sent away."""
        self._order(ProcessCommand("pretend", name))
        refused: bool | None = None

        def ended() -> bool:
            nonlocal refused
            refused = self._order(ProcessCommand("refused", name))
            return refused is not None

        wait_for(self._lobby, ended, f"{name}: what became of the impostor?")
        return not refused

    def _order(self, order: ProcessCommand) -> bool | None:
        hands = self._lobby.hands
        assert hands is not None, "faults of processes need hands"
        return hands(order)
