"""Scenarios that cannot work are refused at the start, and doubtful ones get a warning."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from kantor_fleet.scenarios.catalog import find, names
from kantor_protocol.base.grid import FREE
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import parse
from kantor_worldsim.world.feasibility import find_room
from kantor_worldsim.world.world import WorldSetup
from support.strategies import examples

MAP = """
name = "map"
limit_s = 100
robots = { count = 1 }
starts = { random = true }
map = { layout = "blank", size_m = [8, 8], resolution_m = 0.5 }
vehicle = { speed_m_s = 0.5 }
clock = { period_s = 0.1 }
sensor = { range_m = 3 }
planner = { name = "burgard" }
"""
DENSITY = """
name = "density"
domain = { min_m = [0, 0], max_m = [10, 10] }
robots = { count = 1 }
starts = { poses_m = [[5, 5]] }
energy = { points = 8 }
samples = { count = 100 }
density = [{ mean_m = [5, 5], variance_m2 = [1, 1] }]
"""


def warnings(text: str, *overrides: str) -> tuple[str, ...]:
    """The warnings at the start of a mission."""
    return WorldSetup.of(parse(text, "here", overrides), 0).warnings


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("sensor.range_m=0.25", "sensor.range_m: 0.25 m, and a cell is 0.5 m wide"),
        ("sensor.range_m=1e6", "sensor.range_m: 1e+06 m is measured in steps of 15.2593 m"),
    ],
)
def test_a_mission_on_a_map_that_cannot_work_is_refused(override: str, key: str) -> None:
    """One line that names the key, and says what to give."""
    with pytest.raises(ScenarioError) as refused:
        warnings(MAP, override)
    assert str(refused.value).startswith(key)
    assert ";" in str(refused.value) or ": a robot sees" in str(refused.value)


@examples(60)
@given(resolution_m=st.floats(0.1, 1.0), share=st.floats(0.01, 0.5))
def test_a_sensor_that_ends_in_its_own_cell_is_always_refused(
    resolution_m: float, share: float
) -> None:
    """At any size of cells."""
    overrides = (f"map.resolution_m={resolution_m}", f"sensor.range_m={share * resolution_m}")
    with pytest.raises(ScenarioError, match=r"sensor\.range_m"):
        warnings(MAP, *overrides)


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (("sensor.range_m=0.4",), "sensor.range_m: 0.4 m is shorter than a cell of 0.5 m"),
        (("sensor.beams=1",), "sensor.beams: 1 over 360 degrees"),
        (("sensor.field_of_view_deg=90", "sensor.beams=1"), "sensor.beams: 1 over 90 degrees"),
        (
            ("vehicle.speed_m_s=0.004",),
            "vehicle.speed_m_s: until limit_s = 100 s a robot drives 0.4 m",
        ),
        (("vehicle.speed_m_s=40",), "vehicle.speed_m_s: a robot drives 4 m in a period"),
        (
            ("map.layout=office", "map.size_m=[20, 20]", "vehicle.radius_m=1.5"),
            "vehicle.radius_m: a body 3 m wide",
        ),
    ],
)
def test_a_doubtful_mission_on_a_map_gets_a_warning(overrides: tuple[str, ...], key: str) -> None:
    """One line; the mission begins."""
    (warning,) = warnings(MAP, *overrides)
    assert warning.startswith(key)


def test_samples_outside_the_domain() -> None:
    """Many of them, or any of a file, are a warning, the tails of a density nothing."""
    assert warnings(DENSITY) == ()
    assert warnings(DENSITY, "domain.max_m=[8, 8]") == ()
    (half,) = warnings(DENSITY, "density=[{ mean_m = [10, 5], variance_m2 = [1, 1] }]")
    assert half.startswith("samples: ")
    assert half.endswith("of 100 lie outside the domain [0, 10] x [0, 10]")
    (every,) = warnings(DENSITY, "density=[{ mean_m = [500, 5], variance_m2 = [1, 1] }]")
    assert every.startswith("samples: 100 of 100 lie outside the domain")


@pytest.mark.parametrize("name", names())
def test_no_packaged_scenario_is_doubtful(name: str) -> None:
    """Nobody has to learn to ignore a warning."""
    assert WorldSetup.of(find(name), 0).warnings == ()


@examples(60)
@given(seed=st.integers(0, 1000), radius_cells=st.floats(0.5, 6.0))
def test_a_body_has_room_where_what_is_not_free_is_far_enough(
    seed: int, radius_cells: float
) -> None:
    """As scipy's distances say; all beside the map is not free."""
    draws = np.random.default_rng(seed)
    free = draws.random(draws.integers(1, 30, 2)) < 0.9
    room = find_room(free, radius_cells)

    apart = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] - 0.5
    assert (room == FREE).tolist() == (apart >= radius_cells).tolist()
