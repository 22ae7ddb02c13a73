"""`kantor campaign`: its options and their checks."""

from pathlib import Path

from kantor_fleet.cli.options import check_seed, check_speed
from kantor_fleet.exits import Exit, fail


def campaign(
    *,
    seeds: str | None = None,
    jobs: int | None = None,
    cluster: str | None = None,
    minutes: float | None = None,
    out: Path = Path("campaign"),
    replay: int | None = None,
    processes: bool = False,
    speed: float = 8.0,
    storm: float = 40.0,
    rejoin: float = 2.0,
    byzantine: bool = False,
) -> int:
    """Draw missions full of faults, seed by seed, and check every event, until a rule is broken.

    The first violation ends it: its seed, the command that replays it, and the smallest scenario that
    shows it are printed. Finished missions are kept: the same command goes on where it was stopped.
    Exit code 1 for a violation, and from 500 missions on for a fault that had no effect or a rare
    event that did not occur.

    With --processes missions run one after the other on real processes over the bus, under real signals:
    robots, the supervisor and world-sim are killed and frozen. The first violation keeps its run folder.
    Exit code 1 too if restarts are slow to rejoin, or memory is not flat.

    Args:
        seeds: Number of seeds, from 0 on; or 500:1000 (without 1000). By default 2000; with --processes 18, or as
            many as there is time for.
        jobs: Number of processes, by default one for each core; with --cluster slurm the number of Slurm jobs; not
            with --processes.
        cluster: Run on the Dask scheduler at this address, or in jobs of `slurm`; not with --processes.
        minutes: Real time after which no further mission begins.
        out: Folder of campaign.jsonl and of violations.
        replay: Run the mission of this seed alone, and leave its scenario and its record.
        processes: On real processes over the bus.
        speed: With --processes: simulated seconds in a real one.
        storm: With --processes: real seconds of each mission in which faults occur.
        rejoin: With --processes: real seconds within which 99 % of the restarts must have rejoined.
        byzantine: With --processes: a robot lies in every mission, and everybody signs. Without, drawn missions have
            liars anyway.
    """
    from kantor_fleet.campaign.run import numbered  # noqa: PLC0415

    if replay is not None:
        check_seed(replay)
    if minutes is not None and not minutes > 0.0:
        fail(Exit.USAGE, f"--minutes {minutes:g}: give a time above 0")
    if processes and cluster is not None:
        fail(
            Exit.USAGE,
            f"--cluster {cluster}: not with --processes, which need this machine; drop one of the two",
        )
    if processes:
        from kantor_fleet.campaign import processes as on_processes  # noqa: PLC0415

        check_speed(speed)
        if not 10.0 <= storm <= 600.0:
            fail(Exit.USAGE, f"--storm {storm:g}: give 10 to 600 seconds")
        if not rejoin > 0.0:
            fail(Exit.USAGE, f"--rejoin {rejoin:g}: give a time above 0")
        terms = on_processes.SoakTerms(speed, storm, byzantine)
        if replay is not None:
            return on_processes.replay(replay, out, terms)
        drawn = numbered(seeds or ("18" if minutes is None else "1000"))
        return on_processes.soak(on_processes.Soak(drawn, out, terms, minutes, rejoin))

    from kantor_fleet.campaign.mission import attempt  # noqa: PLC0415
    from kantor_fleet.campaign.run import CampaignConfig  # noqa: PLC0415
    from kantor_fleet.campaign.run import campaign as run_campaign  # noqa: PLC0415
    from kantor_fleet.campaign.run import replay as replay_mission  # noqa: PLC0415
    from kantor_fleet.execution.pools import pool  # noqa: PLC0415

    if replay is not None:
        return replay_mission(replay, out)
    config = CampaignConfig(numbered(seeds or "2000"), out, minutes)
    return run_campaign(config, pool(jobs, cluster, attempt))
