"""Compiled kernels on disk: a file for each kernel and signature, named by all that its machine code depends on.

An edited kernel has another name, and so has each kernel that calls it: nothing is ever stale, clones and
environments of one machine share what they have in common, and whatever else is edited compiles nothing.
"""

import fcntl
import os
import pickle
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from enum import Enum
from functools import cache, cached_property
from hashlib import blake2b
from pathlib import Path
from types import BuiltinFunctionType, CodeType, ModuleType
from typing import Any

import llvmlite
import numba
import numpy as np
from numba import config, types
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.registry import cpu_target
from numba.core.serialize import dumps

_KEPT_S = 30 * 86_400.0
_TOUCHED_S = 86_400.0
_FORMAT = 2
_SUFFIX, _COMPLETE = ".kernel", ".complete"


def kernel_folder() -> Path:
    """The folder of kernels of this compiler and processor, in $KANTOR_KERNELS or in the user's cache."""
    chosen = os.environ.get("KANTOR_KERNELS")
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111  raises nothing
    folder = Path(chosen) if chosen else Path(caches) / "kantor" / "kernels"
    return folder / _compiler()


def is_complete(set_of_kernels: str) -> bool:
    """Whether a set of kernels has been compiled on this machine; an edited one of them may be missing again."""
    try:
        return (kernel_folder() / f"{set_of_kernels}{_COMPLETE}").exists()
    except OSError:
        return False


def note_complete(set_of_kernels: str) -> None:
    """Note that a set of kernels has been compiled."""
    with suppress(OSError):
        (kernel_folder() / f"{set_of_kernels}{_COMPLETE}").touch()


def prune() -> None:
    """Remove the kernels that nobody has loaded for a month, those of other compilers among them."""
    with suppress(OSError):
        for path in kernel_folder().parent.glob("*/*"):
            if time.time() - path.stat().st_mtime > _KEPT_S:
                path.unlink()


class KernelStore(_Cache):  # type: ignore[misc]
    """The files of one kernel. A folder that cannot be read or written costs time, and nothing else."""

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel

    cache_path = property(lambda _: str(kernel_folder()))

    def enable(self) -> None:
        """A store is always in use."""

    def disable(self) -> None:
        """A store is always in use."""

    def flush(self) -> None:
        """Nothing is stale, so that nothing need be dropped."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the kernel for a signature; none if it is not there or cannot be read.

        Only the compiler needs what `target_context.refresh` imports: 20 MB, half a second.
        """
        path = self._path(sig)
        try:
            reduced = pickle.loads(path.read_bytes())  # noqa: S301  a folder of the user's own, like __pycache__
            _touch(path)
            loaded = CompileResult._rebuild(target_context, *reduced)  # noqa: SLF001
        except Exception:  # noqa: BLE001  whatever a broken file raises, the kernel is compiled
            return None
        if "no_cpython_wrapper" not in self._kernel.targetoptions:
            loaded.library._shared_module = None  # noqa: SLF001  what kernels link is another
        return loaded

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a compiled kernel; one that cannot be saved is compiled again the next time."""
        path = self._path(sig)
        draft = path.with_suffix(f".{os.getpid()}")
        with suppress(OSError):
            draft.write_bytes(dumps(data._reduce()))  # noqa: SLF001
            draft.replace(path)

    @contextmanager
    def one_compiles(self, sig: Any) -> Iterator[None]:
        """Hold the lock of a kernel that is not there yet. Kernels call no kernel that calls them: no deadlock."""
        path = self._path(sig)
        with ExitStack() as held:
            with suppress(OSError):
                if not path.exists():
                    path.parent.mkdir(parents=True, exist_ok=True)
                    lock = held.enter_context(path.with_suffix(".lock").open("wb"))
                    fcntl.flock(lock, fcntl.LOCK_EX)
                    held.callback(path.with_suffix(".lock").unlink, missing_ok=True)
            yield

    def _path(self, sig: Any) -> Path:
        digest = blake2b(digest_size=16)
        _feed(digest, self._content, *map(name_of_type, sig))
        function = self._kernel.py_func
        return (
            self._folder
            / f"{function.__module__}.{function.__name__}-{digest.hexdigest()}{_SUFFIX}"
        )

    @property
    def first_symbol(self) -> int:
        """A number that kernels of other content are far from."""
        return int(self._content[:15], 16)

    @cached_property
    def _folder(self) -> Path:
        return kernel_folder()

    @cached_property
    def _content(self) -> str:
        return content_of(self._kernel)


def content_of(kernel: Any) -> str:
    """Digest of a kernel's code and options and of all that it refers to: kernels, constants, types of tuples.

    Lines and comments are not part of it.

    Raises:
        TypeError: It refers to something of which the content cannot be told.
    """
    return _content(kernel, ())


def name_of_type(kind: Any) -> str:
    """A type of numba by name, of a NamedTuple also its fields' names: kernels read fields by name."""
    if isinstance(kind, types.BaseTuple):
        fields = getattr(kind, "fields", "")
        return f"{getattr(kind, 'instance_class', tuple)}{fields}{[name_of_type(each) for each in kind]}"
    return str(kind)


def _content(kernel: Any, callers: tuple[Any, ...]) -> str:
    function, digest = kernel.py_func, blake2b(digest_size=16)
    _feed(digest, sorted(kernel.targetoptions.items()), function.__defaults__)
    codes = list(_codes(function.__code__))
    for code in codes:
        constants = [each for each in code.co_consts if not isinstance(each, CodeType)]
        _feed(digest, code.co_code, code.co_exceptiontable, code.co_flags, code.co_argcount)
        _feed(digest, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
        _feed(digest, *map(_constant, constants))
    names = sorted({name for code in codes for name in code.co_names})
    values = {name: function.__globals__[name] for name in names if name in function.__globals__}
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    values |= {name: cell.cell_contents for name, cell in cells}
    for name, value in values.items():
        _feed(
            digest,
            name,
            _referred(value, names, (*callers, kernel), f"{function.__qualname__}: {name}"),
        )
    return digest.hexdigest()


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _referred(value: Any, names: list[str], callers: tuple[Any, ...], place: str) -> str:
    """The content of a value that a kernel names; names: those of its code, attributes of modules among them."""
    if hasattr(value, "py_func"):
        return "itself" if value in callers else _content(value, callers)
    if isinstance(value, ModuleType):
        return _module(value, names, callers, place)
    if isinstance(value, type) and issubclass(value, Enum):
        return repr([(each.name, each.value) for each in value])
    if isinstance(value, type):
        return f"{value.__module__}.{value.__qualname__}{getattr(value, '_fields', '')}"
    if isinstance(value, BuiltinFunctionType | np.ufunc):
        return repr(value.__name__)
    try:
        return _constant(value)
    except TypeError as error:
        raise TypeError(f"{place}: {error}") from None


def _module(module: ModuleType, names: list[str], callers: tuple[Any, ...], place: str) -> str:
    """Of a module of kantor what is named; of others the name, since their versions are the compiler's."""
    if not module.__name__.startswith("kantor_"):
        return module.__name__
    used = {name: getattr(module, name) for name in names if hasattr(module, name)}
    return repr([(name, _referred(value, names, callers, place)) for name, value in used.items()])


def _constant(value: Any) -> str:
    if isinstance(value, Enum):
        return f"{value!r} {value.value!r}"
    if value is None or isinstance(value, bool | int | float | str | bytes | np.dtype | types.Type):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, np.generic | np.ndarray):
        return f"{value.dtype.descr} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, tuple):
        return f"{type(value).__qualname__} {[_constant(each) for each in value]}"
    raise TypeError(
        f"a kernel refers to {type(value).__name__}, of which the content cannot be told"
    )


@cache
def _compiler() -> str:
    """Digest of what compiles, of the processor for which it does, and of how the result is saved."""
    digest = blake2b(digest_size=8)
    _feed(
        digest,
        _FORMAT,
        numba.__version__,
        llvmlite.__version__,
        np.__version__,
        sys.version,
        config.OPT,
    )
    _feed(digest, cpu_target.target_context.codegen().magic_tuple())
    return digest.hexdigest()


def _feed(digest: Any, *parts: Any) -> None:
    for part in parts:
        text = part if isinstance(part, bytes) else str(part).encode()
        digest.update(len(text).to_bytes(8, "little") + text)


def _touch(path: Path) -> None:
    """Remember that a kernel is in use, once a day."""
    with suppress(OSError):
        if time.time() - path.stat().st_mtime > _TOUCHED_S:
            path.touch()
