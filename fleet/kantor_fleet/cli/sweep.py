"""`kantor sweep`: its options and their checks."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from kantor_fleet.cli.options import exact_period


def sweep(
    scenario: Annotated[str, tyro.conf.Positional] = "fleet",
    /,
    *,
    vary: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    seeds: str = "0:20",
    jobs: int | None = None,
    cluster: str | None = None,
    out: Path | None = None,
    format: Literal["csv", "parquet"] = "csv",  # noqa: A002  the term that users know
    plot: str | None = None,
    exact: bool = False,
    retry_failed: bool = False,
    chaos: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),  # noqa: A002
) -> int:
    """Run many seeds of many variants, and write a table, a summary and a plot.

    Every variant has the same seeds. Finished runs are kept: the same command goes on where it was
    stopped, and a wider one runs only the new runs.

    Args:
        scenario: A packaged name or a TOML file.
        vary: A key and its values, such as radio.range_m=50,100,200; any number of times: the product.
        seeds: 0:50 (without 50), 7, or 1,4,9.
        jobs: Processes, by default one for each core; with --cluster slurm the number of Slurm jobs.
        cluster: Run on the Dask scheduler at this address, or in jobs of `slurm`.
        out: Folder of the results; sweeps/<scenario> by default.
        format: Format of the table.
        plot: The column that plot.png shows.
        exact: Also compute the exact Wasserstein distance at the end (needs the extra `exact`).
        retry_failed: Run failed runs again.
        chaos: A TOML file of [[faults]] that are added to the scenario's own.
        set: Override a key in every variant.
    """
    from kantor_fleet.execution.pools import pool  # noqa: PLC0415
    from kantor_fleet.sweep.plan import plan  # noqa: PLC0415
    from kantor_fleet.sweep.run import SweepConfig  # noqa: PLC0415
    from kantor_fleet.sweep.run import sweep as run_sweep  # noqa: PLC0415

    planned = plan(scenario, vary, seeds, set, chaos, exact=exact)
    for variant in planned.variants:
        exact_period(variant.scenario, 0, "in-process", exact=exact)
    folder = out or Path("sweeps") / planned.name
    config = SweepConfig(planned, folder, format, plot, retry_failed)
    return run_sweep(config, pool(jobs, cluster))
