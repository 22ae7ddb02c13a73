"""Generated maps: the properties of each layout, in every size that it accepts."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.grid import CELLS_MAX, FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.scenario.errors import ScenarioError
from kantor_worldsim.world.layouts import LAYOUTS, layout
from kantor_worldsim.world.maps import Cells, parts
from support.strategies import examples

SEEDED = [name for name in LAYOUTS if name != "blank"]


def assert_sound(cells: Cells) -> None:
    """A closed wall, no unknown cell, and one free part."""
    border = np.ones(cells.shape, dtype=bool)
    border[1:-1, 1:-1] = False
    _, sizes = parts(cells)

    assert (cells[border] == OCCUPIED).all()
    assert not (cells == UNKNOWN).any()
    assert sizes.size == 2  # nothing, and the one part


def fits(name: str, columns: int, rows: int, resolution_m: float) -> bool:
    """Whether a layout accepts this size: cells each way, and metres of a cell."""
    if name == "office":
        return resolution_m <= 0.5 and min(columns, rows) >= round(8.0 / resolution_m)
    least, coarsest_m = {"blank": (3, 1e9), "unstructured": (24, 4.0), "cityblock": (36, 2.5)}[name]
    return min(columns, rows) >= least and resolution_m <= coarsest_m


def runs(line: Cells, kind: int) -> list[int]:
    """The lengths of the stretches of one kind."""
    return [len(list(group)) for value, group in itertools.groupby(line.tolist()) if value == kind]


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_a_layout_is_sound_at_its_default_size(name: str) -> None:
    """The papers' sizes: 96 x 96 cells of 1 m, the office 27 x 20 m in cells of 0.2 m."""
    for seed in range(12):
        ground = layout(name, seed=seed)
        office = name == "office"
        assert ground.frame == (
            Frame(0.2, (0.0, 0.0), 100, 135) if office else Frame(1.0, (0.0, 0.0), 96, 96)
        )
        assert ground.cells.dtype == np.uint8
        assert_sound(ground.cells)


@pytest.mark.parametrize("name", SEEDED)
def test_a_layout_is_drawn_by_the_seed(name: str) -> None:
    """The same seed, the same map; another seed, another."""
    assert np.array_equal(layout(name, seed=3).cells, layout(name, seed=3).cells)
    assert not np.array_equal(layout(name, seed=3).cells, layout(name, seed=4).cells)


@examples(80)
@given(
    name=st.sampled_from(list(LAYOUTS)),
    columns=st.integers(1, 240),
    rows=st.integers(1, 240),
    resolution_m=st.sampled_from([0.05, 0.1, 0.2, 0.25, 0.3, 0.5, 0.6, 1.0, 2.0, 2.5, 4.0, 5.0]),
    seed=st.integers(0, 2**63 - 1),
)
def test_a_layout_of_any_size_is_sound_or_refused(
    name: str, columns: int, rows: int, resolution_m: float, seed: int
) -> None:
    """Any size gives a sound map, or one line with the size that the layout needs."""
    size_m = (columns * resolution_m, rows * resolution_m)
    if not fits(name, columns, rows, resolution_m):
        with pytest.raises(ScenarioError, match=r"^map\.size_m: .* needs"):
            layout(name, size_m, resolution_m, seed)
    else:
        ground = layout(name, size_m, resolution_m, seed)
        assert ground.cells.shape == (rows, columns)
        assert_sound(ground.cells)


def test_blank_has_only_the_surrounding_wall() -> None:
    """All inside is free."""
    assert (layout("blank", (5.0, 4.0)).cells[1:-1, 1:-1] == FREE).all()


def test_unstructured_has_obstacles_on_a_fifth_of_the_map() -> None:
    """About a fifth is occupied, by many obstacles of very different sizes."""
    for seed in range(8):
        cells = layout("unstructured", seed=seed).cells
        labels, sizes = parts(np.where(cells == FREE, OCCUPIED, FREE).astype(np.uint8))
        islands = np.delete(sizes, labels[0, 0])[1:]

        assert 0.19 < (cells[1:-1, 1:-1] == OCCUPIED).mean() < 0.30
        assert islands.size > 20
        assert islands.max() > 10 * np.median(islands)


def test_cityblock_has_streets_around_solid_blocks() -> None:
    """Streets run from wall to wall both ways; every block is a filled rectangle off the wall."""
    for seed in range(8):
        cells = layout("cityblock", seed=seed).cells
        inner = cells[1:-1, 1:-1] == FREE
        labels, sizes = parts(np.where(cells == FREE, OCCUPIED, FREE).astype(np.uint8))

        assert len(runs(inner.all(axis=1).astype(np.uint8), 1)) == 6
        assert all(4 <= width <= 8 for width in runs(inner.all(axis=1).astype(np.uint8), 1))
        assert 15 <= sizes.size - 2 <= 25
        for block in set(range(1, sizes.size)) - {int(labels[0, 0])}:
            rows, columns = np.nonzero(labels == block)
            area = (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
            assert area == sizes[block]
            assert rows.min() > 1
            assert rows.max() < 94


def test_office_has_corridors_rooms_and_doors() -> None:
    """Two corridors of 1.8 m from wall to wall, about a dozen rooms, doors of 0.8 to 1 m, free space most of it."""
    for seed in range(12):
        cells = layout("office", seed=seed).cells
        corridors = np.flatnonzero((cells[:, 1:-1] == FREE).all(axis=1))
        assert len(corridors) == 18

        closed = cells.copy()
        doors = 0
        for row in (corridors[0] - 1, corridors[8] + 1, corridors[9] - 1, corridors[17] + 1):
            for width in runs(cells[row], FREE):
                doors += width in (4, 5)
                assert width in (4, 5, 9) or width > 9  # a door, a crossing, a lounge
            closed[row] = OCCUPIED
        _, sizes = parts(closed)
        rooms = sizes[sizes > 0].size - 3  # without two corridors and the crossing
        assert 11 <= rooms <= 18
        assert doors >= rooms - 1  # without the lounge
        assert 0.75 < (cells == FREE).mean() < 0.95


@pytest.mark.parametrize(
    ("name", "size_m", "resolution_m", "words"),
    [
        ("maze", None, None, "map.layout: 'maze' is unknown; give one of blank"),
        ("blank", (2.0, 9.0), 1.0, "needs 3 each way"),
        ("blank", (0.2, 0.2), 1.0, "needs 3 each way"),
        ("unstructured", (96.0, 10.0), 1.0, "needs 24 each way"),
        ("unstructured", (960.0, 960.0), 5.0, "at most 4 m"),
        ("cityblock", (30.0, 96.0), 1.0, "needs 36 each way"),
        ("office", (27.0, 7.0), 0.2, "needs 8 m each way"),
        ("office", (27.0, 20.0), 1.0, "at most 0.5 m"),
        ("blank", (5000.0, 5000.0), 1.0, f"at most {CELLS_MAX}"),
        ("blank", (1e300, 1e300), 1.0, f"at most {CELLS_MAX}"),
        ("blank", (math.inf, 1.0), 1.0, "above 0"),
        ("blank", (math.nan, 1.0), 1.0, "above 0"),
        ("blank", (-5.0, 5.0), 1.0, "above 0"),
        ("blank", (5.0, 5.0), math.nan, "map.resolution_m"),
        ("blank", (5.0, 5.0), -1.0, "map.resolution_m"),
    ],
)
def test_a_layout_that_cannot_be_generated_is_refused(
    name: str, size_m: tuple[float, float] | None, resolution_m: float | None, words: str
) -> None:
    """One line with the key and the remedy."""
    with pytest.raises(ScenarioError) as caught:
        layout(name, size_m, resolution_m)
    assert words in str(caught.value)
    assert str(caught.value).startswith("map.")
