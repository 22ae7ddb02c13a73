"""The checkers' own rules on links, walls, outages and clocks agree with those that world-sim applies."""

import itertools
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_fleet.campaign.draw import draw
from kantor_protocol.base.grid import FREE, OCCUPIED, Frame
from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.varint import put_uint
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.links import OneWay, Partition, Range
from kantor_protocol.scenario.schema import RadioOptions, Scenario
from kantor_protocol.wire.version_vector import covered_ids
from kantor_worldsim.engine.process_faults import ProcessFaults, schedule_of
from kantor_worldsim.observers.checkers.links import Links
from kantor_worldsim.observers.checkers.outages import WrongClocks, caused_events
from kantor_worldsim.observers.checkers.sight import Sight, count_walls
from kantor_worldsim.observers.metrics.gossip_reader import incarnations_of, read_lengths
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.world.sensors import walls_between
from support.strategies import examples, mission

EDGES = [2.0 * i for i in range(6)]
COORDINATES = st.floats(-1.0, 7.0) | st.integers(-2, 14).map(lambda half: half / 2)
"""In cells of a map of 6 x 6, often on a line of the grid or in the middle of a cell."""
MAPS = st.lists(st.booleans(), min_size=36, max_size=36).map(
    lambda free: np.where(free, FREE, OCCUPIED).astype(np.uint8).reshape(6, 6)
)


def moments_ns(scenario: Scenario) -> list[int]:
    """Times around every begin and end of a fault, and some between."""
    times = {0, 10**8, 7 * 10**9, 61 * 10**9}
    for fault in scenario.faults:
        for edge_ns in (fault.from_ns, fault.until_ns):
            times |= set() if edge_ns is None else {max(0, edge_ns - 1), edge_ns, edge_ns + 1}
        if isinstance(fault, Partition) and fault.flap_s:
            times |= {fault.from_ns + round(i * 0.7e9 * fault.flap_s) for i in range(20)}
    return sorted(times)


def assert_agree(scenario: Scenario, seed: int, times_ns: list[int]) -> None:
    """Each link is cut and shortened at each of some times as the radio says."""
    links, radio = Links(scenario, seed), LinkFaults(scenario, seed)
    names = scenario.roster
    for now_ns in times_ns:
        links.move_to(now_ns)
        for i, j in itertools.permutations(range(len(names)), 2):
            assert links.is_cut(i, j) == radio.cuts(now_ns, names[i], names[j])
            assert links.range_m(i, j) == radio.reach_m(now_ns, names[i], names[j])


@pytest.mark.parametrize("first", range(0, 60, 10))
def test_links_of_drawn_missions_are_those_of_the_radio(first: int) -> None:
    for seed in range(first, first + 10):
        scenario = draw(seed)
        assert_agree(scenario, seed, moments_ns(scenario))


@pytest.mark.parametrize("robots", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("shape", ["halves", "ring", "bridge"])
def test_links_of_teams_of_every_size_are_those_of_the_radio(robots: int, shape: str) -> None:
    scenario = mission(f"robots.count={robots}", "starts.random=true", "energy.points=60")
    fault = msgspec.convert({"kind": "partition", "shape": shape}, Partition)
    assert_agree(msgspec.structs.replace(scenario, faults=(fault,)), 1, [0])


@examples(60)
@given(
    windows=st.lists(
        st.tuples(st.sampled_from(EDGES), st.sampled_from([*EDGES[1:], None])), max_size=5
    ),
    times_s=st.lists(st.floats(0.0, 12.0), min_size=1, max_size=12),
)
def test_links_may_be_read_at_times_in_any_order(
    windows: list[tuple[float, float | None]], times_s: list[float]
) -> None:
    """A table depends on the time alone, not on the times that were asked before."""
    kinds = itertools.cycle(
        [
            {"kind": "partition", "shape": "halves", "flap_s": 0.7},
            {"kind": "one-way", "senders": ["r2"]},
            {"kind": "range", "factor": 0.5, "robots": ["r1"]},
            {"kind": "range", "range_m": 30.0},
        ]
    )
    types: dict[str, type[Fault]] = {"partition": Partition, "one-way": OneWay, "range": Range}
    faults = tuple(
        msgspec.convert(
            tree | {"from_s": from_s} | ({} if until_s is None else {"until_s": from_s + until_s}),
            types[str(tree["kind"])],
        )
        for (from_s, until_s), tree in zip(windows, kinds, strict=False)
    )
    scenario = msgspec.structs.replace(mission("radio.range_m=80"), faults=faults)
    assert_agree(scenario, 3, [round(time_s * 1e9) for time_s in times_s])


@examples(400)
@given(cells=MAPS, ends=st.tuples(COORDINATES, COORDINATES, COORDINATES, COORDINATES))
def test_walls_are_counted_as_the_radio_counts_them(
    cells: np.ndarray, ends: tuple[float, float, float, float]
) -> None:
    u, v, to_u, to_v = ends

    assert count_walls(cells, *ends) == walls_between(cells, *ends)
    assert count_walls(cells, to_u, to_v, u, v) == count_walls(cells, *ends)


def test_walls_block_or_weaken_the_radio() -> None:
    """Between the middles of the first cells of two rooms stands one wall, 2 m away from each."""
    cells = np.full((1, 5), FREE, dtype=np.uint8)
    cells[0, 2] = OCCUPIED
    frame, here_m, there_m = Frame(1.0, (0.0, 0.0), 1, 5), (0.5, 0.5), (4.5, 0.5)
    blocked = Sight(RadioOptions(line_of_sight=True), frame, cells)
    weakened = Sight(RadioOptions(wall_loss_m=3.0), frame, cells)

    assert blocked.walls(here_m, there_m) == weakened.walls(here_m, there_m) == 1
    assert not blocked.reaches(here_m, there_m, 100.0, 1)
    assert blocked.reaches(here_m, there_m, 4.0, 0)
    assert weakened.reaches(here_m, there_m, 7.0, 1)
    assert not weakened.reaches(here_m, there_m, math.nextafter(7.0, 0.0), 1)
    assert not weakened.reaches(here_m, here_m, 2.0, 1)


def test_walls_do_not_matter_without_a_map_or_an_option() -> None:
    cells = np.full((1, 5), OCCUPIED, dtype=np.uint8)
    without_option = Sight(RadioOptions(), Frame(1.0, (0.0, 0.0), 1, 5), cells)
    without_map = Sight(RadioOptions(line_of_sight=True))

    for sight in (without_option, without_map):
        assert not sight.counts
        assert sight.walls((0.5, 0.5), (4.5, 0.5)) == 0


@pytest.mark.parametrize("first", range(0, 200, 50))
def test_events_of_drawn_missions_are_those_of_the_schedule(first: int) -> None:
    for seed in range(first, first + 50):
        scenario = draw(seed)
        caused = {(e.at_ns, e.fault, e.who, e.kind, e.mid_step) for e in caused_events(scenario)}
        scheduled = schedule_of(scenario)

        assert len(caused) == len(scheduled)
        assert caused == {(s.at_ns, s.fault, s.who, s.kind, s.mid_step) for s in scheduled}


@pytest.mark.parametrize("first", range(0, 200, 50))
def test_clocks_of_drawn_missions_are_those_of_the_schedule(first: int) -> None:
    """In virtual time they are wrong by exactly so much; otherwise this lies within the bounds."""
    for seed in range(first, first + 50):
        scenario = draw(seed)
        exact, bounded = (WrongClocks(scenario, virtual=virtual) for virtual in (True, False))
        faults = ProcessFaults(scenario)
        for now_ns, name in itertools.product(moments_ns(scenario), scenario.roster):
            skew_ns = faults.skew_ns(name, now_ns)
            least_ns, most_ns = bounded.skews_ns(name, now_ns, now_ns)

            assert exact.skews_ns(name, now_ns, now_ns) == (skew_ns, skew_ns)
            assert min(least_ns, -now_ns) <= skew_ns <= most_ns


def packed(numbers: list[int]) -> bytes:
    out = np.zeros(10 * len(numbers) + 1, dtype=np.uint8)
    at = 0
    for number in numbers:
        at = put_uint(out, at, number)
    return out[:at].tobytes()


@examples(200)
@given(
    content=st.lists(st.integers(0, 2**40), max_size=40).map(packed) | st.binary(max_size=40),
    participants=st.integers(1, 5),
    claims=st.booleans(),
)
def test_version_vectors_are_read_as_participants_read_them(
    content: bytes, participants: int, *, claims: bool
) -> None:
    count = covered_ids(content, participants, claims=claims)

    assert (incarnations_of(content, participants, claims=claims) or None) == count
    lengths = read_lengths(content, participants, claims=claims)
    assert (None if lengths is None else len(lengths)) == count


def test_version_vector_is_its_log_lengths_and_then_its_claims() -> None:
    vector = packed([3, 0, 700, 9, 8, 7])

    assert read_lengths(vector, 3, claims=True) == [3, 0, 700]
    assert read_lengths(vector, 3, claims=False) == [3, 0, 700, 9, 8, 7]
    assert read_lengths(vector, 4, claims=False) is None
    assert read_lengths(vector[:-1] + b"\x80", 3, claims=True) is None
    assert read_lengths(packed([0] * (INCARNATIONS_MAX + 2)), 1, claims=False) is None
