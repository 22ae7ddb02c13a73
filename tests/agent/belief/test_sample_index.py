"""The sample index: every answer of the bucket grid equals a full scan."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.belief.sample_index import (
    SampleIndex,
    build,
    index_over,
    nearest,
    remove,
    remove_empty,
)
from support.strategies import METRES, Points, crowds, examples, scattered

Answer = list[tuple[float, int]]
"""(squared distance, sample), nearest first."""


FAR_OFF_M = st.sampled_from([0.0, 1e9, 1e13, 1e17, 1e40]).flatmap(
    lambda bound: st.floats(bound / 2.0, bound) | st.floats(-bound, -bound / 2.0)
)
"""From where rounding makes near samples equally far, and ties have to be kept."""


def scan(xy_m: Points, alive: set[int], x: float, y: float, skip: list[int], k: int) -> Answer:
    """The reference: all samples with weight, by (squared distance, index)."""
    answer = []
    for j in sorted(alive - set(skip)):
        dx, dy = float(xy_m[j, 0]) - x, float(xy_m[j, 1]) - y
        answer.append((dx * dx + dy * dy, j))
    return sorted(answer)[:k]


def ask(grid: SampleIndex, x: float, y: float, skip: list[int], k: int) -> Answer:
    """The answer of the grid."""
    best, near = np.zeros(k), np.zeros(k, dtype=np.int64)
    count = nearest(grid, x, y, np.array(skip, dtype=np.int64), best, near)

    assert near[count:].tolist() == [-1] * (k - count)
    return list(zip(best[:count].tolist(), near[:count].tolist(), strict=True))


def weights_of(count: int, dead: set[int]) -> np.ndarray:
    """A weight vector with no weight on the dead."""
    weights = np.ones(count, dtype=np.int64)
    weights[sorted(dead)] = 0
    return weights


def members(grid: SampleIndex) -> list[list[set[int]]]:
    """Of every cell: the samples with weight, and all."""
    leaves = grid.alive[-(grid.first.shape[0] - 1) :]
    cells = []
    for c, alive in enumerate(leaves.tolist()):
        start, end = int(grid.first[c]), int(grid.first[c + 1])
        cells.append(
            [set(grid.order[start : start + alive].tolist()), set(grid.order[start:end].tolist())]
        )
    return cells


def check_pyramid(grid: SampleIndex, alive: set[int]) -> None:
    """Counts add up from the cells to the root, and every sample is where the index says."""
    level_start = 0
    for level in range(grid.levels - 1):
        width = 1 << level
        here = grid.alive[level_start : level_start + width * width].reshape(width, width)
        level_start += width * width
        below = grid.alive[level_start : level_start + 4 * width * width]
        blocks = below.reshape(width, 2, width, 2)
        assert here.tolist() == blocks.sum(axis=(1, 3)).tolist()
    grid.validate(weights_of(grid.xy_m.shape[0], set(range(grid.xy_m.shape[0])) - alive))
    cells = members(grid)

    assert int(grid.alive[0]) == len(alive)
    assert set().union(*(living for living, _ in cells)) == alive
    assert sorted(grid.order.tolist()) == list(range(grid.xy_m.shape[0]))
    assert [j in cells[int(grid.cell[j])][1] for j in range(grid.xy_m.shape[0])] == [True] * len(
        grid.cell
    )


@examples(250)
@given(data=st.data(), xy_m=crowds(), k=st.integers(1, 12))
def test_nearest_equals_a_full_scan(data: st.DataObject, xy_m: Points, k: int) -> None:
    """By (squared distance, index), among samples that have weight and are not to be skipped; for
    scattered points, duplicates, lines, a single place; asked from inside and from far outside.
    """
    count = xy_m.shape[0]
    some = st.sets(st.integers(0, count - 1), max_size=count)
    dead, skip = data.draw(some), sorted(data.draw(some | st.just(set())))
    grid = index_over(xy_m, weights_of(count, dead))
    at = data.draw(st.integers(0, count - 1))
    x, y = data.draw(
        st.tuples(METRES, METRES)
        | st.just((float(xy_m[at, 0]), float(xy_m[at, 1])))
        | st.just((float(xy_m[at, 0]) + 0.5, float(xy_m[at, 1])))
        | st.tuples(FAR_OFF_M, FAR_OFF_M)
    )

    assert ask(grid, x, y, skip, k) == scan(xy_m, set(range(count)) - dead, x, y, skip, k)
    check_pyramid(grid, set(range(count)) - dead)


@pytest.mark.parametrize("count", [1, 2, 9, 100, 3000])
def test_nearest_equals_a_full_scan_until_nothing_is_left(count: int) -> None:
    """While samples are used up one by one from anywhere, every answer stays exact."""
    xy_m = scattered(count)
    grid = index_over(xy_m, weights_of(count, set()))
    alive = set(range(count))
    places_m = scattered(60, seed=2, extent_m=140.0) - 20.0
    for i in range(count):
        j = (i * 7919) % count if count != 7919 else i
        j = j if j in alive else min(alive)
        if i % max(1, count // 60) == 0:
            x, y = map(float, places_m[i % 60])
            assert ask(grid, x, y, [], 5) == scan(xy_m, alive, x, y, [], 5)
        remove(grid, j)
        alive.discard(j)

    assert ask(grid, 50.0, 50.0, [], 5) == []
    assert int(grid.alive[0]) == 0


@examples(60)
@given(xy_m=crowds(), order=st.lists(st.integers(0, 59), max_size=60))
def test_sample_is_removed_once(xy_m: Points, order: list[int]) -> None:
    """Taking out what is out already changes nothing; the counts stay consistent."""
    count = xy_m.shape[0]
    grid = index_over(xy_m, weights_of(count, set()))
    gone: set[int] = set()
    for number in order:
        j = number % count
        remove(grid, j)
        gone.add(j)
        before = [array.tolist() for array in grid[:-1]]
        remove(grid, j)

        assert [array.tolist() for array in grid[:-1]] == before
    check_pyramid(grid, set(range(count)) - gone)


@examples(60)
@given(xy_m=crowds(), dead=st.sets(st.integers(0, 59)), lowered=st.sets(st.integers(0, 59)))
def test_only_emptied_samples_among_the_lowered_are_removed(
    xy_m: Points, dead: set[int], lowered: set[int]
) -> None:
    """A sample whose weight fell but not to 0 stays in the search."""
    count = xy_m.shape[0]
    dead, lowered = ({j % count for j in some} for some in (dead, lowered))
    grid = index_over(xy_m, weights_of(count, set()))
    remove_empty(grid, weights_of(count, dead), np.array(sorted(lowered), dtype=np.int64))

    check_pyramid(grid, set(range(count)) - (dead & lowered))


@examples(100)
@given(
    data=st.data(),
    xy_m=crowds(),
    steps_m=st.lists(st.tuples(METRES, METRES), min_size=1, max_size=60),
    k=st.integers(1, 12),
)
def test_grid_built_again_after_a_move_equals_a_new_one(
    data: st.DataObject, xy_m: Points, steps_m: list[tuple[float, float]], k: int
) -> None:
    """Samples that walk, also out of the first frame: the same answers as a grid over the new
    places (eq. 14).
    """
    count = xy_m.shape[0]
    dead = {j % count for j in data.draw(st.sets(st.integers(0, 59)))}
    weights = weights_of(count, dead)
    xy_m = xy_m.copy()
    grid = index_over(xy_m, weights_of(count, set()))
    xy_m += [steps_m[j % len(steps_m)] for j in range(count)]
    build(grid, weights)
    fresh = index_over(xy_m.copy(), weights)
    x, y = data.draw(st.tuples(METRES, METRES))

    assert ask(grid, x, y, [], k) == ask(fresh, x, y, [], k)
    assert ask(grid, x, y, [], k) == scan(xy_m, set(range(count)) - dead, x, y, [], k)
    check_pyramid(grid, set(range(count)) - dead)


@pytest.mark.parametrize("stride_m", [1.0, 50.0, 500.0, 5000.0])
def test_samples_may_walk_far_out_of_the_first_frame(stride_m: float) -> None:
    """The grid keeps its frame; samples beyond it belong to the cells at its border."""
    count = 300
    xy_m = scattered(count)
    grid = index_over(xy_m, weights_of(count, set()))
    steps_m = 2.0 * scattered(count, seed=2, extent_m=stride_m) - stride_m
    for walked in range(4):
        xy_m += np.roll(steps_m, walked, axis=0)
        build(grid, weights_of(count, set()))
        places_m = 6.0 * scattered(60, seed=3, extent_m=stride_m + 50.0) - 3.0 * stride_m
        for x, y in places_m.tolist():
            expected = scan(xy_m, set(range(count)), x, y, [], 4)

            assert ask(grid, x, y, [], 4) == expected


@pytest.mark.parametrize("far_m", [1e9, 1e13, 1e17, 1e40])
def test_from_far_off_equally_far_samples_come_by_index(far_m: float) -> None:
    """Where distances round to the same number, the lower index is nearer, in whatever cell."""
    xy_m = scattered(200)
    grid = index_over(xy_m, weights_of(200, set()))
    for x, y in ((far_m, 0.0), (-far_m, far_m), (50.0, -far_m), (far_m, far_m)):
        expected = scan(xy_m, set(range(200)), x, y, [], 7)

        assert ask(grid, x, y, [], 7) == expected


def test_ties_go_to_the_lower_index() -> None:
    """Four samples at the same distance, two of them in the same place."""
    xy_m = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, 1.0], [5.0, 5.0]])
    grid = index_over(xy_m, weights_of(5, set()))

    assert ask(grid, 0.0, 0.0, [], 3) == [(1.0, 0), (1.0, 1), (1.0, 2)]
    assert ask(grid, 0.0, 0.0, [1], 3) == [(1.0, 0), (1.0, 2), (1.0, 3)]


@examples(100)
@given(
    xy_m=crowds(),
    x=st.floats(allow_nan=False, allow_infinity=False),
    y=st.floats(allow_nan=False, allow_infinity=False),
)
def test_search_from_anywhere_comes_to_an_end(xy_m: Points, x: float, y: float) -> None:
    """Total: a query from the end of the number line, where squares overflow, finds samples once
    each or none.
    """
    grid = index_over(xy_m, weights_of(xy_m.shape[0], set()))
    near = np.zeros(4, dtype=np.int64)
    count = nearest(grid, x, y, np.zeros(0, dtype=np.int64), np.zeros(4), near)
    found = near[:count].tolist()

    assert len(set(found)) == len(found)
    assert all(0 <= j < xy_m.shape[0] for j in found)
    assert all(-1 <= j < xy_m.shape[0] for j in near.tolist())
