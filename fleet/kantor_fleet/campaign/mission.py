"""One mission of a campaign: in process, with every checker, and checked again from its record alone."""

import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from kantor_fleet.campaign.draw import sort_of
from kantor_fleet.campaign.fault_coverage import FaultCoverage
from kantor_fleet.campaign.invariants import Invariants
from kantor_fleet.campaign.keyed_draws import KeyedDraws
from kantor_fleet.campaign.merge_convergence import merge_shuffled
from kantor_fleet.campaign.rare_events import RareEvents
from kantor_fleet.execution.experiment import Case, Outcome, reason
from kantor_fleet.execution.in_process_team import lies_told, play, team, team_identities
from kantor_protocol.base.machine import WORLD_SIM, ParticipantId, StateMachine
from kantor_protocol.scenario.faults.liars import liars_of
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Identities
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.checkers.checker import Checker
from kantor_worldsim.observers.checkers.liveness import LivenessChecker
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.journal import Digest, Journal, read
from kantor_worldsim.record.records import Opening, Record, decode_record
from kantor_worldsim.record.run_folder import JOURNAL
from kantor_worldsim.world.world import WorldSetup

TWICE_EVERY = 20
"""One seed in so many is executed twice, for the same digest."""
CUT_EVERY = 25
"""One in so many has its journal cut anywhere, for a record that is still sound, and its messages merged in
another order."""
_CUTS = 3
_SUBJECT = 1000


class Trial(Outcome, frozen=True, kw_only=True):
    """The outcome of a mission."""

    sort: str = ""
    """See `draw.SORTS`."""
    planner: str = ""
    centralized: bool = False
    robots: int = 0
    ended: str = ""
    steps: int = 0
    """Of all robots together."""
    simulated_s: float = 0.0
    """Of mission time."""
    cpu_s: float = 0.0
    """Of this machine, for the mission and all that was checked."""
    digest: str = ""
    complaints: tuple[str, ...] = ()
    """The first ten violations; `rule: time: participant: text`."""
    struck: dict[str, int] = msgspec.field(default_factory=dict)
    """Copies or processes hit, by class of faults."""
    seen: dict[str, int] = msgspec.field(default_factory=dict)
    """Rare situations; see `rare_events`."""
    twice: int = 0
    """1: executed twice."""
    cut: int = 0
    """How often its journal was cut."""
    joined: int = 0
    """1: all its messages were merged in another order."""
    lies: int = 0
    """Times that checkers have found a declared liar to lie."""
    liars: int = 0
    """Robots that have told a lie, as they know themselves or checkers do."""
    named: int = 0
    """Those of them that checkers have named."""

    @property
    def violation(self) -> str | None:
        """The first violation, or the crash, if there is one."""
        return self.failed or (self.complaints[0] if self.complaints else None)

    @property
    def rule(self) -> str | None:
        """The rule that it breaks."""
        return rule_of(self.violation) if self.violation else None


def rule_of(complaint: str) -> str:
    """The rule that a violation is about."""
    return complaint.partition(":")[0]


def attempt(case: Case, *, validate: bool = True) -> Trial:
    """Run a case, and nothing but the case; a crash is in the trial too.

    validate: participants and world-sim validate their state as well.
    """
    started_s, cpu_s = time.monotonic(), time.process_time()
    try:
        outcome = _attempt(case, validate=validate)
    except Exception as error:  # noqa: BLE001  a mission that crashes is a finding like any other
        outcome = {"failed": reason(error)}
    scenario = case.scenario
    return Trial(
        **outcome,
        sort=sort_of(scenario),
        planner=scenario.planner.name,
        centralized=scenario.centralized,
        robots=scenario.robots.count,
        wall_s=time.monotonic() - started_s,
        cpu_s=time.process_time() - cpu_s,
    )


class Follower:
    """Runs a mission of a campaign with all its observers, and stops it at the first violation."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        folder: Path | None = None,
        *,
        validate: bool = True,
    ) -> None:
        """folder: for the run's files, as `kantor run` leaves them; None keeps nothing.

        validate: participants and world-sim validate their state as well.
        """
        self.recording = Recording(scenario, seed, "in-process", folder)
        self.payloads: list[bytes] = []
        self.fault_coverage, self.rare_events = FaultCoverage(), RareEvents()
        self.judged: frozenset[str] = frozenset()
        """Rules of liveness that the record could have broken."""
        self._scenario, self._seed = scenario, seed
        self._invariants = Invariants() if validate else None
        self._machines: dict[ParticipantId, StateMachine] = {}

    def run(self) -> str:
        """Run the mission to its end, or to the first violation; why it ended."""
        scenario, seed = self._scenario, self._seed
        setup = WorldSetup.of(scenario, seed)
        machines = self._machines = team(scenario, seed, setup)
        identities = team_identities(scenario, seed)
        simulation = Simulation(scenario, seed, setup, [self.observe], identities)
        if self._invariants is not None:
            self._invariants.watch({**machines, WORLD_SIM: simulation})
        exchange = InProcessExchange(machines)
        return simulate(simulation, exchange, seed, lambda: self.broken, exchange)

    def observe(self, record: Record) -> None:
        """Follow one record."""
        self.payloads.append(self.recording.observe(record).payload)
        self.fault_coverage.observe(record)
        self.rare_events.observe(record)
        if self._invariants is not None and not isinstance(record, Opening | Identities):
            self._invariants.count(record.now_ns)

    @property
    def steps(self) -> int:
        """Of all robots so far."""
        return self.recording.metrics.steps

    @property
    def broken(self) -> bool:
        """Whether there is a violation so far."""
        return self.recording.checker.count > 0 or bool(self._broken_invariants)

    @property
    def _broken_invariants(self) -> list[str]:
        return self._invariants.violations if self._invariants is not None else []

    @property
    def liars(self) -> frozenset[ParticipantId]:
        """Robots that have told a lie, as they know themselves; of a new incarnation only what it has told."""
        return frozenset(name for name, machine in self._machines.items() if lies_told(machine))

    def _unnamed(self) -> list[str]:
        """Liars that no checker has named."""
        named = self.recording.checker.lies
        return [
            f"named: {name} has lied, and was not found out"
            for name in sorted(self.liars - set(named))
        ]

    def violations(self) -> tuple[str, ...]:
        """The first violations of a mission that is over: as it ran, or by its record alone."""
        checker = self.recording.checker
        seen = (*checker.violations[:10], *self._broken_invariants, *self._unnamed())
        return seen[:10] or tuple(self._check_again()[:10])

    def _check_again(self) -> list[str]:
        """The violations that checkers find that have nothing but the bytes of the record."""
        checker, liveness = Checker(), LivenessChecker()
        pipeline = Pipeline(checker, liveness)
        for payload in self.payloads:
            pipeline.observe(decode_record(payload), payload)
        self.judged = frozenset(liveness.judged)
        return checker.violations or liveness.violations


def _attempt(case: Case, *, validate: bool) -> dict[str, Any]:
    scenario, seed = case.scenario, case.seed
    follower = Follower(scenario, seed, validate=validate)
    ended = follower.run()
    result = follower.recording.finish()
    violations = follower.violations()
    twice, cut = seed % TWICE_EVERY == 0, seed % CUT_EVERY == 0
    if twice and not violations:
        violations = tuple(_run_again(scenario, seed, result.digest))
    if cut and not violations:
        violations = tuple(_cut_journal(seed, follower.payloads))
    believed = cut and not liars_of(scenario.faults)
    if believed and not violations:
        violations = tuple(merge_shuffled(scenario, seed, map(decode_record, follower.payloads)))
    return {
        "ended": ended,
        "steps": follower.steps,
        "simulated_s": decode_record(follower.payloads[-1]).now_ns * 1e-9,  # type: ignore[union-attr]
        "digest": result.digest,
        "complaints": violations,
        "struck": dict(follower.fault_coverage.counts),
        "seen": follower.rare_events.counts
        | {f"{rule} judged": 1 for rule in sorted(follower.judged)},
        "twice": int(twice),
        "cut": _CUTS if cut else 0,
        "joined": int(believed and not scenario.mapping),
        "lies": sum(follower.recording.checker.lies.values()),
        "liars": len(follower.liars.union(follower.recording.checker.lies)),
        "named": len(follower.recording.checker.lies),
    }


def _run_again(scenario: Scenario, seed: int, digest: str) -> Iterable[str]:
    """A violation if the mission, run again from its scenario and seed, has another digest."""
    again = Digest()
    setup = WorldSetup.of(scenario, seed)
    play(scenario, seed, setup, [again.follow])
    if again.hex != digest:
        yield f"digest: executed twice, and {again.hex} is not {digest}"


def _cut_journal(seed: int, payloads: list[bytes]) -> Iterable[str]:
    """Violations in a journal as a killed recorder leaves it: it has every record up to the cut, and they are sound."""
    draws = KeyedDraws(seed, _SUBJECT)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / JOURNAL
        journal = Journal(path)
        for payload in payloads:
            journal.append(decode_record(payload), payload)
        journal.close()
        whole = path.read_bytes()
        for _ in range(_CUTS):
            path.write_bytes(whole[: draws.whole(0, len(whole))])
            found = list(read(path))
            if [payload for payload, _ in found] != payloads[: len(found)]:
                yield "prefix: what is left of a journal that was cut is not what was written"
            checker = Checker()
            pipeline = Pipeline(checker)
            for payload, record in found:
                pipeline.observe(record, payload)
            yield from checker.violations
