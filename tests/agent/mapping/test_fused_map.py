"""Fused maps: the layers of all robots summed, each known by its log alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.mapping.fused_map import FusedMap
from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.replication.occupancy_log import RANGE_BINS, dead_frontier, entries
from kantor_protocol.replication.replica import Replica
from support.strategies import examples

FRAME = Frame(0.5, (0.0, 0.0), 4, 5)
ORIGINS = 3


def replica(me: int = 0) -> Replica:
    """Of a mission with a map."""
    return Replica(me, ORIGINS, entries(FRAME), None, ledger=True, claims=False)


def map_of(*logs: list[int]) -> FusedMap:
    """The fused map of a participant that holds these logs; the first is its own."""
    held = replica()
    held.append(np.array(logs[0], dtype=np.int64))
    for origin, log in enumerate(logs[1:], start=1):
        other = replica(origin)
        other.append(np.array(log, dtype=np.int64))
        other.registers.end_step()
        assert held.merge(origin, *_message(other))
    fused_map = FusedMap(FRAME, ORIGINS)
    fused_map.fold(held)
    fused_map.validate(held)
    return fused_map


def _message(other: Replica) -> tuple[bytes, bytes, bytes]:
    """All that a participant holds, as it sends it before it has received anything."""
    version_vector, logs, claims = other.compose(0)
    return version_vector, logs, claims


def free(*cells: int) -> list[int]:
    """Entries."""
    return [2 * cell for cell in cells]


def wall(*cells: int) -> list[int]:
    """Entries."""
    return [2 * cell + 1 for cell in cells]


def test_a_single_layer_is_the_fused_map() -> None:
    """A cell is what its last entry says."""
    fused_map = map_of(free(0, 1, 2) + wall(7) + wall(2))

    assert fused_map.cells.tolist() == [
        FREE,
        FREE,
        OCCUPIED,
        *[UNKNOWN] * 4,
        OCCUPIED,
        *[UNKNOWN] * 12,
    ]
    assert fused_map.p_occ()[[0, 2, 5]].tolist() == pytest.approx([0.05, 0.95, 0.5], abs=1e-3)


def test_layers_are_summed_and_a_tie_is_occupied() -> None:
    """Two against one decide; one against one is explored, and not to be driven on."""
    fused_map = map_of(free(0, 1), free(0) + wall(1), wall(0))

    assert fused_map.cells[:3].tolist() == [FREE, OCCUPIED, UNKNOWN]
    assert fused_map.p_occ()[1] == 0.5
    assert fused_map.explored()[:3].tolist() == [True, True, False]


@examples(60)
@given(
    logs=st.lists(
        st.lists(st.integers(0, 2 * FRAME.cells - 1), max_size=60), min_size=3, max_size=3
    ),
    cuts=st.lists(st.integers(0, 60), min_size=3, max_size=3),
)
def test_folding_in_parts_is_folding_at_once(logs: list[list[int]], cuts: list[int]) -> None:
    """A map is a function of the logs, not of when they came; the reference sums plain signs."""
    whole, held = FusedMap(FRAME, ORIGINS), replica()
    bits = FusedMap(FRAME, ORIGINS)
    for origin, log in enumerate(logs):
        store = held.store
        held.reserve(len(log))
        store = held.store
        store.logs[origin, : len(log), 0] = log
        store.length[origin] = min(cuts[origin], len(log))
    bits.fold(held)
    for origin, log in enumerate(logs):
        held.store.length[origin] = len(log)
    bits.fold(held)
    whole.fold(held)
    bits.validate(held)
    whole.validate(held)
    layers = np.zeros((ORIGINS, FRAME.cells), dtype=int)
    for origin, log in enumerate(logs):
        for entry in log:
            layers[origin, entry // 2] = 1 if entry % 2 else -1
    votes = layers.sum(axis=0)
    plain = np.where(votes < 0, FREE, OCCUPIED)
    plain[(layers == 0).all(axis=0)] = UNKNOWN

    assert bits.cells.tolist() == whole.cells.tolist() == plain.tolist()
    assert not bits.fold(held)


def test_frontiers_are_free_cells_beside_the_unknown() -> None:
    """Four neighbours count, diagonal ones do not; the border of the map is no unknown."""
    fused_map = map_of(free(0, 1, 5, 6) + wall(2, 7))

    assert fused_map.frontiers.tolist() == [5, 6]
    assert fused_map.is_frontier(5)
    assert not fused_map.is_frontier(0)
    assert not fused_map.is_frontier(19)


def test_a_dead_frontier_is_no_frontier() -> None:
    """One robot stood there and saw nothing new: no robot goes there again."""
    assert map_of(free(0, 1), [dead_frontier(FRAME, 1)]).frontiers.tolist() == [0]


def test_measured_ranges_are_counted() -> None:
    """Those of all robots, by bins."""
    first = 3 * FRAME.cells
    fused_map = map_of([first, first, first + RANGE_BINS - 1], [first + 3])

    assert fused_map.ranges[[0, 3, RANGE_BINS - 1]].tolist() == [2, 1, 1]
    assert fused_map.ranges.sum() == 4
