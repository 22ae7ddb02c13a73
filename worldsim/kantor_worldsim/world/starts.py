"""Starts of robots on a map: given, drawn from all free cells, or on spots as in KME's figure 5.

Free cells are connected by steps to one of four neighbours, so that no robot cuts a corner. All robots
start in one connected part, else no team could finish; drawn starts lie in the largest.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.counter_rng import Purpose, generator
from kantor_protocol.base.grid import FREE, NOWHERE, OCCUPIED
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.types import Point
from kantor_worldsim.world.maps import Ground, parts

Spread = Literal["together", "separate"]
Numbers = npt.NDArray[np.int64]


def starts_on(
    ground: Ground,
    *,
    poses_m: Sequence[Point],
    random: bool,
    spread: Spread,
    spots: int,
    count: int,
    seed: int,
) -> npt.NDArray[np.float64]:
    """(n, 2) positions of r1 … rn at time 0, world frame, metres.

    poses_m: used as they are, unless `random`. Drawn starts are centres of cells of their own in
    the largest free part. separate: any cells; together: one, and the nearest around it on foot.
    spots: number of spots of the map, 0 for none (`spots`). separate: each robot draws a spot of
    its own; together: around spot number seed mod `spots`, so that as many seeds in a row try each
    once (KME, V-A). Raises ScenarioError if the map has no such starts.
    """
    if not random:
        return _given(ground, poses_m)
    free = _largest(ground)
    if free.size < count:
        raise ScenarioError(
            f"robots.count: {count}, but the map has {free.size} free cells in one part; "
            "give fewer robots or a larger map"
        )
    draws = generator(seed, Purpose.STARTS)
    cells: Sequence[int] | Numbers
    if spread == "separate":
        places = _on_spots(ground, free, spots, count) if spots else free
        cells = draws.choice(places, count, replace=False)
    else:
        middle = _spread_out(ground, free, spots)[seed % spots] if spots else draws.choice(free)
        cells = _around(ground, int(middle), count)
    return np.array([ground.frame.centre_of(int(cell)) for cell in cells], dtype=np.float64)


def spots(ground: Ground, count: int) -> Numbers:
    """(count,) cells of the largest free part, spread out well and the same for every seed.

    The first is in the middle, each further one where it is farthest, in a straight line, from all
    before; of equally far ones the lowest cell. Raises ScenarioError if there are too few cells.
    """
    return _spread_out(ground, _largest(ground), count)


def observable(ground: Ground, starts_m: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """(rows, columns): the cells that robots from these starts can ever see.

    Free cells that are connected with a start, and the cells next to them (4 neighbours) that are not free. Starts that are
    outside the map or not free reach nothing.
    """
    labels, sizes = parts(ground.cells)
    reached = np.zeros(sizes.size, dtype=np.bool_)
    for x_m, y_m in starts_m:
        cell = ground.frame.cell_of(x_m, y_m)
        if cell != NOWHERE:
            reached[labels.flat[cell]] = True
    reached[0] = False  # cells that are not free
    seen = reached[labels]
    wide = np.pad(seen, 1)
    neighbours = wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:]
    return np.asarray(seen | (neighbours & (ground.cells != FREE)))


def _given(ground: Ground, poses_m: Sequence[Point]) -> npt.NDArray[np.float64]:
    labels, _ = parts(ground.cells)
    part = [_part_of(ground, labels, i, pose_m) for i, pose_m in enumerate(poses_m)]
    for i, (x_m, y_m) in enumerate(poses_m):
        if part[i] != part[0]:
            raise ScenarioError(
                f"starts.poses_m[{i}]: ({x_m:g}, {y_m:g}) cannot be reached from r1's start; "
                "move it to the same part of the map, or open a way between them"
            )
    return np.array(poses_m, dtype=np.float64).reshape(-1, 2)


def _part_of(ground: Ground, labels: npt.NDArray[np.int32], i: int, pose_m: Point) -> int:
    """The free part that a given start lies in."""
    place = f"starts.poses_m[{i}]: ({pose_m[0]:g}, {pose_m[1]:g})"
    cell = ground.frame.cell_of(*pose_m)
    if cell == NOWHERE:
        left, right, bottom, top = ground.frame.extent_m
        raise ScenarioError(
            f"{place} is outside the map, which spans ({left:g}, {bottom:g}) to ({right:g}, {top:g}); "
            "move it inside"
        )
    if ground.cells.flat[cell] != FREE:
        wall = ground.cells.flat[cell] == OCCUPIED
        raise ScenarioError(
            f"{place} is {'inside a wall' if wall else 'in a cell that the map leaves unknown'}; "
            "move it to free space"
        )
    return int(labels.flat[cell])


def _largest(ground: Ground) -> Numbers:
    """The cells of the largest free part, rising; of equally large ones the one with the lowest cell."""
    labels, sizes = parts(ground.cells)
    if not sizes.any():
        raise ScenarioError("map: no free cell, so nowhere to start; give another map")
    return np.flatnonzero(labels == sizes.argmax())


def _on_spots(ground: Ground, free: Numbers, count: int, robots: int) -> Numbers:
    if robots > count:
        raise ScenarioError(
            f'starts.spots: {count} for {robots} robots; give one for each, or starts.spread = "together"'
        )
    return _spread_out(ground, free, count)


def _spread_out(ground: Ground, free: Numbers, count: int) -> Numbers:
    """Farthest-point sampling, in whole numbers."""
    if free.size < count:
        raise ScenarioError(
            f"starts.spots: {count}, but the map has {free.size} free cells in one part; give fewer"
        )
    rows, columns = np.divmod(free, ground.frame.columns)

    def squares_from(row: int, column: int) -> Numbers:
        return np.asarray((rows - row) ** 2 + (columns - column) ** 2)

    middle = squares_from(int(rows.sum()) // free.size, int(columns.sum()) // free.size)
    chosen = [int(middle.argmin())]
    nearest = squares_from(rows[chosen[0]], columns[chosen[0]])
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, squares_from(rows[chosen[-1]], columns[chosen[-1]]))
    return free[chosen]


def _around(ground: Ground, first: int, count: int) -> list[int]:
    """A free cell and those nearest to it on foot; of equally near ones the lowest first."""
    found, ring, seen = [first], [first], {first}
    while len(found) < count:
        ring = sorted({cell for near in ring for cell in _free_neighbours(ground, near)} - seen)
        seen.update(ring)
        found += ring
    return found[:count]


def _free_neighbours(ground: Ground, cell: int) -> list[int]:
    rows, columns = ground.cells.shape
    row, column = divmod(cell, columns)
    neighbours = ((row - 1, column), (row, column - 1), (row, column + 1), (row + 1, column))
    return [
        r * columns + c
        for r, c in neighbours
        if 0 <= r < rows and 0 <= c < columns and ground.cells[r, c] == FREE
    ]
