"""The planner `kmeans` in plain Python, with which its kernels are compared.

Slow, with lists and dicts, and close to the equations of Puig, Garcia and Wu.
"""

import math

import numpy as np
from scipy.ndimage import label
from scipy.optimize import linear_sum_assignment

from kantor_agent.planners.kmeans import PARTS, ROUNDS
from kantor_agent.planners.map_base import Situation, Task, TeamMember
from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.grid import NOWHERE, OCCUPIED, UNKNOWN

SETTLED = 2
"""Assignments for which a robot's centroid is drawn. After so many, as its memo counts them, it stays."""


def plain_line(one: tuple[int, int], other: tuple[int, int]) -> list[tuple[int, int]]:
    """Bresenham's line, by the error against the true line in doubled integers."""
    (row, column), (to_row, to_column) = one, other
    high, wide = abs(to_row - row), abs(to_column - column)
    line, error = [one], wide - high
    while (row, column) != other:
        across, along = 2 * error > -high, 2 * error < wide
        column += (1 if to_column > column else -1) if across else 0
        row += (1 if to_row > row else -1) if along else 0
        error += (wide if along else 0) - (high if across else 0)
        line.append((row, column))
    return line


def plain_cluster(
    points: list[int], columns: int, centroids: list[tuple[int, ...]]
) -> tuple[dict[int, int], list[tuple[int, ...]]]:
    """Lloyd's rounds: the region of each point, and the centroids."""
    places = {p: tuple(PARTS * x for x in divmod(p, columns)) for p in points}
    ks = range(len(centroids))

    def away(p: int, k: int) -> int:
        return sum((x - c) ** 2 for x, c in zip(places[p], centroids[k], strict=True))

    for _ in range(ROUNDS):
        region = {p: min(ks, key=lambda k, p=p: away(p, k)) for p in points}
        for k in ks:
            sizes = [list(region.values()).count(its) for its in ks]
            if not sizes[k]:
                shared = [p for p in points if sizes[region[p]] > 1]
                region[max(shared, key=lambda p: away(p, region[p]))] = k
        before, centroids = centroids, []
        for k in ks:
            own = [places[p] for p in points if region[p] == k]
            sums = [sum(axis) for axis in zip(*own, strict=True)]
            centroids.append(tuple((2 * s + len(own)) // (2 * len(own)) for s in sums))
        if centroids == before:
            break
    return region, centroids


def visible_team(situation: Situation) -> list[TeamMember]:
    """All robots in contact, by their place in the roster."""
    return sorted((*situation.members, *situation.others), key=lambda m: m.robot)


class PlainKMeans:
    """The assignment of one situation."""

    def __init__(self, situation: Situation, seed: int) -> None:
        self.situation, self.seed = situation, seed
        frame = situation.cost_map.frame
        self.shape = (frame.rows, frame.columns)
        self.kinds = situation.cost_map.fused_map.cells.reshape(self.shape)
        self.diagonal = math.sqrt(frame.rows**2 + frame.columns**2)
        self.frontiers = situation.frontiers.tolist()
        self.team = visible_team(situation)

    def at(self, cell: int) -> tuple[int, int]:
        """The row and column of a cell."""
        return divmod(cell, self.shape[1])

    def beside(self, cell: int) -> list[int]:
        row, column = self.at(cell)
        around = [(row - 1, column), (row, column - 1), (row, column + 1), (row + 1, column)]
        inside = [(r, c) for r, c in around if 0 <= r < self.shape[0] and 0 <= c < self.shape[1]]
        return [r * self.shape[1] + c for r, c in inside]

    def unknown(self, cell: int) -> bool:
        return bool(self.kinds[self.at(cell)] == UNKNOWN)

    def squared(self, one: int, other: int) -> int:
        (row, column), (to_row, to_column) = self.at(one), self.at(other)
        return (row - to_row) ** 2 + (column - to_column) ** 2

    def walled(self, one: int, other: int) -> bool:
        line = plain_line(self.at(one), self.at(other))
        return any(self.kinds[place] == OCCUPIED for place in line)

    def travel(self, robot: TeamMember, cell: int) -> float:
        return float(self.situation.cost_map.travel(robot.cell)[cell])

    def points(self) -> list[int]:
        """Frontiers and the unknown cells connected to one."""
        labels, _ = label(self.kinds == UNKNOWN)
        labels = labels.ravel()
        open_parts = {labels[n] for f in self.frontiers for n in self.beside(f)} - {0}
        return sorted({*self.frontiers, *np.flatnonzero(np.isin(labels, list(open_parts)))})

    def start(self, robot: TeamMember) -> tuple[int, int]:
        """The initial centroid of a robot."""
        count, row, column = (*robot.task.memo, 0, 0, 0)[:3]
        edge = [PARTS * (side - 1) for side in self.shape]
        if count >= SETTLED:
            return min(max(row, 0), edge[0]), min(max(column, 0), edge[1])
        key = (self.seed, Purpose.CENTROIDS, robot.robot, max(count, 0))
        return round(uniform(*key, 0) * edge[0]), round(uniform(*key, 1) * edge[1])

    def region_distance(self, robot: TeamMember, k: int) -> tuple[float, int, bool]:
        """Eq. 1-3: the distance, the contour cell at it, and whether the region is accessible."""
        own = [p for p in self.region if self.region[p] == k]
        hidden = [p for p in own if self.unknown(p)]
        contour = [p for p in hidden if any(n not in hidden for n in self.beside(p))] or own
        ways = [
            (self.travel(robot, f), c)
            for c in contour
            for f in ([c] if not hidden else self.beside(c))
            if f in self.frontiers and math.isfinite(self.travel(robot, f))
        ]
        if ways:
            return (*min(ways), True)
        lines = [
            (
                math.sqrt(self.squared(robot.cell, c))
                + (self.diagonal if self.walled(robot.cell, c) else 0.0),
                c,
            )
            for c in contour
        ]
        return (*min(lines), False)

    def spaced(self, robots: list[TeamMember]) -> list[int]:
        """F_M: frontiers a sensor range apart, those that are cheapest for one of the robots first."""
        cheapest = {f: min(self.travel(m, f) for m in robots) for f in self.frontiers}
        far, kept = self.situation.cost_map.sensor_cells**2, []
        for f in sorted(self.frontiers, key=lambda f: (cheapest[f], f)):
            if math.isfinite(cheapest[f]) and all(self.squared(f, k) >= far for k in kept):
                kept.append(f)
        return sorted(kept)

    def assign(self) -> list[Task]:
        members = self.situation.members
        if not self.frontiers:
            return [Task(NOWHERE, m.task.memo) for m in members]
        points = self.points()
        starts = [self.start(robot) for robot in self.team][: len(points)]
        self.region, centroids = plain_cluster(points, self.shape[1], starts)
        measured = [
            [self.region_distance(robot, k) for k in range(len(centroids))] for robot in self.team
        ]
        owners, theirs = linear_sum_assignment([[d for d, _, _ in row] for row in measured])
        self.least = sum(measured[i][k][0] for i, k in zip(owners, theirs, strict=True))
        self.measured = measured
        own = {
            self.team[i].robot: (measured[i][k][1:], centroids[k])
            for i, k in zip(owners, theirs, strict=True)
        }
        taken = [m.task.target for m in self.situation.others] + list(self.situation.absent)
        taken = [target for target in taken if target != NOWHERE]
        spaced, targets = self.spaced(list(members)), {}
        for m in sorted(members, key=lambda m: m.robot not in own or own[m.robot][0][1]):
            cc = own[m.robot][0][0] if m.robot in own else None
            offers = [
                min((self.cost(m, f, cc, taken), f) for f in some) if some else (math.inf, NOWHERE)
                for some in (spaced, self.frontiers)
            ]
            finite = [f for cost, f in offers if math.isfinite(cost)]
            targets[m.robot] = finite[0] if finite else NOWHERE
            taken += finite[:1]
        return [
            Task(
                targets[m.robot],
                (
                    min(max(0, *m.task.memo[:1], 0) + 1, SETTLED),
                    *(own[m.robot][1] if m.robot in own else self.start(m)),
                ),
            )
            for m in members
        ]

    def cost(self, robot: TeamMember, f: int, cc: int | None, taken: list[int]) -> float:
        """Eq. 6: the cost of a frontier for a robot. cc: the nearest contour cell of its region."""
        cost = self.travel(robot, f)
        if cc is not None:
            cost += math.sqrt(self.squared(f, cc))
            cost += self.diagonal if self.walled(f, cc) else 0.0
        far = self.situation.cost_map.sensor_cells**2
        if any(f == t or self.squared(f, t) < far for t in taken):
            cost += 2.0 * self.diagonal
        return cost
