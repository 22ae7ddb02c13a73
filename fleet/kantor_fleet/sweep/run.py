"""`kantor sweep`: runs the plan, resumes where it was stopped, and writes the tables."""

import difflib
import importlib.util
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

from kantor_fleet.execution.experiment import Case
from kantor_fleet.execution.pools import ClusterError, Pool
from kantor_fleet.exits import Exit, warn
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.report.progress import printable
from kantor_fleet.report.run_progress import RunProgressView, table_console
from kantor_fleet.sweep import summary, table
from kantor_fleet.sweep.journal import RunsJournal
from kantor_fleet.sweep.plan import RunKey, SweepError, SweepPlan
from kantor_fleet.sweep.table import SweepRun
from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.storage.drafts import replace

RUNS = "runs.jsonl"
PLAN = "sweep.json"
TIMINGS = "timings.csv"
SUMMARY = "summary.csv"
PLOT = "plot.png"

Format = Literal["csv", "parquet"]


class SweepConfig(NamedTuple):
    """A sweep and the form of its results."""

    plan: SweepPlan
    folder: Path
    format: Format = "csv"
    plot: str | None = None
    """A measure; by default the first of the main ones that varies."""
    retry_failed: bool = False


def sweep(config: SweepConfig, start: Callable[[Iterable[Case]], Pool]) -> Exit:
    """Run what is missing in the journal and write the tables; the exit code.

    start: the pool that runs the cases. Raises SweepError before anything is written; OSError.
    """
    _check(config)
    plan = config.plan
    warn(plan.doubts())
    with Interrupts() as interrupts, RunsJournal(config.folder / RUNS) as journal:
        _write_plan(config)
        left = {case: key for key, case in plan.cases() if _is_due(config, journal, key)}
        code = _run(left, journal, start, interrupts)
        runs = table.finished(plan, journal.outcomes)
        if runs:
            _conclude(config, runs)
    total = len(plan.variants) * len(plan.seeds)
    if len(runs) < total and (runs or interrupts()):
        print(f"kantor: {len(runs)} of {total} runs are done; the same command goes on from there")
    return code or _verdict(runs)


def _check(config: SweepConfig) -> None:
    if config.plot is not None and config.plot not in table.MEASURES:
        near = difflib.get_close_matches(config.plot, table.MEASURES, 1)
        known = f"did you mean {near[0]}?" if near else f"known: {', '.join(table.MEASURES)}"
        raise SweepError(f"--plot {config.plot}: no such measure; {known}")
    if config.format == "parquet" and importlib.util.find_spec("pyarrow") is None:
        raise SweepError("--format parquet: needs PyArrow; pip install 'kantor[parquet]'")


def _is_due(config: SweepConfig, journal: RunsJournal, key: RunKey) -> bool:
    outcome = journal.outcomes.get(key)
    return outcome is None or (outcome.failed is not None and config.retry_failed)


def _run(
    left: Mapping[Case, RunKey],
    journal: RunsJournal,
    start: Callable[[Iterable[Case]], Pool],
    interrupts: Interrupts,
) -> Exit | None:
    """Run cases into the journal; the exit code if that was cut short."""
    if not left:
        return None
    with RunProgressView(len(left)) as view, closing(start(left)) as pool:
        view.note("starting workers (the first time, kernels are compiled: about half a minute)")
        try:
            for done in pool:
                if done is not None:
                    case, outcome = done
                    journal.add(left[case], outcome)
                    view.count(outcome.failed)
                if interrupts():
                    break
        except ClusterError as error:
            print(f"kantor: {error}", file=sys.stderr)
            return Exit.UNREACHABLE
    return interrupts.code


def _verdict(runs: Iterable[SweepRun]) -> Exit:
    sound = all(run.outcome.result and not run.outcome.result.violations for run in runs)
    return Exit.DONE if sound else Exit.NOT_MET


def _conclude(config: SweepConfig, runs: Sequence[SweepRun]) -> None:
    """Write the tables and the picture, and print the main measures."""
    from kantor_fleet.sweep.plot import draw  # noqa: PLC0415  matplotlib is slow to import

    plan, folder = config.plan, config.folder
    lines = summary.summarize(plan, runs)
    _write_tables(config, runs, lines)
    main = summary.varying(runs, summary.MAIN) or summary.MAIN
    shown = list(dict.fromkeys([config.plot, *main] if config.plot else main))
    console = table_console()
    for measure in shown:
        console.print(summary.table_of(plan, lines, measure), markup=False)
    _print_failures(runs)
    draw(plan, runs, lines, shown[0], folder / PLOT)
    print(f"  {folder}/  ({', '.join(sorted(path.name for path in folder.iterdir()))})")


def _write_tables(
    config: SweepConfig, runs: Sequence[SweepRun], lines: Sequence[summary.SummaryRow]
) -> None:
    plan, folder = config.plan, config.folder
    whole = table.rows(plan, runs)
    if config.format == "parquet":
        table.write_parquet(folder / "table.parquet", plan, whole)
        (folder / "table.csv").unlink(missing_ok=True)  # it may be of another plan
    else:
        table.write_csv(folder / "table.csv", list(table.columns(plan)), whole)
        (folder / "table.parquet").unlink(missing_ok=True)
    times = table.timings(plan, runs)
    table.write_csv(folder / TIMINGS, list(times[0]), times)
    table.write_csv(folder / SUMMARY, summary.columns(plan), summary.rows(plan, lines))


def _write_plan(config: SweepConfig) -> None:
    """Write the plan, with every scenario resolved."""
    plan = config.plan
    tree = {
        "seeds": plan.seeds,
        "exact": plan.exact,
        "variants": [
            {
                "varied": dict(zip(plan.keys, variant.values, strict=True)),
                "digest": variant.digest,
                "inputs": msgspec.to_builtins(variant.inputs),
                "scenario": to_tree(variant.scenario),
            }
            for variant in plan.variants
        ],
    }
    text = msgspec.json.format(msgspec.json.encode(tree), indent=2)
    replace(config.folder / PLAN, lambda draft: draft.write_bytes(text + b"\n"))


def _print_failures(runs: Iterable[SweepRun]) -> None:
    """Print the reasons of failed runs, each once, and the number of runs that broke a rule."""
    reasons = Counter(run.outcome.failed for run in runs if run.outcome.failed is not None)
    for reason, times in reasons.most_common():
        print(f"  {times} failed: {printable(reason)}")
    if reasons:
        print("  --retry-failed runs these again")
    broken = [run for run in runs if run.outcome.result and run.outcome.result.violations]
    if broken:
        print(f"  {len(broken)} runs with VIOLATIONS; the column `complaints` names them")
