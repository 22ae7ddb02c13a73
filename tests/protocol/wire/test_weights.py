"""Integer mass, and weight vectors that observers rebuild exactly."""

import math
import tracemalloc
import zlib

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.varint import Pairs
from kantor_protocol.wire.weights import Units, Weights, WeightsPublisher, WeightsSubscriber
from support.strategies import examples

Fall = tuple[int, int]
"""(sample, units) by which it falls."""

STEPS = st.lists(
    st.lists(st.tuples(st.integers(0, 9), st.integers(1, 400)), max_size=4), max_size=60
)


def publish(
    steps: list[list[Fall]], every: int, keyframe_every: int, first: int = 1000
) -> list[tuple[bytes, list[int]]]:
    """Every message of ten samples that fall step by step, each with the vector it stands for."""
    weights: Weights = np.full(10, first, dtype=np.int64)
    publisher = WeightsPublisher(weights, every, keyframe_every)
    messages = []
    for step in steps:
        for sample, units in step:
            weights[sample] = max(0, weights[sample] - units)
        fallen = np.array(sorted({sample for sample, _ in step}), dtype=np.int32)
        messages.append((publisher.step(fallen, last=False), weights.tolist()))
    return [(content, vector) for content, vector in messages if content]


def vector_of(subscriber: WeightsSubscriber) -> list[int] | None:
    """What a subscriber has rebuilt."""
    return None if subscriber.weights is None else subscriber.weights.tolist()


def changes(*pairs: Fall) -> bytes:
    """The content of a message of changes."""
    index = np.array([i for i, _ in pairs], dtype=np.int64)
    value = np.array([v for _, v in pairs], dtype=np.int64)
    return Pairs().encode(index, value, len(pairs))


def message(sequence: int, base: int, size: int, content: bytes, version: int = 1) -> bytes:
    """A weights message, written by the independent encoder."""
    packed: bytes = msgpack.packb([20, version, sequence, base, size, content])
    return packed


def keyframe(*values: int, kind: str = "<u1") -> bytes:
    """The content of a keyframe."""
    return zlib.compress(np.array(values, dtype=kind).tobytes())


@pytest.mark.parametrize(
    ("points", "samples", "units"),
    [
        (5000, 2000, Units(whole=10_000, sample=5, point=2)),
        (2000, 1200, Units(whole=6_000, sample=5, point=3)),
        (2000, 1000, Units(whole=2_000, sample=2, point=1)),
    ],
)
def test_units_of_the_papers_missions(points: int, samples: int, units: Units) -> None:
    """VI-A, VI-C and VI-D: n_0 = 1/N and m = 1/M in units of 1/lcm(M, N)."""
    assert Units.of(points, samples) == units


@examples(100)
@given(points=st.integers(1, 2_000_000_000), samples=st.integers(1, 50_000_000))
def test_units_are_exact_and_as_large_as_they_can_be(points: int, samples: int) -> None:
    """M points ship all that N samples hold, to the unit; no larger unit would do."""
    units = Units.of(points, samples)

    assert units.sample * samples == units.point * points == units.whole
    assert math.gcd(units.sample, units.point) == 1


@examples(100)
@given(
    steps=STEPS,
    every=st.integers(1, 7),
    keyframe_every=st.integers(1, 7),
    first=st.sampled_from([1, 255, 256, 65_535, 65_536, 2_000_000_000]),
)
def test_subscriber_rebuilds_the_vector_at_every_message(
    steps: list[list[Fall]], every: int, keyframe_every: int, first: int
) -> None:
    """A keyframe or what fell since the message before: the vector is exact either way."""
    subscriber = WeightsSubscriber()
    rebuilt = []
    messages = publish(steps, every, keyframe_every, first)
    for content, _ in messages:
        assert subscriber.apply(content)
        rebuilt.append(vector_of(subscriber))

    assert rebuilt == [vector for _, vector in messages]
    assert len(messages) == -(-len(steps) // every)


def test_last_step_is_published_at_once() -> None:
    """When nothing will fall any more, observers get the final vector without waiting; once."""
    weights = np.full(3, 9, dtype=np.int64)
    publisher, subscriber = WeightsPublisher(weights, 10, 20), WeightsSubscriber()
    nothing = np.zeros(0, dtype=np.int32)
    subscriber.apply(publisher.step(nothing, last=False))
    weights[1] = 4

    assert publisher.step(np.array([1], dtype=np.int32), last=False) == b""
    assert subscriber.apply(publisher.step(nothing, last=True))
    assert vector_of(subscriber) == [9, 4, 9]
    assert publisher.step(nothing, last=True) == b""


@examples(100)
@given(steps=STEPS, keyframe_every=st.integers(2, 6), lost=st.integers(0, 60))
def test_gap_is_noticed_and_ends_with_the_next_keyframe(
    steps: list[list[Fall]], keyframe_every: int, lost: int
) -> None:
    """After a lost message the vector is unknown, not wrong, until a keyframe comes."""
    subscriber = WeightsSubscriber()
    expected, rebuilt = [], []
    gap = True
    for i, (content, vector) in enumerate(publish(steps, 1, keyframe_every)):
        if i == lost:
            gap = True
            continue
        gap = gap and i % keyframe_every != 0
        expected.append((not gap, None if gap else vector))
        rebuilt.append((subscriber.apply(content), vector_of(subscriber)))

    assert rebuilt == expected


def test_repeated_change_is_refused() -> None:
    """A change applies to one version only; applied to another it is not taken."""
    subscriber = WeightsSubscriber()
    taken = [
        subscriber.apply(payload)
        for payload in (
            message(1, 0, 2, keyframe(9, 9)),
            message(2, 1, 2, changes((0, 5))),
            message(2, 1, 2, changes((0, 5))),
            message(3, 0, 2, keyframe(5, 9)),
        )
    ]

    assert taken == [True, True, False, True]
    assert vector_of(subscriber) == [5, 9]


UNSOUND = {
    "nothing": b"",
    "no-message": b"\xc0",
    "another-kind": msgpack.packb([1, 1, 2, 1, 3, b""]),
    "another-version": message(2, 1, 3, b"", version=2),
    "no-samples": message(2, 0, 0, zlib.compress(b"")),
    "too-many-samples": message(2, 0, 50_000_001, keyframe(1)),
    "keyframe-not-compressed": message(2, 0, 3, b"\x01\x02\x03"),
    "keyframe-too-short": message(2, 0, 3, keyframe(1, 2)),
    "keyframe-too-long": message(2, 0, 3, keyframe(*range(13))),
    "keyframe-of-no-size": message(2, 0, 3, keyframe(*range(9))),
    "change-outside": message(2, 1, 3, changes((3, 1))),
    "change-cut": message(2, 1, 3, changes((1, 1))[:-1]),
    "change-that-rises": message(2, 1, 3, changes((1, 201))),
    "change-of-another-size": message(2, 1, 4, changes((1, 1))),
    "change-from-the-future": message(3, 2, 3, changes((1, 1))),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_unsound_message_is_refused(name: str) -> None:
    """What is malformed or does not follow is refused, and the vector is right or unknown."""
    subscriber = WeightsSubscriber()
    subscriber.apply(message(1, 0, 3, keyframe(200, 200, 200)))

    assert not subscriber.apply(UNSOUND[name])
    assert vector_of(subscriber) in (None, [200, 200, 200])


def test_bytes_that_are_no_message_leave_the_vector() -> None:
    """Noise on the key is not a gap."""
    subscriber = WeightsSubscriber()
    subscriber.apply(message(1, 0, 3, keyframe(200, 200, 200)))

    assert not subscriber.apply(b"\xff\xff")
    assert subscriber.apply(message(2, 1, 3, changes((1, 199))))
    assert vector_of(subscriber) == [200, 199, 200]


@pytest.mark.parametrize("kind", ["<u1", "<u2", "<u4"])
def test_keyframe_of_every_width_is_read(kind: str) -> None:
    """A keyframe uses the narrowest integers that hold its largest weight."""
    subscriber = WeightsSubscriber()

    assert subscriber.apply(message(1, 0, 3, keyframe(1, 2, 3, kind=kind)))
    assert vector_of(subscriber) == [1, 2, 3]


@examples(200)
@given(payloads=st.lists(st.binary(max_size=60), max_size=4))
def test_any_bytes_are_survived(payloads: list[bytes]) -> None:
    """No payload raises."""
    subscriber = WeightsSubscriber()
    for payload in payloads:
        subscriber.apply(payload)


@examples(200)
@given(
    base=st.integers(0, 2),
    size=st.integers(0, 2**64 - 1) | st.integers(1, 5),
    content=st.binary(max_size=30) | st.binary(max_size=30).map(zlib.compress),
)
def test_any_content_is_survived_and_weights_stay_in_bounds(
    base: int, size: int, content: bytes
) -> None:
    """Whatever a message holds: refused, or a vector of its size without a negative weight."""
    subscriber = WeightsSubscriber()
    subscriber.apply(message(1, 0, 3, keyframe(200, 200, 200)))
    if subscriber.apply(message(2, base, size, content)):
        vector = vector_of(subscriber)

        assert vector is not None
        assert len(vector) == size
        assert min(vector) >= 0


def test_bomb_is_not_inflated() -> None:
    """A keyframe is not inflated beyond what its size allows."""
    subscriber = WeightsSubscriber()

    assert not subscriber.apply(message(1, 0, 3, zlib.compress(bytes(50_000_000))))


def test_no_more_is_inflated_than_there_can_be() -> None:
    """Not even for a moment."""
    subscriber = WeightsSubscriber()
    bomb = message(1, 0, 3, zlib.compress(bytes(50_000_000)))
    tracemalloc.start()
    try:
        assert not subscriber.apply(bomb)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak < 1_000_000


@pytest.mark.parametrize("size", [1, 2, 4, 50_000_000])
def test_a_message_about_another_number_of_samples_is_not_inflated(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who knows the mission knows how many weights there are, before anything is inflated."""
    subscriber = WeightsSubscriber(3)
    assert subscriber.apply(message(1, 0, 3, keyframe(7, 8, 9)))
    monkeypatch.delattr(zlib, "decompressobj")

    assert not subscriber.apply(message(2, 0, size, zlib.compress(bytes(4 * min(size, 99)), 9)))
    assert vector_of(subscriber) == [7, 8, 9]
