"""Reasons why a schedule of faults cannot apply to a scenario."""

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

from kantor_protocol.base.machine import WORLD_SIM
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.processes import Impostor, Kill, Late, OnProcesses
from kantor_protocol.scenario.faults.schedule import kind_of

if TYPE_CHECKING:
    from kantor_protocol.scenario.schema import Scenario


def complaints_of_faults(
    faults: Sequence[Fault], scenario: "Scenario", earlier: Sequence[Fault] = ()
) -> Iterable[str]:
    """Why a list of faults cannot apply to a scenario; `faults[i].key: what, and the remedy`.

    earlier: those that the scenario has already, which are in order.
    """
    for i, fault in enumerate(faults):
        for complaint in fault.complaints(scenario):
            yield f"faults[{i}].{complaint}"
    listed = [(f"the scenario's faults[{i}]", fault) for i, fault in enumerate(earlier)]
    listed += [(f"faults[{i}]", fault) for i, fault in enumerate(faults)]
    of_processes = [(at, fault) for at, fault in listed if isinstance(fault, OnProcesses)]
    for (there, one), (here, other) in combinations(of_processes, 2):
        yield from _overlapping(there, one, here, other)
        for first, second in ((one, other), (other, one)):
            yield from _unseen(there, first, here, second)
            yield from _let_in(there, first, here, second)


def _overlapping(there: str, one: OnProcesses, here: str, other: OnProcesses) -> Iterable[str]:
    """Two faults that both stop a process; the second in the list is blamed."""
    if not (one.stops and other.stops and (one.holds(other.from_ns) or other.holds(one.from_ns))):
        return
    for name in one.who:
        if name in other.who:
            yield (
                f"{here}.who: {name} has a {kind_of(one)} then already, by {there}; "
                f"move one of the two"
            )


def _unseen(there: str, outage: OnProcesses, here: str, kill: OnProcesses) -> Iterable[str]:
    """Somebody who dies, or comes back, while world-sim is down."""
    if WORLD_SIM not in outage.who or WORLD_SIM in kill.who or not isinstance(kill, Kill):
        return
    for key, moment_ns in (("from_s", kill.from_ns), ("until_s", kill.until_ns)):
        if moment_ns is not None and outage.holds(moment_ns):
            yield f"{here}: world-sim is down at {key} of a kill, see {there}; move it"


def _let_in(there: str, impostor: OnProcesses, here: str, absence: OnProcesses) -> Iterable[str]:
    """An impostor of somebody who is away."""
    if not isinstance(impostor, Impostor) or not isinstance(absence, (Kill, Late)):
        return
    for name in impostor.who:
        if name in absence.who and absence.holds(impostor.from_ns):
            yield (
                f"{here}: {name} is away when its impostor comes, who would be let in, "
                f"see {there}; move it"
            )
