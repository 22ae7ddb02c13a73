"""Cost of missions on an unknown map: CPU time with every checker, and bytes that robots publish of the map.

The office at 0.2 m, three robots that hear each other within 12 m, or a supervisor that hears all; and eight
robots in a field of obstacles. Runs are in process and exactly repeatable but for the time; over the bus
the bytes are the same. Then commands of a few seconds of the office at other sizes, up to the largest map: what they
take beside the mission itself, with the picture.
"""

import statistics
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from kantor_command import Ran, run_command
from tables import Table, verdict

from kantor_fleet.execution.in_process_team import play
from kantor_fleet.execution.preload import warm_up
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.scenario.schema import MAP_PLANNERS
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup

BYTES_MAX = 60.0
"""Bytes of maps per robot and tick, on average, at 0.2 m."""
SIDES_M = (20, 200, 400, 800)
"""Of square maps; of the last 800 m are the most cells that a map may have."""
MIB = 1 << 20
MIB_MAX = 1_300
"""Memory that a command on the largest map takes at most."""
_EIGHT = ("robots.count=8", "coordination=centralized")


class Cost(NamedTuple):
    """The cost of one run."""

    steps_per_s: float
    """Robot-steps in a CPU second."""
    cpu_s: float
    map_bytes: float
    """Bytes per robot and tick."""
    cells: int


def measure(*, quick: bool) -> Table:
    """Medians over five seeds, or one."""
    warm_up()
    rows, met = [], True
    for planner in sorted(MAP_PLANNERS):
        settings = (
            ("office", "12 m", ()),
            ("office", "supervisor", ("coordination=centralized",)),
            ("unstructured", "supervisor, 8 robots", _EIGHT),
        )
        for name, radio, overrides in settings[:1] if quick else settings:
            costs = [
                _run(name, (f"planner={planner}", *overrides), seed)
                for seed in range(1 if quick else 5)
            ]
            map_bytes = statistics.fmean(cost.map_bytes for cost in costs)
            judged = name == "office"
            reached = map_bytes <= BYTES_MAX or not judged
            met = met and reached
            whole = costs[0].cells // 4
            rows.append(
                (
                    planner,
                    f"{name}, {radio}",
                    f"{statistics.median(cost.steps_per_s for cost in costs):,.0f}",
                    f"{statistics.median(cost.cpu_s for cost in costs):.2f}",
                    f"{map_bytes:.1f}",
                    f"{BYTES_MAX:g}" if judged else "",
                    verdict(met=reached) if judged else "",
                    f"{whole:,}",
                    f"{whole / map_bytes:,.0f}",
                )
            )
    sizes = {(5 * side_m) ** 2: _command(side_m) for side_m in SIDES_M[: 2 if quick else None]}
    fits = all(ran.peak_bytes <= MIB_MAX * MIB for ran in sizes.values())
    return Table(
        "maps: missions on an unknown map",
        (
            "planner",
            "mission",
            "robot-steps per CPU s",
            "CPU s a run",
            "B of maps",
            "target",
            "verdict",
            "2-bit grid, B",
            "ratio",
        ),
        rows,
        (
            f"4 s of the office at other sizes, as a command; at most {MIB_MAX} MiB: {verdict(met=fits)}",
            *(
                f"{cells:>12,} cells: {ran.cpu_s:5.1f} CPU s, {ran.peak_bytes / MIB:6,.0f} MiB"
                for cells, ran in sizes.items()
            ),
        ),
        met and fits,
    )


def _command(side_m: int) -> Ran:
    settings = f"map.size_m=[{side_m},{side_m}] limit_s=4"
    with tempfile.TemporaryDirectory() as folder:
        return run_command(f"run office --exchange in-process --set {settings}", Path(folder))


def _run(name: str, overrides: tuple[str, ...], seed: int) -> Cost:
    scenario = find(name, overrides)
    setup = WorldSetup.of(scenario, seed)
    recording = Recording(scenario, seed, "in-process")
    start_s = time.process_time()
    play(scenario, seed, setup, [recording.observe])
    spent_s = time.process_time() - start_s
    result = recording.finish()
    assert result.map is not None
    assert setup.ground is not None
    steps = result.ticks * result.robots
    return Cost(
        steps / spent_s, spent_s, result.map.log_bytes_per_robot_tick, setup.ground.frame.cells
    )
