"""True maps from files: Nav2 map_server's YAML, MovingAI's `.map`, and plain images.

Each pixel or character of a file becomes an UNKNOWN, FREE or OCCUPIED cell, row 0 lowest. A `Ground` is
the map on which robots stand, that they hit and that they sense; only world-sim knows it.
"""

import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from kantor_protocol.base.grid import CELLS_MAX, FREE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.scenario.errors import ScenarioError

if TYPE_CHECKING:
    from PIL.Image import Image

Cells = npt.NDArray[np.uint8]

IMAGE_RESOLUTION_M = 0.05
"""Resolution of an image without a YAML file: the default of Nav2's map_saver and SLAM Toolbox."""

MOVING_AI_RESOLUTION_M = 1.0

RESOLUTION_MIN_M, RESOLUTION_MAX_M = 1e-3, 1e4
ORIGIN_MAX_M = 1e7
"""Largest coordinate of an origin: float64 places cells exactly enough up to it, also in UTM coordinates."""

_GREY_UNKNOWN = 205
"""Grey that map_saver writes for unknown cells: (255 - 205) / 255 = 0.196 occupied."""

_FORMATS = ("BMP", "JPEG", "PNG", "PPM", "TIFF")
UNREADABLE = (
    *(OSError, ValueError, SyntaxError, EOFError, struct.error, MemoryError),
    *(TypeError, KeyError, IndexError, OverflowError),  # Pillow and numpy on mangled headers
)


class Ground(NamedTuple):
    """The true map."""

    frame: Frame
    cells: Cells
    """(rows, columns) of UNKNOWN, FREE or OCCUPIED; row 0 is lowest."""


def read(path: str | Path, resolution_m: float | None = None) -> tuple[Ground, list[str]]:
    """The map in a file, by its suffix, and warnings of one line each.

    - `.yaml`, `.yml`: as Nav2's map_server reads it (`_classes`). The file has the resolution.
    - `.map`: MovingAI. `.`, `G` and `S` are free, `@`, `O`, `T` and `W` occupied; 1 m a cell.
    - `.png`, `.pgm`, `.jpg`, `.jpeg`, `.bmp`, `.tif`, `.tiff`: less bright than 0.35 is occupied,
      brighter than 0.804 is free, as by the thresholds 0.65 and 0.196 that Nav2 writes. Brightness
      in between is unknown, such as Nav2's grey 205, and so are pixels that are not opaque. 0.05 m a cell.

    resolution_m: the side of a cell, instead of the format's. The lower left corner is at (0, 0)
    unless a YAML file says otherwise. Raises ScenarioError for a map that cannot be read,
    has no free cell, or has more than CELLS_MAX.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ScenarioError(
            f"map.file: {path}: a map of unknown kind '{path.suffix}'; give one of {', '.join(_READERS)}"
        )
    if resolution_m is not None and not RESOLUTION_MIN_M <= resolution_m <= RESOLUTION_MAX_M:
        raise ScenarioError(
            f"map.resolution_m: {resolution_m:g} is no side of a cell; "
            f"give {RESOLUTION_MIN_M:g} to {RESOLUTION_MAX_M:g} m"
        )
    ground, complaints = reader(path, resolution_m)
    if not (ground.cells == FREE).any():
        raise ScenarioError(
            f"map.file: {path}: no free cell, so nowhere to stand; "
            "in an image white is free, unless negated"
        )
    return ground, complaints


# Images, as Nav2's map_server reads them.


class _Nav2Config(msgspec.Struct, frozen=True):
    """Contents of a YAML file of Nav2's map_server. Other keys are ignored, as by map_server."""

    image: str
    resolution: Annotated[float, Meta(ge=RESOLUTION_MIN_M, le=RESOLUTION_MAX_M)]
    """Metres."""
    origin: tuple[float, float, float]
    """x and y of the lower left corner in metres, yaw in radians."""
    occupied_thresh: Annotated[float, Meta(ge=0.0, le=1.0)]
    free_thresh: Annotated[float, Meta(ge=0.0, le=1.0)]
    negate: bool | int
    mode: str = "trinary"


class _Picture(NamedTuple):
    """The pixels of an image, top row first."""

    colour: npt.NDArray[np.integer]
    """(rows, columns): sum of the colour channels."""
    channels: int
    white: int
    """The largest value of a channel: 255 or 65535."""
    alpha: npt.NDArray[np.uint8] | None
    """(rows, columns): 255 is opaque."""


def _from_yaml(path: Path, resolution_m: float | None) -> tuple[Ground, list[str]]:
    config = _read_config(path)
    if resolution_m not in (None, config.resolution):
        raise ScenarioError(
            f"map.resolution_m: {resolution_m:g}, but {path} says {config.resolution:g}; leave it out"
        )
    picture = _picture(path.parent / config.image, f"map.file: {path}: image")
    x_m, y_m, _ = config.origin
    return _ground(f"map.file: {path}", picture, config, (x_m, y_m))


def _from_image(path: Path, resolution_m: float | None) -> tuple[Ground, list[str]]:
    config = _Nav2Config(
        image=path.name,
        resolution=resolution_m or IMAGE_RESOLUTION_M,
        origin=(0.0, 0.0, 0.0),
        occupied_thresh=0.65,
        free_thresh=0.196,
        negate=False,
    )
    picture = _picture(path, "map.file:")
    ground, found = _ground(f"map.file: {path}", picture._replace(alpha=None), config, (0.0, 0.0))
    if picture.alpha is not None:
        ground.cells[picture.alpha[::-1] < 255] = UNKNOWN
    return ground, found


def _ground(
    place: str, picture: _Picture, config: _Nav2Config, origin_m: tuple[float, float]
) -> tuple[Ground, list[str]]:
    classes = _classes(picture, config)
    rows, columns = classes.shape
    frame = Frame(config.resolution, origin_m, rows, columns)
    return Ground(frame, np.ascontiguousarray(classes[::-1])), _likely_mistakes(
        place, picture, config, classes
    )


def _read_config(path: Path) -> _Nav2Config:
    """Read and check the YAML file."""
    import yaml  # noqa: PLC0415  only where such a map is used

    place = f"map.file: {path}"
    try:
        config = msgspec.convert(yaml.safe_load(path.read_bytes()), _Nav2Config, strict=False)
    except FileNotFoundError:
        raise ScenarioError(f"{place}: no such file") from None
    except msgspec.ValidationError as error:
        problem, _, where = str(error).partition(" - at ")
        raise ScenarioError(
            f"{place}: {where.strip('`').removeprefix('$.') or 'the file'}: {problem}; give image, "
            "resolution (m), origin [x, y, yaw], negate, occupied_thresh and free_thresh (0 to 1)"
        ) from None
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise ScenarioError(f"{place}: not a readable YAML file: {error}") from None
    for complaint in _complaints(config):
        raise ScenarioError(f"{place}: {complaint}")
    return msgspec.structs.replace(config, mode=config.mode.lower())


def _complaints(config: _Nav2Config) -> list[str]:
    x_m, y_m, yaw_rad = config.origin
    found = []
    if config.mode.lower() not in ("trinary", "scale", "raw"):
        found.append(f"mode: '{config.mode}' is unknown; give trinary, scale or raw")
    if config.free_thresh > config.occupied_thresh:
        found.append(
            f"free_thresh: {config.free_thresh:g} is above occupied_thresh, {config.occupied_thresh:g}; "
            "Nav2 writes 0.196 and 0.65"
        )
    if not (abs(x_m) <= ORIGIN_MAX_M and abs(y_m) <= ORIGIN_MAX_M):
        found.append(f"origin: ({x_m:g}, {y_m:g}) is too far away; stay within {ORIGIN_MAX_M:g} m")
    if yaw_rad != 0.0:
        found.append(f"origin: a yaw of {yaw_rad:g} is not supported; rotate the image and give 0")
    if not config.image:
        found.append("image: empty; give the file's name")
    return found


def _picture(path: Path, place: str) -> _Picture:
    """Decode an image, unless it has more than CELLS_MAX pixels."""
    from PIL import Image  # noqa: PLC0415  only where an image is used

    too_large = ScenarioError(
        f"{place} {path}: more than {CELLS_MAX} pixels; scale it down, at most 4000 x 4000"
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged metadata, which is not used
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=_FORMATS) as image:
                if image.width * image.height > CELLS_MAX:
                    raise too_large
                return _pixels(image)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise too_large from None
    except FileNotFoundError:
        raise ScenarioError(f"{place} {path}: no such file") from None
    except ScenarioError:
        raise
    except UNREADABLE as error:
        raise ScenarioError(f"{place} {path}: not a readable image: {error}") from None


def _pixels(image: "Image") -> _Picture:
    if image.mode.startswith("I"):
        grey = np.asarray(image)
        if grey.min() < 0 or grey.max() > 65535:
            raise ValueError("its greys go beyond 16 bits")
        return _Picture(grey, 1, 65535, None)
    if image.mode == "F":
        raise ValueError("its greys are no whole numbers; save it with 8 bits")
    if image.has_transparency_data:
        channels = np.asarray(image.convert("RGBA"))
        return _Picture(channels[:, :, :3].sum(axis=2, dtype=np.uint16), 3, 255, channels[:, :, 3])
    if image.mode in ("1", "L"):
        return _Picture(np.asarray(image.convert("L")), 1, 255, None)
    return _Picture(np.asarray(image.convert("RGB")).sum(axis=2, dtype=np.uint16), 3, 255, None)


def _classes(picture: _Picture, config: _Nav2Config) -> Cells:
    """(rows, columns), top row first: the class of each pixel, by `loadMapFromFile` of nav2_map_server.

    In Nav2 brightness is the mean of the channels, in trinary mode with alpha as one of them, and
    occupancy is 1 - brightness, or brightness if negated. trinary: occupied above occupied_thresh,
    free below free_thresh, else unknown. scale: the same, with pixels that are not opaque unknown; the
    percentages that Nav2 spreads between the thresholds are free at 0, occupied at 100, else
    unknown. raw: the value in 0 to 100 is a percentage, which is free or occupied by the thresholds
    as for map_saver; a value above is unknown.
    """
    levels, channels = picture.colour, picture.channels
    if config.mode == "trinary" and picture.alpha is not None:
        levels, channels = levels + picture.alpha, channels + 1
    every = np.arange(channels * picture.white + 1)
    shade = every * (65535 // picture.white) / channels / 65535.0  # in that order, as Nav2 rounds
    rule = _by_percent if config.mode == "raw" else _by_occupancy
    classes: Cells = rule(shade, config)[levels]
    if config.mode == "scale" and picture.alpha is not None:
        classes[picture.alpha < 255] = UNKNOWN
    return classes


def _by_occupancy(shade: npt.NDArray[np.float64], config: _Nav2Config) -> Cells:
    occupancy = shade if config.negate else 1.0 - shade
    free, occupied = occupancy < config.free_thresh, occupancy > config.occupied_thresh
    span = config.occupied_thresh - config.free_thresh
    if config.mode == "scale" and span > 0.0:
        percent = np.rint((occupancy - config.free_thresh) / span * 100.0)
        free, occupied = free | (percent == 0.0), occupied | (percent == 100.0)
    return _as_cells(free, occupied)


def _by_percent(shade: npt.NDArray[np.float64], config: _Nav2Config) -> Cells:
    percent = np.floor(shade * 255.0 + 0.5)
    free = percent <= np.rint(config.free_thresh * 100.0)
    occupied = (percent >= np.rint(config.occupied_thresh * 100.0)) & (percent <= 100.0)
    return _as_cells(free, occupied & ~free)


def _as_cells(free: npt.NDArray[np.bool_], occupied: npt.NDArray[np.bool_]) -> Cells:
    return np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8)


def _likely_mistakes(
    place: str, picture: _Picture, config: _Nav2Config, classes: Cells
) -> list[str]:
    """Warnings of contents that Nav2 reads in the same way, but that are rarely intended."""
    if config.mode != "trinary":
        return []
    found = []
    grey = picture.colour == _GREY_UNKNOWN * picture.channels * (picture.white // 255)
    taken = classes[grey & (classes != UNKNOWN)]
    if taken.size:
        found.append(
            f"{place}: {taken.size} pixels of grey 205, which Nav2 writes for unknown, are read as "
            f"{'free' if taken[0] == FREE else 'occupied'}; for unknown give negate: 0, "
            "free_thresh: 0.196 and occupied_thresh: 0.65"
        )
    if picture.alpha is not None and ((picture.alpha < 255) & (classes != UNKNOWN)).any():
        found.append(
            f"{place}: pixels that are not opaque are read as free or occupied, since trinary mode "
            "takes alpha as one more colour; remove the alpha channel, or give mode: scale"
        )
    return found


# MovingAI.

_TERRAIN = np.full(256, 255, dtype=np.uint8)
_TERRAIN[list(b".GS")] = FREE
_TERRAIN[list(b"@OTW")] = OCCUPIED


def _from_moving_ai(path: Path, resolution_m: float | None) -> tuple[Ground, list[str]]:
    """Format: https://movingai.com/benchmarks/formats.html. Its swamp (S) counts as plain ground."""
    place = f"map.file: {path}"
    try:
        lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        raise ScenarioError(f"{place}: no such file") from None
    except OSError as error:
        raise ScenarioError(f"{place}: not a readable file: {error}") from None
    start, rows, columns = _header(place, lines)
    body = [line.rstrip() for line in lines[start:]]
    while body and not body[-1]:
        body.pop()
    if len(body) != rows:
        raise ScenarioError(f"{place}: {len(body)} rows of terrain, but height {rows}; mend it")
    for number, row in enumerate(body, start + 1):
        if len(row) != columns:
            raise ScenarioError(
                f"{place}: line {number} has {len(row)} cells, but width is {columns}; mend it"
            )
    cells = _TERRAIN[np.frombuffer(b"".join(body), dtype=np.uint8).reshape(rows, columns)]
    bad = np.argwhere(cells == 255)
    if bad.size:
        row, column = bad[0]
        raise ScenarioError(
            f"{place}: line {start + 1 + row} has unknown terrain {chr(body[row][column])!r}; "
            "use . G S for free and @ O T W for occupied"
        )
    frame = Frame(resolution_m or MOVING_AI_RESOLUTION_M, (0.0, 0.0), rows, columns)
    return Ground(frame, np.ascontiguousarray(cells[::-1])), []


def _header(place: str, lines: list[bytes]) -> tuple[int, int, int]:
    """Number of header lines, height and width."""
    fields: dict[bytes, bytes] = {}
    for number, line in enumerate(lines[:10], 1):
        key, _, value = line.strip().partition(b" ")
        if key == b"map" and {b"height", b"width"} <= fields.keys():
            return number, *_size(place, fields[b"height"].strip(), fields[b"width"].strip())
        fields[key] = value
    raise ScenarioError(
        f"{place}: not a MovingAI map; it begins with type octile, height, width and map, a line each"
    )


def _size(place: str, height: bytes, width: bytes) -> tuple[int, int]:
    """Parse and check the numbers of rows and columns."""
    if not all(text.isdigit() and len(text) <= 8 and int(text) for text in (height, width)):
        raise ScenarioError(f"{place}: height and width must be whole numbers above 0; mend them")
    rows, columns = int(height), int(width)
    if rows * columns > CELLS_MAX:
        raise ScenarioError(
            f"{place}: {rows} x {columns} cells; at most {CELLS_MAX}, such as 4000 x 4000"
        )
    return rows, columns


_Reader = Callable[[Path, float | None], tuple[Ground, list[str]]]

_READERS: dict[str, _Reader] = {
    **dict.fromkeys((".yaml", ".yml"), _from_yaml),
    ".map": _from_moving_ai,
    **dict.fromkeys((".png", ".pgm", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"), _from_image),
}


# Parts.


def parts(cells: Cells) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """The connected parts of the free cells: regions that a robot crosses without cutting corners.

    cells: (rows, columns). Returns (rows, columns) labels from 1, with 0 for cells that are not free, and
    (labels + 1) sizes in cells, 0 for label 0.
    """
    from scipy.ndimage import label  # noqa: PLC0415  slow to import, not needed without a map

    labels, count = label(cells == FREE, output=np.int32)  # 4-connected
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    return labels, sizes
