"""Claims: which of two robots keeps a sample, and how claims travel and expire."""

import pytest

from kantor_protocol.replication.replica_kernels import NO_INDEX
from support.replication import replicas
from support.replication.small_replicas import LosslessRadio, replica


def competing_claims(first_ns: int, second_ns: int) -> tuple[list[int], list[int]]:
    """What two robots must leave when each has claimed sample 3 and received the claim of the other."""
    a, b = (replica(i, 2, ledger=True) for i in range(2))
    a.claim(3, first_ns)
    b.claim(3, second_ns)
    messages = a.compose(), b.compose()
    a.merge(1, *messages[1])
    b.merge(0, *messages[0])
    return replicas.claimed_by_others(a), replicas.claimed_by_others(b)


def test_of_equal_claims_the_lower_id_keeps_the_sample() -> None:
    """Two robots that choose the same sample at the same time: one of them leaves it."""
    assert competing_claims(100, 100) == ([], [3])


@pytest.mark.parametrize(("first_ns", "left"), [(100, ([], [3])), (300, ([3], []))])
def test_incumbent_keeps_its_sample(first_ns: int, left: tuple[list[int], list[int]]) -> None:
    """The robot that claimed earlier keeps it, whatever its id; renewing does not make a claim younger."""
    assert competing_claims(first_ns, 200) == left


def test_renewal_keeps_the_first_time() -> None:
    """A claim is dated by when the robot first headed there without a break."""
    a = replica(0, 2, ledger=True)
    since_ns = []
    for sample, now_ns in ((3, 100), (3, 200), (4, 300), (3, 400), (NO_INDEX, 500)):
        a.claim(sample, now_ns)
        since_ns.append(int(a.store.claims[1, 0]))
        a.end_step()

    assert since_ns == [100, 100, 300, 400, 500]


def test_claimed_sample_is_left_by_a_robot_without_a_claim() -> None:
    """Another robot leaves the sample; when the claim is given up it is free again."""
    a, b = (replica(i, 2, ledger=True) for i in range(2))
    b.claim(3, 100)
    a.merge(1, *b.compose())
    b.end_step()
    b.claim(NO_INDEX, 200)
    left = replicas.claimed_by_others(a)
    a.merge(1, *b.compose())

    assert (left, replicas.claimed_by_others(a)) == ([3], [])


def test_older_claim_changes_nothing() -> None:
    """The newest stamp wins: a claim that arrives late or again is no claim."""
    a, b = (replica(i, 2, ledger=True) for i in range(2))
    b.claim(3, 100)
    late = b.compose()
    b.end_step()
    b.claim(4, 200)
    a.merge(1, *b.compose())
    a.merge(1, *late)

    assert replicas.claimed_by_others(a) == [4]


def test_claim_that_is_not_renewed_expires() -> None:
    """A silent robot's last target ages out after twelve steps (papers, 7.6)."""
    a, b = (replica(i, 2, ledger=True) for i in range(2))
    b.claim(3, 100)
    a.merge(1, *b.compose())
    held = []
    for _ in range(15):
        held.append(replicas.claimed_by_others(a) == [3])
        a.end_step()

    assert held == [True] * 13 + [False] * 2


def test_claim_reaches_the_neighbour_s_neighbour() -> None:
    """Claims are forwarded like logs: the far end of a chain learns what is claimed."""
    made = [replica(i, 3, ledger=True) for i in range(3)]
    radio = LosslessRadio(made, lambda i, j: abs(i - j) == 1)
    for step in range(12):
        made[0].claim(3, 100)
        made[1].claim(1, 100)
        made[2].claim(2, 100 + step)
        radio.round()

    assert sorted(replicas.claimed_by_others(made[2])) == [1, 3]


def test_without_claims_nothing_is_taken() -> None:
    """Without claims: the paper's robots do not send where they head."""
    a, b = (replica(i, 2, ledger=True, claims=False) for i in range(2))
    b.claim(3, 100)
    a.merge(1, *b.compose())

    assert replicas.claimed_by_others(a) == []
    assert b.compose()[2] == b""
