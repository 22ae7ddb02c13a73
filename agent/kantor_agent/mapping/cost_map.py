"""The fused map as a map to drive on: the cost of crossing each cell, ways, and distances."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_agent.mapping.fused_map import P_OCC, FusedMap
from kantor_agent.mapping.routes import (
    COST_MIN,
    Answers,
    Routes,
    gaussian,
    iterate_once,
    length_cost,
    shared_scratch,
    smoothed_cost,
    widened,
)
from kantor_agent.mapping.routes import UNKNOWN as UNKNOWN_P
from kantor_protocol.base.grid import FREE, NOWHERE, UNKNOWN
from kantor_protocol.base.kernels import kernel
from kantor_protocol.scenario.schema import Scenario

_FREE_P = 0.05
"""Cost of open floor on a smoothed map: the least probability of occupancy that evidence gets to."""

Boxes = npt.NDArray[np.int64]
"""(n, 4) parts of the map: rows and columns, from and below."""

_NO_CELL = np.zeros(0, dtype=np.int64)


@kernel
def _renew_lengths(cost: np.ndarray, columns: int, boxes: np.ndarray, cells: np.ndarray) -> None:
    """`length_cost` within boxes, with 0 instead of inf."""
    for i in range(boxes.shape[0]):
        bottom, top, left, right = boxes[i]
        for row in range(bottom, top):
            for cell in range(row * columns + left, row * columns + right):
                cost[cell] = 1.0 if cells[cell] == FREE else 0.0


@kernel
def _fill_row(
    row: int,
    columns: int,
    first: int,
    cells: np.ndarray,
    votes: np.ndarray,
    bumps: np.ndarray,
    p_occ: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write the occupancy of a row of the map from a column on, which may lie beside the map: it goes on there."""
    for i in range(out.shape[0]):
        cell = row * columns + min(max(first + i, 0), columns - 1)
        vote = min(max(votes[cell], -1), 1)
        p = p_occ[2] if bumps[cell] else p_occ[vote + 1]
        out[i] = UNKNOWN_P if cells[cell] == UNKNOWN else p


class _Smoothing(NamedTuple):
    """What smoothed costs are computed from, and scratch."""

    cells: npt.NDArray[np.uint8]
    votes: npt.NDArray[np.int16]
    bumps: npt.NDArray[np.bool_]
    """(cells,) each: the evidence of the fused map."""
    p_occ: npt.NDArray[np.float64]
    """`P_OCC`."""
    p_max: float
    weights: npt.NDArray[np.float64]
    """(reach + 1,) of the Gaussian, from its middle."""
    ring: npt.NDArray[np.float64]
    """(2 reach + 1, columns + 2 reach) scratch: the occupancy of the rows around."""
    column_sums: npt.NDArray[np.float64]
    """(columns + 2 reach,) scratch."""


@kernel
def _renew_box(
    cost: np.ndarray,
    columns: int,
    bottom: int,
    top: int,
    left: int,
    right: int,
    smoothing: _Smoothing,
) -> None:
    """`smoothed_cost` within a box, in cells of open floor and with 0 instead of inf."""
    cells, votes, bumps, p_occ, p_max, weights, ring, column_sums = smoothing
    reach, rows = weights.shape[0] - 1, cells.shape[0] // columns
    wide = right - left + 2 * reach
    size = 2 * reach + 1
    for row in range(bottom - reach, top + reach):
        on_map = min(max(row, 0), rows - 1)
        _fill_row(
            on_map, columns, left - reach, cells, votes, bumps, p_occ, ring[row % size, :wide]
        )
        middle = row - reach
        if middle < bottom:
            continue
        here = ring[middle % size]
        for i in range(wide):
            column_sums[i] = here[i] * weights[0]
        for k in range(reach, 0, -1):
            below, above = ring[(middle - k) % size], ring[(middle + k) % size]
            for i in range(wide):
                column_sums[i] += (below[i] + above[i]) * weights[k]
        for i in range(right - left):
            cell, p = middle * columns + left + i, here[reach + i]
            cost[cell] = 0.0
            if cells[cell] == UNKNOWN or not p < p_max:
                continue
            smooth = column_sums[reach + i] * weights[0]
            for k in range(reach, 0, -1):
                smooth += (column_sums[reach + i - k] + column_sums[reach + i + k]) * weights[k]
            cost[cell] = max(smooth, COST_MIN) / _FREE_P


@kernel
def _renew_smoothed(
    cost: np.ndarray, columns: int, boxes: np.ndarray, fields: tuple[Any, ...]
) -> None:
    """Renew the costs that cells within boxes have changed. fields: of a _Smoothing."""
    smoothing = _Smoothing(*fields)
    reach, rows = smoothing.weights.shape[0] - 1, smoothing.cells.shape[0] // columns
    for i in range(boxes.shape[0]):
        bottom, top, left, right = widened(boxes[i], reach, rows, columns)
        _renew_box(cost, columns, bottom, top, left, right, smoothing)


@kernel
def _renew_hopeful(
    hopeful: np.ndarray,
    columns: int,
    boxes: np.ndarray,
    reach: int,
    cells: np.ndarray,
    cost: np.ndarray,
) -> None:
    """The costs within boxes and around them, with unknown cells taken for open floor."""
    for i in range(boxes.shape[0]):
        box = widened(boxes[i], reach, cells.shape[0] // columns, columns)
        bottom, top, left, right = box
        for row in range(bottom, top):
            for cell in range(row * columns + left, row * columns + right):
                hopeful[cell] = 1.0 if cells[cell] == UNKNOWN else cost[cell]


class CostMap:
    """A fused map with its costs, by the scenario's rule. Costs are in cells of open floor.

    What is read agrees with the fused map as it is: costs are renewed where that has changed. `validate` asserts it.
    """

    def __init__(self, scenario: Scenario, fused_map: FusedMap) -> None:
        """scenario: its planner has the rule of costs, its sensor the range. Nobody else takes the map's boxes."""
        self.fused_map = fused_map
        self.frame = fused_map.frame
        self.sensor_cells = scenario.sensor.range_m / fused_map.frame.resolution_m
        """The sensor's range, in cells."""
        self._planner = scenario.planner
        smoothed = scenario.planner.cost != "length"
        self._weights = gaussian(scenario.planner.smoothing_cells) if smoothed else np.ones(1)
        self._reach = self._weights.shape[0] - 1
        """How far a cell's occupancy changes costs."""
        rows, columns = self._grid = self.frame.rows, self.frame.columns
        self._scratch = shared_scratch(rows, columns)
        self._answers: Answers | None = None
        """Of the present costs, from the scratch; None before the first question."""
        self._routes = Routes(rows, columns, self._scratch)
        """Over the costs of the fused map in `_revision`."""
        self._revision = -1
        self._hopeful: Routes | None = None
        """The same with unknown cells taken for open floor; None until it is asked for."""
        size = 2 * self._reach + 1
        self._ring = np.empty((size, columns + size - 1) if smoothed else (0, 0))
        self._column_sums = np.empty(self._ring.shape[1])

    def validate(self) -> None:
        """Assert that costs agree with the fused map. That has a `validate` of its own."""
        routes = self._renewed()
        assert np.array_equal(np.where(routes.cost > 0.0, routes.cost, np.inf), self._plain_cost())
        cost = np.where(routes.cost > 0.0, routes.cost, np.inf).reshape(self._grid)
        for source in np.flatnonzero(routes.cost)[:1].tolist():
            value = self.travel(source).reshape(self._grid)
            assert np.array_equal(iterate_once(cost, value, source), value)

    def travel(self, cell: int, to: npt.NDArray[np.int64] | None = None) -> npt.NDArray[np.float64]:
        """The least cost of the way from a cell to others; inf where there is none.

        to: (n,) these cells; by default all. Do not change the array. The value function V of Burgard et al., section 2.2.1.
        """
        routes = self._renewed()
        if to is None:
            with _opened(routes, cell):
                return routes.spread_from(cell, _NO_CELL).copy()
        if self._answers is None:
            self._answers = self._scratch.answers(routes.cost)
        asked = (cell, to.tobytes())
        if not to.size:
            return np.zeros(0)
        if asked not in self._answers:
            with _opened(routes, cell):
                self._answers[asked] = routes.spread_from(cell, to)[to]
        return self._answers[asked]

    def reaches_frontier(self, cell: int) -> bool:
        """Whether a way leads from a cell to any frontier."""
        with _opened(self._renewed(), cell) as routes:
            return routes.reaches(cell, self.fused_map.is_live)

    def optimistic(self, cell: int, *, until: int = NOWHERE) -> npt.NDArray[np.float64]:
        """(cells,) `travel` with unknown cells taken for open floor (Zlot et al.).

        until: cells that are farther than this one may have too high a value.
        """
        self._renewed()
        if self._hopeful is None:
            self._hopeful = Routes(*self._grid, self._scratch)
            self._hope(self._hopeful, np.array([[0, self.frame.rows, 0, self.frame.columns]]))
        with _opened(self._hopeful, cell) as routes:
            return routes.spread_from(cell, np.array([until])).copy()

    def way(self, cell: int, target: int) -> npt.NDArray[np.int64]:
        """The cells of the cheapest way to a target, both ends included; empty if there is none."""
        with _opened(self._renewed(), cell) as routes:
            routes.spread_from(cell, np.array([target]))
            return routes.way(target)

    def cells_between(self, one: int, other: int) -> float:
        """The straight-line distance of two cells, in cells."""
        columns = self.frame.columns
        return math.hypot(one // columns - other // columns, one % columns - other % columns)

    def _renewed(self) -> Routes:
        """The routes over the fused map as it is."""
        if self._revision != self.fused_map.revision:
            self._revision, self._answers = self.fused_map.revision, None
            boxes = self.fused_map.take_boxes()
            self._renew(boxes)
            self._routes.renew(boxes, self._reach)
            if self._hopeful is not None:
                self._hope(self._hopeful, boxes)
        return self._routes

    def _renew(self, boxes: Boxes) -> None:
        part = (self._routes.cost, self.frame.columns, boxes)
        if self._planner.cost == "length":
            _renew_lengths(*part, self.fused_map.cells)
            return
        rule = (P_OCC, self._planner.occupied_from, self._weights)
        _renew_smoothed(*part, (*self.fused_map.evidence, *rule, self._ring, self._column_sums))

    def _hope(self, hopeful: Routes, boxes: Boxes) -> None:
        grid = (hopeful.cost, self.frame.columns, boxes, self._reach)
        _renew_hopeful(*grid, self.fused_map.cells, self._routes.cost)
        hopeful.renew(boxes, self._reach)

    def _plain_cost(self) -> npt.NDArray[np.float64]:
        """(cells,) the costs by the plain rules, inf where no way leads."""
        fused_map, planner = self.fused_map, self._planner
        if planner.cost == "length":
            return length_cost(fused_map.cells == FREE)
        smoothed = smoothed_cost(
            fused_map.p_occ().reshape(self._grid),
            fused_map.explored().reshape(self._grid),
            sigma_cells=planner.smoothing_cells,
            p_max=planner.occupied_from,
        )
        return np.asarray(smoothed.ravel() / _FREE_P)


@contextmanager
def _opened(routes: Routes, cell: int) -> Iterator[Routes]:
    """Routes with an open cell where a robot stands: whatever noise says, there is no wall."""
    if not 0 <= cell < routes.cells or routes.cost[cell] > 0.0:
        yield routes
        return
    row, column = divmod(cell, routes.columns)
    box = np.array([[row, row + 1, column, column + 1]])
    routes.cost[cell] = 1.0
    routes.renew(box)
    try:
        yield routes
    finally:
        routes.cost[cell] = 0.0
        routes.renew(box)
