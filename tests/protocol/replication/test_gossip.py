"""A participant's end of the radio: what is merged, what is counted, what is sent."""

from unittest.mock import patch

import pytest

from kantor_protocol.base.machine import SUPERVISOR, Envelope, Pose
from kantor_protocol.replication.gossip import Gossip, ack_timeout_steps, build_replica
from kantor_protocol.wire.messages import GossipMessage, decode_gossip, encode
from kantor_protocol.wire.weights import Units
from support.strategies import mission

TEAM = mission()
SOUND = encode(
    GossipMessage(version=1, step=1, x_m=0.0, y_m=0.0, version_vector=b"", logs=b"", claims=b"")
)


def heard(*envelopes: Envelope, taken: bool = True) -> tuple[list[int], int]:
    """Which places in the roster r2 learns from, and how many envelopes it refuses."""
    radio, units = Gossip("r2", TEAM), Units.of(30, 12)
    replica = build_replica("r2", TEAM, units, 12)
    places: list[int] = []

    def learn(source: int, *_parts: bytes) -> bool:
        places.append(source)
        return taken

    with patch.object(replica, "merge", learn):
        radio.receive(envelopes, replica)
    return places, radio.refused


def test_messages_are_learned_in_order_of_arrival() -> None:
    """A speaker is known by its place in the roster."""
    first, second = Envelope("r3", 1, "", SOUND), Envelope("r1", 1, "r2", SOUND)

    assert heard(first, second, first) == ([2, 0, 2], 0)


@pytest.mark.parametrize(
    "envelope",
    [
        Envelope("r4", 1, "", SOUND),
        Envelope("", 1, "", SOUND),
        Envelope("r2", 1, "", SOUND),
        Envelope("r1", 1, "", b""),
        Envelope("r1", 1, "", b"\xff"),
        Envelope("r1", 1, "", SOUND[:-1]),
    ],
)
def test_unsound_envelopes_are_counted_and_merged_from_no_origin(envelope: Envelope) -> None:
    """A stranger, the robot itself, noise, a cut message."""
    assert heard(envelope, Envelope("r3", 1, "", SOUND)) == ([2], 1)


def test_what_the_replica_refuses_is_counted() -> None:
    """The door has two leaves: the codec and the replica."""
    assert heard(Envelope("r1", 1, "", SOUND), taken=False) == ([0], 1)


@pytest.mark.parametrize("coordination", ["decentralized", "centralized"])
def test_word_carries_what_the_replica_composes(coordination: str) -> None:
    """An envelope is from the speaker, numbered by its step, and holds its place and its state."""
    scenario = mission(f"coordination={coordination}")
    target = SUPERVISOR if scenario.centralized else ""
    units = Units.of(30, 12)
    envelope = Gossip("r2", scenario).compose(
        build_replica("r2", scenario, units, 12), 7, Pose(1.0, 2.0)
    )
    version_vector, logs, claims = build_replica("r2", scenario, units, 12).compose()

    assert envelope == Envelope("r2", 7, target, envelope.body)
    assert decode_gossip(envelope.body) == GossipMessage(
        1, 7, 1.0, 2.0, version_vector, logs, claims
    )


def test_word_carries_registers_where_the_planner_has_them() -> None:
    """K x K numbers for the spectral planner; the supervisor has the same, to relay."""
    for overrides, width in (((), 0), (("planner=spectral", "planner.modes=4"), 16)):
        scenario = mission("coordination=centralized", *overrides)
        units = Units.of(30, 12)
        for name in scenario.roster:
            held = build_replica(name, scenario, units, 12)
            word = Gossip(name, scenario).compose(held, 1, Pose(1.0, 2.0))

            assert held.registers.values.shape == (4, width)
            assert decode_gossip(word.body).registers == bytes(4 if width else 0)


def test_unsound_registers_are_refused_with_all_that_came_with_them() -> None:
    """A message is taken in whole or not at all, whichever part is broken."""
    units = Units.of(30, 12)
    held = build_replica("r1", mission("planner=spectral", "planner.modes=1"), units, 12)
    logs = bytes([1, 0, 1, 1, 2 * 3, 2])
    register = bytes([0, 1, 0, 1, 1, 1, 2 * 9])

    assert not held.merge(1, bytes(3), logs, b"", register + b"\x80")
    assert not held.merge(1, bytes(3), b"\x80", b"", register)
    assert (held.weights.tolist(), held.registers.total.tolist()) == ([5] * 12, [0])
    assert held.merge(1, bytes(3), logs, b"", register)
    assert (held.weights[3], held.registers.total.tolist()) == (3, [9])


@pytest.mark.parametrize(
    ("name", "overrides", "merges", "relays", "beacons"),
    [
        ("r1", (), "ledger", False, False),
        ("r1", ("radio.beacon=state", "merge=min"), "min", False, True),
        (SUPERVISOR, ("coordination=centralized",), "ledger", True, False),
    ],
)
def test_replica_follows_the_mission(
    *, name: str, overrides: tuple[str, ...], merges: str, relays: bool, beacons: bool
) -> None:
    """Merge rule and beacon are the mission's; only the supervisor forwards at once."""
    config = build_replica(name, mission(*overrides), Units.of(30, 12), 12).config

    assert config.ledger == (merges == "ledger")
    assert (config.relay, config.beacon) == (relays, beacons)
    assert config.value_max == (2 if merges == "ledger" else 5)


@pytest.mark.parametrize(
    ("name", "overrides", "steps"),
    [
        ("r1", (), 2),
        ("r1", ("radio.delay_s=0.05",), 3),
        ("r1", ("radio.delay_s=0.2", "radio.jitter_s=0.1"), 8),
        ("r1", ("clock.spread=0.5",), 3),
        (SUPERVISOR, ("coordination=centralized",), 2),
        (SUPERVISOR, ("coordination=centralized", "clock.order=turn"), 5),
    ],
)
def test_answer_is_due_after_both_ways_and_the_others_next_step(
    name: str, overrides: tuple[str, ...], steps: int
) -> None:
    """The timeout is counted in own steps; the supervisor's are shorter when robots act in turn."""
    assert ack_timeout_steps(name, mission(*overrides)) == steps
