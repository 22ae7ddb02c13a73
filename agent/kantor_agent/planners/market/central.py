"""The market of a supervisor: all tours are known, and goals are sold where a sale shortens the tours."""

from collections.abc import Sequence

from kantor_agent.mapping.cost_map import CostMap
from kantor_agent.planners.map_base import Situation, Task, TeamMember
from kantor_agent.planners.market.costs import Costs, DistanceField, price_of
from kantor_agent.planners.market.rules import MarketRules, is_open, is_reachable
from kantor_protocol.base.grid import NOWHERE


class CentralMarket:
    """The tours of all robots in contact, and their trade; see `planner.py`."""

    def __init__(self, rules: MarketRules) -> None:
        self._rules = rules
        self.tours: dict[int, list[int]] = {}
        """By robot in contact: its goals in the order of its tour."""

    def assign(self, situation: Situation) -> list[Task]:
        """Give up goals, propose goals, sell goals, then a target for each member."""
        team = sorted(situation.members + situation.others)
        fields = [situation.cost_map.optimistic(member.cell) for member in team]
        self.tours = {member.robot: self.tours.get(member.robot, []) for member in team}
        self._give_up(situation.cost_map, team, fields)
        self._propose(situation, team, fields)
        self.sell(Costs(situation.cost_map, fields, self._held), [m.robot for m in team])
        heading = self._rules.heading
        return [
            Task(heading(situation, m, next(iter(self.tours[m.robot]), NOWHERE)))
            for m in situation.members
        ]

    @property
    def _held(self) -> list[int]:
        return [goal for tour in self.tours.values() for goal in tour]

    def _give_up(
        self, cost_map: CostMap, team: Sequence[TeamMember], fields: Sequence[DistanceField]
    ) -> None:
        """Drop goals that are known or that no way leads to."""
        for member, field in zip(team, fields, strict=True):
            self.tours[member.robot] = [
                goal
                for goal in self.tours[member.robot]
                if is_open(cost_map, goal) and is_reachable(field, goal)
            ]

    def _propose(
        self, situation: Situation, team: Sequence[TeamMember], fields: Sequence[DistanceField]
    ) -> None:
        """Fill empty tours with new goals."""
        for member, field in zip(team, fields, strict=True):
            tour = self.tours[member.robot]
            if tour:
                continue
            goals = self._rules.propose(
                situation.cost_map, field, member.robot, situation.tick, self._held
            )
            costs = Costs(situation.cost_map, [field], goals)
            for goal in goals:
                tour.insert(costs.insertion(0, tour, goal)[1], goal)

    def sell(self, costs: Costs, team: Sequence[int]) -> None:
        """One pass: the lowest place first, its goals in the order of its tour."""
        for seller, robot in enumerate(team):
            for goal in list(self.tours[robot]):
                price = price_of(costs.saving(seller, self.tours[robot], goal))
                bids = [
                    (price_of(cost), bidder, place)
                    for bidder, other in enumerate(team)
                    if bidder != seller and len(self.tours[other]) < self._rules.capacity
                    for cost, place in [costs.insertion(bidder, self.tours[other], goal)]
                ]
                if bids and min(bids)[0] < price:
                    _, winner, place = min(bids)
                    self.tours[robot].remove(goal)
                    self.tours[team[winner]].insert(place, goal)
