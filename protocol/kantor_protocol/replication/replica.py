"""Replication by anti-entropy: every participant holds the single-writer state of all others.

Theory of operation
-------------------
1. Every origin writes one *log* (append-only entries) and one *register* (its claim; the newest value wins, by the
   origin's stamp). No other participant writes them. An origin is one incarnation of a participant; what is known
   of it is stored at its incarnation id.
2. A version vector names how much of every log, and which stamp of every register, its sender holds. Each message
   carries that of its sender, which is at once its acknowledgement.
3. A message carries the suffixes that a neighbour of its sender lacks. A few unacknowledged entries are repeated in
   every message; a longer suffix is sent once, and again only when the acknowledgement has not come within
   `ack_timeout_steps`.
4. Entries of other origins are forwarded, so that they travel over several hops. A robot holds them back for
   `ack_timeout_steps`, since its neighbours most likely received them themselves; a relay does not. When *proving*,
   as far as they have attested them (`attested.py`).
5. What a planner shares beside weights and claims is in `registers.py` and travels in the same message.
6. Merging is idempotent: a suffix that starts beyond what is held is dropped (it will come again), what is held
   already is skipped. Loss, duplication, delay and reordering cost time, never correctness.

Two meanings of the log of a mission that explores a density, by `merge`:

ledger
    An entry is (sample, units spent by the origin). The weight of a sample is its initial weight minus the spending
    of all origins, never below 0. Nothing is lost and nothing is counted twice. No log ships more than its
    participant's energy allows.
min
    An entry is (sample, units left in the origin's vector) and is merged by the minimum (Kabir & Lee, eq. 8-10). An
    origin's log holds all that ever fell in its vector, what it merged included, so that nothing needs forwarding.
    Spending of two origins on one sample is counted once: the paper's rule, with the paper's weakness.

In a mission with a map there are no weights: an entry is a number alone (`occupancy_log.py` defines its meaning),
and logs are replicated as with a ledger. The fused map is computed from them.

Incarnations
------------
Incarnation ids are defined in `base/incarnations.py`. A version vector is for the ids that its sender knows, and a
sender holds nothing of ids beyond it. A participant that receives a longer version vector makes room for as many
ids. The log of an ended incarnation stays valid, and travels as any other; its claim expires.
"""

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.incarnations import INCARNATIONS_MAX, known_ids
from kantor_protocol.base.kernels import typed
from kantor_protocol.base.varint import Pairs
from kantor_protocol.replication.registers import OTHERS_MAX, STAMP_MAX, Registers
from kantor_protocol.replication.replica_kernels import (
    ENTRIES_MAX,
    HISTORY,
    HOLDING,
    KNOWN_MAX,
    LENGTH_MAX,
    LOWERED,
    MALFORMED,
    MERGED,
    NO_INDEX,
    NO_ROOM_TO_PACK,
    OFFERED,
    RECEIVED_STEP,
    REPEATED_STEP,
    SAMPLE,
    SENT,
    SHIPPED,
    SINCE_NS,
    STAMP,
    STAMP_STEP,
    STEP,
    UNITS_MAX,
    ReplicaArrays,
    ReplicaConfig,
    claim,
    claims_to_prove,
    compose,
    end_step,
    merge,
    pack_lowered,
)
from kantor_protocol.wire.version_vector import count_ids
from kantor_protocol.wire.weights import Units, Weights


class Replica:
    """The state of all participants as one participant holds it, and the messages by which it is kept equal."""

    def __init__(
        self,
        me: int,
        roster: int,
        samples: int,
        units: Units | None,
        *,
        ledger: bool,
        claims: bool,
        relay: bool = False,
        beacon: bool = False,
        ack_timeout_steps: int = 2,
        length_max: int = LENGTH_MAX,
        stamp_max: int = STAMP_MAX,
        spend_max: int = UNITS_MAX,
        proving: bool = False,
        registers: Registers | None = None,
    ) -> None:
        """An empty replica. Raises ValueError for an incarnation too many.

        me: its incarnation id. roster: participants in the roster. units: None for logs of bare indices below
        `samples`, with a ledger. registers: what the planner shares beside the logs, by default nothing. The rest:
        see ReplicaConfig.
        """
        origins = known_ids(me, roster)
        weighed = samples if units else 0
        units = units or Units(whole=0, sample=0, point=0)
        self.registers = Registers(me, roster, 0) if registers is None else registers
        """As many origins as here, unless their width is 0; its step is one less than `store.counters[STEP]`."""
        self.config = ReplicaConfig(
            me=me,
            ledger=ledger,
            claims=claims,
            relay=relay,
            beacon=beacon,
            ack_timeout_steps=max(1, ack_timeout_steps),
            value_max=units.point if ledger else units.sample,
            bound=samples,
            roster=roster,
            length_max=min(length_max, LENGTH_MAX),
            stamp_max=stamp_max,
            spend_max=min(spend_max, UNITS_MAX),
            proving=proving,
        )
        """`me` is one of the origins."""
        self._initial_weight = units.sample
        rows = origins if ledger else 1
        self.store = ReplicaArrays(
            weights=np.full(weighed, units.sample, dtype=np.int32),
            logs=np.zeros((rows, 256, 2), dtype=np.int32),
            length=np.zeros(origins, dtype=np.int64),
            known=np.zeros((origins, 2 * origins), dtype=np.int32),
            sending=_nothing_sent(origins, self.config.ack_timeout_steps),
            claims=_no_claims(origins),
            lowered=np.zeros(weighed, dtype=np.int32),
            mark=np.zeros(weighed, dtype=np.int32),
            counters=np.array([0, 1, weighed], dtype=np.int64),
        )
        """The arrays that kernels work on. ReplicaArrays states which of them agree with which."""
        self._settings = np.array(self.config, dtype=np.int64)
        self._make_scratch()
        self._merge = typed(merge, *self._fields, b"", b"", b"", 0)
        self._compose = typed(compose, *self._fields, self._out, self._least, NO_INDEX)
        self._pack = typed(pack_lowered, *self._to_pack)
        self._end_step = typed(end_step, self.store.counters)

    def _make_scratch(self) -> None:
        """Have kernels work on the store as it is, with scratch arrays for as many origins."""
        origins = self.origins
        self._out = np.zeros(20 * ENTRIES_MAX + 120 * origins + 64, dtype=np.uint8)
        self._least = np.zeros(2 * origins, dtype=np.int32)
        self._fields = (*self.store, self._settings)
        self._to_pack = (self.store.weights, self.store.lowered, self.store.counters, self._out)

    @property
    def origins(self) -> int:
        """Incarnation ids that it knows: the roster, once for each incarnation up to the latest it received."""
        return self.store.length.shape[0]

    @property
    def weights(self) -> Weights:
        """(N,) units left in this participant's view; they never rise."""
        return self.store.weights

    @property
    def empty(self) -> bool:
        """Whether no sample has weight left in this participant's view."""
        return self.store.counters.item(HOLDING) == 0

    def merge(
        self, source: int, version_vector: bytes, logs: bytes, claims: bytes, registers: bytes = b""
    ) -> bool:
        """Merge a message of an origin; False, and nothing changed, when it is malformed."""
        covered = 0
        if registers:
            parts = 2 if self.config.claims else 1
            covered = count_ids(version_vector, self.config.roster, parts)
            if not self.registers.is_well_formed(registers, covered):
                return False
        outcome = self._merge(*self._fields, version_vector, logs, claims, source)
        while outcome != MERGED:
            if outcome == MALFORMED:
                return False
            self._make_room(outcome)
            outcome = self._merge(*self._fields, version_vector, logs, claims, source)
        if registers:
            self.registers.merge(source, registers, covered)
        return True

    def _make_room(self, outcome: int) -> None:
        """Make the room that the kernel `merge` asks for."""
        if outcome > 0:
            self._lengthen(outcome)
        else:
            self._widen(-outcome)

    def append(self, indices: npt.NDArray[np.int64]) -> None:
        """Append (k,) bare indices, each below the bound, to the own log."""
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

    def _widen(self, origins: int) -> None:
        """Make room for this many origins: a message came from a participant that knows another incarnation."""
        old, before = self.store, self.origins
        known = np.zeros((origins, 2 * origins), dtype=np.int32)
        known[:before, :before] = old.known[:, :before]
        known[:before, origins : origins + before] = old.known[:, before:]
        length = np.zeros(origins, dtype=np.int64)
        length[:before] = old.length
        sending = _nothing_sent(origins, self.config.ack_timeout_steps)
        claims = _no_claims(origins)
        sending[:, :before], claims[:, :before] = old.sending, old.claims
        logs = old.logs
        if self.config.ledger:
            logs = np.zeros((origins, *old.logs.shape[1:]), dtype=np.int32)
            logs[:before] = old.logs
        self.store = old._replace(
            logs=logs, length=length, known=known, sending=sending, claims=claims
        )
        self._make_scratch()
        self.registers.widen(origins)

    def claim(self, sample: int, now_ns: int) -> None:
        """Claim a sample (or NO_INDEX) from now on, or renew the claim that is held."""
        claim(self.store.claims, self.store.counters, self.config.me, sample, now_ns)

    def compose(self, target: int = NO_INDEX) -> tuple[bytes, bytes, bytes]:
        """(version vector, logs, claims) of one message to all in range, or to one origin."""
        end_of_vector, end_of_logs, end = self._compose(
            *self._fields, self._out, self._least, target
        )
        message = self._out[:end].tobytes()
        return message[:end_of_vector], message[end_of_vector:end_of_logs], message[end_of_logs:]

    @property
    def in_contact(self) -> bool:
        """Whether the message that was composed last is for anybody from whom a message was received lately."""
        return self.config.beacon or self._least.item(self.config.me) >= 0

    def claims_to_prove(
        self, attested: npt.NDArray[np.int64], sent: npt.NDArray[np.int64]
    ) -> list[int]:
        """Origins whose attested claim a receiver of the message that was just composed lacks; see the kernel."""
        store, some = self.store, np.zeros(OTHERS_MAX, dtype=np.int64)
        counts = (store.claims, store.counters, self._settings, self._least, attested, sent)
        return some[: claims_to_prove(*counts, some)].tolist()

    @property
    def fell(self) -> bool:
        """Whether any weight fell in this step."""
        return self.store.counters.item(LOWERED) > 0

    def lowered(self) -> npt.NDArray[np.int32]:
        """Samples whose weight fell in this step, each once; a view valid until `end_step`."""
        return self.store.lowered[: self.store.counters.item(LOWERED)]

    def packed_lowered(self) -> bytes:
        """Packed pairs (sample, units left) of what fell in this step."""
        used = self._pack(*self._to_pack)
        if used == NO_ROOM_TO_PACK:
            index = self.lowered()
            return Pairs().encode(index, self.weights[index], index.shape[0])
        return self._out[:used].tobytes()

    def end_step(self) -> None:
        """Begin the next step."""
        self._end_step(self.store.counters)
        self.registers.end_step()

    # Invariants.

    def validate(self) -> None:
        """Assert what the sentences at the attributes here and in ReplicaArrays state. For tests: it takes long."""
        store, config = self.store, self.config
        origins, samples = self.origins, store.weights.shape[0]
        incarnations, rest = divmod(origins, config.roster)
        assert rest == 0
        assert 1 <= incarnations <= INCARNATIONS_MAX + 1
        assert 0 <= config.me < origins
        assert store.logs.shape[0] == (origins if config.ledger else 1)
        assert store.known.shape == (origins, 2 * origins)
        assert store.sending.shape == (HISTORY + config.ack_timeout_steps, origins)
        assert store.claims.shape == (4, origins)
        assert store.lowered.shape == store.mark.shape == (samples,)
        assert samples in {0, config.bound}
        self._validate_logs()
        self._validate_shipped()
        self._validate_weights()
        self._validate_lowered()
        self._validate_sending()
        self._validate_claims()
        self.registers.validate()
        if self.registers.total.size:
            assert self.registers.stamps.shape[0] == origins
        assert self.registers.step == store.counters[STEP] - 1

    def _held_logs(self) -> list[npt.NDArray[np.int32]]:
        """(length, 2) the entries of each log that is held: with min the own one only."""
        store, me = self.store, self.config.me
        if not self.config.ledger:
            return [store.logs[0, : store.length[me]]]
        return [log[:length] for log, length in zip(store.logs, store.length, strict=True)]

    def _validate_logs(self) -> None:
        store, config = self.store, self.config
        assert (store.length >= 0).all()
        if config.ledger:
            assert (store.length <= store.logs.shape[1]).all()
            assert (np.delete(store.length, config.me) <= config.length_max).all()
        else:
            assert store.length[config.me] <= store.logs.shape[1]
            assert (store.length <= config.length_max).all()
        for log in self._held_logs():
            assert (log >= 0).all()
            assert (log[:, 0] < config.bound).all()
            assert (log[:, 1] <= config.value_max).all()

    def _validate_shipped(self) -> None:
        config, shipped = self.config, self.store.sending[SHIPPED]
        if not config.ledger:
            assert not shipped.any()
            return
        assert shipped.tolist() == [log[:, 1].sum(dtype=np.int64) for log in self._held_logs()]
        by_place = shipped.reshape(-1, config.roster).sum(axis=0)
        others = np.arange(config.roster) != config.me % config.roster
        assert (by_place[others] <= config.spend_max).all()

    def _validate_weights(self) -> None:
        store, initial = self.store, self._initial_weight
        assert (store.weights >= 0).all()
        assert (store.weights <= initial).all()
        assert store.counters[HOLDING] == np.count_nonzero(store.weights)
        if not store.weights.size:
            return
        expected = np.full(store.weights.shape[0], initial, dtype=np.int64)
        for log in self._held_logs():
            if self.config.ledger:
                np.subtract.at(expected, log[:, 0], log[:, 1])
            else:
                np.minimum.at(expected, log[:, 0], log[:, 1])
        assert (store.weights == np.maximum(expected, 0)).all()

    def _validate_lowered(self) -> None:
        store = self.store
        lowered, step = self.lowered(), store.counters[STEP]
        assert 0 <= store.counters[LOWERED] <= store.weights.shape[0]
        assert np.unique(lowered).size == lowered.size
        assert (store.weights[lowered] < self._initial_weight).all()
        assert (np.flatnonzero(store.mark == step) == np.sort(lowered)).all()
        assert (store.mark <= step).all()

    def _validate_sending(self) -> None:
        store, me, origins = self.store, self.config.me, self.origins
        step, never = store.counters[STEP], -1 - self.config.ack_timeout_steps
        assert (store.known >= 0).all()
        assert (store.known <= KNOWN_MAX).all()
        assert not store.known[me].any()
        assert self.config.claims or not store.known[:, origins:].any()
        for lengths in (*store.sending[[SENT, OFFERED]], *store.sending[HISTORY:]):
            assert (lengths >= 0).all()
            assert (lengths <= store.length).all()
        for steps in store.sending[[REPEATED_STEP, RECEIVED_STEP]]:
            assert ((steps == never) | ((steps >= 1) & (steps <= step))).all()
        assert store.sending[RECEIVED_STEP, me] == never
        # What another is known to hold, it has said in a message.
        silent = store.sending[RECEIVED_STEP] == never
        assert not store.known[silent].any()

    def _validate_claims(self) -> None:
        store, me, step = self.store, self.config.me, self.store.counters[STEP]
        sample, since_ns, stamp, stamp_step = store.claims[[SAMPLE, SINCE_NS, STAMP, STAMP_STEP]]
        assert ((sample >= NO_INDEX) & (sample < store.weights.shape[0])).all()
        assert (since_ns >= 0).all()
        assert (stamp >= 0).all()
        assert ((stamp_step >= 0) & (stamp_step <= step)).all()
        unclaimed = stamp == 0
        assert (sample[unclaimed] == NO_INDEX).all()
        assert not since_ns[unclaimed].any()
        assert not stamp_step[unclaimed].any()
        assert stamp[me] <= step
        assert stamp_step[me] == 0
        others = np.arange(self.origins) != me
        assert self.config.claims or not stamp[others].any()


def _nothing_sent(origins: int, ack_timeout_steps: int) -> npt.NDArray[np.int64]:
    """`ReplicaArrays.sending` of a participant that has received and sent nothing."""
    sending = np.zeros((HISTORY + ack_timeout_steps, origins), dtype=np.int64)
    sending[[REPEATED_STEP, RECEIVED_STEP]] = -1 - ack_timeout_steps
    return sending


def _no_claims(origins: int) -> npt.NDArray[np.int64]:
    """`ReplicaArrays.claims` before any participant has claimed a sample."""
    claims = np.zeros((4, origins), dtype=np.int64)
    claims[SAMPLE] = NO_INDEX
    return claims
