"""Robot-steps that one CPU second buys when the whole fleet runs in one process.

Five robots on section VI-A's world, all in contact through the supervisor, at once or in turn, or as
they meet; and a hundred robots with about five in range each. Messages between robots pass the codec. `bare` is
world, radio and robots; `recorded` adds checker, metrics and digest, as in every real run.
"""

import math
import statistics
import time
from typing import NamedTuple

from tables import Table

from kantor_fleet.execution.in_process_team import team
from kantor_fleet.execution.preload import warm_up
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.load import from_tree
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.metrics.result import Result
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup

ROBOTS = 100
SAMPLES = 20_000
DEGREE = 5.0
"""Robots in range of one, on average, where they start."""
DOMAIN_M = (8000.0, 8000.0)
CLUSTERS = 8
"""Gaussians along each side of the domain: robots spread over them instead of meeting at a few."""


class Setting(NamedTuple):
    """A scenario, and the number of its ticks."""

    name: str
    scenario: Scenario
    ticks: int


class Cost(NamedTuple):
    """The cost of one run."""

    steps_per_s: float
    """Robot-steps in a CPU second."""
    deliveries: float
    """Messages that reached a robot in a step, on average."""


def measure(*, quick: bool) -> Table:
    """Medians over runs of the same seed."""
    warm_up()
    repeats = 1 if quick else 3
    rows = []
    for setting in _settings(quick=quick):
        setup = WorldSetup.of(setting.scenario, 0)
        bare = [_run(setting, setup, recorded=False) for _ in range(repeats)]
        recorded = [_run(setting, setup, recorded=True) for _ in range(repeats)]
        fast = statistics.median(cost.steps_per_s for cost in bare)
        slow = statistics.median(cost.steps_per_s for cost in recorded)
        rows.append(
            (
                setting.name,
                f"{setting.scenario.robots.count}",
                f"{setting.ticks}",
                f"{recorded[0].deliveries:.1f}",
                f"{fast:,.0f}",
                f"{slow:,.0f}",
                f"{1e6 / fast:.0f}",
                f"{1e6 / slow:.0f}",
            )
        )
    return Table(
        "fleet: robot-steps per CPU second, in process",
        (
            "scenario",
            "robots",
            "ticks",
            "deliveries",
            "bare",
            "recorded",
            "bare, us/step",
            "recorded, us/step",
        ),
        rows,
        (
            "deliveries: per robot and tick, the supervisor's included",
            "against another revision: python benchmarks/compare.py REVISION",
        ),
    )


def _settings(*, quick: bool) -> list[Setting]:
    ticks, crowd_ticks = (300, 50) if quick else (1000, 150)
    centralized = find("paper-centralized-concurrent", ("merge=ledger", "claims=true"))
    return [
        Setting("centralized, ledger, claims", _cut(centralized, ticks), ticks),
        Setting("paper-centralized", _cut(find("paper-centralized"), ticks), ticks),
        Setting("fleet", _cut(find("fleet"), ticks), ticks),
        Setting("100 robots", crowd(crowd_ticks), crowd_ticks),
    ]


def _cut(scenario: Scenario, ticks: int) -> Scenario:
    """The scenario, ended after so many ticks."""
    tree = to_tree(scenario) | {"limit_s": ticks * scenario.clock.period_s}
    return from_tree(tree, scenario.name)


def crowd(ticks: int) -> Scenario:
    """A hundred robots anywhere in a domain with many clusters of samples."""
    width_m, height_m = DOMAIN_M
    # Each of the others is in range with probability pi r^2 / area.
    range_m = math.sqrt(DEGREE * width_m * height_m / (ROBOTS - 1) / math.pi)
    density = [
        {
            "mean_m": [width_m * (i + 0.5) / CLUSTERS, height_m * (j + 0.5) / CLUSTERS],
            "variance_m2": [40_000.0, 40_000.0],
        }
        for i in range(CLUSTERS)
        for j in range(CLUSTERS)
    ]
    tree = to_tree(find("fleet"))
    tree |= {
        "name": "crowd",
        "domain": {"min_m": [0.0, 0.0], "max_m": list(DOMAIN_M)},
        "robots": {"count": ROBOTS},
        "starts": {"random": True},
        "samples": {"count": SAMPLES},
        "energy": {"points": SAMPLES * 5 // 2},
        "radio": {"range_m": range_m},
        "density": density,
        "metrics": {},
        "limit_s": ticks * 0.1,
    }
    return from_tree(tree, "crowd")


def _run(setting: Setting, setup: WorldSetup, *, recorded: bool) -> Cost:
    """One run, without setting up its robots."""
    scenario = setting.scenario
    recording = Recording(scenario, 0, "in-process") if recorded else None
    simulation = Simulation(scenario, 0, setup, [recording.observe] if recording else [])
    exchange = InProcessExchange(team(scenario, 0, setup))
    start_s = time.process_time()
    simulate(simulation, exchange, 0, lambda: False, exchange)
    cpu_s = time.process_time() - start_s
    steps = setting.ticks * scenario.robots.count
    return Cost(steps / cpu_s, _heard(recording.finish()) if recording else 0.0)


def _heard(result: Result) -> float:
    """Deliveries per robot and tick. Raises RuntimeError when the run broke a rule."""
    if result.violations:
        raise RuntimeError(f"{result.scenario}: {result.complaints[0]}")
    return result.deliveries / (result.ticks * result.robots)
