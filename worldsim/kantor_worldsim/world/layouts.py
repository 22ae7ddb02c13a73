"""Generated true maps: the kinds of workspace of KME's figure 4, and an office as in Burgard's figure 8.

The papers print pictures, not maps, so these maps are only of the same kind. A layout is a function
of its name, size, resolution and seed; all free space is one part, without cutting corners, and a
closed wall of one cell surrounds it.
"""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from kantor_protocol.base.counter_rng import Purpose, generator
from kantor_protocol.base.grid import CELLS_MAX, FREE, OCCUPIED, Frame
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.types import Point
from kantor_worldsim.world.maps import Cells, Ground, parts
from kantor_worldsim.world.nav2 import RESOLUTION_MAX_M, RESOLUTION_MIN_M


def layout(
    name: str, size_m: Point | None = None, resolution_m: float | None = None, seed: int = 0
) -> Ground:
    """A map by its name, with its lower left corner at (0, 0).

    - blank: only the surrounding wall.
    - unstructured: random obstacles of 2 to 12 m cover a fifth.
    - cityblock: streets of about 5 m round solid blocks of about 12 m, some of them merged.
    - office: rooms along corridors, with doors of 0.8 to 1 m, some with furniture.

    size_m: width and height, rounded to whole cells; by default 96 x 96 m, the office 27 x 20 m.
    Obstacles, streets and blocks shrink in maps below 96 m, but stay in larger ones.
    resolution_m: the side of a cell; by default 1 m, in the office 0.2 m. Raises ScenarioError for
    an unknown name, and for a size or a resolution that does not suit the layout.
    """
    kind = LAYOUTS.get(name)
    if kind is None:
        raise ScenarioError(f"map.layout: '{name}' is unknown; give one of {', '.join(LAYOUTS)}")
    frame = _frame(size_m or kind.size_m, resolution_m or kind.resolution_m)
    for complaint in kind.complaints(frame):
        raise ScenarioError(f"map.size_m: {complaint}")
    cells = np.full((frame.rows, frame.columns), OCCUPIED, dtype=np.uint8)
    kind.draw(cells, frame, generator(seed, Purpose.MAP))
    return Ground(frame, cells)


def _frame(size_m: Point, resolution_m: float) -> Frame:
    if not RESOLUTION_MIN_M <= resolution_m <= RESOLUTION_MAX_M:
        raise ScenarioError(
            f"map.resolution_m: {resolution_m:g} is no side of a cell; "
            f"give {RESOLUTION_MIN_M:g} to {RESOLUTION_MAX_M:g} m"
        )
    if not all(0.0 < side_m < math.inf for side_m in size_m):
        raise ScenarioError("map.size_m: width and height must be above 0; give both in metres")
    columns, rows = (math.floor(side_m / resolution_m + 0.5) for side_m in size_m)
    if rows * columns > CELLS_MAX:
        raise ScenarioError(
            f"map.size_m: {columns} x {rows} cells; at most {CELLS_MAX}, such as 4000 x 4000"
        )
    return Frame(resolution_m, (0.0, 0.0), max(1, rows), max(1, columns))


class _Layout(NamedTuple):
    draw: Callable[[Cells, Frame, np.random.Generator], None]
    """Opens free space in cells that are all occupied."""
    complaints: Callable[[Frame], list[str]]
    size_m: Point = (96.0, 96.0)
    resolution_m: float = 1.0


# KME, figure 4.

_PLAN_CELLS = 96


def _unit_cells(frame: Frame) -> float:
    """One metre in cells; less in small maps, so that they have as many obstacles across."""
    return min(1.0 / frame.resolution_m, min(frame.rows, frame.columns) / _PLAN_CELLS)


def _large_enough(least_cells: int, least_unit_cells: float) -> Callable[[Frame], list[str]]:
    def complaints(frame: Frame) -> list[str]:
        shorter = min(frame.rows, frame.columns)
        if shorter < least_cells:
            return [
                f"{frame.columns} x {frame.rows} cells; this layout needs {least_cells} each way"
            ]
        if 1.0 / frame.resolution_m < least_unit_cells:
            return [
                f"cells of {frame.resolution_m:g} m; this layout needs at most {1 / least_unit_cells:g} m"
            ]
        return []

    return complaints


def _blank(cells: Cells, _frame: Frame, _random: np.random.Generator) -> None:
    cells[1:-1, 1:-1] = FREE


def _unstructured(cells: Cells, frame: Frame, random: np.random.Generator) -> None:
    """Rotated and overlapping rectangles and ellipses; the space that they enclose is filled."""
    inner = cells[1:-1, 1:-1]
    inner[:] = FREE
    unit, left = _unit_cells(frame), int(inner.size * 0.2)
    while left > 0:
        left -= _obstacle(inner, unit, random)
    labels, sizes = parts(cells)
    cells[labels != sizes.argmax()] = OCCUPIED


def _obstacle(cells: Cells, unit: float, random: np.random.Generator) -> int:
    """Stamp one obstacle; returns the number of free cells that it occupies."""
    draw = random.random(7)
    long = (1.0 + 5.0 * draw[0] ** 2) * unit  # half axes; small ones are common
    short = max(long * (0.25 + 0.75 * draw[1]), 0.71)
    u, v = draw[2] * cells.shape[1], draw[3] * cells.shape[0]
    east, north = draw[4] - 0.5, draw[5] - 0.5
    length = math.sqrt(east * east + north * north)  # no sine: its last bit depends on the machine
    east, north = (east / length, north / length) if length else (1.0, 0.0)
    reach = math.sqrt(long * long + short * short)
    top, right = math.ceil(v + reach), math.ceil(u + reach)
    bottom, west = max(0, math.floor(v - reach)), max(0, math.floor(u - reach))
    patch = cells[bottom:top, west:right]
    dv = np.arange(bottom, bottom + patch.shape[0])[:, None] + 0.5 - v
    du = np.arange(west, west + patch.shape[1])[None, :] + 0.5 - u
    along, across = (du * east + dv * north) / long, (dv * east - du * north) / short
    if draw[6] < 0.5:
        inside = np.maximum(abs(along), abs(across)) <= 1.0
    else:
        inside = along * along + across * across <= 1.0
    taken = int((inside & (patch == FREE)).sum())
    patch[inside] = OCCUPIED
    return taken


def _cityblock(cells: Cells, frame: Frame, random: np.random.Generator) -> None:
    """Streets run from wall to wall; a block may have grown over the street to its right."""
    unit = _unit_cells(frame)
    inner = cells[1:-1, 1:-1]
    inner[:] = FREE
    across = _blocks(inner.shape[1], unit, random)
    for low, high in _blocks(inner.shape[0], unit, random):
        grown = random.random(len(across)) < 0.15
        for i, (left, right) in enumerate(across):
            end = across[i + 1][1] if grown[i] and i + 1 < len(across) else right
            inner[low:high, left:end] = OCCUPIED


def _blocks(length: int, unit: float, random: np.random.Generator) -> list[tuple[int, int]]:
    """Ranges (begin, end) of blocks between streets, along one side of the map; at least two."""
    count = max(2, round((length / unit - 5.0) / 17.0))
    widths = np.empty(2 * count + 1)
    widths[0::2] = 5.0 + random.random(count + 1) * 1.5
    widths[1::2] = 8.0 + random.random(count) * 8.0
    edges = _edges(length, widths)
    return list(zip(edges[1::2], edges[2::2], strict=False))


def _edges(length: int, widths: np.ndarray) -> list[int]:
    """The ends of consecutive pieces with these relative widths that fill a length; the first begins at 0."""
    ends = np.cumsum(widths)
    return [0, *np.floor(ends * (length / ends[-1]) + 0.5).astype(int).tolist()]


# Burgard et al., figure 8.

_CORRIDOR_M, _ROOM_DEPTH_M, _ROOM_WIDTH_M = 1.8, 5.5, 5.8
_DOOR_M = (0.8, 1.0)
_CROSSING_EACH_M = 30.0
_PASSAGE_M = 0.6
"""Free width around furniture."""
_FURNITURE_M = ((1.6, 0.8), (1.2, 0.4), (2.0, 1.0))
"""Sizes of pieces: along the wall, and away from it."""


class _Room(NamedTuple):
    """The free cells of a room, as half-open ranges, and whether a corridor runs below and above."""

    bottom: int
    top: int
    left: int
    right: int
    below: bool
    above: bool


def _office_complaints(frame: Frame) -> list[str]:
    if min(frame.rows, frame.columns) < round(8.0 / frame.resolution_m):
        width_m, height_m = frame.columns * frame.resolution_m, frame.rows * frame.resolution_m
        return [f"{width_m:g} x {height_m:g} m; an office needs 8 m each way"]
    if frame.resolution_m > 0.5:
        return [f"cells of {frame.resolution_m:g} m; an office needs at most 0.5 m"]
    return []


def _office(cells: Cells, frame: Frame, random: np.random.Generator) -> None:
    """Corridors from left to right with rooms on both sides; they are linked by crossings."""
    per_m = 1.0 / frame.resolution_m
    corridor = round(_CORRIDOR_M * per_m)
    pitch_m = _ROOM_DEPTH_M + _CORRIDOR_M
    corridors = max(1, round((frame.rows / per_m - _ROOM_DEPTH_M) / pitch_m))
    depths = frame.rows - 2 - corridors * (corridor + 2)
    edges = _edges(depths, 0.85 + 0.3 * random.random(corridors + 1))
    rooms: list[_Room] = []
    for band, (low, high) in enumerate(pairwise(edges)):
        bottom, top = (edge + 1 + band * (corridor + 2) for edge in (low, high))
        below, above = band > 0, band < corridors
        spans = [(1, frame.columns - 1)]
        if below and above:
            spans = _cross(cells, bottom, top, corridor, per_m, random)
        for left, right in spans:
            for begin, end in _rooms(left, right, per_m, random):
                cells[bottom:top, begin:end] = FREE
                rooms.append(_Room(bottom, top, begin, end, below, above))
        if above:
            cells[top + 1 : top + 1 + corridor, 1:-1] = FREE
    lounge = random.integers(len(rooms))
    for i, room in enumerate(rooms):
        _open(cells, room, per_m, random, wide=i == lounge)
    for room in rooms:
        if random.random() < 0.6:
            _furnish(cells, room, per_m, random)


def _cross(
    cells: Cells, bottom: int, top: int, corridor: int, per_m: float, random: np.random.Generator
) -> list[tuple[int, int]]:
    """Open crossings through a band of rooms; returns the column ranges that are left for rooms."""
    columns = cells.shape[1]
    count = max(1, round(columns / per_m / _CROSSING_EACH_M))
    spans, begin = [], 1
    for i in range(count):
        share = (i + 0.3 + 0.4 * random.random()) / count
        left = round(share * columns) - corridor // 2
        cells[bottom - 1 : top + 1, left : left + corridor] = FREE
        spans.append((begin, left - 1))
        begin = left + corridor + 1
    return [*spans, (begin, columns - 1)]


def _rooms(
    left: int, right: int, per_m: float, random: np.random.Generator
) -> list[tuple[int, int]]:
    """Ranges (begin, end) of rooms between two walls, with a wall between any two."""
    count = max(1, round((right - left) / per_m / _ROOM_WIDTH_M))
    edges = _edges(right - left + 1, 0.6 + 0.8 * random.random(count))
    return [(left + begin, left + end - 1) for begin, end in pairwise(edges)]


def _open(
    cells: Cells, room: _Room, per_m: float, random: np.random.Generator, *, wide: bool
) -> None:
    """Open doors to the corridors, to at least one; a lounge is open along its whole side."""
    walls = [room.bottom - 1] * room.below + [room.top] * room.above
    if len(walls) == 2 and random.random() < 0.7:
        del walls[random.integers(2)]
    margin = 1 if room.right - room.left > 3 else 0
    for wall in walls:
        low, high = (round(width_m * per_m) for width_m in _DOOR_M)
        width = min(int(random.integers(low, high + 1)), room.right - room.left - 2 * margin)
        if wide:
            width = room.right - room.left - 2 * margin
        left = int(random.integers(room.left + margin, room.right - margin - width + 1))
        cells[wall, left : left + width] = FREE


def _furnish(cells: Cells, room: _Room, per_m: float, random: np.random.Generator) -> None:
    """Place up to four pieces along the walls, where a way round each is left and no door is blocked."""
    gap = max(1, round(_PASSAGE_M * per_m))
    for _ in range(4):
        along_m, off_m = _FURNITURE_M[random.integers(len(_FURNITURE_M))]
        along, off = max(1, round(along_m * per_m)), max(1, round(off_m * per_m))
        side, share = int(random.integers(4)), random.random()
        plan = cells[room.bottom - 1 : room.top + 1, room.left - 1 : room.right + 1]
        plan = np.rot90(plan, side)  # a view: the wall is its first row
        start = gap + 1 + int(share * (plan.shape[1] - 2 - 2 * gap - along))
        if start < gap + 1 or start + along + gap > plan.shape[1] - 1:
            continue
        solid = (plan[0, start : start + along] == OCCUPIED).all()
        around = plan[1 : 1 + off + gap, start - gap : start + along + gap]
        if solid and off + gap + 1 < plan.shape[0] and (around == FREE).all():
            plan[1 : 1 + off, start : start + along] = OCCUPIED


LAYOUTS: dict[str, _Layout] = {
    "blank": _Layout(_blank, _large_enough(3, 0.0)),
    "unstructured": _Layout(_unstructured, _large_enough(24, 0.25)),
    "cityblock": _Layout(_cityblock, _large_enough(36, 0.4)),
    "office": _Layout(_office, _office_complaints, (27.0, 20.0), 0.2),
}
