"""Bugs of robots on maps: what they say of walls and frontiers."""

from typing import Any

import numpy as np

from campaign.planting import Patch, mutant, now_and_then, wrap
from kantor_agent.mapping.pursuit import Pursuit
from kantor_agent.robots import mapping
from kantor_agent.robots.mapping import MappingRobot
from kantor_protocol.base.grid import FREE, NOWHERE
from kantor_protocol.replication.occupancy_log import dead_frontier, retried_frontier
from kantor_protocol.scenario.schema import Scenario


def on_map(scenario: Scenario) -> bool:
    """Missions on a map."""
    return scenario.mapping


def noisy(scenario: Scenario) -> bool:
    """Missions in which robots run into walls."""
    return scenario.mapping and scenario.sensor.noise_m > 0.0


@mutant("a robot tells of a wall where it stands, not where it met one", noisy)
def bump_in_the_wrong_cell(patch: Patch) -> None:
    def make(_met: Any) -> Any:
        return lambda frame, _start, _end, stop: frame.cell_of(stop.x_m, stop.y_m)

    wrap(patch, mapping, "wall_met", make)


@mutant("a robot gives every target up at once", on_map)
def no_patience_at_all(patch: Patch) -> None:
    patch.setattr(Pursuit, "is_vain", property(lambda _: True))


@mutant("a robot tries frontiers again that nobody has given up", on_map)
def retry_without_a_reason(patch: Patch) -> None:
    due = now_and_then(20)

    def make(decide: Any) -> Any:
        def decided(self: MappingRobot) -> None:
            decide(self)
            if due() and self._fused_map.frontiers.size:
                cell = int(self._fused_map.frontiers[0])
                self._replica.append(np.array([retried_frontier(self._frame, cell)]))

        return decided

    wrap(patch, MappingRobot, "_decide", make)


@mutant("a robot declares a target dead before it has got there", on_map)
def dead_from_afar(patch: Patch) -> None:
    def make(give_up: Any) -> Any:
        def given_up(self: MappingRobot) -> None:
            target = self._task.target
            give_up(self)
            if target != NOWHERE and not self._fused_map.dead_frontiers[target]:
                self._replica.append(np.array([dead_frontier(self._frame, target)]))

        return given_up

    wrap(patch, MappingRobot, "_give_up", make)


@mutant("a robot rests though there is a frontier that it can reach", on_map)
def rest_too_early(patch: Patch) -> None:
    def make(may_go_on: Any) -> Any:
        return lambda self: may_go_on(self) and self._step < 40

    wrap(patch, MappingRobot, "_may_go_on", make)


@mutant("a robot takes an unknown cell for free now and then", on_map)
def invents_free_cells(patch: Patch) -> None:
    due = now_and_then(15)

    def make(look: Any) -> Any:
        def looked(self: MappingRobot, observation: Any) -> None:
            look(self, observation)
            if due():
                cell = int(np.argmin(self._fused_map.cells))
                self._replica.append(np.array([2 * cell + FREE - 1]))

        return looked

    wrap(patch, MappingRobot, "_look", make)
