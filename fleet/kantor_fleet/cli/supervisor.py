"""`kantor supervisor`: its options and their checks."""

from pathlib import Path


def supervisor(
    connect: str = "tcp/127.0.0.1:7447",
    credentials: Path = Path("credentials"),
    state: Path = Path("state"),
    patience: float = 60.0,
) -> int:
    """Run the supervisor, for centralized scenarios.

    Args:
        connect: World-sim's endpoint, tcp/HOST:PORT or tls/HOST:PORT.
        credentials: The credentials folder, or the supervisor's file.
        state: Folder of its write-ahead log.
        patience: Seconds to wait for world-sim.
    """
    from kantor_fleet.processes.standalone import participate_standalone  # noqa: PLC0415
    from kantor_supervisor.process import run as run_supervisor  # noqa: PLC0415

    return participate_standalone(
        run_supervisor, "supervisor", connect, credentials, patience, state
    )
