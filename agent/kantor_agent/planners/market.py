"""A market of goals (Zlot, Stentz, Dias, Thayer 2002, as Puig, Garcia and Wu sum it up).

Every robot proposes goals in unexplored space, keeps them in a tour, and offers them for sale one at a
time, again and again as it moves. A bid is the revenue less the cost of the goal. The revenue is the same
for all, so what is announced is the cost: how much longer the cheapest insertion makes the bidder's tour.
The price is how much shorter the seller's tour would be. Who bids less than the price takes the goal, the
least bid first, then the lowest place; without a bid the seller keeps it. At fixed positions every sale
shortens the sum of all tours, so that trading ends. Goals within half a sensor range are held once. A goal
is given up when its cell is known or no way leads there. A robot drives to the frontier that lies best
towards the first goal of its tour, or to the nearest one if it has none: nobody ever waits for anybody.

The supervisor holds all tours and trades at once whenever somebody needs a target (`_Exchange`). Robots on
their own trade by memos (`_Trader`). A memo is the newest word of one robot; others come to know it late,
not at all, or without the words before. It has

    clock, goal on offer + 1, price, clock of the offer
    for every robot: its clock as known here, 1 + the bid for its offer or 0
    for every goal of the tour: its cell + 1, 1 + the robot that is to take it over or 0

**A goal changes hands in one way.** Its holder names an heir and goes on holding it. The heir takes it up.
The holder lets go once a memo of the heir that knows its naming holds that goal, or one within half a range,
without an heir of its own. If such a memo does not, if the lease runs out or contact ends, the holder takes
the goal back. A sale names the winner. If a goal is held twice the robot of the higher place names the lower.

**No goal is lost.** Who lets go has seen that the heir held the goal, without an heir, after it was named. To
let go in turn the heir has to name one later, and so on: the last one to take the goal up still holds it.
Words that are lost, late or repeated can only make two hold it for a while.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_agent.planners.team import Member, Situation, Task, past
from kantor_agent.terrain import Terrain
from kantor_protocol.grid import NOWHERE, UNKNOWN
from kantor_protocol.kernels import kernel
from kantor_protocol.keyed import Purpose, uniform
from kantor_protocol.scenario import Scenario

Cells = Sequence[int]
Field = npt.NDArray[np.float64]
"""(cells,) from one robot's place, over what is unknown as well."""

NOBODY = -1
_UNKNOWN_SHARE = 0.25
"""quadtree: a part of the map with more of it unknown is split, or becomes a goal."""
_LEAF_RANGES = 2.0
"""quadtree: a part that is no longer than this is not split."""
_PER_CELL = 16
"""Prices and bids are counted in such parts of a cell: closer ones are equal."""
_PRICE_MAX = 1 << 40


# Goals.


def random_goals(terrain: Terrain, seed: int, robot: int, tick: int, count: int) -> list[int]:
    """So many cells anywhere, drawn anew in every tick; those that are known are left out."""
    cells = terrain.frame.cells
    drawn = [
        int(uniform(seed, Purpose.MARKET, robot, tick, index) * cells) for index in range(count)
    ]
    return [cell for cell in dict.fromkeys(drawn) if terrain.chart.cells[cell] == UNKNOWN]


@kernel
def clear_disc(values: np.ndarray, columns: int, cell: int, radius_cells: float) -> None:
    """Make values (cells,) infinite that are less than a radius away from a cell, and its own."""
    row, column = cell // columns, cell % columns
    rows, reach = values.shape[0] // columns, int(radius_cells)
    for i in range(max(0, row - reach), min(rows, row + reach + 1)):
        for j in range(max(0, column - reach), min(columns, column + reach + 1)):
            if math.hypot(i - row, j - column) < radius_cells or (i == row and j == column):
                values[i * columns + j] = math.inf


def greedy_goals(terrain: Terrain, field: Field, held: Iterable[int], count: int) -> list[int]:
    """The unknown cells that are cheapest to get to, a sensor range from one another.

    Those within half a range of a held goal are left out; of equal ones the lowest is taken.
    """
    columns, range_cells = terrain.frame.columns, terrain.sensor_cells
    values = np.where(terrain.chart.cells == UNKNOWN, field, np.inf)
    for cell in held:
        clear_disc(values, columns, cell, math.nextafter(0.5 * range_cells, math.inf))
    goals: list[int] = []
    while len(goals) < count and values.size:
        goal = int(values.argmin())
        if values[goal] == math.inf:
            break
        goals.append(goal)
        clear_disc(values, columns, goal, range_cells)
    return goals


def quadtree_goals(terrain: Terrain) -> list[int]:
    """Centres of the leaves of a quadtree over the map, where they are unknown; rising.

    A part of the map is of no interest if a quarter of it or less is unknown. Otherwise it is halved along
    both sides if one is longer than two sensor ranges, and a leaf if not.
    """
    rows, columns = terrain.frame.rows, terrain.frame.columns
    unknown = (terrain.chart.cells == UNKNOWN).reshape(rows, columns)
    sums = np.zeros((rows + 1, columns + 1), dtype=np.int64)
    sums[1:, 1:] = unknown.cumsum(axis=0).cumsum(axis=1)
    longest = max(1.0, _LEAF_RANGES * terrain.sensor_cells)
    parts, goals = [(0, rows, 0, columns)], []
    while parts:
        low, high, left, right = parts.pop()
        area = (high - low) * (right - left)
        inside = sums[high, right] - sums[low, right] - sums[high, left] + sums[low, left]
        if inside <= _UNKNOWN_SHARE * area:
            continue
        row, column = (low + high) // 2, (left + right) // 2
        if max(high - low, right - left) > longest:
            halves = [(low, row), (row, high)], [(left, column), (column, right)]
            parts += [(*below, *across) for below in halves[0] for across in halves[1]]
        elif unknown[row, column]:
            goals.append(row * columns + column)
    return sorted(goals)


# Costs.


class Costs:
    """What goals cost: from each robot's place to each goal, and from goal to goal, in cells.

    From a place it is the value function, with what is unknown taken for open floor. Between two goals it is
    the most that follows without a field from either: the straight line, or the difference of what both cost
    from one of the places (the triangle inequality; landmarks, Goldberg and Harrelson 2005). That is a metric
    and agrees with the costs from the places, so that no insertion shortens a tour. A field from every goal
    would cost as much again and make missions no shorter.
    """

    def __init__(self, terrain: Terrain, fields: Sequence[Field], goals: Iterable[int]) -> None:
        cells = np.array(sorted(set(goals)), dtype=np.int64)
        self._index = {cell: i for i, cell in enumerate(cells.tolist())}
        from_places = np.array([field[cells] for field in fields]).reshape(len(fields), cells.size)
        between = np.zeros((cells.size, cells.size))
        separate(from_places, cells, terrain.frame.columns, between)
        self._from_places: list[list[float]] = from_places.tolist()
        self._between: list[list[float]] = between.tolist()

    def insertion(self, place: int, tour: Cells, goal: int) -> tuple[float, int]:
        """How much longer a goal makes the tour from a place, inserted where that is least, and there.

        Of equal insertions the first is taken; infinite if there is none.
        """
        cost, slot, last = math.inf, len(tour), len(tour)
        for i in range(last + 1):
            before = tour[i - 1] if i else NOWHERE
            longer = self._leg(place, before, goal)
            if i < last:
                longer += self._leg(place, goal, tour[i]) - self._leg(place, before, tour[i])
            if longer < cost:  # the difference of two infinite legs is no number, and not less
                cost, slot = longer, i
        return cost, slot

    def saving(self, place: int, tour: Cells, goal: int) -> float:
        """How much shorter the tour from a place is without one of its goals."""
        i = tour.index(goal)
        before = tour[i - 1] if i else NOWHERE
        saved = self._leg(place, before, goal)
        if i + 1 < len(tour):
            saved += self._leg(place, goal, tour[i + 1]) - self._leg(place, before, tour[i + 1])
        return math.inf if math.isnan(saved) else saved

    def _leg(self, place: int, one: int, other: int) -> float:
        """From a goal, or from the place (NOWHERE), to a goal."""
        to = self._index[other]
        return (
            self._from_places[place][to] if one == NOWHERE else self._between[self._index[one]][to]
        )


@kernel
def separate(from_places: np.ndarray, cells: np.ndarray, columns: int, between: np.ndarray) -> None:
    """Fill between (goals, goals), the least that ways between goals can cost; see `Costs`.

    from_places: (places, goals); cells: (goals,). Infinite if one is reached from a place and the other not.
    """
    for a in range(cells.shape[0]):
        for b in range(cells.shape[0]):
            rows = cells[a] // columns - cells[b] // columns
            least = math.hypot(rows, cells[a] % columns - cells[b] % columns)
            for place in range(from_places.shape[0]):
                to_a, to_b = from_places[place, a], from_places[place, b]
                if to_a < math.inf or to_b < math.inf:
                    least = max(least, abs(to_a - to_b))
            between[a, b] = least


def price_of(cost: float) -> int:
    """A cost as it is announced."""
    return round(min(cost * _PER_CELL, _PRICE_MAX))


def near(terrain: Terrain, goal: int, others: Iterable[int]) -> bool:
    """Whether one of others is as good as a goal: it lies within half a sensor range."""
    half = 0.5 * terrain.sensor_cells
    return any(terrain.cells_between(goal, other) <= half for other in others)


class _Rules:
    """What both forms of the market have in common."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        planner, robots = scenario.planner, scenario.robots.count
        self._seed = seed
        self._rule = planner.goals
        self._count = planner.goal_count
        self.capacity = (scenario.register_width - 4 - _HEAD - 2 * robots) // 2
        """Goals of a tour that a memo has room for."""

    def propose(
        self, terrain: Terrain, field: Field, robot: int, tick: int, held: Cells
    ) -> list[int]:
        """New goals of a robot, the cheapest first, none within half a range of another or a held one."""
        count = min(self._count, self.capacity)
        if self._rule == "greedy":
            return greedy_goals(terrain, field, held, count)
        if self._rule == "random":
            cells = random_goals(terrain, self._seed, robot, tick, count)
        else:
            cells = quadtree_goals(terrain)
        goals: list[int] = []
        for cell in sorted(cells, key=lambda cell: (field[cell], cell)):
            if (
                len(goals) < count
                and field[cell] < math.inf
                and not near(terrain, cell, (*held, *goals))
            ):
                goals.append(cell)
        return goals

    def heading(self, situation: Situation, member: Member, goal: int) -> int:
        """The reachable frontier on the best way to a goal, or the nearest (NOWHERE); the lowest of equals."""
        terrain, frontiers = situation.terrain, situation.frontiers
        totals = terrain.travel(member.cell)[frontiers]
        if goal != NOWHERE:
            towards = totals + terrain.optimistic(goal, until=member.cell)[frontiers]
            totals = towards if np.isfinite(towards).any() else totals
        best = int(totals.argmin()) if totals.size else 0
        reached = totals.size and math.isfinite(totals[best])
        return int(frontiers[best]) if reached else NOWHERE


def _is_open(terrain: Terrain, goal: int) -> bool:
    """Whether there is still something to explore at a goal."""
    return bool(terrain.chart.cells[goal] == UNKNOWN)


def _is_reachable(field: Field, goal: int) -> bool:
    """Whether a way may lead to a goal."""
    return bool(field[goal] < math.inf)


# All tours in one place.


class _Exchange:
    """The supervisor's market."""

    def __init__(self, rules: _Rules) -> None:
        self._rules = rules
        self._tours: dict[int, list[int]] = {}

    def assign(self, situation: Situation) -> list[Task]:
        """Give up goals, propose goals, sell goals, then a target for each member."""
        team = sorted(situation.members + situation.others)
        fields = [situation.terrain.optimistic(member.cell) for member in team]
        self._tours = {member.robot: self._tours.get(member.robot, []) for member in team}
        self._give_up(situation.terrain, team, fields)
        self._propose(situation, team, fields)
        self._sell(Costs(situation.terrain, fields, self._held), [m.robot for m in team])
        heading = self._rules.heading
        return [
            Task(heading(situation, m, next(iter(self._tours[m.robot]), NOWHERE)))
            for m in situation.members
        ]

    @property
    def _held(self) -> list[int]:
        return [goal for tour in self._tours.values() for goal in tour]

    def _give_up(self, terrain: Terrain, team: Sequence[Member], fields: Sequence[Field]) -> None:
        for member, field in zip(team, fields, strict=True):
            self._tours[member.robot] = [
                goal
                for goal in self._tours[member.robot]
                if _is_open(terrain, goal) and _is_reachable(field, goal)
            ]

    def _propose(
        self, situation: Situation, team: Sequence[Member], fields: Sequence[Field]
    ) -> None:
        for member, field in zip(team, fields, strict=True):
            tour = self._tours[member.robot]
            if tour:
                continue
            goals = self._rules.propose(
                situation.terrain, field, member.robot, situation.tick, self._held
            )
            costs = Costs(situation.terrain, [field], goals)
            for goal in goals:
                tour.insert(costs.insertion(0, tour, goal)[1], goal)

    def _sell(self, costs: Costs, team: Sequence[int]) -> None:
        """One pass: the lowest place first, its goals in the order of its tour."""
        for seller, robot in enumerate(team):
            for goal in list(self._tours[robot]):
                price = price_of(costs.saving(seller, self._tours[robot], goal))
                bids = [
                    (price_of(cost), bidder, slot)
                    for bidder, other in enumerate(team)
                    if bidder != seller and len(self._tours[other]) < self._rules.capacity
                    for cost, slot in [costs.insertion(bidder, self._tours[other], goal)]
                ]
                if bids and min(bids)[0] < price:
                    _, winner, slot = min(bids)
                    self._tours[robot].remove(goal)
                    self._tours[team[winner]].insert(slot, goal)


# A tour in every robot.

_HEAD = 4


class Memo(NamedTuple):
    """What a robot announces; see the module."""

    clock: int
    """Counts its memos, with gaps; 0: no memo."""
    offered: int
    """The goal on offer, or NOWHERE."""
    price: int
    opened: int
    """The clock of the first memo with this offer."""
    seen: tuple[int, ...]
    """(robots,) clocks of the memos that it answers."""
    bids: tuple[int, ...]
    """(robots,) 1 + the bid for the offer in that memo, or 0."""
    tour: tuple[tuple[int, int], ...]
    """Its goals, and who is to take each over."""

    @property
    def firm(self) -> list[int]:
        """Goals that nobody is to take over."""
        return [goal for goal, heir in self.tour if heir == NOBODY]


def packed(memo: Memo) -> tuple[int, ...]:
    """A memo as integers."""
    answers = [number for pair in zip(memo.seen, memo.bids, strict=True) for number in pair]
    tour = [number + 1 for pair in memo.tour for number in pair]
    return memo.clock, memo.offered + 1, memo.price, memo.opened, *answers, *tour


def unpacked(numbers: Sequence[int], robots: int, cells: int) -> Memo:
    """A memo from whatever somebody announced; zeros at the end may be missing, nonsense is left out."""
    begin = _HEAD + 2 * robots
    numbers = [*numbers, *[0] * (begin + 1)]
    clock, offered, price, opened = numbers[:_HEAD]
    seen, bids = numbers[_HEAD:begin:2], numbers[_HEAD + 1 : begin : 2]
    pairs = zip(numbers[begin::2], numbers[begin + 1 :: 2], strict=False)
    return Memo(
        max(0, clock),
        offered - 1 if 1 <= offered <= cells else NOWHERE,
        price,
        opened,
        tuple(seen),
        tuple(bids),
        tuple(
            (cell - 1, heir - 1 if 1 <= heir <= robots else NOBODY)
            for cell, heir in pairs
            if 1 <= cell <= cells
        ),
    )


class _Holding(NamedTuple):
    """A goal in the own tour."""

    goal: int
    heir: int = NOBODY
    named: int = 0
    """The clock of the first memo that names the heir."""
    until: int = 0
    """The tick in which the lease of the heir runs out."""


class _Offer(NamedTuple):
    """A goal that is for sale."""

    goal: int
    price: int
    opened: int
    until: int
    """The tick in which bidding ends."""


class _Trader:
    """A robot's own market. What it announces is all that others know of it."""

    def __init__(self, rules: _Rules, scenario: Scenario, me: int) -> None:
        self._rules = rules
        self._me = me
        self._robots = scenario.robots.count
        self._lease = max(1, round(scenario.planner.lease_s / scenario.clock.period_s))
        self._gap = scenario.planner.replan_gap
        self._on_events = scenario.planner.replan_on == "events"
        self._tour: list[_Holding] = []
        self._offer: _Offer | None = None
        self._agenda: list[int] = []
        self._passed = (-self._gap, NOWHERE)
        self._bids: dict[int, tuple[int, int]] = {}
        self._clock = 0
        self._turned = -self._gap
        self._towards = NOWHERE

    def assign(self, situation: Situation) -> list[Task]:
        """One step of all that goes on at once: holding, selling, buying, driving."""
        [self._member] = situation.members
        self._terrain, self._tick = situation.terrain, situation.tick
        self._clock = max(self._clock + 1, self._tick)
        self._field_now: Field | None = None
        self._mates = self._heard(situation.others)
        self._tour = [held for held in self._tour if _is_open(self._terrain, held.goal)]
        self._let_go()
        self._take_up()
        self._name_heirs()
        self._sell()
        self._bid()
        target = self._drive(situation)
        return [Task(target, packed(self._memo()))]

    def _runs(self, until: int) -> bool:
        """Whether a lease that ends then still runs; one with too long to go is of a clock that ran wrong."""
        return self._tick < until <= self._tick + self._lease

    # What is known.

    def _heard(self, others: Sequence[Member]) -> dict[int, Memo]:
        """The memos of those in contact, by place."""
        cells = self._terrain.frame.cells
        memos = {m.robot: unpacked(m.task.memo, self._robots, cells) for m in others}
        return {robot: memo for robot, memo in sorted(memos.items()) if memo.clock > 0}

    @property
    def _field(self) -> Field:
        if self._field_now is None:
            self._field_now = self._terrain.optimistic(self._member.cell)
        return self._field_now

    @property
    def _goals(self) -> list[int]:
        return [held.goal for held in self._tour]

    @property
    def _firm(self) -> list[int]:
        return [held.goal for held in self._tour if held.heir == NOBODY]

    def _near(self, goal: int, others: Iterable[int]) -> bool:
        return near(self._terrain, goal, others)

    def _held_by_mates(self) -> list[int]:
        return [goal for memo in self._mates.values() for goal, _heir in memo.tour]

    # Holding.

    def _let_go(self) -> None:
        """Let go of what an heir has taken up; take back what it did not, or not in time."""
        settled = [self._settled(held) for held in self._tour]
        self._tour = [held for held in settled if held is not None]

    def _settled(self, held: _Holding) -> _Holding | None:
        """A holding as the heir's answer leaves it: None if it has been taken up."""
        memo = self._mates.get(held.heir)
        if memo is None:  # nobody, or out of contact
            return _Holding(held.goal)
        if memo.seen[self._me] >= held.named:
            return None if self._near(held.goal, memo.firm) else _Holding(held.goal)
        return held if self._runs(held.until) else _Holding(held.goal)

    def _take_up(self) -> None:
        """Take up what others want this robot to hold, unless something near is in its tour."""
        for memo in self._mates.values():
            for goal, heir in memo.tour:
                wanted = heir == self._me and goal not in self._goals
                if wanted and not self._near(goal, self._firm) and self._can_take(goal):
                    self._insert(goal)

    def _can_take(self, goal: int) -> bool:
        return (
            len(self._tour) < self._rules.capacity
            and _is_open(self._terrain, goal)
            and _is_reachable(self._field, goal)
        )

    def _insert(self, goal: int) -> None:
        goals = self._goals
        _, slot = self._costs([*goals, goal]).insertion(0, goals, goal)
        self._tour.insert(slot, _Holding(goal))

    def _costs(self, goals: Iterable[int]) -> Costs:
        return Costs(self._terrain, [self._field], goals)

    def _name_heirs(self) -> None:
        """Name the lowest robot of a lower place that holds something near, as the heir."""
        for i, held in enumerate(self._tour):
            if held.heir == NOBODY:
                lower = [
                    robot
                    for robot, memo in self._mates.items()
                    if robot < self._me and self._near(held.goal, memo.firm)
                ]
                self._tour[i] = self._named(held.goal, lower[0]) if lower else held

    def _named(self, goal: int, heir: int) -> _Holding:
        return _Holding(goal, heir, self._clock, self._tick + self._lease)

    # Selling.

    def _sell(self) -> None:
        """Close the offer when everybody has answered, or its time is up; then open another."""
        if self._offer is not None:
            self._close(self._offer)
        if self._offer is None and self._mates and len(self._firm) == len(self._tour):
            self._open()

    def _close(self, offer: _Offer) -> None:
        answers = [
            (memo.bids[self._me], robot)
            for robot, memo in self._mates.items()
            if memo.seen[self._me] >= offer.opened
        ]
        void = offer.goal not in self._firm
        if not void and len(answers) < len(self._mates) and self._runs(offer.until):
            return
        self._offer = None
        bids = [answer for answer in answers if 1 <= answer[0] <= offer.price]
        if bids and not void:
            at = self._goals.index(offer.goal)
            self._tour[at] = self._named(offer.goal, min(bids)[1])

    def _open(self) -> None:
        """Offer the next goal of this pass that is held once; begin a pass when this robot has moved."""
        tick, cell = self._passed
        if (
            not self._agenda
            and self._tick >= past(tick, self._tick) + self._gap
            and cell != self._member.cell
        ):
            self._agenda, self._passed = self._goals, (self._tick, self._member.cell)
        told = self._held_by_mates()
        while self._agenda and self._offer is None:
            goal = self._agenda.pop(0)
            if goal in self._goals and not self._near(goal, told):
                price = price_of(self._costs(self._goals).saving(0, self._goals, goal))
                self._offer = _Offer(goal, price, self._clock, self._tick + self._lease)

    # Buying.

    def _bid(self) -> None:
        """Answer the offers of all in contact; a bid stands as long as its offer."""
        bids = {}
        for robot, memo in self._mates.items():
            if memo.offered != NOWHERE:
                opened, bid = self._bids.get(robot, (-1, 0))
                fresh = opened != memo.opened
                bids[robot] = (memo.opened, self._bid_for(memo) if fresh else bid)
        self._bids = bids

    def _bid_for(self, memo: Memo) -> int:
        """1 + the cost of what is offered, if it is less than the price, or 0."""
        goal, goals = memo.offered, self._goals
        if self._near(goal, goals) or not self._can_take(goal):
            return 0
        bid = price_of(self._costs([*goals, goal]).insertion(0, goals, goal)[0])
        return bid + 1 if bid < memo.price else 0

    # Driving.

    def _drive(self, situation: Situation) -> int:
        """The target: as before, unless it is time for another."""
        task, stale = self._member.task, task_is_stale(situation, self._member)
        changed = next(iter(self._goals), NOWHERE) != self._towards
        due = self._member.arrived or (self._on_events and (stale or changed))
        if (
            not (due or task.target == NOWHERE)
            or self._tick < past(self._turned, self._tick) + self._gap
        ):
            return task.target
        self._turned = self._tick
        self._tour = [held for held in self._tour if _is_reachable(self._field, held.goal)]
        if not self._tour:
            held, rules = self._held_by_mates(), self._rules
            for goal in rules.propose(self._terrain, self._field, self._me, self._tick, held):
                self._insert(goal)
        self._towards = next(iter(self._goals), NOWHERE)
        return self._rules.heading(situation, self._member, self._towards)

    def _memo(self) -> Memo:
        offer = self._offer or _Offer(NOWHERE, 0, 0, 0)
        robots = range(self._robots)
        return Memo(
            self._clock,
            offer.goal,
            offer.price,
            offer.opened,
            tuple(self._mates[robot].clock if robot in self._mates else 0 for robot in robots),
            tuple(self._bids.get(robot, (0, 0))[1] for robot in robots),
            tuple((held.goal, held.heir) for held in self._tour),
        )


def task_is_stale(situation: Situation, member: Member) -> bool:
    """Whether a member's target is no frontier any more."""
    frontiers = situation.frontiers
    at = int(np.searchsorted(frontiers, member.task.target))
    return at >= frontiers.size or int(frontiers[at]) != member.task.target


class Market:
    """The market, in the form that who asks needs."""

    def __init__(self, scenario: Scenario, seed: int, me: int | None) -> None:
        """me: the robot that asks, or None for the supervisor."""
        rules = _Rules(scenario, seed)
        self.negotiates = me is not None
        self._form = _Exchange(rules) if me is None else _Trader(rules, scenario, me)

    def assign(self, situation: Situation, /) -> list[Task]:
        """The supervisor: a task for each member. A robot: its own, with what it tells the others."""
        return self._form.assign(situation)
