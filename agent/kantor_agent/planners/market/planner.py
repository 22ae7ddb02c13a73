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

from kantor_agent.planners.map_base import Situation, Task
from kantor_agent.planners.market.central import CentralMarket
from kantor_agent.planners.market.rules import MarketRules
from kantor_agent.planners.market.trader import Trader
from kantor_protocol.scenario.schema import Scenario


class Market:
    """The market, in the form that who asks needs."""

    def __init__(self, scenario: Scenario, seed: int, me: int | None) -> None:
        """me: the robot that asks, or None for the supervisor."""
        rules = MarketRules(scenario, seed)
        self.negotiates = me is not None
        self._form = CentralMarket(rules) if me is None else Trader(rules, scenario, me)

    def assign(self, situation: Situation, /) -> list[Task]:
        """The supervisor: a task for each member. A robot: its own, with what it tells the others."""
        return self._form.assign(situation)
