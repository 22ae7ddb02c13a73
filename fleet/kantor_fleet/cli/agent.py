"""`kantor agent`: its options and their checks."""

from pathlib import Path
from typing import Annotated

import tyro

from kantor_fleet.exits import Exit, fail


def agent(
    id: Annotated[str, tyro.conf.Positional],  # noqa: A002  the term that users know
    /,
    connect: str = "tcp/127.0.0.1:7447",
    credentials: Path = Path("credentials"),
    state: Path = Path("state"),
    patience: float = 60.0,
) -> int:
    """Run one robot. It needs only an endpoint, its id and its credentials.

    Args:
        id: Which robot, such as r1.
        connect: World-sim's endpoint, tcp/HOST:PORT or tls/HOST:PORT.
        credentials: The credentials folder, or this robot's file.
        state: Folder of its write-ahead log; started again with it, the robot goes on where it was.
        patience: Seconds to wait for world-sim.
    """
    from kantor_agent.process import run as run_agent  # noqa: PLC0415
    from kantor_fleet.processes.standalone import participate_standalone  # noqa: PLC0415

    if id == "supervisor":
        fail(Exit.USAGE, "supervisor: not a robot; use `kantor supervisor`")
    return participate_standalone(run_agent, id, connect, credentials, patience, state)
