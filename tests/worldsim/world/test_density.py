"""Samples, targets and starts: draws from the scenario and the seed, and bad files."""

import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.density import samples_of, starts_of, targets_of
from support.strategies import Points, crowds, examples, mission

DOMAIN = ("domain.min_m=[-50.0, 0.0]", "domain.max_m=[50.0, 50.0]", "starts.random=true")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files."""
    return tmp_path_factory.mktemp("densities")


def rows(points: Points) -> list[tuple[float, float]]:
    """Points in an order of their own, to be compared as a bag."""
    return sorted(map(tuple, points.tolist()))


def sampled(path: Path, *overrides: str, seed: int = 1) -> Points:
    """The samples that a file gives."""
    return samples_of(mission(f"samples.file={path}", *overrides), seed)


def from_text(folder: Path, text: str | bytes, *overrides: str) -> Points:
    """The samples that a CSV file with this text gives, all of them."""
    path = folder / "points.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return sampled(path, *overrides, "samples.count=1000")


def npy(array: npt.NDArray[Any], *, pickled: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=pickled)
    return buffer.getvalue()


def npz(array: npt.NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, array)
    return buffer.getvalue()


def png(grey: npt.NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(grey).save(buffer, "PNG")
    return buffer.getvalue()


# Mixtures.


@examples(60)
@given(
    weights=st.lists(st.floats(0.1, 10.0), min_size=1, max_size=5),
    count=st.integers(1, 500),
    seed=st.integers(0, 2**63 - 1),
)
def test_samples_of_each_component_are_its_exact_share(
    weights: list[float], count: int, seed: int
) -> None:
    """Samples are stratified: a component's number is its share, to the next whole sample."""
    components = [
        f"{{mean_m = [{1000.0 * i}, 0.0], variance_m2 = [1.0, 1.0], weight = {weight}}}"
        for i, weight in enumerate(weights)
    ]
    density = f"density=[{', '.join(components)}]"
    points = samples_of(mission(density, f"samples.count={count}"), seed)
    got = np.bincount(np.rint(points[:, 0] / 1000.0).astype(int), minlength=len(weights))
    shares = np.array(weights) / sum(weights) * count

    assert got.sum() == count
    assert np.abs(got - shares).max() < 1.0 + 1e-6


def test_equal_components_have_equally_many_samples() -> None:
    """The paper's samples: exactly N / k in each component."""
    component = "{{mean_m = [{x}, 0.0], variance_m2 = [1.0, 1.0]}}"
    density = ", ".join(component.format(x=1000.0 * i) for i in range(3))
    points = samples_of(mission(f"density=[{density}]", "samples.count=1200"), 1)

    assert np.bincount(np.rint(points[:, 0] / 1000.0).astype(int)).tolist() == [400, 400, 400]


def test_samples_of_a_component_have_its_mean_and_variance() -> None:
    """Diagonal covariance, by the axes."""
    density = "density=[{mean_m = [100.0, -50.0], variance_m2 = [400.0, 25.0]}]"
    points = samples_of(mission(density, "samples.count=20000"), 1)

    assert np.allclose(points.mean(axis=0), [100.0, -50.0], atol=0.6)
    assert np.allclose(points.var(axis=0), [400.0, 25.0], rtol=0.05)


def test_targets_are_independent_draws_of_the_same_density() -> None:
    """Targets come from the mixture, not from the samples, and not in exact shares."""
    component = "{{mean_m = [{x}, 0.0], variance_m2 = [1.0, 1.0]}}"
    density = f"density=[{component.format(x=0.0)}, {component.format(x=1000.0)}]"
    scenario = mission(density, "samples.count=500", "targets.count=500")
    in_first = [int((targets_of(scenario, seed)[:, 0] < 500.0).sum()) for seed in range(8)]

    assert len(set(in_first)) > 1
    assert all(180 < number < 320 for number in in_first)
    assert not set(rows(targets_of(scenario, 1))) & set(rows(samples_of(scenario, 1)))


def test_samples_targets_and_starts_are_drawn_by_the_seed() -> None:
    """The same seed gives the same places; another seed gives others."""
    scenario = mission("targets.count=20", *DOMAIN)
    for draw in (samples_of, targets_of, starts_of):
        assert np.array_equal(draw(scenario, 1), draw(scenario, 1))
        assert not np.array_equal(draw(scenario, 1), draw(scenario, 2))


def test_the_number_of_targets_changes_no_sample() -> None:
    """Samples, targets and starts have draws of their own."""
    few, many = mission("targets.count=1", *DOMAIN), mission("targets.count=99", *DOMAIN)

    assert np.array_equal(samples_of(few, 1), samples_of(many, 1))
    assert np.array_equal(starts_of(few, 1), starts_of(many, 1))


def test_starts_are_given_or_random_in_the_domain() -> None:
    """In the order of the robots; random ones are uniform in the rectangle."""
    crowd = mission("robots.count=900", "energy.points=900", *DOMAIN)
    places = starts_of(crowd, 1)

    assert starts_of(mission(), 1).tolist() == [[10.0, 10.0], [90.0, 20.0], [50.0, 80.0]]
    assert (places >= [-50.0, 0.0]).all()
    assert (places <= [50.0, 50.0]).all()
    assert np.allclose(places.mean(axis=0), [0.0, 25.0], atol=5.0)


def test_a_mission_without_targets_has_an_empty_table() -> None:
    """A mission without targets has an empty table of them."""
    assert targets_of(mission(), 1).shape == (0, 2)


# Files of points.


@pytest.mark.parametrize(
    "text",
    [
        "1.5,2\n-3,4e1\n",
        "1.5,2\n-3,4e1",
        "x,y\n1.5,2\n-3,4e1\n",
        "east in m,north in m\r\n1.5,2\r\n-3,4e1\r\n",
        b"\xef\xbb\xbfx,y\n1.5,2\n-3,4e1\n",
        "# surveyed\n\nx,y\n1.5,2\n\n-3,4e1 # here\n",
        " 1.5 , 2 \n -3 , 4e1 \n",
    ],
    ids=["plain", "no-end", "header", "windows", "mark", "remarks", "blanks"],
)
def test_csv_is_read_with_and_without_a_header(folder: Path, text: str | bytes) -> None:
    """Two columns; a first line without numbers is a header."""
    assert rows(from_text(folder, text)) == [(-3.0, 40.0), (1.5, 2.0)]


@pytest.mark.parametrize("kind", ["<f8", ">f8", "<f4", "<i2", "u1"])
def test_npy_is_read_with_any_type_of_numbers(folder: Path, kind: str) -> None:
    """Any real or whole numbers, in any byte order."""
    path = folder / f"{kind[1:]}.npy"
    path.write_bytes(npy(np.array([[1, 2], [3, 40]], dtype=kind)))

    assert rows(sampled(path, "samples.count=9")) == [(1.0, 2.0), (3.0, 40.0)]


def test_a_subset_of_a_file_is_drawn_by_the_seed(folder: Path) -> None:
    """Fewer than the file holds: a draw without repetition; as many or more: all of them."""
    path = folder / "many.npy"
    points = np.random.default_rng(1).random((200, 2))
    path.write_bytes(npy(points))
    some = sampled(path, "samples.count=50")

    assert np.array_equal(some, sampled(path, "samples.count=50"))
    assert not np.array_equal(some, sampled(path, "samples.count=50", seed=2))
    assert len(set(rows(some))) == 50
    assert set(rows(some)) <= set(rows(points))
    assert rows(sampled(path, "samples.count=200")) == rows(points)
    assert rows(sampled(path, "samples.count=999")) == rows(points)


def test_targets_are_read_from_a_file_of_their_own(folder: Path) -> None:
    """All of them in the file's order, or a seeded subset."""
    path = folder / "targets.csv"
    path.write_text("5,5\n1,1\n3,3\n")

    def targets(*overrides: str) -> list[list[float]]:
        return targets_of(mission(f"targets.file={path}", *overrides), 1).tolist()

    assert targets() == [[5.0, 5.0], [1.0, 1.0], [3.0, 3.0]]
    assert len(targets("targets.count=2")) == 2
    assert targets("targets.count=2") == targets("targets.count=2")


def test_targets_without_a_file_follow_the_density_of_the_samples_file(folder: Path) -> None:
    """Without a file of their own, targets are drawn from the density that the points represent."""
    path = folder / "cluster.npy"
    random = np.random.default_rng(3)
    path.write_bytes(npy(random.normal([100.0, -20.0], [10.0, 5.0], size=(2000, 2))))
    scenario = mission(f"samples.file={path}", "targets.count=4000")
    targets = targets_of(scenario, 1)

    assert np.array_equal(targets, targets_of(scenario, 1))
    assert not set(rows(targets)) & set(rows(sampled(path)))
    assert np.allclose(targets.mean(axis=0), [100.0, -20.0], atol=0.8)
    assert np.allclose(targets.std(axis=0), [10.0, 5.0], rtol=0.1)


@pytest.mark.parametrize(
    ("text", "through"),
    [
        ("7,8\n", (7.0, 8.0)),
        ("7,8\n" * 30, (7.0, 8.0)),
        ("1,5\n-1,-5\n", (1.0, 5.0)),
        ("0,0\n1,1\n2,2\n", (1.0, 1.0)),
    ],
    ids=["one", "identical", "two", "line"],
)
def test_targets_of_points_without_an_area_lie_on_the_points_or_their_line(
    folder: Path, text: str, through: tuple[float, float]
) -> None:
    """One point, identical points, points on a line: targets stand there, or on the line."""
    path = folder / "flat.csv"
    path.write_text(text)
    targets = targets_of(mission(f"samples.file={path}", "targets.count=25"), 1)
    aside_m = targets[:, 0] * through[1] - targets[:, 1] * through[0]

    assert targets.shape == (25, 2)
    assert np.allclose(aside_m, 0.0, atol=1e-6)
    assert np.abs(targets).max() < 20.0


# Images.


@pytest.mark.parametrize(
    ("row", "column", "low", "high"),
    [
        (0, 0, (-50.0, 25.0), (-25.0, 50.0)),
        (0, 3, (25.0, 25.0), (50.0, 50.0)),
        (1, 0, (-50.0, 0.0), (-25.0, 25.0)),
        (1, 2, (0.0, 0.0), (25.0, 25.0)),
    ],
)
def test_a_bright_pixel_lies_at_its_place_in_the_image(
    folder: Path,
    row: int,
    column: int,
    low: tuple[float, float],
    high: tuple[float, float],
) -> None:
    """White is dense; the top row is high y, the left column low x; points fill the pixel."""
    grey = np.zeros((2, 4), dtype=np.uint8)
    grey[row, column] = 255
    path = folder / "map.png"
    path.write_bytes(png(grey))
    scenario = mission(f"samples.file={path}", "samples.count=400", "targets.count=400", *DOMAIN)

    for points in (samples_of(scenario, 1), targets_of(scenario, 1)):
        assert (points >= low).all()
        assert (points <= high).all()
        assert np.allclose(points.mean(axis=0), np.add(low, high) / 2.0, atol=2.0)
    assert not np.array_equal(samples_of(scenario, 1), targets_of(scenario, 1))


def test_density_is_proportional_to_brightness(folder: Path) -> None:
    """A pixel three times as bright holds three times as many."""
    path = folder / "map.png"
    path.write_bytes(png(np.array([[60, 180]], dtype=np.uint8)))
    points = sampled(path, "samples.count=20000", *DOMAIN)

    assert abs(float((points[:, 0] > 0.0).mean()) - 0.75) < 0.02


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "I;16", "F"])
def test_an_image_of_any_mode_is_read(folder: Path, mode: str) -> None:
    """Colour is taken as brightness."""
    path = folder / "map.tif"
    Image.new("L", (4, 3), 255).convert("I" if mode == "I;16" else mode).convert(mode).save(path)

    assert sampled(path, "samples.count=5", *DOMAIN).shape == (5, 2)


@pytest.mark.parametrize("mode", ["LA", "RGBA", "PA"])
def test_a_transparent_pixel_is_empty(folder: Path, mode: str) -> None:
    """A pixel is dense as far as it is white and opaque; opaque ones are as without transparency."""
    grey = np.array([[255, 255], [85, 0]], dtype=np.uint8)
    alpha = np.array([[0, 85], [255, 255]], dtype=np.uint8)
    image = Image.fromarray(np.dstack([grey, alpha]), "LA")
    path = folder / "clear.png"
    image.convert("RGBA" if mode == "PA" else mode).save(path)
    if mode == "PA":
        colours = Image.fromarray(np.array([[1, 2], [3, 0]], dtype=np.uint8), "P")
        colours.putpalette([0, 0, 0, 255, 255, 255, 255, 255, 255, 85, 85, 85])
        colours.save(path, transparency=bytes([255, 0, 85, 255]))
    points = sampled(path, "samples.count=20000", *DOMAIN)
    left, top = points[:, 0] < 0.0, points[:, 1] > 25.0

    assert not (left & top).any()
    assert not (~left & ~top).any()
    assert abs(float((~left & top).mean()) - 0.5) < 0.02


def test_a_wholly_transparent_image_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "clear.png"
    Image.new("RGBA", (3, 3), (255, 255, 255, 0)).save(path)

    with pytest.raises(ScenarioError, match=r"no bright pixel; .* transparent are empty"):
        sampled(path, "samples.count=5", *DOMAIN)


def test_an_image_is_guarded_as_a_map_is(tmp_path: Path) -> None:
    """By its content: no program that draws, no image that is decoded before its size is known."""
    path = tmp_path / "a.png"
    for content, words in (
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EOF\n", "not a readable image"),
        (b"GIF89a" + bytes(40), "not a readable image"),
        (b"P5\n4001 4000\n255\n", "more than 16000000 pixels; scale it down"),
        (b"P5\n99999999 99999999\n255\n", "more than 16000000 pixels; scale it down"),
    ):
        path.write_bytes(content)
        with pytest.raises(ScenarioError, match=words):
            sampled(path, "samples.count=5", *DOMAIN)


# Bad files: one line that names the key and the file.


class _Trap:
    """Unpickled, it would leave a trace."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.trace,)


_HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 2), }"
BAD_FILES: dict[str, tuple[str, bytes | None]] = {
    "missing": ("a.csv", None),
    "missing-npy": ("a.npy", None),
    "missing-image": ("a.png", None),
    "empty": ("a.csv", b""),
    "empty-npy": ("a.npy", b""),
    "empty-image": ("a.png", b""),
    "only-a-header": ("a.csv", b"x,y\n"),
    "only-remarks": ("a.csv", b"# x,y\n# 1,2\n"),
    "text": ("a.csv", b"these are\nno points\n"),
    "text-npy": ("a.npy", b"these are no points, and longer than the head of a file is"),
    "text-image": ("a.png", b"this is no picture"),
    "latin-text": ("a.csv", "lat,l\xe4nge\n1,2\n".encode("latin-1")),
    "wrong-columns": ("a.csv", b"1,2,3\n4,5,6\n"),
    "one-column": ("a.csv", b"1\n2\n"),
    "wrong-columns-npy": ("a.npy", npy(np.zeros((3, 4)))),
    "ragged": ("a.csv", b"1,2\n3\n"),
    "one-dimension-npy": ("a.npy", npy(np.zeros(4))),
    "no-rows-npy": ("a.npy", npy(np.zeros((0, 2)))),
    "complex-npy": ("a.npy", npy(np.zeros((3, 2), dtype=complex))),
    "words-npy": ("a.npy", npy(np.array([["a", "b"]]))),
    "structured-npy": ("a.npy", npy(np.zeros(3, dtype=[("x", "f8"), ("y", "f8")]))),
    "nan-row": ("a.csv", b"1,2\n3,nan\n"),
    "nan-in-the-first-row": ("a.csv", b"nan,2\n3,4\n"),
    "infinite-row-npy": ("a.npy", npy(np.array([[1.0, 2.0], [np.inf, 0.0]]))),
    "cut-npy": ("a.npy", npy(np.zeros((3, 2)))[:-3]),
    "huge-npy": ("a.npy", b"\x93NUMPY\x01\x00\x76\x00" + _HUGE.ljust(117).encode() + b"\n"),
    "archive-npy": ("a.npy", npz(np.zeros((3, 2)))),
    "broken-archive-npy": ("a.npy", b"PK\x03\x04 is the head of an archive"),
    "pickle-npy": ("a.npy", pickle.dumps([[1.0, 2.0]])),
    "black-image": ("a.png", png(np.zeros((4, 4), dtype=np.uint8))),
    "cut-image": ("a.png", png(np.full((64, 64), 9, dtype=np.uint8))[:-30]),
    "no-kind": ("a.txt", b"1,2\n"),
}


@pytest.mark.parametrize("key", ["samples", "targets"])
@pytest.mark.parametrize("name", list(BAD_FILES))
def test_a_bad_file_is_refused_in_one_line(tmp_path: Path, name: str, key: str) -> None:
    """For every defect of a file, one line names the key, the file and the defect."""
    file, content = BAD_FILES[name]
    path = tmp_path / file
    if content is not None:
        path.write_bytes(content)

    def draw(scenario: Scenario) -> Points:
        return samples_of(scenario, 1) if key == "samples" else targets_of(scenario, 1)

    with pytest.raises(ScenarioError) as refusal:
        draw(mission(f"{key}.file={path}", f"{key}.count=3"))
    line = str(refusal.value)

    assert "\n" not in line
    assert f"{key}.file: {path}" in line


def test_a_row_that_is_not_finite_is_named(folder: Path) -> None:
    """The row counts from 1, without the header."""
    with pytest.raises(ScenarioError, match="row 2 is not finite"):
        from_text(folder, "x,y\n1,2\n3,inf\n")


def test_an_object_array_is_never_unpickled(tmp_path: Path) -> None:
    """A file must not run code: an array of objects is refused unread."""
    trace, path = tmp_path / "trace", tmp_path / "trap.npy"
    path.write_bytes(npy(np.array([[_Trap(trace), 1]], dtype=object), pickled=True))
    with pytest.raises(ScenarioError, match="Object arrays cannot be loaded"):
        sampled(path)

    assert not trace.exists()
    np.load(path, allow_pickle=True)
    assert trace.exists()


@examples(200)
@given(
    kind=st.sampled_from(["csv", "npy", "png"]),
    at=st.floats(0.0, 1.0, exclude_max=True),
    junk=st.binary(min_size=1, max_size=8),
)
def test_a_damaged_file_gives_points_or_one_line(
    folder: Path, kind: str, at: float, junk: bytes
) -> None:
    """A damaged file gives finite points or a refusal, and nothing else."""
    sound = {
        "csv": b"x,y\n1.5,2\n3,4\n5,6e3\n",
        "npy": npy(np.arange(12.0).reshape(6, 2)),
        "png": png(np.arange(48, dtype=np.uint8).reshape(6, 8)),
    }[kind]
    place = int(at * len(sound))
    path = folder / f"damaged.{kind}"
    path.write_bytes(sound[:place] + junk + sound[place + len(junk) :])
    points, line = np.zeros((1, 2)), ""
    try:
        points = sampled(path, "samples.count=4")
    except ScenarioError as refusal:
        line = str(refusal)

    assert "\n" not in line
    assert points.shape[1] == 2
    assert np.isfinite(points).all()


# Numbers at the edge.


def test_a_density_without_samples_is_refused() -> None:
    """N = 0 is refused, for every cause."""
    scenario = mission()
    none = msgspec.structs.replace(
        scenario, samples=msgspec.structs.replace(scenario.samples, count=0)
    )
    with pytest.raises(ScenarioError, match=r"samples\.count: no samples at all"):
        samples_of(none, 1)


@pytest.mark.parametrize("text", ["7,8\n", "7,8\n" * 40], ids=["one", "identical"])
def test_points_in_one_place_are_accepted(folder: Path, text: str) -> None:
    """One point, or the same one many times, is a density."""
    points = from_text(folder, text)

    assert set(rows(points)) == {(7.0, 8.0)}
    assert len(points) == text.count("\n")


# The order of samples.


@examples(100)
@given(xy_m=crowds())
def test_sorting_keeps_every_sample(folder: Path, xy_m: Points) -> None:
    """The Morton order is a permutation: no sample is lost, none comes twice."""
    path = folder / "crowd.npy"
    path.write_bytes(npy(xy_m))

    assert rows(sampled(path, f"samples.count={len(xy_m)}")) == rows(xy_m)


def test_samples_lie_along_a_morton_curve(folder: Path) -> None:
    """On a lattice of 2^k the order is the interleaving of the bits of y and x."""
    path = folder / "lattice.npy"
    lattice = [(float(x), float(y)) for x in range(8) for y in range(8)]
    path.write_bytes(npy(np.array(lattice)))

    def interleaved(point: list[float]) -> int:
        x, y = int(point[0]), int(point[1])
        return sum((x >> i & 1) << 2 * i | (y >> i & 1) << 2 * i + 1 for i in range(3))

    codes = [interleaved(point) for point in sampled(path, "samples.count=64").tolist()]

    assert codes == list(range(64))


def test_neighbours_in_the_order_are_neighbours_in_space() -> None:
    """The path along the samples is far shorter than in the order of drawing."""
    points = samples_of(mission("samples.count=2000"), 1)
    shuffled = np.random.default_rng(1).permutation(points)

    def way_m(places: Points) -> float:
        return float(np.hypot(*np.diff(places, axis=0).T).sum())

    assert way_m(points) < 0.15 * way_m(shuffled)


def test_an_array_that_is_larger_than_its_file_is_not_made(tmp_path: Path) -> None:
    """Room is made for what is in a file, not for what its header says."""
    path = tmp_path / "huge.npy"
    content = npy(np.zeros((2, 2)))
    path.write_bytes(content.replace(b"(2, 2), }" + b" " * 9, b"(9999999999, 2), }"))

    with pytest.raises(ScenarioError, match="too short"):
        samples_of(mission(f"samples.file={path}"), 1)


def test_an_image_of_too_many_pixels_is_not_decoded(tmp_path: Path) -> None:
    """A small file may have a large image in it; its size is known before it is decoded."""
    path = tmp_path / "huge.png"
    Image.new("1", (4001, 4000)).save(path)

    with pytest.raises(ScenarioError, match="more than 16000000 pixels"):
        samples_of(mission("samples.count=5", f"samples.file={path}"), 1)
