"""Link faults: the effect of each on the decisions of the radio."""

import itertools
import math
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.machine import SUPERVISOR
from kantor_protocol.scenario.faults.links import (
    Bandwidth,
    Burst,
    Clog,
    Delay,
    Drop,
    Duplicate,
    OneWay,
    Partition,
    Range,
    Reorder,
    Replay,
)
from kantor_protocol.scenario.faults.schedule import AnyFault
from kantor_worldsim.radio.channel import DROPPED, Sent
from kantor_worldsim.radio.fault_kernels import in_burst
from support.faults.faulty_radio import (
    ALL_LINKS,
    MS,
    PLACES,
    FaultyRadio,
    S,
    broadcasts,
    dues,
    reached,
    sent_by,
)
from support.grounds import drawn, exploration
from support.strategies import SEEDS, examples, mission


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
    bursts = [len(list(run)) for bad, run in itertools.groupby(lost) if bad]

    assert sum(lost) / len(lost) == pytest.approx(0.2, abs=0.02)
    assert sum(bursts) / len(bursts) * 0.05 == pytest.approx(0.5, abs=0.05)


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
        (OneWay(senders=("r1",)), ALL_LINKS - {"r1>r2", "r1>r3"}),
        (OneWay(senders=("r1",), receivers=("r2",)), ALL_LINKS - {"r1>r2"}),
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


@pytest.mark.parametrize(
    ("faults", "links"),
    [
        ((Range(factor=0.5),), {"r1>r2", "r2>r1", "r2>r3", "r3>r2"}),
        ((Range(range_m=30.0),), {"r1>r2", "r2>r1", "r2>r3", "r3>r2"}),
        ((Range(range_m=29.9),), set()),
        ((Range(factor=0.5), Range(range_m=10.0)), set()),
        ((Range(range_m=10.0, robots=("r1",)),), {"r2>r3", "r3>r2"}),
        ((Range(range_m=10.0, from_s=1.0),), ALL_LINKS),
    ],
)
def test_range_shrinks_on_the_links_of_a_fault(faults: tuple[Range, ...], links: set[str]) -> None:
    """The least range counts, its bound included; receivers beyond it are counted as out of range."""
    radio = FaultyRadio(*faults, scenario=mission("radio.range_m=60"), at=PLACES)
    decisions, out_of_range = radio.channel.transmit(broadcasts(1)[:3])

    now_ns = 100 * MS
    assert reached(decisions) == links
    assert len(links) + out_of_range == 6
    for link in ALL_LINKS:
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
