"""Every test has one tier, and groups are spread over workers as units."""

import pytest

from support.tiers import TIER_OF_PLACE, TIERS, tier_of


def test_every_test_has_exactly_one_tier(request: pytest.FixtureRequest) -> None:
    for item in request.session.items:
        marks = [mark.name for mark in item.iter_markers() if mark.name in TIERS]
        assert marks == [tier_of(item)], item.nodeid


def test_two_tiers_are_refused(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    marks = [pytest.mark.unit.mark, pytest.mark.papers.mark]
    monkeypatch.setattr(request.node, "own_markers", marks)

    with pytest.raises(pytest.UsageError, match=r"several tiers: unit, papers; keep one"):
        tier_of(request.node)


def test_a_folder_without_a_tier_is_refused(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(TIER_OF_PLACE, "test_tiers.py")
    monkeypatch.setattr(request.node, "own_markers", [])

    with pytest.raises(
        pytest.UsageError, match=r"no tier; add test_tiers.py to tests/support/tiers.py"
    ):
        tier_of(request.node)


@pytest.mark.xdist_group("together")
def test_a_group_stays_on_one_worker(request: pytest.FixtureRequest) -> None:
    """The scheduler of xdist recognizes the tests of a group by the end of their id."""
    alone = not hasattr(request.config, "workerinput")
    assert alone or request.node.nodeid.endswith("@together")
