"""The random walk of samples and targets (Kabir & Lee, eq. 13-14)."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.random_walk import RandomWalk
from support.references.plain_philox import philox_plain
from support.strategies import SEEDS, examples, scattered

PERIOD_NS = 100_000_000
DIFFUSIONS_M = st.floats(1e-3, 1e3)


def walk(diffusion_m: float, seed: int, purpose: Purpose = Purpose.SAMPLE_WALK) -> RandomWalk:
    """Eight points that walk once a period."""
    return RandomWalk(scattered(8), diffusion_m, PERIOD_NS, seed, purpose)


@examples(50)
@given(seed=SEEDS, diffusion_m=DIFFUSIONS_M)
def test_step_stays_within_the_amplitude(seed: int, diffusion_m: float) -> None:
    """Eq. 13-14: each coordinate moves by v w with w in [-1, 1]."""
    points = RandomWalk(np.zeros((50, 2)), diffusion_m, PERIOD_NS, seed, Purpose.TARGET_WALK)
    points.advance(PERIOD_NS)

    assert bool((np.abs(points.xy_m) <= diffusion_m).all())
    assert len(np.unique(points.xy_m)) == 100


@examples(50)
@given(seed=SEEDS, diffusion_m=DIFFUSIONS_M)
def test_step_is_what_anybody_computes_alone(seed: int, diffusion_m: float) -> None:
    """The draw of point j at step k is Philox at (purpose, 0, k, j): no message is needed."""
    points = walk(diffusion_m, seed)
    points.advance(2 * PERIOD_NS)

    expected = scattered(8)
    for step in (1, 2):
        for j in range(8):
            a, b, c, d = philox_plain(seed, (Purpose.SAMPLE_WALK, 0, step, j))
            for axis, word in ((0, b << 32 | a), (1, d << 32 | c)):
                expected[j, axis] += diffusion_m * (2.0 * ((word >> 11) / 2**53) - 1.0)
    assert points.xy_m.tolist() == expected.tolist()


@examples(50)
@given(
    seed=SEEDS,
    stops_ns=st.lists(st.integers(0, 20 * PERIOD_NS), max_size=10),
    end_ns=st.integers(0, 20 * PERIOD_NS),
)
def test_two_processes_agree_however_often_they_look(
    seed: int, stops_ns: list[int], end_ns: int
) -> None:
    """Where the points are depends on the time alone, not on how the way there was split."""
    often, once = walk(7.0, seed), walk(7.0, seed)
    for stop_ns in sorted(stop_ns for stop_ns in stops_ns if stop_ns <= end_ns):
        often.advance(stop_ns)
    often.advance(end_ns)
    once.advance(end_ns)

    assert often.xy_m.tolist() == once.xy_m.tolist()
    assert often.steps == once.steps == end_ns // PERIOD_NS


def test_points_move_once_a_period_and_say_so() -> None:
    """`advance` is true when points moved, and a time that has passed changes nothing."""
    points = walk(7.0, 1)
    times_ns = [0, PERIOD_NS - 1, PERIOD_NS, PERIOD_NS + 1, 3 * PERIOD_NS, 2 * PERIOD_NS]

    assert [points.advance(now_ns) for now_ns in times_ns] == [
        False,
        False,
        True,
        False,
        True,
        False,
    ]


def test_without_diffusion_points_stand() -> None:
    """Time-invariant: v = 0."""
    points = walk(0.0, 1)

    assert not points.advance(1000 * PERIOD_NS)
    assert points.xy_m.tolist() == scattered(8).tolist()


def test_samples_and_targets_do_not_walk_alike() -> None:
    """VI-D: both walk, by draws of their own."""
    samples, targets = walk(7.0, 1), walk(7.0, 1, Purpose.TARGET_WALK)
    samples.advance(PERIOD_NS)
    targets.advance(PERIOD_NS)

    assert samples.xy_m.tolist() != targets.xy_m.tolist()


def test_first_points_are_copied() -> None:
    """A walk does not move the array that it was given."""
    given_m = scattered(8)
    RandomWalk(given_m, 7.0, PERIOD_NS, 1, Purpose.SAMPLE_WALK).advance(10 * PERIOD_NS)

    assert given_m.tolist() == scattered(8).tolist()
