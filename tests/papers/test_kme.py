"""Puig, Garcia, Wu, exploration of regions by K-means: their claims over few configurations.

All 630 are `kantor reproduce kme-all`. Bands are wide for so few; the readings are another simulator's.
"""

import functools
from collections.abc import Mapping, Sequence

import pytest

from kantor_fleet.reproduce import kme
from kantor_fleet.reproduce.claims import Measure, geometric, paired_ratios
from kantor_fleet.reproduce.measured_runs import MeasuredRun, Setting, run_measured
from kantor_fleet.reproduce.measures import epv_mean, map_result_of, wtv_final, wtv_mean

CONFIGURATIONS = 9
"""The first of the order in which parts are taken: every map, both kinds of starts, 8 to 2 robots."""

section_c = pytest.mark.xdist_group("kme")


@functools.cache
def flown() -> Mapping[Setting, Sequence[MeasuredRun]]:
    """Those configurations, with no rule broken on the way."""
    flights = {
        setting: [run_measured(case) for _, case in setting.cases(seeds)]
        for setting, seeds in kme.requests(CONFIGURATIONS).items()
    }
    failed = [flight.failed for runs in flights.values() for flight in runs]
    assert failed == [None] * 4 * CONFIGURATIONS
    return flights


def ratio(other: str, measure: Measure) -> float:
    """KME over another, with 4 to 8 robots."""
    pairs = paired_ratios(flown(), kme.group(kme.KME), kme.group(other), measure)
    return geometric(pairs)[0]


@section_c
def test_v_b_the_final_variance_is_the_last_one() -> None:
    """Eq. 10: in the end every cell has its stamp, and WTV is the final WTV."""
    for runs in flown().values():
        for flight in runs:
            end = flight.course[-1]
            assert map_result_of(flight).explored > 0.98
            assert end.wtv == pytest.approx(wtv_final(flight), rel=0.25)
            assert end.epv < 5.0


@section_c
@pytest.mark.parametrize(
    ("other", "most"), [(kme.YAMAUCHI, 0.6), (kme.BURGARD, 0.8)], ids=["yamauchi", "burgard"]
)
def test_v_c_kme_has_the_lowest_waiting_time_variance(other: str, most: float) -> None:
    """V-C: lower than Yamauchi's (0.23, 0.25 with 4, 8 robots) and Burgard's (0.40, 0.37)."""
    assert ratio(other, wtv_final) <= most
    assert ratio(other, wtv_mean) <= most


@section_c
@pytest.mark.parametrize(
    ("other", "most"), [(kme.YAMAUCHI, 0.85), (kme.BURGARD, 0.85)], ids=["yamauchi", "burgard"]
)
def test_v_c_kme_explores_regions_at_the_most_equal_speed(other: str, most: float) -> None:
    """V-C: EPV below Yamauchi's (0.57, 0.60) and Burgard's (0.52, 0.54)."""
    assert ratio(other, epv_mean) <= most
