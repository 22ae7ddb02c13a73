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

    birth: Body
    """What the machine took over when it was built."""
    inputs: Sequence[bytes]
    """Encoded Inputs of each of its steps, in order."""


class WriteAheadLog(Protocol):
    """Where a participant notes what reaches it."""

    def read(self) -> WalContents | None:
        """All that is sound from its beginning on; None if there is nothing."""
        ...

    def begin(self, birth: Body) -> None:
        """Throw away what there is, and begin anew. Raises OSError."""
        ...

    def note(self, inputs: bytes) -> None:
        """Add a page that outlives the process. Raises OSError, and then the page is not there."""
        ...


class RecoverableNode:
    """A machine with its diary. `step` is its only entrance, also for what is encoded already."""

    def __init__(self, build: Build, diary: WriteAheadLog, body: Body) -> None:
        """body: what the world knows of what it takes over. Raises OSError if nothing can be noted."""
        self._diary = diary
        self._told: Outputs | None = None
        self._given: Inputs | None = None
        pages = diary.read()
        if pages is None or not _covers(pages, body):
            pages = WalContents(_reincarnated(body), ())
            diary.begin(pages.birth)
        self.epoch = pages.birth.epoch
        """Which incarnation it is."""
        self._machine = build(pages.birth)
        self.step_count = pages.birth.step
        """Its last step."""
        for page in pages.inputs:
            self._live(decode_inputs(page))

    @property
    def unheard(self) -> tuple[Inputs, Outputs] | None:
        """Its last step with what it was given, if it has made one."""
        return (self._given, self._told) if self._given and self._told else None

    def step(self, inputs: Inputs, /) -> Outputs:
        """The next step, noted ahead; or the last one again. Raises OSError if it cannot be noted."""
        return self.take(encode(inputs))

    def take(self, page: bytes, /) -> Outputs:
        """`step`, of encoded Inputs."""
        inputs = decode_inputs(page)
        if self._told is not None and inputs.observation.step < self.step_count:
            return self._told
        self._diary.note(page)
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

    def begin(self, birth: Body) -> None:
        """Anew."""
        self._birth, self._inputs = birth, []

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
        self._diary = InMemoryLog()
        self._life: RecoverableNode | None = RecoverableNode(build, self._diary, body)

    def step(self, inputs: Inputs, /) -> Outputs:
        """See `Life`. Nobody may ask the dead."""
        return self.take(encode(inputs))

    def take(self, page: bytes, /) -> Outputs:
        """`step`, of encoded Inputs."""
        assert self._life is not None
        return self._life.take(page)

    def kill(self) -> None:
        """All is gone but the diary."""
        self._life = None

    def start(self, body: Body, disk: Disk) -> tuple[int, int]:
        """Go on with what is left of the diary; the epoch, and the last step."""
        self._diary.damage(disk, body.step)
        self._life = RecoverableNode(self._build, self._diary, body)
        return self._life.epoch, self._life.step_count


def _covers(pages: WalContents, body: Body) -> bool:
    """Whether a diary goes as far as the world's knowledge, or farther."""
    return pages.birth.epoch == body.epoch and pages.birth.step + len(pages.inputs) >= body.step


def _reincarnated(body: Body) -> Body:
    """The body as a new incarnation takes it over; who has never acted needs none."""
    return body if body.step == 0 else msgspec.structs.replace(body, epoch=body.epoch + 1)
