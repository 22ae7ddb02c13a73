"""`kantor reproduce`: a paper's figures anew, with a verdict beside each published number."""

import csv
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path

from rich.console import Console
from rich.table import Table

from kantor_fleet.counting import RunsView
from kantor_fleet.exits import Exit
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.pools import local
from kantor_fleet.preload import warm_up
from kantor_fleet.reproduce.claims import MISS, UNMATCHED, Verdict
from kantor_fleet.reproduce.flights import Flight, Flights, Setting, fly
from kantor_fleet.reproduce.kabir_lee import FIGURES, Figure
from kantor_worldsim.exact import available

_WIDTH = 160
"""Columns of what is printed into a file or a pipe."""


def reproduce(names: Sequence[str], runs: int | None, jobs: int, out: Path) -> Exit:
    """Fly, judge, draw and tell. Raises OSError."""
    started = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    figures = {name: _affordable(FIGURES[name], runs) for name in names}
    with Interrupts() as interrupts:
        warm_up()
        flights = _fly_all(_orders(figures.values()), jobs, interrupts)
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
    _write_verdicts(out / "verdicts.csv", verdicts)
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


def _fly_all(orders: dict[Setting, int], jobs: int, interrupts: Interrupts) -> Flights:
    cases = {
        setting.case(seed): (setting, seed)
        for setting, count in orders.items()
        for seed in range(count)
    }
    flights: dict[Setting, list[Flight]] = {s: [Flight()] * count for s, count in orders.items()}
    with RunsView(len(cases)) as view, closing(local(cases, jobs, fly)) as pool:
        for done in pool:
            if interrupts():
                break
            if done is not None:
                setting, seed = cases[done[0]]
                flights[setting][seed] = _flight(done[1])
                view.count(done[1].failed)
    return flights


def _flight(outcome: object) -> Flight:
    if isinstance(outcome, Flight):
        return outcome
    return Flight(failed=getattr(outcome, "failed", None) or "lost")


def _first(flights: Flights, figure: Figure) -> Flights:
    """The flights of a figure; another one may have wanted more."""
    return {setting: flights[setting][:count] for setting, count in _settings(figure).items()}


def _write_runs(path: Path, flights: Flights) -> None:
    """Every run behind a figure."""
    names = ("setting", "seed", "detected", "targets", "finished_tick", "first_contact_tick")
    bounds = ("w_ub_start", "w_ub_end", "w_ub_instant_end", "w1_exact")
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow((*names, *bounds))
        for setting, runs in flights.items():
            for seed, flight in enumerate(runs):
                result = flight.result
                assert result is not None
                table.writerow(
                    (
                        setting.text,
                        seed,
                        result.detected,
                        result.targets,
                        result.finished_tick,
                        result.first_contact_tick,
                        result.w_ub_start,
                        result.w_ub.paper,
                        result.w_ub.final_instant,
                        result.w1_exact,
                    )
                )


def _write_verdicts(path: Path, verdicts: Sequence[Verdict]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(Verdict._fields)
        table.writerows(verdicts)


def _print(verdicts: Sequence[Verdict]) -> None:
    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
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
