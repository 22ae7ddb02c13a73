"""What a process need not keep in memory."""

import contextlib
import ctypes
from pathlib import Path

_MAPS = Path("/proc/self/maps")
_COMPILER = "libllvmlite"
_DONTNEED = 4


def leave_compiler() -> None:
    """Let go of the compiler's pages, some 70 MB, once kernels are loaded.

    They are a file's and unchanged: whatever is wanted again comes back by itself. Does nothing where there is no /proc.
    """
    with contextlib.suppress(OSError, AttributeError):
        madvise = ctypes.CDLL(None).madvise
        madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
        for line in _MAPS.read_text(encoding="utf-8").splitlines():
            place, rights, *_ = line.split()
            if _COMPILER in line and "w" not in rights:
                first, end = (int(address, 16) for address in place.split("-"))
                madvise(first, end - first, _DONTNEED)
