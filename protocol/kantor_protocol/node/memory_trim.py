"""Release of file-backed memory that a process need not keep."""

import contextlib
import ctypes
import re
from pathlib import Path

_SMAPS = Path("/proc/self/smaps")
_STATM = Path("/proc/self/statm")
_WORTH_PAGES = 5120
"""Looking for pages takes as long as a hundred steps; with fewer that are backed by files it is not worth it."""
_FROM_FILE = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) r-[x-]p .* /")
_UNCHANGED = re.compile(r"^Anonymous: +0 kB$")
_DONTNEED = 4


def release_file_pages() -> None:
    """Release file-backed pages (madvise): most of all the compiler's, 70 MB, once kernels are loaded.

    Pages that are used again come back by themselves, from the page cache. Pages that differ from their file, such as
    those that the loader has relocated, would not: they stay. Does nothing where there is no /proc.
    """
    with contextlib.suppress(OSError, AttributeError):
        if int(_STATM.read_text(encoding="utf-8").split()[2]) < _WORTH_PAGES:
            return
        libc = ctypes.CDLL(None)
        libc.malloc_trim(0)
        madvise = libc.madvise
        madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
        mapping = None
        with _SMAPS.open(encoding="utf-8") as lines:
            for line in lines:
                mapping = _FROM_FILE.match(line) or (mapping if line[:1].isupper() else None)
                if mapping is not None and _UNCHANGED.match(line):
                    first, end = (int(address, 16) for address in mapping.groups())
                    madvise(first, end - first, _DONTNEED)
