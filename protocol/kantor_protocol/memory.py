"""What a process need not keep in memory."""

import contextlib
import ctypes
import re
from pathlib import Path

_SMAPS = Path("/proc/self/smaps")
_COMPILER = re.compile(r"^([0-9a-f]+)-([0-9a-f]+) r.*/libllvmlite\.so$")
_UNCHANGED = re.compile(r"^Anonymous: +0 kB$")
_DONTNEED = 4


def leave_compiler() -> None:
    """Let go of the compiler's pages, some 70 MB, once kernels are loaded.

    Only of those that are as they are in its file: whatever is wanted again comes back by itself. What the loader has
    changed (relocations) would not. Does nothing where there is no /proc.
    """
    with contextlib.suppress(OSError, AttributeError):
        madvise = ctypes.CDLL(None).madvise
        madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
        mapping = None
        for line in _SMAPS.read_text(encoding="utf-8").splitlines():
            mapping = _COMPILER.match(line) or (mapping if line[:1].isupper() else None)
            if mapping is not None and _UNCHANGED.match(line):
                first, end = (int(address, 16) for address in mapping.groups())
                madvise(first, end - first, _DONTNEED)
