"""Planted bugs, each switched on by a test only, and the table of the rules that catch them.

A checker that never reports proves nothing until it is seen to report. Each mutant is a bug of `bugs_in_*.py`; a
campaign's own missions run with it until a checker reports a violation. `python tests/campaign/mutants.py` hunts
all of them from seed 0 on and writes docs/mutants.md, where the suite finds the seed from which it hunts.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from campaign import (
    bugs_in_maps,
    bugs_in_processes,
    bugs_in_radio,
    bugs_in_replication,
    bugs_in_robots,
    bugs_in_trust,
)
from campaign.planting import MUTANTS, Mutant
from kantor_fleet.campaign.draw import draw
from kantor_fleet.campaign.mission import Trial, attempt
from kantor_fleet.execution.experiment import Case

BUGS = (
    bugs_in_replication,
    bugs_in_radio,
    bugs_in_robots,
    bugs_in_maps,
    bugs_in_processes,
    bugs_in_trust,
)
"""The modules that plant them."""

LIMIT = 200
"""Missions within which every mutant must be caught."""

TABLE = Path(__file__).parents[2] / "docs" / "mutants.md"

_HEAD = """\
# Planted bugs, and the rules that catch them

{caught} of {all} caught: {hunted} within {limit} missions of `kantor campaign`, from seed 0 on, and {tested} that no
mission meets by the test that is named. Written by `python tests/campaign/mutants.py`;
`tests/campaign/test_mutants.py` plants every one of them.

| mutant | what it does | caught at seed | by rule | violation |
|---|---|---:|---|---|
"""


class Catch(NamedTuple):
    """How a mutant was caught."""

    seed: int
    violation: str
    missions: int
    """Up to and with the one that caught it."""
    wall_s: float


def hunt(one: Mutant, first: int = 0, limit: int = LIMIT) -> Catch | None:
    """Run the missions of a campaign, from seed `first` on, until one catches the bug; None if none does."""
    started_s = time.monotonic()
    with pytest.MonkeyPatch.context() as patch:
        one.plant(patch)
        if one.test is not None:
            return _tested(one.test, started_s)
        for seed in range(first, limit):
            scenario = draw(seed)
            if not one.touches(scenario):
                continue
            # It takes a checker to catch a mutant: what participants find in themselves does not count.
            trial: Trial = attempt(Case(scenario, seed), validate=False)
            if trial.violation is not None:
                return Catch(seed, trial.violation, seed + 1, time.monotonic() - started_s)
    return None


def _tested(test: Callable[[], None], started_s: float) -> Catch | None:
    """Run the test that has to fail."""
    try:
        test()
    except (AssertionError, pytest.fail.Exception):
        function = test.func if isinstance(test, functools.partial) else test
        name = getattr(function, "__wrapped__", function).__name__
        return Catch(0, f"test: {name.strip('_')}", 0, time.monotonic() - started_s)
    return None


def recorded_seeds(path: Path = TABLE) -> dict[str, int]:
    """The seeds at which mutants were caught when the table was written; 0 for those that a test catches."""
    rows = [line.split(" | ") for line in path.read_text(encoding="utf-8").splitlines()]
    return {
        row[0].removeprefix("| "): int(row[2] or 0)
        for row in rows
        if len(row) > 4 and (row[2].isdigit() or row[3] == "test")
    }


def write(hunted: list[tuple[Mutant, Catch | None]], path: Path = TABLE) -> None:
    """Write the table for the repository."""
    caught = [one for one, catch in hunted if catch is not None]
    tested = sum(one.test is not None for one in caught)
    counts = {"caught": len(caught), "all": len(hunted), "tested": tested}
    lines = [_HEAD.format(**counts, hunted=len(caught) - tested, limit=LIMIT)]
    for one, catch in hunted:
        seed = catch.seed if catch and one.test is None else ""
        rule, _, text = catch.violation.partition(": ") if catch else ("**none**", "", "")
        shown = text.replace("|", "\\|")[:90]
        lines.append(f"| {one.name} | {one.does} | {seed} | {rule} | {shown} |\n")
    path.write_text("".join(lines), encoding="utf-8")


def main() -> int:
    """Hunt all mutants, or those that are named."""
    wanted = sys.argv[1:]
    hunted = []
    for one in MUTANTS:
        if not wanted or one.name in wanted:
            catch = hunt(one)
            hunted.append((one, catch))
            print(f"{one.name:38} {catch or 'SURVIVES'}", flush=True)
    if not wanted:
        write(hunted)
    return int(any(catch is None for _, catch in hunted))


if __name__ == "__main__":
    sys.exit(main())
