"""Decoders of replication: packed pairs, merges into replicas and registers, occupancy logs."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fuzz import corpora
from fuzz.decoding import Decode
from fuzz.mutations import unframe
from kantor_protocol.base.grid import OCCUPIED
from kantor_protocol.base.machine import Envelope, Pose
from kantor_protocol.base.varint import Pairs, pack_pairs, sum_pairs
from kantor_protocol.replication.gossip import build_replica
from kantor_protocol.replication.occupancy_log import OccupancyLog, entries
from kantor_protocol.replication.registers import NUMBER_MAX, read_register
from kantor_protocol.replication.replica import Replica
from kantor_protocol.wire.version_vector import read_version_vector
from kantor_protocol.wire.weights import Units
from kantor_worldsim.world.world import units_of
from support.missions import on_map
from support.replication.attesting import Member, claim_of
from support.strategies import mission


def pairs(_folder: Path) -> Decode:
    """Packed pairs have the sum of their values, also when they are packed again."""
    pairs = Pairs()
    out = np.zeros(1 << 17, dtype=np.uint8)

    def decode(content: bytes) -> bool:
        (packed,) = unframe(content)
        total = sum_pairs(packed, 12)
        found = pairs.decode(packed, 12)
        if found is None:
            assert total < 0
            return False
        index, value = found
        assert ((index >= 0) & (index < 12)).all()
        used = pack_pairs(index, value, index.shape[0], out)
        again = pairs.decode(out[:used].tobytes(), 12)
        assert again is not None
        assert sum(again[1].tolist()) == total or total < 0
        return True

    return decode


def merging(name: str, me: str = "r1") -> Callable[[Path], Decode]:
    """A replica merges a message; a refused one changes nothing."""

    def start(_folder: Path) -> Decode:
        played = corpora.played(name)
        scenario = played.scenario
        if scenario.mapping:
            assert played.setup.ground is not None
            bound, units = entries(played.setup.ground.frame), None
        else:
            bound, units = played.setup.samples_m.shape[0], units_of(scenario, 12)
        replica = build_replica(me, scenario, units, bound)
        registers = replica.registers

        def take(content: bytes) -> bool:
            source, version_vector, logs, claims, written = unframe(content)
            place = source[0] % (3 * len(scenario.roster)) if source else 0
            before = _contents(replica)
            taken = replica.merge(place, version_vector, logs, claims, written)
            if not taken:
                assert _contents(replica) == before, "a refused message has changed something"
                return False
            _check_bounds(replica)
            assert (registers.values.sum(axis=0) == registers.total).all()
            return True

        return take

    return start


def attesting(*overrides: str) -> Callable[[Path], Decode]:
    """r3 receives what r2 brings of r1: whatever it is, nothing false of r1 is believed."""

    def start(_folder: Path) -> Decode:
        one, _ = corpora.attesting(*overrides)
        three = Member("r3", one.scenario, 12, one.units)
        registers = three.replica.registers

        def take(content: bytes) -> bool:
            before = _contents(three.replica)
            taken = not three.hear(Envelope("r2", 1, "", content))
            assert taken or _contents(three.replica) == before, (
                "a refused message changed something"
            )
            held = three.held_log(0)
            assert held == one.log[: len(held)], "entries that r1 has not written"
            assert claim_of(three.replica, 0) in one.claims, "a claim that r1 has not made"
            written = one.registers[int(registers.stamps[0])]
            assert registers.values[0].tolist() == written, "a register that r1 has not written"
            assert 0 not in three.gossip.forked, "an honest origin is blamed"
            return taken

        return take

    return start


def _contents(replica: Replica) -> list[bytes]:
    """The contents of a replica, without the capacity of its arrays."""
    store, registers = replica.store, replica.registers
    arrays = (
        *(store.weights, store.length, store.known, store.sending, store.claims),
        *(store.lowered, store.mark, store.counters),
        *(registers.values, registers.total, registers.stamps),
        *(registers._known, registers._received, registers._updated, registers._sent),
    )
    return [array.tobytes() for array in arrays]


def _check_bounds(replica: Replica) -> None:
    store, config = replica.store, replica.config
    rows, capacity, _ = store.logs.shape
    written = store.length if config.ledger else store.length[config.me : config.me + 1]
    assert (written >= 0).all(), "a log of negative length"
    assert (written <= capacity).all(), "a log longer than its room"
    assert rows == (store.length.shape[0] if config.ledger else 1)
    if store.weights.size:
        assert store.weights.min() >= 0, "a negative weight"
        assert store.counters[2] == np.count_nonzero(store.weights), "weights are not counted"


def registers(_folder: Path) -> Decode:
    """Registers are decoded and merged without a replica; what was merged can be read."""
    scenario = mission(*corpora.SHORT, *corpora.DENSITY["spectral"])
    registers = build_replica("r1", scenario, Units.of(30, 12), 12).registers
    width = registers.values.shape[1]

    def take(content: bytes) -> bool:
        source, written = unframe(content)
        sound = registers.is_well_formed(written, 3)
        if sound:
            registers.merge(source[0] % 3 if source else 0, written, 3)
            assert (registers.values.sum(axis=0) == registers.total).all()
            assert np.abs(registers.values).max() <= NUMBER_MAX
        for origin in range(3):
            found = read_register(written, 3, width, origin)
            assert found is not None or not sound, "a sound register that cannot be read"
        return sound

    return take


def version_vector_lengths(content: bytes) -> bool:
    """The lengths of logs in a version vector."""
    _source, version_vector, *_ = unframe(content)
    lengths = read_version_vector(version_vector, 3)
    assert lengths is None or min(lengths) >= 0
    return lengths is not None


def occupancy_log(_folder: Path) -> Decode:
    """Scans from any pose add entries of cells on the map only."""
    scenario = on_map(*corpora.MAP["burgard"])
    frame = corpora.played("burgard").opening.frame
    assert frame is not None
    evidence = OccupancyLog(frame, scenario.sensor, ranges=True)
    bound = entries(frame)

    def take(content: bytes) -> bool:
        scan, place = unframe(content)
        x_m, y_m, heading_rad = struct.unpack("<3d", place[:24].ljust(24, b"\0"))
        added = evidence.observe(scan, Pose(x_m, y_m, heading_rad), moved=True)
        if added.size:
            assert 0 <= added.min() <= added.max() < bound
        assert evidence.kinds.max() <= OCCUPIED
        assert not evidence._reader._sums.any(), "votes that stay"
        return added.size > 0

    return take
