"""The tier of every test: the mark by which `pytest -m` selects it."""

from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
TIERS = ("unit", "processes", "papers", "campaign", "containers", "fuzz")
TIER_OF_PLACE = {
    **dict.fromkeys(("agent", "fleet", "protocol", "supervisor", "worldsim"), "unit"),
    **{tier: tier for tier in TIERS[1:]},
    "fleet/test_report.py": "processes",
    "fleet/test_sweep.py": "processes",
    "fleet/test_report_of_maps.py": "processes",
    "fleet/test_reproduce.py": "papers",
    "fleet/test_reproduce_maps.py": "papers",
    "fleet/test_reproduce_resilience.py": "papers",
    "test_architecture.py": "unit",
    "test_digests.py": "processes",
    "test_documented_commands.py": "processes",
    "test_readme.py": "processes",
    "test_tiers.py": "unit",
}
"""The tier of a folder or file of this folder; the longest path counts, and a mark of the test above all."""
LONGEST_FIRST = ("containers", "papers", "processes", "campaign", "fuzz", "unit")
"""Tiers in the order in which they start: a long test that starts last leaves the other worker idle."""


def tier_of(item: pytest.Item) -> str:
    """The tier of a test: its own mark, `processes` if it runs the command, or that of its place."""
    own = [mark.name for mark in item.iter_markers() if mark.name in TIERS]
    if len(own) > 1:
        raise pytest.UsageError(f"{item.nodeid}: several tiers: {', '.join(own)}; keep one")
    tier = tier_of_place(item.path)
    if tier is None:
        path = item.path.relative_to(TESTS)
        raise pytest.UsageError(f"{item.nodeid}: no tier; add {path} to tests/support/tiers.py")
    if own == ["unit"] != [tier]:
        raise pytest.UsageError(f"{item.nodeid}: a unit test among others; move it to a unit file")
    if own:
        return own[0]
    return "processes" if tier == "unit" and "kantor" in item.fixturenames else tier


def tier_of_place(path: Path) -> str | None:
    """The tier of the tests in a file that have no mark of their own; None if no place covers it.

    Tests of the tier `unit` are in its places only: others need not be imported to run it.
    """
    relative = path.relative_to(TESTS)
    places = [place.as_posix() for place in (relative, *relative.parents)]
    return next((TIER_OF_PLACE[place] for place in places if place in TIER_OF_PLACE), None)
