"""`kantor worldsim`: its options and their checks."""

from pathlib import Path
from typing import Annotated

import tyro

from kantor_fleet.cli.options import (
    ProcessExchange,
    check_seed,
    check_speed,
    exact_period,
    recorded,
)
from kantor_fleet.exits import Exit, fail


def worldsim(
    scenario: Annotated[str, tyro.conf.Positional] = "fleet",
    /,
    *,
    listen: str = "tcp/127.0.0.1:7447",
    credentials: Path = Path("credentials"),
    fleet: str | None = None,
    seed: int = 0,
    exchange: ProcessExchange = "realtime",
    speed: float = 1.0,
    start_after: float | None = None,
    out: Path = Path("runs"),
    exact: bool = False,
    chaos: Path | None = None,
    resume: Path | None = None,
    state: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),  # noqa: A002
) -> int:
    """Run world-sim: host the bus, wait for the roster, run the mission and record it.

    Args:
        scenario: A packaged name or a TOML file.
        listen: Endpoint of the bus: tcp/HOST:PORT for passwords, tls/HOST:PORT for certificates.
        credentials: tcp: folder of the passwords; world-sim writes missing ones. tls: the folder that `kantor keys`
            made, or world-sim's file.
        fleet: Name of the fleet in every key, `kantor` by default; certificates name their fleet.
        seed: Decides every draw.
        exchange: lockstep: all step together, batch by batch. realtime: every robot on its own clock; wall is
            accepted for it.
        speed: Realtime only: simulated seconds in a real second.
        start_after: Seconds after which to start without missing participants; by default never.
        out: Folder in which the run folder is made.
        exact: Also compute the exact Wasserstein distance at the end (needs the extra `exact`).
        chaos: A TOML file of [[faults]] that are added to the scenario's own.
        resume: The folder of a run that was cut short: go on with its mission. Participants that wait
            for it come back by themselves; give the same --listen, --credentials and --fleet.
        state: Folder with a pointer to its run. Started again with it on the same machine (or in the same
            container), it goes on with that run if it was cut short.
        set: Override a key of the scenario.
    """
    from kantor_fleet.processes.standalone import (  # noqa: PLC0415
        go_on_standalone,
        host_standalone,
        resume_standalone,
    )
    from kantor_fleet.scenarios.catalog import find  # noqa: PLC0415

    if resume is not None:
        if set or chaos is not None:
            fail(Exit.USAGE, "--resume: the run has its scenario; leave out --set and --chaos")
        return resume_standalone(resume, listen, credentials, fleet)
    if (
        state is not None
        and (code := go_on_standalone(state, listen, credentials, fleet)) is not None
    ):
        return code
    check_seed(seed)
    check_speed(speed)
    mission = find(scenario, set, chaos)
    every = exact_period(mission, 0, exchange, exact=exact)
    return host_standalone(
        mission,
        seed,
        recorded(exchange),
        speed,
        listen,
        credentials,
        fleet,
        start_after,
        out,
        every,
        state,
    )
