"""A participant that outlives its process.

Theory of operation
-------------------
1. What reaches a machine is noted in its *diary* before the machine steps, and a step is told to nobody
   before it is noted. So spending is on record before it counts (write-ahead), and no crash makes a robot
   spend twice.
2. A machine is a pure function of its inputs. Whoever has the diary has the machine: it is built anew and
   steps through the pages, to the last bit.
3. A step is done once. Asked again for the step that it did last, because the answer was lost with a
   process or on the way, a participant gives the same answer again.
4. A diary that lacks a step that the world knows of (its end is torn, or all of it is lost) is no use:
   others may hold entries that it has forgotten. Its owner goes on as a new *incarnation*, with a log of
   its own; the log of the one before comes back from peers, as anybody's does.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import msgspec

from kantor_protocol.base.machine import Body, Inputs, Outputs, StateMachine
from kantor_protocol.scenario.faults.processes import Disk
from kantor_protocol.wire.messages import decode_inputs, encode

Build = Callable[[Body], StateMachine]
"""Makes a participant's machine as it is when it takes a body over."""


class WalContents(NamedTuple):
    """What a diary holds."""

    initial_state: Body
    """What the machine took over when it was built."""
    inputs: Sequence[bytes]
    """Encoded Inputs of each of its steps, in order."""


class WriteAheadLog(Protocol):
    """Where a participant notes what reaches it."""

    def read(self) -> WalContents | None:
        """All that is sound from its beginning on; None if there is nothing."""
        ...

    def begin(self, initial_state: Body) -> None:
        """Throw away what there is, and begin anew. Raises OSError."""
        ...

    def note(self, inputs: bytes) -> None:
        """Add a page that outlives the process. Raises OSError, and then the page is not there."""
        ...


class RecoverableNode:
    """A machine with its diary. `step` is its only entrance, also for what is encoded already."""

    def __init__(self, build: Build, wal: WriteAheadLog, body: Body) -> None:
        """body: what the world knows of what it takes over. Raises OSError if nothing can be noted."""
        self._wal = wal
        self._told: Outputs | None = None
        self._given: Inputs | None = None
        entries = wal.read()
        if entries is None or not _covers(entries, body):
            entries = WalContents(_reincarnated(body), ())
            wal.begin(entries.initial_state)
        self.incarnation = entries.initial_state.incarnation
        """Which incarnation it is."""
        self._machine = build(entries.initial_state)
        self.step_count = entries.initial_state.step
        """Its last step."""
        for entry in entries.inputs:
            self._live(decode_inputs(entry))

    @property
    def unheard(self) -> tuple[Inputs, Outputs] | None:
        """Its last step with what it was given, if it has made one."""
        return (self._given, self._told) if self._given and self._told else None

    def step(self, inputs: Inputs, /) -> Outputs:
        """The next step, noted ahead; or the last one again. Raises OSError if it cannot be noted."""
        return self.step_encoded(encode(inputs))

    def step_encoded(self, entry: bytes, /) -> Outputs:
        """`step`, of encoded Inputs."""
        inputs = decode_inputs(entry)
        if self._told is not None and inputs.observation.step < self.step_count:
            return self._told
        self._wal.note(entry)
        return self._live(inputs)

    def _live(self, inputs: Inputs) -> Outputs:
        self._given, self._told = inputs, self._machine.step(inputs)
        self.step_count = self._told.step
        return self._told


class InMemoryLog:
    """A diary in memory: it outlives its owner, not the process that both are in."""

    def __init__(self) -> None:
        self._birth: Body | None = None
        self._inputs: list[bytes] = []

    def read(self) -> WalContents | None:
        """All of it."""
        return None if self._birth is None else WalContents(self._birth, tuple(self._inputs))

    def begin(self, initial_state: Body) -> None:
        """Anew."""
        self._birth, self._inputs = initial_state, []

    def note(self, inputs: bytes) -> None:
        """One more page."""
        self._inputs.append(inputs)

    def damage(self, disk: Disk, step: int) -> None:
        """Lose all, or the end with the page of the last step that the world knows of."""
        if self._birth is None or disk == "kept":
            return
        del self._inputs[max(0, step - self._birth.step - 1) :]
        if disk == "lost":
            self._birth = None


class KillableNode:
    """A participant in this process that can be killed; its diary is in memory."""

    def __init__(self, build: Build, body: Body) -> None:
        """body: what it takes over at time 0."""
        self._build = build
        self._wal = InMemoryLog()
        self._life: RecoverableNode | None = RecoverableNode(build, self._wal, body)

    def step(self, inputs: Inputs, /) -> Outputs:
        """See `Life`. Nobody may ask the dead."""
        return self.step_encoded(encode(inputs))

    def step_encoded(self, entry: bytes, /) -> Outputs:
        """`step`, of encoded Inputs."""
        assert self._life is not None
        return self._life.step_encoded(entry)

    def kill(self) -> None:
        """All is gone but the diary."""
        self._life = None

    def start(self, body: Body, disk: Disk) -> tuple[int, int]:
        """Go on with what is left of the diary; the epoch, and the last step."""
        self._wal.damage(disk, body.step)
        self._life = RecoverableNode(self._build, self._wal, body)
        return self._life.incarnation, self._life.step_count


def _covers(entries: WalContents, body: Body) -> bool:
    """Whether a diary goes as far as the world's knowledge, or farther."""
    return (
        entries.initial_state.incarnation == body.incarnation
        and entries.initial_state.step + len(entries.inputs) >= body.step
    )


def _reincarnated(body: Body) -> Body:
    """The body as a new incarnation takes it over; who has never acted needs none."""
    return (
        body if body.step == 0 else msgspec.structs.replace(body, incarnation=body.incarnation + 1)
    )
