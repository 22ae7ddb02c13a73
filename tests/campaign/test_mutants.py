"""Every planted bug is caught by a checker within a bounded number of a campaign's missions.

Each hunt starts at the seed that `docs/mutants.md` records; `make mutants` starts all of them at seed 0.
"""

import pytest

from campaign.mutants import LIMIT, MUTANTS, Mutant, hunt, recorded_seed
from kantor_fleet.campaign.mission import rule_of

_CRASH = "Error"


def test_there_are_at_least_24_bugs_with_names_of_their_own() -> None:
    assert len(MUTANTS) >= 24
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_planted_bug_is_caught(mutant: Mutant) -> None:
    catch = hunt(mutant, recorded_seed(mutant.name))
    assert catch is not None, f"{mutant.name} survives {LIMIT} missions: {mutant.does}"
    assert not rule_of(catch.complaint).endswith(_CRASH), f"a crash is no verdict: {catch}"
