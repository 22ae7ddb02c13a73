"""True maps from files: each format by its own rules, and bad files."""

import io
import math
import zlib
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageFile
from scipy.ndimage import label

from kantor_protocol.base.grid import CELLS_MAX, FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.scenario.errors import ScenarioError
from kantor_worldsim.world.maps import Cells, Ground, parts, read
from support.strategies import examples

NAV2 = {
    "image": "map.pgm",
    "resolution": "0.05",
    "origin": "[-1.5, 2.0, 0.0]",
    "negate": "0",
    "occupied_thresh": "0.65",
    "free_thresh": "0.196",
}

PGM = b"P5\n# by hand\n3 2\n255\n" + bytes([254, 205, 0, 254, 254, 0])

MOVING_AI = "type octile\nheight 3\nwidth 4\nmap\n.G@O\nSTW.\n....\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files."""
    return tmp_path_factory.mktemp("maps")


def nav2(folder: Path, image: bytes | None = PGM, /, **changed: str | None) -> Path:
    """A YAML file with these keys changed (None: left out), and its image."""
    keys = {**NAV2, **changed}
    if image is not None:
        (folder / (keys["image"] or "map.pgm")).write_bytes(image)
    path = folder / "map.yaml"
    path.write_text(
        "".join(f"{key}: {value}\n" for key, value in keys.items() if value is not None)
    )
    return path


def saved(folder: Path, name: str, content: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def encoded(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], kind: str = "PNG") -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind)
    return buffer.getvalue()


def refusal(path: Path, resolution_m: float | None = None) -> str:
    """The error of a bad map, which is one line."""
    with pytest.raises(ScenarioError) as caught:
        read(path, resolution_m)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def ground_of(path: Path) -> Ground:
    """A map that needs no warning."""
    ground, warnings = read(path)
    assert warnings == []
    return ground


# Nav2.


def test_a_map_of_nav2_written_by_hand_is_read(folder: Path) -> None:
    """The image's top row is the highest; white is free, black occupied, 205 unknown."""
    ground = ground_of(nav2(folder))

    assert ground.frame == Frame(0.05, (-1.5, 2.0), 2, 3)
    assert ground.cells.dtype == np.uint8
    assert ground.cells.flags.c_contiguous
    assert ground.cells.tolist() == [[FREE, FREE, OCCUPIED], [FREE, UNKNOWN, OCCUPIED]]


def test_plain_pgm_gives_the_same_map(folder: Path) -> None:
    """P2 and P5 are two ways to write one image."""
    text = b"P2\n3 2\n255\n254 205 0\n254 254 0\n"

    assert ground_of(nav2(folder, text)).cells.tolist() == ground_of(nav2(folder)).cells.tolist()


def by_nav2(
    pixel: Sequence[int], mode: str, occupied: float, free: float, *, negate: bool, opacity: bool
) -> int | None:
    """One pixel as in nav2_map_server/src/map_io.cpp: 0 to 100, or None for unknown."""
    quanta = [257 * value for value in pixel[:3]]
    if mode == "trinary" and opacity:
        quanta.append(257 * pixel[3])
    shade = (sum(quanta) / len(quanta)) / 65535.0
    occ = shade if negate else 1.0 - shade
    if mode == "raw":
        percent = math.floor(shade * 255 + 0.5)
        return percent if percent <= 100 else None
    if mode == "scale" and opacity and pixel[3] != 255:
        return None
    if occupied < occ:
        return 100
    if occ < free:
        return 0
    if mode == "trinary" or occupied == free:
        return None
    return round((occ - free) / (occupied - free) * 100.0)


def as_cell(percent: int | None, mode: str, occupied: float, free: float) -> int:
    """Percentages as map_saver takes them in raw mode; else only the ends are certain."""
    low, high = (round(free * 100), round(occupied * 100)) if mode == "raw" else (0, 100)
    if percent is None or not (percent <= low or percent >= high):
        return UNKNOWN
    return FREE if percent <= low else OCCUPIED


THRESHOLDS = st.one_of(
    st.sampled_from([0.0, 0.196, 0.2, 0.25, 0.5, 0.65, 0.8, 1.0]),
    st.integers(0, 255).map(lambda level: level / 255),
    st.floats(0.0, 1.0).map(lambda share: round(share, 3)),
)


@examples(150)
@given(
    grey=st.lists(st.integers(0, 255), min_size=6, max_size=6),
    mode=st.sampled_from(["trinary", "scale", "raw"]),
    negate=st.booleans(),
    thresholds=st.tuples(THRESHOLDS, THRESHOLDS).map(sorted),
)
def test_a_grey_pixel_is_read_as_by_nav2(
    folder: Path, grey: list[int], mode: str, thresholds: list[float], *, negate: bool
) -> None:
    """Every mode against the loader's own lines, pixel by pixel."""
    free, occupied = thresholds
    pixels = np.array(grey, dtype=np.uint8).reshape(2, 3)
    wanted = [
        as_cell(
            by_nav2([v, v, v], mode, occupied, free, negate=negate, opacity=False),
            *(mode, occupied, free),
        )
        for v in grey
    ]
    path = nav2(
        folder,
        encoded(pixels, "PPM"),
        mode=mode,
        negate=str(int(negate)),
        free_thresh=repr(free),
        occupied_thresh=repr(occupied),
    )
    if FREE not in wanted:
        assert "no free cell" in refusal(path)
    else:
        assert read(path)[0].cells[::-1].ravel().tolist() == wanted


@examples(150)
@given(
    colours=st.lists(
        st.tuples(
            st.integers(0, 255),
            st.integers(0, 255),
            st.integers(0, 255),
            st.sampled_from([0, 1, 128, 254, 255]),
        ),
        min_size=4,
        max_size=4,
    ),
    mode=st.sampled_from(["trinary", "scale", "raw"]),
    opacity=st.booleans(),
    thresholds=st.tuples(THRESHOLDS, THRESHOLDS).map(sorted),
)
def test_a_coloured_pixel_is_read_as_by_nav2(
    folder: Path,
    colours: list[tuple[int, ...]],
    mode: str,
    thresholds: list[float],
    *,
    opacity: bool,
) -> None:
    """Brightness is the mean of the channels; alpha is one of them in trinary mode, a mask in scale mode."""
    free, occupied = thresholds
    pixels = np.array(colours, dtype=np.uint8)[:, : 4 if opacity else 3].reshape(2, 2, -1)
    wanted = [
        as_cell(
            by_nav2(pixel, mode, occupied, free, negate=False, opacity=opacity),
            *(mode, occupied, free),
        )
        for pixel in colours
    ]
    path = nav2(
        folder,
        encoded(pixels),
        image="map.png",
        mode=mode,
        free_thresh=repr(free),
        occupied_thresh=repr(occupied),
    )
    if FREE not in wanted:
        assert "no free cell" in refusal(path)
    else:
        assert read(path)[0].cells[::-1].ravel().tolist() == wanted


def test_opaque_black_is_a_wall_with_an_alpha_channel(folder: Path) -> None:
    """Nav2 takes opacity for brightness: occupied by 0.75 only, which is still above 0.65."""
    grey = np.array([[0, 255]], dtype=np.uint8)
    image = encoded(np.dstack([grey, grey, grey, np.full_like(grey, 255)]))

    assert ground_of(nav2(folder, image, image="map.png")).cells.tolist() == [[OCCUPIED, FREE]]
    strict = nav2(folder, image, image="map.png", occupied_thresh="0.8")
    assert ground_of(strict).cells.tolist() == [[UNKNOWN, FREE]]


def test_a_transparent_pixel_is_unknown_in_scale_mode(folder: Path) -> None:
    """As map_saver writes it; in trinary mode it is not, and that is worth a warning."""
    image = np.array([[[255, 255, 255, 255], [255, 255, 255, 0]]], dtype=np.uint8)
    scale = nav2(folder, encoded(image), image="map.png", mode="scale")
    assert ground_of(scale).cells.tolist() == [[FREE, UNKNOWN]]

    trinary = nav2(folder, encoded(image), image="map.png", free_thresh="0.3")
    ground, (warning,) = read(trinary)
    assert ground.cells.tolist() == [[FREE, FREE]]
    assert "pixels that are not opaque" in warning
    assert "mode: scale" in warning


@pytest.mark.parametrize("kind", ["P", "LA", "1", "CMYK", "I;16"])
def test_an_image_of_any_kind_is_read(folder: Path, kind: str) -> None:
    """Palettes, one bit, 16 bits: white stays free, black occupied."""
    black_and_white = Image.fromarray(np.array([[0, 255], [255, 255]], dtype=np.uint8))
    buffer = io.BytesIO()
    if kind == "I;16":
        deep = np.array([[0, 65535], [65535, 65535]], dtype=np.uint16)
        Image.fromarray(deep).save(buffer, "PNG")
    else:
        black_and_white.convert(kind).save(buffer, "TIFF" if kind == "CMYK" else "PNG")

    path = nav2(folder, buffer.getvalue(), image="map.img")
    assert ground_of(path).cells.tolist() == [[FREE, FREE], [OCCUPIED, FREE]]


def test_grey_of_16_bits_is_not_cut_to_8(folder: Path) -> None:
    """A threshold may lie between two of the 256 levels."""
    deep = np.array([[65535, 52685, 52684, 52429]], dtype=np.uint16)
    path = nav2(folder, encoded(deep), image="map.png", free_thresh="0.19608")
    ground, _ = read(path)

    assert ground.cells.tolist() == [[FREE, FREE, UNKNOWN, UNKNOWN]]


@pytest.mark.parametrize(
    ("free_thresh", "negate", "read_as"),
    [("0.25", "0", "read as free"), ("0.1", "1", "read as occupied"), ("0.196", "0", None)],
)
def test_unknown_grey_that_is_read_as_free_or_occupied_gives_a_warning(
    folder: Path, free_thresh: str, negate: str, read_as: str | None
) -> None:
    """205 is 0.196 occupied: a free_thresh of 0.25, long the default of map_saver, makes it free."""
    image = b"P5 4 1 255 " + bytes([254, 205, 205, 0])
    _, warnings = read(nav2(folder, image, free_thresh=free_thresh, negate=negate))

    if read_as is None:
        assert warnings == []
    else:
        assert len(warnings) == 1
        assert read_as in warnings[0]
        assert "2 pixels" in warnings[0]
        assert "free_thresh: 0.196" in warnings[0]


@pytest.mark.parametrize("value", ["5e-2", "'0.05'", ".05", "0.05 # metres"])
def test_numbers_are_read_as_by_other_yaml_readers(folder: Path, value: str) -> None:
    """PyYAML reads 5e-2 as text; in a map it is a number."""
    assert ground_of(nav2(folder, resolution=value)).frame.resolution_m == 0.05


def test_an_image_may_be_in_another_folder(folder: Path) -> None:
    """In the folder of the YAML file, below it, or anywhere by its full path."""
    (folder / "below").mkdir(exist_ok=True)
    (folder / "below" / "b.pgm").write_bytes(PGM)
    for image in ("below/b.pgm", str(folder / "below" / "b.pgm")):
        assert ground_of(nav2(folder, None, image=image)).cells.shape == (2, 3)


def test_unknown_keys_and_capitals_of_the_mode_are_ignored(folder: Path) -> None:
    """As Nav2, which ignores keys that it does not know and the case of the mode."""
    path = nav2(folder, mode="Trinary", author="somebody", negate="false")

    assert ground_of(path).cells.shape == (2, 3)


def test_the_resolution_of_the_file_is_not_contradicted(folder: Path) -> None:
    """The scenario may repeat it, not contradict it."""
    assert read(nav2(folder), 0.05)[0].frame.resolution_m == 0.05
    assert "leave it out" in refusal(nav2(folder), 0.1)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"image": None}, "`image`"),
        ({"resolution": None}, "`resolution`"),
        ({"origin": None}, "`origin`"),
        ({"negate": None}, "`negate`"),
        ({"occupied_thresh": None}, "`occupied_thresh`"),
        ({"free_thresh": None}, "`free_thresh`"),
        ({"image": "''"}, "image: empty"),
        ({"image": "5"}, "image: Expected `str`"),
        ({"resolution": "fine"}, "resolution: Expected `float`"),
        ({"resolution": "0.0"}, "resolution: Expected `float` >="),
        ({"resolution": "-0.05"}, "resolution: Expected `float` >="),
        ({"resolution": ".nan"}, "resolution: Expected `float` >="),
        ({"resolution": ".inf"}, "resolution: Expected `float` <="),
        ({"resolution": "true"}, "resolution: Expected `float`"),
        ({"origin": "[0, 0]"}, "origin: Expected `array` of length 3"),
        ({"origin": "0"}, "origin: Expected `array`"),
        ({"origin": "[0, .nan, 0]"}, "too far away"),
        ({"origin": "[1.0e+30, 0, 0]"}, "too far away"),
        ({"origin": "[0, 0, 1.57]"}, "yaw of 1.57"),
        ({"origin": "[0, 0, .nan]"}, "yaw"),
        ({"negate": "maybe"}, "negate: Expected"),
        ({"occupied_thresh": "1.5"}, "occupied_thresh: Expected `float` <= 1.0"),
        ({"free_thresh": "-0.1"}, "free_thresh: Expected `float` >= 0.0"),
        ({"free_thresh": ".nan"}, "free_thresh: Expected `float`"),
        ({"free_thresh": "0.7"}, "free_thresh: 0.7 is above occupied_thresh"),
        ({"mode": "binary"}, "give trinary, scale or raw"),
    ],
)
def test_yaml_that_is_no_map_is_refused(
    folder: Path, changed: dict[str, str | None], words: str
) -> None:
    """One line with the file, the key and the remedy."""
    line = refusal(nav2(folder, None, **changed))

    assert line.startswith(f"map.file: {folder}")
    assert words in line


@pytest.mark.parametrize(
    "text",
    ["", "- 1\n", "map", "a: [", "a: b: c", "\x00", "1: 2", "[" * 5000, "&a [*a]", b"\xff\xfe\xff"],
    ids=lambda text: repr(text[:20]),
)
def test_yaml_that_is_no_mapping_is_refused(folder: Path, text: str | bytes) -> None:
    """Every other content is refused in one line."""
    assert str(folder / "bad.yaml") in refusal(saved(folder, "bad.yaml", text))


def test_missing_files_are_refused(folder: Path) -> None:
    """The map, and the image that a map names."""
    for name in ("none.yaml", "none.map", "none.png"):
        assert refusal(folder / name) == f"map.file: {folder / name}: no such file"
    line = refusal(nav2(folder, None, image="none.pgm"))
    assert line == f"map.file: {folder / 'map.yaml'}: image {folder / 'none.pgm'}: no such file"


def test_a_folder_is_refused_as_a_map(folder: Path) -> None:
    """A folder may have any name."""
    for name in ("a.yaml", "a.map", "a.png"):
        (folder / name).mkdir()
        assert "not a readable" in refusal(folder / name)


@pytest.mark.parametrize("name", ["map", "map.txt", "map.world", "map.svg"])
def test_a_file_of_unknown_kind_is_refused(folder: Path, name: str) -> None:
    """The line names the kinds that there are."""
    line = refusal(folder / name)

    assert "unknown kind" in line
    assert ".yaml" in line
    assert ".map" in line


# Plain images.


@pytest.mark.parametrize("kind", ["PNG", "PPM", "BMP", "TIFF", "JPEG"])
def test_a_plain_image_is_read(folder: Path, kind: str) -> None:
    """White is free, black occupied, mid grey unknown, and grey 205 too."""
    suffix = {"PPM": "pgm", "TIFF": "tif", "JPEG": "jpg"}.get(kind, kind.lower())
    grey = np.repeat(np.repeat(np.array([[255, 128], [205, 0]], np.uint8), 8, axis=0), 8, axis=1)
    ground = ground_of(saved(folder, f"plain.{suffix}", encoded(grey, kind)))

    assert ground.frame == Frame(0.05, (0.0, 0.0), 16, 16)
    assert ground.cells[3::8, 3::8].tolist() == [[UNKNOWN, OCCUPIED], [FREE, UNKNOWN]]
    assert read(folder / f"plain.{suffix}", 0.2)[0].frame.resolution_m == 0.2


def test_a_transparent_pixel_is_unknown_in_a_plain_image(folder: Path) -> None:
    """For every colour; an opaque pixel counts by its colour alone."""
    grey = np.array([[255, 0, 255, 0, 205]], dtype=np.uint8)
    alpha = np.array([[255, 255, 254, 0, 255]], dtype=np.uint8)
    ground = ground_of(saved(folder, "clear.png", encoded(np.dstack([grey, grey, grey, alpha]))))

    assert ground.cells.tolist() == [[FREE, OCCUPIED, UNKNOWN, UNKNOWN, UNKNOWN]]


@pytest.mark.parametrize("resolution_m", [0.0, -1.0, math.nan, math.inf, 1e-9])
def test_an_impossible_resolution_is_refused(folder: Path, resolution_m: float) -> None:
    """Refused before anything is read."""
    for name in ("none.png", "none.map"):
        assert "map.resolution_m" in refusal(folder / name, resolution_m)


def test_a_map_without_a_free_cell_is_refused(folder: Path) -> None:
    """A robot cannot stand anywhere."""
    assert "no free cell" in refusal(saved(folder, "black.pgm", b"P5 2 2 255 " + bytes(4)))
    assert "no free cell" in refusal(
        saved(folder, "black.map", "type octile\nheight 1\nwidth 1\nmap\n@\n")
    )


def png_of_size(columns: int, rows: int) -> bytes:
    """A PNG whose header has a size, without pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")
        )

    header = columns.to_bytes(4, "big") + rows.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b""))


@pytest.mark.parametrize("side", [4001, 10_000, 12_000, 20_000, 2_000_000])
def test_an_image_that_is_too_large_is_not_decoded(
    folder: Path, side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The size is in the header; Pillow's own limits are never reached."""
    decoded: list[ImageFile.ImageFile] = []
    monkeypatch.setattr(ImageFile.ImageFile, "load", decoded.append)
    assert f"more than {CELLS_MAX} pixels" in refusal(
        saved(folder, "vast.png", png_of_size(side, side))
    )
    assert f"more than {CELLS_MAX} pixels" in refusal(
        nav2(folder, b"P5 %d %d 255 " % (side, side), image="vast.pgm")
    )
    assert decoded == []


def test_the_largest_map_is_read(folder: Path) -> None:
    """4000 x 4000 cells are read."""
    pixels = np.full((4000, 4000), 255, dtype=np.uint8)
    pixels[0, 3999] = 0
    cells = ground_of(saved(folder, "large.pgm", encoded(pixels, "PPM"))).cells

    assert cells[3999, 3999] == OCCUPIED
    assert int((cells == FREE).sum()) == CELLS_MAX - 1


@pytest.mark.parametrize("kind", ["PNG", "PPM", "BMP", "TIFF", "JPEG"])
def test_a_truncated_image_is_refused(folder: Path, kind: str) -> None:
    """A part of an image is not a map."""
    pixels = np.random.default_rng(1).integers(0, 256, (64, 64), dtype=np.uint8)
    whole = encoded(pixels, kind)
    suffix = {"PPM": "pgm", "TIFF": "tif", "JPEG": "jpg"}.get(kind, kind.lower())

    for length in (len(whole) // 2, 20, 3, 0):
        assert "not a readable image" in refusal(saved(folder, f"half.{suffix}", whole[:length]))


@examples(300)
@given(
    kind=st.sampled_from(["PNG", "PPM", "BMP", "TIFF", "JPEG"]),
    edits=st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), min_size=1, max_size=6),
)
def test_a_mangled_image_is_read_or_refused(
    folder: Path, kind: str, edits: list[tuple[int, int]]
) -> None:
    """No other error and no warning of Pillow's comes out."""
    pixels = np.random.default_rng(1).integers(0, 256, (12, 12), dtype=np.uint8)
    content = bytearray(encoded(pixels, kind))
    for place, value in edits:
        content[place % len(content)] = value
    path = saved(folder, "mangled.png", bytes(content))
    with suppress(ScenarioError):
        ground, _ = read(path)
        assert ground.cells.shape == (ground.frame.rows, ground.frame.columns)
        assert ground.cells.max() <= OCCUPIED


# MovingAI.


def test_a_map_of_moving_ai_written_by_hand_is_read(folder: Path) -> None:
    """The first line is the top row; ., G and S are free; 1 m a cell unless the scenario has another resolution."""
    ground = ground_of(saved(folder, "hand.map", MOVING_AI))

    assert ground.frame == Frame(1.0, (0.0, 0.0), 3, 4)
    assert ground.cells.tolist() == [
        [FREE] * 4,
        [FREE, OCCUPIED, OCCUPIED, FREE],
        [FREE, FREE, OCCUPIED, OCCUPIED],
    ]
    assert read(folder / "hand.map", 0.3)[0].frame.resolution_m == 0.3


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("\n", "\r\n"),
        ("W.\n....\n", "W.\n...."),
        ("height 3\nwidth 4", "width 4\nheight 3"),
        ("....\n", "....\n\n \n"),
    ],
    ids=["windows", "no-end", "order", "blanks"],
)
def test_variants_of_moving_ai_files_are_read(folder: Path, old: str, new: str) -> None:
    """Differences between the benchmark's own files."""
    other = saved(folder, "other.map", MOVING_AI.replace(old, new))
    plain = saved(folder, "plain.map", MOVING_AI)

    assert ground_of(other).cells.tolist() == ground_of(plain).cells.tolist()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("STW.", "STW", "line 6 has 3 cells"),
        ("STW.", "STW..", "line 6 has 5 cells"),
        ("STW.", "SxW.", "line 6 has unknown terrain 'x'"),
        ("STW.\n", "", "2 rows of terrain, but height 3"),
        ("....\n", "....\n....\n", "4 rows of terrain, but height 3"),
        ("....\n", "....\n\n....\n", "5 rows of terrain, but height 3"),
        ("height 3\n", "", "not a MovingAI map"),
        ("map\n", "", "not a MovingAI map"),
        ("height 3", "height three", "whole numbers above 0"),
        ("height 3", "height 0", "whole numbers above 0"),
        ("height 3", "height -3", "whole numbers above 0"),
        ("height 3", "height", "whole numbers above 0"),
        ("height 3\nwidth 4", "height 4001\nwidth 4000", f"at most {CELLS_MAX}"),
        ("height 3", "height 999999999999", "whole numbers"),
        (MOVING_AI, "", "not a MovingAI map"),
        (MOVING_AI, "\x00\xff" * 99, "not a MovingAI map"),
    ],
)
def test_a_bad_map_of_moving_ai_is_refused(folder: Path, old: str, new: str, words: str) -> None:
    """One line with the file, the line and the remedy."""
    line = refusal(saved(folder, "bad.map", MOVING_AI.replace(old, new)))

    assert line.startswith(f"map.file: {folder / 'bad.map'}: ")
    assert words in line


@examples(60)
@given(
    cells=st.lists(st.lists(st.sampled_from(".@"), min_size=5, max_size=5), min_size=1, max_size=9)
)
def test_moving_ai_and_nav2_agree(folder: Path, cells: list[list[str]]) -> None:
    """The same plan in both formats is the same ground but for its frame."""
    cells[0][0] = "."
    rows = ["".join(row) for row in cells]
    text = f"type octile\nheight {len(rows)}\nwidth 5\nmap\n" + "\n".join(rows) + "\n"
    pixels = bytes(254 if cell == "." else 0 for cell in "".join(rows))
    image = b"P5 5 %d 255\n" % len(rows) + pixels

    one, other = ground_of(saved(folder, "one.map", text)), ground_of(nav2(folder, image))
    assert one.cells.tolist() == other.cells.tolist()


# Parts.


def test_parts_do_not_join_at_corners() -> None:
    """A robot does not squeeze between two corners."""
    cells: Cells = np.array([[1, 1, 2, 1], [1, 2, 1, 0], [2, 2, 1, 1]], dtype=np.uint8)
    labels, sizes = parts(cells)

    assert sizes[0] == 0
    assert sorted(sizes[1:]) == [1, 3, 3]
    assert (labels > 0).tolist() == (cells == FREE).tolist()
    for (row, column), (other_row, other_column) in product(np.argwhere(cells == FREE), repeat=2):
        if abs(row - other_row) + abs(column - other_column) == 1:
            assert labels[row, column] == labels[other_row, other_column]


def test_a_map_without_free_cells_has_no_parts() -> None:
    """Without free cells the number of parts is 0."""
    labels, sizes = parts(np.zeros((2, 3), dtype=np.uint8))

    assert sizes.tolist() == [0]
    assert not labels.any()


@pytest.mark.parametrize("seed", range(20))
def test_parts_are_those_of_scipy(seed: int) -> None:
    """Labels are in the order of the lowest cells."""
    draws = np.random.default_rng(seed)
    cells = draws.choice([UNKNOWN, FREE, OCCUPIED], draws.integers(1, 20, 2), p=[0.1, 0.6, 0.3])
    labels, sizes = parts(cells.astype(np.uint8))
    expected, count = label(cells == FREE)
    firsts = np.unique(labels, return_index=True)[1]

    assert labels.max() == count
    assert all(np.unique(expected[labels == part]).size == 1 for part in range(1, count + 1))
    assert np.bincount(labels.ravel())[1:].tolist() == sizes[1:].tolist()
    assert firsts[-count:].tolist() == sorted(firsts[-count:].tolist()) or count == 0
