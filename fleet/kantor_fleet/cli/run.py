"""`kantor run`: its options and their checks."""

from pathlib import Path
from typing import Annotated

import tyro

from kantor_fleet.cli.options import AnyExchange, check_seed, check_speed, exact_period, recorded


def run(
    scenario: Annotated[str, tyro.conf.Positional] = "fleet",
    /,
    *,
    seed: int = 0,
    exchange: AnyExchange = "lockstep",
    speed: float = 1.0,
    out: Path = Path("runs"),
    exact: bool = False,
    exact_every: int = 0,
    chaos: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),  # noqa: A002  the flag is --set
) -> int:
    """Run a mission with live progress, and leave its record and its picture.

    Args:
        scenario: A packaged name (see `kantor scenarios`) or a TOML file.
        seed: Decides every draw.
        exchange: in-process: one process, as fast as possible. lockstep: a process each, the same
            result. realtime: a process each, every robot on its own clock; wall is accepted for it.
        speed: Realtime only: simulated seconds in a real second.
        out: Folder in which the run folder is made.
        exact: Also compute the exact Wasserstein distance at the end (needs the extra `exact`).
        exact_every: Periods from one exact distance to the next, seconds of work each; not in realtime.
        chaos: A TOML file of [[faults]] that are added to the scenario's own.
        set: Override a key of the scenario, such as radio.range_m=150; any number of times.
    """
    from kantor_fleet.processes.mission import run as run_mission  # noqa: PLC0415
    from kantor_fleet.scenarios.catalog import find  # noqa: PLC0415  each verb imports what it needs

    check_seed(seed)
    check_speed(speed)
    mission = find(scenario, set, chaos)
    every = exact_period(mission, exact_every, exchange, exact=exact)
    return run_mission(mission, seed, recorded(exchange), speed, out, every)
