"""`kantor chaos`: its options and their checks."""

from pathlib import Path
from typing import Annotated, Literal

import tyro


def chaos(
    where: Annotated[Literal["docker"], tyro.conf.Positional],
    storm: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    project: str = "kantor",
    patience: float = 120.0,
) -> int:
    """Kill, pause and disconnect containers of a running fleet on a schedule, and check the record afterwards.

    Exit code 1 if the mission was not met, a rule was broken, or the record does not show an injected fault.

    Args:
        where: docker: a compose project on this machine's engine.
        storm: A TOML file of [[faults]]: kill, pause, and partition with shape "isolate"; with times of the mission.
        project: Name of the compose project.
        patience: Seconds to wait for world-sim to begin the mission.
    """
    from kantor_fleet.processes.chaos import chaos_docker  # noqa: PLC0415

    del where
    return chaos_docker(storm, project, patience)
