"""Every robot and supervisor that a test of supervisors builds is validated at the end of the test."""

from collections.abc import Iterator

import pytest

from kantor_agent.robots.density import DensityRobot
from kantor_supervisor.density import DensitySupervisor
from kantor_supervisor.mapping import MappingSupervisor
from support.strategies import all_validated


@pytest.fixture(autouse=True)
def validated_machines() -> Iterator[None]:
    """The machines keep their invariants, whatever the test did with them."""
    with all_validated(DensityRobot, DensitySupervisor, MappingSupervisor):
        yield
