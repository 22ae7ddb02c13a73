"""The compiled kernels of replication: merging, composing and claiming on the arrays of a replica."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import (
    put_int,
    put_uint,
    read_pair,
    read_uint,
    skip_numbers,
)
from kantor_protocol.replication.registers import FRESH_STEPS, OTHERS_MAX
from kantor_protocol.wire.version_vector import count_ids, raise_entries

NO_INDEX = -1
"""Instead of a sample: none. Instead of an incarnation id: none; as the target of a message: all participants in range."""

MERGED, MALFORMED = 0, -1

NO_ROOM_TO_PACK = -1

ENTRIES_MAX = 4096
"""Log entries in one message; the rest follows with the next."""

_CLAIM_LEASE_STEPS = 12
"""A claim that has not been renewed for so many of the holder's steps counts no more."""

_CLAIM_RENEWAL_STEPS = 6
"""Steps by which a neighbour's knowledge of a foreign claim may be stale before a robot forwards the claim."""

_REPEATED_ENTRIES = 32
"""So many unacknowledged entries are repeated with every message, so that one loss costs nothing. Bare entries wait
for the acknowledgement instead: there are dozens of them a step, and a late cell does no harm."""

LENGTH_MAX = 1 << 40
"""No log of any mission is longer; it keeps sums of positions within 64 bits."""

KNOWN_MAX = (1 << 31) - 2
"""More is not remembered of what another holds: it fits into 32 bits, and no log gets so long."""

UNITS_MAX = 1 << 62
"""No participant ships more units."""

BLOCK = 32
"""Entries of a log whose hash is one link of a chain; see `attested.py`."""

REST_BLOCKS_MAX = 4096
"""Blocks of which a message holds the hash instead of the entries, at most."""

# Rows of ReplicaArrays.claims.
SAMPLE, SINCE_NS, STAMP, STAMP_STEP = 0, 1, 2, 3

# Rows of ReplicaArrays.sending; from HISTORY on, one for each step of the acknowledgement timeout.
SENT, REPEATED_STEP, RECEIVED_STEP, OFFERED, SHIPPED, HISTORY = 0, 1, 2, 3, 4, 5

# Entries of ReplicaArrays.counters.
LOWERED, STEP, HOLDING = 0, 1, 2


class ReplicaArrays(NamedTuple):
    """All that a participant holds, for the kernels. n origins, N samples. `Replica.validate` asserts every sentence.

    Hot fields are int32 and contiguous, for runs of many robots.
    """

    weights: npt.NDArray[np.int32]
    """(N,) units left in this participant's view. Between 0 and the initial weight. ledger: the initial weight minus
    the values of all entries held in `logs`, or 0. min: the least value in the own log, or the initial weight."""
    logs: npt.NDArray[np.int32]
    """(n, capacity, 2) entries: sample, value. min: (1, capacity, 2), the own log only. Of row i, `length[i]`
    entries count. Samples are below `ReplicaConfig.bound`, values between 0 and `ReplicaConfig.value_max`."""
    length: npt.NDArray[np.int64]
    """(n,) entries held of each log, at most its capacity. min: of other origins, how much has been merged.
    Of other origins at most `ReplicaConfig.length_max`."""
    known: npt.NDArray[np.int32]
    """(n, 2n) what each origin is known to hold: log lengths, then claim stamps; each between 0 and KNOWN_MAX. 0 in
    the own row, in rows of origins from which nothing was received, and for stamps in missions without claims."""
    sending: npt.NDArray[np.int64]
    """(HISTORY + ack_timeout_steps, n), for each origin. SENT: entries of its log that were sent. REPEATED_STEP: step
    at which they were last repeated. RECEIVED_STEP: step at which a message of it was last received; never for the
    own id. OFFERED: entries of its log that could be sent when a message was last composed; when proving, of others what
    they have attested. From HISTORY on: the same at each of the last `ack_timeout_steps` steps. Numbers of entries are
    at most `length`; steps are at most the current one, or -1 - ack_timeout_steps for never. SHIPPED, with a ledger:
    the sum of values of all entries held of its log, of all incarnations of another participant together at most
    `ReplicaConfig.spend_max`; 0 otherwise."""
    claims: npt.NDArray[np.int64]
    """(4, n): sample or NO_INDEX; since_ns, never negative; stamp; own step at which the stamp was received, at most
    the current one, 0 for the own claim. An origin without a stamp has no sample and 0 in the other rows. The own
    stamp is the step of the last claim. Without claims no other origin has a stamp."""
    lowered: npt.NDArray[np.int32]
    """(N,) indices of the weights that fell since the last `end_step`, each once: as many as `counters[LOWERED]`,
    each with a weight below the initial one."""
    mark: npt.NDArray[np.int32]
    """(N,) the step at which an index was put into `lowered`: the current one for those in it, an earlier one for all
    others."""
    counters: npt.NDArray[np.int64]
    """(3,): LOWERED, how many indices are in `lowered`; STEP, the current step; HOLDING, how many weights are
    above 0."""


class ReplicaConfig(NamedTuple):
    """The rules by which a participant merges and sends; they never change."""

    me: int
    """The own incarnation id."""
    ledger: bool
    claims: bool
    relay: bool
    """Entries of other origins are forwarded at once."""
    beacon: bool
    """All that it holds is sent while nothing is received."""
    ack_timeout_steps: int
    """Own steps within which an acknowledgement is due."""
    value_max: int
    """The largest value of a log entry; 0: entries have no value and weigh nothing."""
    bound: int
    """Every index in a log is below it."""
    roster: int
    """Participants in the roster; incarnation ids come in blocks of so many."""
    length_max: int
    """No origin writes a longer log in this mission; at most LENGTH_MAX."""
    stamp_max: int
    """No claim has a later stamp in this mission."""
    spend_max: int
    """No participant ships more units in this mission, all its incarnations together; at most UNITS_MAX."""
    proving: bool
    """Of others it sends only what they have attested, from the beginning of a block on; see `attested.py`."""


@kernel
def _lower(store: ReplicaArrays, index: int, value: int) -> None:
    store.counters[HOLDING] -= value <= 0 < store.weights[index]
    store.weights[index] = value
    if store.mark[index] != store.counters[STEP]:
        store.mark[index] = np.int32(store.counters[STEP])
        store.lowered[store.counters[LOWERED]] = index
        store.counters[LOWERED] += 1


@kernel
def _append(store: ReplicaArrays, row: int, origin: int, index: int, value: int) -> None:
    store.logs[row, store.length[origin], 0] = index
    store.logs[row, store.length[origin], 1] = value
    store.length[origin] += 1


@kernel
def _append_spending(store: ReplicaArrays, origin: int, index: int, value: int) -> None:
    _append(store, origin, origin, index, value)
    store.sending[SHIPPED, origin] += value


@kernel
def _unspent(sending: np.ndarray, origin: int, roster: int, spend_max: int) -> int:
    """Units that the participant of an origin can have shipped beside all that is held of it."""
    for each in range(origin % roster, sending.shape[1], roster):
        spend_max -= sending[SHIPPED, each]
    return spend_max


@kernel
def spend(store: ReplicaArrays, config: ReplicaConfig, index: int, units: int) -> None:
    """Ship `units` to a sample and log it. The log must have room for one more entry."""
    _lower(store, index, store.weights[index] - units)
    if config.ledger:
        _append_spending(store, config.me, index, units)
    else:
        _append(store, 0, config.me, index, store.weights[index])


@kernel
def _merge_entry(
    store: ReplicaArrays, config: ReplicaConfig, origin: int, index: int, value: int
) -> None:
    if config.ledger:
        _append_spending(store, origin, index, value)
        if value > 0 and store.weights[index] > 0:
            _lower(store, index, max(0, store.weights[index] - value))
    elif value < store.weights[index]:
        _lower(store, index, value)
        _append(store, 0, config.me, index, value)


@kernel
def _check_suffixes(
    store: ReplicaArrays, config: ReplicaConfig, suffixes: bytes, source: int, covered: int
) -> int:
    """Check all suffixes, of the first `covered` origins.

    Returns how many entries some log may hold after them, or a negative number when malformed. In the message of its
    own origin a log is malformed that ships more than its participant has, and elsewhere one whose suffix does by itself.
    """
    ledger = config.ledger
    origins = store.length.shape[0]
    at = 0
    entries = 0
    longest = 0
    while at < len(suffixes):
        origin, at = read_uint(suffixes, at)
        start, at = read_uint(suffixes, at)
        span, at = read_uint(suffixes, at)
        count, at = read_uint(suffixes, at)
        if at < 0 or origin >= covered or count > span or count > len(suffixes):
            return -1
        if start > config.length_max or span > config.length_max - start:
            return -1
        if (ledger and count != span) or (not ledger and origin != source):
            return -1
        held = store.length[origin] if origin < origins else 0
        entries += count
        if not ledger:
            longest = store.length[config.me] + entries
        elif start <= held + entries:  # it may follow on another suffix in this message
            longest = max(longest, start + span)
        index = 0
        units = 0
        for i in range(count):
            index, value, at = read_pair(suffixes, at, index, config.value_max > 0)
            if at < 0 or index < 0 or index >= config.bound or value > config.value_max:
                return -1
            units += value if start + i >= held else 0
        left = config.spend_max
        if origin == source:
            left = _unspent(store.sending, origin, config.roster, config.spend_max)
        if ledger and units > left:
            return -1
    return longest


@kernel
def _apply_suffixes(store: ReplicaArrays, config: ReplicaConfig, suffixes: bytes) -> None:
    """Merge what is new in suffixes that have been checked, as far as its participant can have shipped it."""
    ledger = config.ledger
    at = 0
    while 0 <= at < len(suffixes):
        origin, at = read_uint(suffixes, at)
        start, at = read_uint(suffixes, at)
        span, at = read_uint(suffixes, at)
        count, at = read_uint(suffixes, at)
        held = store.length[origin]
        fresh = origin != config.me and (not ledger or start <= held < start + count)
        if not fresh:
            at = skip_numbers(suffixes, at, 2 * count if config.value_max > 0 else count)
            continue
        left = _unspent(store.sending, origin, config.roster, config.spend_max)
        index = 0
        for i in range(count):
            index, value, at = read_pair(suffixes, at, index, config.value_max > 0)
            if ledger:
                left -= value if start + i >= held else 0
                if start + i < held or left < 0:
                    continue
            _merge_entry(store, config, origin, index, value)
        if not ledger and start <= held:
            store.length[origin] = max(held, start + span)


@kernel
def _walk_claims(
    store: ReplicaArrays, config: ReplicaConfig, claims: bytes, covered: int, apply: bool
) -> int:
    at = 0
    while at < len(claims):
        origin, at = read_uint(claims, at)
        stamp, at = read_uint(claims, at)
        sample, at = read_uint(claims, at)
        since, at = read_uint(claims, at)
        if at < 0 or origin >= covered or sample > config.bound or stamp > config.stamp_max:
            return -1
        if apply and origin != config.me and stamp > store.claims[STAMP, origin]:
            store.claims[SAMPLE, origin] = sample - 1
            store.claims[SINCE_NS, origin] = since
            store.claims[STAMP, origin] = stamp
            store.claims[STAMP_STEP, origin] = store.counters[STEP]
    return at


@kernel
def _apply_version_vector(
    store: ReplicaArrays, config: ReplicaConfig, version_vector: bytes, source: int, covered: int
) -> None:
    known = store.known[source]
    origins = store.length.shape[0]
    parts = 2 if config.claims else 1
    if covered == origins and len(version_vector) == parts * covered:
        # One byte for each entry: the processor takes many at once.
        for i in range(parts * covered):
            known[i] = max(known[i], np.int32(version_vector[i]))
        return
    at = 0
    for part in range(parts):
        entries = known[part * origins : part * origins + covered]
        at = raise_entries(version_vector, at, entries, KNOWN_MAX)


@kernel
def config_of(settings: np.ndarray) -> ReplicaConfig:
    """Configuration of a replica from its row of integers, as kernels take it."""
    return ReplicaConfig(
        settings[0],
        settings[1] != 0,
        settings[2] != 0,
        settings[3] != 0,
        settings[4] != 0,
        settings[5],
        settings[6],
        settings[7],
        settings[8],
        settings[9],
        settings[10],
        settings[11],
        settings[12] != 0,
    )


@kernel
def _check(
    store: ReplicaArrays,
    config: ReplicaConfig,
    version_vector: bytes,
    suffixes: bytes,
    claimed: bytes,
    source: int,
) -> int:
    """Check a message whole: how many entries some log may hold after it, or MALFORMED."""
    covered = count_ids(version_vector, config.roster, 2 if config.claims else 1)
    if not 0 <= source < covered or source == config.me:
        return MALFORMED
    longest = _check_suffixes(store, config, suffixes, source, covered)
    if longest < 0 or _walk_claims(store, config, claimed, covered, False) < 0:
        return MALFORMED
    return longest


@kernel
def is_mergeable(
    weights: np.ndarray,
    logs: np.ndarray,
    length: np.ndarray,
    known: np.ndarray,
    sending: np.ndarray,
    claims: np.ndarray,
    lowered: np.ndarray,
    mark: np.ndarray,
    counters: np.ndarray,
    settings: np.ndarray,
    version_vector: bytes,
    suffixes: bytes,
    claimed: bytes,
    source: int,
) -> bool:
    """Whether `merge` would take a message. Arguments: as for `merge`; nothing changes."""
    store = ReplicaArrays(
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
    return _check(store, config_of(settings), version_vector, suffixes, claimed, source) >= 0


@kernel
def merge(
    weights: np.ndarray,
    logs: np.ndarray,
    length: np.ndarray,
    known: np.ndarray,
    sending: np.ndarray,
    claims: np.ndarray,
    lowered: np.ndarray,
    mark: np.ndarray,
    counters: np.ndarray,
    settings: np.ndarray,
    version_vector: bytes,
    suffixes: bytes,
    claimed: bytes,
    source: int,
) -> int:
    """Check a message whole, then apply it whole.

    Returns MERGED; or, and nothing changed, MALFORMED, the length that logs must have room for, or the
    negative of the number of origins that there must be room for. ReplicaArrays come field by field, see
    `base/kernels.py`, and the ReplicaConfig as a row of integers.
    """
    store = ReplicaArrays(
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
    config = config_of(settings)
    covered = count_ids(version_vector, config.roster, 2 if config.claims else 1)
    longest = _check(store, config, version_vector, suffixes, claimed, source)
    if longest < 0:
        return MALFORMED
    if covered > length.shape[0]:
        return -covered
    if longest > logs.shape[1]:
        return longest
    _apply_version_vector(store, config, version_vector, source, covered)
    _apply_suffixes(store, config, suffixes)
    if config.claims:
        _walk_claims(store, config, claimed, covered, True)
    store.sending[RECEIVED_STEP, source] = store.counters[STEP]
    return MERGED


@kernel
def _find_least(
    store: ReplicaArrays, config: ReplicaConfig, target: int, least: np.ndarray
) -> None:
    """The least that any neighbour, or the target alone, is known to hold, for each column of `known`.

    A neighbour is an origin from which a message was received lately. The origin of a column does not count there:
    it holds its own state. NO_INDEX where no other counts.
    """
    origins = store.length.shape[0]
    least[:] = KNOWN_MAX + 1
    for other in range(origins):
        received = store.sending[RECEIVED_STEP, other]
        fresh_until = received + config.ack_timeout_steps + FRESH_STEPS
        lately = received >= 0 and fresh_until >= store.counters[STEP]
        if lately and other != config.me and target in (NO_INDEX, other):
            log, claim = least[other], least[origins + other]
            for i in range(least.shape[0]):  # row by row: so the processor takes many at once
                least[i] = min(least[i], store.known[other, i])
            least[other], least[origins + other] = log, claim
    for i in range(least.shape[0]):
        least[i] = NO_INDEX if least[i] > KNOWN_MAX else least[i]


@kernel
def _start_of_suffix(
    store: ReplicaArrays,
    config: ReplicaConfig,
    target: int,
    least: int,
    origin: int,
    length: int,
    aged: int,
) -> int:
    """First entry to send of an origin's log; `length` when nothing is to be sent.

    least: how much of it all neighbours hold. length: how much of it may be sent; aged: some steps ago.
    """
    me, relay = config.me, config.relay
    if least < 0 and target < 0 and config.beacon:
        return 0
    if least < 0:
        return store.sending[SENT, origin] if target >= 0 and origin == me else length
    step = store.counters[STEP]
    if (origin == me or relay) and length - least <= (
        _REPEATED_ENTRIES if config.value_max > 0 else 0
    ):
        return least
    if least < aged and step - store.sending[REPEATED_STEP, origin] >= config.ack_timeout_steps:
        store.sending[REPEATED_STEP, origin] = step
        return least
    if origin == me or relay:
        return min(length, max(least, store.sending[SENT, origin]))
    return length


@kernel
def _proven_part(start: int, length: int, room: int) -> tuple[int, int]:
    """The part of a suffix that is sent with its proof: from the beginning of a block to the end or to that of another."""
    start -= start % BLOCK
    end = min(length, start + room)
    if end < length:
        end -= end % BLOCK
    if length - end > REST_BLOCKS_MAX * BLOCK:
        return start, start
    return start, end


@kernel
def _put_suffix(
    store: ReplicaArrays,
    config: ReplicaConfig,
    out: np.ndarray,
    at: int,
    origin: int,
    start: int,
    length: int,
    room: int,
) -> tuple[int, int]:
    """Write one suffix of the first `length` entries: (position after it, entries written)."""
    ledger, valued = config.ledger, config.value_max > 0
    log = store.logs[origin if ledger else 0]
    count = 0
    end = start
    while end < length and count < room:
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
    store.sending[SENT, origin] = max(store.sending[SENT, origin], end)
    return at, count


@kernel
def _put_claims(
    store: ReplicaArrays, config: ReplicaConfig, out: np.ndarray, at: int, least: np.ndarray
) -> int:
    me, relay = config.me, config.relay
    origins = store.length.shape[0]
    step = store.counters[STEP]
    for origin in range(origins):
        stamp = store.claims[STAMP, origin]
        if origin != me and config.proving:
            continue  # it travels in its origin's attestation
        if stamp <= 0 or (
            origin != me and step - store.claims[STAMP_STEP, origin] > _CLAIM_LEASE_STEPS
        ):
            continue
        if origin != me:
            held = least[origins + origin]
            slack = 0 if relay else _CLAIM_RENEWAL_STEPS
            if held < 0 or held + slack >= stamp:
                continue
        at = put_uint(out, at, origin)
        at = put_uint(out, at, stamp)
        at = put_uint(out, at, store.claims[SAMPLE, origin] + 1)
        at = put_uint(out, at, store.claims[SINCE_NS, origin])
    return at


@kernel
def compose(
    weights: np.ndarray,
    logs: np.ndarray,
    length: np.ndarray,
    known: np.ndarray,
    sending: np.ndarray,
    claims: np.ndarray,
    lowered: np.ndarray,
    mark: np.ndarray,
    counters: np.ndarray,
    settings: np.ndarray,
    out: np.ndarray,
    least: np.ndarray,
    target: int,
) -> tuple[int, int, int]:
    """Write version vector, logs and claims one after the other; the position at the end of each.

    least: (2n,) scratch, see `_find_least`. Everything else: see `merge`.
    """
    store = ReplicaArrays(
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
    config = config_of(settings)
    me, ledger = config.me, config.ledger
    _find_least(store, config, target, least)
    origins = store.length.shape[0]
    at = 0
    for origin in range(origins):
        if origin == me or not config.proving:
            store.sending[OFFERED, origin] = store.length[origin]
        at = put_uint(out, at, store.length[origin])
    if config.claims:
        for origin in range(origins):
            at = put_uint(out, at, store.claims[STAMP, origin])
    end_of_vector = at
    now = HISTORY + store.counters[STEP] % config.ack_timeout_steps
    entries_left, others_left = ENTRIES_MAX, OTHERS_MAX if config.proving else origins
    for turn in range(origins):
        origin = (me + turn) % origins
        if ledger or origin == me:
            aged, end = store.sending[now, origin], store.sending[OFFERED, origin]
            start = _start_of_suffix(store, config, target, least[origin], origin, end, aged)
            if start < end and origin != me and config.proving:
                start, end = _proven_part(start, end, entries_left if others_left > 0 else 0)
                others_left -= start < end
            if start < end and entries_left > 0:
                at, written = _put_suffix(store, config, out, at, origin, start, end, entries_left)
                entries_left -= written
    for origin in range(origins):
        store.sending[now, origin] = store.sending[OFFERED, origin]
    end_of_logs = at
    if config.claims:
        at = _put_claims(store, config, out, at, least)
    return end_of_vector, end_of_logs, at


@kernel
def claims_to_prove(
    claims: np.ndarray,
    counters: np.ndarray,
    settings: np.ndarray,
    least: np.ndarray,
    attested: np.ndarray,
    sent: np.ndarray,
    out: np.ndarray,
) -> int:
    """Write to `out` origins whose attested claim a neighbour lacks; their number, at most the size of `out`.

    least: as `compose` has left it. attested: (n,) the stamp of each attested claim, 0 for none. sent: (2, n) the stamp
    with which it was last sent, and the step. The rules: as of `_put_claims`, and each is sent again only when the
    acknowledgement has not come.
    """
    me, ack_timeout_steps = settings[0], settings[5]
    origins, step = attested.shape[0], counters[STEP]
    count = 0
    for turn in range(origins):
        origin = (me + turn) % origins
        stamp, held = attested[origin], least[origins + origin]
        wanted = stamp > 0 and 0 <= held < stamp - _CLAIM_RENEWAL_STEPS
        alive = step - claims[STAMP_STEP, origin] <= _CLAIM_LEASE_STEPS
        waits = stamp <= sent[0, origin] and step - sent[1, origin] < ack_timeout_steps
        if wanted and alive and not waits and count < out.shape[0]:
            out[count] = origin
            count += 1
    return count


@kernel
def claimed_by_others(claims: np.ndarray, counters: np.ndarray, me: int, out: np.ndarray) -> int:
    """Write to `out` the samples of other origins' live claims that outrank the own claim; their number."""
    count = 0
    for origin in range(claims.shape[1]):
        sample = claims[SAMPLE, origin]
        age = counters[STEP] - claims[STAMP_STEP, origin]
        if origin == me or sample < 0 or age > _CLAIM_LEASE_STEPS:
            continue
        if sample == claims[SAMPLE, me]:
            mine = claims[SINCE_NS, me]
            theirs = claims[SINCE_NS, origin]
            if mine < theirs or (mine == theirs and me < origin):
                continue
        out[count] = sample
        count += 1
    return count


@kernel
def claim(claims: np.ndarray, counters: np.ndarray, me: int, sample: int, now_ns: int) -> None:
    """Claim a sample (or NO_INDEX) from now on, or renew the claim that is held."""
    if claims[SAMPLE, me] != sample:
        claims[SAMPLE, me] = sample
        # A clock may run wrong; a message holds no time before 0.
        claims[SINCE_NS, me] = max(0, now_ns)
    claims[STAMP, me] = counters[STEP]


@kernel
def pack_lowered(
    weights: np.ndarray, lowered: np.ndarray, counters: np.ndarray, out: np.ndarray
) -> int:
    """Pairs (sample, units left) in the order in which they fell; the bytes used, or NO_ROOM_TO_PACK."""
    count = counters[LOWERED]
    if 20 * count > out.shape[0]:
        return NO_ROOM_TO_PACK
    at = 0
    before = 0
    for i in range(count):
        index = int(lowered[i])
        at = put_int(out, at, index - before)
        at = put_uint(out, at, int(weights[index]))
        before = index
    return at


@kernel
def end_step(counters: np.ndarray) -> None:
    """Forget the weights that were lowered in this step, and count the step."""
    counters[LOWERED] = 0
    counters[STEP] += 1
