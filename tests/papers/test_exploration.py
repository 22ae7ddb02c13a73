"""Every planner on every kind of map: it ends, and no robot oscillates or stalls."""

import pytest

from kantor_fleet.execution.experiment import Case, run_case
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.scenario.schema import MAP_PLANNERS

SIZES = {
    "office": ("map.size_m=[20.0,16.0]", "coordination=decentralized"),
    "blank": ("map.size_m=[48.0,48.0]",),
    "unstructured": ("map.size_m=[48.0,48.0]", "coordination=decentralized", "radio.range_m=20"),
    "cityblock": ("map.size_m=[48.0,48.0]",),
}
SWITCHES_MAX = 12
"""Of one robot: changes of its target by more than a sensor range, before it was reached."""
STALL_MAX = 30
"""Ticks that a robot with work left may stand still: it waits for another, or for its share."""


@pytest.mark.parametrize("layout", SIZES)
@pytest.mark.parametrize("planner", sorted(MAP_PLANNERS))
def test_missions_end_without_oscillation(planner: str, layout: str) -> None:
    """Four robots from both kinds of starts, with every checker."""
    for spread in ("separate", "together"):
        overrides = (
            *SIZES[layout],
            f"planner={planner}",
            f"starts.spread={spread}",
            "robots.count=4",
        )
        result = run_case(Case(find(layout, overrides), 2)).result

        assert result is not None
        assert (result.ended, result.complaints) == ("done", ())
        assert result.map is not None
        assert result.map.explored > 0.999
        assert result.map.bumps == 0
        assert result.map.switches <= SWITCHES_MAX * result.robots
        assert result.map.stall_ticks <= STALL_MAX
