"""CPU time of the value function over a whole map, compared with two libraries.

Maps of which a fifth is wall, from one corner: an office, and single walls scattered over open floor.
The others are scikit-image's MCP_Geometric, of which only find_costs counts, and scipy's Dijkstra, to
which building its graph belongs, since a map under exploration is never the same twice.

    pip install --group peers
"""

import math
import statistics
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from tables import Table, verdict

from kantor_agent.mapping.routes import Routes, length_cost, smoothed_cost

SIZES = ((100, 135), (200, 270), (1000, 1000))
WALLS = 0.2
ROOM = 20
"""Size of a room of the office, in cells, from wall to wall."""
WALL, DOOR = 3, 4
REPEATS = 7
REPEATS_QUICK = 3
FASTER = 1.5
"""Required ratio to either of the others, on the largest map."""

Map = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


def measure(*, quick: bool) -> Table:
    """Milliseconds, medians of repetitions of one after the other."""
    repeats = REPEATS_QUICK if quick else REPEATS
    rows, met = [], True
    for shape in SIZES:
        for kind, walls in (("office", office(*shape)), ("scattered", scattered(*shape))):
            p_occ, seen = np.where(walls, 0.95, 0.05), np.ones(shape, dtype=np.bool_)
            smooth = smoothed_cost(p_occ, seen, sigma_cells=1.5, p_max=0.5)
            for name, cost in (("length", length_cost(~walls)), ("smoothed", smooth)):
                ours_ms, *others_ms = _side_by_side(cost, shape, repeats)
                ratios = [other_ms / ours_ms for other_ms in others_ms]
                reached = shape != SIZES[-1] or all(not ratio < FASTER for ratio in ratios)
                met = met and reached
                rows.append(
                    (
                        f"{shape[0]} x {shape[1]} {kind}, {name}",
                        f"{np.mean(walls):.0%}",
                        f"{ours_ms:.2f}",
                        *(_told(number, ".1f") for number in others_ms),
                        *(_told(ratio, ".1f") for ratio in ratios),
                        verdict(met=reached) if shape == SIZES[-1] else "",
                    )
                )
    return Table(
        "routes: CPU ms of the value function over a whole map, medians",
        (
            "map and cost",
            "walls",
            "kantor",
            "MCP_Geometric",
            "dijkstra",
            "ratio",
            "ratio",
            f">= {FASTER:g}",
        ),
        rows,
        (
            f"MCP_Geometric: {_installed()}",
            "it charges half a step to either end and cuts corners: at equal costs its values differ at corners",
            "dijkstra: scipy's, with building its graph; its values are kantor's",
        ),
        met,
    )


def office(rows: int, columns: int) -> Map:
    """Rooms on a lattice with thick walls, a door to each neighbour somewhere in the wall."""
    draws = np.random.default_rng(2)
    walls = np.zeros((rows, columns), dtype=np.bool_)
    for start in range(ROOM, rows, ROOM):
        walls[start : start + WALL] = True
    for start in range(ROOM, columns, ROOM):
        walls[:, start : start + WALL] = True
    for row in range(0, rows, ROOM):
        for column in range(0, columns, ROOM):
            along, up = draws.integers(2, ROOM - DOOR, 2)
            walls[row : row + WALL, column + along : column + along + DOOR] = False
            walls[row + up : row + up + DOOR, column : column + WALL] = False
    return walls


def scattered(rows: int, columns: int) -> Map:
    """Walls of one cell, anywhere but in the corner where the way begins."""
    walls = np.random.default_rng(1).random((rows, columns)) < WALLS
    walls[:2, :2] = False
    return walls


def dijkstra_values(cost: Values, shape: tuple[int, int]) -> Values:
    """The same from scipy: edges to the eight neighbours, as rows of a sparse matrix."""
    rows, columns = shape
    passable = np.zeros((rows + 2, columns + 2), dtype=np.bool_)
    passable[1:-1, 1:-1] = np.isfinite(cost).reshape(shape)
    here = passable[1:-1, 1:-1]
    can = np.empty((rows, columns, 8), dtype=np.bool_)
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    for k, (i, j) in enumerate(steps):
        beside = passable[1 + i : rows + 1 + i, 1:-1] & passable[1:-1, 1 + j : columns + 1 + j]
        there = passable[1 + i : rows + 1 + i, 1 + j : columns + 1 + j]
        can[:, :, k] = here & there & beside
    can = can.reshape(-1, 8)
    targets = np.arange(cost.shape[0], dtype=np.int32)[:, None] + np.array(
        [i * columns + j for i, j in steps], dtype=np.int32
    )
    lengths = np.array([math.hypot(i, j) for i, j in steps])
    first = np.zeros(cost.shape[0] + 1, dtype=np.int32)
    np.cumsum(can.sum(axis=1, dtype=np.int32), out=first[1:])
    edges = (np.multiply.outer(cost, lengths)[can], targets[can], first)
    values: Values = dijkstra(csr_array(edges, shape=(cost.shape[0],) * 2), indices=0)
    return values


def _side_by_side(cost: Values, shape: tuple[int, int], repeats: int) -> list[float]:
    """Medians of kantor, MCP_Geometric (NaN if it is not installed) and dijkstra, in turn."""
    made = Routes(*shape)
    find = _finder(cost.reshape(shape))
    works: list[Callable[[], Any]] = [lambda: made.spread(cost, 0)]
    works += [find] if find else []
    works.append(lambda: dijkstra_values(cost, shape))
    assert np.allclose(made.spread(cost, 0), works[-1](), rtol=1e-12)
    costs_ms: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for work, spent_ms in zip(works, costs_ms, strict=True):
            start_ns = time.process_time_ns()
            work()
            spent_ms.append((time.process_time_ns() - start_ns) / 1e6)
    ours_ms, *others_ms = (statistics.median(spent_ms) for spent_ms in costs_ms)
    return [ours_ms, *others_ms] if find else [ours_ms, math.nan, *others_ms]


def _finder(cost: Values) -> Callable[[], Any] | None:
    """MCP_Geometric's find_costs, if it is installed. A negative cost is its wall."""
    try:
        from skimage.graph import MCP_Geometric  # noqa: PLC0415
    except ImportError:
        return None
    finder = MCP_Geometric(np.where(np.isfinite(cost), cost, -1.0))
    return lambda: finder.find_costs([(0, 0)])


def _installed() -> str:
    try:
        return f"scikit-image {version('scikit-image')}"
    except PackageNotFoundError:
        return "not installed (pip install --group peers)"


def _told(number: float, shape: str) -> str:
    return "-" if math.isnan(number) else format(number, shape)
