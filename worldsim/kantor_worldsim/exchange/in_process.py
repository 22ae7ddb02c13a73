"""The in-process exchange: participants are objects in this process; messages still pass through the codec."""

from collections.abc import Mapping

from kantor_protocol.base.machine import (
    WORLD_SIM,
    Body,
    Inputs,
    Outputs,
    ParticipantId,
    StateMachine,
)
from kantor_protocol.node.recovery import KillableNode
from kantor_protocol.scenario.faults.processes import Disk
from kantor_protocol.wire.messages import decode_inputs, encode
from kantor_worldsim.engine.event_loop import Crew, decode_outputs
from kantor_worldsim.exchange.membership import JoinDecision, Membership


def in_process(machines: Mapping[ParticipantId, StateMachine]) -> Crew:
    """The crew without processes. Whom the scenario has killed must be a `Mortal`."""
    return InProcessExchange(machines)


class InProcessExchange:
    """The crew without processes. Everything passes the codec, so nothing is shared."""

    def __init__(self, machines: Mapping[ParticipantId, StateMachine]) -> None:
        self._machines = machines
        self._lives = dict.fromkeys(machines, 0)
        """How often each participant was started anew."""
        self._admission = Membership(machines)
        for name in machines:
            self._admission.join(name, self._nonce(name))

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all of a batch."""
        machines = self._machines
        made = {}
        for name, given in inputs.items():
            machine, entry = machines[name], encode(given)
            outputs = (
                machine.step_encoded(entry)
                if type(machine) is KillableNode
                else machine.step(decode_inputs(entry))
            )
            made[name] = decode_outputs(encode(outputs))
        return made

    def kill(self, name: ParticipantId) -> None:
        """End a participant; nothing has to be done to world-sim, which is rebuilt."""
        if name != WORLD_SIM:
            self._mortal(name).kill()
            self._admission.leave(name, self._nonce(name))

    def start(self, name: ParticipantId, body: Body, disk: Disk) -> tuple[int, int]:
        """Start one that was killed, or is late."""
        machine = self._machines[name]
        if not isinstance(
            machine, KillableNode
        ):  # it has been there all the time, and was not asked
            return body.incarnation, body.step
        self._lives[name] += 1
        self._admission.join(name, self._nonce(name))
        return machine.start(body, disk)

    def pretend(self, name: ParticipantId) -> bool:
        """Have the register decide on somebody else; whoever gets in leaves again at once."""
        let_in = self._admission.join(name, "impostor") in {JoinDecision.NEW, JoinDecision.BACK}
        self._admission.leave(name, "impostor")
        return let_in

    def _nonce(self, name: ParticipantId) -> str:
        return f"{name}, life {self._lives[name]}"

    def _mortal(self, name: ParticipantId) -> KillableNode:
        machine = self._machines[name]
        if not isinstance(machine, KillableNode):
            raise TypeError(f"{name} is killed in this scenario; hand over a life.Mortal")
        return machine
