"""Reasons why a schedule of faults cannot apply to a scenario; each is one line with the place and the remedy."""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from typing import Any

from kantor_protocol.base.machine import SUPERVISOR, WORLD_SIM
from kantor_protocol.scenario.faults.base import Fault, Names
from kantor_protocol.scenario.faults.liars import Byzantine
from kantor_protocol.scenario.faults.links import (
    Bandwidth,
    Clog,
    Delay,
    OneWay,
    OnLinks,
    Partition,
    Range,
    Severs,
)
from kantor_protocol.scenario.faults.processes import (
    ClockFault,
    Impostor,
    Kill,
    Late,
    OnProcesses,
    WithEnd,
)
from kantor_protocol.scenario.faults.schedule import kind_of
from kantor_protocol.scenario.schema import Scenario


def complaints_of_faults(
    faults: Sequence[Fault], scenario: Scenario, earlier: Sequence[Fault] = ()
) -> Iterable[str]:
    """Reasons why a list of faults cannot apply to a scenario; `faults[i].key: what, and the remedy`.

    earlier: those that the scenario has already, which are in order.
    """
    for i, fault in enumerate(faults):
        for complaint in _complaints_of_fault(fault, scenario):
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
    """Reasons for two faults that stop a process at the same time; they name the second in the list."""
    if not (one.stops and other.stops and (one.holds(other.from_ns) or other.holds(one.from_ns))):
        return
    for name in one.who:
        if name in other.who:
            yield (
                f"{here}.who: {name} has a {kind_of(one)} then already, by {there}; "
                f"move one of the two"
            )


def _unseen(there: str, outage: OnProcesses, here: str, kill: OnProcesses) -> Iterable[str]:
    """Reasons for a process that is killed, or started again, while world-sim is down."""
    if WORLD_SIM not in outage.who or WORLD_SIM in kill.who or not isinstance(kill, Kill):
        return
    for key, moment_ns in (("from_s", kill.from_ns), ("until_s", kill.until_ns)):
        if moment_ns is not None and outage.holds(moment_ns):
            yield f"{here}: world-sim is down at {key} of a kill, see {there}; move it"


def _let_in(there: str, impostor: OnProcesses, here: str, absence: OnProcesses) -> Iterable[str]:
    """Reasons for an impostor of a participant that is away."""
    if not isinstance(impostor, Impostor) or not isinstance(absence, (Kill, Late)):
        return
    for name in impostor.who:
        if name in absence.who and absence.holds(impostor.from_ns):
            yield (
                f"{here}: {name} is away when its impostor joins, which would be admitted, "
                f"see {there}; move it"
            )


def _complaints_of_fault(fault: Fault, scenario: Scenario) -> Iterable[str]:
    """Reasons for one fault, those that all faults share first: `key: what, and the remedy`."""
    for kind in reversed(type(fault).__mro__):
        if kind in _CHECKS:
            yield from _CHECKS[kind](fault, scenario)


def _of_window(fault: Fault, scenario: Scenario) -> Iterable[str]:
    if fault.until_ns is not None and fault.until_ns <= fault.from_ns:
        yield f"until_s: {fault.until_s:g} s is not after from_s, {fault.from_s:g} s; set a later end"
    if fault.from_ns >= scenario.limit_ns:
        limit_s = scenario.limit_ns * 1e-9
        yield f"from_s: {fault.from_s:g} s is never reached; the mission is cut at {limit_s:g} s"


def _of_names(key: str, names: Names, scenario: Scenario) -> Iterable[str]:
    """Reasons for names that are not in the team, or that are listed twice."""
    roster = scenario.roster
    for name in names:
        if name not in roster:
            known = f"{roster[0]} to r{scenario.robots.count}"
            known += " and supervisor" if scenario.centralized else ""
            yield f"{key}: {name} is not in the team; known: {known}"
        elif names.count(name) > 1:
            yield f"{key}: {name} is named twice; name it once"


def _of_robots(fault: OnLinks | Bandwidth, scenario: Scenario) -> Iterable[str]:
    yield from _of_names("robots", fault.robots, scenario)


def _of_delay(fault: Delay, _scenario: Scenario) -> Iterable[str]:
    if not fault.delay_s + fault.jitter_s > 0.0:
        yield "delay_s: delays nothing; set it, or jitter_s"


def _of_one_way(fault: OneWay, scenario: Scenario) -> Iterable[str]:
    yield from _of_names("senders", fault.senders, scenario)
    yield from _of_names("receivers", fault.receivers, scenario)
    if not fault.senders and not fault.receivers:
        yield "senders: missing; set senders, receivers or both"
    elif not _cuts_any(fault.severs(scenario.roster), scenario.roster):
        yield "receivers: no link leads there from the senders; name others"


def _of_partition(fault: Partition, scenario: Scenario) -> Iterable[str]:
    for key, shape in (("robots", "isolate"), ("groups", "groups")):
        if bool(getattr(fault, key)) != (fault.shape == shape):
            needs = "missing; set it" if fault.shape == shape else f'only with shape = "{shape}"'
            yield f"{key}: {needs}"
    yield from _of_names("robots", fault.robots, scenario)
    for i, group in enumerate(fault.groups):
        yield from _of_names(f"groups[{i}]", group, scenario)
        yield from () if group else (f"groups[{i}]: empty; name a participant",)
    yield from _of_names("groups", sum(fault.groups, ()), scenario)
    if fault.flap_share is not None and fault.flap_s is None:
        yield "flap_share: only with flap_s; set it"
    if not _cuts_any(fault.severs(scenario.roster), scenario.roster):
        yield f"shape: {fault.shape} cuts no link of a team of {len(scenario.roster)}"


def _of_clog(fault: Clog, _scenario: Scenario) -> Iterable[str]:
    if fault.until_s is None:
        yield "until_s: missing; a clog needs an end"


def _of_bandwidth(fault: Bandwidth, _scenario: Scenario) -> Iterable[str]:
    yield from _of_robots(fault, _scenario)
    if fault.bytes_per_s < 1e-3:
        yield f"bytes_per_s: {fault.bytes_per_s:g} is less than a byte in 1000 s; use drop"


def _of_range(fault: Range, scenario: Scenario) -> Iterable[str]:
    if (fault.range_m is None) == (fault.factor is None):
        yield "range_m: set either range_m or factor"
        return
    whose = "supervisor" if scenario.centralized else "radio"
    before_m = scenario.supervisor.range_m if scenario.centralized else scenario.radio.range_m
    if fault.factor is not None and before_m == math.inf:
        yield f"factor: {whose}.range_m is infinite and stays so; set range_m"
    if fault.range_m is not None and fault.range_m >= before_m:
        yield f"range_m: {whose}.range_m is {before_m:g} m already; set a shorter one"
    if scenario.centralized and scenario.mapping and scenario.supervisor.pose_m is None:
        yield "range_m: the supervisor has no place on the map; set supervisor.pose_m"


def _of_processes(fault: OnProcesses, scenario: Scenario) -> Iterable[str]:
    participants = tuple(name for name in fault.who if name != WORLD_SIM or not fault.of_world_sim)
    yield from _of_names("who", participants, scenario)


def _of_end(fault: WithEnd, _scenario: Scenario) -> Iterable[str]:
    if fault.until_s is None:
        yield f"until_s: missing; a {kind_of(fault)} needs an end"


def _of_kill(fault: Kill, _scenario: Scenario) -> Iterable[str]:
    if WORLD_SIM in fault.who and fault.until_s is None:
        yield "until_s: missing; a mission cannot end without world-sim"
    if WORLD_SIM in fault.who and (fault.disk != "kept" or fault.mid_step):
        key = "disk" if fault.disk != "kept" else "mid_step"
        yield f"{key}: only for participants; leave it out for worldsim"


def _of_late(fault: Late, scenario: Scenario) -> Iterable[str]:
    if fault.from_s > 0.0:
        yield "from_s: a late joiner is missing from the start; leave it out"
    if set(scenario.robot_ids) <= set(fault.who):
        yield "who: no robot would be there at the start; leave one out"


def _of_clock(fault: ClockFault, _scenario: Scenario) -> Iterable[str]:
    if fault.offset_s == 0.0 and round(fault.rate_ppm) == 0:
        yield "offset_s: the clock is right; set it, or rate_ppm"


def _of_impostor(fault: Impostor, _scenario: Scenario) -> Iterable[str]:
    if fault.until_s is not None:
        yield "until_s: an impostor asks once, at from_s; leave it out"


def _of_byzantine(fault: Byzantine, scenario: Scenario) -> Iterable[str]:
    yield from _of_names("who", fault.who, scenario)
    if SUPERVISOR in fault.who:
        yield "who: a supervisor is believed without proof and must not lie; name robots"
    if fault.lie == "overstate" and (scenario.mapping or scenario.merge != "ledger"):
        yield 'lie: overstate is about spending in a ledger; explore a density with merge = "ledger"'
    if fault.lie == "fork" and not (scenario.mapping or scenario.merge == "ledger"):
        yield 'lie: nobody compares logs of minima; fork needs merge = "ledger" or a map'
    shares = scenario.claiming or scenario.register_width
    if fault.lie == "claim" and not shares:
        yield "lie: nobody claims samples or shares registers in this mission; tell another"
    if fault.lie == "rewrite" and not (shares or scenario.merge == "ledger"):
        yield 'lie: nobody passes on what others say in this mission; rewrite needs merge = "ledger"'


_CHECKS: dict[type, Callable[[Any, Scenario], Iterable[str]]] = {
    Fault: _of_window,
    OnLinks: _of_robots,
    Delay: _of_delay,
    OneWay: _of_one_way,
    Partition: _of_partition,
    Clog: _of_clog,
    Bandwidth: _of_bandwidth,
    Range: _of_range,
    OnProcesses: _of_processes,
    WithEnd: _of_end,
    Kill: _of_kill,
    Late: _of_late,
    ClockFault: _of_clock,
    Impostor: _of_impostor,
    Byzantine: _of_byzantine,
}
"""The checks of each class of faults, beyond those of its base classes."""


def _cuts_any(severs: Severs, roster: Names) -> bool:
    return any(severs(one, other) for one in roster for other in roster if one != other)
