"""From a mission that breaks a rule to the smallest one found that still breaks it.

Delta debugging (Zeller & Hildebrandt, 2002): leave something out, and keep what is left if the same rule still
breaks. First faults, in ever smaller groups; then robots, values that are not the default, and length.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import msgspec

from kantor_fleet.campaign.keyed_draws import short
from kantor_fleet.campaign.mission import Trial, attempt
from kantor_fleet.execution.experiment import Case
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import from_tree
from kantor_protocol.scenario.schema import Scenario

Tree = dict[str, Any]

_DEFAULTS = (
    ("radio", ("drop", "duplicate", "reorder", "jitter_s", "delay_s", "range_m", "beacon")),
    ("radio", ("line_of_sight", "wall_loss_m")),
    ("clock", ("spread", "drift_ppm", "jitter_s", "order")),
    ("targets", ("count", "diffusion_m")),
    ("samples", ("diffusion_m",)),
    ("supervisor", ("pose_m", "range_m")),
    ("vehicle", ("name",)),
    ("planner", ("horizon", "modes")),
    ("publish", ("weights_every", "keyframe_every")),
)
"""Values that a scenario can do without."""


def shrink(case: Case, rule: str, most_s: float = 60.0) -> tuple[Scenario, Trial]:
    """The smallest scenario found, and its trial with the same seed.

    rule: that the case breaks. most_s: real time that it may take.
    """
    until_s = time.monotonic() + most_s
    best, trial = case.scenario, attempt(case)
    smaller = _smaller(best)
    while time.monotonic() < until_s and (candidate := next(smaller, None)) is not None:
        tried = attempt(msgspec.structs.replace(case, scenario=candidate))
        if tried.rule == rule:
            best, trial = candidate, tried
            smaller = _smaller(best)
    return best, trial


def _smaller(scenario: Scenario) -> Iterator[Scenario]:
    """Scenarios with less in them, the boldest first."""
    for change in _CHANGES:
        for tree in change(to_tree(scenario)):
            tree["summary"] = scenario.summary
            try:
                smaller = from_tree(tree, "smaller")
            except ScenarioError:
                continue
            if smaller != scenario:
                yield smaller


def _fewer_faults(tree: Tree) -> Iterator[Tree]:
    faults = tree["faults"]
    size = len(faults)
    while size:
        for first in range(0, len(faults), size):
            yield tree | {"faults": faults[:first] + faults[first + size :]}
        size //= 2


def _fewer_robots(tree: Tree) -> Iterator[Tree]:
    count = tree["robots"]["count"]
    for fewer in sorted({1, 2, count // 2, count - 1}):
        if 0 < fewer < count:
            energy = dict(tree["energy"])
            energy["points"] = energy["points"] // count * fewer
            team = tree | {"robots": {"count": fewer}, "energy": energy}
            yield _named_only(team, {f"r{i}" for i in range(fewer + 1, count + 1)})


def _no_supervisor(tree: Tree) -> Iterator[Tree]:
    if tree["coordination"] == "centralized":
        yield _named_only(tree | {"coordination": "decentralized"}, {"supervisor"})


def _named_only(tree: Tree, gone: set[str]) -> Tree:
    """Leave out the participants that are gone, and the faults that concerned no others."""
    faults = []
    for fault in tree["faults"]:
        kept = dict(fault)
        for key in ("who", "robots", "senders", "receivers"):
            kept[key] = [name for name in fault.get(key, ()) if name not in gone]
        groups = [[name for name in group if name not in gone] for group in fault.get("groups", ())]
        kept["groups"] = [group for group in groups if group]
        if all(bool(kept[key]) == bool(fault.get(key)) for key in (*_NAMING, "groups")):
            faults.append({key: value for key, value in kept.items() if key in fault})
    return tree | {"faults": faults}


_NAMING = ("who", "robots", "senders", "receivers")


def _plainer(tree: Tree) -> Iterator[Tree]:
    for table, keys in _DEFAULTS:
        for left_out in (keys, *((key,) for key in keys)) if len(keys) > 1 else (keys,):
            kept = {key: value for key, value in tree[table].items() if key not in left_out}
            yield tree | {table: kept}
    if len(tree["density"]) > 1:
        yield tree | {"density": tree["density"][:1]}


def _less_mass(tree: Tree) -> Iterator[Tree]:
    count = tree["samples"].get("count", 0)
    for fewer in (count // 8, count // 2):
        if fewer:
            yield tree | {"samples": tree["samples"] | {"count": fewer}}
    robots, points = tree["robots"]["count"], tree["energy"]["points"]
    for share in (8, 2):
        each = points // robots // share
        if each:
            yield tree | {"energy": {"points": each * robots, "steps": each}}


def _shorter_windows(tree: Tree) -> Iterator[Tree]:
    for place, fault in enumerate(tree["faults"]):
        until_s = fault.get("until_s")
        if until_s is None:
            continue
        middle_s = short(0.5 * (fault["from_s"] + until_s))
        for window in ({"until_s": middle_s}, {"from_s": middle_s}):
            faults = list(tree["faults"])
            faults[place] = fault | window
            yield tree | {"faults": faults}


_CHANGES: tuple[Callable[[Tree], Iterable[Tree]], ...] = (
    _fewer_faults,
    _fewer_robots,
    _no_supervisor,
    _plainer,
    _less_mass,
    _shorter_windows,
)
