"""The radio: which receivers an envelope reaches, when, and which copies are lost."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Envelope, ParticipantId, Pose
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.radio.channel import (
    DROPPED,
    OPEN,
    Channel,
    DeliveryDecision,
    Sent,
    Walls,
    links,
)
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.sensors import walls_between
from support.grounds import drawn, exploration, grounds
from support.strategies import SEEDS, examples, mission

MS = 1_000_000
CENTRALIZED = "coordination=centralized"
LOSSY = (
    "radio.drop=0.3",
    "radio.duplicate=0.4",
    "radio.delay_s=0.02",
    "radio.jitter_s=0.1",
    "radio.reorder=0.25",
    "radio.reorder_s=0.3",
)
FOUR = (
    "robots.count=4",
    "starts.poses_m=[[10.0, 10.0], [90.0, 20.0], [50.0, 80.0], [50.0, 50.0]]",
)


def sent_by(
    source: ParticipantId, sequence: int, target: ParticipantId = EVERYBODY, now_ns: int = 0
) -> Sent:
    """An envelope on the air."""
    return Sent(now_ns, Envelope(source, sequence, target, b""))


def channel(
    *overrides: str, seed: int = 1, at: dict[str, tuple[float, float]] | None = None
) -> Channel:
    """A channel with all participants in one place, but for those in `at`."""
    scenario = mission(*overrides)
    made = Channel(scenario, seed)
    for name in scenario.roster:
        made.place(name, Pose(*(at or {}).get(name, (0.0, 0.0))))
    return made


def receivers(decisions: Iterable[DeliveryDecision]) -> list[ParticipantId]:
    return [decision.target for decision in decisions]


def broadcasts(scenario: Scenario, count: int) -> list[Sent]:
    """`count` broadcasts of each participant, 100 ms apart."""
    return [
        sent_by(name, sequence, now_ns=100 * MS * sequence)
        for sequence in range(1, count + 1)
        for name in scenario.roster
    ]


# Range.


@pytest.mark.parametrize(
    ("place_m", "heard_by"),
    [
        ((3.0, 4.0), ["r2"]),
        ((-5.0, 0.0), ["r2"]),
        ((0.0, 0.0), ["r2"]),
        ((3.0, math.nextafter(4.0, 5.0)), []),
    ],
)
def test_the_range_is_inclusive(
    place_m: tuple[float, float], heard_by: list[ParticipantId]
) -> None:
    """A receiver at exactly the range is reached; one further away is not, and is counted."""
    radio = channel("radio.range_m=5", at={"r2": place_m, "r3": (99.0, 0.0)})
    decisions, out_of_range = radio.transmit([sent_by("r1", 1)])

    assert (receivers(decisions), out_of_range) == (heard_by, 2 - len(heard_by))


@examples(100)
@given(
    places=st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=3, max_size=3),
    range_m=st.floats(0.0, 2e3),
)
def test_links_are_mutual(places: list[tuple[float, float]], range_m: float) -> None:
    """Two robots are both in range of each other, or neither is."""
    at = dict(zip(("r1", "r2", "r3"), places, strict=True))
    radio = channel(f"radio.range_m={range_m}", at=at)
    decisions, out_of_range = radio.transmit([sent_by(name, 1) for name in at])
    pairs = {(decision.source, decision.target) for decision in decisions}

    assert {(target, source) for source, target in pairs} == pairs
    assert len(pairs) + out_of_range == 6
    assert links(np.array(places), range_m) == len(pairs) / 2


@examples(100)
@given(
    places=st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), min_size=12, max_size=12),
    range_m=st.sampled_from([0.0, 1.0, 2.5, 6.0, 40.0]),
    others=st.sampled_from([(), (CENTRALIZED,)]),
)
def test_many_envelopes_are_decided_as_each_by_itself(
    places: list[tuple[int, int]], range_m: float, others: tuple[str, ...]
) -> None:
    """Only for many are participants sorted by place; that changes no decision, no order and no count."""
    options = (f"radio.range_m={range_m}", "robots.count=12", "starts.random=true", *others)
    at = {f"r{i + 1}": (float(x), float(y)) for i, (x, y) in enumerate(places)}
    together, alone = channel(*options, at=at), channel(*options, at=at)
    sent = [sent_by(name, 1) for name in (*at, *([SUPERVISOR] if others else []))]
    one_by_one = [alone.transmit([each]) for each in sent]

    decisions = [decision for decided, _ in one_by_one for decision in decided]
    assert together.transmit(sent) == (decisions, sum(lost for _, lost in one_by_one))


def test_range_is_measured_at_the_time_of_sending() -> None:
    """An envelope in flight reaches a robot that has left; one that was out of range never arrives."""
    radio = channel("radio.range_m=5", "radio.delay_s=1.0", at={"r3": (50.0, 0.0)})
    radio.transmit([sent_by("r1", 1, now_ns=0)])
    radio.place("r2", Pose(99.0, 0.0))
    radio.place("r3", Pose(0.0, 0.0))

    assert [envelope.sequence for envelope in radio.collect("r2", 1000 * MS)] == [1]
    assert radio.collect("r3", 1000 * MS) == ()


def test_no_participant_is_reached_before_it_is_placed() -> None:
    """A participant without a place is out of range of all."""
    decisions, out_of_range = Channel(mission("radio.range_m=5"), 1).transmit([sent_by("r1", 1)])

    assert (decisions, out_of_range) == ([], 2)


def test_the_supervisor_has_a_range_of_its_own() -> None:
    """Its range holds both ways and for it alone."""
    at = {"r1": (30.0, 0.0), "r2": (30.0, 0.0), "r3": (50.0, 0.0)}
    radio = channel(CENTRALIZED, "radio.range_m=0.0", "supervisor.range_m=30", at=at)
    spoken, too_far = radio.transmit([sent_by(SUPERVISOR, 1)])
    answered, _ = radio.transmit([sent_by(name, 1, SUPERVISOR) for name in at])
    robots, _ = radio.transmit([sent_by("r3", 2)])

    assert (receivers(spoken), too_far) == (["r1", "r2"], 1)
    assert [decision.source for decision in answered] == ["r1", "r2"]
    assert robots == []


# Walls.

TWO_WALLS = drawn(
    "..#..#..",
    "..#..#..",
    "..#.....",
    resolution_m=2.0,
    origin_m=(100.0, -50.0),
)
ROW_M = -45.0
"""The y of places in the highest row."""


def among_walls(*overrides: str, places_m: Sequence[tuple[float, float]]) -> Channel:
    """A channel on the map of two walls, with robots, and the supervisor if there is one, at places."""
    scenario = exploration(f"robots.count={len(places_m)}", *overrides)
    made = Channel(scenario, 1, TWO_WALLS)
    for name, place_m in zip(scenario.robot_ids, places_m, strict=True):
        made.place(name, Pose(*place_m))
    if scenario.centralized:
        made.place(SUPERVISOR, Pose(*scenario.supervisor_m))
    return made


IN_A_ROW = [(101.0, ROW_M), (103.0, ROW_M), (107.0, ROW_M), (115.0, ROW_M)]
"""r1 and r2 before both walls, r3 between them, r4 behind."""


@pytest.mark.parametrize(
    ("radio", "heard_by"),
    [
        ((), ["r2", "r3", "r4"]),
        (("radio.line_of_sight=true",), ["r2"]),
        (("radio.range_m=14.0",), ["r2", "r3", "r4"]),
        (("radio.range_m=14.0", "radio.wall_loss_m=0.1"), ["r2", "r3"]),
        (("radio.range_m=16.0", "radio.wall_loss_m=1.0"), ["r2", "r3", "r4"]),
        (("radio.range_m=16.0", "radio.wall_loss_m=1.01"), ["r2", "r3"]),
        (("radio.range_m=16.0", "radio.wall_loss_m=10.01"), ["r2"]),
        (("radio.range_m=3.0", "radio.wall_loss_m=40.0"), ["r2"]),
        (("radio.wall_loss_m=1e9",), ["r2", "r3", "r4"]),
        (("radio.wall_loss_m=1e9", "radio.line_of_sight=true"), ["r2"]),
    ],
)
def test_walls_shorten_the_range(radio: tuple[str, ...], heard_by: list[ParticipantId]) -> None:
    """Each by its loss, the bound included; with line of sight they block it. Receivers out of range are counted."""
    channel_there = among_walls(*radio, places_m=IN_A_ROW)
    decisions, out_of_range = channel_there.transmit([sent_by("r1", 1)])

    assert (receivers(decisions), out_of_range) == (heard_by, 3 - len(heard_by))


def test_a_wall_beside_the_line_does_not_matter() -> None:
    """A link next to a wall has its full range."""
    radio = among_walls("radio.line_of_sight=true", places_m=[(107.0, -49.0), (115.0, -49.0)])

    assert receivers(radio.transmit([sent_by("r1", 1)])[0]) == ["r2"]


@pytest.mark.parametrize(
    ("place_m", "speaks", "hear"),
    [
        ("[107.0, -45.0]", ["r3"], ["r3"]),
        ("[107.0, -47.0]", ["r3"], ["r3"]),
        ("[101.0, -40.0]", [], []),  # outside is a wall
    ],
)
def test_walls_block_a_supervisor_with_a_pose(
    place_m: str, speaks: list[ParticipantId], hear: list[ParticipantId]
) -> None:
    """In both directions, for every range."""
    overrides = (CENTRALIZED, f"supervisor.pose_m={place_m}", "radio.line_of_sight=true")
    radio = among_walls(*overrides, places_m=IN_A_ROW)
    spoken, _ = radio.transmit([sent_by(SUPERVISOR, 1)])
    received, _ = radio.transmit([sent_by(f"r{i}", 1, SUPERVISOR) for i in range(1, 5)])

    assert receivers(spoken) == hear
    assert [decision.source for decision in received] == speaks


def test_the_range_of_the_supervisor_is_its_own_less_the_walls() -> None:
    """The loss is the radio's, the range its own."""
    overrides = (CENTRALIZED, "supervisor.pose_m=[101.0, -45.0]", "supervisor.range_m=15.0")
    radio = among_walls(*overrides, "radio.wall_loss_m=2.0", "radio.range_m=1.0", places_m=IN_A_ROW)

    assert receivers(radio.transmit([sent_by(SUPERVISOR, 1)])[0]) == ["r1", "r2", "r3"]


def test_a_supervisor_without_a_pose_is_in_range_everywhere() -> None:
    """The supervisor is not on the map, so no wall is between."""
    overrides = (CENTRALIZED, "radio.line_of_sight=true", "radio.wall_loss_m=1.0")
    radio = among_walls(*overrides, places_m=IN_A_ROW)

    assert receivers(radio.transmit([sent_by(SUPERVISOR, 1)])[0]) == ["r1", "r2", "r3", "r4"]
    assert receivers(radio.transmit([sent_by("r1", 1)])[0]) == ["r2", SUPERVISOR]


@examples(200)
@given(
    ground=grounds(),
    places=st.lists(st.tuples(*2 * [st.floats(0.0, 1.0)]), min_size=3, max_size=3),
    range_cells=st.floats(0.0, 15.0) | st.just(math.inf),
    loss_cells=st.sampled_from([0.0, 1.0]) | st.floats(0.0, 8.0),
    line_of_sight=st.booleans(),
)
def test_links_through_walls_are_mutual(
    ground: Ground,
    places: list[tuple[float, float]],
    range_cells: float,
    loss_cells: float,
    line_of_sight: bool,  # noqa: FBT001
) -> None:
    """Two robots both receive from each other or neither does, as by the direct computation; links are counted alike."""
    frame, cells = ground
    side_m, (left_m, bottom_m) = frame.resolution_m, frame.origin_m
    xy_m = np.array(
        [
            (left_m + u * frame.columns * side_m, bottom_m + v * frame.rows * side_m)
            for u, v in places
        ]
    )
    range_m, loss_m = range_cells * side_m, loss_cells * side_m
    scenario = exploration(
        "robots.count=3",
        f"radio.range_m={range_m!r}",
        f"radio.wall_loss_m={loss_m!r}",
        f"radio.line_of_sight={str(line_of_sight).lower()}",
    )
    radio = Channel(scenario, 1, ground)
    for name, (x_m, y_m) in zip(scenario.robot_ids, xy_m.tolist(), strict=True):
        radio.place(name, Pose(x_m, y_m))
    decisions, out_of_range = radio.transmit([sent_by(name, 1) for name in scenario.robot_ids])
    expected = set()
    uv = ((xy_m - (left_m, bottom_m)) / side_m).tolist()
    for i, one in enumerate(scenario.robot_ids):
        for j, other in enumerate(scenario.robot_ids):
            walls = walls_between(cells, *uv[i], *uv[j])
            dx, dy = (xy_m[i] - xy_m[j]).tolist()
            reach_m = range_m - walls * loss_m
            hindered = line_of_sight and walls > 0
            within = reach_m >= 0.0 and dx * dx + dy * dy <= reach_m * reach_m
            if i != j and within and not hindered:
                expected.add((one, other))

    assert {(decision.source, decision.target) for decision in decisions} == expected
    assert len(expected) + out_of_range == 6
    assert links(xy_m, range_m, Walls.of(scenario.radio, ground)) == len(expected) / 2


def test_walls_without_loss_and_line_of_sight_do_not_matter() -> None:
    """Without loss and line of sight a map is like none."""
    assert Walls.of(exploration().radio, TWO_WALLS) is OPEN
    assert Walls.of(exploration("radio.line_of_sight=true").radio, None) is OPEN


# Targets.


@pytest.mark.parametrize(
    ("target", "hear", "out_of_range"),
    [
        (EVERYBODY, ["r2", "r3", SUPERVISOR], 0),
        ("r3", ["r3"], 0),
        (SUPERVISOR, [SUPERVISOR], 0),
        ("r1", [], 0),
        ("r99", [], 0),
    ],
)
def test_an_envelope_reaches_its_target_alone(
    target: ParticipantId, hear: list[ParticipantId], out_of_range: int
) -> None:
    """All participants, or the one addressed; never the sender; a stranger reaches none."""
    decisions = channel(CENTRALIZED).transmit([sent_by("r1", 1, target)])

    assert (receivers(decisions[0]), decisions[1]) == (hear, out_of_range)


def test_only_the_target_can_be_out_of_range() -> None:
    """Participants that are not addressed are not counted."""
    at = {"r2": (9.0, 0.0), "r3": (9.0, 0.0)}

    assert channel("radio.range_m=5", at=at).transmit([sent_by("r1", 1, "r3")]) == ([], 1)


# Draws.


@examples(50)
@given(st.data())
def test_draws_depend_on_the_link_and_the_sequence_alone(data: st.DataObject) -> None:
    """In any order, in any portions, with others in between or not: every decision is the same."""
    overrides = (CENTRALIZED, *LOSSY)
    everything = broadcasts(mission(*overrides), 6)
    whole = set(channel(*overrides).transmit(everything)[0])
    some = data.draw(st.permutations(everything))[: data.draw(st.integers(1, len(everything)))]
    cut = data.draw(st.integers(0, len(some)))
    radio = channel(*overrides)
    in_portions = [*radio.transmit(some[:cut])[0], *radio.transmit(some[cut:])[0]]
    spoken = {(sent.envelope.source, sent.envelope.sequence) for sent in some}

    assert set(in_portions) == {v for v in whole if (v.source, v.sequence) in spoken}


@pytest.mark.parametrize("coordination", ["centralized", "decentralized"])
def test_one_more_robot_changes_no_other_draw(coordination: str) -> None:
    """The decisions on the links of three robots are the same among four."""
    overrides = (f"coordination={coordination}", *LOSSY)
    three = channel(*overrides).transmit(broadcasts(mission(*overrides), 50))[0]
    four = channel(*overrides, *FOUR).transmit(broadcasts(mission(*overrides, *FOUR), 50))[0]
    old = [decision for decision in four if "r4" not in (decision.source, decision.target)]

    assert set(old) == set(three)
    assert len(old) < len(four)


def test_draws_differ_between_links_sequences_and_seeds() -> None:
    """No two links share their draws, nor do two runs."""

    def outcomes(seed: int) -> dict[tuple[str, str], tuple[bool, ...]]:
        decisions = channel("radio.drop=0.5", seed=seed).transmit(broadcasts(mission(), 64))[0]
        fates: dict[tuple[str, str], tuple[bool, ...]] = {}
        for decision in decisions:
            link = decision.source, decision.target
            fates[link] = (*fates.get(link, ()), decision.due_ns == DROPPED)
        return fates

    fates = [*outcomes(1).values(), *outcomes(2).values()]

    assert len(set(fates)) == len(fates) == 12
    assert all(0 < sum(fate) < 64 for fate in fates)


def _copies(decisions: Sequence[DeliveryDecision]) -> dict[tuple[str, int, str], list[int]]:
    """Times of arrival of copies, by (source, sequence, target)."""
    copies: dict[tuple[str, int, str], list[int]] = {}
    for decision in decisions:
        key = decision.source, decision.sequence, decision.target
        copies.setdefault(key, []).append(decision.due_ns)
    return copies


def within_five_sigma(hits: int, trials: int, rate: float) -> bool:
    """Whether a count is within five standard deviations of a binomial one."""
    return abs(hits - trials * rate) <= 5.0 * math.sqrt(trials * rate * (1.0 - rate)) + 0.5


@examples(10)
@given(
    drop=st.sampled_from([0.0, 0.01, 0.3, 0.9]),
    duplicate=st.sampled_from([0.0, 0.05, 0.5]),
    seed=SEEDS,
)
def test_drops_and_duplicates_come_at_their_rate(drop: float, duplicate: float, seed: int) -> None:
    """Per receiver and copy; a copy's loss does not depend on its twin's."""
    radio = channel(f"radio.drop={drop}", f"radio.duplicate={duplicate}", seed=seed)
    decisions = radio.transmit(broadcasts(mission(), 1500))[0]
    copies = _copies(decisions)
    twins = [due for due in copies.values() if len(due) == 2]
    both = sum(due == [DROPPED, DROPPED] for due in twins)

    assert len(copies) == 3 * 2 * 1500
    assert within_five_sigma(len(twins), len(copies), duplicate)
    assert within_five_sigma(sum(v.due_ns == DROPPED for v in decisions), len(decisions), drop)
    assert within_five_sigma(both, len(twins), drop * drop)


@examples(40)
@given(
    delay_ms=st.integers(0, 500),
    jitter_ms=st.integers(0, 500),
    reorder=st.sampled_from([0.0, 0.3]),
    reorder_ms=st.integers(1, 500),
    duplicate=st.sampled_from([0.0, 0.5]),
    seed=SEEDS,
)
def test_a_delay_lies_between_its_bounds(
    delay_ms: int, jitter_ms: int, reorder: float, reorder_ms: int, duplicate: float, seed: int
) -> None:
    """Never sooner than the delay; never later than delay, jitter and hold-back together."""
    radio = channel(
        f"radio.delay_s={delay_ms / 1000}",
        f"radio.jitter_s={jitter_ms / 1000}",
        f"radio.reorder={reorder}",
        f"radio.reorder_s={reorder_ms / 1000}",
        f"radio.duplicate={duplicate}",
        seed=seed,
    )
    decisions = radio.transmit(broadcasts(mission(), 40))[0]
    delays_ms = [decision.due_ns / MS - 100 * decision.sequence for decision in decisions]
    latest_ms = delay_ms + jitter_ms + (reorder_ms if reorder else 0)

    assert radio.lookahead_ns == delay_ms * MS
    assert min(delays_ms) >= delay_ms
    assert max(delays_ms) <= latest_ms
    assert max(delays_ms) >= delay_ms + 0.6 * (latest_ms - delay_ms)


def test_held_back_messages_are_overtaken() -> None:
    """A share `reorder` of the messages waits up to reorder_s, so that later ones pass them."""
    overrides = ("radio.reorder=0.25", "radio.reorder_s=0.5")
    decisions = channel(*overrides).transmit(broadcasts(mission(), 1500))[0]
    held = sum(decision.due_ns > 100 * MS * decision.sequence for decision in decisions)
    radio = channel(*overrides)
    radio.transmit([sent for sent in broadcasts(mission(), 20) if sent.envelope.source == "r1"])
    arrived = [envelope.sequence for envelope in radio.collect("r2", 10_000 * MS)]

    assert within_five_sigma(held, len(decisions), 0.25)
    assert sorted(arrived) == list(range(1, 21))
    assert arrived != sorted(arrived)


def test_a_steady_delay_keeps_the_order() -> None:
    """Without jitter and hold-back nothing is overtaken."""
    radio = channel("radio.delay_s=0.25", "radio.drop=0.3", "radio.duplicate=0.3")
    radio.transmit([sent for sent in broadcasts(mission(), 50) if sent.envelope.source == "r1"])
    arrived = [envelope.sequence for envelope in radio.collect("r2", 10_000 * MS)]

    assert len(arrived) > 30
    assert arrived == sorted(arrived)


# In flight.


def test_an_inbox_is_in_order_of_arrival_then_source_then_sequence() -> None:
    """Ties are broken by roster and sequence, in any order of sending."""
    radio = channel(CENTRALIZED, "radio.delay_s=0.01")
    sent = [
        sent_by(SUPERVISOR, 1),
        sent_by("r3", 2),
        sent_by("r2", 9),
        sent_by("r2", 8),
        sent_by("r3", 1, now_ns=5 * MS),
        sent_by("r2", 10, now_ns=-1 * MS),
    ]
    radio.transmit(sent)
    inbox = radio.collect("r1", 15 * MS)

    assert [(envelope.source, envelope.sequence) for envelope in inbox] == [
        ("r2", 10),
        ("r2", 8),
        ("r2", 9),
        ("r3", 2),
        (SUPERVISOR, 1),
        ("r3", 1),
    ]


def test_an_envelope_is_collected_once_and_not_before_it_is_due() -> None:
    """A delivery waits until its time, is collected once, and is among the arrivals until then."""
    radio = channel("radio.delay_s=0.05")
    radio.transmit([sent_by("r1", 1, "r2"), sent_by("r1", 2, "r2", now_ns=10 * MS)])

    assert radio.arrivals() == [("r2", 50 * MS)]
    assert radio.collect("r2", 50 * MS - 1) == ()
    assert [envelope.sequence for envelope in radio.collect("r2", 50 * MS)] == [1]
    assert radio.arrivals() == [("r2", 60 * MS)]
    assert [envelope.sequence for envelope in radio.collect("r2", 10**12)] == [2]
    assert radio.arrivals() == []
    assert radio.collect("r2", 10**12) == ()


def test_a_dropped_copy_has_a_decision_and_is_never_in_flight() -> None:
    """A lost copy is in the record, and in no inbox."""
    radio = channel("radio.drop=0.999999")
    decisions, _ = radio.transmit([sent_by("r1", 1)])

    assert decisions == [
        DeliveryDecision("r1", 1, "r2", DROPPED),
        DeliveryDecision("r1", 1, "r3", DROPPED),
    ]
    assert radio.arrivals() == []


def test_without_envelopes_there_is_no_decision() -> None:
    """No decision, and no receiver out of range."""
    assert channel().transmit([]) == ([], 0)
