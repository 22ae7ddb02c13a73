"""What a run is measured by, from its records alone.

The bound of Theorems 1-3 has two terms: what was shipped (each robot point with the distance to what
it filled) and what is pending (weight that is left, as if shipped from where the robots stand).

paper
    Eq. 6, 11 and 12: all that was ever shipped, plus the pending term summed over robots. With a
    supervisor every robot counts the common weights; without one each counts its own vector, over the
    whole team (what the paper's figure 7f can only be, since Theorem 3 taken over neighbours rises
    when neighbours meet).
local
    Theorem 3 to the letter: robot k counts itself and whoever is in its range now, with its own vector.
    It rises when robots meet, since neighbours join the sum; the rows give the least and the largest.
tight
    The true remaining weights shipped once, an equal share by each robot (`bounds.py`), where eq. 11
    ships them once for every robot. A bound only while no sample was filled twice and no sample walks,
    else None.
instant
    The last tick's shipping plus the pending term. It is no bound; it is what the paper plots, since
    its final values lie below what any plan costs.

The exact distance, if it is asked for, is between the samples and the ensemble that the bounds are
about: every shipped point where it was shipped, what is left shared evenly by the robots.
"""

import math
from typing import NamedTuple

import msgspec
import numpy as np

from kantor_protocol.kernels import kernel
from kantor_protocol.keyed import Purpose
from kantor_protocol.machine import SUPERVISOR, ParticipantId, State
from kantor_protocol.packing import Pairs
from kantor_protocol.walk import Walk
from kantor_worldsim import exact
from kantor_worldsim.bounds import Auction
from kantor_worldsim.channel import DROPPED, links
from kantor_worldsim.records import Act, Batch, Ending, Opening, Record

_PAIRS_PER_ROW = 200_000
"""Robot-sample distances that one row of metrics may cost when the period is chosen by size."""


class Row(NamedTuple):
    """One row of metrics.csv."""

    tick: int
    time_s: float
    energy_spent: int
    detected: int
    w_ub_paper: float
    w_ub_tight: float | None
    w_ub_instant: float
    mass_left: float
    mass_double_counted: float
    links: int
    deliveries: int
    drops: int
    w_ub_local_min: float | None
    w_ub_local_max: float | None
    w1_exact: float | None = None


class Glance(NamedTuple):
    """How the run stands, cheap to get at any time."""

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


class Bounds(msgspec.Struct, frozen=True):
    """The three readings of W_UB, see the module."""

    paper: float
    tight: float | None
    final_instant: float


class BytesPerRobotTick(msgspec.Struct, frozen=True):
    """What a robot puts on the bus in one step, payload only."""

    weights: float
    """On its weights key."""
    total: float
    """Weights and all radio bodies."""


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """result.json. The names are stable."""

    scenario: str
    seed: int
    exchange: str
    clock: str
    planner: str
    merge: str
    claims: bool
    robots: int
    ticks: int
    finished_tick: int | None
    """The step at which the last robot saw no weight left, or null."""
    first_contact_tick: int | None
    """The step in which a robot first took in another's message, or null."""
    detected: int
    targets: int
    detection_rate: float | None
    w_ub_start: float
    w_ub: Bounds
    w1_exact: float | None
    energy_spent: int
    energy_total: int
    mass_left: float
    mass_double_counted: float
    bytes_per_robot_tick: BytesPerRobotTick
    deliveries: int
    drops: int
    out_of_range_refused: int
    messages_refused: int
    absences: int
    ended: str
    record: str
    """`whole`, or why it was cut."""
    violations: int
    complaints: tuple[str, ...]
    """What the checker found, at most the first ten."""
    digest: str
    wall_s: float


@kernel
def _pending(xy_m: np.ndarray, x: float, y: float, units: np.ndarray) -> float:
    total = 0.0
    for j in range(units.shape[0]):
        if units[j] > 0:
            dx = xy_m[j, 0] - x
            dy = xy_m[j, 1] - y
            total += units[j] * math.sqrt(dx * dx + dy * dy)
    return total


@kernel
def _least(views: np.ndarray, out: np.ndarray) -> None:
    for j in range(out.shape[0]):
        least = views[0, j]
        for k in range(1, views.shape[0]):
            least = min(least, views[k, j])
        out[j] = least


class Metrics:
    """Follows the records of one run."""

    def __init__(self, exact_every: int | None = None) -> None:
        """exact_every: periods from one exact distance to the next; 0: at the end only; None: never."""
        self.rows: list[Row] = []
        self._exact_every = exact_every
        self.finds: list[tuple[float, ParticipantId, int, float, float]] = []
        """(time, robot, target, x, y), world frame."""
        self._opening: Opening | None = None
        self._pairs = Pairs()

    def take(self, record: Record) -> None:
        """Follow one record."""
        if isinstance(record, Opening):
            self._open(record)
        elif isinstance(record, Batch):
            self._follow(record)
        elif isinstance(record, Ending):
            self._ending = record
            self._row(last=True)

    def _open(self, opening: Opening) -> None:
        scenario, site = opening.scenario, opening.site
        self._opening, self._scenario, self._units = opening, scenario, opening.units
        self._period_ns = scenario.period_ns
        self._walk = Walk(
            site.samples_m,
            scenario.samples.diffusion_m,
            self._period_ns,
            opening.seed,
            Purpose.SAMPLE_WALK,
        )
        self._names = scenario.roster
        self._places = {name: i for i, name in enumerate(self._names)}
        samples, robots = site.samples_m.shape[0], scenario.robots.count
        self._targets = site.targets_m.shape[0]
        self._views = np.full((len(self._names), samples), self._units.sample, dtype=np.int64)
        self._true_left = np.full(samples, self._units.sample, dtype=np.int64)
        self._common = np.zeros(samples, dtype=np.int64)
        self._xy_m = site.starts_m.copy()
        size = samples * robots // _PAIRS_PER_ROW
        self._every = scenario.metrics.every or max(1, size)
        self._auction = Auction(robots, samples, self._every)
        self._shipped = 0.0
        self._shipped_by = [0.0] * robots
        self._shipped_now = 0.0
        self._points: list[tuple[float, float, int]] = []
        self._spent_units = 0
        self._energy_spent = 0
        self._deliveries = self._drops = self._out_of_range = self._violations = self._absences = 0
        self._bytes_weights = self._bytes_total = self._steps = 0
        self._refused: dict[ParticipantId, int] = {}
        self._finished: dict[ParticipantId, int] = {}
        self._resting: set[ParticipantId] = set()
        self._first_contact: int | None = None
        self._ending = Ending(0, "cut")
        self._tick = 0
        for name, found in opening.first_look.items():
            self.finds += [(0.0, name, target, x, y) for target, x, y in found]
        self._row()

    def _follow(self, batch: Batch) -> None:
        tick = batch.now_ns // self._period_ns
        if tick != self._tick:
            if self._tick and self._tick % self._every == 0:
                self._row()
            self._tick, self._shipped_now = tick, 0.0
        self._walk.advance(batch.now_ns)
        self._out_of_range += batch.out_of_range
        self._absences += len(batch.absent)
        for verdict in batch.verdicts:
            if verdict.due_ns == DROPPED:
                self._drops += 1
            else:
                self._deliveries += 1
        for act in batch.acts:
            self._follow_act(act)

    def _follow_act(self, act: Act) -> None:
        outputs, ruling, place = act.outputs, act.ruling, self._places[act.name]
        if outputs is None or ruling is None:
            return
        self._violations += len(ruling.violations)
        self._refused[act.name] = outputs.refused
        lowered = self._pairs.decode(outputs.lowered, self._views.shape[1])
        if lowered is not None:
            self._views[place, lowered[0]] = lowered[1]
        if act.name == SUPERVISOR:
            return
        self._xy_m[place] = ruling.pose.x_m, ruling.pose.y_m
        self._steps += 1
        self._bytes_weights += len(outputs.weights)
        self._bytes_total += len(outputs.weights) + sum(len(e.body) for e in outputs.outbox)
        if act.heard and self._first_contact is None:
            self._first_contact = outputs.step
        if outputs.state is not State.EXPLORING:
            self._resting.add(act.name)
        if outputs.state is State.FINISHED:
            self._finished.setdefault(act.name, outputs.step)
        time_s = act.now_ns * 1e-9
        self.finds += [(time_s, act.name, target, x, y) for target, x, y in ruling.found]
        if outputs.spent and not {"step", "energy", "units"} & set(ruling.violations):
            self._ship(place, outputs.spent)

    def _ship(self, place: int, spent: bytes) -> None:
        pairs = self._pairs.decode(spent, self._views.shape[1])
        if pairs is None:
            return
        self._energy_spent += 1
        x, y = self._xy_m[place].tolist()
        if self._exact_every is not None:
            self._points.append((x, y, int(pairs[1].sum())))
        for sample, units in zip(pairs[0].tolist(), pairs[1].tolist(), strict=True):
            way_m = math.hypot(self._walk.xy_m[sample, 0] - x, self._walk.xy_m[sample, 1] - y)
            cost = units * way_m / self._units.whole
            self._shipped += cost
            self._shipped_now += cost
            self._shipped_by[place] += cost
            self._spent_units += units
            self._true_left[sample] -= units

    def _mass_left(self) -> int:
        """Units left in the common view: everybody's minimum, or with a ledger the truth."""
        if self._scenario.merge == "ledger":
            np.maximum(self._true_left, 0, out=self._common)
        else:
            _least(self._views, self._common)
        return int(self._common.sum())

    def _row(self, *, last: bool = False) -> None:
        left = self._mass_left()
        whole, robots = self._units.whole, len(self._xy_m)
        places = [(i, *self._xy_m[i].tolist()) for i in range(robots)]
        xy_m = self._walk.xy_m
        pending = 0.0
        for i, x, y in places:
            units = self._common if self._scenario.centralized else self._views[i]
            pending += _pending(xy_m, x, y, units) / whole
        tight = None
        standing = self._scenario.samples.diffusion_m == 0.0
        if standing and int(np.maximum(self._true_left, 0).sum()) == whole - self._spent_units:
            tight = self._shipped + self._auction.cost(xy_m, self._xy_m, self._true_left) / whole
        local = [] if self._scenario.centralized else self._local_bounds()
        self.rows.append(
            Row(
                tick=self._tick,
                time_s=self._tick * self._period_ns * 1e-9,
                energy_spent=self._energy_spent,
                detected=len(self.finds),
                w_ub_paper=self._shipped + pending,
                w_ub_tight=tight,
                w_ub_instant=self._shipped_now + pending,
                mass_left=left / whole,
                mass_double_counted=(self._spent_units - (whole - left)) / whole,
                links=links(self._xy_m, self._scenario.radio.range_m),
                deliveries=self._deliveries,
                drops=self._drops,
                w_ub_local_min=min(local, default=None),
                w_ub_local_max=max(local, default=None),
                w1_exact=self._exact() if self._exact_due(last=last) else None,
            )
        )

    def _exact_due(self, *, last: bool) -> bool:
        if self._exact_every is None:
            return False
        return last or (self._exact_every > 0 and self._tick % self._exact_every == 0)

    def _exact(self) -> float:
        """W_1 between the samples and the robots' ensemble; see the module."""
        robots = self._xy_m.shape[0]
        shipped = np.array(self._points, dtype=np.float64).reshape(-1, 3)
        left = float(np.maximum(self._true_left, 0).sum())
        samples_m = self._walk.xy_m
        return exact.w1(
            np.concatenate((shipped[:, :2], self._xy_m)),
            np.concatenate((shipped[:, 2], np.full(robots, left / robots))),
            samples_m,
            np.ones(samples_m.shape[0]),
        )

    def _local_bounds(self) -> list[float]:
        """Eq. 12 for every robot."""
        range_m, xy_m = self._scenario.radio.range_m, self._xy_m
        bounds = []
        for k in range(len(xy_m)):
            team = np.flatnonzero(np.hypot(*(xy_m - xy_m[k]).T) <= range_m).tolist()
            pending = sum(
                _pending(self._walk.xy_m, *xy_m[q].tolist(), self._views[k]) for q in team
            )
            shipped = sum(self._shipped_by[q] for q in team)
            bounds.append(shipped + pending / self._units.whole)
        return bounds

    def glance(self) -> Glance:
        """How the run stands, by the last row."""
        if not self.rows:
            return Glance(0, 0, 0, 0, 0.0, 0, 0.0, 0, 1.0)
        last = self.rows[-1]
        before = self.rows[max(0, len(self.rows) - 11)]
        elapsed_s = last.time_s - before.time_s
        rate = (last.deliveries - before.deliveries) / elapsed_s if elapsed_s > 0.0 else 0.0
        return Glance(
            now_ns=round(last.time_s * 1e9),
            energy_spent=self._energy_spent,
            detected=len(self.finds),
            targets=self._targets,
            w_ub=last.w_ub_paper,
            links=last.links,
            messages_per_s=rate,
            robots_done=len(self._resting),
            mass_left=last.mass_left,
        )

    def result(
        self,
        *,
        exchange: str,
        digest: str,
        wall_s: float,
        refused_at_door: int = 0,
        record: str,
        complaints: tuple[str, ...],
    ) -> Result:
        """The summary; call it after the last record. complaints: the checker's."""
        scenario, last = self._scenario, self.rows[-1]
        robots = scenario.robots.count
        finished = max(self._finished.values()) if len(self._finished) == robots else None
        steps = max(1, self._steps)
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
            finished_tick=finished,
            first_contact_tick=self._first_contact,
            detected=len(self.finds),
            targets=self._targets,
            detection_rate=len(self.finds) / self._targets if self._targets else None,
            w_ub_start=self.rows[0].w_ub_paper,
            w_ub=Bounds(last.w_ub_paper, last.w_ub_tight, last.w_ub_instant),
            w1_exact=last.w1_exact,
            energy_spent=self._energy_spent,
            energy_total=scenario.steps_per_robot * robots,
            mass_left=last.mass_left,
            mass_double_counted=last.mass_double_counted,
            bytes_per_robot_tick=BytesPerRobotTick(
                self._bytes_weights / steps, self._bytes_total / steps
            ),
            deliveries=self._deliveries,
            drops=self._drops,
            out_of_range_refused=self._out_of_range,
            messages_refused=sum(self._refused.values()) + refused_at_door,
            absences=self._absences,
            ended=self._ending.reason,
            record=record,
            violations=self._violations + len(complaints),
            complaints=complaints[:10],
            digest=digest,
            wall_s=wall_s,
        )
