"""Lives: what outlives a process, and who comes back."""

from collections.abc import Callable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from kantor_protocol.base.machine import Body, Inputs, Observation, Outputs, Pose
from kantor_protocol.node.recovery import InMemoryLog, KillableNode, RecoverableNode
from kantor_protocol.scenario.faults.processes import Disk
from kantor_protocol.wire.messages import encode
from support.strategies import examples

HOME = Body(Pose(1.0, 2.0))


class Rememberer:
    """A machine whose outputs tell apart all that ever reached it, and what it took over."""

    def __init__(self, body: Body) -> None:
        self._step = body.step
        self._memory = 1000 * body.incarnation + body.energy_spent

    def step(self, inputs: Inputs, /) -> Outputs:
        self._step += 1
        self._memory = (31 * self._memory + inputs.now_ns) % 1_000_003
        return Outputs(self._step, Pose(0.0, 0.0), refused=self._memory)


def turn(step: int, now_ns: int) -> Inputs:
    """What a participant is asked whose last accepted step is this."""
    return Inputs(now_ns, Observation(step, Pose(0.0, 0.0)))


def told(
    machine: Rememberer | RecoverableNode | KillableNode, times_ns: Sequence[int], step: int = 0
) -> list[int]:
    """What comes of turns at these times, after so many steps."""
    return [machine.step(turn(step + i, now_ns)).refused for i, now_ns in enumerate(times_ns)]


def at(step: int, incarnation: int = 0) -> Body:
    """What the world knows of a body after so many steps; each has cost a point."""
    return Body(Pose(float(step), 0.0), step, step, incarnation)


TIMES = st.lists(st.integers(1, 10**6), min_size=1, max_size=8)


@examples(100)
@given(before=TIMES, after=TIMES)
def test_who_has_the_diary_has_the_machine(before: list[int], after: list[int]) -> None:
    """Built anew from its diary it goes on as if nothing had been."""
    wal = InMemoryLog()
    first = told(RecoverableNode(Rememberer, wal, HOME), before)
    again = RecoverableNode(Rememberer, wal, at(len(before)))

    assert (again.incarnation, again.step_count) == (0, len(before))
    assert first + told(again, after, len(before)) == told(Rememberer(HOME), before + after)


@examples(50)
@given(times_ns=TIMES, again=st.integers(0, 3))
def test_step_is_done_once(times_ns: list[int], again: int) -> None:
    """Asked again for its last step it answers from memory, before its death and after."""
    wal = InMemoryLog()
    life = RecoverableNode(Rememberer, wal, HOME)
    last = turn(len(times_ns) - 1, times_ns[-1])
    first = told(life, times_ns)
    answers = [life.step(last).refused for _ in range(again)]
    reborn = RecoverableNode(Rememberer, wal, at(len(times_ns) - 1))

    assert answers == [first[-1]] * again
    assert reborn.step(last).refused == first[-1]
    assert reborn.last_step == (last, reborn.step(last))
    assert len(wal.read() or ()) == 2
    assert told(life, [7], len(times_ns)) == told(Rememberer(HOME), [*times_ns, 7])[-1:]


@examples(50)
@given(times_ns=TIMES)
def test_encoded_turns_are_turns(times_ns: list[int]) -> None:
    """What comes encoded is noted as it came, and answered like any turn; also when it comes again."""
    wal = InMemoryLog()
    life = RecoverableNode(Rememberer, wal, HOME)
    entries = [encode(turn(i, now_ns)) for i, now_ns in enumerate(times_ns)]
    answers = [life.step_encoded(entry).refused for entry in (*entries, entries[-1])]
    read = wal.read()

    assert answers == [*(first := told(Rememberer(HOME), times_ns)), first[-1]]
    assert read is not None
    assert list(read.inputs) == entries


class FullDisk(InMemoryLog):
    """A diary that cannot be written at times."""

    full = False

    def append(self, inputs: bytes) -> None:
        if self.full:
            raise OSError("full")
        super().append(inputs)


def test_what_cannot_be_noted_is_not_done() -> None:
    """On a full disk the machine stands still; when there is room again it goes on where it was."""
    wal = FullDisk()
    life = RecoverableNode(Rememberer, wal, HOME)
    before = told(life, [1, 2])
    wal.full = True
    with pytest.raises(OSError, match="full"):
        life.step(turn(2, 3))
    wal.full = False

    assert life.step_count == 2
    assert before + told(life, [4], 2) == told(Rememberer(HOME), [1, 2, 4])


def torn(wal: InMemoryLog) -> None:
    wal.damage("torn", 3)


def lost(wal: InMemoryLog) -> None:
    wal.damage("lost", 3)


@pytest.mark.parametrize("damage", [torn, lost])
def test_who_lacks_a_step_that_others_know_of_is_another(
    damage: Callable[[InMemoryLog], None],
) -> None:
    """It knows what the world tells of the body, and nothing else."""
    wal = InMemoryLog()
    told(RecoverableNode(Rememberer, wal, HOME), [1, 2, 3])
    damage(wal)
    reborn = RecoverableNode(Rememberer, wal, at(3))

    assert (reborn.incarnation, reborn.step_count, reborn.last_step) == (1, 3, None)
    assert told(reborn, [4, 5], 3) == told(Rememberer(at(3, incarnation=1)), [4, 5], 3)


@pytest.mark.parametrize("damage", [torn, lost])
def test_who_never_acted_stays_the_same(damage: Callable[[InMemoryLog], None]) -> None:
    """Nobody can hold anything of it."""
    wal = InMemoryLog()
    RecoverableNode(Rememberer, wal, HOME)
    damage(wal)

    assert RecoverableNode(Rememberer, wal, HOME).incarnation == 0


def test_diary_of_another_incarnation_is_no_use() -> None:
    """A process that comes back after another took its body over must not write on in its old log."""
    wal = InMemoryLog()
    told(RecoverableNode(Rememberer, wal, HOME), [1, 2, 3, 4])

    assert RecoverableNode(Rememberer, wal, at(3, incarnation=2)).incarnation == 3


DISKS: st.SearchStrategy[Disk] = st.sampled_from(["kept", "torn", "lost"])
ORDERS = st.lists(
    st.tuples(st.sampled_from(["step", "kill", "die in a step"]), DISKS, st.integers(1, 10**6)),
    max_size=20,
)


@examples(300)
@given(ORDERS)
def test_nothing_is_lost_and_nothing_is_twice(orders: list[tuple[str, Disk, int]]) -> None:
    """However a participant dies, what it told stands, and the same step is never told in two ways.

    An incarnation is the machine that took over the body as the world knew it, and knows what it told.
    """
    mortal = KillableNode(Rememberer, HOME)
    initial_state, body = HOME, HOME
    times_ns: list[int] = []
    for order, disk, now_ns in orders:
        asked = turn(body.step, now_ns)
        if order == "die in a step":
            mortal.step(asked)
        if order != "step":
            mortal.kill()
            known = body
            forgets = disk == "lost" or (disk == "torn" and body.step > initial_state.step)
            if forgets and body.step:
                body = replace(body, incarnation=body.incarnation + 1)
                initial_state, times_ns = body, []
            unheard = order == "die in a step" and disk == "kept"
            assert mortal.start(known, disk) == (body.incarnation, body.step + unheard)
        if order != "kill":
            times_ns.append(now_ns)
            outputs = mortal.step(asked)
            assert outputs.step == body.step + 1
            assert outputs.refused == told(Rememberer(initial_state), times_ns)[-1]
            body = at(outputs.step, body.incarnation)
