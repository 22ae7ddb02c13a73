"""Burgard, Fox, Moors, Simmons, Thrun, "Collaborative Multi-Robot Exploration" (2000): their claims, run.

The paper leaves open how random starts lie and when robots choose anew; `burgard.READINGS` are ways to
read it. Ten runs of everything are `kantor reproduce burgard-fig8`; here are fewer, with wider bands.
"""

import functools

import pytest

from kantor_fleet.reproduce.burgard import READINGS, Reading
from kantor_fleet.reproduce.claims import mean_ratio
from kantor_fleet.reproduce.measured_runs import MeasuredRun, run_measured
from kantor_fleet.reproduce.measures import distance_m, finished, map_result_of

A, B, C, D = READINGS
SEEDS = 5

section = pytest.mark.xdist_group("burgard")


@functools.cache
def flown(letter: str, robots: int, *, coordinated: bool, seeds: int = SEEDS) -> list[MeasuredRun]:
    """A reading over seeds 0, 1, …; no rule may be broken on the way."""
    reading = next(reading for reading in READINGS if reading.letter == letter)
    cases = reading.setting(robots, coordinated=coordinated).cases(range(seeds))
    flights = [run_measured(case) for _, case in cases]
    assert [flight.failed for flight in flights] == [None] * seeds
    return flights


def times(letter: str, robots: int, *, coordinated: bool) -> list[float]:
    """Ticks until the team finished."""
    return [finished(flight) for flight in flown(letter, robots, coordinated=coordinated)]


@section
@pytest.mark.parametrize("reading", [A, B, C], ids=lambda reading: reading.letter)
def test_3_3_one_robot_needs_no_coordination(reading: Reading) -> None:
    """Figure 8 has one bar for one robot: with and without coordination it does the very same."""
    alone, uncoordinated = (
        flown(reading.letter, 1, coordinated=coordinated, seeds=2) for coordinated in (True, False)
    )

    for one, other in zip(alone, uncoordinated, strict=True):
        assert (finished(one), distance_m(one)) == (finished(other), distance_m(other))
        assert map_result_of(one) == map_result_of(other)


@section
def test_3_3_everything_is_explored() -> None:
    """Section 3.3: runs last until the environment is explored."""
    for flight in flown("B", 3, coordinated=True):
        assert flight.result is not None
        assert flight.result.ended == "done"
        assert map_result_of(flight).explored > 0.99


@section
def test_3_3_uncoordinated_robots_are_faster_than_one() -> None:
    """Section 3.3: "even an uncoordinated team of robots is faster than a single robot"."""
    ratio, *_ = mean_ratio(times("A", 2, coordinated=False), times("A", 1, coordinated=False))

    assert ratio < 0.85


@section
def test_3_3_coordinated_robots_need_less_time() -> None:
    """Section 3.3: "significantly less", side by side: 0.69 in another simulator with three robots."""
    ratio, *_ = mean_ratio(times("B", 3, coordinated=True), times("B", 3, coordinated=False))

    assert ratio <= 0.95


@section
def test_3_3_two_coordinated_are_about_three_uncoordinated() -> None:
    """Section 3.3: side by side "about the same time": 0.99 in another simulator."""
    ratio, *_ = mean_ratio(times("B", 2, coordinated=True), times("B", 3, coordinated=False))

    assert 0.75 <= ratio <= 1.25
