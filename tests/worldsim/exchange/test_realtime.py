"""The realtime exchange: the outbox of a participant, and which reported inboxes are possible."""

from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import Envelope
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import INBOX_MAX
from kantor_worldsim.engine.process_faults import schedule_of
from kantor_worldsim.exchange.config import needs_process_control
from kantor_worldsim.exchange.fault_injector import world_starts_ns
from kantor_worldsim.exchange.realtime import Outbox
from support.strategies import examples, mission


def envelope(sequence: int) -> Envelope:
    return Envelope("r1", sequence, "", b"")


NUMBERS = st.lists(st.integers(0, 5), max_size=12)


@given(handed=NUMBERS, kept=st.lists(st.booleans(), min_size=12, max_size=12))
@examples(300)
def test_any_reported_part_of_the_handed_out_inbox_is_accepted(
    handed: list[int], kept: list[bool]
) -> None:
    """A full queue drops some; the rest is in order. Numbers may occur twice, as duplicates do."""
    outbox = Outbox()
    outbox.waiting += [envelope(number) for number in handed]
    assert [e.sequence for e in outbox.hand()] == handed
    arrived = [number for number, stays in zip(handed, kept, strict=False) if stays]
    heard = outbox.received(tuple(("r1", number) for number in arrived))

    assert heard is not None
    assert [e.sequence for e in heard] == arrived
    assert len(outbox.handed) <= len(handed) - len(arrived)


@given(handed=NUMBERS, reported=NUMBERS)
@examples(300)
def test_no_other_reported_inbox_is_accepted(handed: list[int], reported: list[int]) -> None:
    """Against the stated rule: an inbox is a subsequence of what was handed out."""
    outbox = Outbox()
    outbox.waiting += [envelope(number) for number in handed]
    outbox.hand()
    rest = iter(handed)
    possible = all(number in rest for number in reported)

    assert (outbox.received(tuple(("r1", number) for number in reported)) is not None) == possible
    if not possible:
        assert [e.sequence for e in outbox.handed] == handed


def test_the_outbox_of_a_silent_participant_is_bounded() -> None:
    outbox = Outbox()
    outbox.waiting += [envelope(i) for i in range(3 * INBOX_MAX)]
    first = outbox.hand()
    outbox.waiting += [envelope(i) for i in range(3 * INBOX_MAX, 5 * INBOX_MAX)]
    assert outbox.hand() == ()
    assert len(first) == len(outbox.waiting) == INBOX_MAX
    outbox.received(tuple((e.source, e.sequence) for e in first))
    assert [e.sequence for e in outbox.hand()] == list(range(4 * INBOX_MAX, 5 * INBOX_MAX))
    assert len(outbox.waiting) == 0


def with_faults(*faults: str) -> Scenario:
    return mission(f"faults=[{', '.join(faults)}]")


KILL = '{kind="kill", who=["r1"], from_s=1, until_s=2}'
PAUSE = '{kind="pause", who=["r2"], from_s=1, until_s=2}'
CLOCK = '{kind="clock", who=["r2"], offset_s=3}'
DROP = '{kind="drop", probability=0.5}'


def test_faults_of_real_processes_need_process_control() -> None:
    """In lockstep a pause needs none; a clock is set by a message."""
    assert needs_process_control(with_faults(DROP, CLOCK), "wall") is None
    assert needs_process_control(with_faults(DROP, PAUSE), "lockstep") is None
    assert needs_process_control(with_faults(DROP, PAUSE), "wall") == "faults[1]: pause"
    assert needs_process_control(with_faults(CLOCK, DROP, KILL), "lockstep") == "faults[2]: kill"


def test_a_killed_world_sim_knows_the_time_of_its_restart() -> None:
    """Other scheduled faults may be due before."""
    schedule = schedule_of(
        with_faults(
            '{kind="kill", who=["worldsim"], from_s=3, until_s=5}',
            '{kind="pause", who=["r2"], from_s=2, until_s=4}',
        )
    )
    starts = [world_starts_ns(schedule, done) for done in range(len(schedule) + 1)]

    assert [scheduled.kind for scheduled in schedule] == ["pause", "kill", "resume", "start"]
    assert starts == [None, None, 5 * 10**9, 5 * 10**9, None]
