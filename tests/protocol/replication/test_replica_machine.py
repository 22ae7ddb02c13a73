"""Replication under an arbitrary radio, as a state machine.

Robots spend, claim and speak; some lose all that they held and are born again; the radio drops, repeats,
delays, reorders and damages what they say. After every event the invariants hold; whenever the radio is
good for a while, all weights come to the plain sum (ledger) or the plain minimum (min) of what was spent,
but for entries that no living robot has received.
"""

from collections import Counter
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import NO_INDEX, spend
from kantor_protocol.wire.weights import Units
from support.replication import replicas
from support.strategies import examples

N = 6
UNITS = Units.of(8, N)
"""Four units a sample, three a point."""

INCARNATIONS = 3
"""New ones in a run, of any robot, at any moment."""

Message = tuple[bytes, bytes, bytes]


class Replicas(RuleBasedStateMachine):
    """Two to four participants and everything that is on the air between them.

    Incarnation ids are counted here by hand: incarnation e of place i of n is e n + i.
    """

    def __init__(self) -> None:
        super().__init__()
        self.made: list[Replica] = []
        """The living, by place."""
        self.authors: dict[int, Replica] = {}
        """All replicas there ever were, by incarnation id; lost ones as they were in the end."""
        self.air: list[tuple[int, int, Message]] = []
        """(id of the source, place of the target, message): sent and not yet received or lost."""
        self.bought: dict[int, list[tuple[int, int]]] = {}
        """By incarnation id: (sample, units), in order. Written here, never by the code under test."""
        self.seen: list[list[int]] = []
        """The weights after the event before."""

    @initialize(
        count=st.integers(2, 4),
        ledger=st.booleans(),
        claims=st.booleans(),
        relay=st.booleans(),
        beacon=st.booleans(),
        timeout_steps=st.integers(1, 3),
    )
    def assemble(
        self,
        *,
        count: int,
        ledger: bool,
        claims: bool,
        relay: bool,
        beacon: bool,
        timeout_steps: int,
    ) -> None:
        """One mission's rules for all; the last of the team may be a relay."""

        def born(incarnation_id: int) -> Replica:
            held = Replica(
                incarnation_id,
                count,
                N,
                UNITS,
                ledger=ledger,
                claims=claims,
                relay=relay and incarnation_id % count == count - 1,
                beacon=beacon,
                ack_timeout_steps=timeout_steps,
            )
            self.authors[incarnation_id], self.bought[incarnation_id] = held, []
            return held

        self.born = born
        self.made = [born(place) for place in range(count)]
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
            spend(held.store, held.config, sample, units)
            self.bought[held.config.me].append((sample, units))

    @precondition(lambda self: len(self.authors) < len(self.made) + INCARNATIONS)
    @rule(who=st.integers(0, 3))
    def lose_all(self, who: int) -> None:
        """A robot has lost its disk, and goes on as its next incarnation."""
        who %= len(self.made)
        self.made[who] = self.born(self.made[who].config.me + len(self.made))
        self.seen[who] = [UNITS.sample] * N

    @rule(who=st.integers(0, 3), sample=st.integers(NO_INDEX, N - 1))
    def head_for(self, who: int, sample: int) -> None:
        """A robot claims a sample, or gives its claim up."""
        held = self.made[who % len(self.made)]
        held.claim(sample, int(held.store.counters[1]))

    @rule(who=st.integers(0, 3))
    def speak(self, who: int) -> None:
        """A robot ends its step with a message to all."""
        who %= len(self.made)
        held = self.made[who]
        message = held.compose()
        held.end_step()
        others = [other for other in range(len(self.made)) if other != who]
        self.air += [(held.config.me, other, message) for other in others]

    @rule(who=st.integers(0, 3), whom=st.integers(0, 3))
    def speak_to(self, who: int, whom: int) -> None:
        """A robot ends its step with a message to one participant, as to a supervisor."""
        who, whom = who % len(self.made), whom % len(self.made)
        if who != whom:
            held, theirs = self.made[who], self.made[whom].config.me
            origin = theirs if theirs < held.origins else whom  # it may not have heard of it yet
            self.air.append((held.config.me, whom, held.compose(origin)))
            held.end_step()

    @precondition(lambda self: self.air)
    @rule(which=st.integers(0, 1000), again=st.booleans())
    def hear(self, *, which: int, again: bool) -> None:
        """Any message that is under way arrives, be it the newest; it may arrive again."""
        source, target, message = self.air[which % len(self.air)]
        if not again:
            del self.air[which % len(self.air)]

        assert self.made[target].merge(source, *message)

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

        assert self.made[target].merge(source, *parts) == (not message[part])
        if message[part]:
            assert self._snapshot(target) == before

    @rule()
    def clear_up(self) -> None:
        """The radio is good for a while: all come to the same weights, the true ones."""
        self.air = []
        made, expected = self.made, self._truth()
        for _ in range(2 * made[0].config.ack_timeout_steps + 6):
            words = [held.compose() for held in made]
            for i, held in enumerate(made):
                held.end_step()
                for j, word in enumerate(words):
                    assert i == j or held.merge(made[j].config.me, *word)

        assert [held.weights.tolist() for held in made] == [expected] * len(made)

    def teardown(self) -> None:
        """However a run went, the end of it is good weather."""
        if self.made:
            self.clear_up()

    # What always holds.

    @invariant()
    def replicas_are_valid(self) -> None:
        """Every sentence at an attribute of a replica holds, also of replicas that were lost."""
        for held in self.authors.values():
            held.validate()

    @invariant()
    def weights_never_rise(self) -> None:
        """Merging and spending are inflationary."""
        now = [held.weights.tolist() for held in self.made]
        for before, after in zip(self.seen, now, strict=True):
            assert all(0 <= x <= y for x, y in zip(after, before, strict=True))
        self.seen = now

    @invariant()
    def views_are_not_below_what_is_left(self) -> None:
        """Whatever is lost or received twice: no view has more spending than there was."""
        spent = Counter[int]()
        for sample, units in (entry for bought in self.bought.values() for entry in bought):
            spent[sample] += units
        for held in self.made:
            assert all(held.weights[j] >= UNITS.sample - spent[j] for j in range(N))

    @invariant()
    def logs_are_prefixes_of_what_was_spent(self) -> None:
        """ledger: what is held of a log is its beginning, and weights are exactly what it leaves."""
        for held in self.made if self.made and self.made[0].config.ledger else []:
            spent: Counter[int] = Counter()
            for origin in range(held.origins):
                entries, bought = replicas.entries(held, origin), self.bought.get(origin, [])
                assert entries == bought[: len(entries)]
                assert origin != held.config.me or len(entries) == len(bought)
                for sample, units in entries:
                    spent[sample] += units

            assert held.weights.tolist() == [max(0, UNITS.sample - spent[j]) for j in range(N)]

    @invariant()
    def acknowledged_minima_were_merged(self) -> None:
        """min: who says that it holds a log up to some length weighs no more than it says there."""
        for held in self.made if self.made and not self.made[0].config.ledger else []:
            for origin, author in self.authors.items():
                length = int(held.store.length[origin]) if origin < held.origins else 0
                assert length <= len(replicas.entries(author, origin))
                for sample, value in replicas.entries(author, origin)[:length]:
                    assert held.weights[sample] <= value

    @invariant()
    def no_acknowledgement_is_ahead_of_the_truth(self) -> None:
        """An acknowledgement is never ahead of the truth, so nothing is ever held back for good."""
        for held in self.made:
            for origin, other in self.authors.items():
                if other is held or origin >= held.origins:
                    continue
                for part, truly in enumerate((other.store.length, other.store.claims[2])):
                    known = held.store.known[
                        origin, part * held.origins : (part + 1) * held.origins
                    ]
                    holds = [*truly.tolist(), *[0] * held.origins]
                    assert all(x <= y for x, y in zip(known.tolist(), holds, strict=False))

    @invariant()
    def room_is_for_whole_rosters(self) -> None:
        """Incarnation ids come in blocks, one for each incarnation that is known."""
        for held in self.made:
            assert held.origins % len(self.made) == 0
            assert held.config.me < held.origins <= max(self.authors) + len(self.made)

    @invariant()
    def fallen_samples_are_named_once(self) -> None:
        """`lowered` is free of repetitions and names only samples that have fallen."""
        for held in self.made:
            fallen = held.lowered().tolist()
            assert len(set(fallen)) == len(fallen)
            assert all(held.weights[sample] < UNITS.sample for sample in fallen)

    def _truth(self) -> list[int]:
        """What the living know between them."""
        if not self.made[0].config.ledger:
            return [min(int(held.weights[sample]) for held in self.made) for sample in range(N)]
        spent = Counter[int]()
        for origin, bought in self.bought.items():
            heard = max(int(h.store.length[origin]) if origin < h.origins else 0 for h in self.made)
            for sample, units in bought[:heard]:
                spent[sample] += units
        return [max(0, UNITS.sample - spent[sample]) for sample in range(N)]

    def _snapshot(self, who: int) -> list[Any]:
        return [(array.shape, array.tolist()) for array in self.made[who].store]


Replicas.TestCase.settings = settings(examples(120), stateful_step_count=50)
TestReplicas = Replicas.TestCase
