"""The cells that the robots of a mapping run have seen, followed once for all observers.

Everything is derived from the record again: a robot's evidence follows from its recorded scans
(`OccupancyLog`), and what it holds of others are the prefixes of their logs that its version vectors name.
Messages that say otherwise are violations, noted here as numbers and put into words by the checker.

Only cells that can ever be seen count (`starts.observable`). Ticks are periods. A cell is stamped with
the tick of the step in which a robot first took in a scan of it.
"""

import math

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.grid import FREE, NOWHERE
from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.machine import Observation, ParticipantId, Pose
from kantor_protocol.replication.occupancy_log import OccupancyLog, entries
from kantor_protocol.scenario.faults.liars import liars_of
from kantor_protocol.wire.messages import RefusedError
from kantor_worldsim.observers.metrics.map_tracker_kernels import (
    AS_SENT,
    DEAD,
    DEAD_FRONTIER_CELLS,
    FRONTIERS,
    HELD_CELLS,
    LOG_BYTES,
    NEVER,
    NOT_SCANNED,
    NOTED,
    OWN,
    OWN_CELLS,
    SCANNED,
    SEEN,
    STOOD,
    VIOLATIONS_MAX,
    GroundTruth,
    MapTrackerState,
    find_way,
    follow,
    take_scan,
)
from kantor_worldsim.record.columnar import ColumnarBatch, DecodedRecord
from kantor_worldsim.record.process_events import TAKE_OVER
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent
from kantor_worldsim.world.starts import observable
from kantor_worldsim.world.world import StepVerdict


class MapTracker:
    """Follows the records of a mapping run."""

    def observe(self, decoded: DecodedRecord, /) -> None:
        """Follow one record. The first must be an opening with a true map; raises RefusedError."""
        record = decoded.record
        if isinstance(record, Opening):
            self.open(record)
        elif isinstance(record, Batch):
            self._follow(record, decoded)
        elif isinstance(record, ProcessEvent):
            self.follow_event(record)

    def follow_event(self, event: ProcessEvent) -> None:
        """Follow a process event."""
        if event.kind in TAKE_OVER:
            self._begin_incarnation(event)

    def open(self, opening: Opening) -> None:
        """Begin with the first record. Raises RefusedError if it has no true map."""
        scenario, setup = opening.scenario, opening.setup
        if setup.ground is None:
            raise RefusedError("a mission on a map, and no map in its opening")
        self.ground, self.frame = setup.ground, setup.ground.frame
        self.observable = observable(setup.ground, setup.starts_m)
        """(rows, columns)"""
        self.total = int(self.observable.sum())
        """The number of cells that can ever be seen."""
        self.tick = 0
        robots, cells, count = scenario.robots.count, self.frame.cells, len(scenario.roster)
        assert entries(self.frame) < 2**31
        liars = liars_of(scenario.faults)
        self.state = MapTrackerState(
            first_tick=np.full(cells, NEVER, dtype=np.int32),
            frontier=np.zeros(cells, dtype=np.bool_),
            held=np.zeros((robots, cells), dtype=np.uint8),
            scanned=np.zeros((count, 4096), dtype=np.int32),
            as_sent=np.zeros((count, 4096), dtype=np.int32),
            version_vector=np.zeros((count, count), dtype=np.int64),
            folded=np.zeros((robots, count), dtype=np.int64),
            written=np.zeros((count, 4), dtype=np.int64),
            incarnation_ids=np.arange(count),
            counts=np.zeros((robots, 3), dtype=np.int64),
            stood=np.full((robots, 256), NEVER, dtype=np.int32),
            totals=np.zeros(4, dtype=np.int64),
            violations=np.zeros((VIOLATIONS_MAX, 5), dtype=np.int64),
            lies=np.array([name in liars for name in scenario.roster]),
        )
        self._ground = GroundTruth(
            np.ascontiguousarray(self.ground.cells),
            self.observable.ravel(),
            scenario.sensor.noise_m == 0.0,
        )
        self._arguments = (tuple(self.state), tuple(self._ground))
        self._sent_at_most = 0
        """No log has more entries that were sent: an entry takes a byte."""
        self.poses_m: list[tuple[float, float]] = [(x, y) for x, y in setup.starts_m.tolist()]
        """Where the robots are, world frame."""
        self.ways_m = [0.0] * robots
        """The distance that each has driven."""
        self.bumps: list[tuple[float, float]] = []
        """Where robots ended a move at a wall."""
        self._patience = scenario.planner.patience
        self._pursued: list[tuple[tuple[float, float] | None, int]] = [(None, 0)] * robots
        """The goal of each, and for how many steps it has had it."""
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
        self._scanned: list[tuple[int, Pose | None]] = [(NEVER, None)] * robots
        for place in range(robots):
            self._stand(place, self.cell_of(place))

    @property
    def seen(self) -> int:
        """Cells that any robot has seen."""
        return self.state.totals.item(SEEN)

    @property
    def unseen(self) -> int:
        """Free cells that robots could reach and that none has seen."""
        free = self._ground.counting & (self._ground.truth.ravel() == FREE)
        return int((free & (self.state.first_tick == NEVER)).sum())

    @property
    def frontiers(self) -> int:
        """Free cells that robots have seen and could reach, with a neighbour that none has seen."""
        return self.state.totals.item(FRONTIERS)

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
        """Bytes of logs in all that robots have sent."""
        return self.state.totals.item(LOG_BYTES)

    @property
    def violations(self) -> tuple[npt.NDArray[np.int64], int]:
        """The violations in the last batch, as in MapTrackerState, and how many there are."""
        count = self.state.totals.item(NOTED)
        return self.state.violations[: min(count, VIOLATIONS_MAX)], count

    def cell_of(self, place: int) -> int:
        """The cell in which a robot is, or NOWHERE."""
        x_m, y_m = self.poses_m[place]
        return self.frame.cell_of(x_m, y_m) if math.isfinite(x_m + y_m) else NOWHERE

    def reachable(self, name: ParticipantId) -> int:
        """A frontier that a robot can reach by all that it holds, or NEVER.

        Frontiers that it may have declared dead in entries that it has not sent yet do not count.
        """
        place, state = self.places[name], self.state
        start = self.cell_of(place)
        if start == NOWHERE:
            return NEVER
        held = state.held[place]
        own = state.incarnation_ids[place]
        known = state.written[own, SCANNED] + state.written[own, NOT_SCANNED]
        unsent = state.version_vector[place, own] > known
        while True:
            cell = int(find_way(held, start, self.frame.columns, self._queue))
            if cell == NEVER or not unsent or not self._is_near(place, cell):
                return cell
            held[cell] |= DEAD

    def _is_near(self, place: int, cell: int) -> bool:
        stood = self.state.stood[place, : self.state.counts[place, STOOD]]
        row, column = divmod(cell, self.frame.columns)
        apart = np.maximum(
            abs(stood // self.frame.columns - row), abs(stood % self.frame.columns - column)
        )
        return bool((apart <= DEAD_FRONTIER_CELLS).any())

    def _follow(self, batch: Batch, decoded: DecodedRecord) -> None:
        self.state.totals[NOTED] = 0
        self.tick = batch.now_ns // self._period_ns
        columns = ColumnarBatch(*decoded.columns)
        stepped = [
            (row, self.places[step_record.name], step_record)
            for row, step_record in enumerate(batch.step_records)
            if step_record.name in self.places
            and step_record.outputs is not None
            and step_record.verdict is not None
        ]
        for row, place, step_record in stepped:
            self._take_scan(place, step_record.observation, row)
        self._sent_at_most += len(columns.payload)
        if self._sent_at_most > self.state.as_sent.shape[1]:
            self._sent_at_most = int(self.state.written[:, AS_SENT].max()) + len(columns.payload)
            self._reserve("as_sent", self._sent_at_most)
        follow(decoded.columns, *self._arguments)
        for _, place, step_record in stepped:
            assert step_record.verdict is not None
            assert step_record.outputs is not None
            self._move(place, step_record.verdict)
            self._follow_goal(place, step_record.outputs.goal)
        self._note_moments()

    def _new_evidence(self) -> OccupancyLog:
        scenario = self._scenario
        return OccupancyLog(self.frame, scenario.sensor, ranges=scenario.learns_ranges)

    def _begin_incarnation(self, process_event: ProcessEvent) -> None:
        """A new incarnation of a robot knows nothing, and writes a new log."""
        names = self._scenario.roster
        if process_event.who not in names:
            return
        who, roster = names.index(process_event.who), len(names)
        incarnation_id = process_event.incarnation * roster + who
        if not self.state.incarnation_ids[who] < incarnation_id <= INCARNATIONS_MAX * roster + who:
            return
        while incarnation_id >= self.state.version_vector.shape[1]:
            self._add_incarnations(roster)
        state = self.state
        state.incarnation_ids[who] = incarnation_id
        state.version_vector[who] = 0
        if who < state.held.shape[0]:
            state.held[who] &= OWN  # a body counts a cell once
            state.folded[who] = 0
            state.counts[who, [HELD_CELLS, STOOD]] = 0
            self._evidence[who] = self._new_evidence()
            self._scanned[who], self._pursued[who] = (NEVER, None), (None, 0)
            self._stand(who, self.cell_of(who))

    def _add_incarnations(self, more: int) -> None:
        """Make room for another incarnation of every participant."""
        state = self.state
        self.state = state._replace(
            scanned=np.pad(state.scanned, ((0, more), (0, 0))),
            as_sent=np.pad(state.as_sent, ((0, more), (0, 0))),
            written=np.pad(state.written, ((0, more), (0, 0))),
            version_vector=np.pad(state.version_vector, ((0, 0), (0, more))),
            folded=np.pad(state.folded, ((0, 0), (0, more))),
        )
        self._arguments = (tuple(self.state), tuple(self._ground))

    def _take_scan(self, place: int, observation: Observation, row: int) -> None:
        """A robot takes in each new scan once; it learns of ranges when it has moved."""
        step, before = self._scanned[place]
        if observation.step <= step:
            return
        pose = observation.pose
        self._scanned[place] = observation.step, pose
        seen = self._evidence[place].observe(observation.scan, pose, moved=pose != before)
        if seen.shape[0]:
            written = self.state.written.item(self.state.incarnation_ids.item(place), SCANNED)
            self._reserve("scanned", written + seen.shape[0])
            take_scan(*self._arguments, seen, place, row, self.tick)

    def _move(self, place: int, verdict: StepVerdict) -> None:
        x_m, y_m = self.poses_m[place]
        pose = verdict.pose
        if verdict.bumped:
            self.bumps.append((pose.x_m, pose.y_m))
        if (pose.x_m, pose.y_m) != (x_m, y_m):
            self.ways_m[place] += math.hypot(pose.x_m - x_m, pose.y_m - y_m)
            self.poses_m[place] = pose.x_m, pose.y_m
            self._stand(place, self.cell_of(place))

    def _follow_goal(self, place: int, goal: tuple[float, float] | None) -> None:
        """A robot that has headed for a goal for `patience` steps may declare it dead as if it stood there."""
        before, steps = self._pursued[place]
        self._pursued[place] = goal, steps + 1 if goal == before else 1
        if goal is None or self._pursued[place][1] != self._patience:
            return
        cell = self.frame.cell_of(*goal)
        if cell != NOWHERE:
            self._stand(place, cell)

    def _stand(self, place: int, cell: int) -> None:
        """Note the cell in which a robot is."""
        count = self.state.counts.item(place, STOOD)
        if count and self.state.stood.item(place, count - 1) == cell:
            return
        self._reserve("stood", count + 1)
        self.state.stood[place, count] = cell
        self.state.counts[place, STOOD] += 1

    def _reserve(self, name: str, needed: int) -> None:
        """Make room for so many entries of each in one of the arrays that grow with the run."""
        rows = getattr(self.state, name)
        if needed <= rows.shape[1]:
            return
        longer = np.zeros((rows.shape[0], 2 * needed), dtype=rows.dtype)
        longer[:, : rows.shape[1]] = rows
        self.state = self.state._replace(**{name: longer})
        self._arguments = (tuple(self.state), tuple(self._ground))

    def _note_moments(self) -> None:
        """Note the ticks at which the map was complete, and nearly all of it was known to a robot, to every robot."""
        seen, total, tick = self.seen, self.total, self.tick
        if self.completed_tick is None and seen and not self.state.totals[FRONTIERS]:
            self.completed_tick = tick
        if self.t95_tick is None and 100 * seen >= 95 * total:
            self.t95_tick = tick
        if self.t99_tick is None and 100 * seen >= 99 * total:
            self.t99_tick = tick
        if self.all_t99_tick is None and self.t99_tick is not None:
            least = int(self.held_cells.min())
            self.all_t99_tick = tick if 100 * least >= 99 * total else None
