"""The fused map as a map to drive on: the cost of crossing each cell, ways, and distances."""

import math

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.mapping.routes import Routes, iterate_once, length_cost, smoothed_cost
from kantor_protocol.base.grid import FREE, NOWHERE, UNKNOWN
from kantor_protocol.scenario.schema import Scenario

_FREE_P = 0.05
"""Cost of open floor on a smoothed map: the least probability of occupancy that evidence gets to."""


class CostMap:
    """A fused map with its costs, by the scenario's rule. Costs are in cells of open floor.

    What is cached is of one revision of the fused map, and is computed anew when it is read after that
    has changed. `validate` asserts what the attributes say.
    """

    def __init__(self, scenario: Scenario, fused_map: FusedMap) -> None:
        """scenario: its planner has the rule of costs, its sensor the range."""
        self.fused_map = fused_map
        self.frame = fused_map.frame
        self.sensor_cells = scenario.sensor.range_m / fused_map.frame.resolution_m
        """The sensor's range, in cells."""
        self._planner = scenario.planner
        self._routes = Routes(fused_map.frame.rows, fused_map.frame.columns)
        self._revision = -1
        """The revision of `fused_map` that the cached costs belong to."""
        self._cost = np.zeros(0)
        """(cells,) `cost` of the fused map while `_revision` is its revision, else out of date."""
        self._travel: dict[int, npt.NDArray[np.float64]] = {}
        """By source, (cells,) the value function over `_cost`, with an open cell at the source."""

    def validate(self) -> None:
        """Assert what the attributes say of one another. The fused map has a `validate` of its own."""
        if self._revision != self.fused_map.revision:
            return
        assert np.array_equal(self._cost, self._compute_cost())
        shape = (self.frame.rows, self.frame.columns)
        for source, value in self._travel.items():
            cost = self._opened(source, self._cost).reshape(shape)
            assert np.array_equal(iterate_once(cost, value.reshape(shape), source).ravel(), value)

    @property
    def cost(self) -> npt.NDArray[np.float64]:
        """(cells,) of crossing each; inf where no way leads: walls, and what is unknown."""
        if self._revision != self.fused_map.revision:
            self._revision = self.fused_map.revision
            self._travel = {}
            self._cost = self._compute_cost()
        return self._cost

    def travel(self, cell: int) -> npt.NDArray[np.float64]:
        """(cells,) the least cost of the way from a cell to every other; inf where there is none.

        The value function V of Burgard et al., section 2.2.1. Kept until the fused map changes.
        """
        cost = self._opened(cell, self.cost)
        if cell not in self._travel:
            self._travel[cell] = self._routes.spread(cost, cell).copy()
        return self._travel[cell]

    def optimistic(self, cell: int, *, until: int = NOWHERE) -> npt.NDArray[np.float64]:
        """(cells,) `travel` with unknown cells taken for open floor (Zlot et al.).

        until: cells that are farther than this one may have too high a value.
        """
        cost = np.where(self.fused_map.cells == UNKNOWN, 1.0, self.cost)
        return self._routes.spread(self._opened(cell, cost), cell, until=until).copy()

    def way(self, cell: int, target: int) -> npt.NDArray[np.int64]:
        """The cells of the cheapest way to a target, both ends included; empty if there is none."""
        self._routes.spread(self._opened(cell, self.cost), cell, until=target)
        return self._routes.way(target)

    def cells_between(self, one: int, other: int) -> float:
        """The straight-line distance of two cells, in cells."""
        columns = self.frame.columns
        return math.hypot(one // columns - other // columns, one % columns - other % columns)

    def _opened(self, cell: int, cost: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The costs with an open cell where a robot stands: whatever noise says, there is no wall."""
        if 0 <= cell < cost.shape[0] and not np.isfinite(cost[cell]):
            cost = cost.copy()
            cost[cell] = 1.0
        return cost

    def _compute_cost(self) -> npt.NDArray[np.float64]:
        fused_map, planner = self.fused_map, self._planner
        if planner.cost == "length":
            return length_cost(fused_map.cells == FREE)
        shape = (self.frame.rows, self.frame.columns)
        smoothed = smoothed_cost(
            fused_map.p_occ().reshape(shape),
            fused_map.explored().reshape(shape),
            sigma_cells=planner.smoothing_cells,
            p_max=planner.occupied_from,
        )
        return np.asarray(smoothed.ravel() / _FREE_P)
