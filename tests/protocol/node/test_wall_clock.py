"""The inbox of a participant on its own clock: bounded in number and in bytes, so that it can always be written ahead."""

from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import Body, Envelope, Inputs, Observation, Pose
from kantor_protocol.node.wal import WalFile
from kantor_protocol.node.wall_clock import INBOX_MAX, WallClock
from kantor_protocol.wire.messages import (
    BODY_BYTES_MAX,
    INBOX_BYTES_MAX,
    INPUTS_BYTES_MAX,
    VERSION,
    Array,
    Mission,
    StartClock,
    encode,
    envelope_bytes,
)
from kantor_worldsim.world.world import WorldSetup
from support.strategies import examples, mission

HERE = Observation(0, Pose(0.0, 0.0))


def clock() -> WallClock:
    """The clock of r1 in a mission that begins."""
    scenario = mission()
    setup = WorldSetup.of(scenario, 1)
    arrays = Array.of(setup.starts_m), Array.of(setup.samples_m)
    body = Body(Pose(0.0, 0.0))
    whole = Mission(VERSION, "n", scenario, 1, *arrays, "wall", None, "run", body)
    return WallClock(whole, "r1", StartClock(VERSION, "n", 0, 1.0, HERE))


@given(
    st.lists(
        st.tuples(st.integers(1, 900), st.sampled_from([0, 1, 1100, 40_000, BODY_BYTES_MAX])),
        max_size=8,
    )
)
@examples(30)
def test_a_full_inbox_can_be_written_ahead(portions: list[tuple[int, int]]) -> None:
    """Whatever arrives in whatever portions: the newest are kept, in order, and fit into an entry of the log."""
    inbox, sent = clock(), 0
    for count, size in portions:
        numbers = range(sent, sent + count)
        inbox.enqueue(Inputs(0, HERE, tuple(Envelope("r2", n, "", bytes(size)) for n in numbers)))
        sent += count
    kept = [envelope.sequence for envelope in inbox.inbox]

    assert kept == [*range(sent - len(kept), sent)]
    assert len(encode(inbox.inputs(1))) <= INPUTS_BYTES_MAX
    if len(kept) < min(sent, INBOX_MAX):
        held = sum(map(envelope_bytes, inbox.inbox))
        assert held + envelope_bytes(Envelope("r2", 0, "", bytes(BODY_BYTES_MAX))) > INBOX_BYTES_MAX


def test_a_full_inbox_of_ordinary_messages_costs_no_past(tmp_path: Path) -> None:
    """Of 1.1 kB each: the step after it, and those before and after, are found again."""
    inbox = clock()
    envelopes = tuple(Envelope("r2", n, "", bytes(1100)) for n in range(INBOX_MAX))
    small = encode(Inputs(1, HERE))
    inbox.enqueue(Inputs(0, HERE, envelopes))
    full = encode(inbox.inputs(1))
    wal = WalFile(tmp_path / "r1.diary", "run")
    wal.reset(Body(Pose(0.0, 0.0)))
    for entry in (small, full, small):
        wal.append(entry)
    wal.close()
    again = WalFile(tmp_path / "r1.diary", "run").read()

    assert len(inbox.inbox) == INBOX_MAX
    assert again is not None
    assert list(again.inputs) == [small, full, small]
