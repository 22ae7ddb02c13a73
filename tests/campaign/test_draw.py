"""A seed gives one scenario, which can always be run."""

from collections import Counter
from itertools import chain

from hypothesis import given

from kantor_fleet.campaign.draw import SORTS, draw, sort_of
from kantor_fleet.campaign.keyed_draws import KeyedDraws
from kantor_protocol.scenario.dump import to_toml, to_tree
from kantor_protocol.scenario.faults.liars import LIES, Byzantine, liars_of
from kantor_protocol.scenario.faults.processes import Kill
from kantor_protocol.scenario.faults.schedule import KINDS, kind_of
from kantor_protocol.scenario.load import from_tree, parse
from support.strategies import SEEDS, examples

MANY = 2000


@given(seed=SEEDS)
@examples(300)
def test_every_seed_gives_a_scenario_that_a_user_could_write(seed: int) -> None:
    scenario = draw(seed)
    assert from_tree(to_tree(scenario), "drawn") == scenario
    assert parse(to_toml(scenario), "written") == scenario
    assert parse(to_toml(scenario, brief=True), "written briefly") == scenario


def test_many_seeds_draw_everything() -> None:
    drawn = [draw(seed) for seed in range(MANY)]
    assert set(map(sort_of, drawn)) == set(SORTS)
    kinds = Counter(map(kind_of, chain.from_iterable(scenario.faults for scenario in drawn)))
    assert set(kinds) == set(KINDS)
    assert {scenario.robots.count for scenario in drawn} == set(range(2, 9))
    planners = {scenario.planner.name for scenario in drawn}
    assert len(planners) == 7
    bare = [scenario for scenario in drawn if not scenario.faults]
    assert 0 < len(bare) < MANY / 10


def test_the_second_phase_is_without_faults() -> None:
    for scenario in map(draw, range(300)):
        for fault in scenario.faults:
            lost = isinstance(fault, Kill) and fault.until_s is None
            assert fault.until_ns is not None or lost or kind_of(fault) == "impostor"
            assert (fault.until_ns or fault.from_ns) < 0.75 * scenario.limit_ns


def test_liars_are_drawn_where_all_sign_and_never_all_of_a_team() -> None:
    """Every lie is told somewhere; the honest are at least as many as the liars."""
    told = set()
    signed = 0
    for scenario in map(draw, range(MANY // 2)):
        liars = liars_of(scenario.faults)
        assert scenario.signed or not liars
        assert 2 * len(liars) <= scenario.robots.count
        signed += scenario.signed
        told |= {fault.lie for fault in scenario.faults if isinstance(fault, Byzantine)}
    assert told == set(LIES)
    assert 0.4 < signed / (MANY // 2) < 0.5


def test_the_same_seed_gives_the_same_scenario() -> None:
    assert [draw(seed) for seed in range(50)] == [draw(seed) for seed in range(50)]
    assert draw(1) != draw(2)


@given(seed=SEEDS)
@examples(100)
def test_keyed_draws_stay_within_bounds(seed: int) -> None:
    draws = KeyedDraws(seed, 7)
    assert 2.0 <= draws.between(2.0, 3.0) <= 3.0
    assert 0.1 <= draws.scale(0.1, 10.0) <= 10.0
    assert draws.whole(3, 5) in {3, 4, 5}
    assert draws.one_of("abc", [1.0, 0.0, 2.0]) in "ac"
    assert 1 <= len(draws.some_of("abc")) <= 3
