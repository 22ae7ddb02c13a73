"""A participant that signs: the edge of its state machine, which knows no key."""

from kantor_protocol.base.machine import Inputs, Outputs, StateMachine
from kantor_protocol.wire.attestations import signed_outputs
from kantor_protocol.wire.signatures import SigningKey


class Signing:
    """A state machine whose attestations are signed on their way out."""

    def __init__(self, machine: StateMachine, run: str, key: SigningKey) -> None:
        """run: the name of the run, in which the signatures count. key: the participant's."""
        self._machine = machine
        self._run = run
        self._key = key

    @property
    def machine(self) -> StateMachine:
        """The machine within."""
        return self._machine

    def step(self, inputs: Inputs, /) -> Outputs:
        """Make one step."""
        return signed_outputs(self._run, self._machine.step(inputs), self._key)

    def validate(self) -> None:
        """Assert the invariants of the machine, if it has any."""
        if callable(validate := getattr(self._machine, "validate", None)):
            validate()
