"""Proposals of goals in unexplored space: at random, greedily, or from a quadtree."""

import math
from collections.abc import Iterable

import numpy as np

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners.market.costs import DistanceField
from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.grid import UNKNOWN
from kantor_protocol.base.kernels import kernel

_UNKNOWN_SHARE = 0.25
"""quadtree: a part of the map of which a larger share is unknown is split, or becomes a goal."""
_LEAF_RANGES = 2.0
"""quadtree: a part that is no longer than this, in sensor ranges, is not split."""


def random_goals(cost_map: CostMap, seed: int, robot: int, tick: int, count: int) -> list[int]:
    """`count` cells drawn from the whole map, anew in every tick, without those that are known."""
    cells = cost_map.frame.cells
    drawn = [
        int(uniform(seed, Purpose.MARKET, robot, tick, index) * cells) for index in range(count)
    ]
    return [cell for cell in dict.fromkeys(drawn) if cost_map.fused_map.cells[cell] == UNKNOWN]


@kernel
def clear_disc(values: np.ndarray, columns: int, cell: int, radius_cells: float) -> None:
    """Set values (cells,) to infinity within less than a radius of a cell, and at the cell itself."""
    row, column = cell // columns, cell % columns
    rows, reach = values.shape[0] // columns, int(radius_cells)
    for i in range(max(0, row - reach), min(rows, row + reach + 1)):
        for j in range(max(0, column - reach), min(columns, column + reach + 1)):
            if math.hypot(i - row, j - column) < radius_cells or (i == row and j == column):
                values[i * columns + j] = math.inf


def greedy_goals(
    cost_map: CostMap, field: DistanceField, held: Iterable[int], count: int
) -> list[int]:
    """Unknown cells that are cheapest to get to, at least a sensor range from one another.

    Cells within half a range of a held goal are left out; of equal ones the lowest is taken.
    """
    columns, range_cells = cost_map.frame.columns, cost_map.sensor_cells
    values = np.where(cost_map.fused_map.cells == UNKNOWN, field, np.inf)
    for cell in held:
        clear_disc(values, columns, cell, math.nextafter(0.5 * range_cells, math.inf))
    goals: list[int] = []
    while len(goals) < count and values.size:
        goal = int(values.argmin())
        if values[goal] == math.inf:
            break
        goals.append(goal)
        clear_disc(values, columns, goal, range_cells)
    return goals


def quadtree_goals(cost_map: CostMap) -> list[int]:
    """Unknown centres of the leaves of a quadtree over the map, rising.

    A part of the map of which a quarter or less is unknown is left out. Otherwise it is halved along both
    sides if one is longer than two sensor ranges, and is a leaf if not.
    """
    rows, columns = cost_map.frame.rows, cost_map.frame.columns
    unknown = (cost_map.fused_map.cells == UNKNOWN).reshape(rows, columns)
    sums = np.zeros((rows + 1, columns + 1), dtype=np.int64)
    sums[1:, 1:] = unknown.cumsum(axis=0).cumsum(axis=1)
    longest = max(1.0, _LEAF_RANGES * cost_map.sensor_cells)
    parts, goals = [(0, rows, 0, columns)], []
    while parts:
        low, high, left, right = parts.pop()
        area = (high - low) * (right - left)
        inside = sums[high, right] - sums[low, right] - sums[high, left] + sums[low, left]
        if inside <= _UNKNOWN_SHARE * area:
            continue
        row, column = (low + high) // 2, (left + right) // 2
        if max(high - low, right - left) > longest:
            halves = [(low, row), (row, high)], [(left, column), (column, right)]
            parts += [(*below, *across) for below in halves[0] for across in halves[1]]
        elif unknown[row, column]:
            goals.append(row * columns + column)
    return sorted(goals)
