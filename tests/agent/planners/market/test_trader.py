"""Robots that trade by memos: how a goal changes hands, and what happens when memos or robots disappear."""

from collections.abc import Sequence

import pytest

from kantor_agent.planners.map_base import TeamMember
from kantor_agent.planners.market.costs import NO_ROBOT
from kantor_agent.planners.market.memo import Memo, packed
from kantor_agent.planners.market.planner import Market
from kantor_agent.planners.market.trader import Holding
from kantor_protocol.base.grid import FREE, NOWHERE
from support.teams.floors import member
from support.teams.markets import CORRIDOR, cost_map_of, floor_of, mission, situation
from support.teams.trading_team import Radio, TradingTeam

HALL = (
    "????............................????",
    *["#" * 23 + "." + "#" * 12] * 10,
    *["#" * 23 + "?" + "#" * 12] * 2,
)
"""A long hall and a branch: goals are W, E, and N at the end of the branch."""
W, E, N = 2, 33, 36 * 12 + 23


def hall() -> TradingTeam:
    """r0 in the west holds W and E; r1 in the branch holds N, and will buy E for half its price."""
    team = TradingTeam(floor_of(*HALL), [5, 36 * 8 + 23])
    team.give(0, W, E)
    team.give(1, N)
    return team


def awarded(team: TradingTeam) -> bool:
    """Whether r0 has named r1 as the winner of E."""
    return (E, 1) in team.memo(0).tour


def no_radio(_source: int, _receiver: int, _step: int) -> Sequence[int]:
    """A radio that is off."""
    return ()


def only_from(source: int) -> Radio:
    """A radio that carries the memos of one robot."""
    return lambda one, _other, _step: (1,) if one == source else ()


def step_aside(team: TradingTeam) -> None:
    """Both robots move on by a cell, so that they offer their goals again."""
    team.play(4)
    team.move(*[one.cell ^ 1 if one.robot == 0 else one.cell - 36 for one in team.members])


def test_best_bid_takes_the_goal() -> None:
    """Offer, bid, award, confirmation: one memo each."""
    team = hall()
    team.play(2)
    assert team.memo(0).offered == W

    team.until(lambda: awarded(team))
    assert team.holders(E) == [0]
    team.play(1)
    assert team.holders(E) == [0, 1]
    team.play(1)
    assert team.holders(E) == [1]
    assert (team.tour(0), team.tour(1)) == ([W], [N, E])


def test_without_a_better_bid_the_goal_stays() -> None:
    """r0 offers W, N is offered by r1; no robot gets them cheaper."""
    team = hall()
    team.play(20)

    assert team.holders(W) == [0]
    assert team.holders(N) == [1]
    assert [team.memo(robot).offered for robot in (0, 1)] == [NOWHERE, NOWHERE]


def test_robots_that_stand_still_stop_trading() -> None:
    """Nothing changes, so nothing is offered; memos differ in their clocks alone."""
    team = hall()
    team.play(20)
    before = [team.memo(robot) for robot in (0, 1)]
    team.play(10)

    for robot in (0, 1):
        memo = team.memo(robot)
        assert memo._replace(clock=0, acknowledged=()) == before[robot]._replace(
            clock=0, acknowledged=()
        )


def test_lost_award_leaves_the_goal_with_its_seller() -> None:
    """r1 never learns that it has won: the lease runs out, r0 takes E back, and sells it again."""
    team = hall()
    team.until(lambda: awarded(team))
    team.under_way = []

    team.play(4, only_from(1))
    assert awarded(team)
    team.play(1, only_from(1))
    assert (E, NO_ROBOT) in team.memo(0).tour
    assert team.holders(E) == [0]

    step_aside(team)
    team.until(lambda: team.holders(E) == [1])


def test_lost_confirmation_is_settled_when_memos_arrive() -> None:
    """r1 holds E, r0 does not receive its memos and takes E back. Both hold it, then the lower place alone."""
    team = hall()
    team.until(lambda: awarded(team))
    team.play(10, only_from(0))
    assert team.holders(E) == [0, 1]
    assert (E, NO_ROBOT) in team.memo(0).tour

    team.until(lambda: team.holders(E) == [0])
    step_aside(team)
    team.until(lambda: team.holders(E) == [1])


def test_winner_that_disappears_leaves_the_goal_with_its_seller() -> None:
    """The radio is off after the award."""
    team = hall()
    team.until(lambda: awarded(team))
    team.under_way = []
    team.play(7, no_radio)

    assert (E, NO_ROBOT) in team.memo(0).tour
    assert team.holders(E) == [0]


def test_seller_that_disappears_after_the_award_leaves_the_goal_with_the_winner() -> None:
    """r1 receives the award and nothing more; it holds E and may offer it once r0 is out of contact."""
    team = hall()
    team.until(lambda: awarded(team))
    team.play(12, no_radio)

    assert E in team.tour(1)
    assert team.memo(1).firm == team.tour(1)


def test_seller_that_disappears_before_the_award_keeps_the_goal() -> None:
    """r1 has bid; an offer is no award."""
    team = hall()
    team.until(lambda: team.memo(0).offered == E)
    team.play(12, no_radio)

    assert team.holders(E) == [0]
    assert team.memo(0).offered == NOWHERE


def test_award_that_arrives_after_it_was_taken_back_is_settled() -> None:
    """The award arrives 12 steps late, and no memo after it for a while: both hold E, then one."""
    team = hall()
    team.until(lambda: awarded(team))
    team.under_way = [(due + 12, *rest) for due, *rest in team.under_way if rest[0] == 1]
    team.play(14, no_radio)
    assert team.holders(E) == [0, 1]

    team.until(lambda: len(team.holders(E)) == 1)
    team.play(10)
    assert len(team.holders(E)) == 1


def test_offer_waits_for_all_robots_in_contact_until_its_lease_ends() -> None:
    """r1 is received and receives nothing: bidding ends with the lease, and the next goal is offered."""
    team = hall()
    team.until(lambda: team.memo(0).offered == W)
    team.under_way = []
    team.play(4, only_from(1))
    assert team.memo(0).offered == W
    team.play(1, only_from(1))
    assert team.memo(0).offered == E


def test_silent_robot_out_of_contact_does_not_hold_up_an_offer() -> None:
    """A robot out of contact is not waited for, and alone there is nothing to sell."""
    team = hall()
    team.play(9, no_radio)

    assert team.memo(0).offered == NOWHERE
    assert team.tour(0) == [W, E]


def answer(clock: int, *tour: tuple[int, int]) -> TeamMember:
    """r1 with a memo that answers the memo of r0 with this clock."""
    return member(1, 311, 23, packed(Memo(9, NOWHERE, 0, 0, (clock, 0, 0), (0, 0, 0), tour)))


@pytest.mark.parametrize(
    ("what", "successor", "after"),
    [
        ("confirmed", answer(60, (E, NO_ROBOT)), []),
        ("holds one near it", answer(60, (E - 1, NO_ROBOT)), []),
        ("holds one too far off", answer(60, (E - 3, NO_ROBOT)), [NO_ROBOT]),
        ("confirmed an earlier award", answer(59, (E, NO_ROBOT)), [1]),
        ("has not answered yet", answer(59), [1]),
        ("declined", answer(60), [NO_ROBOT]),
        ("has named a successor itself", answer(60, (E, 2)), [NO_ROBOT]),
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
    team = hall()
    team.play(2)
    team.give(0, W)
    for robot in (0, 1):
        holding = Holding(E, successor=1 - robot, named=3, until=20)
        team.markets[robot].form.tour.append(holding)
    for _ in range(10):
        team.play(1)
        assert team.holders(E)

    assert team.holders(E) == [0]


def test_goal_held_twice_is_kept_by_the_lower_place() -> None:
    """Two goals within half a range of each other count as the same."""
    team = hall()
    team.give(0, W, E)
    team.give(1, N, E - 2)
    team.until(lambda: team.tour(1) == [N])

    assert E in team.tour(0)


def test_goals_further_apart_are_two() -> None:
    """Three cells are more than half a range."""
    team = hall()
    team.give(0, W)
    team.give(1, E - 1, W + 1)
    team.give(0, W - 2)
    team.play(10)

    assert sorted([*team.tour(0), *team.tour(1)]) == [W - 2, W + 1, E - 1]


def test_winner_does_not_take_a_known_goal() -> None:
    """r1 has seen E before it receives the award: it declines at once, and r0 keeps E till it learns."""
    team = hall()
    team.floors[1] = floor_of(*HALL)
    team.until(lambda: awarded(team))
    team.floors[1].see([E], FREE)
    team.play(3)

    assert team.holders(E) == [0]
    assert (E, NO_ROBOT) in team.memo(0).tour


def test_robots_that_start_at_once_end_up_with_every_goal_once() -> None:
    """All propose the same before they receive memos."""
    team = TradingTeam(floor_of(*["?" * 24] * 11, "." * 24, *["?" * 24] * 12), [24 * 11 + 11] * 3)
    team.play(1)
    assert team.tour(0) == team.tour(1) == team.tour(2)

    team.play(20)
    goals = [goal for robot in range(3) for goal in team.tour(robot)]
    assert len(goals) == len(set(goals)) == 15


def test_idle_robot_in_contact_drives_to_the_nearest_frontier() -> None:
    """r0 holds all goals; no robot waits."""
    team = TradingTeam(floor_of(CORRIDOR), [6, 7])
    team.give(0, 2, 17)
    team.play(1)
    team.give(1)
    team.members[1] = team.members[1]._replace(arrived=True)
    team.play(3)

    assert team.tour(1) == []
    assert team.members[1].task.target == 4


def test_target_stays_while_it_is_a_frontier_and_the_goal_is_the_same() -> None:
    """Wherever the robot moves in between."""
    team = TradingTeam(floor_of(CORRIDOR), [6])
    team.play(1)
    first = team.members[0].task.target
    for cell in (7, 8, 9, 10, 11, 12, 13):
        team.move(cell)
        team.play(1)
        assert team.members[0].task.target == first
