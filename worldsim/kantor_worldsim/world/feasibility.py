"""Whether a scenario can work on its ground: what is refused, and what is doubted, before a mission begins."""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE
from kantor_protocol.base.kernels import kernel
from kantor_protocol.replication.occupancy_log import CODES
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.maps import Ground, parts

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
    from kantor_worldsim.world.starts import observable  # noqa: PLC0415  only where there is a map

    free = observable(ground, starts_m) & (ground.cells == FREE)
    return len(parts(find_room(free, radius_cells))[1]) == 2


def find_room(free: npt.NDArray[np.bool_], radius_cells: float) -> npt.NDArray[np.uint8]:
    """(rows, columns) FREE in the cells in which a round body has room. free: the same shape."""
    room = np.zeros(free.shape, dtype=np.uint8)
    _find_room(free, radius_cells, np.zeros(free.shape, dtype=np.int32), room)
    return room


@kernel
def _find_room(free: np.ndarray, radius_cells: float, height: np.ndarray, room: np.ndarray) -> None:
    """Mark the cells in which a round body has room as FREE.

    free, room: (rows, columns). height: the same shape, scratch: the distance to what is not free in a column.
    """
    rows, columns = free.shape
    reach = int(radius_cells + 0.5) + 1
    for column in range(columns):
        above = 0
        for row in range(rows):
            above = above + 1 if free[row, column] else 0
            height[row, column] = above
        above = 0
        for row in range(rows - 1, -1, -1):
            above = above + 1 if free[row, column] else 0
            height[row, column] = min(height[row, column], above)
    for row in range(rows):
        for column in range(columns):
            least = 1 << 60
            for beside in range(column - reach, column + reach + 1):
                tall = height[row, beside] if 0 <= beside < columns else 0
                least = min(least, (beside - column) ** 2 + tall * tall)
            if math.sqrt(least) - 0.5 >= radius_cells:
                room[row, column] = FREE


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
