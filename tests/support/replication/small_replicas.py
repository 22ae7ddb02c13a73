"""Replicas of a small density: their spending, their contents, and a radio between them."""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from hypothesis import strategies as st

from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import spend
from kantor_protocol.wire.weights import Units
from support.references.plain_gossip import Entry, Message, full_message
from support.replication import replicas

N = 6
UNITS = Units.of(8, N)
"""Four units a sample, three a point."""

Spendings = list[Entry]
"""(sample, units wanted), one after the other."""

SPENDINGS = st.lists(st.tuples(st.integers(0, N - 1), st.integers(1, UNITS.point)), max_size=12)
TEAM_SPENDINGS = st.tuples(SPENDINGS, SPENDINGS, SPENDINGS)
MODES = pytest.mark.parametrize("ledger", [True, False], ids=["ledger", "min"])


def replica(
    me: int,
    origins: int,
    *,
    ledger: bool,
    claims: bool = True,
    relay: bool = False,
    beacon: bool = False,
    timeout_steps: int = 2,
    units: Units = UNITS,
    samples: int = N,
) -> Replica:
    """An empty replica of six samples."""
    return Replica(
        me,
        origins,
        samples,
        units,
        ledger=ledger,
        claims=claims,
        relay=relay,
        beacon=beacon,
        ack_timeout_steps=timeout_steps,
    )


def spend_each(held: Replica, spendings: Spendings) -> None:
    """Spend on samples, as far as there is weight in the replica's view."""
    for sample, wanted in spendings:
        units = min(wanted, int(held.weights[sample]))
        if units > 0:
            held.reserve(1)
            spend(held.store, held.config, sample, units)


def team(spent: Iterable[Spendings], *, ledger: bool) -> list[Replica]:
    """One replica for each list of spendings, made without knowledge of the others'."""
    lists = list(spent)
    made = [replica(i, len(lists), ledger=ledger) for i in range(len(lists))]
    for held, spendings in zip(made, lists, strict=True):
        spend_each(held, spendings)
    return made


def join(held: Replica, *others: Replica) -> Replica:
    """Let a replica learn all that others hold, one after the other."""
    for other in others:
        assert held.merge(other.config.me, *full_message(other))
    return held


def weights_of(held: Replica) -> list[int]:
    """Its weights."""
    return list(map(int, held.weights))


def converged_weights(made: Iterable[Replica]) -> list[int]:
    """The weights that all must come to, as a plain sum or a plain minimum."""
    made = list(made)
    if not made[0].config.ledger:
        return [min(column) for column in zip(*map(weights_of, made), strict=True)]
    spent: Counter[int] = Counter()
    for held in made:
        for sample, units in replicas.entries(held, held.config.me):
            spent[sample] += units
    return [max(0, UNITS.sample - spent[sample]) for sample in range(N)]


def snapshot(held: Replica) -> list[Any]:
    """Every array of the store: shape and numbers."""
    return [(array.shape, array.tolist()) for array in held.store]


def knowledge(held: Replica) -> list[Any]:
    """What a replica holds, apart from what it knows about others."""
    origins = held.store.length.shape[0]
    logs = [replicas.entries(held, i) for i in range(origins)] if held.config.ledger else []
    return [weights_of(held), logs]


InRange = Callable[[int, int], bool]


class LosslessRadio:
    """A radio without losses: what is sent in one round arrives at the start of the next."""

    def __init__(self, made: list[Replica], in_range: InRange = lambda _i, _j: True) -> None:
        self._made, self._in_range = made, in_range
        self._inboxes: list[list[tuple[int, Message]]] = [[] for _ in made]

    def round(self) -> None:
        """All receive, then all send."""
        for i, held in enumerate(self._made):
            for source, message in self._inboxes[i]:
                assert held.merge(source, *message)
            self._inboxes[i] = []
        for i, held in enumerate(self._made):
            message = held.compose()
            held.end_step()
            for j in range(len(self._made)):
                if j != i and self._in_range(i, j):
                    self._inboxes[j].append((i, message))

    def rounds_until(self, agreed: list[int], most: int) -> int:
        """Rounds until the weights of all are these; fails after `most`."""
        for count in range(most):
            if all(weights_of(held) == agreed for held in self._made):
                return count
            self.round()
        assert [weights_of(held) for held in self._made] == [agreed] * len(self._made)
        return most
