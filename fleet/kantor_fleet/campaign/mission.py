"""One mission of a campaign: in process, with every referee, and judged again from its record alone."""

import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from kantor_fleet.campaign.draw import sort_of
from kantor_fleet.campaign.fault_coverage import FaultCoverage
from kantor_fleet.campaign.keyed_draws import KeyedDraws
from kantor_fleet.campaign.merge_convergence import differing
from kantor_fleet.campaign.rare_events import RareEvents
from kantor_fleet.execution.experiment import Case, Outcome, reason
from kantor_fleet.execution.in_process_team import play
from kantor_protocol.scenario.schema import Scenario
from kantor_worldsim.observers.checkers.checker import Checker
from kantor_worldsim.observers.checkers.liveness import LivenessChecker
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.record.journal import Digest, Journal, read
from kantor_worldsim.record.records import Record, decode_record, encode_record
from kantor_worldsim.record.run_folder import JOURNAL
from kantor_worldsim.world.world import WorldSetup

TWICE_EVERY = 20
"""One seed in so many is executed twice, for the same digest."""
CUT_EVERY = 25
"""One in so many has its journal cut anywhere, for a record that is still sound, and its messages learned in
another order."""
_CUTS = 3
_SUBJECT = 1000


class Trial(Outcome, frozen=True, kw_only=True):
    """What came of a mission."""

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
    """What referees found, at most ten; `rule: when: who: what`."""
    struck: dict[str, int] = msgspec.field(default_factory=dict)
    """Copies or processes hit, by class of faults."""
    seen: dict[str, int] = msgspec.field(default_factory=dict)
    """Rare situations; see `sightings`."""
    twice: int = 0
    """1: executed twice."""
    cut: int = 0
    """How often its journal was cut."""
    joined: int = 0
    """1: all that was said in it was learned in another order."""

    @property
    def violation(self) -> str | None:
        """The first thing that is wrong, if anything is."""
        return self.failed or (self.complaints[0] if self.complaints else None)

    @property
    def rule(self) -> str | None:
        """The rule that it breaks."""
        return rule_of(self.violation) if self.violation else None


def rule_of(complaint: str) -> str:
    """The rule that a complaint is about."""
    return complaint.partition(":")[0]


def attempt(case: Case) -> Trial:
    """Run a case; whatever goes wrong is in the trial. It needs nothing but the case."""
    started_s, cpu_s = time.monotonic(), time.process_time()
    try:
        came = _attempt(case)
    except Exception as error:  # noqa: BLE001  a mission that crashes is a finding like any other
        came = {"failed": reason(error)}
    scenario = case.scenario
    return Trial(
        **came,
        sort=sort_of(scenario),
        planner=scenario.planner.name,
        centralized=scenario.centralized,
        robots=scenario.robots.count,
        wall_s=time.monotonic() - started_s,
        cpu_s=time.process_time() - cpu_s,
    )


class Follower:
    """All that follows a mission of a campaign. It stops the mission at the first violation."""

    def __init__(self, scenario: Scenario, seed: int, folder: Path | None = None) -> None:
        """folder: for the run's files, as `kantor run` leaves them; None keeps nothing."""
        self.recording = Recording(scenario, seed, "in-process", folder)
        self.payloads: list[bytes] = []
        self.struck, self.sightings = FaultCoverage(), RareEvents()
        self.judged: frozenset[str] = frozenset()
        """Rules of liveness that the record could have broken."""

    def observe(self, record: Record) -> None:
        """Follow one record."""
        self.payloads.append(self.recording.observe(record).payload)
        self.struck.observe(record)
        self.sightings.observe(record)

    @property
    def steps(self) -> int:
        """Of all robots so far."""
        return self.recording.metrics.steps

    @property
    def broken(self) -> bool:
        """Whether a referee has complained."""
        return self.recording.checker.count > 0

    def complaints(self) -> tuple[str, ...]:
        """What is wrong with the whole, once it is over: as it was seen, and from the record alone."""
        seen = tuple(self.recording.checker.complaints[:10])
        return seen or tuple(self._judged()[:10])

    def _judged(self) -> list[str]:
        """What referees find who have nothing but the bytes of the record."""
        checker, liveness = Checker(), LivenessChecker()
        pipeline = Pipeline(checker, liveness)
        for payload in self.payloads:
            pipeline.observe(decode_record(payload), payload)
        self.judged = frozenset(liveness.judged)
        return checker.complaints or liveness.complaints


def _attempt(case: Case) -> dict[str, Any]:
    scenario, seed = case.scenario, case.seed
    site = WorldSetup.of(scenario, seed)
    follower = Follower(scenario, seed)
    ended = play(scenario, seed, site, [follower.observe], stopped=lambda: follower.broken)
    result = follower.recording.finish()
    complaints = follower.complaints()
    twice, cut = seed % TWICE_EVERY == 0, seed % CUT_EVERY == 0
    if twice and not complaints:
        complaints = tuple(_differing(scenario, seed, result.digest))
    if cut and not complaints:
        complaints = tuple(_cut_open(seed, follower.payloads))
    if cut and not complaints:
        complaints = tuple(differing(scenario, seed, map(decode_record, follower.payloads)))
    return {
        "ended": ended,
        "steps": follower.steps,
        "simulated_s": decode_record(follower.payloads[-1]).now_ns * 1e-9,  # type: ignore[union-attr]
        "digest": result.digest,
        "complaints": complaints,
        "struck": dict(follower.struck.counts),
        "seen": follower.sightings.counts
        | {f"{rule} judged": 1 for rule in sorted(follower.judged)},
        "twice": int(twice),
        "cut": _CUTS if cut else 0,
        "joined": int(cut and not scenario.mapping),
    }


def _differing(scenario: Scenario, seed: int, digest: str) -> Iterable[str]:
    """The mission once more, from its scenario and seed."""
    again = Digest()
    site = WorldSetup.of(scenario, seed)
    play(scenario, seed, site, [lambda record: again.add(encode_record(record))])
    if again.hex != digest:
        yield f"digest: executed twice, and {again.hex} is not {digest}"


def _cut_open(seed: int, payloads: list[bytes]) -> Iterable[str]:
    """The journal as a killed recorder leaves it: every record up to the cut, and nothing wrong in them."""
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
            yield from checker.complaints
