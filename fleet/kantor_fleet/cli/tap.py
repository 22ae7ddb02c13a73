"""`kantor tap`: its options and their checks."""

from pathlib import Path

import tyro


def tap(
    connect: str = "tcp/127.0.0.1:7447",
    credentials: Path = Path("credentials"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    count: int = 0,
    patience: float = 60.0,
) -> int:
    """Print messages on the bus, decoded; it reads and never writes.

    Args:
        connect: World-sim's endpoint, tcp/HOST:PORT or tls/HOST:PORT.
        credentials: The credentials folder, or the observer's file.
        only: Kinds to print: pose, weights, tx, rx, world; by default all.
        count: Stop after so many messages; 0: no limit.
        patience: Seconds to wait for world-sim.
    """
    from kantor_fleet.processes.tap import tap as tap_bus  # noqa: PLC0415

    return tap_bus(connect, credentials, frozenset(only), count, patience)
