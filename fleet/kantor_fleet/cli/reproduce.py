"""`kantor reproduce`: its options and their checks."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from kantor_fleet.exits import Exit, fail


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
    cluster: str | None = None,
    out: Path = Path("reproduced"),
) -> int:
    """Run a paper's experiments, draw its figures, and compare the results with the published numbers.

    Leaves a PNG, a PDF and a CSV for each figure, and verdicts.csv. Exit code 1 if a claim is missed.
    Figures on maps, and `resilience`, keep finished runs in runs.jsonl: the same command goes on where it was
    stopped, and one figure uses the runs of another.

    Args:
        figure: fig4 to fig9 are Kabir & Lee's, section VI, and all stands for these six. burgard-fig8:
            coordinated frontiers. kme-fig6 to kme-fig8: exploration by K-means and three other planners;
            kme-all: the same over all 630 configurations. resilience: quality under faults.
        runs: Runs for each setting; by default as many as in the paper (fig6: 50, fig9: 10, kme-*: 15),
            burgard-fig8: 20. kme-all: how many of the configurations, evenly spread over maps, starts and
            teams.
        jobs: Processes; by default one for each core; with --cluster slurm the number of Slurm jobs.
        cluster: Run on the Dask scheduler at this address, or in jobs of `slurm`.
        out: Folder of the figures.
    """
    from kantor_fleet.execution.pools import pool  # noqa: PLC0415
    from kantor_fleet.reproduce import papers  # noqa: PLC0415
    from kantor_fleet.reproduce.measured_runs import run_measured  # noqa: PLC0415
    from kantor_fleet.reproduce.run import reproduce as reproduce_figures  # noqa: PLC0415

    if runs is not None and runs < 2:
        fail(Exit.USAGE, f"--runs {runs}: give at least 2, an interval needs them")
    start = pool(jobs, cluster, run_measured)
    return reproduce_figures(papers.figures(figure), runs, start, out)
