"""`kantor campaign`: seed by seed until one breaks a rule; the same command goes on where it stopped."""

import functools
import hashlib
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

from kantor_fleet.campaign.draw import draw, sort_of
from kantor_fleet.campaign.mission import Follower, Trial
from kantor_fleet.campaign.shrink import shrink
from kantor_fleet.campaign.totals import ENOUGH, Totals
from kantor_fleet.execution.experiment import Case, Outcome, code
from kantor_fleet.execution.pools import ClusterError, Pool
from kantor_fleet.exits import Exit
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.report.progress import printable
from kantor_fleet.report.run_progress import RunProgressView, table_console
from kantor_fleet.sweep.journal import RunsJournal
from kantor_fleet.sweep.plan import RunKey, parse_seeds
from kantor_protocol.scenario.dump import to_toml
from kantor_protocol.scenario.schema import Scenario

RUNS = "campaign.jsonl"
SMALLEST = "smallest.toml"
_SHRINK_S = 60.0


class CampaignConfig(NamedTuple):
    """The seeds of a campaign, its folder and its limit of time."""

    seeds: Sequence[int]
    folder: Path
    minutes: float | None = None
    """Real time after which no further mission begins."""


class Broken(NamedTuple):
    """A mission that breaks a rule."""

    seed: int
    trial: Trial


def numbered(text: str) -> tuple[int, ...]:
    """Seeds from a number of them, from 0 on, or as `parse_seeds` reads them. Raises SweepError."""
    return parse_seeds(f"0:{text}" if text.strip().isdecimal() else text)


def campaign(config: CampaignConfig, start: Callable[[Iterable[Case]], Pool]) -> Exit:
    """Run the missions that are not done yet, up to the first violation; the exit code.

    start: the pool, whose work is `attempt`. Raises SweepError, OSError.
    """
    started_s = time.monotonic()
    totals, unreachable = Totals(), None
    with Interrupts() as interrupts, RunsJournal(config.folder / RUNS, Trial) as journal:
        broken = _known(config, journal, totals)
        if broken is None:
            try:
                broken = _run(config, journal, totals, start, interrupts)
            except ClusterError as error:
                unreachable = error
        for line in totals.lines(time.monotonic() - started_s):
            print(line)
        if totals.missions:
            for table in totals.tables():
                table_console().print(table)
    if broken is not None:
        _report(config.folder, broken)
        return Exit.NOT_MET
    if unreachable is not None:
        print(f"kantor: {totals.missions} missions are done; the same command goes on")
        print(f"kantor: {unreachable}", file=sys.stderr)
        return Exit.UNREACHABLE
    return interrupts.code or _verdict(config, totals)


def replay(seed: int, folder: Path) -> Exit:
    """Run the mission of one seed, leave its scenario and its record, and print its violations."""
    scenario = draw(seed)
    place = folder / f"seed-{seed}"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    follower = Follower(scenario, seed, place)
    follower.run()
    result = follower.recording.finish()
    print(f"seed {seed}: {scenario.summary}; ended: {result.ended}; digest {result.digest[:16]}")
    violations = follower.violations()
    for violation in violations:
        print(f"  VIOLATION  {violation}")
    print(f"  {place}/  ({', '.join(sorted(path.name for path in place.iterdir()))})")
    print(f"  the same   {_command(place / 'scenario.toml', seed)}")
    return Exit.NOT_MET if violations else Exit.DONE


def _known(config: CampaignConfig, journal: RunsJournal, totals: Totals) -> Broken | None:
    """Count the missions that were run before; the first of them with a violation."""
    first = None
    for seed in config.seeds:
        trial = journal.outcomes.get(_key(seed))
        if isinstance(trial, Trial):
            totals.add(trial)
            if trial.violation and first is None:
                first = Broken(seed, trial)
    if totals.missions:
        print(f"{totals.missions} missions are known from {config.folder / RUNS}")
    return first


def _run(
    config: CampaignConfig,
    journal: RunsJournal,
    totals: Totals,
    start: Callable[[Iterable[Case]], Pool],
    interrupts: Interrupts,
) -> Broken | None:
    left = [seed for seed in config.seeds if _key(seed) not in journal.outcomes]
    if not left:
        return None
    with RunProgressView(len(left)) as view, closing(start(_cases(left, config.minutes))) as pool:
        view.note("starting workers (the first time, kernels are compiled: about half a minute)")
        for done in pool:
            if done is not None:
                case, outcome = done
                trial = _trial(case, outcome)
                journal.add(_key(case.seed), trial)
                totals.add(trial)
                view.count()
                if trial.violation:
                    return Broken(case.seed, trial)
            if interrupts():
                break
    return None


def _cases(seeds: Iterable[int], minutes: float | None) -> Iterator[Case]:
    """Drawn as they are asked for, until the time is up."""
    until_s = None if minutes is None else time.monotonic() + 60.0 * minutes
    for seed in seeds:
        if until_s is not None and time.monotonic() >= until_s:
            return
        yield Case(draw(seed), seed)


def _trial(case: Case, outcome: Outcome) -> Trial:
    """The outcome as a trial; a worker that died has returned none."""
    if isinstance(outcome, Trial):
        return outcome
    return Trial(failed=outcome.failed, sort=sort_of(case.scenario))


def _report(folder: Path, broken: Broken) -> None:
    """Print all that is needed to repeat a violation, and find the smallest scenario that shows it."""
    seed, trial = broken
    print(f"VIOLATION  seed {seed} ({trial.sort})")
    for violation in (trial.violation or "", *trial.complaints[1:]):
        print(f"  {printable(violation)}")
    print(f"  commit     {commit()}, sources {code()[:16]}")
    print(f"  replay     kantor campaign --replay {seed}")
    case = Case(draw(seed), seed)
    print(f"  shrinking  for up to {_SHRINK_S:.0f} s", flush=True)
    smallest, still = shrink(case, trial.rule or "", _SHRINK_S)
    place = folder / f"seed-{seed}"
    place.mkdir(parents=True, exist_ok=True)
    (place / SMALLEST).write_text(to_toml(smallest, brief=True), encoding="utf-8")
    print(
        f"  smallest   {_size(case.scenario)} -> {_size(smallest)}: {printable(still.violation or 'none')}"
    )
    print(f"             {_command(place / SMALLEST, seed)}")


def _verdict(config: CampaignConfig, totals: Totals) -> Exit:
    if totals.missions < len(config.seeds):
        print(
            f"kantor: {totals.missions} of {len(config.seeds)} missions are done; the same command goes on"
        )
    if totals.missions < ENOUGH or not totals.missing:
        return Exit.DONE
    for name in totals.missing:
        print(f"kantor: never reached: {name}")
    return Exit.NOT_MET


def _size(scenario: Scenario) -> str:
    return (
        f"{scenario.robots.count} robots, {len(scenario.faults)} faults, "
        f"{scenario.steps_per_robot} steps"
    )


def _command(path: Path, seed: int) -> str:
    return f"kantor run {path} --exchange in-process --seed {seed}"


def _key(seed: int) -> RunKey:
    """The key of a mission: the code that draws and checks it, and its seed."""
    return RunKey(f"campaign {_draws()}", code(), seed, exact=False)


@functools.cache
def _draws() -> str:
    """Digest of this package, which decides on the scenario of a seed."""
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def commit() -> str:
    """The commit of the sources, if they are under git."""
    git = shutil.which("git")
    if git is None:
        return "unknown"
    described = subprocess.run(
        [git, "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        check=False,
    )
    return described.stdout.strip() or "unknown"
