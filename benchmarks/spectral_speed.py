"""CPU time of one step of multiscale coverage by its modes, compared with a step of optimal transport.

The robot explores section VI-A's density alone. Its register, of 1,000 visits, is then written into a
message, checked on arrival, and taken in; a robot does so once for each register that it receives.
"""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

from planner_speed import Mission
from tables import Table, verdict

from kantor_fleet.scenarios.catalog import find
from kantor_protocol.base.machine import Pose
from kantor_protocol.replication.registers import Registers
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.world.density import samples_of

MODES = (10, 15, 20)
MODES_QUICK = (15,)
CHUNK = 50
"""Steps between two readings of the clock."""
CHUNKS = 80
VISITS = 1_000
RATIO_MAX = 2.0
"""A step costs at most so many times one of the planner `transport`."""


class RegisterCost(NamedTuple):
    """The cost of a register."""

    compose_us: float
    sound_us: float
    learn_us: float
    bytes: int


def measure(*, quick: bool) -> Table:
    """CPU microseconds by K; transport, first, has no register."""
    transport = find("paper-single")
    choose_us, step_us = _costs(transport)
    rows = [("transport", f"{choose_us:.2f}", f"{step_us:.2f}", *["-"] * 6)]
    met = True
    for modes in MODES_QUICK if quick else MODES:
        scenario = find("paper-single", ("planner=spectral", f"planner.modes={modes}"))
        spectral_us, whole_us = _costs(scenario)
        word = _word(scenario)
        reached = whole_us <= RATIO_MAX * step_us
        met = met and reached
        rows.append(
            (
                f"spectral, K = {modes}",
                f"{spectral_us:.2f}",
                f"{whole_us:.2f}",
                f"{whole_us / step_us:.1f}",
                verdict(met=reached),
                f"{word.compose_us:.2f}",
                f"{word.sound_us:.2f}",
                f"{word.learn_us:.2f}",
                f"{word.bytes:,}",
            )
        )
    return Table(
        "spectral: CPU us per step and per register, medians",
        (
            "planner",
            "choose",
            "choose, move, consume",
            "ratio",
            f"<= {RATIO_MAX:g}",
            "code",
            "check",
            "take in",
            "bytes",
        ),
        rows,
        (),
        met,
    )


def _costs(scenario: Scenario) -> tuple[float, float]:
    """The planner alone, in place, and the whole step, under way."""
    samples_m = samples_of(scenario, 0)
    mission = Mission(scenario, samples_m)
    belief, choose = mission.belief, mission.planner.choose
    poses = [Pose(40.0 + 30.0 * i, 1500.0 - 25.0 * i) for i in range(CHUNK)]

    def plan() -> None:
        for pose in poses:
            choose(belief, pose, 0)

    plan_us = _median_us(plan)
    mission = Mission(scenario, samples_m)
    return plan_us, _median_us(lambda: mission.advance(CHUNK))


def _word(scenario: Scenario) -> RegisterCost:
    """The cost of a register of so many visits, at a robot that receives it from another."""
    mission = Mission(scenario, samples_of(scenario, 0))
    mission.advance(VISITS)
    amounts = mission.belief.registers.total
    width = scenario.register_width
    one, two = Registers(0, 2, width, beacon=True), Registers(1, 2, width)
    one.add(amounts)
    composed = one.compose()
    stamps = bytes([0, 0])
    newer = [stamps + bytes([0, stamp]) + composed[4:] for stamp in range(1, CHUNK + 1)]

    def take_in() -> None:
        two.stamps[:] = 0
        for word in newer:
            two.merge(0, word, 2)

    def compose() -> None:
        for _ in range(CHUNK):
            one.compose()

    def check() -> None:
        for _ in range(CHUNK):
            two.is_well_formed(composed, 2)

    assert all(two.is_well_formed(word, 2) for word in newer)
    return RegisterCost(_median_us(compose), _median_us(check), _median_us(take_in), len(composed))


def _median_us(work: Callable[[], None]) -> float:
    """CPU time of one of the CHUNK pieces of the work."""
    work()
    costs = []
    for _ in range(CHUNKS):
        start_ns = time.process_time_ns()
        work()
        costs.append((time.process_time_ns() - start_ns) / CHUNK / 1e3)
    return statistics.median(costs)
