"""Two revisions beside each other: the same commands in turn, and the ratio of each figure.

    python benchmarks/compare.py REVISION [--with REVISION] [--rounds 5] [--only NAME ...]

Each revision is checked out into a folder of its own below --out, with a virtual environment and a cache of kernels, so
that neither warms the other; what is not committed is not measured. A second call finds both again. Commands are what a
user types, so that they exist in every revision. Figures are medians over rounds in which the revisions take turns, and a
ratio is the median of the ratios of the rounds: above 1 the second revision is better.

Exits with 1 if a figure misses the ratio that is wanted of it against revision 77ef687, for which the targets were set.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from kantor_command import Ran, run_command
from tables import Table, show, verdict

ROOT = Path(__file__).resolve().parents[1]
TARGETS_FROM = "77ef687"
MIB = 1 << 20


class Checkout(NamedTuple):
    """A revision, installed."""

    name: str
    folder: Path

    @property
    def kernels(self) -> Path:
        """The cache of kernels of revisions that keep one outside their own folders."""
        return self.folder / ".kernels"

    def forget_kernels(self) -> None:
        """Begin with empty caches, wherever a revision has them."""
        shutil.rmtree(self.kernels, ignore_errors=True)
        for cached in self.folder.glob("*/kantor_*/**/__pycache__/*.nb[ci]"):
            cached.unlink()


class Figure(NamedTuple):
    """A figure, and how it is measured."""

    name: str
    unit: str
    command: str
    of: Callable[[Ran], float]
    target: float | None = None
    """The ratio that is wanted against TARGETS_FROM; None without one."""
    prepare: Callable[[Checkout], None] = lambda _checkout: None
    rounds: int | None = None
    """By default as many as asked for."""

    @property
    def is_rate(self) -> bool:
        """Whether more is better."""
        return self.unit.endswith("/s")


def _edit_a_planner(checkout: Checkout) -> None:
    """Change a planner's file, as its author does: the last line is a new comment."""
    (planner,) = (checkout.folder / "agent").rglob("transport.py")
    with planner.open("a", encoding="utf-8") as file:
        file.write(f"# {time.time_ns()}\n")


_SIMPLE = "--exchange in-process"
_MANY = "starts.random=true radio.range_m=100 limit_s=20"
FIGURES = (
    Figure("help", "ms", "--help", lambda ran: 1e3 * ran.wall_s, 3.3),
    Figure("scenarios", "ms", "scenarios", lambda ran: 1e3 * ran.wall_s, 3.3),
    Figure("fleet-run", "CPU s", f"run fleet {_SIMPLE}", lambda ran: ran.cpu_s),
    Figure("office-run", "CPU s", f"run office {_SIMPLE}", lambda ran: ran.cpu_s, 3.0),
    Figure("fleet", "steps/s", f"run fleet {_SIMPLE}", lambda ran: ran.steps_per_s, 1.7),
    Figure(
        "100-robots", "steps/s", f"run fleet {_SIMPLE} --set robots.count=100 {_MANY}",
        lambda ran: ran.steps_per_s, 2.0,
    ),
    Figure(
        "100-robots-air", "B", f"run fleet {_SIMPLE} --set robots.count=100 {_MANY}",
        lambda ran: ran.air_bytes, 2.4, rounds=1,
    ),
    Figure(
        "100-robots-memory", "MiB", f"run fleet {_SIMPLE} --set robots.count=100 {_MANY}",
        lambda ran: ran.peak_bytes / MIB, 1.1, rounds=1,
    ),
    Figure(
        "supervisor", "steps/s", f"run paper-centralized {_SIMPLE}",
        lambda ran: ran.steps_per_s, 2.2,
    ),
    Figure("office", "steps/s", f"run office {_SIMPLE}", lambda ran: ran.steps_per_s, 3.5),
    Figure(
        "kmeans", "steps/s", f"run unstructured {_SIMPLE} --set planner=kmeans robots.count=8",
        lambda ran: ran.steps_per_s, 2.7,
    ),
    Figure(
        "lockstep", "steps/s", "run fleet --exchange lockstep --set limit_s=40",
        lambda ran: ran.steps_per_s, 1.6,
    ),
    Figure(
        "campaign", "CPU s", "campaign --seeds 200 --jobs 1", lambda ran: ran.cpu_s, 1.5, rounds=2,
    ),
    Figure(
        "edited", "CPU s", f"run fleet {_SIMPLE} --set limit_s=0.2",
        lambda ran: ran.cpu_s, prepare=_edit_a_planner, rounds=1,
    ),
    Figure(
        "cold", "CPU s", f"run fleet {_SIMPLE} --set limit_s=0.2",
        lambda ran: ran.cpu_s, 4.0, Checkout.forget_kernels, 1,
    ),
)  # fmt: skip


def check_out(revision: str, out: Path) -> Checkout:
    """A revision in a folder of its own, installed; as an earlier call has left it, if it did."""
    commit = _git("rev-parse", "--short=12", f"{revision}^{{commit}}")
    folder = out / commit
    if not (folder / ".venv" / "installed").exists():
        shutil.rmtree(folder, ignore_errors=True)
        _git("clone", "--quiet", "--no-checkout", str(ROOT), str(folder))
        subprocess.run(["git", "checkout", "--quiet", commit], cwd=folder, check=True)
        subprocess.run([sys.executable, "-m", "venv", folder / ".venv"], check=True)
        pip = [folder / ".venv/bin/python", "-m", "pip", "install", "--quiet"]
        environment = os.environ.copy()
        if (limits := folder / "constraints.txt").exists():
            environment.setdefault("PIP_CONSTRAINT", str(limits))
        subprocess.run([*pip, "--editable", "."], cwd=folder, env=environment, check=True)
        (folder / ".venv" / "installed").touch()
    return Checkout(f"{revision} ({commit})" if revision != commit else commit, folder)


def _git(*arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        print(done.stderr.strip(), file=sys.stderr)
        sys.exit(2)
    return done.stdout.strip()


def run(checkout: Checkout, command: str) -> Ran:
    """Run a command of a revision. Ends this program if it fails."""
    runs = checkout.folder / "measured"
    shutil.rmtree(runs, ignore_errors=True)
    runs.mkdir()
    environment = os.environ | {"KANTOR_KERNELS": str(checkout.kernels)}
    environment.pop("PYTHONPATH", None)
    kantor = (str(checkout.folder / ".venv/bin/kantor"),)
    return run_command(command, runs, kantor, environment)


class Compared(NamedTuple):
    """A figure of two revisions."""

    figure: Figure
    values: tuple[list[float], list[float]]
    """One of each round."""

    @property
    def ratio(self) -> float:
        """The median over rounds; above 1 the second revision is better."""
        before, after = self.values if not self.figure.is_rate else self.values[::-1]
        return statistics.median(x / y for x, y in zip(before, after, strict=True))


def compare(
    first: Checkout, second: Checkout, figures: list[Figure], rounds: int
) -> list[Compared]:
    """All figures, the revisions in turn. Figures of one command share its runs."""
    compared = []
    alike: dict[tuple[object, ...], list[Figure]] = {}
    for figure in figures:
        alike.setdefault((figure.command, figure.prepare, figure.rounds), []).append(figure)
    for group in alike.values():
        command, prepare = group[0].command, group[0].prepare
        turns: tuple[list[Ran], list[Ran]] = ([], [])
        for number in range(
            -1, group[0].rounds or rounds
        ):  # the first is no round: it fills caches
            for checkout, runs in zip((first, second), turns, strict=True):
                prepare(checkout)
                ran = run(checkout, command)
                if number >= 0:
                    runs.append(ran)
        for figure in group:
            before, after = ([figure.of(ran) for ran in runs] for runs in turns)
            compared.append(Compared(figure, (before, after)))
            name, ratio = figure.name, compared[-1].ratio
            print(f"  {name}: {ratio:.2f}", file=sys.stderr, flush=True)
    return compared


def table_of(first: Checkout, second: Checkout, compared: list[Compared], *, judged: bool) -> Table:
    """Figures with their ratios. judged: by their targets."""
    rows, met = [], True
    for each in compared:
        figure, target = each.figure, each.figure.target if judged else None
        fine = target is None or each.ratio >= target
        met = met and fine
        rows.append(
            (
                figure.name,
                *(f"{statistics.median(values):,.4g}" for values in each.values),
                figure.unit,
                f"{each.ratio:.2f}",
                "" if target is None else f"{target:g}",
                "" if target is None else verdict(met=fine),
            )
        )
    head = ("figure", first.name, second.name, "unit", "ratio", "target", "")
    return Table("two revisions in turn", head, rows, ("ratio: above 1 the second is better",), met)


def main() -> int:
    """Check out, measure, print; 1 if a target is missed."""
    names = [figure.name for figure in FIGURES]
    parser = argparse.ArgumentParser(description="Two revisions of kantor beside each other.")
    parser.add_argument("revision", help="the first: a commit, tag or branch")
    parser.add_argument("--with", dest="other", default="HEAD", help="the second; by default HEAD")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each")
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--out", type=Path, default=Path("compared"), help="for the checkouts")
    options = parser.parse_args()
    out = options.out.resolve()
    out.mkdir(exist_ok=True)
    first, second = (check_out(each, out) for each in (options.revision, options.other))
    figures = [figure for figure in FIGURES if figure.name in options.only]
    compared = compare(first, second, figures, max(1, options.rounds))
    judged = first.folder.name.startswith(TARGETS_FROM)
    table = table_of(first, second, compared, judged=judged)
    show(table)
    return 0 if table.met else 1


if __name__ == "__main__":
    sys.exit(main())
