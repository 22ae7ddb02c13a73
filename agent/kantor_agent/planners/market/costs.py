"""Costs of tours: how much longer a tour gets by a goal, and how much shorter without one."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.cost_map import CostMap
from kantor_protocol.base.grid import NOWHERE
from kantor_protocol.base.kernels import kernel

DistanceField = npt.NDArray[np.float64]
"""(cells,) cost of the way from one robot's place to every cell, unknown cells taken for open floor."""

NO_ROBOT = -1
"""In place of a robot."""

PER_CELL = 16
"""Prices and bids are whole numbers of this fraction of a cell: closer ones are equal."""
_PRICE_MAX = 1 << 40


class Costs:
    """Costs of ways from each robot's place to each goal, and from goal to goal, in cells.

    From a place it is the value function, with unknown cells taken for open floor. Between two goals it is
    the best lower bound without a field from either: the straight line, or the difference of their costs
    from one of the places (the triangle inequality; landmarks, Goldberg and Harrelson 2005). That is a metric
    and agrees with the costs from the places, so that no insertion shortens a tour. A field from every goal
    would cost as much again and make missions no shorter.
    """

    def __init__(
        self, cost_map: CostMap, fields: Sequence[DistanceField], goals: Iterable[int]
    ) -> None:
        """fields: one for each place. goals: cells; all goals of the tours that are asked for."""
        cells = np.array(sorted(set(goals)), dtype=np.int64)
        self._index = {cell: i for i, cell in enumerate(cells.tolist())}
        from_places = np.array([field[cells] for field in fields]).reshape(len(fields), cells.size)
        between = np.zeros((cells.size, cells.size))
        separate(from_places, cells, cost_map.frame.columns, between)
        self._from_places: list[list[float]] = from_places.tolist()
        self._between: list[list[float]] = between.tolist()

    def insertion(self, place: int, tour: Sequence[int], goal: int) -> tuple[float, int]:
        """The cheapest insertion of a goal into the tour from a place: how much longer, and before which goal.

        Of equal insertions the first is taken; infinite, and at the end, if no way leads to the goal.
        """
        cost, place_in_tour, last = math.inf, len(tour), len(tour)
        for i in range(last + 1):
            before = tour[i - 1] if i else NOWHERE
            longer = self.leg(place, before, goal)
            if i < last:
                longer += self.leg(place, goal, tour[i]) - self.leg(place, before, tour[i])
            if longer < cost:  # the difference of two infinite legs is no number, and not less
                cost, place_in_tour = longer, i
        return cost, place_in_tour

    def saving(self, place: int, tour: Sequence[int], goal: int) -> float:
        """How much shorter the tour from a place is without one of its goals."""
        i = tour.index(goal)
        before = tour[i - 1] if i else NOWHERE
        saved = self.leg(place, before, goal)
        if i + 1 < len(tour):
            saved += self.leg(place, goal, tour[i + 1]) - self.leg(place, before, tour[i + 1])
        return math.inf if math.isnan(saved) else saved

    def leg(self, place: int, one: int, other: int) -> float:
        """The cost from a goal, or from the place (one = NOWHERE), to a goal."""
        to = self._index[other]
        return (
            self._from_places[place][to] if one == NOWHERE else self._between[self._index[one]][to]
        )


@kernel
def separate(from_places: np.ndarray, cells: np.ndarray, columns: int, between: np.ndarray) -> None:
    """Write lower bounds on the costs of ways between goals into between (goals, goals); see `Costs`.

    from_places: (places, goals); cells: (goals,). Infinite if a place reaches one goal and not the other.
    """
    for a in range(cells.shape[0]):
        for b in range(cells.shape[0]):
            rows = cells[a] // columns - cells[b] // columns
            least = math.hypot(rows, cells[a] % columns - cells[b] % columns)
            for place in range(from_places.shape[0]):
                to_a, to_b = from_places[place, a], from_places[place, b]
                if to_a < math.inf or to_b < math.inf:
                    least = max(least, abs(to_a - to_b))
            between[a, b] = least


def price_of(cost: float) -> int:
    """A cost as a price or bid: a whole number of 1/PER_CELL of a cell."""
    return round(min(cost * PER_CELL, _PRICE_MAX))


def near(cost_map: CostMap, goal: int, others: Iterable[int]) -> bool:
    """Whether one of the others lies within half a sensor range of a goal, and so is as good."""
    half = 0.5 * cost_map.sensor_cells
    return any(cost_map.cells_between(goal, other) <= half for other in others)
