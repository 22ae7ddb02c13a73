"""Spectral multiscale coverage (Mathew & Mezic) against its formulas in plain numpy."""

import math

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_agent.belief.belief import Belief
from kantor_agent.planners.base import Goal
from kantor_agent.planners.registry import PLANNERS
from kantor_agent.planners.spectral import mean_over_mixture, way_out
from kantor_agent.robots.density import DensityRobot
from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.machine import Body, Inputs, Observation, Pose
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.replication.cosine_basis import VISIT, rectangle_of, visit_at
from kantor_protocol.replication.gossip import build_replica
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import decode_gossip, encode_gossip
from kantor_protocol.wire.weights import Units
from support.strategies import Points, build_team, examples, mission, scattered, step_rounds

Floats = npt.NDArray[np.float64]

WIDE = (
    "planner=spectral",
    "domain.min_m=[-20.0, 5.0]",
    "domain.max_m=[180.0, 105.0]",
    "starts.poses_m=[[10.0, 10.0], [90.0, 20.0], [50.0, 80.0]]",
    "density=[{mean_m=[30, 40], variance_m2=[400, 90]}, {mean_m=[150, 90], variance_m2=[100, 300], weight=2}]",
)
"""A domain that neither begins at 0 nor is square, with a density that it cuts."""
PLACES = st.tuples(st.floats(-19.0, 179.0), st.floats(5.5, 104.5))
MODES = [1, 2, 3, 10, 15, 20, 64]


def belief_of(scenario: Scenario, samples_m: Points, name: str = "r1") -> Belief:
    """What a robot believes at time 0."""
    units = Units.of(scenario.energy.points, samples_m.shape[0])
    replica = build_replica(name, scenario, units, samples_m.shape[0])
    diffusion_m = scenario.samples.diffusion_m
    walk = RandomWalk(samples_m, diffusion_m, scenario.period_ns, 1, Purpose.SAMPLE_WALK)
    return Belief(walk, units, replica)


def basis(scenario: Scenario, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """f_k and its two derivatives at places (n,): three arrays (K, K, n)."""
    (x_min, y_min), (x_max, y_max) = scenario.domain.min_m, scenario.domain.max_m
    extent_x, extent_y = x_max - x_min, y_max - y_min
    k = np.arange(scenario.planner.modes)
    nu = np.where(k > 0, math.sqrt(0.5), 1.0)
    h = math.sqrt(extent_x * extent_y) * np.outer(nu, nu)[:, :, None]
    a = np.outer(k * math.pi / extent_x, x - x_min)[:, None, :]
    b = np.outer(k * math.pi / extent_y, y - y_min)[None, :, :]
    rate_x = (k * math.pi / extent_x)[:, None, None]
    rate_y = (k * math.pi / extent_y)[None, :, None]
    return (
        np.cos(a) * np.cos(b) / h,
        -rate_x * np.sin(a) * np.cos(b) / h,
        -rate_y * np.cos(a) * np.sin(b) / h,
    )


def density_over(scenario: Scenario, x: Floats, y: Floats) -> Floats:
    """The mixture, up to a factor."""
    total = np.zeros(np.broadcast(x, y).shape)
    for part in scenario.density:
        vx, vy = part.variance_m2
        exponent = (x - part.mean_m[0]) ** 2 / vx + (y - part.mean_m[1]) ** 2 / vy
        total = total + part.weight / math.sqrt(vx * vy) * np.exp(-exponent / 2.0)
    return total


def mu(scenario: Scenario) -> Floats:
    """(K, K) mean of f_k over the density, by 400 x 400 midpoints, all of them."""
    (x_min, y_min), (x_max, y_max) = scenario.domain.min_m, scenario.domain.max_m
    middle = (np.arange(400) + 0.5) / 400
    x, y = np.meshgrid(x_min + middle * (x_max - x_min), y_min + middle * (y_max - y_min))
    weight = density_over(scenario, x, y).ravel()
    values = np.zeros((scenario.planner.modes,) * 2)
    for chunk in np.array_split(np.arange(weight.size), 100):
        values += basis(scenario, x.ravel()[chunk], y.ravel()[chunk])[0] @ weight[chunk]
    return values / weight.sum()


def drive(scenario: Scenario, visits: Points, mean: Floats) -> Floats:
    """B_j (2,) of the robot at the last of all visits."""
    k = np.arange(scenario.planner.modes)
    weight = (1.0 + k[:, None] ** 2 + k[None, :] ** 2) ** -1.5
    gap = basis(scenario, visits[:, 0], visits[:, 1])[0].sum(axis=2) - len(visits) * mean
    _, along_x, along_y = basis(scenario, visits[-1:, 0], visits[-1:, 1])
    return np.array([(weight * gap * d[:, :, 0]).sum() for d in (along_x, along_y)])


def choose(scenario: Scenario, belief: Belief, *places: tuple[float, float]) -> Goal | None:
    """The last goal of a robot that is at one place after the other."""
    planner = PLANNERS["spectral"](scenario)
    goals = [planner.choose(belief, Pose(*place), 1) for place in places]
    return goals[-1]


@pytest.mark.parametrize("modes", [1, 2, 5])
def test_mean_of_a_mixture_is_the_midpoint_sum_over_the_domain(modes: int) -> None:
    """mu_k on 400 x 400 cells, the density renormalised; separable or not, the same number."""
    scenario = mission(*WIDE, f"planner.modes={modes}")
    mean = mean_over_mixture(scenario.density, scenario.domain, modes)
    k = np.arange(modes)
    nu = np.where(k > 0, math.sqrt(0.5), 1.0)
    h = math.sqrt(200.0 * 100.0) * np.outer(nu, nu)

    assert mean is not None
    np.testing.assert_allclose(mean.reshape(modes, modes) / h, mu(scenario), atol=1e-15)


@pytest.mark.parametrize("modes", MODES)
def test_a_visit_adds_the_modes_rounded(modes: int) -> None:
    """Integers, so that sums are exact; the first counts the visits."""
    scenario = mission(*WIDE, f"planner.modes={modes}")
    k = np.arange(modes)
    for x, y in [(80.0, 55.0), (-3.7, 99.1), (140.0, 7.0)]:
        exact = VISIT * np.outer(
            np.cos(k * math.pi * (x + 20.0) / 200.0), np.cos(k * math.pi * (y - 5.0) / 100.0)
        )
        visited = visit_at(x, y, rectangle_of(scenario.domain), modes)

        assert np.abs(visited - exact.ravel()).max() <= 0.5 + 1e-6
        assert visited[0] == VISIT
        assert np.abs(visited).max() <= VISIT


@examples(40)
@given(
    modes=st.sampled_from([2, 3, 10, 15]),
    visits=st.lists(PLACES, min_size=1, max_size=8),
)
def test_robot_heads_against_the_gradient(modes: int, visits: list[tuple[float, float]]) -> None:
    """u_j = -u_max B_j / |B_j|: the goal lies in this direction, where it leaves the domain."""
    scenario = mission(*WIDE, f"planner.modes={modes}")
    goal = choose(scenario, belief_of(scenario, scattered(12)), *visits)
    b = drive(scenario, np.array(visits), mu_of(modes))
    size = float(np.hypot(*b))
    if size < 1e-5:  # rounding of the visits may turn so weak a gradient
        return

    assert goal is not None
    way = np.array([goal.x_m, goal.y_m]) - visits[-1]
    reach = float(np.hypot(*way))
    assert -(way / reach) @ (b / size) > 1.0 - 1e-2
    assert goal.x_m in (-20.0, 180.0) or goal.y_m in (5.0, 105.0)
    assert goal.sample == -1


_MU: dict[int, Floats] = {}


def mu_of(modes: int) -> Floats:
    """The reference for the wide mission, once."""
    if modes not in _MU:
        _MU[modes] = mu(mission(*WIDE, f"planner.modes={modes}"))
    return _MU[modes]


@pytest.mark.parametrize("modes", MODES)
def test_any_number_of_modes_explores(modes: int) -> None:
    """From the constant alone, which is level everywhere, to the most that a scenario allows."""
    scenario = mission(*WIDE, f"planner.modes={modes}")
    told = step_rounds(build_team(scenario, scattered(12)), scenario, 8)
    goals = [outputs.goal for _, outputs in told["r1"]]

    assert all((goal is None) == (modes == 1) for goal in goals)
    assert all(outputs.refused == 0 for transcript in told.values() for _, outputs in transcript)


def test_where_the_gradient_vanishes_a_robot_stays() -> None:
    """In the middle of a density that is the same on all sides."""
    scenario = mission("planner=spectral", "planner.modes=9")

    assert choose(scenario, belief_of(scenario, scattered(12)), (50.0, 50.0)) is None


def test_a_visited_place_is_left_for_another() -> None:
    """The sums never forget: from the same place, by another way."""
    scenario = mission("planner=spectral")
    belief = belief_of(scenario, scattered(12))
    first = choose(scenario, belief, (20.0, 50.0))
    for _ in range(9):
        choose(scenario, belief, (40.0, 50.0))
    later = choose(scenario, belief, (20.0, 50.0))

    assert first is not None
    assert later is not None
    assert first.x_m > 20.0 > later.x_m


DOMAIN = np.array([0.0, 0.0, 100.0, 50.0])
WAYS_OUT = {
    "straight": ((10.0, 20.0), (1.0, 0.0), (100.0, 20.0)),
    "aslant": ((10.0, 20.0), (-1.0, -1.0), (0.0, 10.0)),
    "into-a-corner": ((50.0, 0.0), (1.0, 1.0), (100.0, 50.0)),
    "slides-along-a-border": ((100.0, 20.0), (1.0, -0.1), (100.0, 0.0)),
    "leaves-a-border": ((0.0, 20.0), (1.0, 0.0), (100.0, 20.0)),
    "nowhere-to-slide": ((100.0, 20.0), (1.0, 0.0), (100.0, 20.0)),
    "corner": ((100.0, 50.0), (1.0, 1.0), (100.0, 50.0)),
    "level": ((10.0, 20.0), (0.0, 0.0), (10.0, 20.0)),
    "from-outside": ((-5.0, 20.0), (-1.0, 0.0), (100.0, 20.0)),
    "from-outside-a-corner": ((-10.0, -10.0), (0.3, -0.7), (50.0, 50.0)),
}


@pytest.mark.parametrize("name", WAYS_OUT)
def test_goal_is_where_the_way_leaves_the_domain(name: str) -> None:
    """Inside, on the border, in a corner, outside."""
    place, direction, out = WAYS_OUT[name]

    assert way_out(DOMAIN, *place, *direction) == pytest.approx(out)


@examples(200)
@given(
    place=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
    direction=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_goal_is_in_the_domain(place: tuple[float, float], direction: tuple[float, float]) -> None:
    """Whatever the place and the direction; or there is none."""
    x, y = way_out(DOMAIN, *place, *direction)

    assert (x, y) == place or (0.0 <= x <= 100.0 and 0.0 <= y <= 50.0)


@examples(30)
@given(edge=st.sampled_from([0.0, 100.0]), along=st.floats(1.0, 99.0))
def test_a_robot_on_the_border_comes_back(edge: float, along: float) -> None:
    """On the border itself all modes are level across it; the density in the middle still attracts."""
    scenario = mission("planner=spectral")
    belief = belief_of(scenario, scattered(12))
    goal = choose(scenario, belief, (edge, along))

    assert goal is not None
    assert goal.x_m != edge


def test_density_is_that_of_the_samples_where_there_is_no_mixture() -> None:
    """Walking samples: mu_k is the mean over where they are now."""
    scenario = mission("planner=spectral", "planner.modes=4", "samples.diffusion_m=5.0")
    belief = belief_of(scenario, scattered(40))
    planner = PLANNERS["spectral"](scenario)
    for now_ns in (0, 50 * scenario.period_ns):
        belief.advance(now_ns)
        planner.choose(belief, Pose(10.0, 10.0), now_ns)
        x, y = belief.grid.xy_m.T.clip(0.2, 99.8)
        k = np.arange(4)
        cos_x, cos_y = (np.cos(np.outer(k, math.pi * c / 100.0)) for c in (x, y))
        expected = (cos_x[:, None, :] * cos_y[None, :, :]).mean(axis=2)

        np.testing.assert_allclose(planner.mean, expected.ravel(), atol=1e-12)  # type: ignore[attr-defined]


def test_mixture_outside_the_domain_falls_back_on_the_samples() -> None:
    """No mass to renormalise: what the samples say, and numbers throughout."""
    far = "density=[{mean_m=[1e6, 1e6], variance_m2=[1.0, 1.0]}]"
    scenario = mission("planner=spectral", far)

    assert mean_over_mixture(scenario.density, scenario.domain, 15) is None
    goal = choose(scenario, belief_of(scenario, scattered(12) + 1e6), (20.0, 30.0))
    assert goal is not None
    assert math.isfinite(goal.x_m + goal.y_m)


@pytest.mark.parametrize("vehicle", ["first-order", "second-order", "unicycle", "dubins"])
def test_goal_does_not_depend_on_the_vehicle(vehicle: str) -> None:
    """Same places, same goals; and no vehicle comes to rest on its way."""
    moving = (f"vehicle={vehicle}", "vehicle.speed_m_s=20.0", "energy.points=60")
    scenario = mission(*WIDE, *moving)
    reference = mission(*WIDE)
    machine = DensityRobot("r1", scenario, 1, Body(Pose(10.0, 10.0)), scattered(12))
    planner, belief = PLANNERS["spectral"](reference), belief_of(reference, scattered(12))
    place = Pose(10.0, 10.0)
    for step in range(10):
        outputs = machine.step(
            Inputs((step + 1) * scenario.period_ns, Observation(step, place), ())
        )
        goal = planner.choose(belief, place, 0)

        assert goal is not None
        assert outputs.goal == (goal.x_m, goal.y_m)
        place = outputs.pose
    assert place.speed_m_s > 19.0


def test_knowledge_of_others_changes_the_way() -> None:
    """A robot goes where the others have not been, if it hears of it."""
    scenario = mission("planner=spectral", "energy.points=60", "vehicle.speed_m_s=50.0")
    ways = []
    for heard in (True, False):
        machines = build_team(scenario, scattered(12))
        told = step_rounds(machines, scenario, 9, lambda _speaker, _listener, heard=heard: heard)
        ways.append([outputs.pose for _, outputs in told["r1"]])

    assert ways[0][0] == ways[1][0]
    assert ways[0][-1] != ways[1][-1]


def test_all_robots_come_to_hold_the_same_sums() -> None:
    """In the end a robot's total is the plain sum of all visits, also by way of a relay."""
    for overrides in ((), ("coordination=centralized",)):
        scenario = mission("planner=spectral", "planner.modes=5", "energy.steps=6", *overrides)
        machines = build_team(scenario, scattered(12))
        told = step_rounds(machines, scenario, 30)
        visits = np.zeros(25, dtype=np.int64)
        for name in scenario.robot_ids:
            for inputs, outputs in told[name]:
                if outputs.spent:
                    pose = inputs.observation.pose
                    visits += visit_at(pose.x_m, pose.y_m, rectangle_of(scenario.domain), 5)
        for name in scenario.robot_ids:
            total = machines[name]._belief.registers.total  # type: ignore[attr-defined]
            assert total.tolist() == visits.tolist()


def test_hostile_registers_change_nothing() -> None:
    """Sums beyond the visits: the message is refused whole, and counted."""
    scenario = mission("planner=spectral", "planner.modes=2")
    machines = build_team(scenario, scattered(12))
    said = step_rounds(machines, scenario, 2)["r2"][-1][1].outbox[0]
    news, boast = decode_gossip(said.body), bytes([0, 9, 0, 1, 9, 2, 9, 9, 9])
    lie = encode_gossip(msgspec.structs.replace(news, registers=boast))
    machine, look = machines["r1"], Observation(2, Pose(10.0, 10.0))
    before = machine._belief.registers.values[1:].tolist()  # type: ignore[attr-defined]
    outputs = machine.step(
        Inputs(3 * scenario.period_ns, look, (msgspec.structs.replace(said, body=lie),))
    )

    assert outputs.refused == 1
    assert machine._belief.registers.values[1:].tolist() == before  # type: ignore[attr-defined]
