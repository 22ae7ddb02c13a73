"""Records of missions that were played in process, shared by the tests of world-sim."""

import functools
from collections.abc import Callable

import pytest

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.record.records import Record
from kantor_worldsim.world.world import WorldSetup
from support.strategies import mission

ROOMY = ("samples.count=60", "energy.points=90", "energy.steps=60", "targets.count=40")
"""L = 180: three units a sample, two a point; twice the energy that is needed."""


@functools.cache
def _played(scenario: Scenario, seed: int) -> tuple[Record, ...]:
    setup = WorldSetup.of(scenario, seed)
    records: list[Record] = []
    play(scenario, seed, setup, [records.append])
    return tuple(records)


@pytest.fixture(scope="session")
def played() -> Callable[..., tuple[Record, ...]]:
    """The records of a small mission with overrides, played to its end."""

    def play(*overrides: str, seed: int = 1) -> tuple[Record, ...]:
        return _played(mission(*ROOMY, *overrides), seed)

    return play
