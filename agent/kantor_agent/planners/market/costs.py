"""Costs of tours: what it takes to insert a goal, and what its removal saves."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.cost_map import CostMap
from kantor_protocol.base.grid import NOWHERE
from kantor_protocol.base.kernels import kernel

Cells = Sequence[int]


DistanceField = npt.NDArray[np.float64]
"""(cells,) from one robot's place, over what is unknown as well."""


NOBODY = -1


PER_CELL = 16
"""Prices and bids are counted in such parts of a cell: closer ones are equal."""
_PRICE_MAX = 1 << 40


class Costs:
    """What goals cost: from each robot's place to each goal, and from goal to goal, in cells.

    From a place it is the value function, with what is unknown taken for open floor. Between two goals it is
    the most that follows without a field from either: the straight line, or the difference of what both cost
    from one of the places (the triangle inequality; landmarks, Goldberg and Harrelson 2005). That is a metric
    and agrees with the costs from the places, so that no insertion shortens a tour. A field from every goal
    would cost as much again and make missions no shorter.
    """

    def __init__(
        self, cost_map: CostMap, fields: Sequence[DistanceField], goals: Iterable[int]
    ) -> None:
        cells = np.array(sorted(set(goals)), dtype=np.int64)
        self._index = {cell: i for i, cell in enumerate(cells.tolist())}
        from_places = np.array([field[cells] for field in fields]).reshape(len(fields), cells.size)
        between = np.zeros((cells.size, cells.size))
        separate(from_places, cells, cost_map.frame.columns, between)
        self._from_places: list[list[float]] = from_places.tolist()
        self._between: list[list[float]] = between.tolist()

    def insertion(self, place: int, tour: Cells, goal: int) -> tuple[float, int]:
        """How much longer a goal makes the tour from a place, inserted where that is least, and there.

        Of equal insertions the first is taken; infinite if there is none.
        """
        cost, slot, last = math.inf, len(tour), len(tour)
        for i in range(last + 1):
            before = tour[i - 1] if i else NOWHERE
            longer = self._leg(place, before, goal)
            if i < last:
                longer += self._leg(place, goal, tour[i]) - self._leg(place, before, tour[i])
            if longer < cost:  # the difference of two infinite legs is no number, and not less
                cost, slot = longer, i
        return cost, slot

    def saving(self, place: int, tour: Cells, goal: int) -> float:
        """How much shorter the tour from a place is without one of its goals."""
        i = tour.index(goal)
        before = tour[i - 1] if i else NOWHERE
        saved = self._leg(place, before, goal)
        if i + 1 < len(tour):
            saved += self._leg(place, goal, tour[i + 1]) - self._leg(place, before, tour[i + 1])
        return math.inf if math.isnan(saved) else saved

    def _leg(self, place: int, one: int, other: int) -> float:
        """From a goal, or from the place (NOWHERE), to a goal."""
        to = self._index[other]
        return (
            self._from_places[place][to] if one == NOWHERE else self._between[self._index[one]][to]
        )


@kernel
def separate(from_places: np.ndarray, cells: np.ndarray, columns: int, between: np.ndarray) -> None:
    """Fill between (goals, goals), the least that ways between goals can cost; see `Costs`.

    from_places: (places, goals); cells: (goals,). Infinite if one is reached from a place and the other not.
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
    """A cost as it is announced."""
    return round(min(cost * PER_CELL, _PRICE_MAX))


def near(cost_map: CostMap, goal: int, others: Iterable[int]) -> bool:
    """Whether one of others is as good as a goal: it lies within half a sensor range."""
    half = 0.5 * cost_map.sensor_cells
    return any(cost_map.cells_between(goal, other) <= half for other in others)
