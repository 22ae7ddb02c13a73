"""Several link faults together: their order, their draws, and the compiled rules against plain ones."""

import itertools
from collections.abc import Sequence

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import Pose
from kantor_protocol.scenario.faults.links import (
    FORGED_SEQUENCE_MIN,
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
from kantor_worldsim.radio.channel import DROPPED, Channel, DeliveryDecision
from support.faults.faulty_radio import MS, PLACES, FaultyRadio, broadcasts, dues, sent_by
from support.faults.link_fault_strategies import (
    FAULTS,
    FAULTS_WITHOUT_DRAWS,
    FAULTS_WITHOUT_FORGERIES,
    SCHEDULES,
)
from support.references.plain_faults import PASS, Fate, PlainFaults
from support.strategies import SEEDS, examples, mission

LOSSY = ("radio.range_m=50", "radio.drop=0.2", "radio.duplicate=0.3", "radio.jitter_s=0.3")
TRAFFIC = broadcasts(60, size=20)
FATES = st.builds(Fate, st.booleans(), st.integers(0, 10**15), st.integers(0, 10**15))


@examples(100)
@given(FATES, FATES, FATES)
def test_the_order_of_decisions_does_not_matter_and_a_drop_wins(a: Fate, b: Fate, c: Fate) -> None:
    assert a.joined(b) == b.joined(a)
    assert a.joined(b).joined(c) == a.joined(b.joined(c))
    assert a.joined(PASS) == a
    assert (a.joined(b).due_ns(5) == DROPPED) == (a.dropped or b.dropped)


@examples(60)
@given(st.data())
def test_the_order_of_faults_without_draws_does_not_matter(data: st.DataObject) -> None:
    """Cuts, holds, fixed delays, queues and ranges, in any order of the list."""
    schedule = data.draw(st.lists(FAULTS_WITHOUT_DRAWS, min_size=2, max_size=5))
    shuffled = data.draw(st.permutations(schedule))
    one, other = (
        FaultyRadio(*faults, scenario=mission(*LOSSY), at=PLACES).transmit(*TRAFFIC)
        for faults in (schedule, shuffled)
    )

    assert one == other


@examples(60)
@given(schedule=SCHEDULES, seed=SEEDS)
def test_windows_that_are_over_change_nothing(schedule: tuple[AnyFault, ...], seed: int) -> None:
    """Messages after the last of them have the decisions of a radio without faults."""
    over_ns = max((fault.until_ns or 0 for fault in schedule), default=0)
    scenario = mission(*LOSSY)
    plain = FaultyRadio(scenario=scenario, seed=seed, at=PLACES).transmit(*TRAFFIC)
    faulty = FaultyRadio(*schedule, scenario=scenario, seed=seed, at=PLACES)
    faulty.transmit(*[sent for sent in TRAFFIC if sent.now_ns < over_ns])
    after = [sent for sent in TRAFFIC if sent.now_ns >= over_ns]

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
    plain = FaultyRadio(*schedule, scenario=scenario, seed=seed, at=PLACES).transmit(*TRAFFIC)

    assert (
        FaultyRadio(*schedule, idle, later, scenario=scenario, seed=seed, at=PLACES).transmit(
            *TRAFFIC
        )
        == plain
    )


@examples(60)
@given(schedule=SCHEDULES, seed=SEEDS)
def test_a_certain_drop_wins_over_all(schedule: tuple[AnyFault, ...], seed: int) -> None:
    radio = FaultyRadio(
        *schedule, Drop(probability=1.0), scenario=mission(*LOSSY), seed=seed, at=PLACES
    )

    assert set(dues(radio.transmit(*TRAFFIC))) <= {DROPPED}


@examples(60)
@given(schedule=SCHEDULES, fault=FAULTS, seed=SEEDS)
def test_one_fault_more_delivers_no_lost_copy(
    schedule: tuple[AnyFault, ...], fault: AnyFault, seed: int
) -> None:
    """A copy that was lost is still lost, and one that still arrives does so no sooner."""
    scenario = mission(*LOSSY)
    before = _arrivals(
        FaultyRadio(*schedule, scenario=scenario, seed=seed, at=PLACES).transmit(*TRAFFIC)
    )
    after = _arrivals(
        FaultyRadio(*schedule, fault, scenario=scenario, seed=seed, at=PLACES).transmit(*TRAFFIC)
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
    schedule=st.lists(FAULTS_WITHOUT_FORGERIES | FAULTS_WITHOUT_DRAWS, max_size=12).map(tuple),
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
    whole = FaultyRadio(*schedule, scenario=mission(*LOSSY), at=PLACES).transmit(*TRAFFIC)
    some = [TRAFFIC[i] for i in sorted(data.draw(st.sets(st.integers(0, len(TRAFFIC) - 1))))]
    cut = data.draw(st.integers(0, len(some)))
    radio = FaultyRadio(*schedule, scenario=mission(*LOSSY), at=PLACES)
    in_portions = [*radio.transmit(*some[:cut]), *radio.transmit(*some[cut:])]
    keys = {(sent.envelope.source, sent.envelope.sequence) for sent in some}

    assert in_portions == [v for v in whole if (v.source, v.sequence) in keys]


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
