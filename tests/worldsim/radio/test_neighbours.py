"""Participants by place: whoever may be in range is a candidate, in the order of indices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_worldsim.radio.neighbours import Neighbourhood, candidates, sort_by_place

pytestmark = pytest.mark.unit

ranges_m = st.sampled_from([0.0, 1e-170, 0.1, 1.0, 31.6, 1e9])
places = st.one_of(
    st.integers(-5, 5).map(float),
    st.floats(-1e6, 1e6),
    st.sampled_from([np.inf, -np.inf, np.nan, 1e300, -1e300]),
)


def near(xy_m: np.ndarray, range_m: float, supervisor: int) -> list[list[int]]:
    """The candidates of each participant."""
    around = Neighbourhood.of(xy_m.shape[0])
    sort_by_place(xy_m, range_m, supervisor, around)
    counts = [(candidates(xy_m, one, around), around.near.tolist()) for one in range(xy_m.shape[0])]
    return [listed[:count] for count, listed in counts]


@given(st.lists(st.tuples(places, places), min_size=1, max_size=40), ranges_m, st.integers(-1, 39))
def test_whoever_is_in_range_is_a_candidate(
    at_m: list[tuple[float, float]], range_m: float, supervisor: int
) -> None:
    """Also at exactly the range, and where squares are 0 or overflow."""
    # Distances of whole ranges as well.
    xy_m = np.array(at_m) * (range_m if range_m in {0.1, 31.6} else 1.0)
    supervisor = supervisor if supervisor < len(at_m) else -1
    for one, listed in enumerate(near(xy_m, range_m, supervisor)):
        assert listed == sorted(set(listed))
        with np.errstate(all="ignore"):
            squares = ((xy_m - xy_m[one]) ** 2).sum(axis=1)
            in_range = np.flatnonzero(squares <= range_m * range_m).tolist()
        assert set(in_range) <= set(listed)
        assert supervisor < 0 or supervisor in listed


def test_in_a_wide_world_few_are_candidates() -> None:
    """Nine cells of about one participant each."""
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    lists = near(np.column_stack([x.ravel(), y.ravel()]), 0.5, -1)
    assert max(map(len, lists)) <= 16
