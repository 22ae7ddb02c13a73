"""Floor plans for tests of planners: a drawn map as a participant knows it, and robots on it."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.planners.map_base import Situation, Task, TeamMember
from kantor_protocol.base.grid import FREE, NOWHERE, OCCUPIED, UNKNOWN, Frame
from kantor_protocol.replication.occupancy_log import dead_frontier, entries
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from support.strategies import SEEDS

_MISSION = """
name = "floor"
robots = { count = 8 }
starts = { random = true }
map = { layout = "blank" }
sensor = { range_m = 3.0 }
planner = { name = "burgard", cost = "length" }
"""
_KINDS = {" ": UNKNOWN, "?": UNKNOWN, ".": FREE, "#": OCCUPIED}


class Floor:
    """The fused map and cost map of a participant, with cells of 1 m. Ways cost their length in cells."""

    def __init__(self, cells: npt.NDArray[np.uint8], *overrides: str) -> None:
        """cells: (rows, columns), as one log says of them; the rest: overrides of the scenario."""
        self.scenario: Scenario = parse(_MISSION, "floor", overrides)
        frame = Frame(1.0, (0.0, 0.0), *cells.shape)
        self._replica = Replica(0, 1, entries(frame), None, ledger=True, claims=False)
        self.fused_map = FusedMap(frame, 1)
        self.cost_map = CostMap(self.scenario, self.fused_map)
        self.see(np.flatnonzero(cells == FREE), FREE)
        self.see(np.flatnonzero(cells == OCCUPIED), OCCUPIED)

    def see(self, cells: npt.ArrayLike, kind: int) -> None:
        """Cells turn out to be free or occupied."""
        self._log(2 * np.asarray(cells, dtype=np.int64) + (kind == OCCUPIED))

    def find_dead(self, cell: int) -> None:
        """A frontier turns out to be none."""
        self._log(np.array([dead_frontier(self.fused_map.frame, cell)]))

    def measure(self, *bins: int) -> None:
        """Ranges are measured, each given by its bin."""
        self._log(np.array(bins, dtype=np.int64) + 3 * self.fused_map.frame.cells)

    def _log(self, entries: npt.NDArray[np.int64]) -> None:
        self._replica.append(entries)
        self.fused_map.fold(self._replica)

    def validate(self) -> None:
        """The map agrees with the log, and the costs with the map."""
        self._replica.validate()
        self.fused_map.validate(self._replica)
        self.cost_map.validate()

    def situation(
        self,
        members: Sequence[TeamMember],
        others: Sequence[TeamMember] = (),
        absent: Sequence[int] = (),
        but: Sequence[int] = (),
    ) -> Situation:
        """A situation with all frontiers but some to choose from."""
        frontiers = self.fused_map.frontiers
        frontiers = frontiers[~np.isin(frontiers, but)]
        return Situation(self.cost_map, frontiers, tuple(members), tuple(others), tuple(absent), 0)


def drawn(plan: Sequence[str], *overrides: str) -> Floor:
    """A floor as a picture, row 0 first: a wall is #, free is a dot, unknown is blank or a question mark."""
    return Floor(np.array([[_KINDS[c] for c in row] for row in plan], dtype=np.uint8), *overrides)


def member(
    robot: int,
    cell: int,
    target: int = NOWHERE,
    memo: tuple[int, ...] = (),
    *,
    arrived: bool = False,
) -> TeamMember:
    """A member of the visible team, with the task that it has had since the start."""
    return TeamMember(robot, cell, Task(target, memo), 0, arrived)


@st.composite
def crowded(draw: st.DrawFn, *overrides: str) -> tuple[Floor, Situation]:
    """Any floor, with up to six robots on it, and targets that are taken."""
    draws = np.random.default_rng(draw(SEEDS))
    rows, columns = draw(st.integers(1, 12)), draw(st.integers(1, 12))
    walls, unseen = draw(st.sampled_from([0.0, 0.2, 0.4])), draw(st.sampled_from([0.1, 0.3]))
    kinds = draws.choice(
        [OCCUPIED, UNKNOWN, FREE], (rows, columns), p=[walls, unseen, 1 - walls - unseen]
    )
    floor = Floor(kinds.astype(np.uint8), *overrides)
    cells = st.integers(0, rows * columns - 1)
    members = [
        member(i, cell) for i, cell in enumerate(draw(st.lists(cells, min_size=1, max_size=6)))
    ]
    targets = draw(st.lists(st.integers(NOWHERE, rows * columns - 1), max_size=2))
    others = [member(6 + i, 0, target) for i, target in enumerate(targets)]
    return floor, floor.situation(members, others, draw(st.lists(cells, max_size=2)))
