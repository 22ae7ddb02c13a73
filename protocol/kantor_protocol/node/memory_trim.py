"""What a process need not keep in memory."""

import contextlib
import ctypes
import re
from pathlib import Path

_SMAPS = Path("/proc/self/smaps")
_FROM_FILE = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) r-[x-]p .* /")
_UNCHANGED = re.compile(r"^Anonymous: +0 kB$")
_DONTNEED = 4


def release_file_pages() -> None:
    """Let go of what a file holds as well: most of all the compiler, 70 MB, once kernels are loaded.

    What is wanted again comes back by itself, from the page cache. Pages that are not as in their file, such as what the
    loader has relocated, would not: they stay. Does nothing where there is no /proc.
    """
    with contextlib.suppress(OSError, AttributeError):
        madvise = ctypes.CDLL(None).madvise
        madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
        mapping = None
        for line in _SMAPS.read_text(encoding="utf-8").splitlines():
            mapping = _FROM_FILE.match(line) or (mapping if line[:1].isupper() else None)
            if mapping is not None and _UNCHANGED.match(line):
                first, end = (int(address, 16) for address in mapping.groups())
                madvise(first, end - first, _DONTNEED)
