"""What a chart is to drive on: crossing costs, ways, and how far everything is."""

import math

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.mapping.routes import Routes, length_cost, smoothed_cost
from kantor_protocol.base.grid import FREE, NOWHERE, UNKNOWN
from kantor_protocol.scenario.schema import Scenario

_FREE_P = 0.05
"""What open floor costs on a smoothed map: the least probability that evidence gets to."""


class CostMap:
    """A chart with its costs, by the scenario's rule. Costs are in cells of open floor."""

    def __init__(self, scenario: Scenario, fused_map: FusedMap) -> None:
        self.fused_map = fused_map
        self.frame = fused_map.frame
        self.sensor_cells = scenario.sensor.range_m / fused_map.frame.resolution_m
        self._planner = scenario.planner
        self._routes = Routes(fused_map.frame.rows, fused_map.frame.columns)
        self._revision = -1
        self._cost = np.zeros(0)
        self._travel: dict[int, npt.NDArray[np.float64]] = {}

    @property
    def cost(self) -> npt.NDArray[np.float64]:
        """(cells,) of crossing each; inf where no way leads: walls, and what is unknown."""
        if self._revision != self.fused_map.revision:
            self._revision = self.fused_map.revision
            self._travel = {}
            self._cost = self._measured()
        return self._cost

    def travel(self, cell: int) -> npt.NDArray[np.float64]:
        """(cells,) the least cost of the way from a cell to every other; inf where there is none.

        The value function V of Burgard et al., section 2.2.1. Kept until the chart changes.
        """
        cost = self._with(cell, self.cost)
        if cell not in self._travel:
            self._travel[cell] = self._routes.spread(cost, cell).copy()
        return self._travel[cell]

    def optimistic(self, cell: int, *, until: int = NOWHERE) -> npt.NDArray[np.float64]:
        """`travel` for who takes what is unknown for open floor (Zlot et al.).

        until: cells that are farther than this one may have too high a value.
        """
        cost = np.where(self.fused_map.cells == UNKNOWN, 1.0, self.cost)
        return self._routes.spread(self._with(cell, cost), cell, until=until).copy()

    def way(self, cell: int, target: int) -> npt.NDArray[np.int64]:
        """The cells from here to there, both included; empty if there is no way."""
        self._routes.spread(self._with(cell, self.cost), cell, until=target)
        return self._routes.way(target)

    def cells_between(self, one: int, other: int) -> float:
        """As the crow flies, in cells."""
        columns = self.frame.columns
        return math.hypot(one // columns - other // columns, one % columns - other % columns)

    def _with(self, cell: int, cost: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The costs with an open cell where a robot stands: whatever noise says, there is no wall."""
        if 0 <= cell < cost.shape[0] and not np.isfinite(cost[cell]):
            cost = cost.copy()
            cost[cell] = 1.0
        return cost

    def _measured(self) -> npt.NDArray[np.float64]:
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
