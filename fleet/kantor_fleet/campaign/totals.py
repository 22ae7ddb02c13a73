"""Totals of a campaign: missions run, faults injected, rare situations seen."""

from collections import Counter
from collections.abc import Iterator

from rich.table import Table

from kantor_fleet.campaign.draw import SORTS
from kantor_fleet.campaign.fault_coverage import CLASSES, is_of_links, is_of_processes
from kantor_fleet.campaign.mission import Trial
from kantor_fleet.campaign.rare_events import RARE_EVENTS

ENOUGH = 500
"""Missions after which each class of faults must have taken effect, and each rare situation have been seen."""


class Totals:
    """Sums over missions."""

    def __init__(self) -> None:
        self.missions = 0
        self.violations = 0
        self.steps = 0
        self.cpu_s = 0.0
        self.simulated_ns = 0
        self.robots_ns = 0
        """Simulated time of all robots together."""
        self.twice = 0
        self.cuts = 0
        self.joined = 0
        self.lies = 0
        self.liars = 0
        self.named = 0
        self.sorts: Counter[str] = Counter()
        self.planners: Counter[str] = Counter()
        self.ended: Counter[str] = Counter()
        self.struck: Counter[str] = Counter()
        self.seen: Counter[str] = Counter()
        self.missions_with: Counter[str] = Counter()
        """Missions in which a class took effect, or a situation was seen."""

    def add(self, trial: Trial) -> None:
        """One more mission."""
        self.missions += 1
        self.violations += trial.violation is not None
        self.steps += trial.steps
        self.cpu_s += trial.cpu_s
        simulated_ns = round(trial.simulated_s * 1e9)
        self.simulated_ns += simulated_ns
        self.robots_ns += simulated_ns * trial.robots
        self.twice += trial.twice
        self.cuts += trial.cut
        self.joined += trial.joined
        self.lies += trial.lies
        self.liars += trial.liars
        self.named += trial.named
        self.sorts[trial.sort] += 1
        self.planners[trial.planner + ("*" if trial.centralized else "")] += 1
        self.ended[trial.ended] += 1
        self.struck.update(trial.struck)
        self.seen.update(trial.seen)
        self.missions_with.update({name for name, times in trial.struck.items() if times})
        self.missions_with.update(trial.seen.keys())

    @property
    def missing(self) -> tuple[str, ...]:
        """Classes of faults that never took effect, and situations that were never seen."""
        return tuple(
            [name for name in CLASSES if not self.struck[name]]
            + [name for name in RARE_EVENTS if not self.seen[name]]
        )

    def lines(self, wall_s: float) -> Iterator[str]:
        """The totals as text. wall_s: real time of this command."""
        cpu_s = max(self.cpu_s, 1e-9)
        on_links = sum(n for name, n in self.struck.items() if is_of_links(name))
        on_processes = sum(n for name, n in self.struck.items() if is_of_processes(name))
        yield f"{self.missions} missions, {self.violations} with violations; ended: {_listed(self.ended)}"
        yield f"  sorts      {_listed(self.sorts, tuple(SORTS))}"
        yield f"  planners   {_listed(self.planners)}  (* with a supervisor)"
        yield (
            f"  simulated  {self.robots_ns / 3600e9:.1f} robot-hours, {self.steps} robot-steps; "
            f"{self.twice} missions executed twice, {self.cuts} journals cut, "
            f"{self.joined} records merged in another order"
        )
        yield (
            f"  faults     {on_links} copies of messages touched, {on_processes} processes hit, "
            f"{sum(1 for name in CLASSES if self.struck[name])} of {len(CLASSES)} classes"
        )
        yield f"  lies       {self.lies} found, {self.named} of {self.liars} liars named, and no other robot"
        yield (
            f"  speed      {self.steps / cpu_s:.0f} robot-steps per CPU second with every check on "
            f"({cpu_s:.0f} CPU s of all workers, {wall_s:.0f} s here); "
            f"simulated : CPU time {self.simulated_ns * 1e-9 / cpu_s:.0f} : 1"
        )

    def tables(self) -> Iterator[Table]:
        """Classes of faults, and rare situations."""
        yield self._table("class of faults", "copies, processes or steps", CLASSES, self.struck)
        yield self._table("sometimes", "times", RARE_EVENTS, self.seen)

    def _table(self, title: str, unit: str, names: tuple[str, ...], counts: Counter[str]) -> Table:
        table = Table(title, "missions", unit, box=None, pad_edge=False)
        for column in table.columns[1:]:
            column.justify = "right"
        for name in names:
            table.add_row(name, str(self.missions_with[name]), str(counts[name]))
        return table


def _listed(counts: Counter[str], order: tuple[str, ...] = ()) -> str:
    by_count = sorted(counts, key=lambda name: (-counts[name], name))  # in whatever order they came
    names = [name for name in order if counts[name]] or by_count
    return ", ".join(f"{name or 'crashed'} {counts[name]}" for name in names)
