"""The guard of images: size and format are known before anything is decoded.

Maps and densities are read through `decoded`, and through nothing else. Formats that are programs (PostScript) or
that other programs decode are not opened, whatever a file is called.
"""

import re
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import CELLS_MAX
from kantor_protocol.files.reading import UnreadableError, check
from kantor_protocol.scenario.errors import ScenarioError

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFile import ImageFile

FORMATS = ("BMP", "JPEG", "PNG", "PPM", "TIFF")
UNREADABLE = (
    *(OSError, ValueError, SyntaxError, EOFError, struct.error, MemoryError),
    *(TypeError, KeyError, IndexError, OverflowError),  # Pillow and numpy on mangled headers
)
_BYTES_MAX = 16 * CELLS_MAX
"""Four channels of 32 bits; no image of so many pixels is larger."""
_OPAQUE = 255

T = TypeVar("T")


def decoded(path: Path, place: str, take: Callable[["Image"], T]) -> tuple[T, list[str]]:
    """What `take` makes of an image, and warnings about the file of one line each.

    place: begins every message, in front of the path. Raises ScenarioError for an image that cannot be read or has more
    than CELLS_MAX pixels; those are not decoded.
    """
    from PIL import Image  # noqa: PLC0415  only where an image is used

    too_large = ScenarioError(
        f"{place} {path}: more than {CELLS_MAX} pixels; scale it down, at most 4000 x 4000"
    )
    try:
        check(path, _BYTES_MAX)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damaged metadata, which is not used
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=FORMATS) as image:
                if image.width * image.height > CELLS_MAX:
                    raise too_large
                surplus = _surplus(path, image)
                return take(image), [f"{place} {path}: {line}" for line in surplus]
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise too_large from None
    except UnreadableError as error:
        raise ScenarioError(f"{place} {path}: {error.as_no('image')}") from None
    except ScenarioError:
        raise
    except UNREADABLE as error:
        raise ScenarioError(f"{place} {path}: not a readable image: {error}") from None


def opacity(image: "Image") -> npt.NDArray[np.uint8] | None:
    """(rows, columns), top row first: 255 is opaque, 0 transparent; None for an image without transparency."""
    if not image.has_transparency_data:
        return None
    if image.mode.startswith("I"):  # a grey of 16 bits that stands for transparent
        clear = np.asarray(image) == image.info["transparency"]
        return np.where(clear, 0, _OPAQUE).astype(np.uint8)
    return np.asarray(image.convert("RGBA"))[:, :, 3]


# Netpbm, the format of maps: nothing parts its header from its pixels, so that a wrong header shifts them all.


def _surplus(path: Path, image: "ImageFile") -> list[str]:
    """A line about content of a Netpbm file beyond the pixels of its header; Pillow refuses a file with fewer."""
    if image.format != "PPM":
        return []
    with path.open("rb") as file:
        magic = file.read(2)
        file.seek(image.tile[0][2])
        body = file.read(_BYTES_MAX)
    plain = magic in {b"P1", b"P2", b"P3"}
    surplus = _values(magic, body, image) if plain else _bytes_beyond(body, image)
    if surplus <= 0:
        return []
    unit = "values" if plain else "bytes"
    line = (
        f"{surplus} {unit} more than {image.width} x {image.height} pixels, the size in its header, need, "
        "so that rows may be shifted; mend its width, height or line ends, or save it as PNG"
    )
    return [line]


def _values(magic: bytes, body: bytes, image: "ImageFile") -> int:
    """Values in a plain Netpbm file beyond those of its pixels; bits need no space between them."""
    letters = np.frombuffer(re.sub(rb"#[^\r\n]*", b"", body), dtype=np.uint8)
    ink = ~np.isin(letters, np.frombuffer(_SPACE, dtype=np.uint8))
    begins = ink if magic == b"P1" else ink & ~np.concatenate(([False], ink[:-1]))
    return int(np.count_nonzero(begins)) - image.width * image.height * len(image.getbands())


def _bytes_beyond(body: bytes, image: "ImageFile") -> int:
    """Bytes in a raw Netpbm file beyond those of its pixels; space at its end is none, unless rows begin with it."""
    arguments = image.tile[0][3]
    deep = image.mode == "I" or (
        image.mode == "RGB" and isinstance(arguments, tuple) and arguments[1] > _OPAQUE
    )
    row = {"1": (image.width + 7) // 8, "F": 4 * image.width}.get(
        image.mode, image.width * len(image.getbands()) * (2 if deep else 1)
    )
    rest = body[row * image.height :]
    return len(rest) if rest.strip(_SPACE) or body.startswith(b"\n") else 0


_SPACE = b" \t\n\x0b\x0c\r"
