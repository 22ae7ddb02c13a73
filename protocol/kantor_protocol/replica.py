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

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.kernels import kernel
from kantor_protocol.packing import Pairs, put_int, put_uint, skip_numbers, take_int, take_uint
from kantor_protocol.registers import FRESH_STEPS, Registers
from kantor_protocol.slots import count_slots, known_to
from kantor_protocol.weights import Units, Weights

NOBODY = -1
_LEARNT, _MALFORMED = 0, -1
_NO_ROOM_TO_PACK = -1
_ENTRIES_MAX = 4096
"""Log entries in one message; the rest follows with the next."""
_CLAIM_LEASE_STEPS = 12
"""A claim that has not been renewed for so many of the holder's steps is void."""
_CLAIM_RENEWAL_STEPS = 6
"""How stale a neighbour's knowledge of a foreign claim may be before a robot forwards it."""
_REPEATED = 32
"""So many unacknowledged entries are repeated with every message, so that one loss costs nothing.
Evidence waits for `patience` instead: there are dozens of entries a step, and a late cell does no harm."""
LENGTH_MAX = 1 << 40
"""No log is longer; it keeps sums of positions within 64 bits."""
KNOWN_MAX = (1 << 31) - 2
"""More is not remembered of what another holds: it fits into 32 bits, and nothing gets so long."""

# Rows of Store.claims.
_SAMPLE, _SINCE, _STAMP, _HEARD = 0, 1, 2, 3
# Slots of Store.counters.
LOWERED, _STEP, _HOLDING = 0, 1, 2


class Store(NamedTuple):
    """All that a participant holds, for the kernels. n origins (slots), N samples.

    A crowd does not fit into a cache: what is touched here and there is kept small, and side by side.
    """

    weights: npt.NDArray[np.int32]
    """(N,) units left in this participant's view; never rises."""
    logs: npt.NDArray[np.int32]
    """(n, capacity, 2) entries: sample, value. min: (1, capacity, 2), the own log only."""
    length: npt.NDArray[np.int64]
    """(n,) entries held of each log; min: of the others, how much has been merged."""
    known: npt.NDArray[np.int32]
    """(n, 2n) what each participant is known to hold: log lengths, then claim stamps; it says no
    more than KNOWN_MAX of any."""
    sending: npt.NDArray[np.int64]
    """(3 + patience, n): entries sent; step of the last repetition; step last heard; then a ring of
    the lengths at the last `patience` steps."""
    claims: npt.NDArray[np.int64]
    """(4, n): sample or NOBODY; since_ns; stamp; own step at which the stamp was heard."""
    lowered: npt.NDArray[np.int32]
    """(N,) indices of the weights that fell since the last `take_lowered`, each once."""
    mark: npt.NDArray[np.int32]
    """(N,) the step at which an index was put into `lowered`."""
    counters: npt.NDArray[np.int64]
    """(3,): how many in `lowered`; step; how many weights are above 0."""


class Manner(NamedTuple):
    """How a participant merges and talks; it never changes."""

    me: int
    """Its slot."""
    ledger: bool
    claims: bool
    relay: bool
    """It forwards at once."""
    beacon: bool
    """It sends all that it knows while it hears nobody."""
    patience: int
    """Own steps within which an acknowledgement is due."""
    value_max: int
    """The largest value of a log entry; 0: entries have no value and weigh nothing."""
    bound: int
    """Every index in a log is below it."""
    roster: int
    """Participants; slots come in blocks of so many."""


@kernel
def _lower(store: Store, index: int, value: int) -> None:
    store.counters[_HOLDING] -= value <= 0 < store.weights[index]
    store.weights[index] = value
    if store.mark[index] != store.counters[_STEP]:
        store.mark[index] = np.int32(store.counters[_STEP])
        store.lowered[store.counters[LOWERED]] = index
        store.counters[LOWERED] += 1


@kernel
def _append(store: Store, row: int, origin: int, index: int, value: int) -> None:
    store.logs[row, store.length[origin], 0] = index
    store.logs[row, store.length[origin], 1] = value
    store.length[origin] += 1


@kernel
def spend(store: Store, manner: Manner, index: int, units: int) -> None:
    """Ship `units` to a sample and log it. The log must have room for one more entry."""
    _lower(store, index, store.weights[index] - units)
    if manner.ledger:
        _append(store, manner.me, manner.me, index, units)
    else:
        _append(store, 0, manner.me, index, store.weights[index])


@kernel
def _merge_entry(store: Store, manner: Manner, origin: int, index: int, value: int) -> None:
    if manner.ledger:
        _append(store, origin, origin, index, value)
        if value > 0 and store.weights[index] > 0:
            _lower(store, index, max(0, store.weights[index] - value))
    elif value < store.weights[index]:
        _lower(store, index, value)
        _append(store, 0, manner.me, index, value)


@kernel
def _walk_suffixes(
    store: Store, manner: Manner, suffixes: bytes, source: int, told: int, apply: bool
) -> int:
    """Read all suffixes, of `told` origins; apply what is new, or only check.

    Returns how many entries some log may then hold, or a negative number when malformed.
    """
    ledger = manner.ledger
    origins = store.length.shape[0]
    at = 0
    entries = 0
    longest = 0
    while at < len(suffixes):
        origin, at = take_uint(suffixes, at)
        start, at = take_uint(suffixes, at)
        span, at = take_uint(suffixes, at)
        count, at = take_uint(suffixes, at)
        if at < 0 or origin >= told or count > span or count > len(suffixes):
            return -1
        if start > LENGTH_MAX or span > LENGTH_MAX:
            return -1
        if (ledger and count != span) or (not ledger and origin != source):
            return -1
        held = store.length[origin] if origin < origins else 0
        entries += count
        if not ledger:
            longest = store.length[manner.me] + entries
        elif start <= held + entries:  # it may follow on another suffix in this message
            longest = max(longest, start + span)
        fresh = origin != manner.me and (not ledger or start <= held < start + count)
        if apply and not fresh:
            at = skip_numbers(suffixes, at, 2 * count if manner.value_max > 0 else count)
            continue
        index = 0
        for i in range(count):
            step, at = take_int(suffixes, at)
            value = 0
            if manner.value_max > 0:
                value, at = take_uint(suffixes, at)
            index += step
            if at < 0 or index < 0 or index >= manner.bound or value > manner.value_max:
                return -1
            if apply and (not ledger or start + i >= held):
                _merge_entry(store, manner, origin, index, value)
        if apply and not ledger and start <= held:
            store.length[origin] = max(held, start + span)
    return longest


@kernel
def _walk_claims(store: Store, manner: Manner, claims: bytes, told: int, apply: bool) -> int:
    at = 0
    while at < len(claims):
        origin, at = take_uint(claims, at)
        stamp, at = take_uint(claims, at)
        sample, at = take_uint(claims, at)
        since, at = take_uint(claims, at)
        if at < 0 or origin >= told or sample > store.weights.shape[0]:
            return -1
        if apply and origin != manner.me and stamp > store.claims[_STAMP, origin]:
            store.claims[_SAMPLE, origin] = sample - 1
            store.claims[_SINCE, origin] = since
            store.claims[_STAMP, origin] = stamp
            store.claims[_HEARD, origin] = store.counters[_STEP]
    return at


@kernel
def _apply_have(store: Store, manner: Manner, have: bytes, source: int, told: int) -> None:
    known = store.known[source]
    origins = store.length.shape[0]
    parts = 2 if manner.claims else 1
    if told == origins and len(have) == parts * told:
        # A byte for each: the processor takes many at once.
        for slot in range(parts * told):
            known[slot] = max(known[slot], np.int32(have[slot]))
        return
    at = 0
    for part in range(parts):
        for slot in range(part * origins, part * origins + told):
            held, at = take_uint(have, at)
            known[slot] = max(known[slot], min(held, KNOWN_MAX))


@kernel
def _manner(law: np.ndarray) -> Manner:
    return Manner(
        law[0], law[1] != 0, law[2] != 0, law[3] != 0, law[4] != 0, law[5], law[6], law[7], law[8]
    )


@kernel
def _learn(
    weights: np.ndarray,
    logs: np.ndarray,
    length: np.ndarray,
    known: np.ndarray,
    sending: np.ndarray,
    claims: np.ndarray,
    lowered: np.ndarray,
    mark: np.ndarray,
    counters: np.ndarray,
    law: np.ndarray,
    have: bytes,
    suffixes: bytes,
    registers: bytes,
    source: int,
) -> int:
    """Check a message whole, then apply it whole.

    Returns _LEARNT; or, and nothing changed, _MALFORMED, the length that logs must have room for, or
    the negative of the slots that there must be room for. Store and Manner come field by field, see
    `kernels`.
    """
    store = Store(
        weights,
        logs,
        length,
        known,
        sending,
        claims,
        lowered,
        mark,
        counters,
    )
    manner = _manner(law)
    told = count_slots(have, manner.roster, 2 if manner.claims else 1)
    if not 0 <= source < told or source == manner.me:
        return _MALFORMED
    longest = _walk_suffixes(store, manner, suffixes, source, told, False)
    if longest < 0 or _walk_claims(store, manner, registers, told, False) < 0:
        return _MALFORMED
    if told > length.shape[0]:
        return -told
    if longest > logs.shape[1]:
        return longest
    _apply_have(store, manner, have, source, told)
    _walk_suffixes(store, manner, suffixes, source, told, True)
    if manner.claims:
        _walk_claims(store, manner, registers, told, True)
    store.sending[2, source] = store.counters[_STEP]
    return _LEARNT


@kernel
def _find_least(store: Store, manner: Manner, target: int, least: np.ndarray) -> None:
    """The least that any neighbour, or the target alone, is known to hold in each slot of `known`.

    Whoever was heard lately is a neighbour. The origin of a slot does not count there: it holds its
    own state. NOBODY where nobody else counts.
    """
    origins = store.length.shape[0]
    least[:] = KNOWN_MAX + 1
    for other in range(origins):
        heard = store.sending[2, other]
        lately = heard >= 0 and heard + manner.patience + FRESH_STEPS >= store.counters[_STEP]
        if lately and other != manner.me and target in (NOBODY, other):
            log, claim = least[other], least[origins + other]
            for slot in range(least.shape[0]):  # row by row: so the processor takes many at once
                least[slot] = min(least[slot], store.known[other, slot])
            least[other], least[origins + other] = log, claim
    for slot in range(least.shape[0]):
        least[slot] = NOBODY if least[slot] > KNOWN_MAX else least[slot]


@kernel
def _start_of_suffix(
    store: Store, manner: Manner, target: int, least: int, origin: int, aged: int
) -> int:
    """First entry to send of an origin's log; its length when nothing is to be sent.

    least: how much of it all neighbours hold.
    """
    me, relay, patience = manner.me, manner.relay, manner.patience
    length = store.length[origin]
    if least < 0 and target < 0 and manner.beacon:
        return 0
    if least < 0:
        return store.sending[0, origin] if target >= 0 and origin == me else length
    step = store.counters[_STEP]
    if (origin == me or relay) and length - least <= (_REPEATED if manner.value_max > 0 else 0):
        return least
    if least < aged and step - store.sending[1, origin] >= patience:
        store.sending[1, origin] = step
        return least
    if origin == me or relay:
        return min(length, max(least, store.sending[0, origin]))
    return length


@kernel
def _put_suffix(
    store: Store, manner: Manner, out: np.ndarray, at: int, origin: int, start: int, room: int
) -> tuple[int, int]:
    """Write one suffix: (position after it, entries written)."""
    ledger, valued = manner.ledger, manner.value_max > 0
    log = store.logs[origin if ledger else 0]
    count = 0
    end = start
    while end < store.length[origin] and count < room:
        # In a log of minima only the newest entry of a sample matters: the one the vector holds.
        if ledger or log[end, 1] == store.weights[log[end, 0]]:
            count += 1
        end += 1
    at = put_uint(out, at, origin)
    at = put_uint(out, at, start)
    at = put_uint(out, at, end - start)
    at = put_uint(out, at, count)
    before = 0
    for entry in range(start, end):
        index, value = int(log[entry, 0]), int(log[entry, 1])
        if ledger or value == store.weights[index]:
            at = put_int(out, at, index - before)
            if valued:
                at = put_uint(out, at, value)
            before = index
    store.sending[0, origin] = max(store.sending[0, origin], end)
    return at, count


@kernel
def _put_claims(store: Store, manner: Manner, out: np.ndarray, at: int, least: np.ndarray) -> int:
    me, relay = manner.me, manner.relay
    origins = store.length.shape[0]
    step = store.counters[_STEP]
    for origin in range(origins):
        stamp = store.claims[_STAMP, origin]
        if stamp <= 0 or (
            origin != me and step - store.claims[_HEARD, origin] > _CLAIM_LEASE_STEPS
        ):
            continue
        if origin != me:
            held = least[origins + origin]
            slack = 0 if relay else _CLAIM_RENEWAL_STEPS
            if held < 0 or held + slack >= stamp:
                continue
        at = put_uint(out, at, origin)
        at = put_uint(out, at, stamp)
        at = put_uint(out, at, store.claims[_SAMPLE, origin] + 1)
        at = put_uint(out, at, store.claims[_SINCE, origin])
    return at


@kernel
def _compose(
    weights: np.ndarray,
    logs: np.ndarray,
    length: np.ndarray,
    known: np.ndarray,
    sending: np.ndarray,
    claims: np.ndarray,
    lowered: np.ndarray,
    mark: np.ndarray,
    counters: np.ndarray,
    law: np.ndarray,
    out: np.ndarray,
    least: np.ndarray,
    target: int,
) -> tuple[int, int, int]:
    """Write have, logs and claims one after the other; the position at the end of each.

    least: (2n,) room, see `_find_least`.
    """
    store = Store(
        weights,
        logs,
        length,
        known,
        sending,
        claims,
        lowered,
        mark,
        counters,
    )
    manner = _manner(law)
    me, ledger = manner.me, manner.ledger
    _find_least(store, manner, target, least)
    origins = store.length.shape[0]
    at = 0
    for origin in range(origins):
        at = put_uint(out, at, store.length[origin])
    if manner.claims:
        for origin in range(origins):
            at = put_uint(out, at, store.claims[_STAMP, origin])
    end_of_have = at
    slot = 3 + store.counters[_STEP] % manner.patience
    entries_left = _ENTRIES_MAX
    for turn in range(origins):
        origin = (me + turn) % origins
        if ledger or origin == me:
            aged = store.sending[slot, origin]
            start = _start_of_suffix(store, manner, target, least[origin], origin, aged)
            if start < store.length[origin] and entries_left > 0:
                at, written = _put_suffix(store, manner, out, at, origin, start, entries_left)
                entries_left -= written
    for origin in range(origins):
        store.sending[slot, origin] = store.length[origin]
    end_of_logs = at
    if manner.claims:
        at = _put_claims(store, manner, out, at, least)
    return end_of_have, end_of_logs, at


@kernel
def taken(claims: np.ndarray, counters: np.ndarray, me: int, out: np.ndarray) -> int:
    """Samples claimed by others that outrank this participant's claim; their number."""
    count = 0
    for origin in range(claims.shape[1]):
        sample = claims[_SAMPLE, origin]
        age = counters[_STEP] - claims[_HEARD, origin]
        if origin == me or sample < 0 or age > _CLAIM_LEASE_STEPS:
            continue
        if sample == claims[_SAMPLE, me]:
            mine = claims[_SINCE, me]
            theirs = claims[_SINCE, origin]
            if mine < theirs or (mine == theirs and me < origin):
                continue
        out[count] = sample
        count += 1
    return count


@kernel
def claim(claims: np.ndarray, counters: np.ndarray, me: int, sample: int, now_ns: int) -> None:
    """Claim a sample (or NOBODY) from now on, or renew the claim that is held."""
    if claims[_SAMPLE, me] != sample:
        claims[_SAMPLE, me] = sample
        claims[_SINCE, me] = max(
            0, now_ns
        )  # a clock may run wrong; a message holds no time before 0
    claims[_STAMP, me] = counters[_STEP]


@kernel
def _pack_lowered(
    weights: np.ndarray, lowered: np.ndarray, counters: np.ndarray, out: np.ndarray
) -> int:
    """Pairs (sample, units left) in the order in which they fell; the bytes used, or that they are too many."""
    count = counters[LOWERED]
    if 20 * count > out.shape[0]:
        return _NO_ROOM_TO_PACK
    at = 0
    before = 0
    for i in range(count):
        index = int(lowered[i])
        at = put_int(out, at, index - before)
        at = put_uint(out, at, int(weights[index]))
        before = index
    return at


@kernel
def _end_step(counters: np.ndarray) -> None:
    counters[LOWERED] = 0
    counters[_STEP] += 1


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
        self.manner = Manner(
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
        self.store = Store(
            weights=np.full(weighed, units.sample, dtype=np.int32),
            logs=np.zeros((rows, 256, 2), dtype=np.int32),
            length=np.zeros(slots, dtype=np.int64),
            known=np.zeros((slots, 2 * slots), dtype=np.int32),
            sending=_unsent(slots, self.manner.patience),
            claims=_unclaimed(slots),
            lowered=np.zeros(weighed, dtype=np.int32),
            mark=np.zeros(weighed, dtype=np.int32),
            counters=np.array([0, 1, weighed], dtype=np.int64),
        )
        self._law = np.array(self.manner, dtype=np.int64)
        self._fit_rooms()

    def _fit_rooms(self) -> None:
        """Have kernels work on the store as it is, with scratch for as many slots."""
        slots = self.slots
        self._out = np.zeros(20 * _ENTRIES_MAX + 120 * slots + 64, dtype=np.uint8)
        self._least = np.zeros(2 * slots, dtype=np.int32)
        self._fields = (*self.store, self._law)

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
        return self.store.counters.item(_HOLDING) == 0

    def learn(
        self, source: int, have: bytes, logs: bytes, claims: bytes, registers: bytes = b""
    ) -> bool:
        """Take in a message; False, and nothing changed, when it is malformed."""
        told = 0
        if registers:
            told = count_slots(have, self.manner.roster, 2 if self.manner.claims else 1)
            if not self.registers.sound(registers, told):
                return False
        outcome = _learn(*self._fields, have, logs, claims, source)
        while outcome != _LEARNT:
            if outcome == _MALFORMED:
                return False
            self._make_room(outcome)
            outcome = _learn(*self._fields, have, logs, claims, source)
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
        me, length = self.manner.me, int(self.store.length[self.manner.me])
        self.store.logs[me, length : length + indices.shape[0], 0] = indices
        self.store.length[me] += indices.shape[0]

    def reserve(self, entries: int) -> None:
        """Make room for this many more entries in every log."""
        written = self.store.length if self.manner.ledger else self.store.length[self.manner.me]
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
        self._fields = (*self.store, self._law)

    def _widen(self, slots: int) -> None:
        """Make room for this many origins: another incarnation was heard of."""
        old, before = self.store, self.slots
        known = np.zeros((slots, 2 * slots), dtype=np.int32)
        known[:before, :before] = old.known[:, :before]
        known[:before, slots : slots + before] = old.known[:, before:]
        length = np.zeros(slots, dtype=np.int64)
        length[:before] = old.length
        sending, claims = _unsent(slots, self.manner.patience), _unclaimed(slots)
        sending[:, :before], claims[:, :before] = old.sending, old.claims
        logs = old.logs
        if self.manner.ledger:
            logs = np.zeros((slots, *old.logs.shape[1:]), dtype=np.int32)
            logs[:before] = old.logs
        self.store = old._replace(
            logs=logs, length=length, known=known, sending=sending, claims=claims
        )
        self._fit_rooms()
        self.registers.widen(slots)

    def claim(self, sample: int, now_ns: int) -> None:
        """Claim a sample (or NOBODY) from now on, or renew the claim that is held."""
        claim(self.store.claims, self.store.counters, self.manner.me, sample, now_ns)

    def compose(self, target: int = NOBODY) -> tuple[bytes, bytes, bytes]:
        """(have, logs, claims) for one message to everybody, or to one participant."""
        end_of_have, end_of_logs, end = _compose(*self._fields, self._out, self._least, target)
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
        used = _pack_lowered(store.weights, store.lowered, store.counters, self._out)
        if used == _NO_ROOM_TO_PACK:
            index = self.lowered()
            return Pairs().encode(index, store.weights[index], index.shape[0])
        return self._out[:used].tobytes()

    def end_step(self) -> None:
        """Begin the next step."""
        _end_step(self.store.counters)
        self.registers.end_step()


def _unsent(slots: int, patience: int) -> npt.NDArray[np.int64]:
    """`Store.sending` of who has heard and sent nothing."""
    sending = np.zeros((3 + patience, slots), dtype=np.int64)
    sending[1:3] = -1 - patience
    return sending


def _unclaimed(slots: int) -> npt.NDArray[np.int64]:
    """`Store.claims` while nobody has a claim."""
    claims = np.zeros((4, slots), dtype=np.int64)
    claims[_SAMPLE] = NOBODY
    return claims


@kernel
def _read_have(have: np.ndarray, lengths: np.ndarray) -> int:
    at = 0
    for origin in range(lengths.shape[0]):
        lengths[origin], at = take_uint(have, at)
    return at


def read_have(have: bytes, origins: int) -> list[int] | None:
    """The log lengths in a version vector, by slot; origins: see `slots.slots_told`. None if malformed."""
    lengths = np.zeros(origins, dtype=np.int64)
    at = _read_have(np.frombuffer(have, dtype=np.uint8), lengths)
    return None if at < 0 else lengths.tolist()
