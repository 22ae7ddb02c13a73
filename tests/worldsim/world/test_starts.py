"""Starts of robots on a map, and the cells that are observable from them."""

from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.scenario.errors import ScenarioError
from kantor_worldsim.world.layouts import layout
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.starts import observable, spots, starts_on
from support.strategies import examples

OFFICE = layout("office", seed=1)


def plan(text: str) -> Ground:
    """A map drawn with . free, # occupied, ? unknown; top row first; cells of 0.5 m from (10, -4)."""
    rows = text.split()[::-1]
    cells = np.array([["?.#".index(mark) for mark in row] for row in rows], dtype=np.uint8)
    return Ground(Frame(0.5, (10.0, -4.0), *cells.shape), cells)


TWO_ROOMS = plan("""
    #########
    #...#...#
    #...#.?.#
    #...#...#
    #########
""")


def placed(ground: Ground, **changed: Any) -> npt.NDArray[np.float64]:
    """Four random separate starts, with changed arguments."""
    asked: dict[str, Any] = {
        "poses_m": (),
        "random": True,
        "spread": "separate",
        "spots": 0,
        "count": 4,
        "seed": 1,
    }
    return starts_on(ground, **{**asked, **changed})


def cells_of(ground: Ground, starts_m: npt.NDArray[np.float64]) -> list[int]:
    """The cells of starts, which are in the middle of them."""
    cells = [ground.frame.cell_of(x, y) for x, y in starts_m]
    assert [ground.frame.centre_of(cell) for cell in cells] == [tuple(xy) for xy in starts_m]
    return cells


def on_foot(ground: Ground, first: int) -> dict[int, int]:
    """Every cell that can be reached, and in how many steps."""
    rows, columns = ground.cells.shape
    steps, queue = {first: 0}, deque([first])
    while queue:
        row, column = divmod(queue.popleft(), columns)
        for r, c in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            inside = 0 <= r < rows and 0 <= c < columns
            if inside and ground.cells[r, c] == FREE and r * columns + c not in steps:
                steps[r * columns + c] = steps[row * columns + column] + 1
                queue.append(r * columns + c)
    return steps


def largest(ground: Ground) -> set[int]:
    """The cells of the largest part; of equally large ones the one with the lowest cell."""
    free = np.flatnonzero(ground.cells == FREE).tolist()
    found: list[set[int]] = []
    for cell in free:
        if not any(cell in part for part in found):
            found.append(set(on_foot(ground, cell)))
    return max(found, key=len)


GROUNDS = arrays(
    np.uint8,
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
    elements=st.sampled_from([FREE, FREE, FREE, OCCUPIED, UNKNOWN]),
).map(lambda cells: Ground(Frame(0.25, (-3.0, 5.0), *cells.shape), cells))


# Given.


def test_given_starts_are_taken_as_they_are() -> None:
    """Not moved to the middle of a cell."""
    poses_m = ((10.6, -3.1), (11.9, -2.1))

    assert placed(TWO_ROOMS, poses_m=poses_m, random=False, count=2).tolist() == [
        [10.6, -3.1],
        [11.9, -2.1],
    ]


@pytest.mark.parametrize(
    ("pose_m", "words"),
    [
        ((10.2, -3.0), "(10.2, -3) is inside a wall; move it"),
        ((13.2, -2.8), "(13.2, -2.8) is in a cell that the map leaves unknown; move it"),
        (
            (9.9, -3.0),
            "(9.9, -3) is outside the map, which spans (10, -4) to (14.5, -1.5); move it",
        ),
        ((14.5, -3.0), "is outside the map"),
        ((12.6, -3.1), "(12.6, -3.1) cannot be reached from r1's start; move it"),
    ],
)
def test_a_given_start_that_is_not_free_or_not_connected_is_refused(
    pose_m: tuple[float, float], words: str
) -> None:
    """One line with the start that is wrong and the reason."""
    with pytest.raises(ScenarioError) as caught:
        placed(TWO_ROOMS, poses_m=((10.6, -3.1), pose_m), random=False, count=2)
    assert str(caught.value).startswith("starts.poses_m[1]: ")
    assert words in str(caught.value)


def test_given_starts_may_be_in_a_smaller_part() -> None:
    """They need only be in the same part."""
    poses_m = ((13.8, -3.2), (12.8, -2.2))

    assert placed(TWO_ROOMS, poses_m=poses_m, random=False, count=2).shape == (2, 2)


# Drawn.


@examples(100)
@given(
    ground=GROUNDS,
    spread=st.sampled_from(["separate", "together"]),
    kinds=st.integers(0, 5),
    count=st.integers(1, 6),
    seed=st.integers(0, 2**63 - 1),
)
def test_drawn_starts_are_distinct_cells_of_the_largest_part(
    ground: Ground, spread: str, kinds: int, count: int, seed: int
) -> None:
    """With every option of drawing, on any map; or one line with the reason why not."""
    room = len(largest(ground)) if (ground.cells == FREE).any() else 0
    few_spots = spread == "separate" and 0 < kinds < count
    asked = {"spread": spread, "spots": kinds, "count": count, "seed": seed}
    if room < count or room < kinds or few_spots:
        with pytest.raises(ScenarioError, match=r"^(robots.count|starts.spots|map): "):
            placed(ground, **asked)
        return
    starts_m = placed(ground, **asked)
    cells = cells_of(ground, starts_m)
    assert starts_m.dtype == np.float64
    assert starts_m.shape == (count, 2)
    assert len(set(cells)) == count
    assert set(cells) <= largest(ground)
    if spread == "together":
        steps = on_foot(ground, cells[0])
        by_steps = sorted(steps, key=lambda cell: (steps[cell], cell))
        assert [steps[cell] for cell in cells] == [steps[cell] for cell in by_steps[:count]]


def test_drawn_starts_are_drawn_by_the_seed() -> None:
    """The same seed gives the same places; other seeds give others, all over the map."""
    for spread in ("separate", "together"):
        one = placed(OFFICE, spread=spread)
        assert np.array_equal(one, placed(OFFICE, spread=spread))
        assert not np.array_equal(one, placed(OFFICE, spread=spread, seed=2))
    firsts = np.array([placed(OFFICE, spread="together", seed=seed)[0] for seed in range(200)])
    assert np.allclose(firsts.mean(axis=0), [13.5, 10.0], atol=2.0)


def test_a_team_together_starts_side_by_side() -> None:
    """A team fills the cells around its first robot."""
    blank = layout("blank", (21.0, 21.0))
    five = placed(blank, spread="together", count=5, seed=11)

    assert np.abs(five[1:] - five[0]).sum(axis=1).tolist() == [1.0] * 4


def test_a_team_together_starts_on_the_nearest_cells_around_walls() -> None:
    """The nearest on foot, not through the wall."""
    ground = plan("""
        ...#..
        ...#..
        ...#..
        ......
    """)
    cells = cells_of(ground, placed(ground, spread="together", count=21))
    steps = on_foot(ground, cells[0])

    assert [steps[cell] for cell in cells] == sorted(steps.values())


def test_a_team_together_tries_every_spot_once() -> None:
    """15 seeds in a row begin at 15 spots, each the first robot's (KME, V-A)."""
    where = spots(OFFICE, 15).tolist()
    firsts = [
        cells_of(OFFICE, placed(OFFICE, spread="together", spots=15, seed=seed))[0]
        for seed in range(30, 45)
    ]

    assert firsts == where


def test_separate_starts_are_spots_without_replacement() -> None:
    """Each robot has another spot; over the seeds each spot comes to each robot."""
    where = set(spots(OFFICE, 15).tolist())
    seen = set()
    for seed in range(80):
        cells = cells_of(OFFICE, placed(OFFICE, spots=15, count=8, seed=seed))
        assert len(set(cells)) == 8
        seen.add(cells[0])
    assert seen == where
    all_of_them = cells_of(OFFICE, placed(OFFICE, spots=15, count=15))
    assert set(all_of_them) == where


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"count": 10}, "robots.count: 10, but the map has 9 free cells"),
        ({"count": 10, "spread": "together"}, "robots.count: 10, but the map has 9 free cells"),
        ({"count": 4, "spots": 3}, "starts.spots: 3 for 4 robots; give one for each"),
        ({"count": 2, "spots": 10}, "starts.spots: 10, but the map has 9 free cells"),
        (
            {"count": 2, "spots": 10, "spread": "together"},
            "starts.spots: 10, but the map has 9 free cells",
        ),
    ],
)
def test_more_starts_than_free_cells_or_spots_are_refused(
    asked: dict[str, Any], words: str
) -> None:
    """One line with both numbers."""
    with pytest.raises(ScenarioError) as caught:
        placed(TWO_ROOMS, **asked)
    assert words in str(caught.value)


# Spots.


@examples(80)
@given(ground=GROUNDS, count=st.integers(1, 8))
def test_the_next_spot_is_the_farthest(ground: Ground, count: int) -> None:
    """Against a literal farthest-point rule."""
    free = sorted(largest(ground)) if (ground.cells == FREE).any() else []
    if len(free) < count:
        with pytest.raises(ScenarioError):
            spots(ground, count)
        return
    columns = ground.frame.columns

    def squares(one: int, other: int) -> int:
        (a, b), (c, d) = divmod(one, columns), divmod(other, columns)
        return (a - c) ** 2 + (b - d) ** 2

    middle = [sum(divmod(cell, columns)[axis] for cell in free) // len(free) for axis in (0, 1)]
    wanted = [min(free, key=lambda cell: squares(cell, middle[0] * columns + middle[1]))]
    while len(wanted) < count:
        wanted.append(max(free, key=lambda cell: min(squares(cell, one) for one in wanted)))

    assert spots(ground, count).tolist() == wanted


def test_spots_are_spread_over_the_map() -> None:
    """15 spots in a blank map of 96 m are 20 m apart at least."""
    blank = layout("blank")
    places = np.array([blank.frame.centre_of(cell) for cell in spots(blank, 15).tolist()])
    apart = np.linalg.norm(places[:, None] - places[None, :], axis=2)

    assert apart[~np.eye(15, dtype=bool)].min() > 20.0


# Observable cells.


def test_observable_cells_are_the_part_of_the_starts_and_its_walls() -> None:
    """Free cells of the room, the walls next to them without corners, unknown cells like walls."""
    left = observable(TWO_ROOMS, np.array([[10.6, -3.1]]))
    right = observable(TWO_ROOMS, np.array([[13.8, -3.2]]))
    inside = np.zeros((5, 9), dtype=bool)
    inside[1:4, :5] = inside[:, 1:4] = True

    assert left.tolist() == inside.tolist()
    assert right[2, 6]  # the unknown cell
    assert right.sum() == 8 + 1 + 12
    assert (observable(TWO_ROOMS, np.array([[10.6, -3.1], [13.8, -3.2]])) == (left | right)).all()


def test_cells_inside_of_blocks_are_not_observable() -> None:
    """Only the outermost cells of a solid block are observable."""
    city = layout("cityblock", seed=1)
    seen = observable(city, placed(city))
    solid = ~seen & (city.cells == OCCUPIED)

    assert (seen | (city.cells != FREE)).all()
    assert solid.sum() > 0.5 * (city.cells == OCCUPIED).sum()


@examples(80)
@given(ground=GROUNDS, places=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), max_size=3))
def test_observable_cells_are_those_of_the_definition(
    ground: Ground, places: list[tuple[int, int]]
) -> None:
    """Each cell alone; starts that are outside or not free reach nothing."""
    rows, columns = ground.cells.shape
    starts_m = np.array([(-3.0 + 0.25 * c + 0.1, 5.0 + 0.25 * r + 0.1) for r, c in places])
    reached: set[int] = set()
    for r, c in places:
        if r < rows and c < columns and ground.cells[r, c] == FREE:
            reached |= set(on_foot(ground, r * columns + c))
    got = observable(ground, starts_m.reshape(-1, 2))

    for r in range(rows):
        for c in range(columns):
            neighbours = {(r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)}
            near = any(
                0 <= a < rows and 0 <= b < columns and a * columns + b in reached
                for a, b in neighbours
            )
            wanted = near if ground.cells[r, c] != FREE else r * columns + c in reached
            assert got[r, c] == wanted
