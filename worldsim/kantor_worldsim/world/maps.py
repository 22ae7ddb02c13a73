"""True maps from files: Nav2 map_server's YAML, MovingAI's `.map`, and plain images.

Each pixel or character of a file becomes an UNKNOWN, FREE or OCCUPIED cell, row 0 lowest. A `Ground` is
the map on which robots stand, that they hit and that they sense; only world-sim knows it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import (
    CELLS_MAX,
    FREE,
    NOWHERE,
    OCCUPIED,
    UNKNOWN,
    Frame,
    neighbour,
)
from kantor_protocol.base.kernels import kernel
from kantor_protocol.files.reading import UnreadableError, read_text
from kantor_protocol.scenario.errors import ScenarioError
from kantor_worldsim.world.nav2 import (
    RESOLUTION_MAX_M,
    RESOLUTION_MIN_M,
    Nav2Config,
    Picture,
    classes_of,
    image_of,
    likely_mistakes,
    pixels,
    read_config,
)
from kantor_worldsim.world.pictures import decoded

Cells = npt.NDArray[np.uint8]

IMAGE_RESOLUTION_M = 0.05
"""Resolution of an image without a YAML file: the default of Nav2's map_saver and SLAM Toolbox."""

MOVING_AI_RESOLUTION_M = 1.0

_MOVING_AI_BYTES_MAX = 4 * CELLS_MAX


class Ground(NamedTuple):
    """The true map."""

    frame: Frame
    cells: Cells
    """(rows, columns) of UNKNOWN, FREE or OCCUPIED; row 0 is lowest."""


def read(path: str | Path, resolution_m: float | None = None) -> tuple[Ground, list[str]]:
    """The map in a file, by its suffix, and warnings of one line each.

    - `.yaml`, `.yml`: as Nav2's map_server reads it (`nav2.py`). The file has the resolution.
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


# Images.


def _from_yaml(path: Path, resolution_m: float | None) -> tuple[Ground, list[str]]:
    config, found = read_config(path)
    if resolution_m not in (None, config.resolution):
        raise ScenarioError(
            f"map.resolution_m: {resolution_m:g}, but {path} says {config.resolution:g}; leave it out"
        )
    picture, doubts = decoded(image_of(path, config.image), f"map.file: {path}: image", pixels)
    x_m, y_m, _ = config.origin
    ground, mistakes = _ground(f"map.file: {path}", picture, config, (x_m, y_m))
    return ground, [*found, *doubts, *mistakes]


def _from_image(path: Path, resolution_m: float | None) -> tuple[Ground, list[str]]:
    config = Nav2Config(
        image=path.name,
        resolution=resolution_m or IMAGE_RESOLUTION_M,
        origin=(0.0, 0.0, 0.0),
        occupied_thresh=0.65,
        free_thresh=0.196,
        negate=False,
    )
    picture, doubts = decoded(path, "map.file:", pixels)
    ground, mistakes = _ground(
        f"map.file: {path}", picture._replace(alpha=None), config, (0.0, 0.0)
    )
    if picture.alpha is not None:
        ground.cells[picture.alpha[::-1] < 255] = UNKNOWN
    return ground, [*doubts, *mistakes]


def _ground(
    place: str, picture: Picture, config: Nav2Config, origin_m: tuple[float, float]
) -> tuple[Ground, list[str]]:
    classes = classes_of(picture, config)
    rows, columns = classes.shape
    frame = Frame(config.resolution, origin_m, rows, columns)
    return Ground(frame, np.ascontiguousarray(classes[::-1])), likely_mistakes(
        place, picture, config, classes
    )


# MovingAI.

_TERRAIN = np.full(256, 255, dtype=np.uint8)
_TERRAIN[list(b".GS")] = FREE
_TERRAIN[list(b"@OTW")] = OCCUPIED


def _from_moving_ai(path: Path, resolution_m: float | None) -> tuple[Ground, list[str]]:
    """Format: https://movingai.com/benchmarks/formats.html. Its swamp (S) counts as plain ground."""
    place = f"map.file: {path}"
    try:
        lines = read_text(path, _MOVING_AI_BYTES_MAX).encode().split(b"\n")
    except UnreadableError as error:
        raise ScenarioError(f"{place}: {error.as_no('file')}") from None
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


@kernel
def _label(cells: np.ndarray, labels: np.ndarray, stack: np.ndarray, sizes: np.ndarray) -> int:
    """Label the parts of the free cells, in the order of their lowest cells; how many there are.

    cells, labels: (rows, columns), labels 0 before. stack: (cells,) scratch. sizes: room for every part's, from 1.
    """
    rows, columns = cells.shape
    count = 0
    for first in range(rows * columns):
        if (
            cells[first // columns, first % columns] != FREE
            or labels[first // columns, first % columns]
        ):
            continue
        count += 1
        labels[first // columns, first % columns] = count
        stack[0], pending = first, 1
        while pending > 0:
            pending -= 1
            cell = stack[pending]
            sizes[count] += 1
            for side in range(4):
                n = neighbour(cell, side, columns, rows * columns)
                if n == NOWHERE:
                    continue
                row, column = n // columns, n % columns
                if cells[row, column] == FREE and labels[row, column] == 0:
                    labels[row, column] = count
                    stack[pending] = n
                    pending += 1
    return count


def parts(cells: Cells) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """The connected parts of the free cells: regions that a robot crosses without cutting corners.

    cells: (rows, columns). Returns (rows, columns) labels from 1, in the order of the lowest cells, with 0 for cells
    that are not free, and (labels + 1) sizes in cells, 0 for label 0.
    """
    labels = np.zeros(cells.shape, dtype=np.int32)
    sizes = np.zeros(cells.size // 2 + 2, dtype=np.int64)  # parts have a cell between them
    count = _label(np.ascontiguousarray(cells), labels, np.empty(cells.size, dtype=np.int32), sizes)
    return labels, sizes[: count + 1].copy()
