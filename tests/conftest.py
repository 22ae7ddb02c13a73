"""The tiers of the tests, the order in which groups start, and the `kantor` command as a fixture."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from support.processes.command import CommandServer, Kantor
from support.tiers import LONGEST_FIRST, tier_of, tier_of_place

settings.register_profile("kantor", deadline=None, print_blob=True)
settings.register_profile("fast", settings.get_profile("kantor"), max_examples=10)
settings.load_profile("kantor")


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--rewrite` brings the transcripts up to date."""
    parser.addoption("--rewrite", action="store_true", help="rewrite transcripts of robots")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out, for `-m unit`, the files without unit tests: importing them takes as long as many tests."""
    if config.option.markexpr != "unit" or not collection_path.name.startswith("test_"):
        return None
    return True if tier_of_place(collection_path) not in {"unit", None} else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test with its tier, and start the tiers with long tests first."""
    tiers = {item: tier_of(item) for item in items}
    for item, tier in tiers.items():
        if item.get_closest_marker(tier) is None:
            item.add_marker(tier)
    items.sort(key=lambda item: LONGEST_FIRST.index(tiers[item]))


@pytest.fixture(scope="session")
def command_server() -> Iterator[CommandServer]:
    """The process of which the commands of all tests are forks."""
    server = CommandServer()
    yield server
    server.close()


@pytest.fixture
def kantor(tmp_path: Path, command_server: CommandServer) -> Iterator[Kantor]:
    """The kantor command."""
    command = Kantor(tmp_path, command_server)
    yield command
    command.stop_all()
