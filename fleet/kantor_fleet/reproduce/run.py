"""`kantor reproduce`: run, draw and judge figures, with a verdict beside each published number."""

import csv
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from rich.table import Table as Printed

from kantor_fleet.execution.experiment import Case, Outcome
from kantor_fleet.execution.pools import ClusterError, Pool
from kantor_fleet.exits import Exit
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.report.run_progress import RunProgressView, table_console
from kantor_fleet.reproduce.claims import MISS, UNMATCHED, ClaimVerdict
from kantor_fleet.reproduce.figure import PaperFigure, ResultTable, RunRequests
from kantor_fleet.reproduce.measured_runs import MeasuredRun, MeasuredRuns, Setting
from kantor_fleet.sweep.journal import RunsJournal
from kantor_fleet.sweep.plan import RunKey
from kantor_fleet.sweep.table import Row, write_csv
from kantor_worldsim.observers.metrics.wasserstein_exact import available

RUNS = "runs.jsonl"
"""The journal of figures that take long; every such figure uses the runs of all."""

_OURS = "  ours: median [quartiles], mean ± 95 %, ratio of means [95 %] or geometric mean x÷ 95 % over the runs"

RunsBySetting = Mapping[tuple[Setting, int], MeasuredRun]
"""Runs by setting and seed."""


def reproduce(
    figures: Mapping[str, PaperFigure],
    runs: int | None,
    start: Callable[[Iterable[Case]], Pool],
    out: Path,
) -> Exit:
    """Run what the figures need, draw them, and print a verdict for each claim; the exit code.

    runs: for each setting; by default as many as each figure says. start: the pool that runs the cases.
    Raises SweepError, OSError.
    """
    started_s = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    figures = {name: _affordable(figure, runs) for name, figure in figures.items()}
    requests = _requests(figures.values())
    with ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        kept = any(figure.kept for figure in figures.values())
        journal = stack.enter_context(RunsJournal(out / RUNS, MeasuredRun)) if kept else None
        measured: dict[tuple[Setting, int], MeasuredRun] = {}
        try:
            _run_all(requests, start, interrupts, journal, measured)
        except ClusterError as error:
            print(f"kantor: {error}; {_resumable(requests, measured, journal)}", file=sys.stderr)
            return Exit.UNREACHABLE
        if interrupts.code is not None:
            print(
                f"kantor: interrupted; {_resumable(requests, measured, journal)}", file=sys.stderr
            )
            return interrupts.code
    broken = [run for run in measured.values() if run.failed is not None]
    failed = [run for run in broken if run.result is None or journal is None]
    if failed:
        again = "; the same command runs these again" if journal else ""
        print(f"kantor: {len(failed)} runs failed; nothing was written{again}", file=sys.stderr)
        return Exit.NOT_MET
    verdicts = [
        line for name, figure in figures.items() for line in _conclude(name, figure, measured, out)
    ]
    _write_verdicts(out / "verdicts.csv", verdicts)
    _print(verdicts)
    if broken:
        print(f"  {len(broken)} runs broke a rule and are counted nevertheless: {broken[0].failed}")
    print(f"  {out}/  (figures, numbers and verdicts; {time.monotonic() - started_s:.0f} s)")
    missed = any(verdict.verdict == MISS for verdict in verdicts)
    return Exit.NOT_MET if missed or broken else Exit.DONE


def _resumable(requests: RunRequests, measured: RunsBySetting, journal: RunsJournal | None) -> str:
    """How much of interrupted figures is kept."""
    if journal is None:
        return "nothing was written"
    total = sum(map(len, requests.values()))
    return f"{len(measured)} of {total} runs are done; the same command goes on from there"


def _conclude(
    name: str, figure: PaperFigure, measured: RunsBySetting, out: Path
) -> list[ClaimVerdict]:
    """Write the numbers and the picture of a figure, and judge its claims."""
    by_setting = {
        setting: [measured[setting, seed] for seed in seeds]
        for setting, seeds in figure.requests().items()
    }
    _write_runs(out / f"{name}.csv", figure, by_setting)
    picture = figure.draw(by_setting)
    picture.savefig(out / f"{name}.png", dpi=120)
    picture.savefig(out / f"{name}.pdf", metadata={"CreationDate": None})
    if figure.table is not None:
        table = figure.table(by_setting)
        write_csv(out / f"{name}-table.csv", list(table.rows[0]), table.rows)
        _print_table(table)
    return [claim.judge(name, by_setting) for claim in figure.claims]


def _affordable(figure: PaperFigure, runs: int | None) -> PaperFigure:
    """The figure with as many runs as asked for, without exact distances if there is no solver."""
    exact = available()
    claims = tuple(
        claim for claim in figure.claims if exact or not any(s.exact for s in claim.settings)
    )
    if len(claims) < len(figure.claims):
        print("no exact distances: pip install 'kantor[exact]'", file=sys.stderr)
    return figure._replace(claims=claims, runs=runs or figure.runs)


def _requests(figures: Iterable[PaperFigure]) -> RunRequests:
    """All seeds that any figure needs of a setting; the long settings first."""
    wanted: dict[Setting, set[int]] = {}
    for figure in figures:
        for setting, seeds in figure.requests().items():
            wanted.setdefault(setting, set()).update(seeds)
    return {
        setting: sorted(seeds)
        for setting, seeds in sorted(wanted.items(), key=lambda item: not item[0].exact)
    }


def _run_all(
    requests: RunRequests,
    start: Callable[[Iterable[Case]], Pool],
    interrupts: Interrupts,
    journal: RunsJournal | None,
    measured: dict[tuple[Setting, int], MeasuredRun],
) -> None:
    """Add the runs of the journal, and new ones for the rest, which go into the journal too, if there is one.

    Raises ClusterError.
    """
    left: dict[Case, tuple[Setting, RunKey]] = {}
    for setting, seeds in requests.items():
        for key, case in setting.cases(seeds):
            known = journal.outcomes.get(key) if journal is not None else None
            if isinstance(known, MeasuredRun) and known.result is not None:
                measured[setting, case.seed] = known
            else:
                left[case] = setting, key
    if not left:
        return
    with RunProgressView(len(left)) as view, closing(start(left)) as pool:
        for done in pool:
            if done is not None:
                case, outcome = done
                (setting, key), run = left[case], _measured(outcome)
                measured[setting, case.seed] = run
                if journal is not None:
                    journal.add(key, run)
                view.count(outcome.failed)
            if interrupts():
                break


def _measured(outcome: Outcome) -> MeasuredRun:
    """The outcome of a worker; of a worker that died it has only the reason."""
    return outcome if isinstance(outcome, MeasuredRun) else MeasuredRun(failed=outcome.failed)


def _write_verdicts(path: Path, verdicts: Sequence[ClaimVerdict]) -> None:
    """Write verdicts, and keep those of other figures that are in the file already."""
    judged = {line.figure for line in verdicts}
    before = _rows_of(path)
    kept = [row for row in before if row["figure"] not in judged]
    write_csv(path, ClaimVerdict._fields, [*kept, *(line._asdict() for line in verdicts)])


def _rows_of(path: Path) -> list[Row]:
    """The rows of a table of verdicts; none if there is no such file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return rows if all(tuple(row) == ClaimVerdict._fields for row in rows) else []


def _write_runs(path: Path, figure: PaperFigure, by_setting: MeasuredRuns) -> None:
    """Write a row for every run behind a figure."""
    rows = [
        {"setting": setting.text, "seed": run.result.seed, **figure.row(run.result)}
        for setting, runs in by_setting.items()
        for run in runs
        if run.result is not None
    ]
    write_csv(path, list(rows[0]), rows)


def _print_table(table: ResultTable) -> None:
    printed = Printed(box=None, pad_edge=False, header_style="bold")
    for name in table.shown[0]:
        printed.add_column(name)
    for row in table.shown:
        printed.add_row(*row.values())
    console = table_console()
    console.print(f"  {table.title}", markup=False, highlight=False)
    console.print(printed)


def _print(verdicts: Sequence[ClaimVerdict]) -> None:
    console = table_console()
    table = Printed(box=None, pad_edge=False, header_style="bold")
    for name in ("figure", "claim", "published", "faithful reading", "ours", "verdict"):
        table.add_column(name)
    figure = ""
    for line in verdicts:
        style = "red" if line.verdict == MISS else "yellow" if line.verdict == UNMATCHED else ""
        shown = line.figure if line.figure != figure else ""
        table.add_row(shown, *line[1:5], f"[{style}]{line.verdict}[/]" if style else line.verdict)
        figure = line.figure
    console.print(table)
    print(_OURS)
    for (figure, why), claims in _reasons(verdicts).items():
        which = claims[0] if len(claims) == 1 else f"{len(claims)} claims"
        console.print(f"  {figure}, {which}: {why}", highlight=False)


def _reasons(verdicts: Sequence[ClaimVerdict]) -> dict[tuple[str, str], list[str]]:
    """The claims by figure and reason."""
    claims: dict[tuple[str, str], list[str]] = {}
    for line in verdicts:
        if line.why:
            claims.setdefault((line.figure, line.why), []).append(line.claim)
    return claims
