"""Missions on small maps, played in process, for tests of what follows their records."""

import functools

import numpy as np

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.record.records import Record
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.world import WorldSetup
from support.grounds import drawn

ROOMS_MISSION = """
name = "rooms"

[map]
layout = "blank"

[robots]
count = 2

[starts]
poses_m = [[1.5, 1.5], [9.5, 1.5]]

[vehicle]
speed_m_s = 10.0

[planner]
name = "frontier"

[sensor]
range_m = 4.0
beams = 90

[radio]
range_m = 8.0
"""

ROOMS = drawn(
    "################",
    "#......#.......#",
    "#......#.......#",
    "#..............#",
    "#......#.......#",
    "####.#####.#####",
    "#......#.......#",
    "#......#.......#",
    "#..............#",
    "#......#....#..#",
    "#......#.......#",
    "################",
)
"""Four rooms of cells of one metre; 183 of the 192 cells can ever be seen."""


def on_map(*overrides: str) -> Scenario:
    """A mission in these rooms with `key.sub=value` overrides."""
    return parse(ROOMS_MISSION, "rooms", overrides)


def setup_of(scenario: Scenario, ground: Ground = ROOMS) -> WorldSetup:
    """What such a mission starts from, on a map of the test's own."""
    return WorldSetup(np.zeros((0, 2)), np.zeros((0, 2)), np.array(scenario.starts.poses_m), ground)


@functools.cache
def explored(*overrides: str, seed: int = 1) -> tuple[Record, ...]:
    """The records of a mission in these rooms, played to its end."""
    scenario = on_map(*overrides)
    records: list[Record] = []
    play(scenario, seed, setup_of(scenario), [records.append])
    return tuple(records)
