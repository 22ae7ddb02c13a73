"""The market of a robot without a supervisor: offers, bids and successors in registers."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from kantor_agent.planners.map_base import Situation, Task, TeamMember, past_or_long_ago
from kantor_agent.planners.market.costs import NO_ROBOT, Costs, DistanceField, near, price_of
from kantor_agent.planners.market.memo import Memo, packed, unpacked
from kantor_agent.planners.market.rules import MarketRules, is_open, is_reachable, task_is_stale
from kantor_protocol.base.grid import NOWHERE
from kantor_protocol.scenario.schema import Scenario


class Holding(NamedTuple):
    """A goal in the own tour, perhaps on its way to another robot."""

    goal: int
    successor: int = NO_ROBOT
    named: int = 0
    """The clock of the first memo that names the successor."""
    until: int = 0
    """The tick in which the lease of the successor runs out."""


class _Offer(NamedTuple):
    """A goal of the own tour that is for sale."""

    goal: int
    price: int
    """How much shorter the own tour is without it."""
    opened: int
    """The clock of the first memo with this offer."""
    until: int
    """The tick in which bidding ends."""


class Trader:
    """One robot's part in the market; see `planner.py`. Others know of it what its memos announce."""

    def __init__(self, rules: MarketRules, scenario: Scenario, me: int) -> None:
        self._rules = rules
        self._me = me
        self._robots = scenario.robots.count
        self._lease = max(1, round(scenario.planner.lease_s / scenario.clock.period_s))
        self._gap = scenario.planner.replan_gap
        self._on_events = scenario.planner.replan_on == "events"
        self.tour: list[Holding] = []
        """The goals that this robot holds, in the order in which it explores them."""
        self._offer: _Offer | None = None
        self._to_offer: list[int] = []
        """Goals that are still to be offered in this pass over the tour."""
        self._pass_began = (-self._gap, NOWHERE)
        """The tick and the cell in which the last pass began."""
        self._bids: dict[int, tuple[int, int]] = {}
        """By seller in contact: the clock of its offer, and 1 + the bid or 0."""
        self._clock = 0
        """The clock of the last memo."""
        self._retargeted = -self._gap
        """The tick in which the target was chosen."""
        self._towards = NOWHERE
        """The goal for which the target was chosen."""

    def assign(self, situation: Situation) -> list[Task]:
        """One step of the market: holding, selling, buying, driving."""
        [self._member] = situation.members
        self._cost_map, self._tick = situation.cost_map, situation.tick
        self._clock = max(self._clock + 1, self._tick)
        self._field_now: DistanceField | None = None
        self._memos = self._read_memos(situation.others)
        self.tour = [held for held in self.tour if is_open(self._cost_map, held.goal)]
        self._release()
        self._take_up()
        self._name_successors()
        self._sell()
        self._bid()
        target = self._drive(situation)
        return [Task(target, packed(self._memo()))]

    def _runs(self, until: int) -> bool:
        """Whether a lease that ends at this tick still runs; one that ends too late is of a wrong clock."""
        return self._tick < until <= self._tick + self._lease

    # What is known.

    def _read_memos(self, others: Sequence[TeamMember]) -> dict[int, Memo]:
        """The memos of robots in contact, by robot, rising."""
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
        return [held.goal for held in self.tour]

    @property
    def _firm(self) -> list[int]:
        return [held.goal for held in self.tour if held.successor == NO_ROBOT]

    def _near(self, goal: int, others: Iterable[int]) -> bool:
        return near(self._cost_map, goal, others)

    def _held_by_others(self) -> list[int]:
        return [goal for memo in self._memos.values() for goal, _successor in memo.tour]

    # Holding.

    def _release(self) -> None:
        """Release goals that a successor has taken up; take back those it did not, or not in time."""
        settled = [self._settled(held) for held in self.tour]
        self.tour = [held for held in settled if held is not None]

    def _settled(self, held: Holding) -> Holding | None:
        """A holding after the successor's answer: None if that has taken it up."""
        memo = self._memos.get(held.successor)
        if memo is None:  # no successor, or it is out of contact
            return Holding(held.goal)
        if memo.acknowledged[self._me] >= held.named:
            return None if self._near(held.goal, memo.firm) else Holding(held.goal)
        return held if self._runs(held.until) else Holding(held.goal)

    def _take_up(self) -> None:
        """Take up goals of which this robot is the successor, unless one near is in its tour."""
        for memo in self._memos.values():
            for goal, successor in memo.tour:
                named = successor == self._me and goal not in self._goals
                if named and not self._near(goal, self._firm) and self._can_take(goal):
                    self._insert(goal)

    def _can_take(self, goal: int) -> bool:
        return (
            len(self.tour) < self._rules.capacity
            and is_open(self._cost_map, goal)
            and is_reachable(self._field, goal)
        )

    def _insert(self, goal: int) -> None:
        goals = self._goals
        _, place = self._costs([*goals, goal]).insertion(0, goals, goal)
        self.tour.insert(place, Holding(goal))

    def _costs(self, goals: Iterable[int]) -> Costs:
        return Costs(self._cost_map, [self._field], goals)

    def _name_successors(self) -> None:
        """Name the lowest robot of a lower place that holds a goal near as the successor."""
        for i, held in enumerate(self.tour):
            if held.successor == NO_ROBOT:
                lower = [
                    robot
                    for robot, memo in self._memos.items()
                    if robot < self._me and self._near(held.goal, memo.firm)
                ]
                self.tour[i] = self._named(held.goal, lower[0]) if lower else held

    def _named(self, goal: int, successor: int) -> Holding:
        return Holding(goal, successor, self._clock, self._tick + self._lease)

    # Selling.

    def _sell(self) -> None:
        """Close the offer when all robots in contact have answered, or its time is up; then open another."""
        if self._offer is not None:
            self._close(self._offer)
        if self._offer is None and self._memos and len(self._firm) == len(self.tour):
            self._open()

    def _close(self, offer: _Offer) -> None:
        answers = [
            (memo.bids[self._me], robot)
            for robot, memo in self._memos.items()
            if memo.acknowledged[self._me] >= offer.opened
        ]
        withdrawn = offer.goal not in self._firm
        if not withdrawn and len(answers) < len(self._memos) and self._runs(offer.until):
            return
        self._offer = None
        bids = [answer for answer in answers if 1 <= answer[0] <= offer.price]
        if bids and not withdrawn:
            at = self._goals.index(offer.goal)
            self.tour[at] = self._named(offer.goal, min(bids)[1])

    def _open(self) -> None:
        """Offer the next goal of this pass that is held once; begin a pass when this robot has moved."""
        tick, cell = self._pass_began
        if (
            not self._to_offer
            and self._tick >= past_or_long_ago(tick, self._tick) + self._gap
            and cell != self._member.cell
        ):
            self._to_offer, self._pass_began = self._goals, (self._tick, self._member.cell)
        held = self._held_by_others()
        while self._to_offer and self._offer is None:
            goal = self._to_offer.pop(0)
            if goal in self._goals and not self._near(goal, held):
                price = price_of(self._costs(self._goals).saving(0, self._goals, goal))
                self._offer = _Offer(goal, price, self._clock, self._tick + self._lease)

    # Buying.

    def _bid(self) -> None:
        """Answer the offers of all robots in contact; a bid stands as long as its offer."""
        bids = {}
        for robot, memo in self._memos.items():
            if memo.offered != NOWHERE:
                opened, bid = self._bids.get(robot, (-1, 0))
                fresh = opened != memo.opened
                bids[robot] = (memo.opened, self._bid_for(memo) if fresh else bid)
        self._bids = bids

    def _bid_for(self, memo: Memo) -> int:
        """1 + the cost of the goal on offer, if it is less than the price, or 0."""
        goal, goals = memo.offered, self._goals
        if self._near(goal, goals) or not self._can_take(goal):
            return 0
        bid = price_of(self._costs([*goals, goal]).insertion(0, goals, goal)[0])
        return bid + 1 if bid < memo.price else 0

    # Driving.

    def _drive(self, situation: Situation) -> int:
        """The target: the present one, unless another is due."""
        task, stale = self._member.task, task_is_stale(situation, self._member)
        changed = next(iter(self._goals), NOWHERE) != self._towards
        due = self._member.arrived or (self._on_events and (stale or changed))
        if (
            not (due or task.target == NOWHERE)
            or self._tick < past_or_long_ago(self._retargeted, self._tick) + self._gap
        ):
            return task.target
        self._retargeted = self._tick
        self.tour = [held for held in self.tour if is_reachable(self._field, held.goal)]
        if not self.tour:
            held, rules = self._held_by_others(), self._rules
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
            tuple(self._memos[robot].clock if robot in self._memos else 0 for robot in robots),
            tuple(self._bids.get(robot, (0, 0))[1] for robot in robots),
            tuple((held.goal, held.successor) for held in self.tour),
        )
