"""The schema of a scenario: everything that defines a run but its seed.

Units are in the names. Positions are in the world frame: metres, x right, y up.
"""

import math
from typing import Annotated, Literal

from msgspec import UNSET, Meta, UnsetType

from kantor_protocol.base.machine import SUPERVISOR, ParticipantId
from kantor_protocol.scenario.faults.schedule import FAULTS_MAX, AnyFault
from kantor_protocol.scenario.types import (
    NotNegative,
    Point,
    Positive,
    Probability,
    ScenarioTable,
    Seconds,
)

PlannerName = Literal[
    "transport", "spectral", "frontier", "burgard", "market", "kmeans", "hungarian"
]


MAP_PLANNERS = frozenset({"frontier", "burgard", "market", "kmeans", "hungarian"})
"""Planners that explore an unknown map; the others explore a density."""


LayoutName = Literal["office", "blank", "unstructured", "cityblock"]


VehicleName = Literal["first-order", "second-order", "unicycle", "dubins"]


class Domain(ScenarioTable, frozen=True, kw_only=True):
    """The rectangle that random starts are drawn from and that plots show. It is no wall.

    A mission with a map needs none: the map has an extent of its own.
    """

    min_m: Point
    max_m: Point


class MapOptions(ScenarioTable, frozen=True, kw_only=True):
    """The map that the robots explore and do not know."""

    file: str | None = None
    """Nav2 map_server YAML, MovingAI .map, or an image: white is free, black is occupied."""
    layout: LayoutName | None = None
    """Or a generated one."""
    resolution_m: Positive | None = None
    """The side of a cell; by default that of the file, or the layout's own."""
    size_m: tuple[Positive, Positive] | None = None
    """Width and height of a layout; by default the layout's own."""
    seed: Annotated[int, Meta(ge=0)] = 0
    """Seed of the layout, so that runs of many seeds share one map."""


class Robots(ScenarioTable, frozen=True, kw_only=True):
    """The team: `r1` … `rN`."""

    count: Annotated[int, Meta(ge=1, le=1000)]


class Starts(ScenarioTable, frozen=True, kw_only=True):
    """The places of robots at time 0."""

    random: bool = False
    """Starts are drawn uniformly in the domain, or from the free cells of the map, by the seed."""
    poses_m: tuple[Point, ...] = ()
    """One for each robot, unless random."""
    spread: Literal["separate", "together"] = "separate"
    """On a map, random: each robot alone, or side by side around one place."""
    spots: Annotated[int, Meta(ge=0, le=10_000)] = 0
    """On a map, random: draw from so many places spread over it, the same for every seed; 0: anywhere.
    Together, a run takes the spot number seed mod spots."""


class VehicleOptions(ScenarioTable, frozen=True, kw_only=True):
    """The motion of a robot. Planners do not depend on it."""

    name: VehicleName = "first-order"
    speed_m_s: Positive = 100.0
    """u_max."""
    acceleration_m_s2: Positive = 400.0
    """second-order: bound on the acceleration vector; unicycle: on the speed's change."""
    turn_rate_rad_s: Positive = 6.0
    """unicycle: bound on the turn rate."""
    turn_radius_m: Positive = 15.0
    """dubins: the tightest circle."""
    radius_m: NotNegative = 0.0
    """On a map: radius of its body. Robots on the way to the same target keep two radii apart; 0: points."""


class ClockOptions(ScenarioTable, frozen=True, kw_only=True):
    """The times of steps."""

    period_s: Annotated[float, Meta(ge=1e-6, le=1e6)] = 0.1
    """Nominal time between two steps; also the step of walking samples and targets."""
    order: Literal["concurrent", "turn"] = "concurrent"
    """concurrent: all phases equal. turn: phases spread over the period, one robot after another."""
    spread: Annotated[float, Meta(ge=0.0, le=0.9)] = 0.0
    """Each robot's period is drawn from [1 - spread, 1 + spread] times the nominal one."""
    drift_ppm: Annotated[float, Meta(ge=0.0, le=100_000.0)] = 0.0
    """Each robot's clock runs wrong by a rate drawn from plus or minus this."""
    jitter_s: Seconds = 0.0
    """Each step is late by a time drawn from [0, jitter_s]; below the period."""


ENERGY_MAX = 2_000_000_000
"""Points of a mission, or of a robot, at most."""


class Energy(ScenarioTable, frozen=True, kw_only=True):
    """The energy budget, eq. 7."""

    points: Annotated[int, Meta(ge=0, le=ENERGY_MAX)] = 0
    """M: robot points of the whole team; each ships 1/M of the mass. 0 in a mission with a map."""
    steps: Annotated[int, Meta(ge=1, le=ENERGY_MAX)] | None = None
    """Points that one robot may ship; by default t_e = M / n_a."""


class Gaussian(ScenarioTable, frozen=True, kw_only=True):
    """One component of the density."""

    mean_m: Point
    variance_m2: tuple[Positive, Positive]
    """Diagonal of the covariance."""
    weight: Positive = 1.0


class Samples(ScenarioTable, frozen=True, kw_only=True):
    """The points y_j that stand for the density."""

    count: Annotated[int, Meta(ge=1, le=50_000_000)] | None = None
    """N. Needed for a mixture or an image; for a file of points, a seeded subset if it has more."""
    file: str | None = None
    """CSV or NPY: points. PNG, JPEG, PGM, TIFF: a grey-scale density over the domain, white is dense."""
    diffusion_m: NotNegative = 0.0
    """v of eq. 14: samples walk by up to this in x and y each period."""


class Targets(ScenarioTable, frozen=True, kw_only=True):
    """The targets to be found."""

    count: Annotated[int, Meta(ge=0, le=10_000_000)] = 0
    """Drawn from the same density as the samples."""
    file: str | None = None
    """CSV or NPY of points (all are used, or a seeded subset of `count`), or an image."""
    diffusion_m: NotNegative = 0.0
    """v of eq. 13: undetected targets walk by up to this each period."""


class SensorOptions(ScenarioTable, frozen=True, kw_only=True):
    """A disc in which a robot detects targets; on a map also a range finder."""

    range_m: Positive = 15.0
    beams: Annotated[int, Meta(ge=1, le=10_000)] = 360
    """Beams of one scan, evenly over the field of view."""
    field_of_view_deg: Annotated[float, Meta(gt=0.0, le=360.0)] = 360.0
    """Centred on the heading."""
    noise_m: NotNegative = 0.0
    """Standard deviation of a range."""


class RadioOptions(ScenarioTable, frozen=True, kw_only=True):
    """The radio channel, simulated by world-sim."""

    range_m: NotNegative = math.inf
    """Between true poses at the time of sending; the bound itself is in range."""
    drop: Probability = 0.0
    """Probability of a loss, for each receiver."""
    delay_s: Seconds = 0.0
    jitter_s: Seconds = 0.0
    """Each delivery takes delay_s plus up to this."""
    duplicate: Probability = 0.0
    """Probability of a second copy, with its own delay."""
    reorder: Probability = 0.0
    """Probability that a delivery is held back by up to reorder_s, so that later ones overtake it."""
    reorder_s: Seconds = 0.3
    line_of_sight: bool = False
    """On a map: no wall may stand between."""
    wall_loss_m: NotNegative = 0.0
    """On a map: each wall between shortens the range by so much."""
    beacon: Literal["versions", "state"] = "versions"
    """The message of a robot that hears no other robot: its version vector, or all that it knows.
    With `state` one message is enough to inform a robot that comes into range, as Algorithm 3 presupposes."""


class SupervisorOptions(ScenarioTable, frozen=True, kw_only=True):
    """The supervisor of the centralized variant."""

    pose_m: Point | None = None
    """Its place, world frame; the middle of the domain by default."""
    range_m: NotNegative = math.inf
    """Radio range between it and any robot."""


class PlannerOptions(ScenarioTable, frozen=True, kw_only=True):
    """The planner and its options."""

    name: PlannerName = "transport"
    """On a density: transport (Kabir & Lee), spectral (multiscale coverage, Mathew & Mezic). On a map:
    frontier (Yamauchi), burgard, market (Zlot), kmeans (Puig, Garcia, Wu), hungarian (the cheapest
    assignment of robots to frontiers)."""
    horizon: Annotated[int, Meta(ge=1, le=12)] = 3
    """transport: h, samples in one plan."""
    modes: Annotated[int, Meta(ge=1, le=64)] = 15
    """spectral: K, cosine modes along each axis."""
    cost: Literal["occupancy", "length"] = "occupancy"
    """map: a way costs its length times the smoothed occupancy (Burgard), or its length."""
    smoothing_cells: Annotated[float, Meta(ge=0.0, le=100.0)] = 1.0
    """cost = occupancy: deviation of the Gaussian; the wider, the dearer are doors."""
    occupied_from: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.5
    """map: no way leads through a cell that is occupied with this probability or more."""
    replan_on: Literal["events", "arrivals"] = "events"
    """map: robots get new targets when one arrives or its target is no frontier any more, or only when
    one arrives."""
    replan_whose: Literal["team", "own"] = "team"
    """map: all robots, or only the one concerned."""
    replan_gap: Annotated[int, Meta(ge=1, le=10_000)] = 3
    """map: steps from one assignment to the next, at least."""
    remember_s: Seconds = 60.0
    """map, decentralized: how long the target of a robot counts as assigned when no message of it is received."""
    patience: Annotated[int, Meta(ge=1)] = 60
    """map: cells that a robot drives beyond its way, or steps at a wall or without a way, after which it gives a
    target up that it gets no nearer to."""
    coordinated: bool = True
    """burgard: false lets each robot take the frontier that is cheapest for it."""
    beta: NotNegative = 1.0
    """burgard: weight of the cost; 1 across one sensor range of open floor is worth one utility."""
    coverage: Literal["histogram", "linear", "disc"] = "histogram"
    """burgard: P(d) as learned from measured ranges (2000), 1 - d / range (2005), or 1 within range."""
    discount: Literal["multiply", "subtract"] = "multiply"
    """burgard: utilities near a target are multiplied by 1 - P(d) (2000), or lessened by P(d) (2005)."""
    sight: bool = False
    """burgard: P(d) is 0 behind a wall (2005)."""
    goals: Literal["random", "greedy", "quadtree"] = "quadtree"
    """market: how goals in the unknown are proposed."""
    goal_count: Annotated[int, Meta(ge=1, le=64)] = 5
    """market: goals of one robot at a time."""
    lease_s: Annotated[float, Meta(gt=0.0, le=1e6)] = 5.0
    """market: how long a seller waits for bids, or for a winner to confirm."""


class PublishOptions(ScenarioTable, frozen=True, kw_only=True):
    """The messages of robots on their weights key, for observers."""

    weights_every: Annotated[int, Meta(ge=1)] = 10
    """Steps from one weights message to the next."""
    keyframe_every: Annotated[int, Meta(ge=1)] = 20
    """Weights messages from one whole vector to the next."""


class MetricsOptions(ScenarioTable, frozen=True, kw_only=True):
    """The rate of metrics."""

    every: Annotated[int, Meta(ge=0)] = 0
    """Periods from one row to the next; 0 chooses by size, 1 for the paper's scenarios."""


class Scenario(ScenarioTable, frozen=True, kw_only=True):
    """A mission as data."""

    name: Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9-]{0,63}$")]
    summary: str = ""
    coordination: Literal["centralized", "decentralized"] = "decentralized"
    """centralized: robots talk to the supervisor only. decentralized: to all robots in range."""
    merge: Literal["min", "ledger"] = "ledger"
    """min: elementwise minimum, as in the paper. ledger: the spending of all participants, each counted once."""
    claims: bool = True
    """Robots claim the sample they head for, if their planner heads for samples."""
    trust: Literal["open", "signed"] | UnsetType = UNSET
    """open: who forwards another's log, claim or register is believed. signed: only what its origin has signed counts.
    By default signed over TLS, and open otherwise."""
    limit_s: Annotated[float, Meta(gt=0.0, le=1e9)] | None = None
    """Simulated time after which the mission is cut; by default 1.5 times the energy's."""
    linger_s: Seconds = 0.0
    """Simulated time that it goes on once every robot rests and no fault is left, so that all logs reach all robots."""
    domain: Domain = Domain(min_m=(0.0, 0.0), max_m=(0.0, 0.0))
    map: MapOptions | None = None
    """Given one, the robots explore it; they then need no domain, energy, samples or density."""
    robots: Robots
    energy: Energy = Energy()
    samples: Samples = Samples()
    density: tuple[Gaussian, ...] = ()
    starts: Starts = Starts()
    targets: Targets = Targets()
    vehicle: VehicleOptions = VehicleOptions()
    clock: ClockOptions = ClockOptions()
    sensor: SensorOptions = SensorOptions()
    radio: RadioOptions = RadioOptions()
    supervisor: SupervisorOptions = SupervisorOptions()
    planner: PlannerOptions = PlannerOptions()
    publish: PublishOptions = PublishOptions()
    metrics: MetricsOptions = MetricsOptions()
    faults: Annotated[tuple[AnyFault, ...], Meta(max_length=FAULTS_MAX)] = ()
    """Faults to inject, and when; see `faults`. A mission on the bus contains only the lies of the robot that it is
    for."""

    @property
    def robot_ids(self) -> tuple[ParticipantId, ...]:
        """`r1` … `rN`."""
        return tuple(f"r{i}" for i in range(1, self.robots.count + 1))

    @property
    def roster(self) -> tuple[ParticipantId, ...]:
        """All participants: the robots, then the supervisor if there is one."""
        return (*self.robot_ids, SUPERVISOR) if self.centralized else self.robot_ids

    @property
    def centralized(self) -> bool:
        """Whether there is a supervisor."""
        return self.coordination == "centralized"

    @property
    def mapping(self) -> bool:
        """Whether the robots explore an unknown map, and not a density."""
        return self.map is not None

    @property
    def signed(self) -> bool:
        """Whether participants sign what they say of themselves, and believe of others what these have signed."""
        return self.trust == "signed"

    @property
    def claiming(self) -> bool:
        """Whether robots claim samples: asked for, and the planner has samples to claim."""
        return self.claims and self.planner.name == "transport"

    @property
    def learns_ranges(self) -> bool:
        """Whether robots share some of the ranges that they measure."""
        return self.planner.name == "burgard" and self.planner.coverage == "histogram"

    @property
    def register_width(self) -> int:
        """Integers in the register by which robots coordinate, at most; 0 for a planner without one."""
        if self.mapping:
            return 64 + 8 * self.robots.count
        return self.planner.modes**2 if self.planner.name == "spectral" else 0

    @property
    def period_ns(self) -> int:
        """The nominal period."""
        return round(self.clock.period_s * 1e9)

    @property
    def steps_per_robot(self) -> int:
        """The energy budget of one robot in points, t_e of eq. 7 unless given."""
        return self.energy.steps or max(1, self.energy.points // self.robots.count)

    @property
    def limit_ns(self) -> int:
        """Simulated time at which the mission is cut."""
        if self.limit_s is not None:
            return round(self.limit_s * 1e9)
        if self.mapping:
            return _MAP_LIMIT_PERIODS * self.period_ns
        slowest = 1.0 + self.clock.spread + self.clock.drift_ppm * 1e-6
        return round(1.5 * (self.steps_per_robot + 100) * self.period_ns * slowest)

    @property
    def supervisor_m(self) -> Point:
        """The place of the supervisor, world frame."""
        if self.supervisor.pose_m is not None:
            return self.supervisor.pose_m
        (x_min, y_min), (x_max, y_max) = self.domain.min_m, self.domain.max_m
        return (x_min + x_max) / 2.0, (y_min + y_max) / 2.0


_MAP_LIMIT_PERIODS = 20_000
