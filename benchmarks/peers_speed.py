"""Robot-steps that one CPU second buys in other simulators of many robots, in the same run.

They do less in a step, so this gives a scale and no ranking: ir-sim moves bodies (differential drive, no lidar,
no radio); coverage-control senses an importance field and computes Voronoi coverage, decentralized, in
C++. kantor plans, merges, passes every message through the codec, and records with every checker on.

    pip install --group peers
"""

import importlib.machinery
import importlib.util
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from tables import Table

ROBOTS = (10, 100)
_IR_SIM = """
world: {{height: 1000, width: 1000, step_time: 0.1, control_mode: auto, collision_mode: unobstructed}}
robot:
  - number: {robots}
    distribution: {{name: random, range_low: [1, 1, -3.14], range_high: [999, 999, 3.14]}}
    kinematics: {{name: diff}}
    shape: {{name: circle, radius: 0.2}}
    behavior:
      name: dash
      wander: true
      range_low: [1, 1, -3.14]
      range_high: [999, 999, 3.14]
"""


def measure(*, quick: bool) -> Table:
    """Medians over processes of their own."""
    budget_s, repeats = (1.0, 1) if quick else (4.0, 3)
    rows = []
    for name, (package, does, _) in PEERS.items():
        for robots in ROBOTS:
            try:
                label = f"{package} {version(package)}"
            except PackageNotFoundError:
                rows.append((package, does, f"{robots}", "not installed"))
                continue
            speeds = [_in_a_process(name, robots, budget_s) for _ in range(repeats)]
            rows.append((label, does, f"{robots}", f"{statistics.median(speeds):,.0f}"))
    return Table(
        "peers: robot-steps per CPU second of other simulators",
        ("simulator", "a step is", "robots", "robot-steps/s"),
        rows,
        (
            "kantor's are in the section fleet, column recorded; `pip install --group peers` installs these",
        ),
    )


def ir_sim(robots: int) -> Callable[[], None]:
    """Ir-sim without display and lidar."""
    import irsim  # noqa: PLC0415  may not be installed

    with tempfile.TemporaryDirectory() as folder:
        world = Path(folder) / "world.yaml"
        world.write_text(_IR_SIM.format(robots=robots), encoding="utf-8")
        environment = irsim.make(
            str(world), display=False, disable_all_plot=True, log_level="ERROR"
        )
    advance: Callable[[], None] = environment.step
    return advance


def coverage_control(robots: int) -> Callable[[], None]:
    """Its C++ core alone: the Python package around it imports torch, which a step does not need."""
    spec = importlib.util.find_spec("coverage_control")
    assert spec is not None
    assert spec.origin is not None
    library = next(Path(spec.origin).parent.glob("_core*.so"))
    loader = importlib.machinery.ExtensionFileLoader("_core", str(library))
    located = importlib.util.spec_from_file_location("_core", library, loader=loader)
    assert located is not None
    core: Any = importlib.util.module_from_spec(located)
    loader.exec_module(core)
    parameters = core.Parameters()
    parameters.pNumRobots = robots
    environment = core.CoverageSystem(parameters)
    controller = core.DecentralizedCVT(parameters, environment)

    def step() -> None:
        controller.ComputeActions()
        environment.StepActions(controller.GetActions())

    return step


PEERS = {
    "ir_sim": ("ir-sim", "motion of a body", ir_sim),
    "coverage_control": ("coverage-control", "sensing and Voronoi coverage, C++", coverage_control),
}


def _in_a_process(name: str, robots: int, budget_s: float) -> float:
    """The speed that this file measures in a new process, without threads or caches of another."""
    done = subprocess.run(
        [sys.executable, __file__, name, str(robots), str(budget_s)],
        capture_output=True,
        text=True,
        check=True,
        timeout=120.0,
    )
    return float(done.stdout.split()[-1])


def _steps_per_s(step: Callable[[], None], robots: int, budget_s: float) -> float:
    step()
    steps, start_s = 0, time.process_time()
    while (spent_s := time.process_time() - start_s) < budget_s:
        step()
        steps += 1
    return robots * steps / spent_s


if __name__ == "__main__":
    _, peer, count, budget = sys.argv
    *_, stepper = PEERS[peer]
    print(_steps_per_s(stepper(int(count)), int(count), float(budget)))
