"""Log suffixes: what a replica sends to others and takes from them, and how the logs of a team converge."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.replication.replica_kernels import spend
from kantor_protocol.wire.weights import Units
from support.references.plain_gossip import claim, full_message, suffix, version_vector
from support.replication import replicas
from support.replication.small_replicas import (
    MODES,
    SPENDINGS,
    TEAM_SPENDINGS,
    LosslessRadio,
    N,
    Spendings,
    converged_weights,
    join,
    knowledge,
    replica,
    spend_each,
    team,
    weights_of,
)
from support.strategies import examples


@MODES
def test_suffix_that_leaves_a_gap_waits(*, ledger: bool) -> None:
    """A log is held as a prefix: what lies beyond a gap is not acknowledged."""
    held = replica(0, 2, ledger=ledger)
    message = (version_vector(2), suffix(1, 2, [(0, 1)]), b"")

    assert held.merge(1, *message)
    assert int(held.store.length[1]) == 0
    assert weights_of(held) == ([4] * N if ledger else [1, 4, 4, 4, 4, 4])


def test_suffix_that_overlaps_adds_what_is_new() -> None:
    """Entries that are held already are skipped."""
    held = replica(0, 2, ledger=True)
    held.merge(1, version_vector(2), suffix(1, 0, [(0, 1), (1, 2)]), b"")
    held.merge(1, version_vector(2), suffix(1, 1, [(1, 2), (2, 3)]), b"")

    assert replicas.entries(held, 1) == [(0, 1), (1, 2), (2, 3)]
    assert weights_of(held) == [3, 2, 1, 4, 4, 4]


def test_no_other_participant_writes_a_log() -> None:
    """Single writer: a suffix of the robot's own log changes nothing, whichever participant sends it."""
    held = replica(0, 2, ledger=True)
    spend_each(held, [(0, 1)])
    before = knowledge(held)

    assert held.merge(1, version_vector(2), suffix(0, 0, [(0, 1), (1, 3)]), b"")
    assert knowledge(held) == before


def test_minimum_is_not_forwarded_for_others() -> None:
    """min: a suffix comes from its origin alone, whose log holds what it learned as well."""
    held = replica(0, 3, ledger=False)

    assert not held.merge(1, version_vector(3), suffix(2, 0, [(0, 1)]), b"")
    assert weights_of(held) == [4] * N


@MODES
def test_message_to_one_participant_needs_no_answer_first(*, ledger: bool) -> None:
    """A robot that reports to the supervisor sends new entries before it has received anything from it."""
    robot, supervisor = (replica(i, 2, ledger=ledger, relay=i == 1) for i in range(2))
    spend_each(robot, [(0, 1), (1, 2)])
    supervisor.merge(0, *robot.compose(1))

    assert weights_of(supervisor) == [3, 2, 4, 4, 4, 4]


@MODES
@pytest.mark.parametrize(("beacon", "informed"), [(True, True), (False, False)])
def test_beacon_of_state_informs_with_one_message(
    *, ledger: bool, beacon: bool, informed: bool
) -> None:
    """Beacon `state`: a robot that comes into range knows at once (Algorithm 3, line 5); with versions
    it takes an answer.
    """
    sender, receiver = (replica(i, 2, ledger=ledger, beacon=beacon) for i in range(2))
    for _ in range(20):
        spend_each(sender, [(0, 1)])
        spend_each(sender, [(1, 1)])
        sender.compose()
        sender.end_step()
    receiver.merge(0, *sender.compose())

    assert (weights_of(receiver) == weights_of(sender)) == informed
    assert weights_of(sender) == [0, 0, 4, 4, 4, 4]


@pytest.mark.parametrize(("relay", "waits"), [(True, 0), (False, 2)])
def test_relay_forwards_at_once_and_a_robot_after_its_timeout(*, relay: bool, waits: int) -> None:
    """A robot's neighbours most likely received the entries themselves; a supervisor's never do."""
    middle = replica(1, 3, ledger=True, relay=relay, timeout_steps=2)
    author, reader = replica(0, 3, ledger=True), replica(2, 3, ledger=True)
    middle.merge(2, *reader.compose())
    middle.merge(0, *author.compose())
    for _ in range(5):
        middle.compose()
        middle.end_step()
        middle.merge(2, *reader.compose())
    spend_each(author, [(0, 3)])
    middle.merge(0, version_vector(3), suffix(0, 0, replicas.entries(author, 0)), b"")
    steps = 0
    while weights_of(reader) == [4] * N:
        reader.merge(1, *middle.compose())
        middle.end_step()
        steps += 1

    assert steps - 1 == waits


def test_what_is_acknowledged_is_not_sent_again() -> None:
    """The version vector is the acknowledgement: a quiet team sends versions only."""
    made = team([[(0, 1)], [(1, 1)], [(2, 1)]], ledger=True)
    radio = LosslessRadio(made)
    for _ in range(12):
        radio.round()

    assert [held.compose()[1] for held in made] == [b""] * 3


@MODES
@examples(40)
@given(spent=st.tuples(SPENDINGS, SPENDINGS, SPENDINGS, SPENDINGS), timeout_steps=st.integers(1, 4))
def test_entries_travel_along_a_chain(
    *, ledger: bool, spent: tuple[Spendings, ...], timeout_steps: int
) -> None:
    """Four robots in a row, only neighbours hear each other: all come to the same weights,
    in a few rounds a hop.
    """
    made = [replica(i, 4, ledger=ledger, timeout_steps=timeout_steps) for i in range(4)]
    for held, spendings in zip(made, spent, strict=True):
        spend_each(held, spendings)

    LosslessRadio(made, lambda i, j: abs(i - j) == 1).rounds_until(
        converged_weights(made), 6 * (timeout_steps + 2)
    )


@MODES
@examples(40)
@given(
    spent=TEAM_SPENDINGS,
    later=TEAM_SPENDINGS,
    silence=st.integers(0, 40),
    timeout_steps=st.integers(1, 4),
)
def test_team_that_was_apart_agrees_when_it_meets(
    *,
    ledger: bool,
    spent: tuple[Spendings, ...],
    later: tuple[Spendings, ...],
    silence: int,
    timeout_steps: int,
) -> None:
    """However long no robot heard another, one encounter of a few rounds is enough."""
    made = [replica(i, 3, ledger=ledger, timeout_steps=timeout_steps) for i in range(3)]
    apart = LosslessRadio(made, lambda _i, _j: False)
    for i, held in enumerate(made):
        spend_each(held, spent[i])
    for _ in range(silence):
        apart.round()
    for i, held in enumerate(made):
        spend_each(held, later[i])

    LosslessRadio(made).rounds_until(converged_weights(made), 2 * timeout_steps + 4)


@MODES
def test_long_log_is_sent_in_parts_and_converges(*, ledger: bool) -> None:
    """A message holds 4096 entries at most; the rest follows."""
    samples = 6000
    units = Units.of(2 * samples, samples)
    made = [replica(i, 2, ledger=ledger, units=units, samples=samples) for i in range(2)]
    writer = made[0]
    writer.reserve(2 * samples)
    for sample in (*range(samples), *range(0, samples, 2)):
        spend(writer.store, writer.config, sample, 1)
    agreed = [0, 1] * (samples // 2)

    assert units == Units(whole=2 * samples, sample=2, point=1)
    assert weights_of(writer) == agreed
    assert LosslessRadio(made).rounds_until(agreed, 30) > 3
    assert max(len(logs) for _, logs, _ in [writer.compose()]) < 20 * 4096


def test_log_outgrows_its_first_room() -> None:
    """Entries are kept in order however many there are."""
    units = Units.of(1000 * N, N)
    writer = replica(0, 2, ledger=True, units=units)
    reader = replica(1, 2, ledger=True, units=units)
    spent = [(i % N, 1) for i in range(3000)]
    spend_each(writer, spent)
    reader.merge(0, *full_message(writer))

    assert replicas.entries(writer, 0) == replicas.entries(reader, 0) == spent
    assert weights_of(writer) == weights_of(reader) == [500] * N


@MODES
def test_lowered_samples_are_reported_once(*, ledger: bool) -> None:
    """`lowered` names each sample once, whether it fell by spending or by a merge, until the step ends."""
    a, b = team([[(0, 1), (0, 1), (2, 1)], [(2, 2), (5, 1)]], ledger=ledger)
    join(a, b)
    fallen = sorted(a.lowered().tolist())
    a.end_step()

    assert fallen == [0, 2, 5]
    assert a.lowered().tolist() == []
    spend_each(a, [(0, 1)])
    assert a.lowered().tolist() == [0]


@MODES
def test_messages_are_what_the_protocol_says(*, ledger: bool) -> None:
    """Version vector, logs and claims, byte by byte; the minimum leaves out entries that a newer one covers."""
    held = replica(0, 2, ledger=ledger, beacon=True)
    spend_each(held, [(3, 1), (5, 2), (3, 1)])
    held.claim(2, 300)
    entries = [(3, 1), (5, 2), (3, 1)] if ledger else [(5, 2), (3, 2)]

    assert held.compose() == (
        bytes([3, 0, 1, 0]),
        suffix(0, 0, entries, span=3),
        claim(0, 1, 2, 300),
    )
