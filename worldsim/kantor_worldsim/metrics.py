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
from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_protocol.faults import kind_of
from kantor_protocol.kernels import kernel, sum_kernel
from kantor_protocol.keyed import Purpose
from kantor_protocol.machine import ParticipantId, State
from kantor_protocol.quota import Excess
from kantor_protocol.walk import Walk
from kantor_worldsim import exact
from kantor_worldsim import reading as of
from kantor_worldsim.bounds import Auction, measure
from kantor_worldsim.channel import DROPPED, links
from kantor_worldsim.reading import Reader
from kantor_worldsim.records import Batch, Ending, Incident, Opening, Record

_PAIRS_PER_ROW = 200_000
"""Robot-sample distances that one row of metrics may cost when the period is chosen by size."""

_BLOCK = 1024
"""Samples that a row of metrics takes at a time."""


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
    """On a map the share of cells that nobody has seen."""
    distance_m: float | None = None
    """On a map: what all robots have driven."""


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


class ByRegions(msgspec.Struct, frozen=True):
    """A variance over so many regions of the map (Puig, Garcia, Wu, section 4)."""

    r2: float
    r4: float
    r8: float
    r16: float
    r32: float
    r64: float


class MapResult(msgspec.Struct, frozen=True, kw_only=True):
    """What came of exploring a map. Only cells that can ever be seen count; ticks are periods."""

    explored: float
    """Share of them that somebody has seen."""
    completed_tick: int | None
    """When no reachable free cell that somebody had seen had an unknown neighbour any more, or null."""
    t95_tick: int | None
    """When that share was seen by somebody."""
    t99_tick: int | None
    all_t99_tick: int | None
    """When every robot knew of that share, by itself or from others."""
    distance_m: float
    """Driven by all robots."""
    longest_m: float
    """By one of them, at most."""
    overlap: float
    """What robots have seen themselves, summed, over what somebody has seen; minus 1."""
    bumps: int
    """Moves that ended at a wall."""
    switches: int
    """Goals given up, a sensor range or farther from the new one, before the robot had come within a cell."""
    stall_ticks: int
    """The longest that a robot stood still that had not finished."""
    log_bytes_per_robot_tick: float
    """Map traffic: what a robot sends of logs in a step."""
    wtv_final: ByRegions
    """Eq. 10, squared ticks: variance of the regions' mean time at which a cell was first seen."""
    wtv_mean: ByRegions
    """Eq. 9, the same with unseen cells counted as seen when the closest robot could be there, over time."""
    epv_final: ByRegions
    """Variance of the regions' explored share, squared percent."""
    epv_mean: ByRegions


class FaultCounts(msgspec.Struct, frozen=True, kw_only=True):
    """What one fault of the scenario did; all 0 says that it never struck.

    A fault of links counts copies of messages, one of processes how often it did what.
    """

    dropped: int = 0
    """For receivers that the radio alone would have let hear; one that several faults drop counts for each."""
    delayed: int = 0
    doubled: int = 0
    replayed: int = 0
    forged: int = 0
    """Nobody sent them."""
    killed: int = 0
    started: int = 0
    """Late joiners too."""
    paused: int = 0
    resumed: int = 0
    filled: int = 0
    """Disks."""
    freed: int = 0
    slowed: int = 0
    quickened: int = 0
    skewed: int = 0
    """Clocks."""
    righted: int = 0
    refused: int = 0
    """Impostors."""
    let_in: int = 0


_OF_LINKS = ("dropped", "delayed", "doubled", "replayed", "forged")
_OF_PROCESSES = {
    "kill": "killed",
    "start": "started",
    "pause": "paused",
    "resume": "resumed",
    "fill": "filled",
    "free": "freed",
    "slow": "slowed",
    "quicken": "quickened",
    "skew": "skewed",
    "right": "righted",
    "pretend": "refused",
    "let in": "let_in",
}
"""What a fault is counted for by what it did, see `outages.Deed`."""


class Rejoining(msgspec.Struct, frozen=True, kw_only=True):
    """How long participants that had started again took to their first step, in simulated seconds."""

    count: int
    median_s: float
    p99_s: float
    max_s: float

    @classmethod
    def of(cls, times_ns: Sequence[int]) -> "Rejoining | None":
        """Of so many times, if there are any. A quantile is one of them."""
        if not times_ns:
            return None
        times_s = [time_ns * 1e-9 for time_ns in sorted(times_ns)]
        last = len(times_s) - 1
        return cls(
            count=len(times_s),
            median_s=times_s[-(-last // 2)],
            p99_s=times_s[-(-99 * last // 100)],
            max_s=times_s[-1],
        )


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
    """The step at which the last robot saw no weight left, or no frontier to go to, or null."""
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
    faults: dict[str, FaultCounts] = {}
    """By place in the scenario's list and kind, such as `0 partition`."""
    restarts: int = 0
    """How often a participant, or world-sim, that had been killed or had left was there again."""
    incarnations: int = 0
    """New ones: robots, or the supervisor, that came back and had forgotten what others had of them."""
    rejoin_s: Rejoining | None = None
    """In real seconds on the wall at speed 1; turn by turn to the next step that is due."""
    map: MapResult | None = None
    """Of a mission that explores a map; bounds, energy and mass then say nothing but mass_left, the share
    of cells that nobody has seen."""
    excess: dict[ParticipantId, Excess] = {}
    """Who flooded the bus, and how much of it was not taken in since it was beyond its quota. It counts for no
    other figure."""


# Slots of Tally.counts and Tally.shipped.
_VIOLATIONS, _STEPS, _BYTES_WEIGHTS, _BYTES_TOTAL, _ENERGY, _UNITS = 0, 1, 2, 3, 4, 5
_DELIVERIES, _DROPS, _FIRST_CONTACT, _LEAST, _REFUSED_BEFORE = 6, 7, 8, 9, 10
_EVER, _NOW = 0, 1
_NEVER = -1


class Tally(NamedTuple):
    """What is counted batch by batch. n participants, of them m robots; N samples."""

    counts: npt.NDArray[np.int64]
    """(11,): violations, robot-steps, bytes on weights keys and in all, points and units shipped,
    deliveries, drops, step of the first contact or _NEVER, units in `least`, messages that
    incarnations refused that are no more."""
    shipped: npt.NDArray[np.float64]
    """(2,) mass times metres: since the start, in this tick."""
    standing: npt.NDArray[np.int64]
    """(n, 4): refused messages; whether it rests; step in which it saw no weight left, or _NEVER; how far
    its clock was ahead in its last step."""
    shipped_by: npt.NDArray[np.float64]
    """(m,) since the start."""
    xy_m: npt.NDArray[np.float64]
    """(m, 2) where robots are, world frame."""
    views: npt.NDArray[np.int64]
    """(n, N) the weight vector of each, in units."""
    least: npt.NDArray[np.int64]
    """(N,) the least of all views."""
    true_left: npt.NDArray[np.int64]
    """(N,) first weight minus everybody's spending; negative where a sample was filled twice."""


@kernel
def _lower(tally: Tally, place: int, sample: int, left: int) -> None:
    """Put an entry into a view. A record that is not sound may let it rise."""
    before, least = tally.views[place, sample], tally.least[sample]
    tally.views[place, sample] = left
    lower = min(left, least)
    if left > before == least:
        lower = left
        for other in range(tally.views.shape[0]):
            lower = min(lower, tally.views[other, sample])
    tally.least[sample] = lower
    tally.counts[_LEAST] += lower - least


@kernel
def _begin_anew(
    counts: np.ndarray,
    shipped: np.ndarray,
    standing: np.ndarray,
    shipped_by: np.ndarray,
    xy_m: np.ndarray,
    views: np.ndarray,
    least: np.ndarray,
    true_left: np.ndarray,
    place: int,
    units: int,
) -> None:
    """Who drives a body has forgotten all: its view is full, it rests no more, it has refused nothing."""
    tally = Tally(counts, shipped, standing, shipped_by, xy_m, views, least, true_left)
    counts[_REFUSED_BEFORE] += standing[place, 0]
    standing[place, 0], standing[place, 1], standing[place, 2] = 0, 0, _NEVER
    for sample in range(least.shape[0]):
        _lower(tally, place, sample, units)


@kernel
def _ship(
    tally: Tally, samples_m: np.ndarray, place: int, sample: int, units: int, whole: int
) -> None:
    dx = samples_m[sample, 0] - tally.xy_m[place, 0]
    dy = samples_m[sample, 1] - tally.xy_m[place, 1]
    cost = units * math.hypot(dx, dy) / whole
    tally.shipped[_EVER] += cost
    tally.shipped[_NOW] += cost
    tally.shipped_by[place] += cost
    tally.counts[_UNITS] += units
    tally.true_left[sample] -= units


@kernel
def _follow(
    _payload: bytes,
    sizes: np.ndarray,
    acts: np.ndarray,
    poses_m: np.ndarray,
    _heard: np.ndarray,
    _sent: np.ndarray,
    verdicts: np.ndarray,
    pairs: np.ndarray,
    _injected: np.ndarray,
    counts: np.ndarray,
    shipped: np.ndarray,
    standing: np.ndarray,
    shipped_by: np.ndarray,
    xy_m: np.ndarray,
    views: np.ndarray,
    least: np.ndarray,
    true_left: np.ndarray,
    samples_m: np.ndarray,
    whole: int,
) -> int:
    """Count one batch, see Reading and Tally; how many targets were found in it.

    samples_m: (N, 2) as they are now.
    """
    tally = Tally(counts, shipped, standing, shipped_by, xy_m, views, least, true_left)
    finds = 0
    for row in range(sizes[of.VERDICTS]):
        counts[_DROPS if verdicts[row, of.DUE_NS] == DROPPED else _DELIVERIES] += 1
    for row in range(sizes[of.ACTS]):
        act = acts[row]
        place = act[of.PLACE]
        if place < 0 or not act[of.PRESENT]:
            continue
        counts[_VIOLATIONS] += act[of.VIOLATIONS]
        if act[of.TOO_FAST] > 0 and act[of.SKEW_NS] > standing[place, 3]:  # see the checker's rule
            counts[_VIOLATIONS] -= 1
        standing[place, 3] = act[of.SKEW_NS]
        standing[place, 0] = act[of.REFUSED]
        for i in range(act[of.LOWERED], act[of.LOWERED] + max(0, act[of.LOWERED_COUNT])):
            _lower(tally, place, pairs[i, of.SAMPLE], pairs[i, of.UNITS])
        if place >= xy_m.shape[0]:  # the supervisor
            continue
        xy_m[place, 0], xy_m[place, 1] = poses_m[row, 0], poses_m[row, 1]
        counts[_STEPS] += 1
        counts[_BYTES_WEIGHTS] += act[of.WEIGHTS_BYTES]
        counts[_BYTES_TOTAL] += act[of.WEIGHTS_BYTES] + act[of.BODY_BYTES]
        finds += act[of.FINDS]
        if act[of.HEARD_COUNT] > 0 and counts[_FIRST_CONTACT] == _NEVER:
            counts[_FIRST_CONTACT] = act[of.STEP]
        if act[of.STATE] != State.EXPLORING.value:
            standing[place, 1] = 1
        if act[of.STATE] == State.FINISHED.value and standing[place, 2] == _NEVER:
            standing[place, 2] = act[of.STEP]
        if act[of.SPENT_COUNT] > 0 and not act[of.VOID]:
            counts[_ENERGY] += 1
            for i in range(act[of.SPENT], act[of.SPENT] + act[of.SPENT_COUNT]):
                _ship(tally, samples_m, place, pairs[i, of.SAMPLE], pairs[i, of.UNITS], whole)
    return finds


@sum_kernel
def _weighed(units: np.ndarray, way_m: np.ndarray) -> float:
    total = 0.0
    for j in range(way_m.shape[0]):
        total += units[j] * way_m[j]
    return total


@kernel
def _rest(true_left: np.ndarray) -> int:
    """Units that are truly left."""
    rest = 0
    for j in range(true_left.shape[0]):
        rest += max(true_left[j], 0)
    return rest


@kernel
def _sum_common(
    xy_m: np.ndarray,
    samples_m: np.ndarray,
    common: np.ndarray,
    first: int,
    xyu: np.ndarray,
    way_m: np.ndarray,
    whole: int,
    paper: np.ndarray,
) -> None:
    """Every robot ships the same weights: add the block that begins at `first`."""
    for j in range(way_m.shape[0]):
        xyu[0, j], xyu[1, j] = samples_m[first + j, 0], samples_m[first + j, 1]
        xyu[2, j] = max(common[first + j], 0)
    for i in range(xy_m.shape[0]):
        measure(xyu[0], xyu[1], xy_m[i], way_m)
        paper[i] += _weighed(xyu[2], way_m) / whole


@kernel
def _sum_views(
    xy_m: np.ndarray,
    samples_m: np.ndarray,
    views: np.ndarray,
    first: int,
    near: np.ndarray,
    xyu: np.ndarray,
    way_m: np.ndarray,
    whole: int,
    paper: np.ndarray,
    local: np.ndarray,
) -> None:
    """Every robot ships by its own view: add the block that begins at `first`."""
    last = first + way_m.shape[0]
    for j in range(way_m.shape[0]):
        xyu[0, j], xyu[1, j] = samples_m[first + j, 0], samples_m[first + j, 1]
    for i in range(xy_m.shape[0]):
        measure(xyu[0], xyu[1], xy_m[i], way_m)
        own = _weighed(views[i, first:last], way_m) / whole
        paper[i] += own
        for k in range(xy_m.shape[0]):
            if k == i:
                local[k] += own
            elif near[i, k]:
                local[k] += _weighed(views[k, first:last], way_m) / whole


@kernel
def _sum_up(
    shipped_by: np.ndarray,
    xy_m: np.ndarray,
    views: np.ndarray,
    least: np.ndarray,
    true_left: np.ndarray,
    samples_m: np.ndarray,
    whole: int,
    range_m: float,
    centralized: bool,
    ledger: bool,
    near: np.ndarray,
    xyu: np.ndarray,
    way_m: np.ndarray,
    paper: np.ndarray,
    local: np.ndarray,
) -> None:
    """The pending terms, mass times the distance to a robot, over all samples.

    For each robot in paper: by the common weights or its own view; in local: eq. 12, what the robots in
    its range have shipped and their terms by its own view. near: (m, m) room for who is in whose range.
    xyu (3, B), way_m (B,): room for one block of samples, which stays in the cache while all robots and
    views meet in it.
    """
    robots = xy_m.shape[0]
    paper[:] = 0.0
    local[:] = 0.0
    for k in range(robots):
        for i in range(robots):
            apart_m = math.hypot(xy_m[i, 0] - xy_m[k, 0], xy_m[i, 1] - xy_m[k, 1])
            near[i, k] = i == k or apart_m <= range_m
            if near[i, k]:
                local[k] += shipped_by[i]
    first = 0
    while first < samples_m.shape[0]:
        way = way_m[: min(way_m.shape[0], samples_m.shape[0] - first)]
        if centralized:
            common = true_left if ledger else least
            _sum_common(xy_m, samples_m, common, first, xyu, way, whole, paper)
        else:
            _sum_views(xy_m, samples_m, views, first, near, xyu, way, whole, paper, local)
        first += way.shape[0]


class Following:
    """Follows the records of one run: what is the same whatever is explored.

    A kind of mission adds what it measures: `_begin`, `_attend`, `_row`, `_glimpse` and `_measured`.
    """

    columns: ClassVar[tuple[str, ...]]
    """The names in a row."""

    def __init__(self, reader: Reader | None = None) -> None:
        """reader: the one that another referee of the same run reads by."""
        self.rows: list[Any] = []
        self.finds: list[tuple[float, ParticipantId, int, float, float]] = []
        """(time, robot, target, x, y), world frame."""
        self._reader = reader or Reader()
        self._opening: Opening | None = None
        self._every = 1
        """Periods from one row to the next."""

    def take(self, record: Record) -> None:
        """Follow one record."""
        if isinstance(record, Opening):
            self._open(record)
        elif isinstance(record, Batch):
            self._follow(record)
        elif isinstance(record, Incident):
            self._befall(record)
        else:
            self._ending = record
            self._row(last=True)

    def _open(self, opening: Opening) -> None:
        self._reader.read(opening)
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
        names, samples, robots = scenario.roster, site.samples_m.shape[0], scenario.robots.count
        self._targets = site.targets_m.shape[0]
        self._tally = Tally(
            counts=np.zeros(11, dtype=np.int64),
            shipped=np.zeros(2),
            standing=np.zeros((len(names), 4), dtype=np.int64),
            shipped_by=np.zeros(robots),
            xy_m=site.starts_m.copy(),
            views=np.full((len(names), samples), self._units.sample, dtype=np.int64),
            least=np.full(samples, self._units.sample, dtype=np.int64),
            true_left=np.full(samples, self._units.sample, dtype=np.int64),
        )
        self._tally.counts[_FIRST_CONTACT] = _NEVER
        self._tally.counts[_LEAST] = self._units.whole
        self._tally.standing[:, 2] = _NEVER
        self._arguments = (*self._tally, self._walk.xy_m, self._units.whole)
        self._out_of_range = self._absences = 0
        self._tolls = Counter[tuple[int, str]]()
        self._restarts = 0
        self._epochs = dict.fromkeys(names, 0)
        self._gone: set[ParticipantId] = set()
        self._started_ns: dict[ParticipantId, int] = {}
        """Who has started again and not stepped yet, and when that was."""
        self._rejoined_ns: list[int] = []
        self._ending = Ending(0, "cut")
        self._tick = 0
        for name, found in opening.first_look.items():
            self.finds += [(0.0, name, target, x, y) for target, x, y in found]
        self._begin(opening)
        self._row()

    def _follow(self, batch: Batch) -> None:
        tick = batch.now_ns // self._period_ns
        if tick != self._tick:
            if self._tick and self._tick % self._every == 0:
                self._row()
            self._tick, self._tally.shipped[_NOW] = tick, 0.0
        self._walk.advance(batch.now_ns)
        self._out_of_range += batch.out_of_range
        self._absences += len(batch.absent)
        for toll in batch.tolls:
            for deed in _OF_LINKS:
                self._tolls[toll.fault, deed] += getattr(toll, deed)
        if self._started_ns:
            self._note_rejoining(batch)
        reading = self._reader.read(batch)
        if _follow(*reading, *self._arguments):
            self._note_finds(batch)
        self._attend(batch, reading)

    def _befall(self, incident: Incident) -> None:
        """Follow what befell a process."""
        name, what = incident.who, incident.what
        if incident.fault >= 0 and what in _OF_PROCESSES:
            self._tolls[incident.fault, _OF_PROCESSES[what]] += 1
        if what in {"kill", "leave"}:
            self._gone.add(name)
            self._started_ns.pop(name, None)
        elif what in {"start", "join"}:
            self._restarts += name in self._gone
            if name in self._epochs:
                self._take_over(incident)
            self._gone.discard(name)

    def _take_over(self, incident: Incident) -> None:
        name = incident.who
        if name in self._gone:
            self._started_ns[name] = incident.now_ns
        if incident.epoch <= self._epochs[name]:
            return
        self._epochs[name] = incident.epoch
        place = self._scenario.roster.index(name)
        _begin_anew(*self._tally, place, self._units.sample)

    def _note_rejoining(self, batch: Batch) -> None:
        for act in batch.acts:
            if act.outputs is not None and act.name in self._started_ns:
                started_ns = self._started_ns.pop(act.name)
                self._rejoined_ns.append(max(0, batch.now_ns - started_ns))

    @property
    def steps(self) -> int:
        """Of all robots so far."""
        return self._tally.counts.item(_STEPS)

    @property
    def deliveries(self) -> int:
        """So far."""
        return self._tally.counts.item(_DELIVERIES)

    @property
    def drops(self) -> int:
        """So far."""
        return self._tally.counts.item(_DROPS)

    def _note_finds(self, batch: Batch) -> None:
        for act in batch.acts:
            if act.ruling is not None and act.outputs is not None:
                time_s = act.now_ns * 1e-9
                self.finds += [
                    (time_s, act.name, target, x, y) for target, x, y in act.ruling.found
                ]

    def _begin(self, opening: Opening) -> None:
        """Prepare for the run, before its first row."""
        raise NotImplementedError

    def _attend(self, batch: Batch, reading: tuple[Any, ...]) -> None:
        """Follow a batch that has been counted. reading: a Reading as arguments of a kernel."""

    def _row(self, *, last: bool = False) -> None:
        """Measure."""
        raise NotImplementedError

    def _glimpse(self) -> dict[str, Any]:
        """By the last row: `w_ub`, `mass_left` and what else there is in a Glance."""
        raise NotImplementedError

    def _measured(self) -> dict[str, Any]:
        """What a Result has beside the counts."""
        raise NotImplementedError

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
            energy_spent=int(self._tally.counts[_ENERGY]),
            detected=len(self.finds),
            targets=self._targets,
            links=last.links,
            messages_per_s=rate,
            robots_done=int(self._tally.standing[:, 1].sum()),
            **self._glimpse(),
        )

    def result(
        self,
        *,
        exchange: str,
        digest: str,
        wall_s: float,
        refused_at_door: int = 0,
        excess: Mapping[ParticipantId, Excess] = MappingProxyType({}),
        record: str,
        complaints: tuple[str, ...],
    ) -> Result:
        """The summary; call it after the last record. complaints: the checker's."""
        scenario, counts = self._scenario, self._tally.counts.tolist()
        robots = scenario.robots.count
        finished = self._tally.standing[:robots, 2].tolist()
        steps = max(1, counts[_STEPS])
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
            finished_tick=None if _NEVER in finished else max(finished),
            first_contact_tick=None if counts[_FIRST_CONTACT] == _NEVER else counts[_FIRST_CONTACT],
            detected=len(self.finds),
            targets=self._targets,
            detection_rate=len(self.finds) / self._targets if self._targets else None,
            energy_spent=counts[_ENERGY],
            bytes_per_robot_tick=BytesPerRobotTick(
                counts[_BYTES_WEIGHTS] / steps, counts[_BYTES_TOTAL] / steps
            ),
            deliveries=counts[_DELIVERIES],
            drops=counts[_DROPS],
            out_of_range_refused=self._out_of_range,
            messages_refused=int(self._tally.standing[:, 0].sum())
            + counts[_REFUSED_BEFORE]
            + refused_at_door,
            absences=self._absences,
            ended=self._ending.reason,
            record=record,
            violations=counts[_VIOLATIONS] + len(complaints),
            complaints=complaints[:10],
            digest=digest,
            wall_s=wall_s,
            faults={
                f"{i} {kind_of(fault)}": FaultCounts(
                    **{deed: self._tolls[i, deed] for deed in FaultCounts.__struct_fields__}
                )
                for i, fault in enumerate(scenario.faults)
            },
            restarts=self._restarts,
            incarnations=sum(self._epochs.values()),
            rejoin_s=Rejoining.of(self._rejoined_ns),
            excess=dict(excess),
            **self._measured(),
        )


class Metrics(Following):
    """Follows the records of one run that explores a density."""

    columns = Row._fields
    rows: list[Row]

    def __init__(self, exact_every: int | None = None, reader: Reader | None = None) -> None:
        """exact_every: periods from one exact distance to the next; 0: at the end only; None: never.

        reader: the one that another referee of the same run reads by.
        """
        super().__init__(reader)
        self._exact_every = exact_every

    def _begin(self, opening: Opening) -> None:
        scenario = opening.scenario
        robots, samples = scenario.robots.count, self._walk.xy_m.shape[0]
        self._terms = np.zeros((2, robots))
        self._to_sum_up = (
            *self._tally[3:],
            self._walk.xy_m,
            self._units.whole,
            scenario.radio.range_m,
            scenario.centralized,
            scenario.merge == "ledger",
            np.zeros((robots, robots), dtype=np.bool_),
            np.zeros((3, _BLOCK)),
            np.zeros(_BLOCK),
            *self._terms,
        )
        size = samples * robots // _PAIRS_PER_ROW
        self._every = scenario.metrics.every or max(1, size)
        self._auction = Auction(robots, samples, self._every)
        self._points: list[tuple[float, float, int]] = []

    def _attend(self, _batch: Batch, reading: tuple[Any, ...]) -> None:
        if self._exact_every is not None:
            self._note_points(of.Reading(*reading))

    def _note_points(self, reading: of.Reading) -> None:
        """Where a point was shipped, and how many units."""
        for row in range(reading.sizes[of.ACTS]):
            act = reading.acts[row]
            if act[of.PLACE] >= 0 and act[of.SPENT_COUNT] > 0 and not act[of.VOID]:
                shipped = reading.pairs[act[of.SPENT] : act[of.SPENT] + act[of.SPENT_COUNT]]
                x, y = reading.poses_m[row, :2].tolist()
                self._points.append((x, y, int(shipped[:, of.UNITS].sum())))

    def _row(self, *, last: bool = False) -> None:
        tally, scenario, whole = self._tally, self._scenario, self._units.whole
        counts = tally.counts.tolist()
        true_rest = _rest(tally.true_left)
        # The common view: everybody's minimum, or with a ledger the truth.
        left = true_rest if scenario.merge == "ledger" else counts[_LEAST]
        shipped, shipped_now = tally.shipped.tolist()
        tight = None
        if scenario.samples.diffusion_m == 0.0 and true_rest == whole - counts[_UNITS]:
            rest = self._auction.cost(self._walk.xy_m, tally.xy_m, tally.true_left)
            tight = shipped + rest / whole
        local: list[float] = []
        if tight is not None and scenario.centralized and scenario.merge == "ledger":
            pending = sum((self._auction.ways / whole).tolist())  # one pass for both
        else:
            _sum_up(*self._to_sum_up)
            pending = sum(self._terms[0].tolist())
            local = [] if scenario.centralized else self._terms[1].tolist()
        self.rows.append(
            Row(
                tick=self._tick,
                time_s=self._tick * self._period_ns * 1e-9,
                energy_spent=counts[_ENERGY],
                detected=len(self.finds),
                w_ub_paper=shipped + pending,
                w_ub_tight=tight,
                w_ub_instant=shipped_now + pending,
                mass_left=left / whole,
                mass_double_counted=(counts[_UNITS] - (whole - left)) / whole,
                links=links(tally.xy_m, scenario.radio.range_m),
                deliveries=counts[_DELIVERIES],
                drops=counts[_DROPS],
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
        robots_m, samples_m = self._tally.xy_m, self._walk.xy_m
        robots = robots_m.shape[0]
        shipped = np.array(self._points, dtype=np.float64).reshape(-1, 3)
        left = float(np.maximum(self._tally.true_left, 0).sum())
        return exact.w1(
            np.concatenate((shipped[:, :2], robots_m)),
            np.concatenate((shipped[:, 2], np.full(robots, left / robots))),
            samples_m,
            np.ones(samples_m.shape[0]),
        )

    def _glimpse(self) -> dict[str, Any]:
        return {"w_ub": self.rows[-1].w_ub_paper, "mass_left": self.rows[-1].mass_left}

    def _measured(self) -> dict[str, Any]:
        last, scenario = self.rows[-1], self._scenario
        return {
            "w_ub_start": self.rows[0].w_ub_paper,
            "w_ub": Bounds(last.w_ub_paper, last.w_ub_tight, last.w_ub_instant),
            "w1_exact": last.w1_exact,
            "energy_total": scenario.steps_per_robot * scenario.robots.count,
            "mass_left": last.mass_left,
            "mass_double_counted": last.mass_double_counted,
        }
