"""The pace of a participant: no more steps than time and its clock allow, and every one that they do."""

from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.scenario.clocks import StepClock, step_clocks
from kantor_worldsim.exchange.pace import Pace
from support.strategies import examples, mission

PERIOD_NS = 100_000_000
PLAIN = StepClock(PERIOD_NS, 0, 0, 0, 0, 0)
SLACK = 4
"""Steps that may come at once, and one that was due at the beginning."""


def accepted(pace: Pace, reports: list[tuple[int, int]]) -> list[int]:
    """Times of the steps that are accepted, of reports as (time by its clock, true time)."""
    made = []
    for made_ns, now_ns in reports:
        if pace.permits(made_ns, now_ns):
            pace.count(made_ns, now_ns)
            made.append(made_ns)
    return made


def test_a_burst_after_silence_is_not_accepted() -> None:
    """A hundred seconds of silence do not save a thousand steps."""
    now_ns = 1000 * PERIOD_NS
    burst = [(step * PERIOD_NS, now_ns) for step in range(1, 1001)]

    assert len(accepted(Pace(PLAIN, 0), burst)) == 3


def test_two_steps_at_one_time_of_the_clock_are_not_accepted() -> None:
    now_ns = 5 * PERIOD_NS + 10
    pace = Pace(PLAIN, 0)

    assert accepted(pace, [(now_ns, now_ns), (now_ns + 1, now_ns + 1)]) == [now_ns]
    pace.restart()
    assert pace.permits(now_ns + 1, now_ns + 1)


@given(
    waits_ns=st.lists(st.integers(0, 5 * PERIOD_NS), max_size=200),
    behind_ns=st.lists(st.integers(0, 20 * PERIOD_NS), min_size=200, max_size=200),
)
@examples(200)
def test_no_more_steps_than_periods_have_passed(waits_ns: list[int], behind_ns: list[int]) -> None:
    """Whatever times a participant claims for its steps."""
    now_ns, reports = 0, []
    for wait_ns, back_ns in zip(waits_ns, behind_ns, strict=False):
        now_ns += wait_ns
        reports.append((max(0, now_ns - back_ns), now_ns))

    made = accepted(Pace(PLAIN, 0), reports)
    assert len(made) <= SLACK + 1.02 * now_ns / PERIOD_NS
    assert len({made_ns // PERIOD_NS for made_ns in made}) >= len(made) - SLACK


@given(
    seed=st.integers(0, 50),
    late_ns=st.lists(st.integers(0, PERIOD_NS // 2), min_size=100, max_size=100),
    frozen=st.integers(0, 99),
)
@examples(100)
def test_every_step_of_an_honest_robot_is_accepted(
    seed: int, late_ns: list[int], frozen: int
) -> None:
    """Reports may be under way for half a period, clocks may be uneven, and world-sim may have been frozen."""
    scenario = mission("clock.spread=0.4", "clock.jitter_s=0.02", "clock.drift_ppm=500")
    clock = step_clocks(scenario, seed)["r1"]
    pace = Pace(clock, 0)
    acknowledged_ns, ordinal = 0, 0
    for step, way_ns in enumerate(late_ns):
        ordinal += 1
        while clock.due_ns(ordinal) < acknowledged_ns:  # it holds, and does not make up for it
            ordinal += 1
        made_ns = clock.due_ns(ordinal)
        arrived_ns = made_ns + way_ns + (30 * PERIOD_NS if step == frozen else 0)
        assert pace.permits(made_ns, arrived_ns)
        pace.count(made_ns, arrived_ns)
        acknowledged_ns = arrived_ns


@given(seed=st.integers(0, 50), now_ns=st.integers(0, 100 * PERIOD_NS))
@examples(100)
def test_what_has_arrived_is_needed_shortly_before_the_next_step(seed: int, now_ns: int) -> None:
    """Less than half a period before the first time of its clock that is to come."""
    clock = step_clocks(mission("clock.spread=0.4", "clock.jitter_s=0.02"), seed)["r1"]
    next_ns = next(due for due in map(clock.due_ns, range(1, 1000)) if due > now_ns)

    assert next_ns - PERIOD_NS * 0.4 < Pace(clock, 0).delivery_ns(now_ns) < next_ns
