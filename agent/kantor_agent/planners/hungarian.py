"""The cheapest assignment of robots to frontiers, by the Hungarian method: no utilities, costs alone.

Neighbouring frontiers cost nearly the same, so that robots would drive side by side to one opening. Robots
are therefore assigned to frontiers that lie half a sensor range apart, and as far from targets of others.
"""

import numpy as np
import numpy.typing as npt

from kantor_agent.planners.map_base import Situation, Task
from kantor_protocol.base.grid import NOWHERE
from kantor_protocol.base.kernels import kernel
from kantor_protocol.scenario.schema import Scenario

_SPACING_RANGES = 0.5
"""Least distance between two frontiers to choose from, in sensor ranges."""


@kernel
def spread_out(
    frontiers: np.ndarray,
    order: np.ndarray,
    taken: np.ndarray,
    spacing: float,
    columns: int,
    kept: np.ndarray,
) -> int:
    """Keep frontiers, in this order, that lie `spacing` cells from all kept and taken ones; returns how many.

    order: (k,) indices into `frontiers`; kept: (k,) output, likewise. taken: cells.
    """
    count = 0
    for i in range(order.shape[0]):
        cell = frontiers[order[i]]
        row, column = cell // columns, cell % columns
        near = False
        for j in range(taken.shape[0] + count):
            at = taken[j] if j < taken.shape[0] else frontiers[kept[j - taken.shape[0]]]
            rise, run = at // columns - row, at % columns - column
            if rise * rise + run * run < spacing * spacing:
                near = True
                break
        if not near:
            kept[count] = order[i]
            count += 1
    return count


class Hungarian:
    """The planner `hungarian`. Robots without a frontier of their own drive to their cheapest."""

    negotiates = False

    def __init__(self, _scenario: Scenario, _seed: int, _me: int | None) -> None:
        """The planner has no options."""

    def assign(self, situation: Situation, /) -> list[Task]:
        """A frontier for each member; no target for those that can reach none."""
        cost_map, frontiers = situation.cost_map, situation.frontiers
        if frontiers.size == 0:
            return [Task() for _ in situation.members]
        ways = [cost_map.travel(member.cell, frontiers) for member in situation.members]
        travel = np.array(ways)
        picked = travel.argmin(axis=1)
        spots = _find_spots(situation, travel.min(axis=0))
        for robot, spot in cheapest_pairs(travel[:, spots]):
            picked[robot] = spots[spot]
        reached = np.isfinite(travel[np.arange(picked.size), picked]).tolist()
        cells = frontiers[picked].tolist()
        return [Task(cell) if can else Task() for cell, can in zip(cells, reached, strict=True)]


def _find_spots(situation: Situation, cheapest: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Indices of frontiers that lie apart, cheapest first. cheapest: (f,) the cost for the nearest robot."""
    held = [member.task.target for member in situation.others]
    taken = [target for target in (*held, *situation.absent) if target != NOWHERE]
    order = np.argsort(cheapest, kind="stable")[: np.isfinite(cheapest).sum()]
    kept = np.empty_like(order)
    count = spread_out(
        situation.frontiers,
        order,
        np.array(taken, dtype=np.int64),
        _SPACING_RANGES * situation.cost_map.sensor_cells,
        situation.cost_map.frame.columns,
        kept,
    )
    return kept[:count]


def cheapest_pairs(travel: npt.NDArray[np.float64]) -> list[tuple[int, int]]:
    """Pairs (robot, spot), as many as possible, of least total cost. travel: (robots, spots), inf without a way."""
    possible = np.isfinite(travel)
    if not possible.any():
        return []
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  20 MB that other planners do without

    never = (min(travel.shape) + 1.0) * (travel[possible].max() + 1.0)
    robots, spots = linear_sum_assignment(np.where(possible, travel, never))
    pairs = zip(robots.tolist(), spots.tolist(), strict=True)
    return [pair for pair in pairs if possible[pair]]
