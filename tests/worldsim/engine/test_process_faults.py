"""Process faults over time: their schedule, and the participants that are idle."""

import itertools

import pytest

from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.engine.process_faults import ProcessFaults, ScheduledProcessFault, schedule_of
from support.strategies import SMALL

MS = 1_000_000


def troubled(*faults: str) -> Scenario:
    """The small mission with these faults, a line each."""
    tables = "".join(f"\n[[faults]]\n{fault.replace('; ', chr(10))}\n" for fault in faults)
    return parse(SMALL + tables, "troubled")


KILL = 'kind = "kill"; who = ["r1"]; from_s = 1.0; until_s = 2.0; disk = "torn"; mid_step = true'
FOR_GOOD = 'kind = "kill"; who = ["r2"]; from_s = 2.0'
PAUSE = 'kind = "pause"; who = ["r1", "r3"]; from_s = 2.0; until_s = 3.0'
DARK = 'kind = "pause"; who = ["worldsim"]; from_s = 4.0; until_s = 5.0'
SLOW = 'kind = "slow"; who = ["r3"]; from_s = 6.0; until_s = 8.0; every = 3'
AHEAD = (
    'kind = "clock"; who = ["r3"]; from_s = 1.0; until_s = 3.0; offset_s = 5.0; rate_ppm = 100.0'
)
BEHIND = 'kind = "clock"; who = ["r3"]; from_s = 2.0; offset_s = -2.5'
ASKS = 'kind = "impostor"; who = ["r1"]; from_s = 2.0'


def test_ends_of_faults_come_before_beginnings() -> None:
    """In order of time, then ends, then of the list: a robot can be started and paused at once."""
    schedule = schedule_of(troubled(PAUSE, FOR_GOOD, ASKS, KILL))

    assert schedule == [
        ScheduledProcessFault(1000 * MS, 3, "r1", "kill", "torn", mid_step=True),
        ScheduledProcessFault(2000 * MS, 3, "r1", "start", "torn", mid_step=True),
        ScheduledProcessFault(2000 * MS, 0, "r1", "pause"),
        ScheduledProcessFault(2000 * MS, 0, "r3", "pause"),
        ScheduledProcessFault(2000 * MS, 1, "r2", "kill"),
        ScheduledProcessFault(2000 * MS, 2, "r1", "pretend"),
        ScheduledProcessFault(3000 * MS, 0, "r1", "resume"),
        ScheduledProcessFault(3000 * MS, 0, "r3", "resume"),
    ]


def test_world_sim_comes_first_and_goes_last() -> None:
    """World-sim observes each participant that starts or stops at the same moment."""
    outage = 'kind = "kill"; who = ["worldsim"]; from_s = 1.0; until_s = 2.0'
    pause = 'kind = "pause"; who = ["r3"]; from_s = 1.0; until_s = 2.0'
    schedule = schedule_of(troubled(outage, pause))

    assert [(scheduled.who, scheduled.kind) for scheduled in schedule] == [
        ("r3", "pause"),
        ("worldsim", "kill"),
        ("worldsim", "start"),
        ("r3", "resume"),
    ]


@pytest.mark.parametrize(
    ("who", "at_ms", "idle"),
    [
        ("r1", 999, False),
        ("r1", 1000, True),
        ("r1", 1999, True),
        ("r1", 2000, True),
        ("r1", 3000, False),
        ("r2", 1999, False),
        ("r2", 10**6, True),
        ("r3", 1500, False),
        ("r3", 2000, True),
        ("r1", 4000, True),
        ("r3", 4999, True),
        ("r3", 5000, False),
        ("r3", 6000, False),
        ("r3", 6100, True),
        ("r3", 6299, True),
        ("r3", 6300, False),
        ("r3", 8000, False),
    ],
)
def test_a_participant_is_idle_within_its_windows(who: str, at_ms: int, idle: bool) -> None:  # noqa: FBT001
    """From the beginning of a window up to its end; all participants are while world-sim is."""
    outages = ProcessFaults(troubled(KILL, FOR_GOOD, PAUSE, DARK, SLOW))

    assert outages.idle(who, at_ms * MS) == idle


def test_no_participant_is_idle_or_dies_while_it_is_quiet() -> None:
    """Before the first window and after the last; windows of clocks and of links do not count."""
    outages = ProcessFaults(troubled(KILL, PAUSE, AHEAD))
    quiet = [outages.quiet(at_ms * MS, (at_ms + 99) * MS) for at_ms in range(0, 9000, 100)]

    for i, is_quiet in enumerate(quiet):
        for name, at_ms in itertools.product(("r1", "r2", "r3"), (100 * i, 100 * i + 99)):
            affected = outages.idle(name, at_ms * MS) or outages.dies(name, at_ms * MS)
            assert not (is_quiet and affected)
    assert quiet[0]
    assert quiet[-1]
    assert not all(quiet)
    assert ProcessFaults(troubled(AHEAD)).quiet(0, 2**62)


@pytest.mark.parametrize(
    ("at_ms", "skew_ns"),
    [
        (999, 0),
        (1000, 5000 * MS),
        (1500, 5000 * MS + 50_000),
        (2000, 2500 * MS + 100_000),
        (3000, -2500 * MS),
    ],
)
def test_faults_of_a_clock_add_up(at_ms: int, skew_ns: int) -> None:
    """The clock jumps, runs wrong, and jumps back."""
    assert ProcessFaults(troubled(AHEAD, BEHIND)).skew_ns("r3", at_ms * MS) == skew_ns


def test_no_clock_shows_a_time_before_the_start() -> None:
    """Messages carry times that are not negative."""
    early = 'kind = "clock"; who = ["r3"]; offset_s = -2.5'

    assert ProcessFaults(troubled(early)).skew_ns("r3", 1000 * MS) == -1000 * MS


def test_a_robot_dies_in_a_step_within_the_window() -> None:
    """Any step within the window is one in which it may die."""
    outages = ProcessFaults(troubled(KILL, FOR_GOOD))

    assert [outages.dies("r1", at_ms * MS) for at_ms in (999, 1000, 2000)] == [False, True, False]
    assert not outages.dies("r2", 2500 * MS)


@pytest.mark.parametrize("done", range(10))
def test_every_scheduled_fault_is_returned_once(done: int) -> None:
    """One by one, when it is due, from the beginning or from the point that was reached before."""
    scenario = troubled(KILL, ASKS, PAUSE, DARK)
    outages, left = ProcessFaults(scenario, done), schedule_of(scenario)[done:]

    for scheduled in left:
        assert outages.next_ns == scheduled.at_ns
        assert outages.pop() == scheduled
    assert outages.next_ns is None
