"""The `kantor` command."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from kantor_fleet.exits import Exit, fail

if TYPE_CHECKING:
    from kantor_protocol.scenario import Scenario


def run(
    scenario: Annotated[str, tyro.conf.Positional] = "fleet",
    /,
    *,
    seed: int = 0,
    exchange: Literal["in-process", "lockstep", "wall"] = "lockstep",
    speed: float = 1.0,
    out: Path = Path("runs"),
    exact: bool = False,
    exact_every: int = 0,
    chaos: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),  # noqa: A002  the flag is --set
) -> int:
    """Run a mission, with live progress, and leave its record and its picture.

    Args:
        scenario: A packaged name (see `kantor scenarios`) or a TOML file.
        seed: Decides every draw.
        exchange: in-process: one process, as fast as possible. lockstep: a process each, the same
            result. wall: a process each, every robot on its own clock.
        speed: wall only: simulated seconds in a real one.
        out: Where the run folder is made.
        exact: Also compute the exact Wasserstein distance at the end (needs the extra `exact`).
        exact_every: Periods from one exact distance to the next, seconds of work each; not on the wall.
        chaos: A TOML file of [[faults]] that are added to the scenario's own.
        set: Override a key of the scenario, such as radio.range_m=150; any number of times.
    """
    from kantor_fleet.catalog import find  # noqa: PLC0415  each verb imports what it needs
    from kantor_fleet.run import run as run_mission  # noqa: PLC0415

    _check_seed(seed)
    _check_speed(speed)
    mission = find(scenario, set, chaos)
    every = _exact(mission, exact_every, exchange, exact=exact)
    return run_mission(mission, seed, exchange, speed, out, every)


def worldsim(
    scenario: Annotated[str, tyro.conf.Positional] = "fleet",
    /,
    *,
    listen: str = "tcp/127.0.0.1:7447",
    credentials: Path = Path("credentials"),
    fleet: str | None = None,
    seed: int = 0,
    exchange: Literal["lockstep", "wall"] = "wall",
    speed: float = 1.0,
    start_after: float | None = None,
    out: Path = Path("runs"),
    exact: bool = False,
    chaos: Path | None = None,
    resume: Path | None = None,
    state: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),  # noqa: A002
) -> int:
    """World-sim by hand: host the bus, wait for the roster, run the mission, record it.

    Args:
        scenario: A packaged name or a TOML file.
        listen: Endpoint of the bus: tcp/HOST:PORT for passwords, tls/HOST:PORT for certificates.
        credentials: tcp: folder of the passwords; world-sim writes what is missing. tls: what `kantor keys` has
            made, the folder or world-sim's file.
        fleet: Name of the fleet in every key, `kantor` by default; certificates are of a fleet already.
        seed: Decides every draw.
        exchange: lockstep: step by step together. wall: every robot on its own clock.
        speed: wall only: simulated seconds in a real one.
        start_after: Seconds after which to start without whoever is missing; by default never.
        out: Where the run folder is made.
        exact: Also compute the exact Wasserstein distance at the end (needs the extra `exact`).
        chaos: A TOML file of [[faults]] that are added to the scenario's own.
        resume: The folder of a run that was cut short: go on with its mission. Participants that wait
            for it come back by themselves; give the same --listen, --credentials and --fleet.
        state: A folder in which it notes its run. Started again with it on the same machine (or in the same
            container), it goes on with that run if it was cut short.
        set: Override a key of the scenario.
    """
    from kantor_fleet.by_hand import go_on_by_hand, host_by_hand, resume_by_hand  # noqa: PLC0415
    from kantor_fleet.catalog import find  # noqa: PLC0415

    if resume is not None:
        if set or chaos is not None:
            fail(Exit.USAGE, "--resume: the run has its scenario; leave out --set and --chaos")
        return resume_by_hand(resume, listen, credentials, fleet)
    if state is not None and (code := go_on_by_hand(state, listen, credentials, fleet)) is not None:
        return code
    _check_seed(seed)
    _check_speed(speed)
    mission = find(scenario, set, chaos)
    every = _exact(mission, 0, exchange, exact=exact)
    return host_by_hand(
        mission, seed, exchange, speed, listen, credentials, fleet, start_after, out, every, state
    )


def agent(
    id: Annotated[str, tyro.conf.Positional],  # noqa: A002  the word users know
    /,
    connect: str = "tcp/127.0.0.1:7447",
    credentials: Path = Path("credentials"),
    state: Path = Path("state"),
    patience: float = 60.0,
) -> int:
    """A robot by hand. It needs only an endpoint, its id and its credentials.

    Args:
        id: Which robot, such as r1.
        connect: World-sim's endpoint, tcp/HOST:PORT or tls/HOST:PORT.
        credentials: The credentials folder, or this robot's file.
        state: Folder of its diary; started again with it, the robot goes on where it was.
        patience: Seconds to wait for world-sim to come up.
    """
    from kantor_agent.process import run as run_agent  # noqa: PLC0415
    from kantor_fleet.by_hand import participate_by_hand  # noqa: PLC0415

    if id == "supervisor":
        fail(Exit.USAGE, "supervisor: not a robot; use `kantor supervisor`")
    return participate_by_hand(run_agent, id, connect, credentials, patience, state)


def supervisor(
    connect: str = "tcp/127.0.0.1:7447",
    credentials: Path = Path("credentials"),
    state: Path = Path("state"),
    patience: float = 60.0,
) -> int:
    """The supervisor by hand, for centralized scenarios.

    Args:
        connect: World-sim's endpoint, tcp/HOST:PORT or tls/HOST:PORT.
        credentials: The credentials folder, or the supervisor's file.
        state: Folder of its diary.
        patience: Seconds to wait for world-sim to come up.
    """
    from kantor_fleet.by_hand import participate_by_hand  # noqa: PLC0415
    from kantor_supervisor.process import run as run_supervisor  # noqa: PLC0415

    return participate_by_hand(run_supervisor, "supervisor", connect, credentials, patience, state)


def site(
    name: Annotated[str, tyro.conf.Positional],
    /,
    connect: str = "tls/127.0.0.1:7447",
    listen: str = "tls/0.0.0.0:7447",
    credentials: Path = Path("keys"),
    patience: float = 60.0,
) -> int:
    """The router of a place: its robots connect to it, and it connects to world-sim.

    It speaks for its own robots only, those that `kantor keys --site` has put behind it, and keeps nothing.

    Args:
        name: Which site, such as north.
        connect: World-sim's endpoint, tls/HOST:PORT.
        listen: Endpoint for the site's robots.
        credentials: The folder of identities, or this site's file.
        patience: Seconds to wait for world-sim to come up.
    """
    from kantor_fleet.site import serve  # noqa: PLC0415

    return serve(name, connect, listen, credentials, patience)


def sweep(
    scenario: Annotated[str, tyro.conf.Positional] = "fleet",
    /,
    *,
    vary: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    seeds: str = "0:20",
    jobs: int | None = None,
    cluster: str | None = None,
    out: Path | None = None,
    format: Literal["csv", "parquet"] = "csv",  # noqa: A002  the word users know
    plot: str | None = None,
    exact: bool = False,
    retry_failed: bool = False,
    chaos: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),  # noqa: A002
) -> int:
    """Run many seeds of many variants: a table, a summary and a plot.

    Every variant has the same seeds. Finished runs are kept: the same command goes on where it was
    stopped, and a wider one runs only what is new.

    Args:
        scenario: A packaged name or a TOML file.
        vary: A key and its values, such as radio.range_m=50,100,200; any number of times: the product.
        seeds: 0:50 (without 50), 7, or 1,4,9.
        jobs: Processes, by default one for each core; with --cluster slurm the number of Slurm jobs.
        cluster: Run on the Dask scheduler at this address, or in jobs of `slurm`.
        out: Where everything is kept; sweeps/<scenario> by default.
        format: Of the table.
        plot: The column that plot.png shows.
        exact: Also compute the exact Wasserstein distance at the end (needs the extra `exact`).
        retry_failed: Run again what has failed.
        chaos: A TOML file of [[faults]] that are added to the scenario's own.
        set: Override a key in every variant.
    """
    from kantor_fleet.pools import pool  # noqa: PLC0415
    from kantor_fleet.sweep.plan import plan  # noqa: PLC0415
    from kantor_fleet.sweep.run import Order  # noqa: PLC0415
    from kantor_fleet.sweep.run import sweep as run_sweep  # noqa: PLC0415

    planned = plan(scenario, vary, seeds, set, chaos, exact=exact)
    for variant in planned.variants:
        _exact(variant.scenario, 0, "in-process", exact=exact)
    folder = out or Path("sweeps") / planned.name
    order = Order(planned, folder, format, plot, retry_failed)
    return run_sweep(order, pool(jobs, cluster))


def campaign(
    *,
    seeds: str | None = None,
    jobs: int | None = None,
    minutes: float | None = None,
    out: Path = Path("campaign"),
    replay: int | None = None,
    processes: bool = False,
    speed: float = 8.0,
    storm: float = 40.0,
) -> int:
    """Draw missions full of faults, seed by seed, and judge every event, until a rule breaks.

    The first violation ends it: its seed, the command that replays it, and the smallest scenario that
    shows it are printed. Finished missions are kept: the same command goes on where it was stopped.
    Exit code 1 for a violation, and from 500 missions on for a fault that never struck or a rare
    situation that was never seen.

    With --processes missions run one after the other on real processes over the bus, under real signals:
    robots, the supervisor and world-sim are killed and frozen. The first violation keeps its run folder.
    Exit code 1 too if restarts are slow to rejoin, or memory is not flat.

    Args:
        seeds: How many, from 0 on; or 500:1000 (without 1000). By default 2000; with --processes 18, or as
            many as there is time for.
        jobs: Processes, by default one for each core; not with --processes.
        minutes: Real time after which no further mission begins.
        out: Where campaign.jsonl is kept, and what is found.
        replay: Run the mission of this seed alone, and leave its scenario and its record.
        processes: On real processes over the bus.
        speed: With --processes: simulated seconds in a real one.
        storm: With --processes: real seconds of each mission in which anything may go wrong.
    """
    from kantor_fleet.campaign.run import numbered  # noqa: PLC0415

    if replay is not None:
        _check_seed(replay)
    if minutes is not None and not minutes > 0.0:
        fail(Exit.USAGE, f"--minutes {minutes:g}: give a time above 0")
    if processes:
        from kantor_fleet.campaign import processes as on_processes  # noqa: PLC0415

        _check_speed(speed)
        if not 10.0 <= storm <= 600.0:
            fail(Exit.USAGE, f"--storm {storm:g}: give 10 to 600 seconds")
        terms = on_processes.Terms(speed, storm)
        if replay is not None:
            return on_processes.replay(replay, out, terms)
        drawn = numbered(seeds or ("18" if minutes is None else "1000"))
        return on_processes.soak(on_processes.Soak(drawn, out, terms, minutes))

    from kantor_fleet.campaign.mission import attempt  # noqa: PLC0415
    from kantor_fleet.campaign.run import Order  # noqa: PLC0415
    from kantor_fleet.campaign.run import campaign as run_campaign  # noqa: PLC0415
    from kantor_fleet.campaign.run import replay as replay_mission  # noqa: PLC0415
    from kantor_fleet.pools import pool  # noqa: PLC0415

    if replay is not None:
        return replay_mission(replay, out)
    order = Order(numbered(seeds or "2000"), out, minutes)
    return run_campaign(order, pool(jobs, work=attempt))


def scenarios(
    action: Annotated[Literal["list", "show"], tyro.conf.Positional] = "list",
    name: Annotated[str, tyro.conf.Positional] = "fleet",
    /,
) -> int:
    """List the packaged scenarios, or show one as TOML.

    Args:
        action: list, or show.
        name: Which one to show.
    """
    from kantor_fleet.catalog import find, names, path_of  # noqa: PLC0415

    if action == "show":
        print(path_of(name).read_text(encoding="utf-8"), end="")
        return Exit.DONE
    width = max(map(len, names()))
    for known in names():
        print(f"{known:<{width}}  {find(known).summary}")
    return Exit.DONE


def verify(run: Annotated[Path, tyro.conf.Positional], /) -> int:
    """Execute a recorded run again and compare; exit code 1 if anything differs.

    A deterministic run is executed anew from its scenario and seed. A wall run is replayed robot by
    robot from the inboxes that it recorded.

    Args:
        run: A run folder.
    """
    from kantor_fleet.verify import verify as verify_run  # noqa: PLC0415

    return verify_run(run)


def reproduce(
    figure: Annotated[
        Literal[
            "fig4",
            "fig5",
            "fig6",
            "fig7",
            "fig8",
            "fig9",
            "all",
            "burgard-fig8",
            "kme-fig6",
            "kme-fig7",
            "kme-fig8",
            "kme-all",
            "resilience",
        ],
        tyro.conf.Positional,
    ] = "all",
    /,
    *,
    runs: int | None = None,
    jobs: int | None = None,
    out: Path = Path("reproduced"),
) -> int:
    """Run a paper's experiments, draw its figures, and hold our numbers against the published ones.

    Leaves a PNG, a PDF and a CSV for each figure, and verdicts.csv. Exit code 1 if a claim is missed.
    Figures of explored maps keep finished runs in runs.jsonl: the same command goes on where it was
    stopped, and one figure uses what another has run.

    Args:
        figure: fig4 to fig9 are Kabir & Lee's, section VI, and all stands for these six. burgard-fig8:
            coordinated frontiers. kme-fig6 to kme-fig8: exploration by K-means beside three others;
            kme-all: the same over all 630 configurations.
        runs: Runs for each setting; by default as many as in the paper (fig6: 50, fig9: 10, kme-*: 15),
            burgard-fig8: 20. kme-all: how many of the configurations, evenly spread over maps, starts and
            teams.
        jobs: Processes; by default one for each core.
        out: Where the figures go.
    """
    from kantor_fleet.pools import pool  # noqa: PLC0415
    from kantor_fleet.reproduce import papers  # noqa: PLC0415
    from kantor_fleet.reproduce import reproduce as reproduce_figures  # noqa: PLC0415
    from kantor_fleet.reproduce.flights import fly  # noqa: PLC0415

    if runs is not None and runs < 2:
        fail(Exit.USAGE, f"--runs {runs}: give at least 2, an interval needs them")
    return reproduce_figures(papers.figures(figure), runs, pool(jobs, work=fly), out)


def tap(
    connect: str = "tcp/127.0.0.1:7447",
    credentials: Path = Path("credentials"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    count: int = 0,
    patience: float = 60.0,
) -> int:
    """Print what goes over the bus, decoded; it reads and never writes.

    Args:
        connect: World-sim's endpoint, tcp/HOST:PORT or tls/HOST:PORT.
        credentials: The credentials folder, or the observer's file.
        only: Kinds to print: pose, weights, tx, rx, world; by default all.
        count: Stop after so many messages; 0: never.
        patience: Seconds to wait for world-sim to come up.
    """
    from kantor_fleet.tap import tap as tap_bus  # noqa: PLC0415

    return tap_bus(connect, credentials, frozenset(only), count, patience)


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

    Beside it come `runs/`, and `.env` with the user that runs the containers.

    Args:
        robots: How many.
        supervisor: Have a supervisor as well, in the profile `centralized`.
        isolated: Each robot on a network of its own with world-sim.
        scenario: A packaged name, or /runs/FILE.toml for a file in the run folder.
        hub: The endpoint of a world-sim elsewhere, tls/HOST:PORT; then only the robots are in the file.
        out: The file.
        set: Override a key of the scenario.
    """
    from kantor_fleet.compose import Order  # noqa: PLC0415
    from kantor_fleet.compose import compose as write  # noqa: PLC0415

    return write(Order(robots, supervisor, isolated, scenario, set, hub), out)


def chaos(
    where: Annotated[Literal["docker"], tyro.conf.Positional],
    storm: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    project: str = "kantor",
    patience: float = 120.0,
) -> int:
    """Kill, pause and cut off containers of a running fleet by a schedule, and check the record afterwards.

    Exit code 1 if the mission was not met, a rule was broken, or world-sim did not see what was done.

    Args:
        where: docker: a compose project on this machine's engine.
        storm: A TOML file of [[faults]]: kill, pause, and partition with shape "isolate"; times of the mission.
        project: Name of the compose project.
        patience: Seconds to wait for the mission to begin.
    """
    from kantor_fleet.chaos import chaos_docker  # noqa: PLC0415

    del where
    return chaos_docker(storm, project, patience)


def keys(
    fleet: Annotated[str, tyro.conf.Positional],
    /,
    *,
    robots: int = 0,
    supervisor: bool = False,
    host: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    site: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    days: int = 365,
    renew: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    revoke: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    list: bool = False,  # noqa: A002  the flag is --list
    out: Path = Path("keys"),
) -> int:
    """Make a fleet's certificates: its private authority, once, and a file for each member.

    Run again it keeps what there is and adds what is missing. Hand each file to whoever runs that member, and to
    nobody else; authority.toml stays. What has changed in the register reaches world-sim with worldsim.toml.

    Args:
        fleet: Name of the fleet in every key.
        robots: Robots r1 to r<robots>; those that there are stay.
        supervisor: Also the supervisor.
        host: A name or an address by which others reach world-sim, or a site's router: north=10.0.0.5. Any number
            of times. Each has localhost, 127.0.0.1, ::1 and its id anyway.
        site: A site and the robots that stand behind it, such as north=r1,r2,r3; any number of times.
        days: How long the new certificates count.
        renew: Make a new certificate for this member; the old one ceases to count. Any number of times.
        revoke: This member's certificate ceases to count. Any number of times.
        list: Say which certificates there are, and until when they count; nothing is made.
        out: The folder.
    """
    from kantor_fleet.authority import Wanted, issue, listing, today  # noqa: PLC0415

    if list:
        lines = listing(out, fleet, today())
    else:
        wanted = Wanted(fleet, robots, supervisor, host, site, days, renew, revoke)
        lines = issue(out, wanted, today())
    print("\n".join(lines))
    return Exit.DONE


VERBS: dict[str, Callable[..., int]] = {
    "run": run,
    "worldsim": worldsim,
    "agent": agent,
    "supervisor": supervisor,
    "site": site,
    "sweep": sweep,
    "campaign": campaign,
    "scenarios": scenarios,
    "verify": verify,
    "reproduce": reproduce,
    "tap": tap,
    "compose": compose,
    "chaos": chaos,
    "keys": keys,
}


def main() -> None:
    """Entry point: one verb, one exit code, no traceback for what a user can mend."""
    from kantor_protocol.bus import BusError  # noqa: PLC0415
    from kantor_protocol.credentials import CredentialsError  # noqa: PLC0415
    from kantor_protocol.scenario import ScenarioError  # noqa: PLC0415

    try:
        code: int = tyro.extras.subcommand_cli_from_dict(
            VERBS,
            prog="kantor",
            description="Fleets of robot processes on the Zenoh bus that explore together.",
            args=_spread(sys.argv[1:]),
        )
    except (ScenarioError, CredentialsError) as error:
        fail(Exit.USAGE, str(error))
    except BusError as error:
        fail(Exit.UNREACHABLE, str(error))
    except BrokenPipeError:
        sys.stderr.close()
        code = Exit.DONE
    except OSError as error:
        fail(Exit.USAGE, f"{error.filename or 'file'}: {error.strerror or error}")
    except KeyboardInterrupt:
        code = Exit.INTERRUPTED
    sys.exit(code)


def _check_seed(seed: int) -> None:
    if not 0 <= seed < 2**63:
        fail(Exit.USAGE, f"--seed {seed}: give a whole number from 0 to 2^63 - 1")


def _check_speed(speed: float) -> None:
    if not 0.0 < speed <= 1000.0:
        fail(Exit.USAGE, f"--speed {speed:g}: give a factor above 0, at most 1000")


def _exact(scenario: "Scenario", every: int, exchange: str, *, exact: bool) -> int | None:
    """Periods between exact distances, 0 for the end only, None for none."""
    from kantor_worldsim.exact import AFFORDABLE, available  # noqa: PLC0415

    if not exact and not every:
        return None
    if every < 0:
        fail(Exit.USAGE, f"--exact-every {every}: give a number of periods")
    if every and exchange == "wall":
        fail(Exit.USAGE, "--exact-every: not on the wall, it would hold the relay up; use --exact")
    if not available():
        fail(Exit.USAGE, "--exact: needs POT; pip install 'kantor[exact]'")
    if scenario.energy.points * (scenario.samples.count or 1) > AFFORDABLE:
        fail(Exit.USAGE, "--exact: too many points and samples; at most 4e8 pairs")
    return every


_REPEATED = ("--set", "--vary")


def _spread(arguments: list[str]) -> list[str]:
    """`--set a=1 b=2` as `--set a=1 --set b=2`, and `--vary` likewise."""
    spread: list[str] = []
    flag = None
    for argument in arguments:
        if flag and "=" in argument and not argument.startswith("-") and spread[-1] != flag:
            spread.append(flag)
        elif argument.startswith("-") or spread[-1:] != [flag]:
            flag = argument if argument in _REPEATED else None
        spread.append(argument)
    return spread


if __name__ == "__main__":
    main()
