"""Metrics that every run has, on a density or on a map."""

from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from kantor_protocol.base.counter_rng import Purpose
from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.base.random_walk import RandomWalk
from kantor_protocol.scenario.faults.liars import liars_of
from kantor_protocol.scenario.faults.schedule import kind_of
from kantor_protocol.transport.rate_limit import Excess
from kantor_worldsim.observers.metrics.result import (
    LINK_COUNTERS,
    BytesPerRobotTick,
    FaultCounts,
    RefusedReports,
    Rejoining,
    Result,
)
from kantor_worldsim.observers.metrics.tally import (
    BYTES_TOTAL,
    BYTES_WEIGHTS,
    DELIVERIES,
    DROPS,
    ENERGY,
    FIRST_CONTACT,
    LEAST,
    NEVER,
    NOW,
    REFUSED_BEFORE,
    STANDING,
    STEPS,
    VIOLATIONS,
    RunTally,
    begin_anew,
    follow,
)
from kantor_worldsim.record.columnar import DecodedRecord
from kantor_worldsim.record.process_events import EVENTS, TAKE_OVER, ProcessEventKind
from kantor_worldsim.record.records import Batch, Ending, Opening, ProcessEvent

_ROWS_OF_RATE = 10
"""Rows over which a rate is taken."""


class Snapshot(NamedTuple):
    """The state of a run in a few numbers, cheap to get at any time."""

    now_ns: int
    energy_spent: int
    detected: int
    targets: int
    w_ub: float
    links: int
    messages_per_s: float
    """Deliveries a simulated second over the last ten rows."""
    robots_done: int
    mass_left: float
    """On a map the share of cells that no robot has seen."""
    distance_m: float | None = None
    """On a map: what all robots have driven."""


class RunMetrics:
    """Follows the records of one run and measures what every kind of mission has.

    A kind of mission adds its own measures: `_begin`, `_attend`, `_row`, `_snapshot_of` and `_measured`.
    """

    columns: ClassVar[tuple[str, ...]]
    """The names in a row."""

    def __init__(self, on_row: Callable[[Any], None] = lambda _row: None) -> None:
        """on_row: called with each row when it is complete."""
        self._on_row = on_row
        self.rows: list[Any] = []
        self.keeps_rows = True
        """Whether all rows stay in memory, and not the first and the last ones alone."""
        self.finds: list[tuple[float, ParticipantId, int, float, float]] = []
        """(time, robot, target, x, y), world frame."""
        self._opening: Opening | None = None
        self._every = 1
        """Periods from one row to the next."""

    def observe(self, decoded: DecodedRecord, /) -> None:
        """Follow one record."""
        record = decoded.record
        if isinstance(record, Opening):
            self._open(record)
        elif isinstance(record, Batch):
            self._follow(record, decoded)
        elif isinstance(record, ProcessEvent):
            self._follow_event(record)
        elif isinstance(record, Ending):
            self._ending = record
            self._row(last=True)

    def _open(self, opening: Opening) -> None:
        scenario, setup = opening.scenario, opening.setup
        self._opening, self._scenario, self._units = opening, scenario, opening.units
        self._period_ns = scenario.period_ns
        self._walk = RandomWalk(
            setup.samples_m,
            scenario.samples.diffusion_m,
            self._period_ns,
            opening.seed,
            Purpose.SAMPLE_WALK,
        )
        names, samples, robots = scenario.roster, setup.samples_m.shape[0], scenario.robots.count
        self._targets = setup.targets_m.shape[0]
        self._tally = RunTally(
            counts=np.zeros(11, dtype=np.int64),
            shipped=np.zeros(2),
            standing=np.zeros(len(names), dtype=STANDING),
            shipped_by=np.zeros(robots),
            xy_m=setup.starts_m.copy(),
            views=np.full((len(names), samples), float(self._units.sample)),
            least=np.full(samples, self._units.sample, dtype=np.int64),
            true_left=np.full(samples, self._units.sample, dtype=np.int64),
        )
        self._tally.counts[FIRST_CONTACT] = NEVER
        self._tally.counts[LEAST] = self._units.whole
        self._tally.standing["finished_step"] = NEVER
        liars = liars_of(scenario.faults)
        self._tally.standing["lies"] = [name in liars for name in names]
        self._fields = tuple(self._tally)
        self._out_of_range = self._absences = 0
        self._fault_counts = Counter[tuple[int, str]]()
        self._restarts = 0
        self._incarnations = dict.fromkeys(names, 0)
        self._gone: set[ParticipantId] = set()
        self._started_ns: dict[ParticipantId, int] = {}
        """Participants that have started again and not stepped yet, and when that was."""
        self._rejoined_ns: list[int] = []
        self._ending = Ending(0, "cut")
        self._tick = 0
        for name, found in opening.first_look.items():
            self.finds += [(0.0, name, target, x, y) for target, x, y in found]
        self._begin(opening)
        self._row()

    def _follow(self, batch: Batch, decoded: DecodedRecord) -> None:
        tick = batch.now_ns // self._period_ns
        if tick != self._tick:
            if self._tick and self._tick % self._every == 0:
                self._row()
            self._tick, self._tally.shipped[NOW] = tick, 0.0
        self._walk.advance(batch.now_ns)
        self._out_of_range += batch.out_of_range
        self._absences += len(batch.absent)
        for stats in batch.fault_stats:
            for counter in LINK_COUNTERS:
                self._fault_counts[stats.fault, counter] += getattr(stats, counter)
        if self._started_ns:
            self._note_rejoining(batch)
        if follow(decoded.columns, self._fields, self._walk.xy_m, self._units.whole):
            self._note_finds(batch)
        self._attend(batch, decoded)

    def _follow_event(self, event: ProcessEvent) -> None:
        """Follow an event of a process."""
        name, kind = event.who, event.kind
        if event.fault >= 0 and (counter := EVENTS[kind].counter):
            self._fault_counts[event.fault, counter] += 1
        if kind in {ProcessEventKind.KILL, ProcessEventKind.LEAVE}:
            self._gone.add(name)
            self._started_ns.pop(name, None)
        elif kind in TAKE_OVER:
            self._restarts += name in self._gone
            if name in self._incarnations:
                self._begin_incarnation(event)
            self._gone.discard(name)

    def _begin_incarnation(self, process_event: ProcessEvent) -> None:
        name = process_event.who
        if name in self._gone:
            self._started_ns[name] = process_event.now_ns
        if process_event.incarnation <= self._incarnations[name]:
            return
        self._incarnations[name] = process_event.incarnation
        place = self._scenario.roster.index(name)
        begin_anew(self._fields, place, self._units.sample)

    def _note_rejoining(self, batch: Batch) -> None:
        for step_record in batch.step_records:
            if step_record.outputs is not None and step_record.name in self._started_ns:
                started_ns = self._started_ns.pop(step_record.name)
                self._rejoined_ns.append(max(0, batch.now_ns - started_ns))

    @property
    def steps(self) -> int:
        """Steps of all robots so far."""
        return self._tally.counts.item(STEPS)

    @property
    def deliveries(self) -> int:
        """Copies that have arrived or will, so far."""
        return self._tally.counts.item(DELIVERIES)

    @property
    def drops(self) -> int:
        """Copies that were lost, so far."""
        return self._tally.counts.item(DROPS)

    def _note_finds(self, batch: Batch) -> None:
        for step_record in batch.step_records:
            if step_record.verdict is not None and step_record.outputs is not None:
                time_s = step_record.now_ns * 1e-9
                self.finds += [
                    (time_s, step_record.name, target, x, y)
                    for target, x, y in step_record.verdict.found
                ]

    def _begin(self, opening: Opening) -> None:
        """Prepare for the run, before its first row."""
        raise NotImplementedError

    def _attend(self, batch: Batch, decoded: DecodedRecord) -> None:
        """Follow a batch that has been counted."""

    def _add_row(self, row: Any) -> None:
        if not self.keeps_rows and len(self.rows) > 2 * _ROWS_OF_RATE:
            del self.rows[1:-_ROWS_OF_RATE]
        self.rows.append(row)
        self._on_row(row)

    def _row(self, *, last: bool = False) -> None:
        """Measure, and add a row."""
        raise NotImplementedError

    def _snapshot_of(self) -> dict[str, Any]:
        """The fields `w_ub` and `mass_left` of a Snapshot, and others that it may have, by the last row."""
        raise NotImplementedError

    def _ended(self) -> str:
        """How the mission ended."""
        return self._ending.reason

    def _measured(self) -> dict[str, Any]:
        """The fields of a Result beside the counts."""
        raise NotImplementedError

    def snapshot(self) -> Snapshot:
        """The state of the run, by the last row."""
        if not self.rows:
            return Snapshot(0, 0, 0, 0, 0.0, 0, 0.0, 0, 1.0)
        last = self.rows[-1]
        before = self.rows[max(0, len(self.rows) - _ROWS_OF_RATE - 1)]
        elapsed_s = last.time_s - before.time_s
        rate = (last.deliveries - before.deliveries) / elapsed_s if elapsed_s > 0.0 else 0.0
        return Snapshot(
            now_ns=round(last.time_s * 1e9),
            energy_spent=int(self._tally.counts[ENERGY]),
            detected=len(self.finds),
            targets=self._targets,
            links=last.links,
            messages_per_s=rate,
            robots_done=int(self._tally.standing["rests"].sum()),
            **self._snapshot_of(),
        )

    def result(
        self,
        *,
        exchange: str,
        digest: str,
        wall_s: float,
        refused_at_door: int = 0,
        excess: Mapping[ParticipantId, Excess] = MappingProxyType({}),
        refused_reports: Mapping[ParticipantId, RefusedReports] = MappingProxyType({}),
        silences: Mapping[ParticipantId, int] = MappingProxyType({}),
        record: str,
        complaints: tuple[str, ...],
        lies: Mapping[ParticipantId, int] = MappingProxyType({}),
    ) -> Result:
        """The summary; call it after the last record. complaints: the violations that checkers found.

        lies: how often each declared liar has said what is against the rules.
        """
        scenario, counts = self._scenario, self._tally.counts.tolist()
        robots = scenario.robots.count
        finished = self._tally.standing["finished_step"][:robots].tolist()
        steps = max(1, counts[STEPS])
        assert self._opening is not None
        return Result(
            scenario=scenario.name,
            seed=self._opening.seed,
            exchange=exchange,
            clock=scenario.clock.order,
            planner=scenario.planner.name,
            merge=scenario.merge,
            claims=scenario.claiming,
            robots=robots,
            ticks=self._tick,
            finished_tick=None if NEVER in finished else max(finished),
            first_contact_tick=None if counts[FIRST_CONTACT] == NEVER else counts[FIRST_CONTACT],
            detected=len(self.finds),
            targets=self._targets,
            detection_rate=len(self.finds) / self._targets if self._targets else None,
            energy_spent=counts[ENERGY],
            bytes_per_robot_tick=BytesPerRobotTick(
                counts[BYTES_WEIGHTS] / steps, counts[BYTES_TOTAL] / steps
            ),
            deliveries=counts[DELIVERIES],
            drops=counts[DROPS],
            out_of_range_refused=self._out_of_range,
            messages_refused=int(self._tally.standing["refused"].sum())
            + counts[REFUSED_BEFORE]
            + refused_at_door,
            absences=self._absences,
            ended=self._ended(),
            record=record,
            violations=counts[VIOLATIONS] + len(complaints),
            complaints=complaints[:10],
            digest=digest,
            wall_s=wall_s,
            faults={
                f"{i} {kind_of(fault)}": FaultCounts(
                    **{name: self._fault_counts[i, name] for name in FaultCounts.__struct_fields__}
                )
                for i, fault in enumerate(scenario.faults)
            },
            restarts=self._restarts,
            incarnations=sum(self._incarnations.values()),
            rejoin_s=Rejoining.of(self._rejoined_ns),
            excess=dict(excess),
            refused_reports=dict(refused_reports),
            lies=dict(lies),
            silences=dict(silences),
            **self._measured(),
        )
