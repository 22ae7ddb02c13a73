"""A participant that survives the end of its process.

Theory of operation
-------------------
1. Inputs are written to the *write-ahead log* (WAL) before the machine steps, and outputs are sent only after that.
   So spending is on record before it counts, and no crash makes a robot spend twice.
2. A machine is a pure function of its inputs. The log therefore determines the machine: it is built anew and steps
   through all entries, which restores it to the last bit.
3. A step is done once. When the last step is requested again, because its report was lost with a process or on the
   way, the participant answers with the same outputs.
4. A log that lacks a step that world-sim knows (its end is torn, or all of it is lost) cannot be used: other
   participants may hold log entries that it lacks. The participant then goes on as a new *incarnation*, with a log
   of its own; the replicated log of the one before comes back from peers, as that of any other origin does.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import msgspec

from kantor_protocol.base.machine import Body, Inputs, Outputs, StateMachine
from kantor_protocol.scenario.faults.processes import Disk
from kantor_protocol.wire.messages import decode_inputs, encode

BuildMachine = Callable[[Body], StateMachine]
"""Builds a participant's machine as it is when it takes a body over."""


class WalContents(NamedTuple):
    """The contents of a write-ahead log."""

    initial_state: Body
    """The body that the machine took over when it was built."""
    inputs: Sequence[bytes]
    """Encoded Inputs of each of its steps, in order."""


class WriteAheadLog(Protocol):
    """The inputs of a participant, written before each step."""

    def read(self) -> WalContents | None:
        """The sound beginning of the log; None if there is none. Raises OSError."""
        ...

    def reset(self, initial_state: Body) -> None:
        """Discard all entries and begin a new log. Raises OSError."""
        ...

    def append(self, inputs: bytes) -> None:
        """Add an entry that outlives the process. Raises OSError, and then the entry is not there."""
        ...


class RecoverableNode:
    """A state machine with its write-ahead log. `step` is its only entrance, and `step_encoded` the same for bytes."""

    def __init__(self, build: BuildMachine, wal: WriteAheadLog, body: Body) -> None:
        """Recover from the log, or begin a new incarnation with a new log.

        body: what world-sim knows of the body that is taken over. Raises OSError if the log cannot be written.
        """
        self._wal = wal
        self._last_inputs: Inputs | None = None
        self._last_outputs: Outputs | None = None
        contents = wal.read()
        if contents is None or not _covers(contents, body):
            contents = WalContents(_reincarnated(body), ())
            wal.reset(contents.initial_state)
        self.incarnation = contents.initial_state.incarnation
        self._machine = build(contents.initial_state)
        self.step_count = contents.initial_state.step
        """The number of its last step."""
        for entry in contents.inputs:
            self._advance(decode_inputs(entry))

    @property
    def machine(self) -> StateMachine:
        """The machine as it is now."""
        return self._machine

    @property
    def last_step(self) -> tuple[Inputs, Outputs] | None:
        """Inputs and outputs of its last step, if it has made one."""
        if self._last_inputs is None or self._last_outputs is None:
            return None
        return self._last_inputs, self._last_outputs

    def step(self, inputs: Inputs, /) -> Outputs:
        """Make the next step, written ahead, or repeat the last outputs. Raises OSError if it cannot be written."""
        return self._step(inputs, encode(inputs))

    def step_encoded(self, entry: bytes, /) -> Outputs:
        """`step`, of encoded Inputs."""
        return self._step(decode_inputs(entry), entry)

    def _step(self, inputs: Inputs, entry: bytes) -> Outputs:
        if self._last_outputs is not None and inputs.observation.step < self.step_count:
            return self._last_outputs
        self._wal.append(entry)
        return self._advance(inputs)

    def validate(self) -> None:
        """Assert that the last step is that of the last inputs, and the invariants of the machine, if it has any."""
        if (last := self.last_step) is not None:
            assert last[1].step == self.step_count == last[0].observation.step + 1
        if callable(validate := getattr(self._machine, "validate", None)):
            validate()

    def _advance(self, inputs: Inputs) -> Outputs:
        self._last_inputs, self._last_outputs = inputs, self._machine.step(inputs)
        self.step_count = self._last_outputs.step
        return self._last_outputs


class InMemoryLog:
    """A write-ahead log in memory: it outlives the node that writes it, not their process."""

    def __init__(self) -> None:
        self._initial_state: Body | None = None
        self._inputs: list[bytes] = []

    def read(self) -> WalContents | None:
        """All of it."""
        if self._initial_state is None:
            return None
        return WalContents(self._initial_state, tuple(self._inputs))

    def reset(self, initial_state: Body) -> None:
        """Discard all entries and begin a new log."""
        self._initial_state, self._inputs = initial_state, []

    def append(self, inputs: bytes) -> None:
        """Add an entry."""
        self._inputs.append(inputs)

    def damage(self, disk: Disk, step: int) -> None:
        """Lose nothing, all, or the end with the entry of the last step that world-sim knows."""
        if self._initial_state is None or disk == "kept":
            return
        del self._inputs[max(0, step - self._initial_state.step - 1) :]
        if disk == "lost":
            self._initial_state = None


class KillableNode:
    """A participant in this process that can be killed and started again; its write-ahead log is in memory."""

    def __init__(self, build: BuildMachine, body: Body) -> None:
        """body: what it takes over at time 0."""
        self._build = build
        self._wal = InMemoryLog()
        self._node: RecoverableNode | None = RecoverableNode(build, self._wal, body)

    @property
    def machine(self) -> StateMachine | None:
        """The machine as it is now; None while it is killed."""
        return None if self._node is None else self._node.machine

    def step(self, inputs: Inputs, /) -> Outputs:
        """Make a step, see RecoverableNode. It must not be called while the participant is killed."""
        return self.step_encoded(encode(inputs))

    def step_encoded(self, entry: bytes, /) -> Outputs:
        """`step`, of encoded Inputs."""
        assert self._node is not None
        return self._node.step_encoded(entry)

    def validate(self) -> None:
        """Assert the invariants of the node, unless it is killed."""
        if self._node is not None:
            self._node.validate()

    def kill(self) -> None:
        """Discard everything but the write-ahead log."""
        self._node = None

    def start(self, body: Body, disk: Disk) -> tuple[int, int]:
        """Recover from what is left of the write-ahead log; the incarnation, and the number of its last step."""
        self._wal.damage(disk, body.step)
        self._node = RecoverableNode(self._build, self._wal, body)
        return self._node.incarnation, self._node.step_count


def _covers(contents: WalContents, body: Body) -> bool:
    """Whether a log goes as far as world-sim's knowledge, or farther."""
    return (
        contents.initial_state.incarnation == body.incarnation
        and contents.initial_state.step + len(contents.inputs) >= body.step
    )


def _reincarnated(body: Body) -> Body:
    """The body as a new incarnation takes it over; one that has made no step needs none."""
    return (
        body if body.step == 0 else msgspec.structs.replace(body, incarnation=body.incarnation + 1)
    )
