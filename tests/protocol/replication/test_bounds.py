"""What a mission makes possible bounds what is taken: lengths of logs, stamps of claims and registers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.replication.gossip import MessageCheck, build_replica, log_length_max
from kantor_protocol.scenario.clocks import steps_max
from kantor_protocol.wire.messages import VERSION, GossipMessage
from kantor_protocol.wire.weights import Units
from support.references.plain_varint import leb128 as uint
from support.references.plain_varint import zigzag
from support.strategies import MINIMUM, examples, mission

N = 12
UNITS = Units.of(30, N)
MISSIONS = {
    "ledger": (mission(), UNITS, N),
    "min": (mission(*MINIMUM), UNITS, N),
    "spectral": (mission("planner=spectral", "planner.modes=4"), UNITS, N),
}


def test_a_log_is_as_long_as_the_energy_lasts() -> None:
    """An entry ships a unit at least; with the minimum, it lowers a weight by one."""
    scenario, units, samples = MISSIONS["ledger"]
    assert log_length_max(scenario, units, samples) == 30 * units.point
    scenario, units, samples = MISSIONS["min"]
    assert log_length_max(scenario, units, samples) == samples * units.sample


def test_a_log_on_a_map_is_a_small_multiple_of_its_cells() -> None:
    small, large = (log_length_max(mission(), None, 3 * cells) for cells in (1000, 1_000_000))

    assert small <= 96 * 1000 + 8 * steps_max(mission())
    assert large <= 96 * 1_000_000 + 8 * steps_max(mission())


def test_a_mission_has_as_many_steps_as_its_limit_has_periods() -> None:
    scenario = mission("limit_s=100", "clock.period_s=0.1", "clock.spread=0.5")

    assert 2000 <= steps_max(scenario) <= 2000 + 1000


@pytest.mark.parametrize("name", MISSIONS)
def test_an_endless_log_is_not_taken(name: str) -> None:
    """Suffix by suffix a hostile participant can fill a log, and not a bit more; memory stays bounded."""
    scenario, units, samples = MISSIONS[name]
    replica = build_replica("r1", scenario, units, samples)
    most = log_length_max(scenario, units, samples)
    vector = uint(0) * (3 * (2 if scenario.claiming else 1))
    start, taken = 0, True
    while taken:
        entry = uint(zigzag(0)) + uint(0)
        log = uint(1) + uint(start) + uint(16) + uint(16) + 16 * entry
        taken = replica.merge(1, vector, log, b"")
        start += 16 if taken else 0
        assert start <= most

    assert replica.store.logs.shape[1] <= max(256, 2 * most)


@pytest.mark.parametrize("name", ["ledger", "spectral"])
def test_a_stamp_from_the_future_is_not_taken(name: str) -> None:
    """Otherwise nothing that its origin says would count any more."""
    scenario, units, samples = MISSIONS[name]
    for stamp, sound in ((steps_max(scenario), True), (steps_max(scenario) + 1, False)):
        replica = build_replica("r1", scenario, units, samples)
        vector = uint(0) * (3 * (2 if scenario.claiming else 1))
        claims = uint(1) + uint(stamp) + uint(1) + uint(0) if scenario.claiming else b""
        registers = b"" if scenario.claiming else 3 * uint(0) + uint(2) + uint(stamp) + uint(0)

        assert replica.merge(1, vector, b"", claims, registers) == sound


BYTES = st.binary(max_size=16)


@given(
    name=st.sampled_from(list(MISSIONS)),
    vector=BYTES | st.sampled_from([bytes(3), bytes(6), bytes(12), bytes(48)]),
    parts=st.tuples(BYTES, BYTES, BYTES | st.just(b"")),
    source=st.integers(0, 8),
)
@examples(500)
def test_the_check_passes_what_every_receiver_takes(
    name: str, vector: bytes, parts: tuple[bytes, bytes, bytes], source: int
) -> None:
    """World-sim's check beforehand and the checks of a receiver agree on any message."""
    scenario, units, samples = MISSIONS[name]
    receiver = "r1" if source % 3 else "r2"
    replica = build_replica(receiver, scenario, units, samples)
    message = GossipMessage(VERSION, 1, 0.0, 0.0, vector, *parts)

    passes = MessageCheck(scenario, units, samples).passes(source, message)
    assert passes == replica.merge(source, vector, *parts)
