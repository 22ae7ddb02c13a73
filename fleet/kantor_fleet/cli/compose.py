"""`kantor compose`: its options and their checks."""

from pathlib import Path

import tyro


def compose(
    *,
    robots: int = 5,
    supervisor: bool = False,
    isolated: bool = False,
    scenario: str = "fleet",
    hub: str | None = None,
    out: Path = Path("compose.yaml"),
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),  # noqa: A002
) -> int:
    """Write a compose file for a fleet: world-sim and every robot in a container of its own.

    Beside it are made `runs/`, `keys/`, and `.env` with the user that runs the containers.

    Args:
        robots: Number of robots.
        supervisor: Add a supervisor, in the profile `centralized`.
        isolated: Put each robot on a network of its own with world-sim.
        scenario: A packaged name, or /runs/FILE.toml for a file in the run folder.
        hub: Endpoint of a world-sim elsewhere, tls/HOST:PORT; then only the robots are in the file.
        out: The compose file.
        set: Override a key of the scenario.
    """
    from kantor_fleet.processes.compose import ComposeConfig  # noqa: PLC0415
    from kantor_fleet.processes.compose import compose as write  # noqa: PLC0415

    return write(ComposeConfig(robots, supervisor, isolated, scenario, set, hub), out)
