"""The clock of one participant: when its steps fall in simulated time."""

import math

import msgspec
import numpy as np

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.machine import SUPERVISOR, ParticipantId
from kantor_protocol.scenario.schema import Scenario


class StepClock(msgspec.Struct, frozen=True):
    """Period, phase, drift and jitter, all whole nanoseconds or draws keyed by the seed."""

    period_ns: int
    phase_ns: int
    drift_ppm: int
    """Excess of this clock's second, in parts per million."""
    jitter_ns: int
    seed: int
    who: int

    def due_ns(self, step: int) -> int:
        """Simulated time of the given step, counted from 1. It rises with every step."""
        nominal = self.phase_ns + step * self.period_ns
        late = nominal * self.drift_ppm // 1_000_000
        if self.jitter_ns:
            draw = uniform(self.seed, int(Purpose.CLOCK_JITTER), self.who, step, 0)
            late += int(draw * self.jitter_ns)
        return nominal + late

    def steps_by(self, now_ns: int) -> int:
        """How many steps are due by then."""
        nominal_ns = (now_ns + 1) * 1_000_000 // (1_000_000 + self.drift_ppm)  # at the latest
        step = max(0, (nominal_ns - self.phase_ns) // self.period_ns)
        while step and self.due_ns(step) > now_ns:
            step -= 1
        return step


def step_clocks(scenario: Scenario, seed: int) -> dict[ParticipantId, StepClock]:
    """The clocks of all participants in the roster.

    Robots have equal phases, or phases spread over the period when they act in turn. The supervisor
    steps half-way between two robots' steps, so that its message is in time for the next.
    """
    period_ns, count = scenario.period_ns, scenario.robots.count
    turns = count if scenario.clock.order == "turn" else 1
    made = {}
    for i, name in enumerate(scenario.robot_ids):
        stretch = _signed(seed, Purpose.CLOCK_PERIOD, i) * scenario.clock.spread
        drift = _signed(seed, Purpose.CLOCK_DRIFT, i) * scenario.clock.drift_ppm
        made[name] = StepClock(
            period_ns=round(period_ns * (1.0 + stretch)),
            phase_ns=period_ns * (i % turns) // turns,
            drift_ppm=math.trunc(drift),
            jitter_ns=round(scenario.clock.jitter_s * 1e9),
            seed=seed,
            who=i,
        )
    if scenario.centralized:
        beat_ns = max(1, period_ns // turns)
        made[SUPERVISOR] = StepClock(
            period_ns=beat_ns,
            phase_ns=period_ns - beat_ns + beat_ns // 2,
            drift_ppm=0,
            jitter_ns=0,
            seed=seed,
            who=count,
        )
    return made


def steps_max(scenario: Scenario) -> int:
    """The most steps that any participant can make in a mission, whatever the seed."""
    clock = scenario.clock
    turns = scenario.robots.count if scenario.centralized and clock.order == "turn" else 1
    shortest = scenario.period_ns * (1.0 - clock.spread) * (1.0 - clock.drift_ppm * 1e-6) / turns
    return _SPARE_STEPS + int(scenario.limit_ns / max(1.0, shortest))


_SPARE_STEPS = 1000
"""Steps that are due before the limit and made after it, and rounding."""


def _signed(seed: int, purpose: Purpose, who: int) -> float:
    return float(np.float64(2.0 * uniform(seed, int(purpose), who, 0, 0) - 1.0))
