"""Every planted bug is caught by a referee within a bounded number of a campaign's missions."""

import pytest

from campaign.mutants import LIMIT, MUTANTS, Mutant, hunt
from kantor_fleet.campaign.mission import rule_of

_CRASH = "Error"


def test_there_are_enough_of_them() -> None:
    assert len(MUTANTS) >= 24
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_is_caught(mutant: Mutant) -> None:
    catch = hunt(mutant)
    assert catch is not None, f"{mutant.name} survives {LIMIT} missions: {mutant.does}"
    assert not rule_of(catch.complaint).endswith(_CRASH), f"a crash is no verdict: {catch}"
