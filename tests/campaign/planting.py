"""How bugs are planted: the list of them, the missions that each can change, and where to put a patch.

A bug that no mission meets, not even one with a liar, names the test that has to fail.

A bug is a mistake that one could make in this system. Those in Python are planted at a seam; one in a compiled
kernel replaces the kernel, and every kernel that calls it is compiled anew.
"""

import itertools
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import pytest

from kantor_protocol.base.kernels import Kernel
from kantor_protocol.replication.replica_kernels import ReplicaArrays
from kantor_protocol.scenario.schema import Scenario

Patch = pytest.MonkeyPatch
Touches = Callable[[Scenario], bool]


class Mutant(NamedTuple):
    """A planted bug."""

    name: str
    does: str
    plant: Callable[[Patch], None]
    touches: Touches
    """Missions that it can change at all; the others count, and need not run."""
    test: Callable[[], None] | None = None
    """A test of the suite that has to catch it, since no mission meets it."""


MUTANTS: list[Mutant] = []


def mutant(
    does: str, touches: Touches = lambda _: True, *, test: Callable[[], None] | None = None
) -> Callable[[Callable[[Patch], None]], Callable[[Patch], None]]:
    """Add a bug to the list under the name of the function that plants it."""

    def add(plant: Callable[[Patch], None]) -> Callable[[Patch], None]:
        MUTANTS.append(Mutant(plant.__name__.replace("_", "-"), does, plant, touches, test))
        return plant

    return add


# Missions that a bug can change.


def has(kind: type, **wanted: Any) -> Touches:
    """Missions with such a fault; wanted: values of which its fields have one."""
    return lambda scenario: any(
        isinstance(fault, kind)
        and all(getattr(fault, key) in values for key, values in wanted.items())
        for fault in scenario.faults
    )


def strikes(kind: type, who: str) -> Touches:
    """Missions in which such a fault strikes a process."""
    return lambda scenario: any(isinstance(f, kind) and who in f.who for f in scenario.faults)


def density(scenario: Scenario) -> bool:
    """Missions on a density."""
    return not scenario.mapping


def minimum(scenario: Scenario) -> bool:
    """Missions that merge by the minimum."""
    return density(scenario) and scenario.merge == "min"


def ledger(scenario: Scenario) -> bool:
    """Missions that merge ledgers."""
    return density(scenario) and scenario.merge == "ledger"


def spectral(scenario: Scenario) -> bool:
    """Missions with registers."""
    return scenario.planner.name == "spectral"


def supervised(scenario: Scenario) -> bool:
    """Missions with a supervisor."""
    return scenario.centralized


def spatial(scenario: Scenario) -> bool:
    """Missions in which robots can be out of range of each other."""
    return scenario.radio.range_m < 1e9 and not scenario.centralized


def walled(scenario: Scenario) -> bool:
    """Missions in which walls stand before the radio."""
    return scenario.mapping and (scenario.radio.line_of_sight or scenario.radio.wall_loss_m > 0.0)


# Where to put a patch.


def now_and_then(every: int) -> Callable[[], bool]:
    """True at each time out of so many."""
    asked = itertools.count(1)
    return lambda: next(asked) % every == 0


def wrap(patch: Patch, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
    """Replace a function by what is made of it."""
    patch.setattr(owner, name, make(getattr(owner, name)))


def set_weight(store: ReplicaArrays, index: int, value: int) -> None:
    """Set a weight as `replica_kernels` lowers one, whatever the value."""
    before = int(store.weights[index])
    store.counters[2] += int(value > 0) - int(before > 0)
    store.weights[index] = value
    if store.mark[index] != store.counters[1]:
        store.mark[index] = store.counters[1]
        store.lowered[store.counters[0]] = index
        store.counters[0] += 1


def replace_kernel(
    patch: Patch, module: ModuleType, name: str, mutated: Callable[..., Any]
) -> None:
    """Replace a kernel everywhere, also where it was inlined.

    A kernel is inlined into those that call it. So each of them, and each that calls one of them, is made anew.
    """
    modules = [each for key, each in sys.modules.items() if key.startswith("kantor_")]
    kernels = {
        value for each in modules for value in vars(each).values() if isinstance(value, Kernel)
    }
    original = getattr(module, name)
    anew = {original: Kernel(mutated, original.targetoptions)}
    while callers := [
        each for each in kernels - anew.keys() if not anew.keys().isdisjoint(_callees(each))
    ]:
        anew |= {each: Kernel(each.py_func, each.targetoptions) for each in callers}
    for each in modules:
        for key, value in list(vars(each).items()):
            if isinstance(value, Kernel) and value in anew:
                patch.setattr(each, key, anew[value])


def _callees(kernel: Kernel) -> set[Kernel]:
    """The kernels that a kernel names, also by a module."""
    function = kernel.py_func
    names = function.__code__.co_names
    values = [function.__globals__[name] for name in names if name in function.__globals__]
    values += [
        getattr(value, name, None)
        for value in values
        if isinstance(value, ModuleType)
        for name in names
    ]
    return {value for value in values if isinstance(value, Kernel)}
