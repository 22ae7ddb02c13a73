"""Honest robots keep every rule at any scale and anywhere: from micrometres at the origin to UTM coordinates."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kantor_fleet.execution.in_process_team import play
from kantor_protocol.base.grid import Frame
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.checkers.checker import Checker
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.starts import starts_on
from kantor_worldsim.world.world import WorldSetup
from support.grounds import SMALL
from support.strategies import examples

MISSION = """
name = "scaled"
limit_s = {limit_s}
robots = {{ count = 2 }}
starts = {{ random = true }}
vehicle = {{ name = "{vehicle}", speed_m_s = {s}, acceleration_m_s2 = {s}, turn_rate_rad_s = 3, turn_radius_m = {s} }}
clock = {{ period_s = {period_s}, spread = 0.1, drift_ppm = 100 }}
sensor = {{ range_m = {range_m} }}
radio = {{ range_m = {range_m}, delay_s = 0.001 }}
"""
DENSITY = """
domain = {{ min_m = [{x}, {y}], max_m = [{right}, {top}] }}
energy = {{ points = 120 }}
samples = {{ count = 60 }}
targets = {{ count = 10 }}
density = [{{ mean_m = [{middle_x}, {middle_y}], variance_m2 = [{variance}, {variance}] }}]
"""
MAP = """
map = {{ layout = "blank" }}
planner = {{ name = "burgard" }}
"""


def checked(scenario: Scenario, setup: WorldSetup) -> list[str]:
    """What checkers say of a mission."""
    checker = Checker()
    play(scenario, 0, setup, [Pipeline(checker).observe])
    return list(checker.violations)


@examples(40)
@given(
    vehicle=st.sampled_from(["first-order", "second-order", "unicycle", "dubins"]),
    exponent=st.integers(-6, 6),
    away_m=st.sampled_from([0.0, -3.7, 4_649_776.3, -1e7, 9_999_999.9]),
    steps_per_metre=st.sampled_from([1.0, 30.0, 10_000.0]),
)
def test_densities(vehicle: str, exponent: int, away_m: float, steps_per_metre: float) -> None:
    """Domains of ten units, wherever they are more than rounding."""
    s = 10.0**exponent
    if 10.0 * s < 1e-7 * abs(away_m):
        away_m = 0.0
    x, y = away_m / 3.0, away_m
    places = {
        "s": s, "range_m": 2.0 * s, "period_s": 1.0 / steps_per_metre, "x": x, "y": y,
        "right": x + 10.0 * s, "top": y + 10.0 * s, "middle_x": x + 5.0 * s, "middle_y": y + 5.0 * s,
        "variance": s * s, "vehicle": vehicle, "limit_s": 300.0 / steps_per_metre,
    }  # fmt: skip
    scenario = parse((MISSION + DENSITY).format(**places), "scaled")
    assert checked(scenario, WorldSetup.of(scenario, 0)) == []


@examples(40)
@given(
    vehicle=st.sampled_from(["first-order", "second-order", "unicycle"]),
    exponent=st.integers(-6, 4),
    away_m=st.sampled_from([0.0, -3.7, 4_649_776.3, -1e7, 9_999_999.9]),
    steps_per_metre=st.sampled_from([1.0, 30.0, 10_000.0]),
)
def test_maps(vehicle: str, exponent: int, away_m: float, steps_per_metre: float) -> None:
    """Cells of one unit, wherever a thousandth of a cell is more than rounding."""
    s = 10.0**exponent
    if s < 1e-6 * abs(away_m):
        away_m = 0.0
    places = {
        "s": s,
        "range_m": 3.0 * s,
        "period_s": 1.0 / steps_per_metre,
        "vehicle": vehicle,
        "limit_s": 300.0 / steps_per_metre,
    }
    scenario = parse((MISSION + MAP).format(**places), "scaled")
    frame = SMALL.frame
    ground = Ground(Frame(s, (away_m / 3.0, away_m), frame.rows, frame.columns), SMALL.cells)
    starts_m = starts_on(
        ground, poses_m=(), random=True, spread="separate", spots=0, count=2, seed=0
    )
    none = np.zeros((0, 2))
    assert checked(scenario, WorldSetup(none, none, starts_m, ground)) == []
