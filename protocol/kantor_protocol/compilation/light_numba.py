"""Imports numba without the packages that it only looks at: scipy for its version, yaml for a file of settings.

They take 0.1 s and 1.5 MB in every process. Whatever needs them imports them afterwards as usual.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

_LOOKED_AT = ("scipy", "yaml")


@contextmanager
def _absent(names: tuple[str, ...]) -> Iterator[None]:
    """Let imports of packages that are not loaded yet fail."""
    absent = [name for name in names if name not in sys.modules]
    for name in absent:
        sys.modules[name] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        for name in absent:
            del sys.modules[name]


with _absent(_LOOKED_AT):
    import numba  # noqa: F401
