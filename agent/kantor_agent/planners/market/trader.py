"""The market of a robot without a supervisor: offers, bids and heirs by registers."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from kantor_agent.planners.map_base import Member, Situation, Task, past_or_long_ago
from kantor_agent.planners.market.costs import NOBODY, Costs, DistanceField, near, price_of
from kantor_agent.planners.market.memo import Memo, packed, unpacked
from kantor_agent.planners.market.rules import MarketRules, is_open, is_reachable, task_is_stale
from kantor_protocol.base.grid import NOWHERE
from kantor_protocol.scenario.schema import Scenario


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


class Trader:
    """A robot's own market. What it announces is all that others know of it."""

    def __init__(self, rules: MarketRules, scenario: Scenario, me: int) -> None:
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
        self._cost_map, self._tick = situation.cost_map, situation.tick
        self._clock = max(self._clock + 1, self._tick)
        self._field_now: DistanceField | None = None
        self._mates = self._heard(situation.others)
        self._tour = [held for held in self._tour if is_open(self._cost_map, held.goal)]
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
        cells = self._cost_map.frame.cells
        memos = {m.robot: unpacked(m.task.memo, self._robots, cells) for m in others}
        return {robot: memo for robot, memo in sorted(memos.items()) if memo.clock > 0}

    @property
    def _field(self) -> DistanceField:
        if self._field_now is None:
            self._field_now = self._cost_map.optimistic(self._member.cell)
        return self._field_now

    @property
    def _goals(self) -> list[int]:
        return [held.goal for held in self._tour]

    @property
    def _firm(self) -> list[int]:
        return [held.goal for held in self._tour if held.heir == NOBODY]

    def _near(self, goal: int, others: Iterable[int]) -> bool:
        return near(self._cost_map, goal, others)

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
            and is_open(self._cost_map, goal)
            and is_reachable(self._field, goal)
        )

    def _insert(self, goal: int) -> None:
        goals = self._goals
        _, slot = self._costs([*goals, goal]).insertion(0, goals, goal)
        self._tour.insert(slot, _Holding(goal))

    def _costs(self, goals: Iterable[int]) -> Costs:
        return Costs(self._cost_map, [self._field], goals)

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
            and self._tick >= past_or_long_ago(tick, self._tick) + self._gap
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
            or self._tick < past_or_long_ago(self._turned, self._tick) + self._gap
        ):
            return task.target
        self._turned = self._tick
        self._tour = [held for held in self._tour if is_reachable(self._field, held.goal)]
        if not self._tour:
            held, rules = self._held_by_mates(), self._rules
            for goal in rules.propose(self._cost_map, self._field, self._me, self._tick, held):
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
