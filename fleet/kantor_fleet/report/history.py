"""The history of a run from its records: trails, outages, weights left and moments.

Positions are in the world frame, in metres; times are simulated seconds.
"""

from array import array
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.machine import SUPERVISOR, ParticipantId, State
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.base.varint import Pairs
from kantor_protocol.scenario.faults.processes import Late
from kantor_protocol.wire.attestations import Identities
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.observers.recording import metrics_of
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, Record, StepRecord

_GRAIN = 1.0 / 4_000
"""A trail keeps a point for each such share of the domain's diagonal: below a pixel."""

Points = npt.NDArray[np.float64]


class Trail:
    """The path of one robot, at the resolution of the picture, however many steps it has."""

    def __init__(self, x_m: float, y_m: float, grain_m: float) -> None:
        self.end_m = (x_m, y_m)
        self._kept = array("d", self.end_m)
        self._grain_m = grain_m

    def extend(self, x_m: float, y_m: float) -> None:
        """Add a place."""
        self.end_m = (x_m, y_m)
        if max(abs(x_m - self._kept[-2]), abs(y_m - self._kept[-1])) >= self._grain_m:
            self._kept.extend(self.end_m)

    @property
    def xy_m(self) -> Points:
        """(P, 2) from start to end."""
        return np.array([*self._kept, *self.end_m]).reshape(-1, 2)


class Outage(NamedTuple):
    """A time in which a process was down or away."""

    who: ParticipantId
    cause: str
    """The event that began it: kill, pause, fill, leave, or late."""
    from_s: float
    until_s: float | None
    """None: the process did not return."""


_BEGINNINGS = {"kill", "pause", "fill", "leave"}
_ENDS = {"start", "resume", "free", "join"}
"""Process events by which an outage begins and ends."""


class RunHistory:
    """The history of a run as far as its records have been followed."""

    def __init__(self, opening: Opening) -> None:
        self.scenario, self.seed, self.setup = opening.scenario, opening.seed, opening.setup
        self.metrics = metrics_of(self.scenario)
        self.end_ns = 0
        self.contact_s: float | None = None
        """The time at which a robot first received a message."""
        grain_m = _GRAIN * self._diagonal_m
        starts_m = zip(self.scenario.robot_ids, self.setup.starts_m.tolist(), strict=True)
        self.trails = {name: Trail(x_m, y_m, grain_m) for name, (x_m, y_m) in starts_m}
        self.outages: list[Outage] = []
        """Outages in order of their ends; those without an end come last."""
        self.deaths_m: list[tuple[float, float]] = []
        """Positions of robots when they were killed."""
        self._away: dict[ParticipantId, tuple[str, float]] = {
            name: ("late", 0.0)
            for fault in self.scenario.faults
            if isinstance(fault, Late)
            for name in fault.who
        }
        self._units = opening.units
        self._left = np.full(self.setup.samples_m.shape[0], self._units.sample, dtype=np.int64)
        self._finished_ns: dict[ParticipantId, int] = {}
        self._pairs = Pairs()
        self._pipeline = Pipeline(self.metrics)
        self._pipeline.observe(opening)

    @classmethod
    def of(cls, records: Iterable[Record]) -> "RunHistory | None":
        """The history of all records; None if they do not begin with an opening."""
        following = iter(records)
        opening = next(following, None)
        if not isinstance(opening, Opening):
            return None
        run = cls(opening)
        for record in following:
            run.follow(record)
        for name, (cause, from_s) in run._away.items():
            run.outages.append(Outage(name, cause, from_s, None))
        return run

    @property
    def _diagonal_m(self) -> float:
        """Diagonal of the map or of the domain, m."""
        if self.setup.ground is not None:
            return self.setup.ground.frame.diagonal_m
        domain = self.scenario.domain
        return float(np.hypot(*np.subtract(domain.max_m, domain.min_m)))

    @property
    def finish_s(self) -> float | None:
        """The time at which the last robot was finished: no weight or no frontier left; None if not all were."""
        if len(self._finished_ns) < self.scenario.robots.count:
            return None
        return max(self._finished_ns.values()) * 1e-9

    @property
    def share_left(self) -> Points:
        """(N,) shares of each sample's first weight that are left, in the common view of the team."""
        return np.asarray(np.maximum(self._left, 0) / self._units.sample)

    def walked(self, points_m: Points, diffusion_m: float, purpose: Purpose) -> Points:
        """Positions at the end of points that walk, from their positions at time 0."""
        walk = RandomWalk(points_m, diffusion_m, self.scenario.period_ns, self.seed, purpose)
        walk.advance(self.end_ns)
        return walk.xy_m

    def follow(self, record: Record) -> None:
        """Follow one more record after the opening."""
        self._pipeline.observe(record)
        if isinstance(record, ProcessEvent):
            self._follow_event(record)
        if not isinstance(record, Opening | Identities):
            self.end_ns = max(self.end_ns, record.now_ns)
        if isinstance(record, Batch):
            for step_record in record.step_records:
                self._follow_step(step_record)

    def _follow_event(self, event: ProcessEvent) -> None:
        name, what, now_s = event.who, event.kind, event.now_ns * 1e-9
        if what in _BEGINNINGS:
            self._away.setdefault(name, (what, now_s))
            if what == "kill" and name in self.trails:
                self.deaths_m.append(self.trails[name].end_m)
        elif what in _ENDS and name in self._away:
            cause, from_s = self._away.pop(name)
            self.outages.append(Outage(name, cause, from_s, now_s))

    def _follow_step(self, step_record: StepRecord) -> None:
        outputs, verdict = step_record.outputs, step_record.verdict
        if outputs is None or verdict is None:
            return
        if self.scenario.merge == "min":
            self._lower(outputs.lowered)
        elif not {"step", "energy", "units"} & set(verdict.violations):
            self._spend(outputs.spent)
        if step_record.name == SUPERVISOR:
            return
        self.trails[step_record.name].extend(verdict.pose.x_m, verdict.pose.y_m)
        if step_record.heard and self.contact_s is None:
            self.contact_s = step_record.now_ns * 1e-9
        if outputs.state is State.FINISHED:
            self._finished_ns.setdefault(step_record.name, step_record.now_ns)

    def _lower(self, packed: bytes) -> None:
        """Lower the common view: with the minimum merge it is the least weight that any robot has published."""
        pairs = self._pairs.decode(packed, self._left.shape[0])
        if pairs is not None:
            np.minimum.at(self._left, *pairs)

    def _spend(self, packed: bytes) -> None:
        """Spend in the common view: with the ledger it is the first weight less all spending."""
        pairs = self._pairs.decode(packed, self._left.shape[0])
        if pairs is not None:
            np.subtract.at(self._left, *pairs)
