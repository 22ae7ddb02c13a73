"""Every planted bug is caught by a checker within a bounded number of a campaign's missions."""

import pytest

from campaign.mutants import BUGS, LIMIT, MUTANTS, Mutant, hunt, recorded_seeds
from kantor_fleet.campaign.mission import rule_of

_CRASH = "Error"
_RECORDED = recorded_seeds()


def test_there_are_enough_of_them() -> None:
    assert len(BUGS) == 6
    assert len(MUTANTS) >= 84
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS)


def test_each_has_a_recorded_seed() -> None:
    """docs/mutants.md has every mutant, and how it was caught."""
    assert {mutant.name for mutant in MUTANTS} == _RECORDED.keys()
    assert all(0 <= seed < LIMIT for seed in _RECORDED.values())


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_is_caught(mutant: Mutant) -> None:
    """The hunt begins at the recorded seed; `make mutants` begins at 0."""
    catch = hunt(mutant, _RECORDED.get(mutant.name, 0))
    assert catch is not None, f"{mutant.name} survives {LIMIT} missions: {mutant.does}"
    assert not rule_of(catch.violation).endswith(_CRASH), f"a crash is no verdict: {catch}"
