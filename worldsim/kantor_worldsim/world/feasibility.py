"""Whether a scenario can work on its ground: what is refused, and what is doubted, before a mission begins."""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE
from kantor_protocol.replication.occupancy_log import CODES
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.maps import Ground

_GAP_DEG = 45.0
"""From anywhere in a cell each of the four cells beside it fills at least such an angle."""
_OUTSIDE = 0.2
"""The share of samples outside the domain from which on it is no longer the tail of a density."""


def doubts_of_map(
    scenario: Scenario, ground: Ground, starts_m: npt.NDArray[np.float64]
) -> list[str]:
    """Reasons why a mission on a map may leave ground unseen, one line each.

    starts_m: (n, 2) of the robots. Raises ScenarioError if no robot can explore anything.
    """
    for complaint in _complaints_of_map(scenario, ground.frame.resolution_m):
        raise ScenarioError(complaint)
    return list(_doubts_of_map(scenario, ground, starts_m))


def _complaints_of_map(scenario: Scenario, resolution_m: float) -> Iterator[str]:
    range_m = scenario.sensor.range_m
    if range_m <= resolution_m / 2.0:
        yield (
            f"sensor.range_m: {range_m:g} m, and a cell is {resolution_m:g} m wide: a robot sees no cell beside "
            f"its own; give at least {resolution_m:g} m, or a smaller map.resolution_m"
        )
    if range_m / CODES > resolution_m / 2.0:
        yield (
            f"sensor.range_m: {range_m:g} m is measured in steps of {range_m / CODES:g} m, and a cell is "
            f"{resolution_m:g} m wide; give at most {CODES * resolution_m / 2.0:g} m, or a larger map.resolution_m"
        )


def _doubts_of_map(
    scenario: Scenario, ground: Ground, starts_m: npt.NDArray[np.float64]
) -> Iterator[str]:
    sensor, resolution_m = scenario.sensor, ground.frame.resolution_m
    step_m = scenario.vehicle.speed_m_s * scenario.clock.period_s
    if sensor.range_m < resolution_m:
        yield (
            f"sensor.range_m: {sensor.range_m:g} m is shorter than a cell of {resolution_m:g} m: from the border "
            "of its cell a robot does not see the cell beside it, and cells may stay unseen"
        )
    if sensor.field_of_view_deg / sensor.beams > _GAP_DEG:
        needed = math.ceil(sensor.field_of_view_deg / _GAP_DEG)
        yield (
            f"sensor.beams: {sensor.beams} over {sensor.field_of_view_deg:g} degrees pass by whole cells, which "
            f"may stay unseen; give at least {needed}"
        )
    if step_m > sensor.range_m:
        yield (
            f"vehicle.speed_m_s: a robot drives {step_m:g} m in a period and sees {sensor.range_m:g} m far; "
            "it decides too rarely to explore well"
        )
    limit_s = math.inf if scenario.limit_s is None else scenario.limit_s
    if scenario.vehicle.speed_m_s * limit_s < resolution_m:
        yield (
            f"vehicle.speed_m_s: until limit_s = {limit_s:g} s a robot drives "
            f"{scenario.vehicle.speed_m_s * limit_s:g} m, less than a cell of {resolution_m:g} m"
        )
    if not _fits(ground, starts_m, scenario.vehicle.radius_m / resolution_m):
        yield (
            f"vehicle.radius_m: a body {2.0 * scenario.vehicle.radius_m:g} m wide does not fit through every "
            "passage of the map; walls stop its centre alone, so that it passes nevertheless"
        )


def _fits(ground: Ground, starts_m: npt.NDArray[np.float64], radius_cells: float) -> bool:
    """Whether a round body gets from anywhere where it has room to all other such places."""
    if radius_cells <= 0.5:
        return True  # the narrowest passage is a cell wide
    from scipy.ndimage import distance_transform_edt, label  # noqa: PLC0415  slow to import

    from kantor_worldsim.world.starts import observable  # noqa: PLC0415  likewise

    free = observable(ground, starts_m) & (ground.cells == FREE)
    room_cells = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] - 0.5
    return bool(label(room_cells >= radius_cells)[1] == 1)


def doubts_of_density(scenario: Scenario, samples_m: npt.NDArray[np.float64]) -> list[str]:
    """Reasons why a mission on a density may search in vain, one line each."""
    low, high = scenario.domain.min_m, scenario.domain.max_m
    inside = ((samples_m >= low) & (samples_m <= high)).all(axis=1)
    outside = int((~inside).sum())
    place = f"[{low[0]:g}, {high[0]:g}] x [{low[1]:g}, {high[1]:g}]"
    from_file = scenario.samples.file is not None
    if outside and (from_file or outside > _OUTSIDE * samples_m.shape[0]):
        return [f"samples: {outside} of {samples_m.shape[0]} lie outside the domain {place}"]
    return []
