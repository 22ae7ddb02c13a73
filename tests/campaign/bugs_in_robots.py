"""Bugs in robots: energy, motion, goals, weights and registers."""

from typing import Any

import msgspec
import numpy as np

from campaign.planting import (
    Patch,
    density,
    has,
    mutant,
    now_and_then,
    set_weight,
    spectral,
    wrap,
)
from kantor_agent.belief.belief import Belief
from kantor_agent.robots.density import DensityRobot
from kantor_protocol.replication.registers import Registers
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.faults.processes import Kill
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.weights import WeightsPublisher
from kantor_worldsim.world.world import World


@mutant("a robot ships one unit more than a point holds", density)
def overspending_by_one_unit(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: Belief, walk: Any, units: Any, held: Any) -> None:
            init(self, walk, msgspec.structs.replace(units, point=units.point + 1), held)

        return made

    wrap(patch, Belief, "__init__", make)


@mutant("a robot takes one step more than its budget", density)
def one_step_more_than_the_budget(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: DensityRobot, *arguments: Any) -> None:
            init(self, *arguments)
            self._budget += 1

        return made

    wrap(patch, DensityRobot, "__init__", make)


@mutant("a new incarnation begins with a full battery", has(Kill, disk=("torn", "lost")))
def energy_gauge_forgotten(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: DensityRobot, *arguments: Any) -> None:
            init(self, *arguments)
            self._energy_spent = 0

        return made

    wrap(patch, DensityRobot, "__init__", make)


@mutant("world-sim counts a point twice now and then", density)
def world_counts_energy_twice(patch: Patch) -> None:
    def make(spend: Any) -> Any:
        def spent(self: World, body: Any, packed: bytes) -> list[str]:
            refused: list[str] = spend(self, body, packed)
            body.energy_spent += body.energy_spent % 10 == 5
            return refused

        return spent

    wrap(patch, World, "_spend", make)


@mutant("robots drive 1 % too fast, and world-sim accepts it")
def speed_limit_one_percent_too_high(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: World, scenario: Scenario, *arguments: Any) -> None:
            init(self, scenario, *arguments)
            self._speed_m_s *= 1.01

        return made

    def faster(explore: Any) -> Any:
        return lambda self, dt_s: explore(self, 1.01 * dt_s)

    wrap(patch, World, "__init__", make)
    wrap(patch, DensityRobot, "_explore", faster)


@mutant("a new incarnation drives for the time since the start", has(Kill, disk=("torn", "lost")))
def a_new_incarnation_leaps(patch: Patch) -> None:
    def make(init: Any) -> Any:
        def made(self: DensityRobot, *arguments: Any) -> None:
            init(self, *arguments)
            if self._step:
                timer = self._timer
                timer._last_ns, timer._period_ns = 0, 10 * timer._period_ns

        return made

    wrap(patch, DensityRobot, "__init__", make)


@mutant("a weight rises now and then", density)
def weight_that_rises(patch: Patch) -> None:
    def make(learn: Any) -> Any:
        def learnt(self: Replica, *arguments: Any) -> bool:
            taken: bool = learn(self, *arguments)
            index = int(np.argmin(self.weights)) if self.weights.size else 0
            if self.store.counters[1] % 50 == 0 and self.weights.size:
                set_weight(self.store, index, int(self.weights[index]) + 1)
            return taken

        return learnt

    wrap(patch, Replica, "merge", make)


@mutant("what is published misses an entry now and then", density)
def published_vector_differs(patch: Patch) -> None:
    due = now_and_then(20)

    def make(step: Any) -> Any:
        def stepped(self: WeightsPublisher, lowered: np.ndarray, *, last: bool) -> bytes:
            packed: bytes = step(self, lowered[1:] if due() else lowered, last=last)
            return packed

        return stepped

    wrap(patch, WeightsPublisher, "step", make)


@mutant("a robot keeps to a goal that has no weight left", lambda s: s.planner.name == "transport")
def goal_without_weight(patch: Patch) -> None:
    def make(explore: Any) -> Any:
        def explored(self: DensityRobot, dt_s: float) -> bytes:
            before = self._goal
            packed: bytes = explore(self, dt_s)
            self._goal = before or self._goal
            return packed

        return explored

    wrap(patch, DensityRobot, "_explore", make)


@mutant("a register is not the sum over its places", spectral)
def register_off_by_one(patch: Patch) -> None:
    def make(compose: Any) -> Any:
        def composed(self: Registers, target: int = -1) -> bytes:
            self.values[self.me, 1:2] += 1
            content: bytes = compose(self, target)
            return content

        return composed

    wrap(patch, Registers, "compose", make)
