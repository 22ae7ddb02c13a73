"""An engine, the base image and the image, once for all tests of containers."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from containers.engine import BASE, IMAGE, Fleet, NoEngineError, an_engine, call
from kantor_fleet.processes.compose import ComposeConfig


@pytest.fixture(scope="session")
def image() -> Iterator[str]:
    """The image, built from this checkout. Where no engine can be had tests are skipped; in CI that is an error."""
    engine = an_engine()
    try:
        engine.__enter__()
    except NoEngineError as error:
        if os.environ.get("CI"):
            pytest.fail(str(error))
        pytest.skip(str(error))
    try:
        if not call("docker", "images", "--quiet", BASE):
            call("docker/base.sh", TMPDIR="/dev/shm" if Path("/dev/shm").is_dir() else "/tmp")
        call("docker/build.sh", "--tag", IMAGE)
        yield IMAGE
    finally:
        engine.__exit__(None, None, None)


MakeFleet = Callable[..., Fleet]


@pytest.fixture
def fleet_of(image: str, tmp_path: Path) -> Iterator[MakeFleet]:
    """Makes fleets that are gone afterwards."""
    fleets: list[Fleet] = []

    def make(order: ComposeConfig, **settings: Any) -> Fleet:
        fleets.append(Fleet(tmp_path / f"fleet{len(fleets)}", order, **settings))
        return fleets[-1]

    yield make
    for fleet in fleets:
        fleet.remove()
