"""Every robot, supervisor, belief and floor that a test here builds is validated at the end of the test."""

from collections.abc import Iterator

import pytest

from kantor_agent.belief.belief import Belief
from kantor_agent.robots.density import DensityRobot
from kantor_agent.robots.mapping import MappingRobot
from kantor_supervisor.density import DensitySupervisor
from kantor_supervisor.mapping import MappingSupervisor
from support.strategies import all_validated
from support.teams.floors import Floor


@pytest.fixture(autouse=True)
def all_keep_their_invariants() -> Iterator[None]:
    """Machines and maps keep their invariants, whatever the test did with them."""
    with all_validated(
        DensityRobot, MappingRobot, DensitySupervisor, MappingSupervisor, Belief, Floor
    ):
        yield
