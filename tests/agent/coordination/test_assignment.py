"""Assignment: which robots get a target, when, and on what knowledge; the same in supervisor and robot."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.coordination import assignment
from kantor_agent.coordination.assignment import (
    Assignment,
    ContactLimits,
    assigned_target,
    read_member,
    robot_register,
    supervisor_register,
    visible_team,
)
from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.mapping.fused_map import FusedMap
from kantor_agent.planners.map_base import Situation, Task, TeamMember
from kantor_protocol.base.grid import NOWHERE, Frame
from kantor_protocol.replication.occupancy_log import entries
from kantor_protocol.replication.registers import Registers
from kantor_protocol.replication.replica import Replica
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from support.strategies import examples

FRAME = Frame(1.0, (0.0, 0.0), 5, 9)
MISSION = """
name = "rooms"
robots = { count = 3 }
starts = { random = true }
map = { layout = "blank" }
sensor = { range_m = 3.0 }
planner = { name = "frontier", cost = "length" }
"""


def mission(*overrides: str) -> Scenario:
    """Three robots on a map, with overrides."""
    return parse(MISSION, "rooms", overrides)


class Asked:
    """A planner that notes the situations, and sends all members to the first frontier."""

    negotiates = False

    def __init__(self, *_: object) -> None:
        self.situations: list[Situation] = []

    def assign(self, situation: Situation) -> list[Task]:
        """Notes it."""
        self.situations.append(situation)
        return [Task(int(situation.frontiers[0])) for _ in situation.members]


class World:
    """A fused map whose frontiers a test chooses, and an assignment over it."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, *overrides: str, me: int | None = None
    ) -> None:
        self.asked = Asked()
        monkeypatch.setitem(assignment.ALLOCATORS, "frontier", lambda *_: self.asked)
        scenario = mission(*overrides)
        self.fused_map = FusedMap(FRAME, 3)
        self.log = Replica(0, 3, entries(FRAME), None, ledger=True, claims=False)
        self.assignment = Assignment(scenario, CostMap(scenario, self.fused_map), 0, me)

    def see(self, *cells: int) -> None:
        """Cells are free."""
        self.log.append(np.array([2 * cell for cell in cells]))
        self.fused_map.fold(self.log)

    def decide(self, *group: TeamMember, tick: int = 10) -> dict[int, Task]:
        """New tasks."""
        return self.assignment.decide(group, (), tick)


def robot(
    place: int, target: int = NOWHERE, since: int = 0, *, arrived: bool = False
) -> TeamMember:
    """A member that stands in the middle."""
    return TeamMember(place, 22, Task(target), since, arrived)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    """Three frontiers in a row."""
    made = World(monkeypatch)
    made.see(21, 22, 23)
    return made


def test_the_planner_is_not_asked_while_all_robots_are_on_the_way(world: World) -> None:
    """A target that still is a frontier is kept."""
    assert world.decide(robot(0, 21), robot(1, 23)) == {}
    assert world.asked.situations == []


@pytest.mark.parametrize("event", ["arrival", "no frontier any more", "idle"])
def test_an_event_at_one_gives_all_new_targets(world: World, event: str) -> None:
    """The whole team, by place."""
    eventful = {
        "arrival": robot(1, 23, arrived=True),
        "no frontier any more": robot(1, 20),
        "idle": robot(1),
    }[event]

    assert set(world.decide(robot(0, 21), eventful)) == {0, 1}


def test_a_gap_lies_between_two_assignments(world: World) -> None:
    """Of planner.replan_gap ticks since any robot of the team got its task."""
    assert world.decide(robot(0, 21, since=8), robot(1), tick=10) == {}
    assert set(world.decide(robot(0, 21, since=8), robot(1), tick=11)) == {0, 1}


def test_a_robot_may_get_a_target_without_the_rest_of_the_team(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """replan_whose = own: the rest of the team is given to the planner as others."""
    world = World(monkeypatch, "planner.replan_whose=own")
    world.see(21, 22, 23)

    assert set(world.decide(robot(0, 21), robot(1, 23, arrived=True))) == {1}
    assert [m.robot for m in world.asked.situations[0].others] == [0]


def test_arrivals_alone_count_if_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """replan_on = arrivals: a target that was seen from afar is driven to all the same."""
    world = World(monkeypatch, "planner.replan_on=arrivals")
    world.see(21, 22, 23)

    assert world.decide(robot(0, 20)) == {}
    assert set(world.decide(robot(0, 21, arrived=True))) == {0}


def test_a_robot_back_in_contact_gets_a_target_though_the_map_is_the_same(world: World) -> None:
    """Its old one was forgotten meanwhile; it may have none to explore by, and would wait for ever."""
    assert set(world.decide(robot(0), robot(1), tick=10)) == {0, 1}
    assert world.decide(robot(0), robot(1), tick=20) == {}, "asked in vain is asked once"

    assert world.decide(robot(0, 21), tick=30) == {}
    assert set(world.decide(robot(0, 21), robot(1), tick=40)) == {0, 1}


def test_no_robot_is_sent_where_one_has_looked_around(world: World) -> None:
    """It would be the nearest frontier of the robot that stands on it, for ever."""
    world.decide(robot(0, 21, arrived=True))

    assert world.asked.situations[0].frontiers.tolist() == [22, 23]


def test_an_idle_robot_asks_again_only_when_the_map_has_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """There is nothing new to decide on the same map."""
    world = World(monkeypatch)
    world.see(21, 22)
    world.decide(robot(0))
    assert world.decide(robot(0), tick=20) == {}
    world.see(23)
    assert set(world.decide(robot(0), tick=30)) == {0}


def test_a_negotiating_robot_is_asked_in_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """For itself alone; the robots in contact are the others."""
    world = World(monkeypatch, me=1)
    world.asked.negotiates = True
    world.see(21, 22)

    assert set(world.decide(robot(0, 21), robot(1, 22))) == {1}
    assert [m.robot for m in world.asked.situations[0].others] == [0]


# Registers.


@given(
    cell=st.integers(0, FRAME.cells - 1),
    target=st.integers(NOWHERE, FRAME.cells - 1),
    since=st.integers(0, 100),
    arrived=st.booleans(),
    memo=st.lists(st.integers(-(2**51), 2**51), max_size=8),
)
def test_a_register_holds_the_whole_member(
    cell: int, target: int, since: int, memo: list[int], *, arrived: bool
) -> None:
    """Register and back; a memo loses zeros at its end."""
    while memo and memo[-1] == 0:
        memo.pop()
    me = TeamMember(1, cell, Task(target, tuple(memo)), since, arrived)
    register = np.zeros(20, dtype=np.int64)
    numbers = robot_register(me, resting=False)
    register[: len(numbers)] = numbers

    assert read_member(1, register, FRAME.cells, 100) == me
    register[1] += 2
    assert read_member(1, register, FRAME.cells, 100) is None


@examples(200)
@given(numbers=st.lists(st.integers(-(2**52), 2**52), min_size=12, max_size=12))
def test_any_register_names_cells_of_the_map(numbers: Sequence[int]) -> None:
    """Hostile numbers give no member, or one within the map and not in the future."""
    register = np.array(numbers, dtype=np.int64)
    member = read_member(0, register, FRAME.cells, 7)

    assert NOWHERE <= assigned_target(register, 2, FRAME.cells) < FRAME.cells
    if member is not None:
        assert 0 <= member.cell < FRAME.cells
        assert NOWHERE <= member.task.target < FRAME.cells
        assert member.since <= 7


def test_the_supervisors_register_has_a_target_for_every_robot() -> None:
    """NOWHERE for a robot without a task."""
    numbers = supervisor_register({0: Task(4), 2: Task(0)}, 3, 9)
    register = np.zeros(20, dtype=np.int64)
    register[: len(numbers)] = numbers

    assert [assigned_target(register, i, FRAME.cells) for i in range(3)] == [4, NOWHERE, 0]


def test_a_silent_robot_leaves_the_team_and_later_its_target_is_free() -> None:
    """First its target counts as taken, then it is free again."""
    held = Registers(0, 2, 12, sums=False)
    other = Registers(1, 2, 12, sums=False, beacon=True)
    held.write(robot_register(robot(0, 3), resting=False))
    other.write(robot_register(robot(1, 5), resting=False))
    held.merge(1, other.compose(), 2)
    limits = ContactLimits(contact_timeout_steps=2, remember_steps=5)
    seen = []
    for _ in range(8):
        group, absent = visible_team(held, 2, FRAME, 0, limits)
        seen.append(([m.robot for m in group], absent))
        held.end_step()

    assert seen == [([0, 1], [])] * 3 + [([0], [5])] * 3 + [([0], [])] * 2


def test_contact_limits_are_counted_in_own_steps() -> None:
    """A supervisor that steps twice a period waits twice as many steps."""
    scenario = mission("planner.remember_s=3", "clock.period_s=0.5")

    assert ContactLimits.of(scenario, scenario.period_ns) == (8, 6)
    assert ContactLimits.of(scenario, scenario.period_ns // 2) == (16, 12)
