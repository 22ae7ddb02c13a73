"""Bugs in the radio: range, walls, link faults, and the messages under way."""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from campaign.planting import (
    Patch,
    density,
    has,
    mutant,
    now_and_then,
    replace_kernel,
    spatial,
    strikes,
    walled,
    wrap,
)
from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.grid import FREE, next_cell
from kantor_protocol.base.machine import WORLD_SIM
from kantor_protocol.scenario.faults.links import OneWay, Partition, Range
from kantor_protocol.scenario.faults.processes import Kill
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.radio import channel, link_faults
from kantor_worldsim.radio import fault_kernels as rules
from kantor_worldsim.radio.channel import Channel
from kantor_worldsim.radio.fault_kernels import FaultTable
from kantor_worldsim.world import sensors


def _cutting(scenario: Scenario) -> bool:
    return any(isinstance(fault, OneWay | Partition | Range) for fault in scenario.faults)


def _flapping(scenario: Scenario) -> bool:
    return any(isinstance(f, Partition) and f.flap_s is not None for f in scenario.faults)


def _has_named_range(scenario: Scenario) -> bool:
    return any(isinstance(f, Range) and f.robots for f in scenario.faults)


def _has_factor(scenario: Scenario) -> bool:
    return any(isinstance(f, Range) and f.factor is not None for f in scenario.faults)


def _changed(scenario: Scenario, **tables: dict[str, Any]) -> Scenario:
    """A scenario with other values in some of its tables."""
    changed = {
        name: msgspec.structs.replace(getattr(scenario, name), **values)
        for name, values in tables.items()
    }
    return msgspec.structs.replace(scenario, **changed)


def _with_radio(patch: Patch, change: Callable[[Scenario], Scenario]) -> None:
    """The radio reads another scenario."""

    def make(init: Any) -> Any:
        def made(self: Channel, scenario: Scenario, *arguments: Any, **named: Any) -> None:
            init(self, change(scenario), *arguments, **named)

        return made

    wrap(patch, Channel, "__init__", make)


def _with_table(patch: Patch, change: Callable[[FaultTable], None]) -> None:
    """The radio reads another table of link faults."""

    def make(table_of: Any) -> Any:
        def made(scenario: Scenario, seed: int) -> FaultTable:
            table: FaultTable = table_of(scenario, seed)
            change(table)
            return table

        return made

    wrap(patch, link_faults, "table_of", make)


@mutant("the radio reaches 5 % further", spatial)
def range_plus_five_percent(patch: Patch) -> None:
    _with_radio(patch, lambda s: _changed(s, radio={"range_m": 1.05 * s.radio.range_m}))


@mutant(
    "the supervisor is heard however far away",
    lambda s: s.supervisor.range_m < 1e9 and s.centralized,
)
def supervisors_range_ignored(patch: Patch) -> None:
    _with_radio(patch, lambda s: _changed(s, supervisor={"range_m": 1e12}))


@mutant("a partition stops one direction only", has(Partition))
def partition_leaks_one_way(patch: Patch) -> None:
    def changed(table: FaultTable) -> None:
        places = np.arange(table.severed.shape[1])
        table.severed[:, places[:, None] > places[None, :]] = 0

    _with_table(patch, changed)


@mutant("now and then a robot gets a message to another")
def delivery_to_the_wrong_robot(patch: Patch) -> None:
    due = now_and_then(50)

    def make(collect: Any) -> Any:
        def collected(self: Channel, name: str, now_ns: int) -> Any:
            others = [other for other in self._roster if other != name]
            return collect(self, others[0] if others and due() else name, now_ns)

        return collected

    wrap(patch, Channel, "collect", make)


@mutant(
    "messages are heard up to a period before they arrive",
    lambda s: s.radio.delay_s + s.radio.jitter_s > 0.0,
)
def heard_before_it_is_due(patch: Patch) -> None:
    def make(collect: Any) -> Any:
        return lambda self, name, now_ns: collect(self, name, now_ns + 200_000_000)

    wrap(patch, Channel, "collect", make)


@mutant("one delivery in a hundred vanishes on the way")
def a_delivery_vanishes(patch: Patch) -> None:
    due = now_and_then(100)

    def make(collect: Any) -> Any:
        def collected(self: Channel, name: str, now_ns: int) -> Any:
            envelopes = collect(self, name, now_ns)
            return envelopes[:-1] if envelopes and due() else envelopes

        return collected

    wrap(patch, Channel, "collect", make)


@mutant("one delivery in a hundred comes twice, which no fault causes")
def a_delivery_comes_twice(patch: Patch) -> None:
    due = now_and_then(100)

    def make(collect: Any) -> Any:
        def collected(self: Channel, name: str, now_ns: int) -> Any:
            envelopes = collect(self, name, now_ns)
            return (*envelopes, envelopes[-1]) if envelopes and due() else envelopes

        return collected

    wrap(patch, Channel, "collect", make)


@mutant("a process that is started finds what arrived while it was dead", has(Kill))
def letters_to_the_dead_arrive(patch: Patch) -> None:
    patch.setattr(Channel, "lose", lambda *_: None)


@mutant("world-sim forgets what was under way when it starts again", strikes(Kill, WORLD_SIM))
def world_sim_forgets_what_was_under_way(patch: Patch) -> None:
    def make(rebuilt: Any) -> Any:
        def forgetful(self: Simulation) -> Simulation:
            simulation: Simulation = rebuilt(self)
            simulation.channel.clear()
            return simulation

        return forgetful

    wrap(patch, Simulation, "rebuilt", make)


# The table of link faults and what the radio reads from it.


@mutant("a link fault ends a tenth of its window too early", _cutting)
def link_fault_ends_early(patch: Patch) -> None:
    def changed(table: FaultTable) -> None:
        from_ns, until_ns = table.rules["from_ns"], table.rules["until_ns"]
        lasting = until_ns < rules.DUE_MAX_NS
        until_ns[lasting] -= (until_ns[lasting] - from_ns[lasting]) // 10

    _with_table(patch, changed)


@mutant("a fault that names robots is about the one after each", _has_named_range)
def robots_of_a_fault_are_off_by_one(patch: Patch) -> None:
    def changed(table: FaultTable) -> None:
        table.named[:] = np.roll(table.named, 1, axis=1)

    _with_table(patch, changed)


def _cut_backwards(table: FaultTable, rule: int, now_ns: int, source: int, target: int) -> bool:
    row = table.rules[rule]
    if table.severed[row.at, target, source] == 0:
        return False
    if row.span_ns == 0:
        return True
    index, slot = row.fault << rules.FAULT_SHIFT, now_ns // row.span_ns
    draw = uniform(table.seed, Purpose.FAULT_FLAP.value, 0, slot, index)
    return draw < table.numbers[rule, rules._SHARE]


@mutant("a cut is looked up from receiver to sender", has(OneWay))
def cut_backwards(patch: Patch) -> None:
    replace_kernel(patch, rules, "_cuts", _cut_backwards)


def _cut_late(table: FaultTable, rule: int, now_ns: int, source: int, target: int) -> bool:
    row = table.rules[rule]
    if table.severed[row.at, source, target] == 0:
        return False
    if row.span_ns == 0:
        return True
    index, slot = row.fault << rules.FAULT_SHIFT, now_ns // row.span_ns
    draw = uniform(table.seed, Purpose.FAULT_FLAP.value, 0, slot + 1, index)
    return draw < table.numbers[rule, rules._SHARE]


@mutant("a flapping cut is there a slot too early", _flapping)
def flapping_cut_a_slot_early(patch: Patch) -> None:
    replace_kernel(patch, rules, "_cuts", _cut_late)


def _reach_half_shortened_m(table: FaultTable, rule: int, whole_m: float) -> float:
    range_m = table.numbers[rule, rules._RANGE_M]
    if range_m >= 0.0:
        return min(whole_m, range_m)
    return whole_m * 0.5 * (1.0 + table.numbers[rule, rules._FACTOR])


@mutant("a factor shortens the range by half of what it should", _has_factor)
def range_half_shortened(patch: Patch) -> None:
    replace_kernel(patch, rules, "_reach_m", _reach_half_shortened_m)


@mutant("in a ring a robot hears two on each side", has(Partition, shape=("ring",)))
def ring_of_two_on_each_side(patch: Patch) -> None:
    def make(severs: Any) -> Any:
        def severing(self: Partition, roster: tuple[str, ...]) -> Any:
            if self.shape != "ring":
                return severs(self, roster)
            place = {name: i for i, name in enumerate(roster)}
            return lambda one, other: 2 < abs(place[one] - place[other]) < len(roster) - 2

        return severing

    wrap(patch, Partition, "severs", make)


@mutant("a one-way fault cuts the other way", has(OneWay))
def one_way_the_other_way(patch: Patch) -> None:
    def make(severs: Any) -> Any:
        def severing(self: OneWay, roster: tuple[str, ...]) -> Any:
            forward = severs(self, roster)
            return lambda sender, receiver: forward(receiver, sender)

        return severing

    wrap(patch, OneWay, "severs", make)


# Who hears an envelope.


def _hears_by_the_longer_axis(
    field: channel.LinkGeometry, one: int, other: int, range_m: float
) -> bool:
    dx = abs(field.xy_m[other, 0] - field.xy_m[one, 0])
    dy = abs(field.xy_m[other, 1] - field.xy_m[one, 1])
    return max(dx, dy) <= range_m


@mutant("a distance is that along the longer axis", lambda s: density(s) and spatial(s))
def distance_along_the_longer_axis(patch: Patch) -> None:
    replace_kernel(patch, channel, "hears", _hears_by_the_longer_axis)


def _is_in_range_through_walls(
    left_m: float,
    bottom_m: float,
    resolution_m: float,
    line_of_sight: bool,  # noqa: FBT001  as in the radio
    loss_m: float,
    cells: np.ndarray,
    xy_m: np.ndarray,
    one: int,
    other: int,
    range_m: float,
    through: bool,  # noqa: FBT001
) -> bool:
    dx = xy_m[other, 0] - xy_m[one, 0]
    dy = xy_m[other, 1] - xy_m[one, 1]
    return dx * dx + dy * dy <= range_m * range_m


@mutant("walls do not block the radio", walled)
def radio_through_walls(patch: Patch) -> None:
    replace_kernel(patch, channel, "_in_range", _is_in_range_through_walls)


def _count_walls_but_the_first(
    cells: np.ndarray, u: float, v: float, to_u: float, to_v: float
) -> int:
    rows, columns = cells.shape
    if not (0.0 <= u < columns and 0.0 <= v < rows):
        return 1
    column, row, walls, inside_wall = int(u), int(v), -1, False
    while 0 <= row < rows and 0 <= column < columns:
        wall = cells[row, column] != FREE
        walls += wall and not inside_wall
        inside_wall = wall
        row, column, share = next_cell(row, column, u, v, to_u - u, to_v - v)
        if share >= 1.0:
            break
    return max(0, walls)


@mutant("the first wall on a line of sight is not counted", walled)
def first_wall_not_counted(patch: Patch) -> None:
    replace_kernel(patch, sensors, "walls_between", _count_walls_but_the_first)
