"""Maps of Nav2's map_server: the YAML file, the image that it names, and the class of each pixel.

The rules are those of `loadMapFromFile` in nav2_map_server. Warnings are about contents that Nav2 reads in the same
way, but that are rarely intended.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from kantor_protocol.base.grid import FREE, OCCUPIED, UNKNOWN
from kantor_protocol.files.reading import UnreadableError, read_text
from kantor_protocol.scenario.errors import ScenarioError
from kantor_worldsim.world.pictures import opacity

if TYPE_CHECKING:
    from PIL.Image import Image
    from yaml import Node

Classes = npt.NDArray[np.uint8]
"""(rows, columns), top row first: UNKNOWN, FREE or OCCUPIED."""

RESOLUTION_MIN_M, RESOLUTION_MAX_M = 1e-3, 1e4
ORIGIN_MAX_M = 1e7
"""Largest coordinate of an origin: float64 places cells exactly enough up to it, also in UTM coordinates."""

_GREY_UNKNOWN = 205
"""Grey that map_saver writes for unknown cells: (255 - 205) / 255 = 0.196 occupied."""
_PLAN_GREYS = (0, _GREY_UNKNOWN, 254, 255)
"""Greys of a plan: occupied, unknown, and free as map_saver and as painters write it."""
_BYTES_MAX = 1 << 16


class Nav2Config(msgspec.Struct, frozen=True):
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


class Picture(NamedTuple):
    """The pixels of an image, top row first."""

    colour: npt.NDArray[np.integer]
    """(rows, columns): sum of the colour channels."""
    channels: int
    white: int
    """The largest value of a channel: 255 or 65535."""
    alpha: npt.NDArray[np.uint8] | None
    """(rows, columns): 255 is opaque."""
    lossy: bool
    """Whether its format changes greys."""


# The YAML file.


def image_of(path: Path, name: str) -> Path:
    """The image that a YAML file names: beside the file, as Nav2 looks for it, or else beside what it is a link to.

    Raises ScenarioError for a link without an image in either place.
    """
    if name.startswith("~/"):
        return Path(name).expanduser()
    beside = path.parent / name
    if not path.is_symlink() or _is_there(beside):
        return beside
    behind = path.resolve().parent / name
    if not _is_there(behind):
        raise ScenarioError(
            f"map.file: {path}: image {beside}: no such file, and none at {behind}, beside what it links to"
        )
    return behind


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that is too long, or a folder that may not be entered
        return False


def image_named_in(path: Path) -> Path | None:
    """The image of a map's YAML file; None if the file cannot be read. Raises nothing."""
    try:
        return image_of(path, read_config(path)[0].image)
    except ScenarioError:
        return None


def read_config(path: Path) -> tuple[Nav2Config, list[str]]:
    """The checked content of the YAML file, and warnings."""
    import yaml  # noqa: PLC0415  only where such a map is used

    place = f"map.file: {path}"
    try:
        tree, found = _first_values(
            yaml.compose(read_text(path, _BYTES_MAX, utf_16=True), yaml.SafeLoader)
        )
        config = msgspec.convert(tree, Nav2Config, strict=False)
    except UnreadableError as error:
        raise ScenarioError(f"{place}: {error.as_no('YAML file')}") from None
    except msgspec.ValidationError as error:
        problem, _, where = str(error).partition(" - at ")
        raise ScenarioError(
            f"{place}: {where.strip('`').removeprefix('$.') or 'the file'}: {problem}; give image, "
            "resolution (m), origin [x, y, yaw], negate, occupied_thresh and free_thresh (0 to 1)"
        ) from None
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise ScenarioError(f"{place}: not a readable YAML file: {error}") from None
    for complaint in _complaints(config):
        raise ScenarioError(f"{place}: {complaint}")
    mode = config.mode.lower()
    return msgspec.structs.replace(config, mode=mode), [f"{place}: {line}" for line in found]


def _first_values(root: "Node | None") -> tuple[dict[str, Any], list[str]]:
    """The keys of a map in a composed YAML file, and warnings about keys that come twice: Nav2 takes the first.

    Nothing is constructed but these values, so that tags, references and numbers in base 60 have no effect.
    """
    if root is None or root.id != "mapping":
        raise ValueError("no keys in it; give image, resolution and the others")
    tree: dict[str, Any] = {}
    found = []
    for key, value in root.value:
        if key.id != "scalar" or key.value not in {*Nav2Config.__struct_fields__, _MERGE}:
            continue
        line = key.start_mark.line + 1
        if key.value == _MERGE:
            raise ValueError(f"line {line}: << merges keys, which Nav2 cannot; write them out")
        if key.value in tree:
            found.append(
                f"line {line}: {key.value} comes twice; the first one counts, as for Nav2; remove one"
            )
        else:
            tree[key.value] = _plain(value)
    return tree, found


_MERGE = "<<"


def _plain(node: "Node", depth: int = 1) -> Any:
    """The value of a YAML node: a scalar, or a list of scalars."""
    if node.id == "sequence":
        return [_plain(item, depth - 1) for item in node.value] if depth else []
    if node.id == "mapping":
        return {}
    text, kind = str(node.value), node.tag.rpartition(":")[2]
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() in {"yes", "true", "on"}
    if kind in {"int", "float"}:
        return _number(text.lower(), int if kind == "int" else float)
    return text


def _number(text: str, kind: type[int] | type[float]) -> float | str:
    """A decimal number; any other text stays one, such as a number in base 60."""
    if text.lstrip("+-") in {".inf", ".nan"}:
        return float(text.replace(".", ""))
    try:
        return kind(text)
    except ValueError:
        return text


def _complaints(config: Nav2Config) -> list[str]:
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


# Pixels.


def pixels(image: "Image") -> Picture:
    """The pixels of a decoded image. Raises ValueError for greys that are no shades."""
    lossy, alpha = image.format == "JPEG", opacity(image)
    if image.mode.startswith("I"):
        grey = np.asarray(image)
        if grey.min() < 0 or grey.max() > 65535:
            raise ValueError("its greys go beyond 16 bits")
        return Picture(grey, 1, 65535, alpha, lossy)
    if image.mode == "F":
        raise ValueError("its greys are no whole numbers; save it with 8 bits")
    if image.mode in ("1", "L") and alpha is None:
        return Picture(np.asarray(image.convert("L")), 1, 255, None, lossy)
    colour = np.asarray(image.convert("RGB" if alpha is None else "RGBA"))[:, :, :3]
    return Picture(colour.sum(axis=2, dtype=np.uint16), 3, 255, alpha, lossy)


def classes_of(picture: Picture, config: Nav2Config) -> Classes:
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
        alpha = picture.alpha.astype(np.int32) * (picture.white // 255)
        levels, channels = levels + alpha, channels + 1
    every = np.arange(channels * picture.white + 1)
    shade = every * (65535 // picture.white) / channels / 65535.0  # in that order, as Nav2 rounds
    rule = _by_percent if config.mode == "raw" else _by_occupancy
    classes: Classes = rule(shade, config)[levels]
    if config.mode == "scale" and picture.alpha is not None:
        classes[picture.alpha < 255] = UNKNOWN
    return classes


def _by_occupancy(shade: npt.NDArray[np.float64], config: Nav2Config) -> Classes:
    occupancy = shade if config.negate else 1.0 - shade
    free, occupied = occupancy < config.free_thresh, occupancy > config.occupied_thresh
    span = config.occupied_thresh - config.free_thresh
    if config.mode == "scale" and span > 0.0:
        percent = np.rint((occupancy - config.free_thresh) / span * 100.0)
        free, occupied = free | (percent == 0.0), occupied | (percent == 100.0)
    return _as_cells(free, occupied)


def _by_percent(shade: npt.NDArray[np.float64], config: Nav2Config) -> Classes:
    percent = np.floor(shade * 255.0 + 0.5)
    free = percent <= np.rint(config.free_thresh * 100.0)
    occupied = (percent >= np.rint(config.occupied_thresh * 100.0)) & (percent <= 100.0)
    return _as_cells(free, occupied & ~free)


def _as_cells(free: npt.NDArray[np.bool_], occupied: npt.NDArray[np.bool_]) -> Classes:
    return np.where(occupied, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8)


def likely_mistakes(
    place: str, picture: Picture, config: Nav2Config, classes: Classes
) -> list[str]:
    """Warnings of contents that Nav2 reads in the same way, but that are rarely intended."""
    if config.mode != "trinary":
        return []
    found = [
        *_of_unknown_grey(picture, config, classes),
        *_of_transparency(picture, config, classes),
        *_of_lossy_greys(picture),
    ]
    return [f"{place}: {line}" for line in found]


def _of_unknown_grey(picture: Picture, config: Nav2Config, classes: Classes) -> list[str]:
    """A line about opaque grey 205 that is not unknown, with a remedy by which it is."""
    grey = picture.colour == _grey_205(picture)
    if picture.alpha is not None:
        grey &= picture.alpha == 255
    taken = classes[grey & (classes != UNKNOWN)]
    if not taken.size:
        return []
    usual = msgspec.structs.replace(config, negate=False, free_thresh=0.196, occupied_thresh=0.65)
    without_alpha = "remove the alpha channel, which trinary mode takes as one more colour"
    thresholds = "give negate: 0, free_thresh: 0.196 and occupied_thresh: 0.65"
    remedy = f"{without_alpha}, and {thresholds}"
    if picture.alpha is None or _is_unknown(picture, usual):
        remedy = thresholds
    elif _is_unknown(picture._replace(alpha=None), config):
        remedy = without_alpha
    read_as = "free" if taken[0] == FREE else "occupied"
    return [
        f"{taken.size} pixels of grey 205, which Nav2 writes for unknown, are read as {read_as}; for unknown {remedy}"
    ]


def _is_unknown(picture: Picture, config: Nav2Config) -> bool:
    """Whether an opaque pixel of grey 205 would be unknown in an image of this kind."""
    grey = np.full((1, 1), _grey_205(picture))
    alpha = None if picture.alpha is None else np.full((1, 1), 255, dtype=np.uint8)
    return bool(classes_of(picture._replace(colour=grey, alpha=alpha), config)[0, 0] == UNKNOWN)


def _grey_205(picture: Picture) -> int:
    return _GREY_UNKNOWN * picture.channels * (picture.white // 255)


def _of_transparency(picture: Picture, config: Nav2Config, classes: Classes) -> list[str]:
    """A line about pixels that are not opaque and yet not unknown, with a remedy that leaves the others as they are."""
    if picture.alpha is None:
        return []
    clear = picture.alpha < 255
    if not (clear & (classes != UNKNOWN)).any():
        return []
    masked = classes_of(picture, msgspec.structs.replace(config, mode="scale"))
    remedy = "give mode: scale"
    if (masked != classes)[~clear].any():
        remedy = "paint them grey 205 and remove the alpha channel"
    line = "pixels that are not opaque are read as free or occupied, since trinary mode takes alpha as one more colour"
    return [f"{line}; for unknown {remedy}"]


def _of_lossy_greys(picture: Picture) -> list[str]:
    """A line about greys that a lossy format made of those of a plan."""
    if not picture.lossy:
        return []
    scale = picture.channels * (picture.white // 255)
    greys, counts = np.unique(picture.colour, return_counts=True)
    off = ~np.isin(greys, np.array(_PLAN_GREYS) * scale)
    if greys.size <= len(_PLAN_GREYS) or not off.any():
        return []
    line = f"{counts[off].sum()} pixels have other greys than black, 205 and white, as JPEG makes them at edges"
    return [f"{line}, and may be read as another kind of cell; save the plan as PNG or PGM"]
