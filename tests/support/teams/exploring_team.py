"""Missions of a team that explores drawn rooms, played in process to their end."""

from collections.abc import Callable
from typing import Any

import numpy as np

from kantor_fleet.execution.in_process_team import play, team
from kantor_protocol.base.grid import FREE, UNKNOWN
from kantor_protocol.base.machine import StateMachine
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.record.records import Batch, Ending, Record
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.starts import observable, starts_on
from kantor_worldsim.world.world import WorldSetup
from support.grounds import drawn
from support.strategies import validate_all

ROOMS = drawn(
    "####################",
    "#......#.....#.....#",
    "#......#.....#.....#",
    "#............#.....#",
    "#......#...........#",
    "####.######.####.###",
    "#..................#",
    "#..................#",
    "###.#####.######.###",
    "#......#.....#.....#",
    "#......#.....#.....#",
    "#......#.....#.....#",
    "####################",
)
MISSION = """
name = "rooms"
limit_s = 600
robots = { count = 3 }
starts = { random = true }
map = { layout = "blank" }
vehicle = { speed_m_s = 1 }
clock = { period_s = 1 }
sensor = { range_m = 4, beams = 120 }
planner = { name = "burgard", remember_s = 30 }
"""


def mission(*overrides: str) -> Scenario:
    """Three robots in seven rooms."""
    return parse(MISSION, "rooms", overrides)


class Played:
    """A mission to its end, with the machines as they are then."""

    def __init__(
        self,
        scenario: Scenario,
        ground: Ground = ROOMS,
        seed: int = 1,
        disturb: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        starts_m = starts_on(
            ground,
            poses_m=scenario.starts.poses_m,
            random=scenario.starts.random,
            spread=scenario.starts.spread,
            spots=0,
            count=scenario.robots.count,
            seed=seed,
        )
        setup = WorldSetup(np.zeros((0, 2)), np.zeros((0, 2)), starts_m, ground)
        self.machines: dict[str, Any] = dict(team(scenario, seed, setup))
        self.records: list[Record] = []
        machines: dict[str, StateMachine] = dict(self.machines)
        if disturb is not None:
            disturb(machines)
        observers = [self.records.append, self._validate]
        self.reason = play(scenario, seed, setup, observers, machines=machines)
        self.ground = ground
        self.observable = observable(ground, starts_m).ravel()

    def _validate(self, _record: Record) -> None:
        """Validate the machines after every 25th record."""
        if len(self.records) % 25 == 0:
            validate_all(self.machines.values())

    @property
    def batches(self) -> list[Batch]:
        """In order."""
        return [record for record in self.records if isinstance(record, Batch)]

    @property
    def ticks(self) -> int:
        """Until all robots rest."""
        ending = self.records[-1]
        assert isinstance(ending, Ending)
        return ending.now_ns // 1_000_000_000

    def cells(self, name: str = "r1") -> np.ndarray:
        """What a robot knows at the end."""
        return np.asarray(self.machines[name]._fused_map.cells)

    def assert_explored(self) -> None:
        """Every robot rests and knows all observable cells, as they are."""
        truth = self.ground.cells.ravel()
        assert self.reason == "done"
        for name in ("r1", "r2", "r3"):
            known = self.cells(name) != UNKNOWN
            assert (self.cells(name)[known] == truth[known]).all()
            assert known[(truth == FREE) & self.observable].all()
