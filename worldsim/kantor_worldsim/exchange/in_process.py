"""The in-process exchange: participants are objects in this process. What they say to one another is still encoded."""

from collections.abc import Mapping

import msgspec

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
from kantor_protocol.wire.messages import encode
from kantor_worldsim.exchange.membership import JoinDecision, Membership

_decode_outputs = msgspec.msgpack.Decoder(Outputs).decode
"""Their numbers are checked by the simulation."""


class _PermanentNode:
    """A participant that no fault of the scenario kills: its state machine."""

    def __init__(self, machine: StateMachine) -> None:
        self.step = machine.step

    def start(self, body: Body, _disk: Disk) -> tuple[int, int]:
        """A late joiner has existed since the start, and was not asked until now."""
        return body.incarnation, body.step


class InProcessExchange:
    """Exchange and process control for participants in this process.

    Outputs pass through the codec, so that they are of the types that they have on the bus. Inputs are passed as they
    are: frozen values of world-sim, with what participants say to one another as bytes.
    """

    def __init__(self, machines: Mapping[ParticipantId, StateMachine]) -> None:
        """machines: a `KillableNode` for each participant that the scenario kills."""
        self._nodes = {
            name: machine if isinstance(machine, KillableNode) else _PermanentNode(machine)
            for name, machine in machines.items()
        }
        self._starts = dict.fromkeys(machines, 0)
        """Number of restarts of each participant."""
        self._membership = Membership(machines)
        for name in machines:
            self._membership.join(name, self._nonce(name))

    def __call__(
        self, inputs: Mapping[ParticipantId, Inputs], /
    ) -> Mapping[ParticipantId, Outputs]:
        """Step all participants of a batch."""
        nodes = self._nodes
        return {
            name: _decode_outputs(encode(nodes[name].step(given))) for name, given in inputs.items()
        }

    def kill(self, name: ParticipantId) -> None:
        """Kill a participant. World-sim itself is rebuilt from its records by the event loop."""
        if name == WORLD_SIM:
            return
        node = self._nodes[name]
        if not isinstance(node, KillableNode):
            raise TypeError(f"{name} is killed in this scenario; pass a KillableNode")
        node.kill()
        self._membership.leave(name, self._nonce(name))

    def start(self, name: ParticipantId, body: Body, disk: Disk) -> tuple[int, int]:
        """Start a participant that was killed, or is late; its (incarnation, last step)."""
        node = self._nodes[name]
        if isinstance(node, KillableNode):
            self._starts[name] += 1
            self._membership.join(name, self._nonce(name))
        return node.start(body, disk)

    def admits_impostor(self, name: ParticipantId) -> bool:
        """Whether a second process under this id would be admitted; it leaves again at once."""
        decision = self._membership.join(name, "impostor")
        self._membership.leave(name, "impostor")
        return decision in {JoinDecision.NEW, JoinDecision.BACK}

    def _nonce(self, name: ParticipantId) -> str:
        return f"{name}, start {self._starts[name]}"
