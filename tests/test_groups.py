"""How tests are spread over workers."""

import pytest


@pytest.mark.xdist_group("together")
def test_a_group_stays_on_one_worker(request: pytest.FixtureRequest) -> None:
    """Tests that share what is dear are marked so; xdist tells them by the end of their id."""
    alone = not hasattr(request.config, "workerinput")
    assert alone or request.node.nodeid.endswith("@together")
