"""`kantor campaign --processes`: missions on real processes over the bus, under storms of real signals.

World-sim, robots and the supervisor are processes of their own. A seed decides when they are killed, paused,
slowed and impersonated, world-sim too, and every mission has to come to its end with every rule kept: as it ran,
and read again from its file alone.
"""

import os
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.util import get_temp_dir
from pathlib import Path
from typing import NamedTuple

from kantor_fleet.campaign.fault_coverage import CLASSES, FaultCoverage
from kantor_fleet.campaign.process_scenarios import is_lockstep, process_scenario
from kantor_fleet.campaign.rss_monitor import (
    FLAT_LASTING_MB,
    FLAT_MB,
    Grown,
    Lasting,
    RssMonitor,
    grandchildren,
)
from kantor_fleet.campaign.run import commit
from kantor_fleet.execution.experiment import code
from kantor_fleet.execution.fork_server import fork_server
from kantor_fleet.execution.in_process_team import play
from kantor_fleet.execution.leftovers import Leftovers
from kantor_fleet.execution.parent_death import die_with_parent
from kantor_fleet.execution.preload import warm_up
from kantor_fleet.execution.verify import findings
from kantor_fleet.exits import Exit
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.processes.local import Fleet, FleetConfig, local_fleet, watch_progress
from kantor_fleet.report.progress import printable
from kantor_fleet.report.summary import read_result
from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.scenario.dump import to_toml
from kantor_protocol.scenario.faults.liars import liars_of
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.transport.session import BusError
from kantor_worldsim.engine.process_faults import schedule_of
from kantor_worldsim.observers.checkers.liveness import LivenessChecker
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.record.journal import Digest, read
from kantor_worldsim.record.records import Batch, ProcessEvent, Record
from kantor_worldsim.record.run_folder import JOURNAL, SCENARIO
from kantor_worldsim.world.world import WorldSetup

FOLDER = "processes"
REJOIN_S = 2.0
"""Of a hundred restarts 99 have to be back by then, unless a soak has a bound of its own."""
_GRACE_S = 120.0
"""What a mission may take beyond its limit: a start, and a world that starts again and again."""
_ORPHANS_S = 60.0
"""How long a process that was killed may be seen yet."""


class SoakTerms(NamedTuple):
    """How storms are drawn and missions are run."""

    speed: float
    """Simulated seconds in a real one."""
    storm_s: float
    """Real seconds in which anything may go wrong."""
    byzantine: bool = False
    """One robot lies in every mission."""

    def scenario(self, seed: int) -> Scenario:
        """The scenario of a seed."""
        return process_scenario(seed, self.speed, self.storm_s, byzantine=self.byzantine)


class Soak(NamedTuple):
    """The seeds of a campaign on processes, its folder and its terms."""

    seeds: Sequence[int]
    folder: Path
    terms: SoakTerms
    minutes: float | None = None
    """Real time after which no further mission begins."""
    rejoin_s: float = REJOIN_S


class ProcessMission(NamedTuple):
    """The outcome of a mission."""

    seed: int
    exchange: str
    ended: str
    wall_s: float
    complaints: tuple[str, ...]
    struck: Counter[str]
    """Processes, or copies of messages, by class of faults."""
    rejoined_s: tuple[float, ...] = ()
    """Of participants: real time from the order to start to the first step that world-sim accepted."""
    resumed_s: tuple[float, ...] = ()
    """Of world-sim: until the first step of a participant was accepted."""
    steps: int = 0
    incarnations: int = 0
    judged: frozenset[str] = frozenset()
    """Rules of liveness that the record could have broken."""
    liars: int = 0
    """Robots that the scenario has lie."""
    lies: dict[str, int] = {}  # noqa: RUF012  it is only read
    """Times that checkers have found each of them to lie."""
    grown: dict[str, Grown] = {}  # noqa: RUF012  it is only read


def soak(config: Soak) -> Exit:
    """Run mission after mission, up to the first that breaks a rule; the exit code."""
    started_s = time.monotonic()
    totals = SoakTotals(config.rejoin_s)
    with Interrupts() as interrupts, _own_temporary_folder() as temporary:
        print(f"warming up; {config.terms.storm_s:g} s of storm in each mission", flush=True)
        warm_up()
        for seed in config.seeds:
            spent_s = time.monotonic() - started_s
            if config.minutes is not None and spent_s >= 60.0 * config.minutes:
                break
            place = config.folder / FOLDER / f"seed-{seed}"
            mission = run_mission(seed, config.terms, place, interrupts, temporary)
            if interrupts():
                break
            totals.add(mission)
            print(_line(mission, totals, time.monotonic() - started_s), flush=True)
            if mission.complaints:
                break
            shutil.rmtree(place)
    for line in totals.lines(time.monotonic() - started_s):
        print(line)
    if totals.broken is not None:
        _report(totals.broken, config)
    return interrupts.code or (Exit.DONE if totals.met else Exit.NOT_MET)


def replay(seed: int, folder: Path, terms: SoakTerms) -> Exit:
    """Run the mission of one seed, and leave its run folder."""
    with Interrupts() as interrupts, _own_temporary_folder() as temporary:
        warm_up()
        place = folder / FOLDER / f"seed-{seed}"
        mission = run_mission(seed, terms, place, interrupts, temporary)
    totals = SoakTotals()
    totals.add(mission)
    print(_line(mission, totals, mission.wall_s))
    for violation in mission.complaints:
        print(f"  VIOLATION  {printable(violation)}")
    print(f"  {place}/  ({', '.join(sorted(path.name for path in place.iterdir()))})")
    return interrupts.code or (Exit.NOT_MET if mission.complaints else Exit.DONE)


def run_mission(
    seed: int, terms: SoakTerms, folder: Path, stopped: Interrupts, temporary: Path
) -> ProcessMission:
    """Run and check one mission. folder: for its files, emptied before. temporary: where nothing may be left."""
    started_s = time.monotonic()
    scenario = terms.scenario(seed)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    exchange = "lockstep" if is_lockstep(seed) else "wall"
    config = FleetConfig(scenario, seed, exchange, terms.speed, folder)
    before = _entries(temporary)
    failures, grown = _run(config, stopped)
    failures += [f"orphan: process {pid} is there yet" for pid in _orphans()]
    failures += [f"leftover: {name} in {temporary}" for name in _entries(temporary) - before]
    if stopped():
        return ProcessMission(seed, exchange, "interrupted", 0.0, (), Counter())
    return _check_apart(config, failures)._replace(wall_s=time.monotonic() - started_s, grown=grown)


def _run(config: FleetConfig, stopped: Interrupts) -> tuple[list[str], dict[str, Grown]]:
    """Run the fleet to its end; its failures, and the growth of its processes."""
    scenario = config.scenario
    give_up_s = time.monotonic() + scenario.limit_ns * 1e-9 / config.speed + _GRACE_S
    failures: list[str] = []
    with local_fleet(config) as fleet:
        rss_monitor = RssMonitor(fleet)
        periods = 0
        try:
            for progress in watch_progress(fleet):
                periods = progress.now_ns // scenario.period_ns if progress else periods
                rss_monitor.sample(periods)
                failures += _newly_failed(fleet)
                late = time.monotonic() >= give_up_s
                if late or stopped():
                    failures += ["end: the mission hangs"] if late else []
                    fleet.stop()
                    break
        except BusError as error:
            failures.append(f"bus: {error}")
        fleet.end()
        failures += _newly_failed(fleet)
        if fleet.world_sim.exitcode:
            failures.append(f"process: world-sim ended with {fleet.world_sim.exitcode}")
    return failures, rss_monitor.grown()


def _newly_failed(fleet: Fleet) -> list[str]:
    failed = [f"process: {name} ended with {failure}" for name, failure in fleet.newly_failed()]
    if (ended := fleet.restart_killed()) is not None:
        failed.append(f"process: world-sim ended with {ended}")
    return failed


def _orphans() -> list[int]:
    """Processes of a fleet that should be gone."""
    give_up_s = time.monotonic() + _ORPHANS_S
    while (left := grandchildren()) and time.monotonic() < give_up_s:
        time.sleep(0.05)
    return left


def _check_apart(config: FleetConfig, failures: list[str]) -> ProcessMission:
    """Check a mission in another process, since a whole record in memory would make this one larger for good."""
    context = fork_server()
    with ProcessPoolExecutor(1, mp_context=context, initializer=die_with_parent) as pool:
        return pool.submit(_check, config, failures).result()


def _check(config: FleetConfig, failures: list[str]) -> ProcessMission:
    """Check a mission by its files."""
    folder, scenario = config.folder, config.scenario
    result = read_result(folder)
    if result is None:
        failures.append("result: there is none")
        return ProcessMission(
            config.seed, config.exchange, "crashed", 0.0, tuple(failures), Counter()
        )
    journal = list(read(folder / JOURNAL))
    records = [record for _, record in journal]
    coverage, liveness = FaultCoverage(), LivenessChecker()
    pipeline = Pipeline(liveness)
    for payload, record in journal:
        coverage.observe(record)
        pipeline.observe(record, payload)
    violations = [*failures, *result.complaints]
    if result.ended != "done" or result.record != "whole":
        violations.append(f"end: {result.ended}; record {result.record}")
    violations += [f"verify: {line}" for held, line in findings(folder, journal) if not held]
    violations += liveness.violations
    violations += [f"{i.who}: let in" for i in _process_events(records) if i.kind == "let in"]
    rejoined_s: tuple[float, ...] = ()
    resumed_s: tuple[float, ...] = ()
    if config.exchange == "lockstep":
        violations += _run_again(scenario, config.seed, result.digest)
    else:
        rejoined_s, resumed_s = _back_s(scenario, records, config.speed)
    return ProcessMission(
        config.seed,
        config.exchange,
        result.ended,
        0.0,
        tuple(violations[:10]),
        coverage.counts,
        rejoined_s,
        resumed_s,
        sum(
            step_record.outputs is not None
            for r in records
            if isinstance(r, Batch)
            for step_record in r.step_records
        ),
        result.incarnations,
        frozenset(liveness.judged),
        len(liars_of(scenario.faults)),
        result.lies,
    )


def _process_events(records: Sequence[Record]) -> list[ProcessEvent]:
    return [record for record in records if isinstance(record, ProcessEvent)]


def _run_again(scenario: Scenario, seed: int, digest: str) -> Iterator[str]:
    """A violation if the mission of a lockstep run has another digest in this process."""
    alone = Digest()
    play(scenario, seed, WorldSetup.of(scenario, seed), [alone.follow])
    if alone.hex != digest:
        yield f"digest: {digest} over the bus, {alone.hex} in process"


def _back_s(
    scenario: Scenario, records: Sequence[Record], speed: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Real seconds from a restart to the first step that follows: of participants, and of world-sim.

    Scheduled process faults are injected one after the other, so a participant's start is ordered when it is due
    and the one before is done. Clocks of participants run on while world-sim is down, and it goes on by them.
    """
    due_ns = {
        (scheduled.fault, scheduled.who): scheduled.at_ns
        for scheduled in schedule_of(scenario)
        if scheduled.kind == "start"
    }
    killed: set[ParticipantId] = set()
    ordered_ns: dict[ParticipantId, int] = {}
    back_s: dict[bool, list[float]] = {False: [], True: []}
    before_ns = 0
    for record in records:
        if isinstance(record, ProcessEvent) and record.fault >= 0:
            who = record.who
            if record.kind == "kill":
                killed.add(who)
            elif record.kind == "start" and who in killed:
                due = due_ns[record.fault, who]
                ordered_ns[who] = due if who == WORLD_SIM else max(before_ns, due)
            before_ns = record.now_ns
        elif isinstance(record, Batch) and ordered_ns:
            stepped = {
                step_record.name
                for step_record in record.step_records
                if step_record.outputs is not None
            }
            for who in (stepped | ({WORLD_SIM} if stepped else set())) & ordered_ns.keys():
                waited_ns = record.now_ns - ordered_ns.pop(who)
                back_s[who == WORLD_SIM].append(waited_ns * 1e-9 / speed)
    return tuple(back_s[False]), tuple(back_s[True])


class SoakTotals:
    """Sums over missions."""

    def __init__(self, rejoin_s: float = REJOIN_S) -> None:
        self._rejoin_s = rejoin_s
        self.broken: ProcessMission | None = None
        self.struck: Counter[str] = Counter()
        """In real time, and in lockstep where a fault is a signal as well."""
        self._missions: Counter[str] = Counter()
        self._judged: Counter[str] = Counter()
        self._rejoined_s: list[float] = []
        self._resumed_s: list[float] = []
        self._grown: dict[str, Grown] = {}
        self._lasting = Lasting()
        self._steps = self._incarnations = 0
        self._liars = self._named = self._lies = 0

    def add(self, mission: ProcessMission) -> None:
        """One more mission."""
        self.broken = mission if mission.complaints else self.broken
        real = dict(mission.struck)
        if mission.exchange == "lockstep":  # no process is stopped there, only left out
            real = {name: n for name, n in real.items() if not name.startswith(("pause", "slow"))}
        self.struck.update(real)
        self._missions[mission.exchange] += 1
        self._judged.update(mission.judged)
        self._rejoined_s += mission.rejoined_s
        self._resumed_s += mission.resumed_s
        self._steps += mission.steps
        self._incarnations += mission.incarnations
        self._liars += mission.liars
        self._named += len(mission.lies)
        self._lies += sum(mission.lies.values())
        for kind, grown in mission.grown.items():
            self._grown[kind] = self._grown.get(kind, Grown()) + grown
        self._lasting.sample()

    @property
    def met(self) -> bool:
        """No rule was broken, every restarted process was back in time, and memory was flat."""
        rejoined_s = _quantile(self._rejoined_s, 0.99)
        return self.broken is None and rejoined_s < self._rejoin_s and self._is_flat

    @property
    def _is_flat(self) -> bool:
        lasting = self._lasting.grown_mb or (0.0, 0.0)
        flat = all(grown.mb_per_1000 <= FLAT_MB for grown in self._grown.values())
        return flat and max(lasting) <= FLAT_LASTING_MB

    def signals(self) -> str:
        """How often processes were killed and paused."""
        robots, supervisor, world = (
            [self.struck[f"{kind}{who}"] for kind in ("kill", "pause")]
            for who in ("", " supervisor", " worldsim")
        )
        return (
            f"SIGKILL {robots[0] + supervisor[0] + world[0]} "
            f"(robots {robots[0]}, supervisor {supervisor[0]}, world-sim {world[0]}), "
            f"SIGSTOP {robots[1] + supervisor[1] + world[1]} "
            f"(robots {robots[1]}, supervisor {supervisor[1]}, world-sim {world[1]})"
        )

    def lines(self, wall_s: float) -> Iterator[str]:
        """In words. wall_s: real time of this command."""
        missions, broken = self._missions.total(), int(self.broken is not None)
        yield (
            f"{missions} missions ({self._missions['wall']} in real time, "
            f"{self._missions['lockstep']} in lockstep) in {wall_s / 60.0:.1f} min, "
            f"{broken} with violations; {self._steps} steps"
        )
        yield f"  signals    {self.signals()}"
        others = [
            f"{name} {self.struck[name]}"
            for name in CLASSES
            if self.struck[name] and name.partition(" ")[0] not in {"kill", "pause"}
        ]
        yield f"  others     {', '.join(others)}"
        kinds = [f"{self.struck[f'kill {how}']} {how}" for how in ("torn", "lost", "mid-step")]
        yield (
            f"  disks      {', '.join(kinds)}, {self.struck['kill for good']} killed for good; "
            f"{self._incarnations} new incarnations"
        )
        if self._liars:
            yield f"  lies       {self._lies} found, {self._named} of {self._liars} liars named, and no other robot"
        yield f"  rejoined   {_quantiles(self._rejoined_s, self._rejoin_s)}"
        yield f"  resumed    world-sim {_quantiles(self._resumed_s)}"
        yield f"  liveness   {', '.join(f'{rule} judged {n}' for rule, n in sorted(self._judged.items()))}"
        yield from self._memory()
        yield "  left over  no process, no file" if not broken else "  left over  see the violation"

    def _memory(self) -> Iterator[str]:
        for kind, grown in sorted(self._grown.items()):
            yield (
                f"  memory     {kind}: {grown.mb_per_1000:+.2f} MB in 1000 periods "
                f"({grown.processes} processes, {grown.periods:.0f} periods; at most {grown.most_mb:+.1f} MB in "
                f"one, peak {grown.peak_mb:.0f} MB)"
            )
        if (lasting := self._lasting.grown_mb) is not None:
            yield f"  memory     from the third mission on: campaign {lasting[0]:+.1f} MB, fork server {lasting[1]:+.1f} MB"
        yield (
            f"  memory     {'flat' if self._is_flat else 'NOT FLAT'}: bounds {FLAT_MB:g} MB in 1000 "
            f"periods, {FLAT_LASTING_MB:g} MB of what outlives missions"
        )


def _quantile(values: list[float], share: float) -> float:
    """One of the values; 0 if there is none."""
    ordered = sorted(values)
    return ordered[-(-round(1000 * share) * len(ordered) // 1000) - 1] if ordered else 0.0


def _quantiles(times_s: list[float], bound_s: float | None = None) -> str:
    if not times_s:
        return "none"
    p50, p99 = (_quantile(times_s, share) for share in (0.5, 0.99))
    text = f"{len(times_s)} times: p50 {p50:.2f} s, p99 {p99:.2f} s, at most {max(times_s):.2f} s"
    if bound_s is None:
        return text
    return f"{text}; {'below' if p99 < bound_s else 'NOT BELOW'} {bound_s:g} s"


def _line(mission: ProcessMission, totals: SoakTotals, spent_s: float) -> str:
    """A mission in one line, with the signals of the campaign so far."""
    minutes, seconds = divmod(round(spent_s), 60)
    verdict = "all rules held" if not mission.complaints else "VIOLATION"
    slowest_s = max(mission.rejoined_s, default=0.0)
    return (
        f"{minutes:2d}:{seconds:02d}  seed {mission.seed} ({mission.exchange}): {mission.ended} in "
        f"{mission.wall_s:.0f} s, {verdict}; back in at most {slowest_s:.2f} s; so far {totals.signals()}"
    )


def _report(mission: ProcessMission, config: Soak) -> None:
    """Print all that is needed to repeat a violation."""
    terms = config.terms
    place = config.folder / FOLDER / f"seed-{mission.seed}"
    (place / SCENARIO).write_text(to_toml(terms.scenario(mission.seed)), encoding="utf-8")
    print(f"VIOLATION  seed {mission.seed} ({mission.exchange})")
    for violation in mission.complaints:
        print(f"  {printable(violation)}")
    print(f"  commit     {commit()}, sources {code()[:16]}")
    print(
        f"  replay     kantor campaign --processes --replay {mission.seed} "
        f"--speed {terms.speed:g} --storm {terms.storm_s:g}{' --byzantine' if terms.byzantine else ''}"
    )
    print(f"  kept       {place}/")


@contextmanager
def _own_temporary_folder() -> Iterator[Path]:
    """A folder with everything temporary of this process and its children, and of no other."""
    get_temp_dir()  # what multiprocessing has of its own goes when this process does
    before = tempfile.tempdir, os.environ.get("TMPDIR")
    with tempfile.TemporaryDirectory(prefix="kantor-") as folder:
        tempfile.tempdir = os.environ["TMPDIR"] = folder
        try:
            with Leftovers(Path(folder)):
                yield Path(folder)
        finally:
            tempfile.tempdir = before[0]
            os.environ.pop("TMPDIR")
            if before[1] is not None:
                os.environ["TMPDIR"] = before[1]


def _entries(folder: Path) -> set[str]:
    """The names in a folder."""
    return {path.name for path in folder.iterdir()}
