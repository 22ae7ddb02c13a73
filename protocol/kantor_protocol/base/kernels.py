"""How kernels are compiled: for speed, to be called often, and kept on disk."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, InTreeCacheLocator


class _InTree(InTreeCacheLocator):  # type: ignore[misc]
    """Keeps the cache beside the source, also where nothing can be written but cached kernels exist, as in an image."""

    def ensure_cache_path(self) -> None:
        """Accept an unwritable path with cached kernels; numba's own locator would compile anew elsewhere."""
        try:
            super().ensure_cache_path()
        except OSError:
            if not any(Path(self.get_cache_path()).glob("*.nbi")):
                raise


class _CacheFiles(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = tuple(
        _InTree if locator is InTreeCacheLocator else locator
        for locator in CompileResultCacheImpl._locator_classes  # noqa: SLF001
    )


class _Cache(FunctionCache):  # type: ignore[misc]
    _impl_class = _CacheFiles

    def save_overload(self, signature: Any, data: Any) -> None:
        """Save a kernel; one that cannot be saved is compiled again the next time."""
        with contextlib.suppress(OSError):
            super().save_overload(signature, data)


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def compile_(function: Callable[..., Any]) -> Any:
        dispatcher = njit(error_model="numpy", _nrt=False, **options)(function)
        dispatcher._cache = _Cache(function)  # noqa: SLF001  cache=True, and where it cannot be written as well
        return dispatcher

    return compile_


kernel = _compiled()
"""Compiles a function that allocates nothing. Numba then counts no references to its arrays, which
would cost more than the work itself; at the border to Python an array costs 0.02 us. A NamedTuple of
arrays costs a whole one there, so that a kernel that is called in every step takes the fields one by one."""

sum_kernel = _compiled(fastmath={"reassoc"})
"""For a long sum of which the last digits do not matter: its terms are added in the order in which the
processor is fastest, four times as fast as one by one."""
