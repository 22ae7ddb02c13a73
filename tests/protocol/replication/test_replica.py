"""Replication: nothing is lost by loss, nothing is counted twice by repetition (design, part 4).

Messages that a test writes itself come from `whole`, an encoder of the wire format that shares
nothing with the kernels. Its reference for weights is a plain sum, or a plain minimum.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import KNOWN_MAX, NO_INDEX, spend
from kantor_protocol.wire.weights import Units
from support import replicas
from support.strategies import examples

N = 6
UNITS = Units.of(8, N)
"""Four units a sample, three a point."""

Message = tuple[bytes, bytes, bytes]
Entry = tuple[int, int]
Purchases = list[Entry]
"""(sample, units wanted), one after the other."""

PURCHASES = st.lists(st.tuples(st.integers(0, N - 1), st.integers(1, UNITS.point)), max_size=12)
TEAM_PURCHASES = st.tuples(PURCHASES, PURCHASES, PURCHASES)
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


def buy(held: Replica, purchases: Purchases) -> None:
    """Spend on samples, as far as there is weight in the replica's view."""
    for sample, wanted in purchases:
        units = min(wanted, int(held.weights[sample]))
        if units > 0:
            held.reserve(1)
            spend(held.store, held.config, sample, units)


def team(bought: Iterable[Purchases], *, ledger: bool) -> list[Replica]:
    """One replica for each list of purchases, made in ignorance of the others'."""
    lists = list(bought)
    made = [replica(i, len(lists), ledger=ledger) for i in range(len(lists))]
    for held, purchases in zip(made, lists, strict=True):
        buy(held, purchases)
    return made


def leb128(value: int) -> bytes:
    """Seven bits a byte, low bits first, the high bit on all but the last."""
    out = bytearray()
    while value > 127:
        out.append(value % 128 + 128)
        value //= 128
    return bytes([*out, value])


def suffix(origin: int, start: int, entries: list[Entry], span: int | None = None) -> bytes:
    """A log suffix: origin, start, span, count, then (difference of sample, value)."""
    head = (origin, start, len(entries) if span is None else span, len(entries))
    content = b"".join(leb128(number) for number in head)
    before = 0
    for index, value in entries:
        step, before = index - before, index
        content += leb128(2 * step if step >= 0 else -2 * step - 1) + leb128(value)
    return content


def claim(origin: int, stamp: int, sample: int, since_ns: int) -> bytes:
    """A claim register: origin, stamp, sample + 1, since."""
    return b"".join(leb128(number) for number in (origin, stamp, sample + 1, since_ns))


def version_vector(origins: int, *, claims: bool = True) -> bytes:
    """A version vector that claims to hold nothing."""
    return bytes(2 * origins if claims else origins)


def whole(held: Replica) -> Message:
    """Everything that a replica holds of logs, as one message; it acknowledges nothing."""
    config, origins = held.config, held.store.length.shape[0]
    told = range(origins) if config.ledger else [config.me]
    logs = b"".join(suffix(origin, 0, replicas.entries(held, origin)) for origin in told)
    return version_vector(origins, claims=config.claims), logs, b""


def join(held: Replica, *others: Replica) -> Replica:
    """Let a replica learn all that others hold, one after the other."""
    for other in others:
        assert held.merge(other.config.me, *whole(other))
    return held


def vector(held: Replica) -> list[int]:
    """Its weights."""
    return list(map(int, held.weights))


def truth(made: Iterable[Replica]) -> list[int]:
    """The weights that all must come to, by a plain dictionary."""
    made = list(made)
    if not made[0].config.ledger:
        return [min(column) for column in zip(*map(vector, made), strict=True)]
    bought: Counter[int] = Counter()
    for held in made:
        for sample, units in replicas.entries(held, held.config.me):
            bought[sample] += units
    return [max(0, UNITS.sample - bought[sample]) for sample in range(N)]


def snapshot(held: Replica) -> list[Any]:
    """Every array of the store: shape and numbers."""
    return [(array.shape, array.tolist()) for array in held.store]


def knowledge(held: Replica) -> list[Any]:
    """What a replica holds, apart from what it knows about others."""
    origins = held.store.length.shape[0]
    logs = [replicas.entries(held, i) for i in range(origins)] if held.config.ledger else []
    return [vector(held), logs]


Hears = Callable[[int, int], bool]


class Air:
    """A radio without losses: what is said in one round is heard at the start of the next."""

    def __init__(self, made: list[Replica], hears: Hears = lambda _i, _j: True) -> None:
        self._made, self._hears = made, hears
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
                if j != i and self._hears(i, j):
                    self._inboxes[j].append((i, message))

    def rounds_until(self, agreed: list[int], most: int) -> int:
        """Rounds until the weights of all are these; fails after `most`."""
        for count in range(most):
            if all(vector(held) == agreed for held in self._made):
                return count
            self.round()
        assert [vector(held) for held in self._made] == [agreed] * len(self._made)
        return most


# The merge, as a join of what two replicas hold.


@MODES
@examples(60)
@given(bought=TEAM_PURCHASES)
def test_merge_is_idempotent(*, ledger: bool, bought: tuple[Purchases, ...]) -> None:
    """Hearing the same thing twice is hearing it once."""
    a, b, _ = team(bought, ledger=ledger)
    once = knowledge(join(a, b))

    assert knowledge(join(a, b)) == once
    assert knowledge(join(a, b, b)) == once


@MODES
@examples(60)
@given(bought=TEAM_PURCHASES)
def test_merge_is_commutative(*, ledger: bool, bought: tuple[Purchases, ...]) -> None:
    """The order in which a robot hears the others does not matter."""
    a, b, c = team(bought, ledger=ledger)
    forth = knowledge(join(replica(0, 3, ledger=ledger), b, c))
    back = knowledge(join(replica(0, 3, ledger=ledger), c, b))

    assert forth == back
    assert vector(join(a, b)) == vector(join(b, a))


@MODES
@examples(60)
@given(bought=TEAM_PURCHASES)
def test_merge_is_associative(*, ledger: bool, bought: tuple[Purchases, ...]) -> None:
    """Hearing B, then C, is hearing B who has heard C: news may travel over others."""
    a, b, c = team(bought, ledger=ledger)
    direct = knowledge(join(a, b, c))
    a, b, c = team(bought, ledger=ledger)

    assert knowledge(join(a, join(b, c))) == direct


@MODES
@examples(60)
@given(bought=TEAM_PURCHASES)
def test_merge_never_raises_a_weight(*, ledger: bool, bought: tuple[Purchases, ...]) -> None:
    """Weights only ever fall, and come to the truth when all is heard."""
    a, b, c = team(bought, ledger=ledger)
    expected = truth([a, b, c])
    seen = [vector(a), vector(join(a, b)), vector(join(a, c))]

    assert all(
        x >= y for before, after in pairwise(seen) for x, y in zip(before, after, strict=True)
    )
    assert seen[-1] == expected


@examples(60)
@given(bought=TEAM_PURCHASES)
def test_both_rules_agree_when_no_sample_was_bought_twice(bought: tuple[Purchases, ...]) -> None:
    """Disjoint spending leaves the ledger nothing to correct in the minimum (papers, 2.6)."""
    apart = [
        [(sample, units) for sample, units in purchases if sample % 3 == i]
        for i, purchases in enumerate(bought)
    ]
    results = []
    for ledger in (True, False):
        a, b, c = team(apart, ledger=ledger)
        results.append(vector(join(a, b, c)))

    assert results[0] == results[1]


@pytest.mark.parametrize(("ledger", "left"), [(True, 0), (False, 2)])
def test_spending_of_two_on_one_sample(*, ledger: bool, left: int) -> None:
    """The ledger counts both; the minimum, as printed (eq. 8-10), counts one."""
    a, b = team([[(3, 2)], [(3, 2)]], ledger=ledger)

    assert vector(join(a, b)) == [4, 4, 4, left, 4, 4]


def test_overspent_sample_stops_at_zero() -> None:
    """Credit beyond what a sample holds is not owed to anybody."""
    a, b = team([[(3, 3)], [(3, 3)]], ledger=True)

    assert vector(join(a, b)) == [4, 4, 4, 0, 4, 4]


@MODES
def test_largest_units_are_exact(*, ledger: bool) -> None:
    """The most points that a scenario may have: no weight overflows."""
    units = Units.of(1_999_999_999, N)
    writer, held = (replica(me, 2, ledger=ledger, units=units) for me in range(2))
    value = units.point if ledger else units.sample - 1
    entries = [(0, value), (0, value)]

    assert vector(writer) == [units.sample] * N
    assert held.merge(0, version_vector(2), suffix(0, 0, entries), b"")
    assert vector(held)[0] == units.sample - (2 * units.point if ledger else 1)


def test_acknowledgement_beyond_any_log_is_taken_for_all_of_it() -> None:
    """A sender that claims to hold more than can be gets nothing, and harms none."""
    held = replica(0, 2, ledger=True)
    buy(held, [(3, 1)])
    boast = b"".join(leb128(number) for number in (1 << 62, 1 << 31, (1 << 31) - 1, 0))

    assert held.merge(1, boast, b"", b"")
    assert held.store.known[1].tolist() == [KNOWN_MAX, KNOWN_MAX, KNOWN_MAX, 0]
    assert held.compose()[1] == b""


# Suffixes.


@MODES
def test_suffix_that_leaves_a_gap_waits(*, ledger: bool) -> None:
    """A log is held as a prefix: what lies beyond a gap is not acknowledged."""
    held = replica(0, 2, ledger=ledger)
    message = (version_vector(2), suffix(1, 2, [(0, 1)]), b"")

    assert held.merge(1, *message)
    assert int(held.store.length[1]) == 0
    assert vector(held) == ([4] * N if ledger else [1, 4, 4, 4, 4, 4])


def test_suffix_that_overlaps_adds_what_is_new() -> None:
    """Entries that are held already are skipped."""
    held = replica(0, 2, ledger=True)
    held.merge(1, version_vector(2), suffix(1, 0, [(0, 1), (1, 2)]), b"")
    held.merge(1, version_vector(2), suffix(1, 1, [(1, 2), (2, 3)]), b"")

    assert replicas.entries(held, 1) == [(0, 1), (1, 2), (2, 3)]
    assert vector(held) == [3, 2, 1, 4, 4, 4]


def test_no_other_participant_writes_a_log() -> None:
    """Single writer: a suffix of the robot's own log changes nothing, whoever sends it."""
    held = replica(0, 2, ledger=True)
    buy(held, [(0, 1)])
    before = knowledge(held)

    assert held.merge(1, version_vector(2), suffix(0, 0, [(0, 1), (1, 3)]), b"")
    assert knowledge(held) == before


def test_minimum_is_not_forwarded_for_others() -> None:
    """min: a suffix comes from its origin alone, whose log holds what it learned as well."""
    held = replica(0, 3, ledger=False)

    assert not held.merge(1, version_vector(3), suffix(2, 0, [(0, 1)]), b"")
    assert vector(held) == [4] * N


@MODES
def test_message_to_one_participant_needs_no_answer_first(*, ledger: bool) -> None:
    """A robot that reports to the supervisor sends new entries before it has ever heard it."""
    robot, supervisor = (replica(i, 2, ledger=ledger, relay=i == 1) for i in range(2))
    buy(robot, [(0, 1), (1, 2)])
    supervisor.merge(0, *robot.compose(1))

    assert vector(supervisor) == [3, 2, 4, 4, 4, 4]


@MODES
@pytest.mark.parametrize(("beacon", "informed"), [(True, True), (False, False)])
def test_beacon_of_state_informs_with_one_message(
    *, ledger: bool, beacon: bool, informed: bool
) -> None:
    """Beacon `state`: a robot that comes into range knows at once (Algorithm 3, line 5); with versions
    it takes an answer.
    """
    lonely, passing = (replica(i, 2, ledger=ledger, beacon=beacon) for i in range(2))
    for _ in range(20):
        buy(lonely, [(0, 1)])
        buy(lonely, [(1, 1)])
        lonely.compose()
        lonely.end_step()
    passing.merge(0, *lonely.compose())

    assert (vector(passing) == vector(lonely)) == informed
    assert vector(lonely) == [0, 0, 4, 4, 4, 4]


@pytest.mark.parametrize(("relay", "waits"), [(True, 0), (False, 2)])
def test_relay_forwards_at_once_and_a_robot_after_its_timeout(*, relay: bool, waits: int) -> None:
    """A robot's neighbours most likely heard the news themselves; a supervisor's never do."""
    middle = replica(1, 3, ledger=True, relay=relay, timeout_steps=2)
    author, reader = replica(0, 3, ledger=True), replica(2, 3, ledger=True)
    middle.merge(2, *reader.compose())
    middle.merge(0, *author.compose())
    for _ in range(5):
        middle.compose()
        middle.end_step()
        middle.merge(2, *reader.compose())
    buy(author, [(0, 3)])
    middle.merge(0, version_vector(3), suffix(0, 0, replicas.entries(author, 0)), b"")
    steps = 0
    while vector(reader) == [4] * N:
        reader.merge(1, *middle.compose())
        middle.end_step()
        steps += 1

    assert steps - 1 == waits


def test_what_is_acknowledged_is_not_sent_again() -> None:
    """The version vector is the acknowledgement: a quiet team sends versions only."""
    made = team([[(0, 1)], [(1, 1)], [(2, 1)]], ledger=True)
    air = Air(made)
    for _ in range(12):
        air.round()

    assert [held.compose()[1] for held in made] == [b""] * 3


@MODES
@examples(40)
@given(
    bought=st.tuples(PURCHASES, PURCHASES, PURCHASES, PURCHASES), timeout_steps=st.integers(1, 4)
)
def test_news_travels_along_a_chain(
    *, ledger: bool, bought: tuple[Purchases, ...], timeout_steps: int
) -> None:
    """Four robots in a row, only neighbours hear each other: all come to the same truth, in
    a few rounds a hop.
    """
    made = [replica(i, 4, ledger=ledger, timeout_steps=timeout_steps) for i in range(4)]
    for held, purchases in zip(made, bought, strict=True):
        buy(held, purchases)

    Air(made, lambda i, j: abs(i - j) == 1).rounds_until(truth(made), 6 * (timeout_steps + 2))


@MODES
@examples(40)
@given(
    bought=TEAM_PURCHASES,
    later=TEAM_PURCHASES,
    silence=st.integers(0, 40),
    timeout_steps=st.integers(1, 4),
)
def test_team_that_was_apart_agrees_when_it_meets(
    *,
    ledger: bool,
    bought: tuple[Purchases, ...],
    later: tuple[Purchases, ...],
    silence: int,
    timeout_steps: int,
) -> None:
    """However long no robot heard another, one encounter of a few rounds is enough."""
    made = [replica(i, 3, ledger=ledger, timeout_steps=timeout_steps) for i in range(3)]
    apart = Air(made, lambda _i, _j: False)
    for i, held in enumerate(made):
        buy(held, bought[i])
    for _ in range(silence):
        apart.round()
    for i, held in enumerate(made):
        buy(held, later[i])

    Air(made).rounds_until(truth(made), 2 * timeout_steps + 4)


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
    assert vector(writer) == agreed
    assert Air(made).rounds_until(agreed, 30) > 3
    assert max(len(logs) for _, logs, _ in [writer.compose()]) < 20 * 4096


def test_log_outgrows_its_first_room() -> None:
    """Entries are kept in order however many there are."""
    units = Units.of(1000 * N, N)
    writer = replica(0, 2, ledger=True, units=units)
    reader = replica(1, 2, ledger=True, units=units)
    bought = [(i % N, 1) for i in range(3000)]
    buy(writer, bought)
    reader.merge(0, *whole(writer))

    assert replicas.entries(writer, 0) == replicas.entries(reader, 0) == bought
    assert vector(writer) == vector(reader) == [500] * N


@MODES
def test_what_fell_in_a_step_is_told_once(*, ledger: bool) -> None:
    """`lowered` names each sample once, whether it fell by spending or by news, until the step ends."""
    a, b = team([[(0, 1), (0, 1), (2, 1)], [(2, 2), (5, 1)]], ledger=ledger)
    join(a, b)
    fallen = sorted(a.lowered().tolist())
    a.end_step()

    assert fallen == [0, 2, 5]
    assert a.lowered().tolist() == []
    buy(a, [(0, 1)])
    assert a.lowered().tolist() == [0]


# Messages that are not sound.


def meeting(*, ledger: bool, claims: bool) -> tuple[Replica, Message]:
    """A replica with a past, and a sound message for it from participant 1."""
    a, b = (replica(i, 3, ledger=ledger, claims=claims) for i in range(2))
    buy(a, [(0, 1), (3, 2)])
    buy(b, [(3, 1), (4, 2), (5, 3)])
    b.claim(5, 100)
    a.claim(2, 90)
    b.merge(0, *a.compose())
    a.merge(1, *b.compose())
    buy(b, [(0, 2), (1, 3)])
    b.end_step()
    b.claim(1, 200)
    return a, b.compose()


@pytest.mark.parametrize("claims", [True, False])
@MODES
@examples(150)
@given(data=st.data())
def test_malformed_message_changes_nothing_at_all(
    *, ledger: bool, claims: bool, data: st.DataObject
) -> None:
    """A message is checked whole before any of it is applied; any bytes are survived."""
    held, sound = meeting(ledger=ledger, claims=claims)
    parts = [data.draw(st.just(part) | st.binary(max_size=40)) for part in sound]
    before, weights = snapshot(held), vector(held)
    taken = held.merge(1, *parts)

    if not taken:
        assert snapshot(held) == before
    assert all(new <= old for new, old in zip(vector(held), weights, strict=True))
    held.compose()
    held.end_step()


@pytest.mark.parametrize("claims", [True, False])
@MODES
@examples(150)
@given(part=st.integers(0, 2), at=st.integers(0, 100), byte=st.integers(0, 255))
def test_damaged_message_is_taken_whole_or_not_at_all(
    *, ledger: bool, claims: bool, part: int, at: int, byte: int
) -> None:
    """One byte changed: if the message is refused, no other part of it was applied."""
    held, sound = meeting(ledger=ledger, claims=claims)
    parts = [bytearray(content) for content in sound]
    if parts[part]:
        parts[part][at % len(parts[part])] = byte
    before = snapshot(held)
    if not held.merge(1, *map(bytes, parts)):
        assert snapshot(held) == before


@pytest.mark.parametrize("part", [0, 1, 2])
@MODES
def test_cut_message_changes_nothing_at_all(*, ledger: bool, part: int) -> None:
    """The last byte of any part is missing: the whole message is refused."""
    held, sound = meeting(ledger=ledger, claims=True)
    parts = [content[:-1] if i == part else content for i, content in enumerate(sound)]
    before = snapshot(held)

    assert not held.merge(1, *parts)
    assert snapshot(held) == before
    assert held.merge(1, *sound)


MALFORMED_LOGS = {
    "origin-outside-the-roster": suffix(3, 0, [(0, 1)]),
    "sample-outside": suffix(1, 0, [(N, 1)]),
    "sample-below-0": suffix(1, 0, [(-1, 1)]),
    "more-units-than-can-be": suffix(1, 0, [(0, UNITS.sample + 1)]),
    "fewer-entries-than-counted": suffix(1, 0, [(0, 1), (1, 1)])[:-2],
    "more-entries-than-the-span": suffix(1, 0, [(0, 1), (1, 1)], span=1),
    "log-of-impossible-length": suffix(1, 1 << 41, [(0, 1)]),
    "second-suffix-cut": suffix(1, 0, [(0, 1)]) + b"\x01",
}


@pytest.mark.parametrize("name", MALFORMED_LOGS)
@MODES
def test_malformed_suffix_is_refused(*, ledger: bool, name: str) -> None:
    """Every number in a suffix is checked against what can be."""
    held = replica(0, 3, ledger=ledger)
    before = snapshot(held)

    assert not held.merge(1, version_vector(3), MALFORMED_LOGS[name], b"")
    assert snapshot(held) == before


def test_ledger_entry_is_at_most_a_point() -> None:
    """No robot ships more than a point to one sample at once."""
    held = replica(0, 2, ledger=True)

    assert not held.merge(1, version_vector(2), suffix(1, 0, [(0, UNITS.point + 1)]), b"")
    assert held.merge(1, version_vector(2), suffix(1, 0, [(0, UNITS.point)]), b"")


@pytest.mark.parametrize(
    "content", [claim(3, 1, 0, 0), claim(1, 1, N, 0), claim(1, 1, 0, 5)[:-1], b"\xff" * 9]
)
def test_malformed_claim_is_refused(content: bytes) -> None:
    """An origin outside the roster, a sample that does not exist, a cut register."""
    held = replica(0, 3, ledger=True)
    before = snapshot(held)

    assert not held.merge(1, version_vector(3), suffix(1, 0, [(0, 1)]), content)
    assert snapshot(held) == before


@pytest.mark.parametrize("content", [b"", bytes(5), bytes(7), b"\x80" * 6])
def test_version_vector_of_another_length_is_refused(content: bytes) -> None:
    """One number for each log and, with claims, one for each register."""
    held = replica(0, 3, ledger=True)

    assert not held.merge(1, content, b"", b"")
    assert held.merge(1, version_vector(3), b"", b"")


@MODES
def test_malformed_message_takes_no_room(*, ledger: bool) -> None:
    """A long refused message leaves no more behind than a short one."""
    held = replica(0, 3, ledger=ledger)
    before = snapshot(held)

    assert not held.merge(1, version_vector(3), b"\xff" * 20_000, b"")
    assert snapshot(held) == before


# Claims.


def rivals(first_ns: int, second_ns: int) -> tuple[list[int], list[int]]:
    """What two robots must leave when each has claimed sample 3 and has heard the other."""
    a, b = (replica(i, 2, ledger=True) for i in range(2))
    a.claim(3, first_ns)
    b.claim(3, second_ns)
    words = a.compose(), b.compose()
    a.merge(1, *words[1])
    b.merge(0, *words[0])
    return replicas.claimed_by_others(a), replicas.claimed_by_others(b)


def test_of_equal_claims_the_lower_id_keeps_the_sample() -> None:
    """Two robots that choose the same sample at the same time: one of them leaves it."""
    assert rivals(100, 100) == ([], [3])


@pytest.mark.parametrize(("first_ns", "left"), [(100, ([], [3])), (300, ([3], []))])
def test_incumbent_keeps_its_sample(first_ns: int, left: tuple[list[int], list[int]]) -> None:
    """Who claimed earlier keeps it, whatever its id; renewing does not make a claim younger."""
    assert rivals(first_ns, 200) == left


def test_renewal_keeps_the_first_time() -> None:
    """A claim is dated by when the robot first headed there without a break."""
    a = replica(0, 2, ledger=True)
    since_ns = []
    for sample, now_ns in ((3, 100), (3, 200), (4, 300), (3, 400), (NO_INDEX, 500)):
        a.claim(sample, now_ns)
        since_ns.append(int(a.store.claims[1, 0]))
        a.end_step()

    assert since_ns == [100, 100, 300, 400, 500]


def test_claimed_sample_is_left_by_who_has_none() -> None:
    """A robot that is not there yet leaves it; when it is given up it is free again."""
    a, b = (replica(i, 2, ledger=True) for i in range(2))
    b.claim(3, 100)
    a.merge(1, *b.compose())
    b.end_step()
    b.claim(NO_INDEX, 200)
    left = replicas.claimed_by_others(a)
    a.merge(1, *b.compose())

    assert (left, replicas.claimed_by_others(a)) == ([3], [])


def test_older_word_on_a_claim_changes_nothing() -> None:
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
    """Claims are forwarded like logs: the far end of a chain learns what is taken."""
    made = [replica(i, 3, ledger=True) for i in range(3)]
    air = Air(made, lambda i, j: abs(i - j) == 1)
    for step in range(12):
        made[0].claim(3, 100)
        made[1].claim(1, 100)
        made[2].claim(2, 100 + step)
        air.round()

    assert sorted(replicas.claimed_by_others(made[2])) == [1, 3]


def test_without_claims_nothing_is_taken() -> None:
    """Without claims: the paper's robots do not tell where they head."""
    a, b = (replica(i, 2, ledger=True, claims=False) for i in range(2))
    b.claim(3, 100)
    a.merge(1, *b.compose())

    assert replicas.claimed_by_others(a) == []
    assert b.compose()[2] == b""


# The format.


@MODES
def test_compact_words_are_what_the_protocol_says(*, ledger: bool) -> None:
    """have, logs and claims, byte by byte; the minimum leaves out entries that a newer one covers."""
    held = replica(0, 2, ledger=ledger, beacon=True)
    buy(held, [(3, 1), (5, 2), (3, 1)])
    held.claim(2, 300)
    entries = [(3, 1), (5, 2), (3, 1)] if ledger else [(5, 2), (3, 2)]

    assert held.compose() == (
        bytes([3, 0, 1, 0]),
        suffix(0, 0, entries, span=3),
        claim(0, 1, 2, 300),
    )


@examples(40)
@given(bought=TEAM_PURCHASES)
def test_held_spending_is_the_sum_of_the_logs(bought: tuple[Purchases, ...]) -> None:
    """ledger: `weights` are what the held entries add up to, to the unit."""
    a, b, c = team(bought, ledger=True)
    join(a, b, c)
    total = np.zeros(N, dtype=np.int64)
    for origin in range(3):
        for sample, units in replicas.entries(a, origin):
            total[sample] += units

    assert vector(a) == np.maximum(0, UNITS.sample - total).tolist()
