"""Compilation of kernels: for speed, to be called often, and kept on disk."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from itertools import count
from typing import Any

import numpy as np

from kantor_protocol.compilation import light_numba  # noqa: F401  before numba

# isort: split
from numba import config, types
from numba.core.bytecode import FunctionIdentity
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from kantor_protocol.compilation.kernel_store import KernelStore


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """A compiled function that Python calls, and that kernels inline.

    For kernels it is compiled a second time, without the wrappers by which Python and C call a function: these take
    as long to compile as the function itself, and most kernels are called by kernels alone.
    """

    def __init__(self, function: Callable[..., Any], targetoptions: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=targetoptions)
        self._cache = KernelStore(self)
        self._typed: dict[tuple[Any, ...], Callable[..., Any]] = {}

    @cached_property
    def inlined(self) -> "Kernel":
        """This kernel as kernels call it."""
        without_wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        return Kernel(self.py_func, self.targetoptions | without_wrappers)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What numba asks for when it compiles a kernel that calls this one.

        A literal is any number of its type; otherwise each constant in an argument would be a kernel of its own.
        """
        plain = tuple(map(types.unliteral, args))
        named = {name: types.unliteral(kind) for name, kind in kws.items()}
        return CPUDispatcher.get_call_template(self.inlined, plain, named)

    def get_overload(self, sig: Any) -> Any:
        """The compiled code that a kernel calls."""
        return CPUDispatcher.get_overload(self.inlined, sig)

    def typed(self, *arguments: Any) -> Callable[..., Any]:
        """The compiled code for arguments of the types that these have; see `typed`."""
        kinds = tuple(map(_kind, arguments))
        if (code := self._typed.get(kinds)) is None:
            code = self._typed[kinds] = self.compile(tuple(map(self.typeof_pyval, arguments)))
        return code

    def compile(self, sig: Any) -> Any:
        """Load or compile this kernel for a signature: in one process, while the others wait for it."""
        if tuple(sig) in self.overloads:
            return super().compile(sig)
        # The lock of the threads first: a thread that holds it may wait for a file that another thread compiles.
        with (
            global_compiler_lock,
            self._cache.one_compiles(sig),
            self._own_symbols(),
            _garbage_kept(),
        ):
            return super().compile(sig)

    @contextmanager
    def _own_symbols(self) -> Iterator[None]:
        """Number the functions of this kernel from its content on, not by how many this process has compiled.

        Code that two processes compiled is linked in a third, where two functions of one symbol would be one.
        """
        of_process = FunctionIdentity._unique_ids  # noqa: SLF001
        FunctionIdentity._unique_ids = count(self._cache.first_symbol)  # noqa: SLF001
        try:
            yield
        finally:
            FunctionIdentity._unique_ids = of_process  # noqa: SLF001


def _kind(argument: Any) -> Any:
    """What decides the type of an argument; numba's own answer takes a hundred times as long."""
    if isinstance(argument, np.ndarray):
        return argument.dtype, argument.ndim, argument.flags.num
    if isinstance(argument, tuple):
        return type(argument), tuple(map(_kind, argument))
    return type(argument)


@contextmanager
def _garbage_kept() -> Iterator[None]:
    """Compilation makes millions of objects and hardly a cycle: looking for cycles takes a sixth of its time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def compile_(function: Callable[..., Any]) -> Any:
        if config.DISABLE_JIT:
            return function
        return Kernel(
            function, {"nopython": True, "error_model": "numpy", "_nrt": False, **options}
        )

    return compile_


kernel = _compiled()
"""Compiles a function that allocates nothing. Numba then counts no references to its arrays, which would cost more
than the work itself. At the border to Python an array costs 0.02 us, also one within a plain tuple; a NamedTuple costs
a whole one. A kernel that is called for each batch takes each NamedTuple as the plain tuple of its fields, and names
them again: `state = State(*fields)`."""

sum_kernel = _compiled(fastmath={"reassoc"})
"""For a long sum of which the last digits do not matter: its terms are added in the order in which the
processor is fastest, four times as fast as one by one."""


def typed(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """A kernel for arguments of the types that these have, and for no others.

    A kernel looks up the types of its arguments in every call, which takes longer than a short kernel does: 0.05 us
    for each. What is returned has looked once. Only for arguments whose types cannot change: that an array has the
    same layout is not looked at again.
    """
    return function.typed(*arguments) if isinstance(function, Kernel) else function


Row = Any
"""A row of a table in a kernel: its fields are its attributes."""


def integers(*names: str) -> "np.dtype[np.void]":
    """The type of a row of whole numbers, each with its name; in kernels a table is an array of rows."""
    return np.dtype([(name, np.int64) for name in names])
