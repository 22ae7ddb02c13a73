"""Merging replicas: nothing is lost by loss, nothing is counted twice by repetition (design, part 4)."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given

from kantor_protocol.replication.replica_kernels import KNOWN_MAX
from kantor_protocol.wire.weights import Units
from support.references.plain_gossip import suffix, version_vector
from support.references.plain_varint import leb128
from support.replication import replicas
from support.replication.small_replicas import (
    MODES,
    TEAM_SPENDINGS,
    UNITS,
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
@examples(60)
@given(spent=TEAM_SPENDINGS)
def test_merge_is_idempotent(*, ledger: bool, spent: tuple[Spendings, ...]) -> None:
    """A message that arrives twice counts once."""
    a, b, _ = team(spent, ledger=ledger)
    once = knowledge(join(a, b))

    assert knowledge(join(a, b)) == once
    assert knowledge(join(a, b, b)) == once


@MODES
@examples(60)
@given(spent=TEAM_SPENDINGS)
def test_merge_is_commutative(*, ledger: bool, spent: tuple[Spendings, ...]) -> None:
    """The order in which messages of others arrive does not matter."""
    a, b, c = team(spent, ledger=ledger)
    forth = knowledge(join(replica(0, 3, ledger=ledger), b, c))
    back = knowledge(join(replica(0, 3, ledger=ledger), c, b))

    assert forth == back
    assert weights_of(join(a, b)) == weights_of(join(b, a))


@MODES
@examples(60)
@given(spent=TEAM_SPENDINGS)
def test_merge_is_associative(*, ledger: bool, spent: tuple[Spendings, ...]) -> None:
    """Merging B, then C, is merging B that has merged C: entries may travel over others."""
    a, b, c = team(spent, ledger=ledger)
    direct = knowledge(join(a, b, c))
    a, b, c = team(spent, ledger=ledger)

    assert knowledge(join(a, join(b, c))) == direct


@MODES
@examples(60)
@given(spent=TEAM_SPENDINGS)
def test_merge_never_raises_a_weight(*, ledger: bool, spent: tuple[Spendings, ...]) -> None:
    """Weights only ever fall, and come to the same when all is merged."""
    a, b, c = team(spent, ledger=ledger)
    expected = converged_weights([a, b, c])
    seen = [weights_of(a), weights_of(join(a, b)), weights_of(join(a, c))]

    assert all(
        x >= y for before, after in pairwise(seen) for x, y in zip(before, after, strict=True)
    )
    assert seen[-1] == expected


@examples(60)
@given(spent=TEAM_SPENDINGS)
def test_both_rules_agree_when_no_two_robots_spend_on_one_sample(
    spent: tuple[Spendings, ...],
) -> None:
    """Disjoint spending leaves the ledger nothing to correct in the minimum (papers, 2.6)."""
    apart = [
        [(sample, units) for sample, units in spendings if sample % 3 == i]
        for i, spendings in enumerate(spent)
    ]
    results = []
    for ledger in (True, False):
        a, b, c = team(apart, ledger=ledger)
        results.append(weights_of(join(a, b, c)))

    assert results[0] == results[1]


@pytest.mark.parametrize(("ledger", "left"), [(True, 0), (False, 2)])
def test_spending_of_two_on_one_sample(*, ledger: bool, left: int) -> None:
    """The ledger counts both; the minimum, as printed (eq. 8-10), counts one."""
    a, b = team([[(3, 2)], [(3, 2)]], ledger=ledger)

    assert weights_of(join(a, b)) == [4, 4, 4, left, 4, 4]


def test_overspent_sample_stops_at_zero() -> None:
    """Spending beyond what a sample holds leaves no debt."""
    a, b = team([[(3, 3)], [(3, 3)]], ledger=True)

    assert weights_of(join(a, b)) == [4, 4, 4, 0, 4, 4]


@MODES
def test_largest_units_are_exact(*, ledger: bool) -> None:
    """The most points that a scenario may have: no weight overflows."""
    units = Units.of(1_999_999_999, N)
    writer, held = (replica(me, 2, ledger=ledger, units=units) for me in range(2))
    value = units.point if ledger else units.sample - 1
    entries = [(0, value), (0, value)]

    assert weights_of(writer) == [units.sample] * N
    assert held.merge(0, version_vector(2), suffix(0, 0, entries), b"")
    assert weights_of(held)[0] == units.sample - (2 * units.point if ledger else 1)


def test_acknowledgement_beyond_any_log_is_taken_for_all_of_it() -> None:
    """A sender that claims to hold more than can be gets nothing, and does no harm."""
    held = replica(0, 2, ledger=True)
    spend_each(held, [(3, 1)])
    exaggerated = b"".join(leb128(number) for number in (1 << 62, 1 << 31, (1 << 31) - 1, 0))

    assert held.merge(1, exaggerated, b"", b"")
    assert held.store.known[1].tolist() == [KNOWN_MAX, KNOWN_MAX, KNOWN_MAX, 0]
    assert held.compose()[1] == b""


@examples(40)
@given(spent=TEAM_SPENDINGS)
def test_held_spending_is_the_sum_of_the_logs(spent: tuple[Spendings, ...]) -> None:
    """ledger: `weights` are what the held entries add up to, to the unit."""
    a, b, c = team(spent, ledger=True)
    join(a, b, c)
    total = np.zeros(N, dtype=np.int64)
    for origin in range(3):
        for sample, units in replicas.entries(a, origin):
            total[sample] += units

    assert weights_of(a) == np.maximum(0, UNITS.sample - total).tolist()
