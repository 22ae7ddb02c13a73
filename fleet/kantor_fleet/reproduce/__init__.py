"""`kantor reproduce`: a paper's figures anew, with a verdict beside each published number."""

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from pathlib import Path

from rich.table import Table

from kantor_fleet.counting import RunsView, table_console
from kantor_fleet.exits import Exit
from kantor_fleet.experiment import Case, Outcome
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.pools import Pool
from kantor_fleet.preload import warm_up
from kantor_fleet.reproduce.claims import MISS, UNMATCHED, Verdict
from kantor_fleet.reproduce.flights import Flight, Flights, Setting
from kantor_fleet.reproduce.kabir_lee import FIGURES, Figure
from kantor_fleet.sweep.table import Row, write_csv
from kantor_worldsim.exact import available
from kantor_worldsim.metrics import Result


def reproduce(
    names: Sequence[str], runs: int | None, start: Callable[[Iterable[Case]], Pool], out: Path
) -> Exit:
    """Fly, judge, draw and tell. start: a pool that flies. Raises OSError."""
    started = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    figures = {name: _affordable(FIGURES[name], runs) for name in names}
    with Interrupts() as interrupts:
        warm_up()
        flights = _fly_all(_orders(figures.values()), start, interrupts)
        if interrupts.code is not None:
            print("kantor: interrupted; nothing was written", file=sys.stderr)
            return interrupts.code
    failed = sum(flight.failed is not None for runs in flights.values() for flight in runs)
    if failed:
        print(f"kantor: {failed} runs failed; nothing was written", file=sys.stderr)
        return Exit.NOT_MET
    verdicts = [
        line for name, figure in figures.items() for line in _conclude(name, figure, flights, out)
    ]
    write_csv(out / "verdicts.csv", Verdict._fields, [line._asdict() for line in verdicts])
    _print(verdicts)
    print(f"  {out}/  (figures, numbers and verdicts; {time.monotonic() - started:.0f} s)")
    return Exit.NOT_MET if any(verdict.verdict == MISS for verdict in verdicts) else Exit.DONE


def _conclude(name: str, figure: Figure, flights: Flights, out: Path) -> list[Verdict]:
    """Write the numbers and the picture of a figure, and judge its claims."""
    seen = _first(flights, figure)
    _write_runs(out / f"{name}.csv", seen)
    picture = figure.draw(seen)
    picture.savefig(out / f"{name}.png", dpi=120)
    picture.savefig(out / f"{name}.pdf", metadata={"CreationDate": None})
    return [claim.judge(name, seen) for claim in figure.claims]


def _affordable(figure: Figure, runs: int | None) -> Figure:
    """The figure with as many runs as asked for, without exact distances if there is no solver."""
    exact = available()
    claims = tuple(
        claim for claim in figure.claims if exact or not any(s.exact for s in claim.settings)
    )
    if len(claims) < len(figure.claims):
        print("no exact distances: pip install 'kantor[exact]'", file=sys.stderr)
    return figure._replace(claims=claims, runs=runs or figure.runs)


def _settings(figure: Figure) -> dict[Setting, int]:
    """What a figure needs flown, how often."""
    return {
        setting: min(figure.runs, setting.most)
        for claim in figure.claims
        for setting in claim.settings
    }


def _orders(figures: Iterable[Figure]) -> dict[Setting, int]:
    """Settings by the most runs that a figure wants of them; the long ones first."""
    most: dict[Setting, int] = {}
    for figure in figures:
        for setting, count in _settings(figure).items():
            most[setting] = max(count, most.get(setting, 0))
    return dict(sorted(most.items(), key=lambda item: not item[0].exact))


def _fly_all(
    orders: dict[Setting, int], start: Callable[[Iterable[Case]], Pool], interrupts: Interrupts
) -> Flights:
    cases = {case: setting for setting, count in orders.items() for case in setting.cases(count)}
    flights: dict[Setting, list[Flight]] = {s: [Flight()] * count for s, count in orders.items()}
    with RunsView(len(cases)) as view, closing(start(cases)) as pool:
        for done in pool:
            if interrupts():
                break
            if done is not None:
                case, outcome = done
                flights[cases[case]][case.seed] = _flight(outcome)
                view.count(outcome.failed)
    return flights


def _flight(outcome: Outcome) -> Flight:
    """What a worker made of a case, or, if it died, why there is nothing."""
    return outcome if isinstance(outcome, Flight) else Flight(failed=outcome.failed)


def _first(flights: Flights, figure: Figure) -> Flights:
    """The flights of a figure; another one may have wanted more."""
    return {setting: flights[setting][:count] for setting, count in _settings(figure).items()}


def _write_runs(path: Path, flights: Flights) -> None:
    """Every run behind a figure."""
    rows = [
        _row(setting, seed, flight.result)
        for setting, runs in flights.items()
        for seed, flight in enumerate(runs)
        if flight.result is not None
    ]
    write_csv(path, list(rows[0]), rows)


def _row(setting: Setting, seed: int, result: Result) -> Row:
    return {
        "setting": setting.text,
        "seed": seed,
        "detected": result.detected,
        "targets": result.targets,
        "finished_tick": result.finished_tick,
        "first_contact_tick": result.first_contact_tick,
        "w_ub_start": result.w_ub_start,
        "w_ub_end": result.w_ub.paper,
        "w_ub_instant_end": result.w_ub.final_instant,
        "w1_exact": result.w1_exact,
    }


def _print(verdicts: Sequence[Verdict]) -> None:
    console = table_console()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in ("figure", "claim", "published", "faithful reading", "ours", "verdict"):
        table.add_column(name)
    figure = ""
    for line in verdicts:
        style = "red" if line.verdict == MISS else "yellow" if line.verdict == UNMATCHED else ""
        shown = line.figure if line.figure != figure else ""
        table.add_row(shown, *line[1:5], f"[{style}]{line.verdict}[/]" if style else line.verdict)
        figure = line.figure
    console.print(table)
    print("  ours: median [quartiles] or mean ± 95 % over the runs")
    for line in verdicts:
        if line.why:
            console.print(f"  {line.figure}, {line.claim}: {line.why}", highlight=False)
