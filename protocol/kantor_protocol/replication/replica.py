"""Replication by anti-entropy: everybody's single-writer state, held by everybody (design, part 4).

Theory of operation
-------------------
1. Every participant (origin) writes one *log* (append-only entries) and one *register* (its claim,
   the newest value wins by the origin's stamp). Nobody else writes them.
2. A version vector says how much of every log, and which stamp of every register, somebody holds.
   Everybody sends its own with every message, which is at once its acknowledgement.
3. A sender puts in the suffixes that somebody it hears lacks. A few unacknowledged entries ride along
   with every message; a longer suffix goes out once, and again only when the acknowledgement has not
   come within `patience` steps.
4. Entries of others are forwarded, so news travels over several hops. A robot holds foreign entries
   back for `patience` steps, since a neighbour most likely heard them itself; a relay does not.
5. What a planner shares beside weights and claims stands in `registers.py` and comes with the same message.
6. Receiving is idempotent: a suffix that starts beyond what is held is left (it will come again), what
   is held already is skipped. Loss, duplication, delay and reordering cost time, never truth.

Two meanings of the log of a mission that explores a density, by `merge`:

ledger
    An entry is (sample, units spent by the origin). The weight of a sample is its first weight minus
    everybody's spending, never below 0. Nothing is lost and nothing is counted twice.
min
    An entry is (sample, units left in the origin's vector) and is merged by the minimum (Kabir & Lee,
    eq. 8-10). An origin's log holds all that ever fell in its vector, what it learned included, so
    that nothing needs forwarding. Spending of two origins on one sample is counted once: the paper's
    rule, with the paper's weakness.

In a mission with a map there is no weight: an entry is a number alone (`evidence.py` says what it
means), logs are replicated as with a ledger, and whoever holds them makes of them what it wants.

Incarnations
------------
An origin is one incarnation of a participant (`slots.py`). A version vector is for the slots that its
sender knows. Of slots beyond it the sender holds nothing; whoever hears of more slots than it knows makes
room for them. The log of a dead incarnation counts on, and travels as any other; its claim expires.
"""

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.incarnations import known_to
from kantor_protocol.base.varint import Pairs
from kantor_protocol.replication.registers import Registers
from kantor_protocol.replication.replica_kernels import (
    ENTRIES_MAX,
    HOLDING,
    LEARNT,
    LOWERED,
    MALFORMED,
    NO_ROOM_TO_PACK,
    NOBODY,
    SAMPLE,
    ReplicaArrays,
    ReplicaConfig,
    claim,
    compose,
    end_step,
    learn,
    pack_lowered,
)
from kantor_protocol.wire.version_vector import count_ids
from kantor_protocol.wire.weights import Units, Weights


class Replica:
    """What one participant holds of everybody's state, and what it tells others.

    `weights` never rises; `weights[j]` is the first weight minus spending (ledger), or the least
    value seen (min).
    """

    def __init__(
        self,
        me: int,
        origins: int,
        samples: int,
        units: Units | None,
        *,
        ledger: bool,
        claims: bool,
        relay: bool = False,
        beacon: bool = False,
        patience_steps: int = 2,
        registers: Registers | None = None,
    ) -> None:
        """origins: participants in the roster. The rest: Manner. Raises ValueError for an incarnation too many.

        me: its slot, which is its place in the roster unless it is a later incarnation. units: None for logs of
        bare indices below `samples`, with a ledger. registers: what the planner shares beside the logs, by
        default nothing.
        """
        slots = known_to(me, origins)
        weighed = samples if units else 0
        units = units or Units(whole=0, sample=0, point=0)
        self.registers = Registers(me, origins, 0) if registers is None else registers
        self.config = ReplicaConfig(
            me=me,
            ledger=ledger,
            claims=claims,
            relay=relay,
            beacon=beacon,
            patience=max(1, patience_steps),
            value_max=units.point if ledger else units.sample,
            bound=samples,
            roster=origins,
        )
        rows = slots if ledger else 1
        self.store = ReplicaArrays(
            weights=np.full(weighed, units.sample, dtype=np.int32),
            logs=np.zeros((rows, 256, 2), dtype=np.int32),
            length=np.zeros(slots, dtype=np.int64),
            known=np.zeros((slots, 2 * slots), dtype=np.int32),
            sending=_unsent(slots, self.config.patience),
            claims=_unclaimed(slots),
            lowered=np.zeros(weighed, dtype=np.int32),
            mark=np.zeros(weighed, dtype=np.int32),
            counters=np.array([0, 1, weighed], dtype=np.int64),
        )
        self._settings = np.array(self.config, dtype=np.int64)
        self._fit_rooms()

    def _fit_rooms(self) -> None:
        """Have kernels work on the store as it is, with scratch for as many slots."""
        slots = self.slots
        self._out = np.zeros(20 * ENTRIES_MAX + 120 * slots + 64, dtype=np.uint8)
        self._least = np.zeros(2 * slots, dtype=np.int32)
        self._fields = (*self.store, self._settings)

    @property
    def slots(self) -> int:
        """Origins that it knows of: the roster once for each incarnation heard of."""
        return self.store.length.shape[0]

    @property
    def weights(self) -> Weights:
        """(N,) units left in this participant's view."""
        return self.store.weights

    @property
    def empty(self) -> bool:
        """Whether no sample has weight left in this participant's view."""
        return self.store.counters.item(HOLDING) == 0

    def learn(
        self, source: int, version_vector: bytes, logs: bytes, claims: bytes, registers: bytes = b""
    ) -> bool:
        """Take in a message; False, and nothing changed, when it is malformed."""
        told = 0
        if registers:
            told = count_ids(version_vector, self.config.roster, 2 if self.config.claims else 1)
            if not self.registers.sound(registers, told):
                return False
        outcome = learn(*self._fields, version_vector, logs, claims, source)
        while outcome != LEARNT:
            if outcome == MALFORMED:
                return False
            self._make_room(outcome)
            outcome = learn(*self._fields, version_vector, logs, claims, source)
        if registers:
            self.registers.learn(source, registers, told)
        return True

    def _make_room(self, outcome: int) -> None:
        """What `_learn` asks for."""
        if outcome > 0:
            self._lengthen(outcome)
        else:
            self._widen(-outcome)

    def append(self, indices: npt.NDArray[np.int64]) -> None:
        """Put (k,) bare indices, each below the bound, behind the own log."""
        self.reserve(indices.shape[0])
        me, length = self.config.me, int(self.store.length[self.config.me])
        self.store.logs[me, length : length + indices.shape[0], 0] = indices
        self.store.length[me] += indices.shape[0]

    def reserve(self, entries: int) -> None:
        """Make room for this many more entries in every log."""
        written = self.store.length if self.config.ledger else self.store.length[self.config.me]
        self._lengthen(int(written.max()) + entries)

    def _lengthen(self, needed: int) -> None:
        """Make room for this many entries in every log."""
        rows, capacity, _ = self.store.logs.shape
        if needed <= capacity:
            return
        while capacity < needed:
            capacity *= 2
        logs = np.zeros((rows, capacity, 2), dtype=np.int32)
        logs[:, : self.store.logs.shape[1]] = self.store.logs
        self.store = self.store._replace(logs=logs)
        self._fields = (*self.store, self._settings)

    def _widen(self, slots: int) -> None:
        """Make room for this many origins: another incarnation was heard of."""
        old, before = self.store, self.slots
        known = np.zeros((slots, 2 * slots), dtype=np.int32)
        known[:before, :before] = old.known[:, :before]
        known[:before, slots : slots + before] = old.known[:, before:]
        length = np.zeros(slots, dtype=np.int64)
        length[:before] = old.length
        sending, claims = _unsent(slots, self.config.patience), _unclaimed(slots)
        sending[:, :before], claims[:, :before] = old.sending, old.claims
        logs = old.logs
        if self.config.ledger:
            logs = np.zeros((slots, *old.logs.shape[1:]), dtype=np.int32)
            logs[:before] = old.logs
        self.store = old._replace(
            logs=logs, length=length, known=known, sending=sending, claims=claims
        )
        self._fit_rooms()
        self.registers.widen(slots)

    def claim(self, sample: int, now_ns: int) -> None:
        """Claim a sample (or NOBODY) from now on, or renew the claim that is held."""
        claim(self.store.claims, self.store.counters, self.config.me, sample, now_ns)

    def compose(self, target: int = NOBODY) -> tuple[bytes, bytes, bytes]:
        """(have, logs, claims) for one message to everybody, or to one participant."""
        end_of_have, end_of_logs, end = compose(*self._fields, self._out, self._least, target)
        told = self._out[:end].tobytes()
        return told[:end_of_have], told[end_of_have:end_of_logs], told[end_of_logs:]

    @property
    def fell(self) -> bool:
        """Whether any weight fell in this step."""
        return self.store.counters.item(LOWERED) > 0

    def lowered(self) -> npt.NDArray[np.int32]:
        """Samples whose weight fell in this step, each once; a view valid until `end_step`."""
        return self.store.lowered[: self.store.counters.item(LOWERED)]

    def packed_lowered(self) -> bytes:
        """Packed pairs (sample, units left) of what fell in this step."""
        store = self.store
        used = pack_lowered(store.weights, store.lowered, store.counters, self._out)
        if used == NO_ROOM_TO_PACK:
            index = self.lowered()
            return Pairs().encode(index, store.weights[index], index.shape[0])
        return self._out[:used].tobytes()

    def end_step(self) -> None:
        """Begin the next step."""
        end_step(self.store.counters)
        self.registers.end_step()


def _unsent(slots: int, patience: int) -> npt.NDArray[np.int64]:
    """`Store.sending` of who has heard and sent nothing."""
    sending = np.zeros((3 + patience, slots), dtype=np.int64)
    sending[1:3] = -1 - patience
    return sending


def _unclaimed(slots: int) -> npt.NDArray[np.int64]:
    """`Store.claims` while nobody has a claim."""
    claims = np.zeros((4, slots), dtype=np.int64)
    claims[SAMPLE] = NOBODY
    return claims
