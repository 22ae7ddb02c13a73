# ruff: noqa: INP001
"""Removes files of installed packages that no kantor command opens; run in the first stage of the image.

    lighten.py SITE-PACKAGES

It removes tests, sources and headers of compiled parts, stubs, and the parts of shared libraries that a loader does
not read: symbols, debugging information, section headers. (binutils, which has `strip`, is in no slim base.)
"""

import os
import shutil
import struct
import sys
from pathlib import Path

_SUFFIXES = {".a", ".c", ".cpp", ".h", ".hpp", ".pxd", ".pxi", ".pyi", ".pyx"}
_FOLDERS = {"tests", "test", "sample_data"}
_PLACES = (
    "numba/cuda/cudadrv/runtime",
    "numpy/distutils",
    "PIL/_avif*",
    "cffi",
    "pillow.libs/libavif*",
    "pycparser",
    "pygments/lexers/[a-z]*.py",
    "scipy/io/_fast_matrix_market",
    "zstandard/_cffi*",
)
"""No GPU in the image, no compiler, no AVIF, no source to colour; zstandard uses its C backend,
cryptography `_cffi_backend` alone, and numba imports cffi just because it is there."""


def lighten(site: Path) -> None:
    """Lighten all packages below a folder."""
    for pattern in _PLACES:
        for path in site.glob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    for folder, folders, files in os.walk(site):
        for name in _FOLDERS & set(folders):
            shutil.rmtree(Path(folder) / name)
            folders.remove(name)
        for path in (Path(folder) / name for name in files):
            if path.suffix in _SUFFIXES:
                path.unlink()
            elif ".so" in path.name and not path.is_symlink():
                strip(path)


def strip(path: Path) -> None:
    """Cut off a 64-bit ELF file behind its last segment."""
    with path.open("r+b") as file:
        header = bytearray(file.read(64))
        if header[:6] != b"\x7fELF\x02\x01":  # 64 bits, little-endian
            return
        (first,) = struct.unpack_from("<Q", header, 32)
        size, count = struct.unpack_from("<HH", header, 54)
        end = first + size * count
        for index in range(count):
            file.seek(first + size * index)
            (_type, _flags, offset, _v, _p, in_file, *_) = struct.unpack("<IIQQQQQQ", file.read(56))
            end = max(end, offset + in_file)
        struct.pack_into("<Q", header, 40, 0)  # where the section headers are
        struct.pack_into("<HHH", header, 58, 0, 0, 0)
        file.seek(0)
        file.write(header)
        file.truncate(end)


if __name__ == "__main__":
    lighten(Path(sys.argv[1]))
