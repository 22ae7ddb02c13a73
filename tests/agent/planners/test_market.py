"""A market of goals: how goals are proposed, what they cost, which robot gets them, and that none is ever lost."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners.map_base import Situation, Task, TeamMember
from kantor_agent.planners.market.costs import NO_ROBOT, Costs, price_of, separate
from kantor_agent.planners.market.goals import (
    clear_disc,
    greedy_goals,
    quadtree_goals,
    random_goals,
)
from kantor_agent.planners.market.memo import Memo, packed, unpacked
from kantor_agent.planners.market.planner import Market
from kantor_agent.planners.market.rules import MarketRules
from kantor_agent.planners.market.trader import Holding
from kantor_fleet.execution.in_process_team import play
from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.grid import FREE, NOWHERE, OCCUPIED, UNKNOWN
from kantor_protocol.replication.registers import NUMBER_MAX
from kantor_protocol.scenario.load import parse
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.record.records import Batch, Record
from kantor_worldsim.world.world import WorldSetup
from support.floors import Floor
from support.strategies import examples

MISSION = """
name = "market"
robots = { count = 3 }
starts = { random = true }
map = { layout = "blank" }
clock = { period_s = 1.0 }
sensor = { range_m = 4.0 }
planner = { name = "market", cost = "length" }
"""
KINDS = {"?": UNKNOWN, ".": FREE, "#": OCCUPIED}


def mission(*overrides: str) -> Scenario:
    """Three robots that see 4 cells far; a step takes a second, a lease five."""
    return parse(MISSION, "market", overrides)


def floor_of(*rows: str, range_m: float = 4.0) -> Floor:
    """A map as it is drawn, row 0 first: `?` unknown, `.` free, `#` wall."""
    kinds = np.array([[KINDS[kind] for kind in row] for row in rows], dtype=np.uint8)
    return Floor(kinds, f"sensor.range_m={range_m}")


def cost_map_of(*rows: str, range_m: float = 4.0) -> CostMap:
    """The cost map of a floor."""
    return floor_of(*rows, range_m=range_m).cost_map


CORRIDOR = "????............????"
"""Goals lie at 2 and 17."""


IDLE = Task()


def member(robot: int, cell: int, task: Task = IDLE) -> TeamMember:
    """A robot under way."""
    return TeamMember(robot, cell, task, 0, arrived=False)


def situation(
    cost_map: CostMap,
    members: Sequence[TeamMember],
    others: Sequence[TeamMember] = (),
    tick: int = 10,
) -> Situation:
    """What is known."""
    return Situation(
        cost_map, cost_map.fused_map.frontiers, tuple(members), tuple(others), (), tick
    )


# Goals.


def test_quadtree_splits_until_leaves_are_two_ranges_long() -> None:
    """8 x 8 cells, range 1: sixteen leaves of 2 x 2, and a goal in the middle of each."""
    cost_map = cost_map_of(*["?" * 8] * 8, range_m=1.0)

    assert quadtree_goals(cost_map) == [
        8 * row + column for row in (1, 3, 5, 7) for column in (1, 3, 5, 7)
    ]


def test_quadtree_leaf_of_two_ranges_is_not_split() -> None:
    """8 x 8 cells, range 4: the whole map is one leaf."""
    assert quadtree_goals(cost_map_of(*["?" * 8] * 8)) == [8 * 4 + 4]


def test_quadtree_passes_over_what_is_known_to_three_quarters() -> None:
    """Range 1, leaves of 2 x 2: one of four cells is too little, and so are 4 of 16."""
    assert quadtree_goals(cost_map_of("....", ".???", "??..", "??..", range_m=1.0)) == [7, 13]
    assert quadtree_goals(cost_map_of("....", ".?.?", "?...", "?...", range_m=1.0)) == []


def test_quadtree_centre_that_is_known_is_no_goal() -> None:
    """A goal is given up when its cell is known, so that this one would not live."""
    assert quadtree_goals(cost_map_of("??", "?.", range_m=1.0)) == []


def test_quadtree_ends_when_ranges_are_tiny() -> None:
    """With a range below half a cell every unknown cell is a goal."""
    assert quadtree_goals(cost_map_of("?.?", range_m=0.01)) == [0, 2]


def test_greedy_takes_the_cheapest_a_range_apart() -> None:
    """From cell 2, range 4: cell 3 costs 1, then 7 and 11 are the next at least 4 away."""
    cost_map = cost_map_of("...????????????")
    field = cost_map.optimistic(2)

    assert greedy_goals(cost_map, field, [], 5) == [3, 7, 11]
    assert greedy_goals(cost_map, field, [], 2) == [3, 7]


def test_greedy_leaves_out_what_is_within_half_a_range_of_a_held_goal() -> None:
    """Goal 4 is held: 3 and up to 6 are as good as taken; 7 is not."""
    cost_map = cost_map_of("...????????????")

    assert greedy_goals(cost_map, cost_map.optimistic(2), [4], 5) == [7, 11]


def test_greedy_of_equals_takes_the_lowest_cell() -> None:
    """Both sides of the robot are as near."""
    cost_map = cost_map_of("??.??")

    assert greedy_goals(cost_map, cost_map.optimistic(2), [], 1) == [1]


def test_greedy_does_not_propose_what_walls_enclose() -> None:
    """Behind the wall everything is unknown, and stays so."""
    cost_map = cost_map_of("..#???")

    assert greedy_goals(cost_map, cost_map.optimistic(0), [], 5) == []


def test_random_goals_are_keyed_draws_without_known_cells() -> None:
    """Cells anywhere, by seed, robot and tick; the known and repeated ones are left out."""
    cost_map = cost_map_of("????????........")
    drawn = [int(uniform(3, Purpose.MARKET, 1, 20, i) * 16) for i in range(64)]
    left = [cell for cell in dict.fromkeys(drawn) if cell < 8]

    assert random_goals(cost_map, 3, 1, 20, 64) == left
    assert random_goals(cost_map, 3, 1, 21, 64) != left


@pytest.mark.parametrize("rule", ["random", "greedy", "quadtree"])
@given(seed=st.integers(0, 99))
@examples(20)
def test_proposed_goals_are_unknown_reachable_apart_and_not_too_many(rule: str, seed: int) -> None:
    """Every rule: at most goal_count, none within half a range of another or of a held goal."""
    rng = np.random.default_rng(seed)
    rows = ["".join(rng.choice(list("??.#"), 20)) for _ in range(20)]
    cost_map = cost_map_of(*rows)
    here = int(np.flatnonzero(cost_map.fused_map.cells == FREE)[0])
    held = [int(cell) for cell in np.flatnonzero(cost_map.fused_map.cells == UNKNOWN)[::50]]
    field = cost_map.optimistic(here)
    rules = MarketRules(mission(f"planner.goals={rule}"), seed)

    goals = rules.propose(cost_map, field, 0, 7, held)

    assert len(goals) <= 5
    assert [field[goal] for goal in goals] == sorted(field[goal] for goal in goals)
    for goal in goals:
        assert cost_map.fused_map.cells[goal] == UNKNOWN
        assert field[goal] < math.inf
        assert all(cost_map.cells_between(goal, h) > 2.0 for h in {*held, *goals} - {goal})


@given(st.integers(0, 99), st.floats(0.1, 30.0), st.integers(1, 10))
@examples(50)
def test_cleared_disc_is_the_cells_nearer_than_its_radius(
    cell: int, radius_cells: float, columns: int
) -> None:
    """The kernel against plain distances."""
    cell %= 10 * columns
    values = np.zeros(10 * columns)
    clear_disc(values, columns, cell, radius_cells)

    for other in range(10 * columns):
        rows, across = other // columns - cell // columns, other % columns - cell % columns
        inside = math.hypot(rows, across) < radius_cells or other == cell
        assert (values[other] == math.inf) == inside


# Costs.

PLACES = st.lists(st.integers(0, 399), min_size=1, max_size=7, unique=True)


def scattered_walls(seed: int) -> CostMap:
    """20 x 20 cells, a quarter of them walls, half of them unknown."""
    rng = np.random.default_rng(seed)
    return cost_map_of(*["".join(rng.choice(list("??.#"), 20)) for _ in range(20)])


def length(costs: Costs, place: int, tour: Sequence[int]) -> float:
    """Of a tour."""
    before = [NOWHERE, *tour]
    return sum(costs.leg(place, one, other) for one, other in itertools.pairwise(before))


@given(st.integers(0, 30), PLACES, st.integers(0, 399))
@examples(60)
def test_insertion_is_the_cheapest_of_all_places(seed: int, tour: list[int], goal: int) -> None:
    """Against tours written out; among equals the first; no insertion shortens a tour."""
    cost_map = scattered_walls(seed)
    here = int(np.flatnonzero(cost_map.fused_map.cells == FREE)[0])
    field = cost_map.optimistic(here)
    tour = [cell for cell in tour if field[cell] < math.inf]
    costs = Costs(cost_map, [field], [*tour, goal])
    tours = [[*tour[:i], goal, *tour[i:]] for i in range(len(tour) + 1)]
    longer = [length(costs, 0, one) - length(costs, 0, tour) for one in tours]

    cost, slot = costs.insertion(0, tour, goal)

    if field[goal] == math.inf:
        assert (cost, slot) == (math.inf, len(tour))
    else:
        assert cost == pytest.approx(min(longer), abs=1e-9)
        assert longer[slot] == pytest.approx(cost, abs=1e-9)
        assert cost >= -1e-9


@given(st.integers(0, 30), PLACES, st.data())
@examples(40)
def test_saving_is_what_the_tour_gets_shorter(
    seed: int, tour: list[int], data: st.DataObject
) -> None:
    """Against tours written out."""
    cost_map = scattered_walls(seed)
    field = cost_map.optimistic(int(np.flatnonzero(cost_map.fused_map.cells == FREE)[0]))
    tour = [cell for cell in tour if field[cell] < math.inf]
    if not tour:
        return
    goal = data.draw(st.sampled_from(tour))
    costs = Costs(cost_map, [field], tour)
    rest = [cell for cell in tour if cell != goal]

    saved = length(costs, 0, tour) - length(costs, 0, rest)

    assert costs.saving(0, tour, goal) == pytest.approx(saved, abs=1e-9)


def test_saving_of_an_unreachable_goal_is_infinite() -> None:
    """A robot that gets there may have it."""
    cost_map = cost_map_of("..#???..")
    costs = Costs(cost_map, [cost_map.optimistic(0)], [4, 5])

    assert costs.saving(0, [4, 5], 4) == math.inf


@given(st.integers(0, 30), PLACES, st.integers(1, 3))
@examples(40)
def test_distances_between_goals_are_a_metric_and_no_way_is_shorter(
    seed: int, goals: list[int], places: int
) -> None:
    """The kernel against a plain reference; the triangle inequality; a bound on the true ways."""
    cost_map = scattered_walls(seed)
    free = np.flatnonzero(cost_map.fused_map.cells == FREE)[:places].tolist()
    fields = [cost_map.optimistic(cell) for cell in free]
    cells = np.array(goals, dtype=np.int64)
    between = np.zeros((cells.size, cells.size))
    separate(np.array([field[cells] for field in fields]), cells, 20, between)

    for (i, a), (j, b) in itertools.product(enumerate(goals), repeat=2):
        reached = [(f[a], f[b]) for f in fields if min(f[a], f[b]) < math.inf]
        plain = max([cost_map.cells_between(a, b), *(abs(p - q) for p, q in reached)])
        assert between[i, j] == plain
        if cost_map.fused_map.cells[a] != OCCUPIED:
            assert plain <= cost_map.optimistic(a)[b] + 1e-9
        for k in range(cells.size):
            assert between[i, j] <= between[i, k] + between[k, j] + 1e-9


# Headings.


def test_robot_drives_to_the_frontier_on_the_way_to_its_goal() -> None:
    """The nearest frontier is at the left end, the goal at the right."""
    cost_map = cost_map_of(CORRIDOR)
    rules = MarketRules(mission(), 0)
    asked = situation(cost_map, [member(0, 6)])

    assert rules.heading(asked, asked.members[0], 17) == 15
    assert rules.heading(asked, asked.members[0], NOWHERE) == 4


def test_way_to_a_goal_leads_round_what_is_known_to_be_a_wall() -> None:
    """As the crow flies the frontier at the wall is nearest to the goal, but it leads the long way."""
    cost_map = cost_map_of(
        "????????",
        "########",
        "........",
        "......##",
        "....##??",
        "....##??",
        "??....??",
    )
    rules = MarketRules(mission(), 0)
    asked = situation(cost_map, [member(0, 8 * 2)])

    assert rules.heading(asked, asked.members[0], 8 * 5 + 7) == 8 * 6 + 5


def test_without_a_way_to_any_frontier_there_is_no_target() -> None:
    """A goal changes nothing about it."""
    cost_map = cost_map_of("..#...??")
    rules = MarketRules(mission(), 0)
    asked = situation(cost_map, [member(0, 0)])

    assert rules.heading(asked, asked.members[0], 7) == NOWHERE
    assert rules.heading(asked, asked.members[0], NOWHERE) == NOWHERE


# The supervisor's market.


def exchange(*overrides: str, **tours: list[int]) -> Market:
    """A supervisor's market with tours, by `r0`, `r1`, …"""
    market = Market(mission(*overrides), 0, None)
    market.form.tours = {int(name[1:]): tour for name, tour in tours.items()}
    return market


def test_goals_go_to_the_robot_that_reaches_them_cheapest() -> None:
    """Robots at 5 and 14 hold the far ends. 17 costs r0 12, r1 bids 3 + 15 - 12 = 6; then 2 costs r1 15, r0 3."""
    market = exchange(r0=[17], r1=[2])

    tasks = market.assign(situation(cost_map_of(CORRIDOR), [member(0, 5), member(1, 14)]))

    assert market.form.tours == {0: [2], 1: [17]}
    assert [task.target for task in tasks] == [4, 15]
    assert not market.negotiates


def test_without_a_better_bid_the_seller_keeps_its_goal() -> None:
    """An equal bid is none: from 9 and 9 both ways are as long."""
    market = exchange(r0=[17], r1=[2])

    market.assign(situation(cost_map_of(CORRIDOR), [member(0, 9), member(1, 9)]))

    assert market.form.tours == {0: [17], 1: [2]}


def test_of_equal_bids_the_lowest_place_wins() -> None:
    """r0 is far; r1 and r2 stand side by side."""
    market = exchange(r0=[17], r1=[2], r2=[2])

    market.assign(situation(cost_map_of(CORRIDOR), [member(0, 5), member(1, 14), member(2, 14)]))

    assert 17 in market.form.tours[1]
    assert 17 not in market.form.tours[2]


def test_goals_are_auctioned_again_as_positions_change() -> None:
    """The robots have changed sides; so do the goals."""
    market = exchange(r0=[2], r1=[17])

    market.assign(situation(cost_map_of(CORRIDOR), [member(0, 14), member(1, 5)]))

    assert market.form.tours == {0: [17], 1: [2]}


def test_robots_together_divide_what_is_unknown() -> None:
    """Nobody proposes what another holds; together they hold every leaf once."""
    cost_map = cost_map_of(*["?" * 24] * 11, "?" * 10 + "...." + "?" * 10, *["?" * 24] * 12)
    market = Market(mission("planner.goal_count=8"), 0, None)

    market.assign(situation(cost_map, [member(i, 24 * 11 + 11) for i in range(3)]))

    tours = market.form.tours
    assert sorted(goal for tour in tours.values() for goal in tour) == quadtree_goals(cost_map)
    assert all(tours.values())


def test_goals_that_are_known_or_unreachable_are_given_up() -> None:
    """Cell 8 is known; 18 lies behind a wall."""
    market = exchange(r0=[2, 8, 18], r1=[])

    market.assign(situation(cost_map_of("????........#..????"), [member(0, 6), member(1, 7)]))

    assert market.form.tours[0] == [2]


def test_goals_of_a_robot_out_of_contact_are_free() -> None:
    """A robot that is left proposes its goals anew."""
    market = exchange(r0=[2], r1=[17])

    market.assign(situation(cost_map_of(CORRIDOR), [member(0, 5)]))

    assert market.form.tours == {0: [2]}


def test_robots_that_keep_their_targets_trade_as_well() -> None:
    """Only r0 is given a target, but all robots trade."""
    market = exchange(r0=[17], r1=[2])

    tasks = market.assign(situation(cost_map_of(CORRIDOR), [member(0, 5)], [member(1, 14)]))

    assert market.form.tours == {0: [2], 1: [17]}
    assert [task.target for task in tasks] == [4]


def test_idle_robot_drives_to_the_nearest_frontier() -> None:
    """What is unknown is too little for a goal; without this the mission would never end."""
    cost_map = cost_map_of("..................?.")
    [task] = Market(mission(), 0, None).assign(situation(cost_map, [member(0, 3)]))

    assert task == Task(17)


@given(st.integers(0, 30), st.lists(PLACES, min_size=3, max_size=3))
@examples(40)
def test_every_sale_shortens_the_tours(seed: int, tours: list[list[int]]) -> None:
    """A pass never makes the sum longer, and loses and doubles nothing."""
    cost_map = scattered_walls(seed)
    free = np.flatnonzero(cost_map.fused_map.cells == FREE)[:3].tolist()
    fields = [cost_map.optimistic(cell) for cell in free]
    reached = [cell for cell in range(400) if all(field[cell] < math.inf for field in fields)]
    taken: set[int] = set()
    market = exchange(r0=[], r1=[], r2=[])
    for robot, tour in enumerate(tours):
        goals = [cell for cell in tour if cell in reached and cell not in taken]
        market.form.tours[robot] = goals
        taken.update(goals)
    costs = Costs(cost_map, fields, taken)
    before = sum(length(costs, i, tour) for i, tour in market.form.tours.items())

    market.form.sell(costs, [0, 1, 2])

    after = sum(length(costs, i, tour) for i, tour in market.form.tours.items())
    assert after <= before + 1e-9
    assert sorted(g for tour in market.form.tours.values() for g in tour) == sorted(taken)


# Memos.

NUMBERS = st.integers(-NUMBER_MAX, NUMBER_MAX)


@given(st.lists(NUMBERS | st.integers(-2, 30), max_size=88))
@examples(200)
def test_any_register_is_some_memo(numbers: list[int]) -> None:
    """Whatever a robot says: cells are on the map, successors in the team, and it is announced as it was."""
    memo = unpacked(numbers, 3, 20)

    assert memo.clock >= 0
    assert -1 <= memo.offered < 20
    assert len(memo.acknowledged) == len(memo.bids) == 3
    assert all(0 <= goal < 20 and -1 <= successor < 3 for goal, successor in memo.tour)
    numbers = list(packed(memo))
    while numbers and numbers[-1] == 0:
        numbers.pop()
    assert unpacked(numbers, 3, 20) == memo


@pytest.mark.parametrize("robots", [1, 2, 8, 1000])
def test_longest_memo_fits_into_a_register(robots: int) -> None:
    """A full tour, the offers of all others answered, an offer of its own."""
    scenario = mission(f"robots.count={robots}")
    tour = tuple((cell, robots - 1) for cell in range(MarketRules(scenario, 0).capacity))
    memo = Memo(9, 7, 5, 3, (1,) * robots, (1,) * robots, tour)

    assert len(tour) >= 28
    assert len(packed(memo)) <= scenario.register_width - 4


def test_prices_are_bounded() -> None:
    """What cannot be reached costs a lot; parts of a cell count."""
    assert price_of(math.inf) < NUMBER_MAX
    assert price_of(2.5) == 40


@given(st.lists(st.lists(NUMBERS | st.integers(-2, 30), max_size=88), min_size=3, max_size=3))
@examples(50)
def test_robot_survives_any_announcement(announced: list[list[int]]) -> None:
    """It has a target, and its own memo fits."""
    cost_map, scenario = cost_map_of(CORRIDOR), mission()
    market, task = Market(scenario, 0, 1), Task()
    for tick, memo in enumerate(announced):
        others = [member(robot, 5, Task(4, tuple(memo))) for robot in (0, 2)]
        [task] = market.assign(situation(cost_map, [member(1, 7 + tick, task)], others, tick))

        assert task.target in (4, 15)
        assert len(task.memo) <= scenario.register_width - 4
        assert all(abs(number) <= NUMBER_MAX for number in task.memo)


# Robots among themselves.

Radio = Callable[[int, int, int], Sequence[int]]
"""Source, receiver and step to the delays, in steps, with which a memo arrives; none: it is lost."""


def perfect_radio(_source: int, _receiver: int, _step: int) -> Sequence[int]:
    """A radio without faults."""
    return (1,)


def no_radio(_source: int, _receiver: int, _step: int) -> Sequence[int]:
    """A radio that is off."""
    return ()


class Net:
    """Robots that receive one another's registers: late, twice or not at all; the newest counts."""

    def __init__(self, floor: Floor, cells: Sequence[int], *overrides: str) -> None:
        self.robots = len(cells)
        scenario = mission(f"robots.count={self.robots}", *overrides)
        self.floors = [floor] * self.robots
        self.markets = [Market(scenario, 0, robot) for robot in range(self.robots)]
        self.members = [member(robot, cell) for robot, cell in enumerate(cells)]
        self.received: list[dict[int, tuple[int, int, TeamMember]]] = [{} for _ in cells]
        self.under_way: list[tuple[int, int, int, TeamMember]] = []
        self.step = 0

    def play(self, steps: int, radio: Radio = perfect_radio) -> None:
        """Let every robot step; in between, memos are under way."""
        for _ in range(steps):
            self.step += 1
            self._deliver()
            self.members = [self._asked(robot) for robot in range(self.robots)]
            for source, receiver in itertools.permutations(range(self.robots), 2):
                for delay in radio(source, receiver, self.step):
                    due = self.step + delay
                    self.under_way.append((due, receiver, self.step, self.members[source]))

    def move(self, *cells: int) -> None:
        """Put the robots somewhere else."""
        self.members = [
            one._replace(cell=cell) for one, cell in zip(self.members, cells, strict=True)
        ]

    def _deliver(self) -> None:
        for due, receiver, stamp, sender in self.under_way:
            received = self.received[receiver]
            if due <= self.step and stamp > received.get(sender.robot, (0,))[0]:
                received[sender.robot] = (stamp, self.step, sender)
        self.under_way = [copy for copy in self.under_way if copy[0] > self.step]

    def _asked(self, robot: int) -> TeamMember:
        me = self.members[robot]
        others = [
            sender
            for _, (_, at, sender) in sorted(self.received[robot].items())
            if at + 8 >= self.step
        ]
        asked = situation(self.floors[robot].cost_map, [me], others, self.step)
        [task] = self.markets[robot].assign(asked)
        return me._replace(task=task)

    def give(self, robot: int, *goals: int) -> None:
        """Let a robot hold goals, and no others."""
        self.markets[robot].form.tour = [Holding(goal) for goal in goals]

    def memo(self, robot: int) -> Memo:
        """What a robot announces."""
        return unpacked(
            self.members[robot].task.memo, self.robots, self.floors[robot].fused_map.frame.cells
        )

    def tour(self, robot: int) -> list[int]:
        """The goals that a robot holds."""
        return [goal for goal, _successor in self.memo(robot).tour]

    def holders(self, goal: int) -> list[int]:
        """The robots that hold a goal."""
        return [robot for robot in range(self.robots) if goal in self.tour(robot)]

    def until(
        self, rule: Callable[[], bool], radio: Radio = perfect_radio, steps: int = 40
    ) -> None:
        """Play until a rule holds."""
        for _ in range(steps):
            if rule():
                return
            self.play(1, radio)
        raise AssertionError("it never came to that")


HALL = (
    "????............................????",
    *["#" * 23 + "." + "#" * 12] * 10,
    *["#" * 23 + "?" + "#" * 12] * 2,
)
"""A long hall and a branch: goals are W, E, and N at the end of the branch."""
W, E, N = 2, 33, 36 * 12 + 23


def hall() -> Net:
    """r0 in the west holds W and E; r1 in the branch holds N, and will buy E for half its price."""
    net = Net(floor_of(*HALL), [5, 36 * 8 + 23])
    net.give(0, W, E)
    net.give(1, N)
    return net


def sold(net: Net) -> bool:
    """Whether r0 has named r1 as the winner of E."""
    return (E, 1) in net.memo(0).tour


def only(source: int) -> Radio:
    """A radio that carries the memos of one robot."""
    return lambda one, _other, _step: (1,) if one == source else ()


def step_aside(net: Net) -> None:
    """Both robots move on by a cell, so that they offer their goals again."""
    net.play(4)
    net.move(*[one.cell ^ 1 if one.robot == 0 else one.cell - 36 for one in net.members])


def test_best_bid_takes_the_goal() -> None:
    """Offer, bid, award, confirmation: one memo each."""
    net = hall()
    net.play(2)
    assert net.memo(0).offered == W

    net.until(lambda: sold(net))
    assert net.holders(E) == [0]
    net.play(1)
    assert net.holders(E) == [0, 1]
    net.play(1)
    assert net.holders(E) == [1]
    assert (net.tour(0), net.tour(1)) == ([W], [N, E])


def test_without_a_better_bid_the_goal_stays() -> None:
    """r0 offers W, N is offered by r1; no robot gets them cheaper."""
    net = hall()
    net.play(20)

    assert net.holders(W) == [0]
    assert net.holders(N) == [1]
    assert [net.memo(robot).offered for robot in (0, 1)] == [NOWHERE, NOWHERE]


def test_robots_that_stand_still_stop_trading() -> None:
    """Nothing changes, so nothing is offered; memos differ in their clocks alone."""
    net = hall()
    net.play(20)
    before = [net.memo(robot) for robot in (0, 1)]
    net.play(10)

    for robot in (0, 1):
        memo = net.memo(robot)
        assert memo._replace(clock=0, acknowledged=()) == before[robot]._replace(
            clock=0, acknowledged=()
        )


def test_lost_award_leaves_the_goal_with_its_seller() -> None:
    """r1 never learns that it has won: the lease runs out, r0 takes E back, and sells it again."""
    net = hall()
    net.until(lambda: sold(net))
    net.under_way = []

    net.play(4, only(1))
    assert sold(net)
    net.play(1, only(1))
    assert (E, NO_ROBOT) in net.memo(0).tour
    assert net.holders(E) == [0]

    step_aside(net)
    net.until(lambda: net.holders(E) == [1])


def test_lost_confirmation_is_settled_when_memos_arrive() -> None:
    """r1 holds E, r0 does not hear it and takes E back. Both hold it, then the lower place alone."""
    net = hall()
    net.until(lambda: sold(net))
    net.play(10, only(0))
    assert net.holders(E) == [0, 1]
    assert (E, NO_ROBOT) in net.memo(0).tour

    net.until(lambda: net.holders(E) == [0])
    step_aside(net)
    net.until(lambda: net.holders(E) == [1])


def test_winner_that_disappears_leaves_the_goal_with_its_seller() -> None:
    """The radio is off after the award."""
    net = hall()
    net.until(lambda: sold(net))
    net.under_way = []
    net.play(7, no_radio)

    assert (E, NO_ROBOT) in net.memo(0).tour
    assert net.holders(E) == [0]


def test_seller_that_disappears_after_the_award_leaves_the_goal_with_the_winner() -> None:
    """r1 receives the award and nothing more; it holds E and may offer it once r0 is out of contact."""
    net = hall()
    net.until(lambda: sold(net))
    net.play(12, no_radio)

    assert E in net.tour(1)
    assert net.memo(1).firm == net.tour(1)


def test_seller_that_disappears_before_the_award_keeps_the_goal() -> None:
    """r1 has bid; an offer is no award."""
    net = hall()
    net.until(lambda: net.memo(0).offered == E)
    net.play(12, no_radio)

    assert net.holders(E) == [0]
    assert net.memo(0).offered == NOWHERE


def test_award_that_comes_when_it_was_taken_back_is_settled() -> None:
    """The award arrives 12 steps late, and no memo after it for a while: both hold E, then one."""
    net = hall()
    net.until(lambda: sold(net))
    net.under_way = [(due + 12, *rest) for due, *rest in net.under_way if rest[0] == 1]
    net.play(14, no_radio)
    assert net.holders(E) == [0, 1]

    net.until(lambda: len(net.holders(E)) == 1)
    net.play(10)
    assert len(net.holders(E)) == 1


def test_offer_waits_for_all_in_contact_but_not_for_ever() -> None:
    """r1 is received and receives nothing: bidding ends with the lease, and the next goal is offered."""
    net = hall()
    net.until(lambda: net.memo(0).offered == W)
    net.under_way = []
    net.play(4, only(1))
    assert net.memo(0).offered == W
    net.play(1, only(1))
    assert net.memo(0).offered == E


def test_silent_robot_out_of_contact_does_not_hold_up_an_offer() -> None:
    """A robot out of contact is not waited for, and alone there is nothing to sell."""
    net = hall()
    net.play(9, no_radio)

    assert net.memo(0).offered == NOWHERE
    assert net.tour(0) == [W, E]


def answer(seen: int, *tour: tuple[int, int]) -> TeamMember:
    """r1 with what it has seen of r0."""
    return member(1, 311, Task(23, packed(Memo(9, NOWHERE, 0, 0, (seen, 0, 0), (0, 0, 0), tour))))


@pytest.mark.parametrize(
    ("what", "successor", "after"),
    [
        ("confirmed", answer(60, (E, NO_ROBOT)), []),
        ("holds one near it", answer(60, (E - 1, NO_ROBOT)), []),
        ("holds one too far off", answer(60, (E - 3, NO_ROBOT)), [NO_ROBOT]),
        ("confirmed an earlier award", answer(59, (E, NO_ROBOT)), [1]),
        ("has not answered yet", answer(59), [1]),
        ("declined", answer(60), [NO_ROBOT]),
        ("has named an successor itself", answer(60, (E, 2)), [NO_ROBOT]),
    ],
)
def test_seller_releases_only_what_the_successor_holds_without_a_successor(
    what: str, successor: TeamMember, after: list[int]
) -> None:
    """r0 has named r1 in its memo 60."""
    market = Market(mission(), 0, 0)
    market.form.tour = [Holding(W), Holding(E, successor=1, named=60, until=62)]

    market.assign(situation(cost_map_of(*HALL), [member(0, 5)], [successor], 61))

    assert [held.successor for held in market.form.tour if held.goal == E] == after, what


def test_two_robots_that_name_each_other_do_not_both_release() -> None:
    """Each holds E and has named the other: neither holds it for good, so neither lets go."""
    net = hall()
    net.play(2)
    net.give(0, W)
    for robot in (0, 1):
        holding = Holding(E, successor=1 - robot, named=3, until=20)
        net.markets[robot].form.tour.append(holding)
    for _ in range(10):
        net.play(1)
        assert net.holders(E)

    assert net.holders(E) == [0]


def test_goal_held_twice_is_kept_by_the_lower_place() -> None:
    """Also if it is only as good as the same: within half a range."""
    net = hall()
    net.give(0, W, E)
    net.give(1, N, E - 2)
    net.until(lambda: net.tour(1) == [N])

    assert E in net.tour(0)


def test_goals_further_apart_are_two() -> None:
    """Three cells are more than half a range."""
    net = hall()
    net.give(0, W)
    net.give(1, E - 1, W + 1)
    net.give(0, W - 2)
    net.play(10)

    assert sorted([*net.tour(0), *net.tour(1)]) == [W - 2, W + 1, E - 1]


def test_winner_does_not_take_a_known_goal() -> None:
    """r1 has seen E before it receives the award: it declines at once, and r0 keeps E till it learns."""
    net = hall()
    net.floors[1] = floor_of(*HALL)
    net.until(lambda: sold(net))
    net.floors[1].see([E], FREE)
    net.play(3)

    assert net.holders(E) == [0]
    assert (E, NO_ROBOT) in net.memo(0).tour


def test_robots_that_start_at_once_end_up_with_every_goal_once() -> None:
    """All propose the same before they hear of one another."""
    net = Net(floor_of(*["?" * 24] * 11, "." * 24, *["?" * 24] * 12), [24 * 11 + 11] * 3)
    net.play(1)
    assert net.tour(0) == net.tour(1) == net.tour(2)

    net.play(20)
    goals = [goal for robot in range(3) for goal in net.tour(robot)]
    assert len(goals) == len(set(goals)) == 15


def test_idle_robot_in_contact_drives_to_the_nearest_frontier() -> None:
    """r0 holds all goals; no robot waits."""
    net = Net(floor_of(CORRIDOR), [6, 7])
    net.give(0, 2, 17)
    net.play(1)
    net.give(1)
    net.members[1] = net.members[1]._replace(arrived=True)
    net.play(3)

    assert net.tour(1) == []
    assert net.members[1].task.target == 4


def test_target_stays_while_it_is_a_frontier_and_the_goal_is_the_same() -> None:
    """However the robot moves."""
    net = Net(floor_of(CORRIDOR), [6])
    net.play(1)
    first = net.members[0].task.target
    for cell in (7, 8, 9, 10, 11, 12, 13):
        net.move(cell)
        net.play(1)
        assert net.members[0].task.target == first


# The same under any radio.

FIELD = (*["?" * 24] * 11, *["." * 24] * 2, *["?" * 24] * 11)


def faulty(seed: int, robots: int) -> Radio:
    """Memos are lost, late, repeated and overtaken; for a while the team is cut in two."""
    rng = np.random.default_rng(seed)
    side = rng.integers(0, 2, (8, robots))
    loss = rng.random()

    def radio(source: int, receiver: int, step: int) -> Sequence[int]:
        part = side[step // 10 % 8]
        copies = [int(rng.integers(1, 12)) if rng.random() < 0.3 else 1 for _ in range(2)]
        arrives = part[source] == part[receiver] and rng.random() > loss * 0.8
        return copies[: 1 + (rng.random() < 0.2)] if arrives else ()

    return radio


def wander(net: Net, rng: np.random.Generator) -> None:
    """Move every robot on the known floor, not far from before."""
    net.move(
        *[
            24 * int(rng.integers(11, 13))
            + min(23, max(0, one.cell % 24 + int(rng.integers(-2, 3))))
            for one in net.members
        ]
    )


@given(seed=st.integers(0, 10**6), robots=st.integers(2, 4))
@examples(25)
def test_no_goal_is_ever_lost(seed: int, robots: int) -> None:
    """Whatever the radio does, an unknown goal is held by a robot, in the end by one alone."""
    rng = np.random.default_rng(seed)
    net = Net(floor_of(*FIELD), [24 * 11 + int(cell) for cell in rng.integers(0, 24, robots)])
    radio, goals = faulty(seed, robots), set[int]()
    for step in range(180):
        net.play(1, radio if step < 80 else perfect_radio)
        held = {goal for robot in range(robots) for goal in net.tour(robot)}
        goals |= held
        assert held == goals
        if step < 110:
            wander(net, rng)

    held = [goal for robot in range(robots) for goal in net.tour(robot)]
    assert len(held) == len(goals)
    assert all(net.memo(robot).firm == net.tour(robot) for robot in range(robots))
    assert all(net.memo(robot).offered == NOWHERE for robot in range(robots))


@given(seed=st.integers(0, 10**6), robots=st.integers(2, 4))
@examples(25)
def test_no_goal_is_lost_while_robots_explore(seed: int, robots: int) -> None:
    """Every robot has a map of its own and learns of cells at other times than the others."""
    rng = np.random.default_rng(seed)
    net = Net(floor_of(*FIELD), [24 * 11 + int(cell) for cell in rng.integers(0, 24, robots)])
    net.floors = [floor_of(*FIELD) for _ in range(robots)]
    radio, goals = faulty(seed, robots), set[int]()
    for _ in range(80):
        net.play(1, radio)
        unknown_to_all = np.all([f.fused_map.cells == UNKNOWN for f in net.floors], axis=0)
        held = {goal for robot in range(robots) for goal in net.tour(robot)}
        goals = {goal for goal in goals | held if unknown_to_all[goal]}
        assert goals <= held
        wander(net, rng)
        if held and rng.random() < 0.2:
            seen = sorted(held)[int(rng.integers(len(held)))]
            for floor in net.floors:
                if rng.random() < 0.5:
                    floor.see([seen], FREE)


@pytest.mark.parametrize("rule", ["random", "greedy"])
@given(seed=st.integers(0, 10**6))
@examples(15)
def test_goals_vanish_only_for_one_that_is_as_good(rule: str, seed: int) -> None:
    """A robot that releases an unknown goal has received that its successor holds one within half a range."""
    rng = np.random.default_rng(seed)
    net = Net(
        floor_of(*FIELD),
        [24 * 11 + int(cell) for cell in rng.integers(0, 24, 3)],
        f"planner.goals={rule}",
    )
    radio = faulty(seed, 3)
    cells_between = net.floors[0].cost_map.cells_between
    for _ in range(80):
        before = [net.memo(robot).tour for robot in range(3)]
        net.play(1, radio)
        for robot in range(3):
            for goal, successor in before[robot]:
                if goal not in net.tour(robot):
                    memo = net.received[robot][successor][2].task.memo
                    firm = unpacked(memo, 3, 576).firm
                    assert min(cells_between(goal, other) for other in firm) <= 2.0
        wander(net, rng)


@given(seed=st.integers(0, 10**6))
@examples(10)
def test_same_memos_make_the_same_market(seed: int) -> None:
    """No clock, no entropy: two teams that hear the same announce the same."""
    nets = [Net(floor_of(*FIELD), [270, 275, 280], "planner.goals=random") for _ in range(2)]
    radios = [faulty(seed, 3) for _ in nets]
    for net, radio in zip(nets, radios, strict=True):
        net.play(40, radio)

    assert nets[0].members == nets[1].members


# Whole missions.

FIELD_TRIP = (
    "map.layout=unstructured",
    "map.size_m=[48.0, 48.0]",
    "starts.spread=together",
    "sensor.range_m=6.0",
    "sensor.beams=90",
    "vehicle.speed_m_s=1.0",
    "limit_s=2000.0",
)
BAD_RADIO = (
    "radio.range_m=15.0",
    "radio.drop=0.3",
    "radio.duplicate=0.2",
    "radio.delay_s=1.0",
    "radio.jitter_s=2.0",
)


def targets_of(scenario: Scenario, seed: int) -> tuple[str, dict[str, list[tuple[float, float]]]]:
    """Why a mission ended, and the targets of each robot, one after another."""
    targets: dict[str, list[tuple[float, float]]] = {name: [] for name in scenario.robot_ids}

    def note(record: Record) -> None:
        for step_record in record.step_records if isinstance(record, Batch) else ():
            goal = step_record.outputs and step_record.outputs.goal
            if goal and targets[step_record.name][-1:] != [goal]:
                targets[step_record.name].append(goal)

    return play(scenario, seed, WorldSetup.of(scenario, seed), [note]), targets


@pytest.mark.parametrize("rule", ["random", "greedy", "quadtree"])
@pytest.mark.parametrize(
    "how",
    [("coordination=centralized",), (), BAD_RADIO],
    ids=["centralized", "decentralized", "bad-radio"],
)
def test_mission_ends_and_targets_do_not_oscillate(rule: str, how: tuple[str, ...]) -> None:
    """All is explored; of a robot's targets hardly one in ten is one of the four before it."""
    scenario = mission(*FIELD_TRIP, *how, f"planner.goals={rule}")
    reason, targets = targets_of(scenario, 1)

    assert reason == "done"
    back = [
        goal in ways[max(0, i - 4) : i] for ways in targets.values() for i, goal in enumerate(ways)
    ]
    assert sum(back) <= 0.1 * len(back)
