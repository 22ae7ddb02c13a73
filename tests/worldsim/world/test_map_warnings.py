"""Warnings about maps: what is true of the file, with a remedy that helps; and files of another kind of damage."""

import io
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN
from kantor_protocol.scenario.errors import ScenarioError
from kantor_worldsim.world.maps import read
from support.strategies import examples

YAML = {
    "image": "map.png",
    "resolution": "0.05",
    "origin": "[0.0, 0.0, 0.0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}
PLAN = np.repeat(np.repeat(np.array([[254, 205, 0], [254, 0, 205]], np.uint8), 4, 0), 4, 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files."""
    return tmp_path_factory.mktemp("maps")


def text_of(**changed: str) -> str:
    """The YAML file with these keys changed."""
    return "".join(f"{key}: {value}\n" for key, value in {**YAML, **changed}.items())


def encoded(pixels: npt.NDArray[np.uint8], kind: str = "PNG", **options: object) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


def saved(folder: Path, content: bytes, text: str | None = None) -> Path:
    """A map of a YAML file and an image."""
    (folder / "map.png").write_bytes(content)
    (folder / "map.yaml").write_text(text or text_of())
    return folder / "map.yaml"


def with_alpha(grey: npt.NDArray[np.uint8], alpha: int = 255) -> npt.NDArray[np.uint8]:
    return np.dstack([grey, grey, grey, np.full_like(grey, alpha)])


# Grey 205, and alpha.

WITHOUT_ALPHA = "remove the alpha channel, which trinary mode takes as one more colour"
THRESHOLDS = "give negate: 0, free_thresh: 0.196 and occupied_thresh: 0.65"


@pytest.mark.parametrize(
    ("opaque", "changed", "remedy"),
    [
        (True, {}, WITHOUT_ALPHA),
        (True, {"free_thresh": "0.25"}, f"{WITHOUT_ALPHA}, and {THRESHOLDS}"),
        (False, {"free_thresh": "0.25"}, THRESHOLDS),
        (False, {"negate": "1", "free_thresh": "0.1"}, THRESHOLDS),
    ],
)
def test_the_remedy_for_unknown_cells_helps(
    folder: Path, changed: dict[str, str], remedy: str, *, opaque: bool
) -> None:
    """It names what makes them free or occupied; done as it says, they are unknown and no warning is left."""
    pixels = with_alpha(PLAN) if opaque else PLAN
    ground, (warning,) = read(saved(folder, encoded(pixels), text_of(**changed)))
    assert ground.cells[::-1][0, 4] != UNKNOWN
    assert warning.endswith(f"for unknown {remedy}")
    assert "32 pixels of grey 205" in warning

    thresholds = {} if "free_thresh" in remedy else changed
    mended = PLAN if "alpha" in remedy else pixels
    ground, warnings = read(saved(folder, encoded(mended), text_of(**thresholds)))
    assert ground.cells[::-1][0, 4] == UNKNOWN
    assert warnings == []


@pytest.mark.parametrize("grey", [254, 205])
def test_the_remedy_for_transparent_cells_helps(folder: Path, grey: int) -> None:
    """Another mode, unless that would change the other cells; then another paint."""
    pixels = with_alpha(np.array([[254, 0, grey, 254]], np.uint8))
    pixels[0, 3, 3] = 0
    _, warnings = read(saved(folder, encoded(pixels), text_of(free_thresh="0.3")))
    warning = next(line for line in warnings if "not opaque" in line)

    if "mode: scale" in warning:
        mended = read(saved(folder, encoded(pixels), text_of(free_thresh="0.3", mode="scale")))
    else:
        assert warning.endswith("paint them grey 205 and remove the alpha channel")
        pixels[0, 3] = 205
        mended = read(saved(folder, encoded(pixels[:, :, 0])))
    assert mended[0].cells[0, 3] == UNKNOWN
    assert mended[0].cells[0, 0] == FREE


@pytest.mark.parametrize("deep", [False, True])
def test_a_grey_that_stands_for_transparent_is_unknown(folder: Path, *, deep: bool) -> None:
    """PNG can name one grey so, of 8 bits or of 16."""
    grey = np.array([[255, 0, 254]], np.uint8)
    pixels = grey.astype(np.uint16) * 257 if deep else grey
    clear = int(pixels[0, 2])
    path = folder / "clear.png"
    path.write_bytes(encoded(pixels, transparency=clear))  # type: ignore[arg-type]

    assert read(path)[0].cells.tolist() == [[FREE, OCCUPIED, UNKNOWN]]


# JPEG.


def test_a_plan_that_jpeg_has_blurred_is_warned_of(folder: Path) -> None:
    """Whatever the file is called; the same plan as PNG needs no warning."""
    rough = np.kron(PLAN, np.ones((1, 1), np.uint8))[::-1].T.copy()
    path = folder / "blurred.png"
    path.write_bytes(encoded(rough, "JPEG"))
    _, (warning,) = read(path)
    path.write_bytes(encoded(rough))

    assert "other greys than black, 205 and white" in warning
    assert "save the plan as PNG or PGM" in warning
    assert read(path)[1] == []


# Netpbm: a header and pixels that do not fit.


def pgm(columns: int, rows: int, pixels: bytes, end: bytes = b"\n", kind: bytes = b"P5") -> bytes:
    return kind + end + b"%d %d" % (columns, rows) + end + b"255" + end + pixels


@examples(60)
@given(
    size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    more=st.binary(min_size=1, max_size=20).filter(lambda rest: rest.strip() != b""),
)
def test_bytes_beyond_the_pixels_are_warned_of(
    folder: Path, size: tuple[int, int], more: bytes
) -> None:
    """A header with a wrong size, or something that stands before the pixels."""
    columns, rows = size
    path = folder / "shifted.pgm"
    path.write_bytes(pgm(columns, rows, b"\xfe" * (columns * rows) + more))
    _, (warning,) = read(path)
    assert f"{len(more)} bytes more than {columns} x {rows} pixels" in warning

    path.write_bytes(pgm(columns, rows, b"\xfe" * (columns * rows)))
    assert read(path)[1] == []


@pytest.mark.parametrize(
    ("content", "surplus"),
    [
        (pgm(2, 2, b"\xfe\x00\xcd\xfe", b"\r\n"), "1 bytes more"),
        (pgm(2, 2, b"\xfe\x00\xcd\xfe") + b"\n", None),
        (pgm(2, 1, b"\xfe\x00\xcd\xfe"), "2 bytes more"),
        (pgm(2, 2, b"254 0\n205 254\n", kind=b"P2"), None),
        (pgm(2, 2, b"254 0 # ink\n205 254 7\n", kind=b"P2"), "1 values more"),
        (b"P1\n2 2\n0101\n", None),
        (b"P1\n2 2\n01011\n", "1 values more"),
        (b"P4\n9 2\n" + bytes(4), None),
        (b"P4\n9 2\n" + bytes(5), "1 bytes more"),
        (b"P5\n2 2\n65535\n" + b"\xff" * 8, None),
        (b"P5\n2 2\n65535\n" + b"\xff" * 9, "1 bytes more"),
        (b"P6\n2 1\n255\n" + b"\xff" * 6, None),
        (b"P6\n2 1\n255\n" + b"\xff" * 7, "1 bytes more"),
    ],
)
def test_every_kind_of_netpbm_is_measured(
    folder: Path, content: bytes, surplus: str | None
) -> None:
    """Windows' line ends shift by one byte; a line end after the pixels is none of them."""
    path = folder / "kind.pgm"
    path.write_bytes(content)
    warnings = read(path)[1]

    assert [surplus in line for line in warnings if surplus] == [True] * (surplus is not None)
    assert len(warnings) == (surplus is not None)


# The YAML file.


def test_a_key_that_comes_twice_is_warned_of(folder: Path) -> None:
    """The first one counts, as for Nav2, which other readers of YAML do otherwise."""
    ground, (warning,) = read(saved(folder, encoded(PLAN), text_of() + "resolution: 0.1\n"))

    assert ground.frame.resolution_m == 0.05
    assert "line 7: resolution comes twice; the first one counts" in warning


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (text_of(resolution="1:30"), "resolution: Expected `float`, got `str`"),
        (text_of(resolution="!!int 1:30"), "resolution: Expected `float`, got `str`"),
        (text_of(resolution=":".join(["59"] * 10_000)), "resolution: Expected `float`"),
        (text_of(resolution="0x" + "f" * 50_000), "resolution: Expected `float`"),
        (text_of(resolution="9" * 50_000), "resolution: "),
        ("a: &a {image: map.png}\n<<: *a\n", "line 2: << merges keys, which Nav2 cannot"),
        (text_of(image="!!python/object/apply:os.system [x]"), "image: Expected `str`"),
        (text_of(image="&a [*a]"), "image: Expected `str`, got `array`"),
        (text_of(image="!!binary é"), "map.file: "),
        (text_of() + "x: " + "[" * 100 + "]" * 100, "brackets within one another"),
        (text_of() + "x: " + "- " * 5000, "not a readable YAML file"),
        (text_of() + "# " + "x" * 70_000, "at most 65536 are read"),
        ("? [a, b]\n: 1\n", "missing required field"),
    ],
    ids=lambda text: text[-20:],
)
def test_yaml_beyond_what_nav2_reads_is_refused(folder: Path, text: str, words: str) -> None:
    """Numbers in base 60, merges, references, tags and nesting: one line, at once."""
    (folder / "é").write_bytes(b"")
    path = saved(folder, encoded(PLAN), text)
    with pytest.raises(ScenarioError) as caught:
        read(path)

    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_references_that_would_grow_without_bound_are_not_followed(folder: Path) -> None:
    """A billion laughs in a key that no map has are never made."""
    laughs = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 12)
    )

    assert read(saved(folder, encoded(PLAN), laughs + text_of()))[1] == []


def test_a_yaml_file_in_utf_16_is_read(folder: Path) -> None:
    """As YAML allows."""
    path = saved(folder, encoded(PLAN))
    path.write_bytes(text_of().encode("utf-16"))

    assert read(path)[0].frame.resolution_m == 0.05


# Links.


def test_the_image_of_a_link_is_looked_for_beside_the_link_first(tmp_path: Path) -> None:
    """As by Nav2; then beside what it is a link to; a missing one is named in both places."""
    link, shared = tmp_path / "link", tmp_path / "shared"
    for folder in (link, shared):
        folder.mkdir()
    (shared / "map.yaml").write_text(text_of())
    (link / "map.yaml").symlink_to("../shared/map.yaml")
    with pytest.raises(ScenarioError) as caught:
        read(link / "map.yaml")
    assert f"image {link / 'map.png'}: no such file, and none at " in str(caught.value)
    assert str(shared / "map.png") in str(caught.value)

    (shared / "map.png").write_bytes(encoded(PLAN))
    assert read(link / "map.yaml")[0].cells.shape == PLAN.shape
    (link / "map.png").write_bytes(encoded(PLAN[:, :5]))
    assert read(link / "map.yaml")[0].cells.shape == (8, 5)
