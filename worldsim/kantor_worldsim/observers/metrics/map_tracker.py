"""What the robots of a mapping run have seen, followed once for all referees.

Everything is made anew from the record: a robot's evidence is what its recorded scans say (`Evidence`),
and what it holds of others are the prefixes of their logs that its version vectors name. What it says
otherwise is a fault, noted here as numbers and put into words by the checker.

Only cells that can ever be seen count (`starts.observable`). Ticks are periods. A cell is stamped with
the tick of the step in which somebody first took in a scan of it.
"""

import math

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import NOWHERE
from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import Observation, ParticipantId, Pose
from kantor_protocol.replication.occupancy_log import OccupancyLog, entries
from kantor_protocol.wire.messages import RefusedError
from kantor_worldsim.observers.metrics.map_tracker_kernels import (
    FAULTS,
    FAULTS_MAX,
    FRONTIERS,
    HELD_CELLS,
    LOG_BYTES,
    MADE,
    NEVER,
    OWN,
    OWN_CELLS,
    SEEN,
    STOOD,
    TOLD,
    VOID,
    VOID_CELLS,
    VOIDS,
    GroundTruth,
    MapTrackerState,
    find_way,
    follow,
    look,
)
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch, ColumnarDecoder
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, Record
from kantor_worldsim.world.starts import observable
from kantor_worldsim.world.world import StepVerdict


class MapTracker:
    """Follows the records of a mapping run. Several referees may share one; each record counts once.

    Whoever wants to know how things stood before a record asks before anybody hands it on.
    """

    def __init__(self, decoder: ColumnarDecoder | None = None) -> None:
        """reader: the one that another referee of the same run reads by."""
        self._decoder = decoder or ColumnarDecoder()
        self._record: Record | None = None

    def observe(self, record: Record) -> None:
        """Follow one record. The first must be an opening with a true map; raises RefusedError."""
        if record is self._record:
            return
        self._record = record
        if isinstance(record, Opening):
            self._open(record)
        elif isinstance(record, Batch):
            self._follow(record)
        elif isinstance(record, ProcessEvent) and record.kind in {"start", "join"}:
            self._take_over(record)

    def _open(self, opening: Opening) -> None:
        self._decoder.read(opening)
        scenario, site = opening.scenario, opening.site
        if site.ground is None:
            raise RefusedError("a mission on a map, and no map in its opening")
        self.ground, self.frame = site.ground, site.ground.frame
        self.observable = observable(site.ground, site.starts_m)
        """(rows, columns)"""
        self.total = int(self.observable.sum())
        """How many cells can ever be seen."""
        self.tick = 0
        robots, cells, everybody = scenario.robots.count, self.frame.cells, len(scenario.roster)
        assert entries(self.frame) < 2**31
        self.state = MapTrackerState(
            first_tick=np.full(cells, NEVER, dtype=np.int32),
            frontier=np.zeros(cells, dtype=np.bool_),
            held=np.zeros((robots, cells), dtype=np.uint8),
            made=np.zeros((everybody, 4096), dtype=np.int32),
            told=np.zeros((everybody, 4096), dtype=np.int32),
            version_vector=np.zeros((everybody, everybody), dtype=np.int64),
            folded=np.zeros((robots, everybody), dtype=np.int64),
            written=np.zeros((everybody, 4), dtype=np.int64),
            slots=np.arange(everybody),
            counts=np.zeros((robots, 3), dtype=np.int64),
            stood=np.full((robots, 256), NEVER, dtype=np.int32),
            union=np.zeros(4, dtype=np.int64),
            faults=np.zeros((FAULTS_MAX, 5), dtype=np.int64),
        )
        self._ground = GroundTruth(
            np.ascontiguousarray(self.ground.cells),
            self.observable.ravel(),
            scenario.sensor.noise_m == 0.0,
        )
        self._arguments = (*self.state, *self._ground)
        self.poses_m: list[tuple[float, float]] = [(x, y) for x, y in site.starts_m.tolist()]
        """Where the robots are, world frame."""
        self.ways_m = [0.0] * robots
        """How far each has driven."""
        self.bumps: list[tuple[float, float]] = []
        """Where robots ended a move at a wall."""
        self._patience = scenario.planner.patience
        self._strived: list[tuple[tuple[float, float] | None, int]] = [(None, 0)] * robots
        """The goal of each, and for how many steps it has been that."""
        self.completed_tick: int | None = None
        self.t95_tick: int | None = None
        self.t99_tick: int | None = None
        self.all_t99_tick: int | None = None
        self._period_ns = scenario.period_ns
        self.places = {name: i for i, name in enumerate(scenario.robot_ids)}
        """Of the robots, in the order of the roster."""
        self._queue = np.zeros(cells, dtype=np.int32)
        self._scenario = scenario
        self._evidence = [self._new_evidence() for _ in range(robots)]
        self._looked: list[tuple[int, Pose | None]] = [(NEVER, None)] * robots
        for place in range(robots):
            self._stand(place, self.cell_of(place))

    @property
    def seen(self) -> int:
        """Cells that anybody has seen."""
        return self.state.union.item(SEEN)

    @property
    def stamps(self) -> npt.NDArray[np.int32]:
        """(seen,) the ticks at which the cells that count were first seen."""
        ticks = self.state.first_tick[self._ground.counting]
        return np.asarray(ticks[ticks >= 0])

    @property
    def own_cells(self) -> npt.NDArray[np.int64]:
        """(n,) how many cells each robot has seen itself; a view."""
        return self.state.counts[:, OWN_CELLS]

    @property
    def held_cells(self) -> npt.NDArray[np.int64]:
        """(n,) how many cells each robot knows; a view."""
        return self.state.counts[:, HELD_CELLS]

    @property
    def log_bytes(self) -> int:
        """Of logs in all that robots have sent."""
        return self.state.union.item(LOG_BYTES)

    @property
    def faults(self) -> tuple[npt.NDArray[np.int64], int]:
        """Of the last batch, as in Books, and how many there are."""
        count = self.state.union.item(FAULTS)
        return self.state.faults[: min(count, FAULTS_MAX)], count

    def cell_of(self, place: int) -> int:
        """The cell in which a robot is, or NOWHERE."""
        x_m, y_m = self.poses_m[place]
        return self.frame.cell_of(x_m, y_m) if math.isfinite(x_m + y_m) else NOWHERE

    def reachable(self, name: ParticipantId) -> int:
        """A frontier that a robot can reach by all that it holds, or NEVER.

        Frontiers that it may have called none in entries that it has not sent yet do not count.
        """
        place, state = self.places[name], self.state
        start = self.cell_of(place)
        if start == NOWHERE:
            return NEVER
        held = state.held[place]
        slot = state.slots[place]
        untold = (
            state.version_vector[place, slot]
            > state.written[slot, MADE] + state.written[slot, VOIDS]
        )
        while True:
            cell = int(find_way(held, start, self.frame.columns, self._queue))
            if cell == NEVER or not untold or not self._is_near(place, cell):
                return cell
            held[cell] |= VOID

    def _is_near(self, place: int, cell: int) -> bool:
        stood = self.state.stood[place, : self.state.counts[place, STOOD]]
        row, column = divmod(cell, self.frame.columns)
        apart = np.maximum(
            abs(stood // self.frame.columns - row), abs(stood % self.frame.columns - column)
        )
        return bool((apart <= VOID_CELLS).any())

    def _follow(self, batch: Batch) -> None:
        self.state.union[FAULTS] = 0
        self.tick = batch.now_ns // self._period_ns
        columns = ColumnarBatch(*self._decoder.read(batch))
        acted = [
            (row, self.places[step_record.name], step_record)
            for row, step_record in enumerate(batch.step_records)
            if step_record.name in self.places
            and step_record.outputs is not None
            and step_record.verdict is not None
        ]
        for row, place, step_record in acted:
            self._look(place, step_record.observation, row)
        step_records = columns.step_records[: columns.sizes[of.ACTS]]
        self._reserve("told", "written", TOLD, int(step_records[:, of.BODY_BYTES].max(initial=0)))
        follow(*columns, *self._arguments)
        for _, place, step_record in acted:
            assert step_record.verdict is not None
            assert step_record.outputs is not None
            self._move(place, step_record.verdict)
            self._strive(place, step_record.outputs.goal)
        self._note_moments()

    def _new_evidence(self) -> OccupancyLog:
        scenario = self._scenario
        return OccupancyLog(self.frame, scenario.sensor, ranges=scenario.learns_ranges)

    def _take_over(self, incident: ProcessEvent) -> None:
        """A new incarnation of a robot knows nothing, and writes a new log."""
        names = self._scenario.roster
        if incident.who not in names:
            return
        who, roster = names.index(incident.who), len(names)
        slot = incident.incarnation * roster + who
        if not self.state.slots[who] < slot <= INCARNATIONS_MAX * roster + who:
            return
        while slot >= self.state.version_vector.shape[1]:
            self._add_slots(roster)
        state = self.state
        state.slots[who] = slot
        state.version_vector[who] = 0
        if who < state.held.shape[0]:
            state.held[who] &= OWN  # a body counts a cell once
            state.folded[who] = 0
            state.counts[who, [HELD_CELLS, STOOD]] = 0
            self._evidence[who] = self._new_evidence()
            self._looked[who], self._strived[who] = (NEVER, None), (None, 0)
            self._stand(who, self.cell_of(who))

    def _add_slots(self, more: int) -> None:
        """Room for another incarnation of everybody."""
        state = self.state
        self.state = state._replace(
            made=np.pad(state.made, ((0, more), (0, 0))),
            told=np.pad(state.told, ((0, more), (0, 0))),
            written=np.pad(state.written, ((0, more), (0, 0))),
            version_vector=np.pad(state.version_vector, ((0, 0), (0, more))),
            folded=np.pad(state.folded, ((0, 0), (0, more))),
        )
        self._arguments = (*self.state, *self._ground)

    def _look(self, place: int, observation: Observation, row: int) -> None:
        """A robot takes in each new scan once; it learns of ranges when it has moved."""
        step, before = self._looked[place]
        if observation.step <= step:
            return
        pose = observation.pose
        self._looked[place] = observation.step, pose
        news = self._evidence[place].observe(observation.scan, pose, moved=pose != before)
        if news.shape[0]:
            self._reserve("made", "written", MADE, news.shape[0])
            look(*self._arguments, news, place, row, self.tick)

    def _move(self, place: int, verdict: StepVerdict) -> None:
        x_m, y_m = self.poses_m[place]
        pose = verdict.pose
        if verdict.bumped:
            self.bumps.append((pose.x_m, pose.y_m))
        if (pose.x_m, pose.y_m) != (x_m, y_m):
            self.ways_m[place] += math.hypot(pose.x_m - x_m, pose.y_m - y_m)
            self.poses_m[place] = pose.x_m, pose.y_m
            self._stand(place, self.cell_of(place))

    def _strive(self, place: int, goal: tuple[float, float] | None) -> None:
        """A robot that has headed for the same goal for long enough may speak of it as if it stood there."""
        before, steps = self._strived[place]
        self._strived[place] = goal, steps + 1 if goal == before else 1
        if goal is None or self._strived[place][1] != self._patience:
            return
        cell = self.frame.cell_of(*goal)
        if cell != NOWHERE:
            self._stand(place, cell)

    def _stand(self, place: int, cell: int) -> None:
        """Note the cell in which a robot is."""
        count = self.state.counts.item(place, STOOD)
        if count and self.state.stood.item(place, count - 1) == cell:
            return
        self._reserve("stood", "counts", STOOD, 1)
        self.state.stood[place, count] = cell
        self.state.counts[place, STOOD] += 1

    def _reserve(self, name: str, counted: str, column: int, more: int) -> None:
        """Room for so many more entries in one of the arrays that grow with the run."""
        rows = getattr(self.state, name)
        needed = int(getattr(self.state, counted)[:, column].max()) + more
        if needed <= rows.shape[1]:
            return
        longer = np.zeros((rows.shape[0], 2 * needed), dtype=rows.dtype)
        longer[:, : rows.shape[1]] = rows
        self.state = self.state._replace(**{name: longer})
        self._arguments = (*self.state, *self._ground)

    def _note_moments(self) -> None:
        """When the union was complete, and when nearly everything was known to somebody, to everybody."""
        seen, total, tick = self.seen, self.total, self.tick
        if self.completed_tick is None and seen and not self.state.union[FRONTIERS]:
            self.completed_tick = tick
        if self.t95_tick is None and 100 * seen >= 95 * total:
            self.t95_tick = tick
        if self.t99_tick is None and 100 * seen >= 99 * total:
            self.t99_tick = tick
        if self.all_t99_tick is None and self.t99_tick is not None:
            least = int(self.held_cells.min())
            self.all_t99_tick = tick if 100 * least >= 99 * total else None
