"""Coordinated exploration by utility and cost (Burgard et al. 2000, table 1 and eq. 4-6).

The utility U of every frontier is 1 at first. The robot and the frontier with the largest U - beta V are a
pair; what the robot will probably see from there reduces the utility of the frontiers around it, for the
robots that have no target yet. V is in sensor ranges of open floor, so that it compares with a utility of 1.

Of equal pairs the one with the shorter way is taken, then the lower robot, then the lower cell. A robot
alone therefore drives to its cheapest frontier, to the last bit, as every robot does without coordination.
"""

import numpy as np
import numpy.typing as npt

from kantor_agent.planners.map_base import Situation, Task
from kantor_protocol.base.grid import NOWHERE, OCCUPIED
from kantor_protocol.base.kernels import kernel
from kantor_protocol.scenario.schema import Scenario


@kernel
def in_sight(cells: np.ndarray, columns: int, one: int, other: int) -> bool:
    """Whether no known wall touches the line between the middles of two cells; cells: (cells,).

    At a corner, both cells beside it count. The line is traced in integers: exact, and the same from both ends.
    """
    row, column = one // columns, one % columns
    rise, run = other // columns - row, other % columns - column
    up, right = (1 if rise > 0 else -1), (1 if run > 0 else -1)
    rise, run = abs(rise), abs(run)
    i, j = 0, 0
    while i < run or j < rise:
        ahead = (2 * i + 1) * rise - (2 * j + 1) * run
        here = (row + up * j) * columns + column + right * i
        if ahead == 0 and (
            cells[here + right] == OCCUPIED or cells[here + up * columns] == OCCUPIED
        ):
            return False
        i, j = i + (1 if ahead <= 0 else 0), j + (1 if ahead >= 0 else 0)
        if cells[(row + up * j) * columns + column + right * i] == OCCUPIED:
            return False
    return True


@kernel
def coverage(distance: float, reach: float, shares: np.ndarray) -> float:
    """P(d), the probability that a cell at a distance d from a target is seen from it; 0 beyond `reach`.

    shares: (bins,) P for equal parts of the reach, or empty for 1 - d / reach.
    """
    bins = shares.shape[0]
    if distance > reach:
        return 0.0
    if bins == 0:
        return 1.0 - distance / reach
    return shares[min(int(distance / reach * bins), bins - 1)]


@kernel
def discount(
    utility: np.ndarray,
    frontiers: np.ndarray,
    target: int,
    reach: float,
    shares: np.ndarray,
    subtract: bool,
    sight: bool,
    cells: np.ndarray,
    columns: int,
) -> None:
    """Eq. 6: reduce the utility (f,) of frontiers (f,) near a target. reach: the sensor's range, in cells.

    subtract: by P(d), not by the factor 1 - P(d). sight: P(d) is 0 where a known wall stands between.
    """
    if not 0 <= target < cells.shape[0]:
        return
    for f in range(frontiers.shape[0]):
        rise = frontiers[f] // columns - target // columns
        run = frontiers[f] % columns - target % columns
        p = coverage(np.sqrt(rise * rise + run * run), reach, shares)
        if p > 0.0 and sight and not in_sight(cells, columns, target, frontiers[f]):
            p = 0.0
        if subtract:
            utility[f] -= p
        else:
            utility[f] *= 1.0 - p


@kernel
def best_pair(
    utility: np.ndarray, value: np.ndarray, beta: float, picked: np.ndarray
) -> tuple[int, int]:
    """Eq. 5: robot and frontier with the largest U - beta V, among robots with picked[robot] < 0; or -1, -1.

    value: (robots, f) V, infinite where no way leads.
    """
    best_robot, best_frontier, best, shortest = -1, -1, -np.inf, np.inf
    for robot in range(value.shape[0]):
        if picked[robot] >= 0:
            continue
        for f in range(value.shape[1]):
            way = value[robot, f]
            if way == np.inf:
                continue
            gain = utility[f] - beta * way
            if gain > best or (gain == best and way < shortest):
                best_robot, best_frontier, best, shortest = robot, f, gain, way
    return best_robot, best_frontier


@kernel
def pick(
    value: np.ndarray,
    frontiers: np.ndarray,
    taken: np.ndarray,
    beta: float,
    reach: float,
    shares: np.ndarray,
    subtract: bool,
    sight: bool,
    cells: np.ndarray,
    columns: int,
    utility: np.ndarray,
    picked: np.ndarray,
) -> None:
    """Table 1: write the frontier of every robot into picked (robots,), as its index in `frontiers`, or -1.

    value: (robots, f) V in sensor ranges; taken: targets of other robots; utility: (f,) scratch.
    """
    utility[:] = 1.0
    picked[:] = -1
    for i in range(taken.shape[0]):
        discount(utility, frontiers, taken[i], reach, shares, subtract, sight, cells, columns)
    for _ in range(picked.shape[0]):
        robot, f = best_pair(utility, value, beta, picked)
        if robot < 0:
            return
        picked[robot] = f
        discount(utility, frontiers, frontiers[f], reach, shares, subtract, sight, cells, columns)


class Burgard:
    """The planner `burgard` of table 1; uncoordinated, the baseline that the paper compares it with."""

    negotiates = False

    def __init__(self, scenario: Scenario, _seed: int, _me: int | None) -> None:
        """The options are the scenario's."""
        self._planner = scenario.planner

    def assign(self, situation: Situation, /) -> list[Task]:
        """A frontier for each member; no target for those that can reach none."""
        cost_map, frontiers = situation.cost_map, situation.frontiers
        ways = [cost_map.travel(member.cell, frontiers) for member in situation.members]
        value = np.array(ways) / cost_map.sensor_cells
        picked = (
            self._coordinated(situation, value) if self._planner.coordinated else _cheapest(value)
        )
        return [Task(int(frontiers[f])) if f >= 0 else Task() for f in picked.tolist()]

    def _coordinated(
        self, situation: Situation, value: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.int64]:
        """(robots,) index of every robot's frontier by table 1. value: (robots, f)."""
        cost_map, planner = situation.cost_map, self._planner
        held = [member.task.target for member in situation.others]
        taken = [target for target in (*held, *situation.absent) if target != NOWHERE]
        picked = np.empty(value.shape[0], dtype=np.int64)
        pick(
            value,
            situation.frontiers,
            np.array(taken, dtype=np.int64),
            planner.beta,
            cost_map.sensor_cells,
            self.shares(cost_map.fused_map.ranges),
            planner.discount == "subtract",
            planner.sight,
            cost_map.fused_map.cells,
            cost_map.frame.columns,
            np.empty(value.shape[1]),
            picked,
        )
        return picked

    def shares(self, ranges: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Eq. 4: (bins,) P(d) for d in each bin, by the option `coverage`; empty for 1 - d / reach.

        ranges: (bins,) counts of measured ranges. One in the bin of d counts as at least d.
        """
        if self._planner.coverage == "disc":
            return np.ones(1)
        measured = ranges.sum()
        if self._planner.coverage == "linear" or measured == 0:
            return np.zeros(0)
        return np.asarray(ranges[::-1].cumsum()[::-1] / measured)


def _cheapest(value: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """(robots,) index of every robot's cheapest frontier, whatever the others do; -1 without a way."""
    if value.shape[1] == 0:
        return np.full(value.shape[0], -1)
    nearest = value.argmin(axis=1)
    return np.where(np.isfinite(value.min(axis=1)), nearest, -1)
