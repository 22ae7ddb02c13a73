"""Link faults: the effect of each on the radio's decisions, of several together, and whole missions under them."""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Envelope, ParticipantId, Pose
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.faults.links import (
    FORGED_SEQUENCE_MIN,
    Bandwidth,
    Burst,
    Clog,
    Delay,
    Drop,
    Duplicate,
    Hostile,
    OneWay,
    Partition,
    Range,
    Reorder,
    Replay,
)
from kantor_protocol.scenario.faults.schedule import AnyFault, kind_of
from kantor_protocol.scenario.load import from_tree
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.checkers.checker import check
from kantor_worldsim.observers.metrics.result import FaultCounts, Result
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import metrics_of
from kantor_worldsim.radio.channel import DROPPED, Channel, DeliveryDecision, Sent
from kantor_worldsim.radio.fault_kernels import in_burst
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.record.journal import Journal
from kantor_worldsim.record.records import Batch, Ending, Opening, Record
from kantor_worldsim.world.maps import Ground
from support.grounds import drawn, exploration
from support.missions import explored
from support.plain_faults import PASS, Fate, PlainFaults
from support.strategies import SEEDS, examples, mission

Play = Callable[..., tuple[Record, ...]]

MS = 1_000_000
S = 1_000 * MS


# A radio with faults.


class FaultyRadio:
    """A channel under faults, with all participants in one place but for those in `at`."""

    def __init__(
        self,
        *faults: AnyFault,
        scenario: Scenario | None = None,
        seed: int = 1,
        at: dict[ParticipantId, tuple[float, float]] | None = None,
        ground: Ground | None = None,
    ) -> None:
        self.scenario = msgspec.structs.replace(scenario or mission(), faults=faults)
        self.faults = LinkFaults(self.scenario, seed)
        self.channel = Channel(self.scenario, seed, ground, self.faults.rule)
        for name in self.scenario.roster:
            self.channel.place(name, Pose(*(at or {}).get(name, (0.0, 0.0))))

    def transmit(self, *sent: Sent) -> list[DeliveryDecision]:
        """Decisions on envelopes."""
        return self.channel.transmit(sent)[0]

    @property
    def fault_stats(self) -> dict[int, dict[str, int]]:
        """Effects of each fault, without counters that are zero."""
        return {
            stats.fault: {
                k: n for k, n in msgspec.structs.asdict(stats).items() if n and k != "fault"
            }
            for stats in self.faults.pop_stats()
        }


def sent_by(
    source: ParticipantId,
    sequence: int,
    now_ns: int = 0,
    target: ParticipantId = EVERYBODY,
    size: int = 0,
) -> Sent:
    """An envelope on the radio."""
    return Sent(now_ns, Envelope(source, sequence, target, bytes(size)))


def broadcasts(count: int, roster: Sequence[str] = ("r1", "r2", "r3"), size: int = 0) -> list[Sent]:
    """`count` broadcasts of each participant, 100 ms apart."""
    return [
        sent_by(name, sequence, 100 * MS * sequence, size=size)
        for sequence in range(1, count + 1)
        for name in roster
    ]


def dues(decisions: Sequence[DeliveryDecision]) -> list[int]:
    return [decision.due_ns for decision in decisions]


def reached(decisions: Sequence[DeliveryDecision]) -> set[str]:
    """Links over which a copy passed, as source>target."""
    return {f"{v.source}>{v.target}" for v in decisions if v.due_ns != DROPPED}


ALL = {f"{one}>{other}" for one, other in itertools.permutations(("r1", "r2", "r3"), 2)}


def within_five_sigma(hits: int, trials: int, rate: float) -> bool:
    """Whether a count is within five standard deviations of a binomial one."""
    return abs(hits - trials * rate) <= 5.0 * math.sqrt(trials * rate * (1.0 - rate)) + 0.5


# Windows and names.


@pytest.mark.parametrize(
    ("now_ns", "lost"), [(0, False), (S - 1, False), (S, True), (2 * S - 1, True), (2 * S, False)]
)
def test_a_window_includes_its_beginning_and_excludes_its_end(*, now_ns: int, lost: bool) -> None:
    radio = FaultyRadio(Drop(probability=1.0, from_s=1.0, until_s=2.0))

    assert dues(radio.transmit(sent_by("r1", 1, now_ns))) == 2 * [DROPPED if lost else now_ns]


def test_named_robots_have_their_links_affected_in_both_directions() -> None:
    radio = FaultyRadio(Drop(probability=1.0, robots=("r2",)))

    assert reached(radio.transmit(*broadcasts(1))) == {"r1>r3", "r3>r1"}
    assert radio.fault_stats == {0: {"dropped": 4}}
    assert radio.fault_stats == {}


# Loss.


@pytest.mark.parametrize("probability", [0.05, 0.5, 0.95])
def test_copies_drop_at_their_rate(probability: float) -> None:
    decisions = FaultyRadio(Drop(probability=probability)).transmit(*broadcasts(500))

    assert within_five_sigma(dues(decisions).count(DROPPED), 3000, probability)


def test_faults_have_independent_draws() -> None:
    """Two of the same kind, together with the radio, lose more than one."""
    decisions = FaultyRadio(
        *2 * [Drop(probability=0.5)], scenario=mission("radio.drop=0.5")
    ).transmit(*broadcasts(500))

    assert within_five_sigma(dues(decisions).count(DROPPED), 3000, 7 / 8)


@examples(40)
@given(seed=SEEDS, shape=st.sampled_from([(0.1, 0.1), (0.02, 0.1), (0.1, 0.01), (0.5, 0.5)]))
def test_bursts_are_a_markov_chain_of_two_states(seed: int, shape: tuple[float, float]) -> None:
    """The state in any slot is that of a chain that is followed from the start."""
    to_bad, to_good = shape
    bad = False
    for slot in range(300):
        draw = uniform(seed, Purpose.FAULT_BURST, 7, slot, 3)
        if slot:
            bad = draw < 1.0 - to_good if bad else draw < to_bad
        assert in_burst(seed, 7, 3, slot, to_bad, to_good) == bad


def test_bursts_have_their_mean_length() -> None:
    """A link is bad for half a second after two good ones, on average."""
    radio = FaultyRadio(Burst(good_s=2.0, bad_s=0.5))
    lost = [
        radio.transmit(sent_by("r1", i, i * 50 * MS, "r2"))[0].due_ns == DROPPED
        for i in range(1, 40_001)
    ]
    spells = [len(list(run)) for bad, run in itertools.groupby(lost) if bad]

    assert sum(lost) / len(lost) == pytest.approx(0.2, abs=0.02)
    assert sum(spells) / len(spells) * 0.05 == pytest.approx(0.5, abs=0.05)


def test_each_direction_has_bursts_of_its_own() -> None:
    radio = FaultyRadio(Burst(good_s=1.0, bad_s=1.0, drop_good=0.1, drop_bad=0.9))
    fates = [tuple(due == DROPPED for due in dues(radio.transmit(*each))) for each in _rounds(400)]
    there, back = zip(*fates, strict=True)

    assert within_five_sigma(sum(there), 400, 0.5) or 100 < sum(there) < 300
    assert there != back


def _rounds(count: int) -> list[tuple[Sent, Sent]]:
    return [
        (sent_by("r1", i, i * 100 * MS, "r2"), sent_by("r2", i, i * 100 * MS, "r1"))
        for i in range(1, count + 1)
    ]


# Time.


def test_delays_add_up() -> None:
    """Delays of faults, and the radio's."""
    radio = FaultyRadio(
        Delay(delay_s=0.5), Delay(delay_s=0.25), scenario=mission("radio.delay_s=0.125")
    )

    assert dues(radio.transmit(sent_by("r1", 1, S))) == 2 * [S + 875 * MS]
    assert radio.fault_stats == {0: {"delayed": 2}, 1: {"delayed": 2}}


def test_jitter_is_within_its_bounds_and_spreads() -> None:
    decisions = FaultyRadio(Delay(delay_s=0.5, jitter_s=0.2)).transmit(
        *[sent_by("r1", i) for i in range(1, 400)]
    )

    assert all(500 * MS <= due < 700 * MS for due in dues(decisions))
    assert max(dues(decisions)) - min(dues(decisions)) > 190 * MS
    assert len(set(dues(decisions))) > 700


def test_some_messages_are_held_back_so_that_others_overtake() -> None:
    radio = FaultyRadio(Reorder(probability=0.25, hold_s=1.0))
    decisions = radio.transmit(*[sent_by("r1", i, i * MS, "r2") for i in range(1, 1001)])
    held = [v.due_ns - v.sequence * MS for v in decisions if v.due_ns > v.sequence * MS]

    assert within_five_sigma(len(held), 1000, 0.25)
    assert 0 < min(held) < 100 * MS < 900 * MS < max(held) < S
    assert dues(decisions) != sorted(dues(decisions))


def test_a_clog_delivers_in_order_when_it_ends() -> None:
    radio = FaultyRadio(Clog(from_s=1.0, until_s=2.0), Delay(delay_s=0.3, jitter_s=0.2))
    radio.transmit(*[sent_by(name, i, i * 100 * MS) for i in range(1, 25) for name in ("r1", "r2")])
    before = radio.channel.collect("r3", 2 * S - 1)
    burst = radio.channel.collect("r3", 2 * S)

    assert {envelope.sequence for envelope in before} == set(range(1, 10))
    held = [(e.source, e.sequence) for e in burst if 10 <= e.sequence < 15]
    assert held == [(name, i) for name in ("r1", "r2") for i in range(10, 15)]


def test_messages_beyond_the_bandwidth_wait() -> None:
    """Each sender has a queue; a message takes its time on the radio, for any number of receivers."""
    radio = FaultyRadio(Bandwidth(bytes_per_s=1000.0))
    first, second, third = (radio.transmit(sent_by("r1", i, 0, size=500)) for i in (1, 2, 3))
    other = radio.transmit(sent_by("r2", 1, 0, size=100))
    later = radio.transmit(sent_by("r1", 4, 2 * S, size=500))

    assert dues(first) == 2 * [500 * MS]
    assert dues(second) == 2 * [1000 * MS]
    assert dues(third) == 2 * [1500 * MS]
    assert dues(other) == 2 * [100 * MS]
    assert dues(later) == 2 * [2500 * MS]


@pytest.mark.parametrize(
    ("queue_bytes", "arriving"), [(0, 1), (499, 1), (500, 2), (1000, 3), (None, 4)]
)
def test_a_full_queue_drops(queue_bytes: int | None, arriving: int) -> None:
    radio = FaultyRadio(Bandwidth(bytes_per_s=1000.0, queue_bytes=queue_bytes))
    decisions = radio.transmit(*[sent_by("r1", i, 0, "r2", size=500) for i in (1, 2, 3, 4)])

    assert dues(decisions) == [500 * i * MS if i <= arriving else DROPPED for i in range(1, 5)]


def test_bandwidth_limits_the_named_senders() -> None:
    radio = FaultyRadio(Bandwidth(bytes_per_s=10.0, robots=("r2",)))

    assert dues(radio.transmit(sent_by("r1", 1, size=10), sent_by("r2", 1, size=10))) == [
        0,
        0,
        S,
        S,
    ]


def test_a_copy_that_never_arrives_can_be_recorded() -> None:
    """A queue of centuries: the time of arrival stays a number that records hold."""
    radio = FaultyRadio(Bandwidth(bytes_per_s=1e-3), *20 * [Delay(delay_s=1e6)])
    decisions = [radio.transmit(sent_by("r1", i, size=10**6))[0] for i in range(1, 30)]

    assert all(0 < due < 2**63 for due in dues(decisions))


# Copies.


def test_copies_are_doubled_and_lost_independently() -> None:
    radio = FaultyRadio(Duplicate(probability=1.0, copies=3, delay_s=0.5), Drop(probability=0.5))
    decisions = radio.transmit(*broadcasts(100))

    assert len(decisions) == 4 * 600
    assert within_five_sigma(dues(decisions).count(DROPPED), 2400, 0.5)
    assert radio.fault_stats[0] == {"doubled": 1800}
    late = [v.due_ns - v.sequence * 100 * MS for v in decisions if v.due_ns != DROPPED]
    assert min(late) == 0
    assert 0 < max(late) < 500 * MS
    assert len(set(late)) > 700


@pytest.mark.parametrize("probability", [0.1, 0.9])
def test_doubling_comes_at_its_rate(probability: float) -> None:
    decisions = FaultyRadio(Duplicate(probability=probability)).transmit(*broadcasts(200))

    assert within_five_sigma(len(decisions) - 1200, 1200, probability)


def test_a_copy_that_the_radio_has_lost_is_not_doubled() -> None:
    faults = (Duplicate(probability=1.0), Replay(probability=1.0, age_s=9.0))
    decisions = FaultyRadio(*faults, scenario=mission("radio.drop=0.5")).transmit(*broadcasts(100))
    fates: dict[tuple[str, int, str], list[int]] = {}
    for decision in FaultyRadio(faults[0], scenario=mission("radio.drop=0.5")).transmit(
        *broadcasts(100)
    ):
        fates.setdefault((decision.source, decision.sequence, decision.target), []).append(
            decision.due_ns
        )

    assert {tuple(due == DROPPED for due in each) for each in fates.values()} == {
        (True,),
        (False, False),
    }
    assert len(decisions) > sum(map(len, fates.values()))


def test_an_older_message_of_the_same_sender_is_replayed() -> None:
    """To the same receivers, together with a new one, and no older than its greatest age."""
    radio = FaultyRadio(Replay(probability=1.0, age_s=1.0))
    replays = []
    for i in range(1, 101):
        now_ns = i * 100 * MS
        decisions = radio.transmit(sent_by("r1", i, now_ns), sent_by("r2", 1000 + i, now_ns, "r3"))
        replays += [(i, v) for v in decisions if v.sequence % 1000 != i]
        assert {v.due_ns for v in decisions} == {now_ns}

    ages = Counter(i - v.sequence % 1000 for i, v in replays)
    assert len(replays) > 280
    assert set(ages) == set(range(1, 11))
    assert {v.target for _, v in replays if v.source == "r2"} == {"r3"}
    assert {v.target for _, v in replays if v.source == "r1"} == {"r2", "r3"}


def test_only_sent_messages_are_replayed() -> None:
    radio = FaultyRadio(Replay(probability=1.0, age_s=1.0))

    assert len(radio.transmit(sent_by("r1", 1), sent_by("r1", 2))) == 4


def test_a_dropped_message_may_still_be_replayed() -> None:
    """Its draw is neither that of the first time nor that of the message with which it arrives."""
    radio = FaultyRadio(Drop(probability=0.5), Replay(probability=1.0, age_s=0.1))
    own, again, alone = set(), set(), 0
    for i in range(1, 400):
        arrived = [
            v.sequence
            for v in radio.transmit(sent_by("r1", i, i * 100 * MS, "r2"))
            if v.due_ns != DROPPED
        ]
        own |= {i} & set(arrived)
        again |= set(arrived) - {i}
        alone += bool(arrived) and i not in arrived

    assert 50 < len(again - own) < 150
    assert 50 < alone < 150


# Cuts.


@pytest.mark.parametrize(
    ("fault", "links"),
    [
        (Partition(shape="halves"), {"r1>r2", "r2>r1"}),
        (Partition(shape="isolate", robots=("r2",)), {"r1>r3", "r3>r1"}),
        (Partition(shape="groups", groups=(("r1",), ("r2",))), set()),
        (OneWay(senders=("r1",)), ALL - {"r1>r2", "r1>r3"}),
        (OneWay(senders=("r1",), receivers=("r2",)), ALL - {"r1>r2"}),
    ],
)
def test_nothing_passes_a_cut(fault: AnyFault, links: set[str]) -> None:
    radio = FaultyRadio(fault)

    assert reached(radio.transmit(*broadcasts(3))) == links
    assert {f"{a}>{b}" for a, b in itertools.permutations(("r1", "r2", "r3"), 2) if not
            radio.faults.cuts(0, a, b)} == links  # fmt: skip


def test_a_cut_holds_at_the_time_of_sending() -> None:
    """Copies in flight arrive."""
    radio = FaultyRadio(
        Partition(shape="halves", from_s=1.0, until_s=2.0), scenario=mission("radio.delay_s=0.5")
    )
    decisions = radio.transmit(*[sent_by("r1", i, i * 100 * MS, "r3") for i in range(1, 31)])

    assert [v.sequence for v in decisions if v.due_ns == DROPPED] == list(range(10, 20))


def test_a_flapping_cut_opens_and_closes_in_slots() -> None:
    """For all links at once, with the given share."""
    radio = FaultyRadio(Partition(shape="halves", flap_s=0.5, flap_share=0.25))
    cut = [
        (radio.faults.cuts(i * 100 * MS, "r1", "r3"), radio.faults.cuts(i * 100 * MS, "r3", "r2"))
        for i in range(5000)
    ]
    slots = [set(cut[i : i + 5]) for i in range(0, 5000, 5)]

    assert all(there == back for there, back in cut)
    assert all(len(slot) == 1 for slot in slots)
    assert within_five_sigma(sum(slot == {(True, True)} for slot in slots), 1000, 0.25)


# Range.

PLACES = {"r2": (30.0, 0.0), "r3": (60.0, 0.0)}


@pytest.mark.parametrize(
    ("faults", "links"),
    [
        ((Range(factor=0.5),), {"r1>r2", "r2>r1", "r2>r3", "r3>r2"}),
        ((Range(range_m=30.0),), {"r1>r2", "r2>r1", "r2>r3", "r3>r2"}),
        ((Range(range_m=29.9),), set()),
        ((Range(factor=0.5), Range(range_m=10.0)), set()),
        ((Range(range_m=10.0, robots=("r1",)),), {"r2>r3", "r3>r2"}),
        ((Range(range_m=10.0, from_s=1.0),), ALL),
    ],
)
def test_range_shrinks_on_the_links_of_a_fault(faults: tuple[Range, ...], links: set[str]) -> None:
    """The least range counts, its bound included; receivers beyond it are counted as out of range."""
    radio = FaultyRadio(*faults, scenario=mission("radio.range_m=60"), at=PLACES)
    decisions, out_of_range = radio.channel.transmit(broadcasts(1)[:3])

    now_ns = 100 * MS
    assert reached(decisions) == links
    assert len(links) + out_of_range == 6
    for link in ALL:
        one, other = link.split(">")
        apart_m = math.dist(PLACES.get(one, (0.0, 0.0)), PLACES.get(other, (0.0, 0.0)))
        assert (apart_m <= radio.faults.reach_m(now_ns, one, other)) == (link in links)


def test_the_range_of_the_supervisor_shrinks_too() -> None:
    scenario = mission("coordination=centralized", "supervisor.range_m=100")
    radio = FaultyRadio(Range(factor=0.5), scenario=scenario, at=PLACES)

    assert {v.target for v in radio.transmit(sent_by(SUPERVISOR, 1))} == {"r1", "r2"}
    received = radio.transmit(*[sent_by(name, 1, 0, SUPERVISOR) for name in ("r1", "r2", "r3")])
    assert {v.source for v in received} == {"r1", "r2"}


def test_walls_shorten_the_range_that_faults_leave() -> None:
    """A wall of 2 m of range, 6 m apart: 8 m are enough and 7.9 m are not."""
    ground = drawn("..#....")
    scenario = exploration("robots.count=2", "radio.range_m=20", "radio.wall_loss_m=2")
    at = {"r1": (0.5, 0.5), "r2": (6.5, 0.5)}
    receivers = [
        len(
            FaultyRadio(Range(range_m=m), scenario=scenario, at=at, ground=ground).transmit(
                sent_by("r1", 1)
            )
        )
        for m in (8.0, 7.9)
    ]

    assert receivers == [1, 0]


# Together.

FATES = st.builds(Fate, st.booleans(), st.integers(0, 10**15), st.integers(0, 10**15))


@examples(100)
@given(FATES, FATES, FATES)
def test_the_order_of_decisions_does_not_matter_and_a_drop_wins(a: Fate, b: Fate, c: Fate) -> None:
    assert a.joined(b) == b.joined(a)
    assert a.joined(b).joined(c) == a.joined(b.joined(c))
    assert a.joined(PASS) == a
    assert (a.joined(b).due_ns(5) == DROPPED) == (a.dropped or b.dropped)


FIXED: st.SearchStrategy[AnyFault] = st.sampled_from(
    [
        Drop(probability=1.0, from_s=1.0, until_s=1.5, robots=("r1",)),
        Delay(delay_s=0.2, from_s=0.5),
        Delay(delay_s=0.1, until_s=2.0, robots=("r2",)),
        OneWay(senders=("r1",), receivers=("r2",), until_s=3.0),
        Partition(shape="halves", from_s=2.0, until_s=4.0),
        Clog(from_s=3.5, until_s=5.0),
        Clog(from_s=4.0, until_s=4.5, robots=("r3",)),
        Bandwidth(bytes_per_s=150.0),
        Bandwidth(bytes_per_s=100.0, queue_bytes=30, robots=("r2",)),
        Range(range_m=40.0, from_s=0.3),
        Range(factor=0.7, robots=("r3",)),
    ]
)


@examples(60)
@given(st.data())
def test_the_order_of_faults_without_draws_does_not_matter(data: st.DataObject) -> None:
    """Cuts, holds, fixed delays, queues and ranges, in any order of the list."""
    schedule = data.draw(st.lists(FIXED, min_size=2, max_size=5))
    shuffled = data.draw(st.permutations(schedule))
    one, other = (
        FaultyRadio(*faults, scenario=mission(*LOSSY), at=PLACES).transmit(*TALK)
        for faults in (schedule, shuffled)
    )

    assert one == other


NAMES = st.lists(st.sampled_from(["r1", "r2", "r3"]), unique=True, max_size=2).map(tuple)
WINDOWS = st.tuples(st.floats(0.0, 2.0), st.floats(0.001, 2.0)).map(
    lambda pair: {"from_s": pair[0], "until_s": sum(pair)}
)
SHARES = st.sampled_from([0.2, 0.5, 1.0])
SPANS = st.sampled_from([0.05, 0.3, 1.0])
PARTS: dict[type[AnyFault], dict[str, st.SearchStrategy[Any]]] = {
    Drop: {"probability": SHARES, "robots": NAMES},
    Burst: {"good_s": SPANS, "bad_s": SPANS, "robots": NAMES},
    Delay: {"delay_s": SPANS, "jitter_s": st.sampled_from([0.0, 0.5]), "robots": NAMES},
    Duplicate: {"probability": SHARES, "copies": st.integers(1, 8), "delay_s": SPANS},
    Replay: {"probability": SHARES, "age_s": SPANS},
    Reorder: {"probability": SHARES, "hold_s": SPANS, "robots": NAMES},
    OneWay: {"senders": st.just(("r1",)), "receivers": st.just(("r2", "r3"))},
    Partition: {
        "shape": st.sampled_from(["halves", "bridge"]),
        "flap_s": st.sampled_from([None, 0.5]),
    },
    Clog: {"robots": NAMES},
    Bandwidth: {
        "bytes_per_s": st.sampled_from([50.0, 1000.0]),
        "queue_bytes": st.sampled_from([None, 0, 50]),
        "robots": NAMES,
    },
    Range: {"range_m": st.sampled_from([5.0, 40.0]), "robots": NAMES},
    Hostile: {"probability": SHARES, "robots": NAMES},
}


def faults_of(kinds: Sequence[type[AnyFault]]) -> st.SearchStrategy[AnyFault]:
    """Faults of these kinds in windows of the first seconds."""
    return st.sampled_from(kinds).flatmap(
        lambda kind: WINDOWS.flatmap(
            lambda window: st.fixed_dictionaries(PARTS[kind]).map(
                lambda part: kind(**window, **part)
            )
        )
    )


FAULTS = faults_of(list(PARTS))
UNFORGED = faults_of([kind for kind in PARTS if kind is not Hostile])
SCHEDULES = st.lists(FAULTS, max_size=5).map(tuple)
LOSSY = ("radio.range_m=50", "radio.drop=0.2", "radio.duplicate=0.3", "radio.jitter_s=0.3")
TALK = broadcasts(60, size=20)


@examples(60)
@given(schedule=SCHEDULES, seed=SEEDS)
def test_windows_that_are_over_change_nothing(schedule: tuple[AnyFault, ...], seed: int) -> None:
    """Messages after the last of them have the decisions of a radio without faults."""
    over_ns = max((fault.until_ns or 0 for fault in schedule), default=0)
    scenario = mission(*LOSSY)
    plain = FaultyRadio(scenario=scenario, seed=seed, at=PLACES).transmit(*TALK)
    faulty = FaultyRadio(*schedule, scenario=scenario, seed=seed, at=PLACES)
    faulty.transmit(*[sent for sent in TALK if sent.now_ns < over_ns])
    after = [sent for sent in TALK if sent.now_ns >= over_ns]

    assert faulty.transmit(*after) == [v for v in plain if v.sequence * 100 * MS >= over_ns]


@examples(60)
@given(schedule=SCHEDULES, fault=FAULTS, seed=SEEDS)
def test_a_window_in_which_nothing_is_sent_changes_nothing(
    schedule: tuple[AnyFault, ...], fault: AnyFault, seed: int
) -> None:
    """Nor does a fault that never begins: appended to others, it leaves their draws as they were."""
    scenario = mission(*LOSSY)
    idle = msgspec.structs.replace(fault, from_s=0.0, until_s=0.05)
    later = msgspec.structs.replace(fault, from_s=1e5, until_s=1e6)
    plain = FaultyRadio(*schedule, scenario=scenario, seed=seed, at=PLACES).transmit(*TALK)

    assert (
        FaultyRadio(*schedule, idle, later, scenario=scenario, seed=seed, at=PLACES).transmit(*TALK)
        == plain
    )


@examples(60)
@given(schedule=SCHEDULES, seed=SEEDS)
def test_a_certain_drop_wins_over_all(schedule: tuple[AnyFault, ...], seed: int) -> None:
    radio = FaultyRadio(
        *schedule, Drop(probability=1.0), scenario=mission(*LOSSY), seed=seed, at=PLACES
    )

    assert set(dues(radio.transmit(*TALK))) <= {DROPPED}


@examples(60)
@given(schedule=SCHEDULES, fault=FAULTS, seed=SEEDS)
def test_one_fault_more_delivers_no_lost_copy(
    schedule: tuple[AnyFault, ...], fault: AnyFault, seed: int
) -> None:
    """A copy that was lost is still lost, and one that still arrives does so no sooner."""
    scenario = mission(*LOSSY)
    before = _arrivals(
        FaultyRadio(*schedule, scenario=scenario, seed=seed, at=PLACES).transmit(*TALK)
    )
    after = _arrivals(
        FaultyRadio(*schedule, fault, scenario=scenario, seed=seed, at=PLACES).transmit(*TALK)
    )

    if not isinstance(fault, Replay | Duplicate):
        assert set(after) <= set(before)
    for key in set(after) & set(before):
        assert isinstance(fault, Replay | Duplicate) or after[key] >= before[key]


def _arrivals(decisions: Sequence[DeliveryDecision]) -> dict[tuple[str, int, str], int]:
    """Time of arrival of the first copy of each sent message at each receiver."""
    arrivals: dict[tuple[str, int, str], int] = {}
    for source, sequence, target, due_ns in map(msgspec.structs.astuple, decisions):
        if due_ns != DROPPED and sequence < FORGED_SEQUENCE_MIN:
            key = source, sequence, target
            arrivals[key] = min(due_ns, arrivals.get(key, due_ns))
    return arrivals


@examples(100)
@given(
    schedule=st.lists(UNFORGED | FIXED, max_size=12).map(tuple),
    seed=SEEDS,
    overrides=st.sampled_from(
        [(), LOSSY, (*LOSSY, "coordination=centralized", "supervisor.range_m=55")]
    ),
    spots=st.lists(st.tuples(st.floats(0.0, 60.0), st.floats(0.0, 60.0)), min_size=3, max_size=3),
)
def test_compiled_rules_agree_with_the_reference(
    schedule: tuple[AnyFault, ...],
    seed: int,
    overrides: tuple[str, ...],
    spots: list[tuple[float, float]],
) -> None:
    """Decision by decision, and counter by counter."""
    at = dict(zip(("r1", "r2", "r3"), spots, strict=True))
    scenario = mission(*overrides)
    radio = FaultyRadio(*schedule, scenario=scenario, seed=seed, at=at)
    plain = PlainFaults(radio.scenario, seed)
    reference = Channel(radio.scenario, seed, None, plain.interfere)
    for name in scenario.roster:
        reference.place(name, Pose(*at.get(name, (0.0, 0.0))))
    for i in range(1, 45):
        now_ns = 100 * MS * i
        sent = [sent_by(name, i, now_ns, size=20) for name in scenario.roster]
        sent += [sent_by("r1", 100 + i, now_ns, "r2", size=5)]
        assert radio.channel.transmit(sent) == reference.transmit(sent)
        assert radio.fault_stats == plain.pop_stats()
        for name in scenario.roster:
            assert radio.channel.collect(name, now_ns) == reference.collect(name, now_ns)
        for one, other in itertools.permutations(scenario.roster, 2):
            assert radio.faults.cuts(now_ns, one, other) == plain.cuts(now_ns, one, other)
            assert radio.faults.reach_m(now_ns, one, other) == plain.reach_m(now_ns, one, other)


_DRAWN_ALONE = (Drop, Burst, Delay, Duplicate, Reorder, OneWay, Partition, Clog, Range)


@examples(60)
@given(st.data())
def test_draws_depend_on_the_message_alone(data: st.DataObject) -> None:
    """In any portions, with others in between or not: every decision is the same."""
    schedule = data.draw(
        SCHEDULES.filter(lambda faults: all(isinstance(f, _DRAWN_ALONE) for f in faults))
    )
    whole = FaultyRadio(*schedule, scenario=mission(*LOSSY), at=PLACES).transmit(*TALK)
    some = [TALK[i] for i in sorted(data.draw(st.sets(st.integers(0, len(TALK) - 1))))]
    cut = data.draw(st.integers(0, len(some)))
    radio = FaultyRadio(*schedule, scenario=mission(*LOSSY), at=PLACES)
    in_portions = [*radio.transmit(*some[:cut]), *radio.transmit(*some[cut:])]
    spoken = {(sent.envelope.source, sent.envelope.sequence) for sent in some}

    assert in_portions == [v for v in whole if (v.source, v.sequence) in spoken]


def test_fault_stats_agree_with_the_decisions() -> None:
    """Every copy that faults drop is counted, for each fault that drops it."""
    faults = (Partition(shape="halves"), Drop(probability=0.5), Delay(delay_s=1.0))
    radio = FaultyRadio(*faults)
    decisions = radio.transmit(*broadcasts(50))
    passed = [v.due_ns for v in decisions if v.due_ns != DROPPED]
    fault_stats = radio.fault_stats

    assert fault_stats[0] == {"dropped": 200}
    assert fault_stats[1]["dropped"] > 100 - len(passed)
    assert fault_stats[2] == {"delayed": len(passed)}


# Missions.

SCHEDULE: dict[str, AnyFault] = {
    "drop": Drop(probability=0.4),
    "burst": Burst(good_s=1.0, bad_s=0.6),
    "delay": Delay(delay_s=0.2, jitter_s=0.3),
    "duplicate": Duplicate(probability=0.5, copies=2, delay_s=0.5),
    "replay": Replay(probability=0.5, age_s=1.5),
    "reorder": Reorder(probability=0.5, hold_s=1.0),
    "one-way": OneWay(senders=("r1",), from_s=0.5, until_s=3.0),
    "halves": Partition(shape="halves", from_s=0.5, until_s=2.0),
    "isolate": Partition(shape="isolate", robots=("r1",), until_s=2.5),
    "flapping": Partition(shape="groups", groups=(("r2",),), flap_s=0.3),
    "clog": Clog(from_s=0.5, until_s=2.0),
    "bandwidth": Bandwidth(bytes_per_s=300.0),
    "bandwidth-drops": Bandwidth(bytes_per_s=300.0, queue_bytes=40),
    "range": Range(range_m=7.0, until_s=3.0),
    "hostile": Hostile(probability=0.3),
}


def under(*faults: AnyFault) -> str:
    """Faults as an override."""

    def literal(value: Any) -> str:
        if isinstance(value, dict):
            return "{" + ", ".join(f"{k} = {literal(v)}" for k, v in value.items()) + "}"
        if isinstance(value, list):
            return "[" + ", ".join(map(literal, value)) + "]"
        return repr(value)

    trees = to_tree(msgspec.structs.replace(mission(), faults=faults))["faults"]
    return f"faults={literal(trees)}"


def result_of(records: Sequence[Record]) -> Result:
    """result.json of a record."""
    first = records[0]
    assert isinstance(first, Opening)
    metrics = metrics_of(first.scenario)
    journal = Journal()
    pipeline = Pipeline(journal, metrics)
    for record in records:
        pipeline.observe(record)
    return metrics.result(
        exchange="in-process",
        digest=journal.digest.hex,
        wall_s=0.0,
        record="whole",
        complaints=tuple(check(records).violations),
    )


def went_well(records: Sequence[Record], *faults: AnyFault) -> Result:
    """The result of a mission that ended, in which no rule was broken and every fault has had effects."""
    result = result_of(records)

    assert result.complaints == ()
    assert result.ended == "done"
    assert list(result.faults) == [f"{i} {kind_of(fault)}" for i, fault in enumerate(faults)]
    assert all(counts != FaultCounts() for counts in result.faults.values())
    return result


@pytest.mark.parametrize("name", SCHEDULE)
@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
def test_a_mission_on_a_density_completes_under_every_fault(
    played: Play, coordination: str, name: str
) -> None:
    """Only time is lost: all mass is shipped, and no robot has shipped more than it knows of."""
    narrow = ("supervisor.range_m=60",) if coordination == "centralized" else ()
    fault = SCHEDULE[name]
    if isinstance(fault, Range):
        fault = msgspec.structs.replace(fault, range_m=30.0)
    overrides = (f"coordination={coordination}", *narrow, "energy.steps=90")
    result = went_well(played(*overrides, under(fault)), fault)

    assert result.mass_left == 0.0
    assert result.finished_tick is not None


@pytest.mark.campaign
@pytest.mark.parametrize("name", SCHEDULE)
@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
def test_a_mission_on_a_map_completes_under_every_fault(coordination: str, name: str) -> None:
    """The map is explored as far as it can be."""
    fault = SCHEDULE[name]
    place = ("supervisor.pose_m=[1.5, 1.5]",) if isinstance(fault, Range) else ()
    if isinstance(fault, Partition) and fault.shape == "halves" and coordination == "centralized":
        fault = Partition(shape="isolate", robots=("r1",), from_s=0.5, until_s=2.0)
    overrides = (f"coordination={coordination}", "radio.range_m=30", *place)
    result = went_well(explored(*overrides, under(fault)), fault)

    assert result.map is not None
    assert result.map.explored == 1.0


STORM = (
    *(SCHEDULE[name] for name in ("drop", "burst", "delay", "duplicate", "replay", "reorder")),
    *(SCHEDULE[name] for name in ("flapping", "clog", "bandwidth", "bandwidth-drops")),
    OneWay(senders=("r1",), receivers=("r2",), until_s=1.5),
    Range(factor=0.9, until_s=3.0),
    Partition(shape="bridge", until_s=1.0),
)


def test_a_mission_completes_under_all_faults_together(played: Play) -> None:
    overrides = ("radio.range_m=95", "energy.steps=200", "energy.points=200", under(*STORM))
    result = went_well(played(*overrides), *STORM)

    assert result.mass_left == 0.0


@examples(30)
@given(
    schedule=SCHEDULES,
    coordination=st.sampled_from(["decentralized", "centralized"]),
    merge=st.sampled_from([("merge=ledger",), ("merge=min", "claims=false")]),
    order=st.sampled_from(["turn", "concurrent"]),
    delay_s=st.sampled_from([0.0, 0.15]),
    seed=SEEDS,
)
def test_under_no_schedule_does_a_sound_robot_break_a_rule(
    played: Play,
    schedule: tuple[AnyFault, ...],
    coordination: str,
    merge: tuple[str, ...],
    order: str,
    delay_s: float,
    seed: int,
) -> None:
    """And when the faults are over, the mission comes to its end."""
    overrides = (
        f"coordination={coordination}",
        f"clock.order={order}",
        f"radio.delay_s={delay_s}",
        "energy.steps=90",
    )
    result = result_of(played(*merge, *overrides, under(*schedule), seed=seed))

    assert result.complaints == ()
    assert result.ended == "done"


def test_the_same_seed_gives_the_same_record_under_faults() -> None:
    first, second, other = (
        result_of(explored.__wrapped__(under(*STORM[:8]), seed=seed)).digest for seed in (1, 1, 2)
    )

    assert first == second != other


def without_scenario(records: Sequence[Record]) -> list[Record]:
    """The records with no faults in the opening."""
    first = records[0]
    assert isinstance(first, Opening)
    plain = msgspec.structs.replace(first.scenario, faults=())
    return [msgspec.structs.replace(first, scenario=plain), *records[1:]]


@pytest.mark.parametrize("name", SCHEDULE)
def test_a_fault_after_the_end_changes_nothing(played: Play, name: str) -> None:
    """Record by record, but for the scenario itself."""
    plain = played()
    assert isinstance(plain[-1], Ending)
    end_s = plain[-1].now_ns * 1e-9
    fault = msgspec.structs.replace(SCHEDULE[name], from_s=end_s + 0.01, until_s=end_s + 1.0)

    assert without_scenario(played(under(fault))) == list(plain)


def test_batches_have_the_effects_of_faults(played: Play) -> None:
    """In the window, and not outside."""
    records = played(under(SCHEDULE["halves"]))
    times_ns = [r.now_ns for r in records if isinstance(r, Batch) and r.fault_stats]

    assert (min(times_ns), max(times_ns)) == (500 * MS, 1900 * MS)


def test_a_scenario_without_link_faults_has_no_interference() -> None:
    assert LinkFaults.of(mission(), 1) is None
    assert LinkFaults.of(from_tree(to_tree(mission(under(SCHEDULE["drop"]))), "t"), 1) is not None
