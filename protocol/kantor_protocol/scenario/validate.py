"""Reasons why a scenario cannot be run, beyond what its types express."""

import math
from collections.abc import Iterable
from typing import Any

from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.file_names import path_of
from kantor_protocol.scenario.schema import MAP_PLANNERS, Domain, Scenario
from kantor_protocol.scenario.validate_faults import complaints_of_faults

_PERIODS_UNDER_WAY = 1000
"""Replicas keep log lengths for as long as an acknowledgement may take."""


def complaints(scenario: Scenario) -> Iterable[str]:
    """Reasons why a scenario cannot be run: `key: what, and the remedy`. The first one is reported."""
    yield from unusable_numbers(to_tree(scenario))
    yield from _complaints_of_map(scenario) if scenario.map else _complaints_of_density(scenario)
    yield from complaints_of_faults(scenario.faults, scenario)
    for key, name in (("samples", scenario.samples.file), ("targets", scenario.targets.file)):
        if name is not None and path_of(name).suffix.lower() not in POINT_FILES | IMAGE_FILES:
            known = ", ".join(sorted(POINT_FILES | IMAGE_FILES))
            yield f"{key}.file: {name} has an unknown kind; use one of {known}"
    clock = scenario.clock
    shortest_s = clock.period_s * (1.0 - clock.spread) * (1.0 - clock.drift_ppm * 1e-6)
    if clock.jitter_s + 1e-9 >= shortest_s:  # a step must not overtake the next one
        yield f"clock.jitter_s: must be below the shortest period after spread and drift, {shortest_s:g} s"
    if scenario.radio.delay_s + scenario.radio.jitter_s > _PERIODS_UNDER_WAY * shortest_s:
        yield f"radio.delay_s: with the jitter over {_PERIODS_UNDER_WAY} periods; make it shorter"


def _complaints_of_density(scenario: Scenario) -> Iterable[str]:
    (x_min, y_min), (x_max, y_max) = scenario.domain.min_m, scenario.domain.max_m
    if scenario.domain == Domain(min_m=(0.0, 0.0), max_m=(0.0, 0.0)):
        yield "domain: missing; set it"
    if x_min >= x_max or y_min >= y_max:
        yield "domain: min_m must lie below max_m in x and in y"
    yield from _complaints_of_starts(scenario)
    if scenario.planner.name in MAP_PLANNERS:
        yield f"planner.name: {scenario.planner.name} explores a map; add a [map]"
    image_or_mixture = scenario.samples.file is None or is_image(scenario.samples.file)
    if scenario.samples.file is None and not scenario.density:
        yield "samples: no source; add [[density]] tables or set samples.file"
    if image_or_mixture and scenario.samples.count is None:
        yield "samples.count: missing; set the number of samples N"
    if scenario.energy.points == 0:
        yield "energy: missing; set it"
    if scenario.energy.points < scenario.robots.count:
        yield "energy.points: fewer than robots; set at least one point for each"


def _complaints_of_map(scenario: Scenario) -> Iterable[str]:
    assert scenario.map is not None
    if (scenario.map.file is None) == (scenario.map.layout is None):
        yield "map: set either map.file or map.layout"
    if scenario.map.file is not None and scenario.map.size_m is not None:
        yield "map.size_m: only for a layout; a file has a size of its own"
    if scenario.planner.name not in MAP_PLANNERS:
        known = ", ".join(sorted(MAP_PLANNERS))
        yield f"planner.name: {scenario.planner.name} explores a density; on a map use {known}"
    if (
        scenario.density
        or scenario.samples.file
        or scenario.samples.count
        or scenario.energy.points
    ):
        yield "map: cannot be joined with a density; remove density, samples and energy"
    if scenario.vehicle.name == "dubins":
        yield "vehicle.name: dubins cannot stop at a wall; use first-order, second-order or unicycle"
    if scenario.targets.file is None and scenario.targets.count:
        yield "targets.count: on a map targets come from a file; set targets.file"
    if not scenario.starts.random and len(scenario.starts.poses_m) != scenario.robots.count:
        yield _starts_given(scenario)
    bounded = scenario.centralized and scenario.supervisor.range_m != math.inf
    if bounded and scenario.supervisor.pose_m is None:
        yield "supervisor.pose_m: missing; a supervisor of limited range needs its place"


def _starts_given(scenario: Scenario) -> str:
    return (
        f"starts.poses_m: {len(scenario.starts.poses_m)} given for {scenario.robots.count} robots; "
        f"give one for each or set starts.random=true"
    )


def unusable_numbers(tree: Any, path: str = "") -> Iterable[str]:
    """Reasons for numbers that no run can work with. A radio range may be as large as it wants, and infinite."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from unusable_numbers(value, f"{path}.{key}".lstrip("."))
    elif isinstance(tree, list):
        for i, value in enumerate(tree):
            yield from unusable_numbers(value, f"{path}[{i}]")
    elif isinstance(tree, float) and not (tree >= 0.0 and path in _BOUNDLESS):
        if not math.isfinite(tree):
            yield f"{path}: {tree} is no usable number; set a finite one"
        elif abs(tree) > NUMBER_MAX:
            yield f"{path}: {tree:g} is no usable number; stay within {NUMBER_MAX:g}"


_BOUNDLESS = frozenset({"radio.range_m", "supervisor.range_m"})
NUMBER_MAX = 1e30
"""Largest number in a scenario: its fourth power is still a number."""


def _complaints_of_starts(scenario: Scenario) -> Iterable[str]:
    starts, count = scenario.starts, scenario.robots.count
    if starts.random:
        return
    if len(starts.poses_m) != count:
        yield _starts_given(scenario)
    (x_min, y_min), (x_max, y_max) = scenario.domain.min_m, scenario.domain.max_m
    for i, (x, y) in enumerate(starts.poses_m):
        if not (x_min <= x <= x_max and y_min <= y <= y_max):
            yield (
                f"starts.poses_m[{i}]: ({x:g}, {y:g}) is outside the domain; move it inside "
                f"[{x_min:g}, {x_max:g}] x [{y_min:g}, {y_max:g}]"
            )


POINT_FILES = frozenset({".csv", ".npy"})


IMAGE_FILES = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".tif", ".tiff", ".bmp"})


def is_image(name: str) -> bool:
    """Whether a file name stands for a grey-scale density."""
    return path_of(name).suffix.lower() in IMAGE_FILES
