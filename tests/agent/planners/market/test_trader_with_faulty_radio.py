"""No goal is lost, whatever the radio does with memos: the invariants of the trade in drawn runs."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.planners.market.memo import unpacked
from kantor_protocol.base.grid import FREE, NOWHERE, UNKNOWN
from support.strategies import examples
from support.teams.markets import floor_of
from support.teams.trading_team import Radio, TradingTeam, perfect_radio

KNOWN_BAND = (*["?" * 24] * 11, *["." * 24] * 2, *["?" * 24] * 11)
"""24 x 24 cells; two rows in the middle are free, all others unknown."""


def faulty_radio(seed: int, robots: int) -> Radio:
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


def wander(team: TradingTeam, rng: np.random.Generator) -> None:
    """Move every robot by at most two columns on the known floor."""
    team.move(
        *[
            24 * int(rng.integers(11, 13))
            + min(23, max(0, one.cell % 24 + int(rng.integers(-2, 3))))
            for one in team.members
        ]
    )


@given(seed=st.integers(0, 10**6), robots=st.integers(2, 4))
@examples(25)
def test_no_goal_is_ever_lost(seed: int, robots: int) -> None:
    """An unknown goal is held by a robot, and once the radio has no faults, by one alone."""
    rng = np.random.default_rng(seed)
    team = TradingTeam(
        floor_of(*KNOWN_BAND), [24 * 11 + int(cell) for cell in rng.integers(0, 24, robots)]
    )
    radio, goals = faulty_radio(seed, robots), set[int]()
    for step in range(180):
        team.play(1, radio if step < 80 else perfect_radio)
        held = {goal for robot in range(robots) for goal in team.tour(robot)}
        goals |= held
        assert held == goals
        if step < 110:
            wander(team, rng)

    held = [goal for robot in range(robots) for goal in team.tour(robot)]
    assert len(held) == len(goals)
    assert all(team.memo(robot).firm == team.tour(robot) for robot in range(robots))
    assert all(team.memo(robot).offered == NOWHERE for robot in range(robots))


@given(seed=st.integers(0, 10**6), robots=st.integers(2, 4))
@examples(25)
def test_no_goal_is_lost_while_robots_explore(seed: int, robots: int) -> None:
    """Every robot has a map of its own and learns of cells at other times than the others."""
    rng = np.random.default_rng(seed)
    team = TradingTeam(
        floor_of(*KNOWN_BAND), [24 * 11 + int(cell) for cell in rng.integers(0, 24, robots)]
    )
    team.floors = [floor_of(*KNOWN_BAND) for _ in range(robots)]
    radio, goals = faulty_radio(seed, robots), set[int]()
    for _ in range(80):
        team.play(1, radio)
        unknown_to_all = np.all([f.fused_map.cells == UNKNOWN for f in team.floors], axis=0)
        held = {goal for robot in range(robots) for goal in team.tour(robot)}
        goals = {goal for goal in goals | held if unknown_to_all[goal]}
        assert goals <= held
        wander(team, rng)
        if held and rng.random() < 0.2:
            seen = sorted(held)[int(rng.integers(len(held)))]
            for floor in team.floors:
                if rng.random() < 0.5:
                    floor.see([seen], FREE)


@pytest.mark.parametrize("rule", ["random", "greedy"])
@given(seed=st.integers(0, 10**6))
@examples(15)
def test_goal_is_released_only_for_one_that_is_as_good(rule: str, seed: int) -> None:
    """A robot that releases an unknown goal has received that its successor holds one within half a range."""
    rng = np.random.default_rng(seed)
    team = TradingTeam(
        floor_of(*KNOWN_BAND),
        [24 * 11 + int(cell) for cell in rng.integers(0, 24, 3)],
        f"planner.goals={rule}",
    )
    radio = faulty_radio(seed, 3)
    cells_between = team.floors[0].cost_map.cells_between
    for _ in range(80):
        before = [team.memo(robot).tour for robot in range(3)]
        team.play(1, radio)
        for robot in range(3):
            for goal, successor in before[robot]:
                if goal not in team.tour(robot):
                    memo = team.received[robot][successor][2].task.memo
                    firm = unpacked(memo, 3, 576).firm
                    assert min(cells_between(goal, other) for other in firm) <= 2.0
        wander(team, rng)


@given(seed=st.integers(0, 10**6))
@examples(10)
def test_same_memos_make_the_same_market(seed: int) -> None:
    """No clock, no entropy: two teams that receive the same announce the same."""
    teams = [
        TradingTeam(floor_of(*KNOWN_BAND), [270, 275, 280], "planner.goals=random")
        for _ in range(2)
    ]
    radios = [faulty_radio(seed, 3) for _ in teams]
    for team, radio in zip(teams, radios, strict=True):
        team.play(40, radio)

    assert teams[0].members == teams[1].members
