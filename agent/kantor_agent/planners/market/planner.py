"""A market of goals (Zlot, Stentz, Dias, Thayer 2002, as Puig, Garcia and Wu sum it up).

Theory of operation
-------------------
Every robot proposes goals in unexplored space, keeps them in a tour, and offers them for sale one at a
time, again and again as it moves. A bid is the revenue less the cost of the goal. The revenue is the same
for all, so that only the cost is announced: how much longer the cheapest insertion makes the bidder's tour.
The price is how much shorter the seller's tour would be without the goal. The lowest bid below the price
wins, of equal ones that of the lowest place in the roster; without such a bid the seller keeps the goal. At
fixed positions every sale shortens the sum of all tours, so that trading ends. Of goals within half a sensor
range of one another one is held. A goal is given up when its cell is known or no way leads there. A robot
drives to the frontier that lies best towards the first goal of its tour, or to the nearest one if its tour
is empty: no robot ever waits for another.

The supervisor holds all tours and trades at once whenever a robot needs a target (`CentralMarket`). Without
it robots trade by memos (`Trader`). A memo is the latest announcement of one robot; others receive it late,
not at all, or without the memos before. Its numbers are

    clock, goal on offer + 1, price, clock of the offer
    for every robot: its clock as known here, 1 + the bid for its offer or 0
    for every goal of the tour: its cell + 1, 1 + the robot that is its successor or 0

**A goal changes hands in one way.** Its holder names a successor and goes on holding it. The successor takes
it up. The holder releases it once a memo of the successor, sent after it knew of being named, holds that
goal, or one within half a range, without a successor of its own. If such a memo does not, if the lease runs
out or contact ends, the holder takes the goal back. A sale names the winner. If a goal is held twice, the
robot of the higher place names the one of the lower.

**No goal is lost.** A robot that releases a goal has seen that the successor held it, without a successor,
after it was named. To release it in turn the successor has to name one later, and so on: the last robot to
take the goal up still holds it. Memos that are lost, late or repeated can only make two robots hold it for
a while.
"""

from kantor_agent.planners.map_base import Situation, Task
from kantor_agent.planners.market.central import CentralMarket
from kantor_agent.planners.market.rules import MarketRules
from kantor_agent.planners.market.trader import Trader
from kantor_protocol.scenario.schema import Scenario


class Market:
    """The planner `market`: central in the supervisor, by memos in a robot."""

    def __init__(self, scenario: Scenario, seed: int, me: int | None) -> None:
        """me: the robot that asks, or None for the supervisor."""
        rules = MarketRules(scenario, seed)
        self.negotiates = me is not None
        self.form = CentralMarket(rules) if me is None else Trader(rules, scenario, me)

    def assign(self, situation: Situation, /) -> list[Task]:
        """In the supervisor a task for each member; in a robot its own, with its memo for the others."""
        return self.form.assign(situation)
