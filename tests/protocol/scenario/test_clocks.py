"""Clocks: steps in simulated time, rising whatever the drift, the spread and the jitter."""

from itertools import pairwise

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from kantor_protocol.base.machine import SUPERVISOR
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.schema import Scenario
from support.strategies import examples, mission

PERIOD_NS = 100_000_000


def timetable(scenario: Scenario, seed: int, steps: int) -> list[tuple[int, str]]:
    """The first steps of all participants, by time."""
    return sorted(
        (clock.due_ns(step), name)
        for name, clock in step_clocks(scenario, seed).items()
        for step in range(1, steps + 1)
    )


@examples(150)
@given(
    seed=st.integers(0, 2**32),
    spread=st.floats(0.0, 0.9),
    drift_ppm=st.floats(0.0, 100_000.0),
    jitter=st.floats(0.0, 1.2) | st.floats(0.999, 1.0),
    period_s=st.sampled_from([0.1, 1e-6, 3.7]),
)
def test_time_rises_with_every_step(
    seed: int, spread: float, drift_ppm: float, jitter: float, period_s: float
) -> None:
    """Whatever clock a scenario may ask for, a step comes after the one before it.

    jitter: as a share of the shortest period after spread and drift.
    """
    jitter_s = jitter * period_s * (1.0 - spread) * (1.0 - drift_ppm * 1e-6)
    try:
        scenario = mission(
            f"clock.spread={spread!r}",
            f"clock.drift_ppm={drift_ppm!r}",
            f"clock.jitter_s={jitter_s!r}",
            f"clock.period_s={period_s!r}",
        )
    except ScenarioError:
        assume(False)
    for clock in step_clocks(scenario, seed).values():
        dues_ns = [clock.due_ns(step) for step in range(1, 60)]

        assert all(before < after for before, after in pairwise([0, *dues_ns]))
        for now_ns in (0, *(due_ns + late_ns for due_ns in dues_ns[:-1] for late_ns in (-1, 0, 1))):
            assert clock.steps_by(now_ns) == sum(due_ns <= now_ns for due_ns in dues_ns)


def test_concurrent_robots_step_at_the_same_moment() -> None:
    """Order `concurrent`: all phases are equal, and there is no supervisor without the word."""
    scenario = mission()

    assert timetable(scenario, 1, 2) == [
        (step * PERIOD_NS, name) for step in (1, 2) for name in ("r1", "r2", "r3")
    ]


def test_supervisor_steps_half_way_between_concurrent_robots() -> None:
    """Its message is in time for the robots' next step (Algorithm 2: merge after all have moved)."""
    scenario = mission("coordination=centralized")

    assert timetable(scenario, 1, 2) == [
        (PERIOD_NS, "r1"),
        (PERIOD_NS, "r2"),
        (PERIOD_NS, "r3"),
        (PERIOD_NS * 3 // 2, SUPERVISOR),
        (PERIOD_NS * 2, "r1"),
        (PERIOD_NS * 2, "r2"),
        (PERIOD_NS * 2, "r3"),
        (PERIOD_NS * 5 // 2, SUPERVISOR),
    ]


def test_in_turn_phases_are_spread_over_the_period() -> None:
    """Order `turn`: one robot after the other, each once a period."""
    scenario = mission("clock.order=turn")

    assert timetable(scenario, 1, 2) == [
        (PERIOD_NS * 3 // 3, "r1"),
        (PERIOD_NS * 4 // 3, "r2"),
        (PERIOD_NS * 5 // 3, "r3"),
        (PERIOD_NS * 6 // 3, "r1"),
        (PERIOD_NS * 7 // 3, "r2"),
        (PERIOD_NS * 8 // 3, "r3"),
    ]


@pytest.mark.parametrize("count", [1, 2, 3, 5, 7])
def test_in_turn_the_supervisor_steps_between_any_two_robots(count: int) -> None:
    """In turn, the supervisor has merged before the next robot plans, for a thousand periods."""
    scenario = mission(
        "coordination=centralized",
        "clock.order=turn",
        f"robots.count={count}",
        "starts.random=true",
        "starts.poses_m=[]",
    )
    made = step_clocks(scenario, 1)
    steps = {name: 1000 * count if name == SUPERVISOR else 1000 for name in made}
    due = sorted(
        (clock.due_ns(step), name)
        for name, clock in made.items()
        for step in range(1, steps[name] + 1)
    )

    assert [name for _, name in due] == [
        name for _ in range(1000) for robot in scenario.robot_ids for name in (robot, SUPERVISOR)
    ]


def test_same_seed_same_clock() -> None:
    """Clocks are drawn from the seed and from nothing else."""
    scenario = mission("clock.spread=0.2", "clock.drift_ppm=500.0", "clock.jitter_s=0.01")

    assert timetable(scenario, 7, 20) == timetable(scenario, 7, 20)
    assert timetable(scenario, 7, 20) != timetable(scenario, 8, 20)


def test_spread_and_drift_keep_within_their_bounds() -> None:
    """Periods lie in [1 - spread, 1 + spread] times the nominal one, rates within the drift."""
    scenario = mission("clock.spread=0.2", "clock.drift_ppm=500.0")
    made = [clock for seed in range(40) for clock in step_clocks(scenario, seed).values()]

    assert all(0.8 * PERIOD_NS <= clock.period_ns <= 1.2 * PERIOD_NS for clock in made)
    assert all(-500 <= clock.drift_ppm <= 500 for clock in made)
    assert len({clock.period_ns for clock in made}) == len(made)


def test_jitter_only_delays() -> None:
    """A step is late by at most the jitter, and never early."""
    scenario = mission("clock.jitter_s=0.02")
    late_ns = [
        clock.due_ns(step) - step * PERIOD_NS
        for clock in step_clocks(scenario, 3).values()
        for step in range(1, 100)
    ]

    assert all(0 <= late < 20_000_000 for late in late_ns)
    assert len(set(late_ns)) > 250
