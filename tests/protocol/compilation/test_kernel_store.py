"""Compiled kernels on disk: nothing stale is loaded, nothing is compiled twice, and no folder is needed."""

import importlib
import itertools
import multiprocessing
import os
import pkgutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba import typeof
from numba.core.bytecode import FunctionIdentity

from kantor_protocol.base.counter_rng import uniform
from kantor_protocol.base.kernels import Kernel, kernel
from kantor_protocol.compilation import kernel_store
from kantor_protocol.compilation.kernel_store import content_of, kernel_folder, name_of_type
from support.limits import EVENT_LIMIT_S

PACKAGES = ("protocol", "agent", "supervisor", "worldsim", "fleet")
CALLEE = "def callee(x):\n    return x + STEP\n"
CALLER = "def caller(x):\n    return 2 * callee(x)\n"


class Pair(NamedTuple):
    first: int
    second: int


class Turned(NamedTuple):
    second: int
    first: int


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of kernels."""
    monkeypatch.setenv("KANTOR_KERNELS", str(tmp_path / "kernels"))
    return kernel_folder()


def written(source: str, name: str, **names: Any) -> Kernel:
    """A kernel from its source; names: what it refers to."""
    namespace = {"__name__": "kantor_written", **names}
    exec(source, namespace)
    function = namespace[name]
    assert isinstance(function, FunctionType)
    made = kernel(function)
    assert isinstance(made, Kernel)
    return made


def caller(callee: str = CALLEE, step: object = 1, source: str = CALLER) -> Kernel:
    """A kernel that calls another."""
    return written(source, "caller", callee=written(callee, "callee", STEP=step))


def compilations(made: Kernel) -> int:
    """How often a kernel was compiled in this process."""
    return sum(made.stats.cache_misses.values())


def files(folder: Path) -> set[str]:
    """The names of the kernels in a folder."""
    return {path.name for path in folder.glob("*.kernel")}


@pytest.mark.parametrize(
    "edited",
    [
        pytest.param(
            lambda: caller(CALLEE.replace("+", "-")), id="the code of a kernel that it calls"
        ),
        pytest.param(lambda: caller(step=2), id="a constant of a kernel that it calls"),
        pytest.param(lambda: caller(step=1.0), id="the type of that constant"),
        pytest.param(lambda: caller(step=np.uint8(1)), id="the width of that constant"),
        pytest.param(lambda: caller(source=CALLER.replace("2", "3")), id="a number in its code"),
    ],
)
def test_an_edit_of_anything_that_a_kernel_depends_on_is_another_content(
    edited: Callable[[], Kernel],
) -> None:
    """A digest of what is compiled, over kernels that are inlined and over values."""
    assert content_of(edited()) != content_of(caller())


def test_lines_and_comments_are_no_content() -> None:
    """What compiles to the same code is the same kernel."""
    moved = "\n\n\n# Why.\n" + CALLER.replace("    return", "    # How.\n    return")
    assert content_of(caller(source=moved)) == content_of(caller())


def test_options_of_the_compiler_are_content() -> None:
    """A kernel that may add in another order is another kernel."""
    plain = caller()
    fast = Kernel(plain.py_func, {**plain.targetoptions, "fastmath": {"reassoc"}})
    assert content_of(fast) != content_of(plain)


def test_a_kernel_that_calls_itself_has_a_content() -> None:
    """The digest of a recursive kernel ends."""
    source = "def down(n):\n    return n if n < 1 else down(n - 1)\n"
    namespace: dict[str, Any] = {"__name__": "kantor_written"}
    exec(source, namespace)
    namespace["down"] = kernel(namespace["down"])
    assert len(content_of(namespace["down"])) == 32


def test_a_value_without_a_content_is_refused() -> None:
    """Where a digest could miss a change, there is an error that names the kernel and the value."""
    with pytest.raises(TypeError, match="callee: STEP: a kernel refers to list"):
        content_of(caller(step=[1]))


def test_what_a_kernel_takes_of_a_module_is_content() -> None:
    """A constant that is read through a module of kantor's own."""
    source = "def taken(x):\n    return x + there.STEP\n"
    one, two = (ModuleType("kantor_there") for _ in range(2))
    one.STEP, two.STEP = 1, 2  # type: ignore[attr-defined]
    assert content_of(written(source, "taken", there=one)) != content_of(
        written(source, "taken", there=two)
    )


def test_the_names_of_a_tuples_fields_are_part_of_its_type() -> None:
    """Two fields of one type that change places are another kernel."""
    pair, turned = Pair(3, 4), Turned(3, 4)
    assert name_of_type(typeof(pair)) != name_of_type(typeof(turned))
    assert name_of_type(typeof((pair,))) != name_of_type(typeof((turned,)))


def test_a_kernel_is_compiled_once_for_all_clones(store: Path) -> None:
    """The second is loaded, also where its source lies elsewhere."""
    first, second = caller(), caller(source="\n" + CALLER)
    assert (first(3), second(3)) == (8, 8)
    assert (compilations(first), compilations(second)) == (1, 0)
    assert len(files(store)) == 2


def test_an_edit_compiles_what_depends_on_it_and_nothing_else(store: Path) -> None:
    """Both kernels after an edit of the one that is called, one after an edit of the caller."""
    assert caller()(3) == 8
    before = files(store)
    assert caller(source=CALLER.replace("2", "3"))(3) == 12
    assert len(files(store) - before) == 1
    assert caller(step=2)(3) == 10
    assert len(files(store) - before) == 3


def test_constants_in_calls_make_no_kernels_of_their_own(store: Path) -> None:
    """A literal argument is any number of its type."""
    source = "def caller(x):\n    return callee(1) + callee(2) + callee(x)\n"
    assert caller(source=source)(3) == 2 + 3 + 4
    assert len(files(store)) == 2


@pytest.mark.parametrize("content", [b"", b"no pickle", b"\x80\x05N."])
def test_a_broken_file_is_compiled_anew(store: Path, content: bytes) -> None:
    """Cut off by a crash, or written by something else."""
    assert caller()(3) == 8
    for path in store.glob("*.kernel"):
        path.write_bytes(content)
    again = caller()
    assert again(3) == 8
    assert compilations(again) == 1


@pytest.mark.parametrize("name", ["file", 300 * "x"], ids=["a file", "a name too long"])
def test_a_folder_that_cannot_be_used_costs_time_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A file stands where it should be, or the system refuses every access."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("KANTOR_KERNELS", str(tmp_path / name))
    assert not kernel_store.is_complete("some")
    kernel_store.note_complete("some")  # where nothing can be written
    assert not kernel_store.is_complete("some")
    assert caller()(3) == 8
    kernel_store.prune()


def test_a_kernel_that_nobody_loads_for_a_month_is_removed(store: Path) -> None:
    """One that is loaded stays, however old."""
    assert caller()(3) == 8
    (other,) = (path for path in store.glob("*.kernel") if "callee" in path.name)
    month_ago_s = time.time() - 31 * 86_400.0
    for path in store.glob("*.kernel"):
        os.utime(path, (month_ago_s, month_ago_s))
    assert caller()(3) == 8
    kernel_store.prune()
    assert files(store).isdisjoint({other.name})
    assert len(files(store)) == 1


def test_processes_that_need_the_same_kernel_compile_it_once(store: Path) -> None:
    """Of three that begin together one compiles; the others wait and load."""
    context = multiprocessing.get_context("fork")
    barrier, told = context.Barrier(3), context.SimpleQueue()

    def run() -> None:
        made = Kernel(uniform.py_func, uniform.targetoptions)
        barrier.wait(EVENT_LIMIT_S)
        made(1, 2, 3, 4, 5)
        told.put(compilations(made))

    processes = [context.Process(target=run) for _ in range(3)]
    for process in processes:
        process.start()
    answers = sorted(told.get() for _ in processes)
    for process in processes:
        process.join(EVENT_LIMIT_S)
    assert answers == [0, 0, 1]
    assert {path.suffix for path in store.iterdir()} == {".kernel"}


def kernels() -> Iterator[Kernel]:
    """Every kernel of kantor."""
    for package in PACKAGES:
        root = importlib.import_module(f"kantor_{package}")
        for found in pkgutil.walk_packages(root.__path__, f"{root.__name__}."):
            if not found.name.endswith(("__main__", "preloaded")):
                importlib.import_module(found.name)
    for name, module in list(sys.modules.items()):
        if name.startswith("kantor_"):
            yield from (value for value in vars(module).values() if isinstance(value, Kernel))


def test_the_content_of_every_kernel_can_be_told() -> None:
    """No kernel of kantor refers to what a digest cannot hold."""
    contents = {id(each): content_of(each) for each in kernels()}
    assert len(contents) > 150
    assert len(set(contents.values())) == len(contents)


_LOOP = """
    for i in range(x):
        if total % 5 == i:
            total += i + STEP * x
        total = (total ^ (total >> 3) * STEP) % 10007
"""
TOO_LONG_TO_INLINE = f"def callee(x):\n    total = STEP{8 * _LOOP}    return total\n"
CALLED_OFTEN = (
    "def caller(x):\n    return callee(x) + callee(x + 1) * callee(x + 2) + callee(x + 3)\n"
)


def test_kernels_of_one_name_are_linked_apart(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Code of two processes, each of which compiled it as its first, is used in one: none calls the other's."""

    def kernels_of_both() -> Iterator[tuple[Kernel, int]]:
        for step in (3, 5):
            monkeypatch.setattr(FunctionIdentity, "_unique_ids", itertools.count(1))
            plain: dict[str, Any] = {"STEP": step}
            exec(TOO_LONG_TO_INLINE + CALLED_OFTEN, plain)
            yield caller(TOO_LONG_TO_INLINE, step, CALLED_OFTEN), plain["caller"](8)

    compiled = [(made(8), expected) for made, expected in kernels_of_both()]
    used = list(kernels_of_both())
    loaded = [(made(8), expected) for made, expected in used]
    assert len(files(store)) == 4
    assert all(result == expected for result, expected in compiled + loaded)
