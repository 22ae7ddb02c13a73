"""Replication under an arbitrary radio, as a state machine.

Robots spend, claim and speak; the radio drops, repeats, delays, reorders and damages what they say.
After every event the invariants hold; whenever the radio is good for a while, all weights come to
the plain sum (ledger) or the plain minimum (min) of what was spent.
"""

from collections import Counter
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from kantor_protocol.replica import NOBODY, Replica, spend
from kantor_protocol.weights import Units
from strategies import examples

N = 6
UNITS = Units.of(8, N)
"""Four units a sample, three a point."""

Message = tuple[bytes, bytes, bytes]


class Replicas(RuleBasedStateMachine):
    """Two to four replicas and everything that is on the air between them."""

    def __init__(self) -> None:
        super().__init__()
        self.made: list[Replica] = []
        self.air: list[tuple[int, int, Message]] = []
        """(source, target, message): said and not yet heard or lost."""
        self.bought: list[list[tuple[int, int]]] = []
        """By origin: (sample, units), in order. Written here, never by the code under test."""
        self.least: dict[int, int] = {}
        """By sample: the least weight after anybody's spending, in that robot's view."""
        self.seen: list[list[int]] = []
        """The weights after the event before."""

    @initialize(
        count=st.integers(2, 4),
        ledger=st.booleans(),
        claims=st.booleans(),
        relay=st.booleans(),
        beacon=st.booleans(),
        patience=st.integers(1, 3),
    )
    def assemble(
        self, *, count: int, ledger: bool, claims: bool, relay: bool, beacon: bool, patience: int
    ) -> None:
        """One mission's manner for all; the last of the team may be a relay."""
        self.made = [
            Replica(
                me,
                count,
                N,
                UNITS,
                ledger=ledger,
                claims=claims,
                relay=relay and me == count - 1,
                beacon=beacon,
                patience_steps=patience,
            )
            for me in range(count)
        ]
        self.bought = [[] for _ in range(count)]
        self.seen = [[UNITS.sample] * N for _ in range(count)]

    # Events.

    @rule(who=st.integers(0, 3), sample=st.integers(0, N - 1), wanted=st.integers(1, UNITS.point))
    def buy(self, who: int, sample: int, wanted: int) -> None:
        """A robot spends, as far as there is weight in its own view."""
        who %= len(self.made)
        held = self.made[who]
        units = min(wanted, int(held.weights[sample]))
        if units > 0:
            held.reserve(1)
            spend(held.store, held.manner, sample, units)
            self.bought[who].append((sample, units))
            left = int(held.weights[sample])
            self.least[sample] = min(left, self.least.get(sample, UNITS.sample))

    @rule(who=st.integers(0, 3), sample=st.integers(NOBODY, N - 1))
    def head_for(self, who: int, sample: int) -> None:
        """A robot claims a sample, or gives its claim up."""
        held = self.made[who % len(self.made)]
        held.claim(sample, int(held.store.counters[1]))

    @rule(who=st.integers(0, 3))
    def speak(self, who: int) -> None:
        """A robot ends its step with a message to everybody."""
        who %= len(self.made)
        message = self.made[who].compose()
        self.made[who].end_step()
        self.air += [(who, other, message) for other in range(len(self.made)) if other != who]

    @rule(who=st.integers(0, 3), whom=st.integers(0, 3))
    def speak_to(self, who: int, whom: int) -> None:
        """A robot ends its step with a message to one participant, as to a supervisor."""
        who, whom = who % len(self.made), whom % len(self.made)
        if who != whom:
            self.air.append((who, whom, self.made[who].compose(whom)))
            self.made[who].end_step()

    @precondition(lambda self: self.air)
    @rule(which=st.integers(0, 1000), again=st.booleans())
    def hear(self, *, which: int, again: bool) -> None:
        """Any message that is under way arrives, be it the newest; it may arrive again."""
        source, target, message = self.air[which % len(self.air)]
        if not again:
            del self.air[which % len(self.air)]

        assert self.made[target].learn(source, *message)

    @precondition(lambda self: self.air)
    @rule(which=st.integers(0, 1000))
    def lose(self, which: int) -> None:
        """A message is lost."""
        del self.air[which % len(self.air)]

    @precondition(lambda self: self.air)
    @rule(which=st.integers(0, 1000), part=st.integers(0, 2))
    def damage(self, which: int, part: int) -> None:
        """A message arrives without its last byte: it changes nothing at all."""
        source, target, message = self.air.pop(which % len(self.air))
        parts = [content[:-1] if i == part else content for i, content in enumerate(message)]
        before = self._snapshot(target)

        assert self.made[target].learn(source, *parts) == (not message[part])
        if message[part]:
            assert self._snapshot(target) == before

    @rule()
    def clear_up(self) -> None:
        """The radio is good for a while: everybody comes to the same weights, the true ones."""
        self.air = []
        made, expected = self.made, self._truth()
        for _ in range(2 * made[0].manner.patience + 4):
            words = [held.compose() for held in made]
            for i, held in enumerate(made):
                held.end_step()
                for j, word in enumerate(words):
                    assert i == j or held.learn(j, *word)

        assert [held.weights.tolist() for held in made] == [expected] * len(made)

    def teardown(self) -> None:
        """However a run went, the end of it is good weather."""
        if self.made:
            self.clear_up()

    # What always holds.

    @invariant()
    def weights_never_rise(self) -> None:
        """Merging and spending are inflationary."""
        now = [held.weights.tolist() for held in self.made]
        for before, after in zip(self.seen, now, strict=True):
            assert all(0 <= x <= y for x, y in zip(after, before, strict=True))
        self.seen = now

    @invariant()
    def logs_are_prefixes_of_what_was_spent(self) -> None:
        """ledger: whoever holds anything of a log holds its beginning, and weighs exactly that."""
        for held in self.made if self.made and self.made[0].manner.ledger else []:
            spent: Counter[int] = Counter()
            for origin, bought in enumerate(self.bought):
                entries = held.entries(origin)
                assert entries == bought[: len(entries)]
                assert origin != held.manner.me or len(entries) == len(bought)
                for sample, units in entries:
                    spent[sample] += units

            assert held.weights.tolist() == [max(0, UNITS.sample - spent[j]) for j in range(N)]

    @invariant()
    def acknowledged_minima_were_merged(self) -> None:
        """min: who says that it holds a log up to some length weighs no more than it says there."""
        for held in self.made if self.made and not self.made[0].manner.ledger else []:
            for author in self.made:
                length = int(held.store.length[author.manner.me])
                assert length <= len(author.entries(author.manner.me))
                for sample, value in author.entries(author.manner.me)[:length]:
                    assert held.weights[sample] <= value

    @invariant()
    def nobody_is_thought_to_hold_more_than_it_does(self) -> None:
        """An acknowledgement is never ahead of the truth, so nothing is ever held back for good."""
        count = len(self.made)
        for held in self.made:
            for other in self.made:
                known = held.store.known[other.manner.me].tolist()
                truly = other.store.length.tolist() + other.store.claims[2].tolist()
                if other is not held:
                    assert all(x <= y for x, y in zip(known, truly, strict=True))
                assert len(known) == 2 * count

    @invariant()
    def fallen_samples_are_named_once(self) -> None:
        """`lowered` is free of repetitions and names only samples that have fallen."""
        for held in self.made:
            fallen = held.lowered().tolist()
            assert len(set(fallen)) == len(fallen)
            assert all(held.weights[sample] < UNITS.sample for sample in fallen)

    def _truth(self) -> list[int]:
        if not self.made[0].manner.ledger:
            return [self.least.get(sample, UNITS.sample) for sample in range(N)]
        spent = Counter[int]()
        for sample, units in (entry for bought in self.bought for entry in bought):
            spent[sample] += units
        return [max(0, UNITS.sample - spent[sample]) for sample in range(N)]

    def _snapshot(self, who: int) -> list[Any]:
        return [(array.shape, array.tolist()) for array in self.made[who].store]


Replicas.TestCase.settings = settings(examples(80), stateful_step_count=40)
TestReplicas = Replicas.TestCase
