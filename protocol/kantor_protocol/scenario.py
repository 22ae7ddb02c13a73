"""A scenario: everything that defines a run but its seed, read from TOML and checked once, here.

Units are in the names. Positions are in the world frame: metres, x right, y up. A key that does
not exist, a value of the wrong type or out of bounds is refused with one line that names it.
"""

import difflib
import math
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from kantor_protocol import faults as of_faults
from kantor_protocol.faults import FAULTS_MAX, KINDS, AnyFault, Chaos
from kantor_protocol.machine import SUPERVISOR, ParticipantId
from kantor_protocol.tables import NotNegative, Point, Positive, Probability, Seconds, Table

PlannerName = Literal[
    "transport", "spectral", "frontier", "burgard", "market", "kmeans", "hungarian"
]
MAP_PLANNERS = frozenset({"frontier", "burgard", "market", "kmeans", "hungarian"})
"""Planners that explore an unknown map; the others explore a density."""
LayoutName = Literal["office", "blank", "unstructured", "cityblock"]
VehicleName = Literal["first-order", "second-order", "unicycle", "dubins"]


class ScenarioError(ValueError):
    """A scenario that cannot be run; the message is one line with the place and the remedy."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class Domain(Table, frozen=True, kw_only=True):
    """The rectangle that random starts are drawn from and that plots show. It is no wall.

    A mission with a map needs none: the map has an extent of its own.
    """

    min_m: Point
    max_m: Point


class Map(Table, frozen=True, kw_only=True):
    """The world of walls that the robots do not know and explore."""

    file: str | None = None
    """Nav2 map_server YAML, MovingAI .map, or an image: white is free, black is occupied."""
    layout: LayoutName | None = None
    """Or one that is generated."""
    resolution_m: Positive | None = None
    """The side of a cell; by default what the file says, or the layout's own."""
    size_m: tuple[Positive, Positive] | None = None
    """Width and height of a layout; by default the layout's own."""
    seed: Annotated[int, Meta(ge=0)] = 0
    """Of the layout, so that runs of many seeds share one map."""


class Robots(Table, frozen=True, kw_only=True):
    """The team: `r1` … `rN`."""

    count: Annotated[int, Meta(ge=1, le=1000)]


class Starts(Table, frozen=True, kw_only=True):
    """Where robots stand at time 0."""

    random: bool = False
    """Drawn uniformly in the domain, or from the free cells of the map, by the seed."""
    poses_m: tuple[Point, ...] = ()
    """One for each robot, unless random."""
    spread: Literal["separate", "together"] = "separate"
    """On a map, random: each robot for itself, or side by side around one place."""
    spots: Annotated[int, Meta(ge=0, le=10_000)] = 0
    """On a map, random: draw from so many places spread over it, the same for every seed; 0: anywhere.
    Together, a run takes the spot number seed mod spots."""


class Vehicle(Table, frozen=True, kw_only=True):
    """How a robot moves. A planner never knows."""

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
    """On a map: of its body. Robots on the way to the same target keep two radii apart; 0: points."""


class Clock(Table, frozen=True, kw_only=True):
    """When robots step."""

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


class Energy(Table, frozen=True, kw_only=True):
    """The budget, eq. 7."""

    points: Annotated[int, Meta(ge=0, le=2_000_000_000)] = 0
    """M: robot points of the whole team; each ships 1/M of the mass. 0 in a mission with a map."""
    steps: Annotated[int, Meta(ge=1, le=2_000_000_000)] | None = None
    """Points that one robot may ship; by default t_e = M / n_a."""


class Gaussian(Table, frozen=True, kw_only=True):
    """One component of the density."""

    mean_m: Point
    variance_m2: tuple[Positive, Positive]
    """Diagonal of the covariance."""
    weight: Positive = 1.0


class Samples(Table, frozen=True, kw_only=True):
    """The points y_j that stand for the density."""

    count: Annotated[int, Meta(ge=1, le=50_000_000)] | None = None
    """N. Needed for a mixture or an image; for a file of points, a seeded subset if it has more."""
    file: str | None = None
    """CSV or NPY: points. PNG, JPEG, PGM, TIFF: a grey-scale density over the domain, white is dense."""
    diffusion_m: NotNegative = 0.0
    """v of eq. 14: samples walk by up to this in x and y each period."""


class Targets(Table, frozen=True, kw_only=True):
    """What is to be found."""

    count: Annotated[int, Meta(ge=0, le=10_000_000)] = 0
    """Drawn from the same density as the samples."""
    file: str | None = None
    """CSV or NPY of points (all are used, or a seeded subset of `count`), or an image."""
    diffusion_m: NotNegative = 0.0
    """v of eq. 13: undetected targets walk by up to this each period."""


class Sensor(Table, frozen=True, kw_only=True):
    """A disc in which a robot detects targets; on a map also a range finder."""

    range_m: Positive = 15.0
    beams: Annotated[int, Meta(ge=1, le=10_000)] = 360
    """Of one scan, evenly over the field of view."""
    field_of_view_deg: Annotated[float, Meta(gt=0.0, le=360.0)] = 360.0
    """Centred on the heading."""
    noise_m: NotNegative = 0.0
    """Standard deviation of a range."""


class Radio(Table, frozen=True, kw_only=True):
    """The channel, played by world-sim."""

    range_m: NotNegative = math.inf
    """Between true poses at the time of sending; the bound itself is in range."""
    drop: Probability = 0.0
    """Per receiver."""
    delay_s: Seconds = 0.0
    jitter_s: Seconds = 0.0
    """Each delivery takes delay_s plus up to this."""
    duplicate: Probability = 0.0
    """A second copy arrives, with its own delay."""
    reorder: Probability = 0.0
    """A delivery is held back by up to reorder_s, so that later ones overtake it."""
    reorder_s: Seconds = 0.3
    line_of_sight: bool = False
    """On a map: no wall may stand between."""
    wall_loss_m: NotNegative = 0.0
    """On a map: each wall between shortens the range by so much."""
    beacon: Literal["versions", "state"] = "versions"
    """What a robot sends while it hears nobody: which versions it holds, or all that it knows.
    With state one message is enough to inform whoever comes into range, as Algorithm 3 presupposes."""


class Supervisor(Table, frozen=True, kw_only=True):
    """The supervisor of the centralized variant."""

    pose_m: Point | None = None
    """Its place; the middle of the domain by default."""
    range_m: NotNegative = math.inf
    """Radio range between it and any robot."""


class Planner(Table, frozen=True, kw_only=True):
    """How goals are chosen."""

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
    """map: all of them, or only the robot that it happens to."""
    replan_gap: Annotated[int, Meta(ge=1, le=10_000)] = 3
    """map: steps from one assignment to the next, at least."""
    remember_s: Seconds = 60.0
    """map, decentralized: how long the target of a robot that is not heard counts as taken."""
    patience: Annotated[int, Meta(ge=1)] = 60
    """map: steps without progress after which a target counts as inaccessible."""
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


class Publish(Table, frozen=True, kw_only=True):
    """What robots tell observers on their weights key."""

    weights_every: Annotated[int, Meta(ge=1)] = 10
    """Steps that one weights message gathers."""
    keyframe_every: Annotated[int, Meta(ge=1)] = 20
    """Weights messages from one whole vector to the next."""


class Metrics(Table, frozen=True, kw_only=True):
    """What the record measures."""

    every: Annotated[int, Meta(ge=0)] = 0
    """Periods from one row to the next; 0 chooses by size, 1 for the paper's scenarios."""


class Scenario(Table, frozen=True, kw_only=True):
    """A mission as data."""

    name: Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9-]{0,63}$")]
    summary: str = ""
    coordination: Literal["centralized", "decentralized"] = "decentralized"
    """centralized: robots talk to the supervisor only. decentralized: to whoever is in range."""
    merge: Literal["min", "ledger"] = "ledger"
    """min: elementwise minimum, as in the paper. ledger: everybody's spending, counted once."""
    claims: bool = True
    """Robots claim the sample they head for, if their planner heads for samples."""
    limit_s: Annotated[float, Meta(gt=0.0, le=1e9)] | None = None
    """Simulated time after which the mission is cut; by default 1.5 times the energy's."""
    linger_s: Seconds = 0.0
    """Simulated time that it goes on once every robot rests and no fault is left, so that news gets around."""
    domain: Domain = Domain(min_m=(0.0, 0.0), max_m=(0.0, 0.0))
    map: Map | None = None
    """Given one, the robots explore it; they then need no domain, energy, samples or density."""
    robots: Robots
    energy: Energy = Energy()
    samples: Samples = Samples()
    density: tuple[Gaussian, ...] = ()
    starts: Starts = Starts()
    targets: Targets = Targets()
    vehicle: Vehicle = Vehicle()
    clock: Clock = Clock()
    sensor: Sensor = Sensor()
    radio: Radio = Radio()
    supervisor: Supervisor = Supervisor()
    planner: Planner = Planner()
    publish: Publish = Publish()
    metrics: Metrics = Metrics()
    faults: Annotated[tuple[AnyFault, ...], Meta(max_length=FAULTS_MAX)] = ()
    """What goes wrong, and when; see `faults`. Over the bus participants are not told."""

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
    def claiming(self) -> bool:
        """Whether robots claim samples: asked for, and the planner has samples to claim."""
        return self.claims and self.planner.name == "transport"

    @property
    def learns_ranges(self) -> bool:
        """Whether robots tell one another some of the ranges that they measure."""
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
        """Where the supervisor stands."""
        if self.supervisor.pose_m is not None:
            return self.supervisor.pose_m
        (x_min, y_min), (x_max, y_max) = self.domain.min_m, self.domain.max_m
        return (x_min + x_max) / 2.0, (y_min + y_max) / 2.0


def parse(text: str, origin: str, overrides: Iterable[str] = ()) -> Scenario:
    """A checked scenario from TOML text and `key.sub=value` overrides.

    `origin` names the text in messages. Raises ScenarioError.
    """
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{origin}: not valid TOML: {error}") from None
    for override in overrides:
        _override(tree, override)
    return from_tree(tree, origin)


def load(path: Path, overrides: Iterable[str] = ()) -> Scenario:
    """A checked scenario from a TOML file; relative files in it are relative to its folder."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ScenarioError(
            f"{path}: no such scenario file; `kantor scenarios` lists the packaged ones"
        ) from None
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from None
    return rooted(parse(text, str(path), overrides), path.parent)


def with_chaos(scenario: Scenario, path: Path) -> Scenario:
    """The scenario with the faults of a TOML file behind its own. Raises ScenarioError."""
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ScenarioError(f"{path}: no such file of faults") from None
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from None
    except (ValueError, RecursionError) as error:
        raise ScenarioError(f"{path}: not valid TOML: {error}") from None
    try:
        chaos = msgspec.convert(tree, Chaos)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{path}: {_readable(str(error), tree, Chaos)}") from None
    faults = (*scenario.faults, *chaos.faults)
    if len(faults) > FAULTS_MAX:
        raise ScenarioError(f"{path}: faults: with the scenario's own more than {FAULTS_MAX}")
    for complaint in (
        *_not_finite(to_tree(chaos)),
        *of_faults.complaints(chaos.faults, scenario, scenario.faults),
    ):
        raise ScenarioError(f"{path}: {complaint}")
    return msgspec.structs.replace(scenario, faults=faults)


def rooted(scenario: Scenario, folder: Path) -> Scenario:
    """The scenario with its relative file names turned into absolute ones below `folder`.

    A name that exists from the current folder is taken as it is, so that `--set samples.file=…`
    means what a shell user expects.
    """

    def place(name: str | None) -> str | None:
        if name is None or Path(name).is_absolute():
            return name
        try:
            Path(name).stat()  # unlike `exists`, it tells of a name that no file can have
        except (FileNotFoundError, NotADirectoryError):
            return str((folder / name).resolve())
        except (OSError, ValueError) as error:
            raise ScenarioError(f"{name}: cannot be the name of a file: {error}") from None
        return str(Path(name).resolve())

    return msgspec.structs.replace(
        scenario,
        map=scenario.map and msgspec.structs.replace(scenario.map, file=place(scenario.map.file)),
        samples=msgspec.structs.replace(scenario.samples, file=place(scenario.samples.file)),
        targets=msgspec.structs.replace(scenario.targets, file=place(scenario.targets.file)),
    )


def from_tree(tree: dict[str, Any], origin: str) -> Scenario:
    """A checked scenario from parsed TOML. Raises ScenarioError."""
    try:
        scenario = msgspec.convert(tree, Scenario)
    except msgspec.ValidationError as error:
        raise ScenarioError(f"{origin}: {_readable(str(error), tree)}") from None
    except UnicodeEncodeError:  # a shell passes on whatever bytes it is given
        raise ScenarioError(f"{origin}: a text in it is not UTF-8; write it so") from None
    for complaint in _complaints(scenario):
        raise ScenarioError(f"{origin}: {complaint}")
    return scenario


def to_tree(scenario: Table) -> dict[str, Any]:
    """A scenario, or another table, as plain ones, without what is not set."""

    def without_none(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: without_none(v) for k, v in value.items() if v is not None}
        if isinstance(value, list | tuple):
            return [without_none(v) for v in value]
        return value

    tree: dict[str, Any] = without_none(msgspec.to_builtins(scenario))
    return tree


def to_toml(scenario: Scenario, *, brief: bool = False) -> str:
    """The scenario as TOML text that `parse` reads back as an equal one.

    brief: without what is as it is by default.
    """

    def literal(value: Any) -> str:
        if isinstance(value, bool):
            return str(value).lower()
        if isinstance(value, str):
            return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
        if isinstance(value, list):
            return "[" + ", ".join(literal(v) for v in value) + "]"
        return repr(value)

    def body(table: dict[str, Any]) -> list[str]:
        return [f"{key} = {literal(value)}" for key, value in table.items()]

    tree = _without_defaults(scenario) if brief else to_tree(scenario)
    rows = {key: tree.pop(key, []) for key in ("density", "faults")}
    lines = body({k: v for k, v in tree.items() if not isinstance(v, dict)})
    for key, table in tree.items():
        if isinstance(table, dict) and table:
            lines += ["", f"[{key}]", *body(table)]
    for key, tables in rows.items():
        for table in tables:
            lines += ["", f"[[{key}]]", *body(table)]
    return "\n".join(lines) + "\n"


def _without_defaults(table: Table) -> dict[str, Any]:
    """A table as plain ones, as briefly as `from_tree` understands it."""

    def plain(value: Any) -> Any:
        if isinstance(value, Table):
            return _without_defaults(value)
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return value

    kind = table.__struct_config__
    tree = {} if kind.tag is None else {str(kind.tag_field): kind.tag}
    for field in msgspec.structs.fields(table):
        value = getattr(table, field.name)
        if value != field.default:
            tree[field.name] = plain(value)
    return tree


def _override(tree: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    path = key.strip().split(".")
    if not separator or not all(path):
        raise ScenarioError(f"--set {override}: write it as key.sub=value")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text.strip()
    if isinstance(value, str) and ".".join(path) in _NAMED:
        path.append("name")  # planner=spectral says which planner
    table = tree
    for i, part in enumerate(path[:-1]):
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {override}: {'.'.join(path[: i + 1])} is not a table")
    table[path[-1]] = value


_MAP_LIMIT_PERIODS = 20_000

_PERIODS_UNDER_WAY = 1000
"""Robots remember what they sent for as long as an answer may take."""

_NAMED = frozenset({"planner", "vehicle"})
"""Tables that a name may stand for."""


def _readable(message: str, tree: Any, whole: type[Table] = Scenario) -> str:
    """Msgspec's complaint with the key first and, for an unknown key, the nearest known one.

    tree: what msgspec was to make a `whole` of.
    """
    problem, _, place = message.partition(" - at ")
    place = place.strip("`").removeprefix("$").removeprefix(".")
    for kind in ("unknown", "missing required"):
        if found := re.match(rf"Object (?:contains|{kind}) (?:unknown )?field `(.+)`", problem):
            key = f"{place}.{found[1]}".lstrip(".")
            if "missing" in problem:
                known = f"; known: {', '.join(sorted(KINDS))}" if found[1] == "kind" else ""
                return f"{key}: missing; set it{known}"
            fields = _table_at(place, tree, whole).__struct_fields__
            near = difflib.get_close_matches(found[1], fields, 1)
            known = f"did you mean {near[0]}?" if near else f"known: {', '.join(fields)}"
            return f"{key}: no such key; {known}"
    if found := re.match("Invalid (?:enum )?value ('.*')$", problem, re.DOTALL):
        return f"{place}: {found[1]} is not known; known: {_choices(place, tree, whole)}"
    return f"{place}: {problem[0].lower()}{problem[1:]}" if place else problem


def _table_at(place: str, tree: Any, whole: type[Table]) -> type[Table]:
    """What kind of table a place such as `radio` or `faults[2]` is."""
    kind: Any = whole
    if fault := re.match(r"faults\[(\d+)\]", place):
        return KINDS[tree["faults"][int(fault[1])]["kind"]]
    for part in filter(None, re.sub(r"\[.*?\]", "", place).split(".")):
        kind = _plain(get_type_hints(kind)[part])
    table: type[Table] = kind
    return table


def _choices(place: str, tree: Any, whole: type[Table]) -> str:
    """The names that a key may be set to."""
    table, _, key = place.rpartition(".")
    if key == "kind":
        return ", ".join(sorted(KINDS))
    return ", ".join(get_args(_plain(get_type_hints(_table_at(table, tree, whole))[key])))


def _plain(kind: Any) -> Any:
    """A type without what makes it optional, or many."""
    if get_origin(kind) in {Union, UnionType, tuple}:
        return get_args(kind)[0]
    return kind


def _complaints(scenario: Scenario) -> Iterable[str]:
    """What types alone cannot say. The first one is reported."""
    yield from _not_finite(to_tree(scenario))
    yield from _complaints_of_map(scenario) if scenario.map else _complaints_of_density(scenario)
    yield from of_faults.complaints(scenario.faults, scenario)
    for key, name in (("samples", scenario.samples.file), ("targets", scenario.targets.file)):
        if name is not None and Path(name).suffix.lower() not in POINT_FILES | IMAGE_FILES:
            known = ", ".join(sorted(POINT_FILES | IMAGE_FILES))
            yield f"{key}.file: {name} has an unknown kind; use one of {known}"
    clock = scenario.clock
    shortest_s = clock.period_s * (1.0 - clock.spread) * (1.0 - clock.drift_ppm * 1e-6)
    if clock.jitter_s + 1e-9 >= shortest_s:  # a step must not overtake the next one
        yield f"clock.jitter_s: must be below the shortest period after spread and drift, {shortest_s:g} s"
    if scenario.radio.delay_s + scenario.radio.jitter_s > _PERIODS_UNDER_WAY * shortest_s:
        yield f"radio.delay_s: with the jitter over {_PERIODS_UNDER_WAY} periods; make it shorter"


def _complaints_of_density(scenario: Scenario) -> Iterable[str]:
    (x_min, y_min), (x_max, y_max) = scenario.domain.min_m, scenario.domain.max_m
    if scenario.domain == Domain(min_m=(0.0, 0.0), max_m=(0.0, 0.0)):
        yield "domain: missing; set it"
    if x_min >= x_max or y_min >= y_max:
        yield "domain: min_m must lie below max_m in x and in y"
    yield from _complaints_of_starts(scenario)
    if scenario.planner.name in MAP_PLANNERS:
        yield f"planner.name: {scenario.planner.name} explores a map; add a [map]"
    image_or_mixture = scenario.samples.file is None or is_image(scenario.samples.file)
    if scenario.samples.file is None and not scenario.density:
        yield "samples: no source; add [[density]] tables or set samples.file"
    if image_or_mixture and scenario.samples.count is None:
        yield "samples.count: missing; set the number of samples N"
    if scenario.energy.points == 0:
        yield "energy: missing; set it"
    if scenario.energy.points < scenario.robots.count:
        yield "energy.points: fewer than robots; set at least one point for each"


def _complaints_of_map(scenario: Scenario) -> Iterable[str]:
    assert scenario.map is not None
    if (scenario.map.file is None) == (scenario.map.layout is None):
        yield "map: set either map.file or map.layout"
    if scenario.map.file is not None and scenario.map.size_m is not None:
        yield "map.size_m: only for a layout; a file has a size of its own"
    if scenario.planner.name not in MAP_PLANNERS:
        known = ", ".join(sorted(MAP_PLANNERS))
        yield f"planner.name: {scenario.planner.name} explores a density; on a map use {known}"
    if (
        scenario.density
        or scenario.samples.file
        or scenario.samples.count
        or scenario.energy.points
    ):
        yield "map: cannot be joined with a density; remove density, samples and energy"
    if scenario.vehicle.name == "dubins":
        yield "vehicle.name: dubins cannot stop at a wall; use first-order, second-order or unicycle"
    if scenario.targets.file is None and scenario.targets.count:
        yield "targets.count: on a map targets come from a file; set targets.file"
    if not scenario.starts.random and len(scenario.starts.poses_m) != scenario.robots.count:
        yield _starts_given(scenario)
    bounded = scenario.centralized and scenario.supervisor.range_m != math.inf
    if bounded and scenario.supervisor.pose_m is None:
        yield "supervisor.pose_m: missing; a supervisor of limited range needs its place"


def _starts_given(scenario: Scenario) -> str:
    return (
        f"starts.poses_m: {len(scenario.starts.poses_m)} given for {scenario.robots.count} robots; "
        f"give one for each or set starts.random=true"
    )


def _not_finite(tree: Any, path: str = "") -> Iterable[str]:
    """Numbers that are no numbers. Only a radio range may be infinite."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _not_finite(value, f"{path}.{key}".lstrip("."))
    elif isinstance(tree, list):
        for i, value in enumerate(tree):
            yield from _not_finite(value, f"{path}[{i}]")
    elif isinstance(tree, float) and not math.isfinite(tree):
        boundless = tree == math.inf and path in {"radio.range_m", "supervisor.range_m"}
        if not boundless:
            yield f"{path}: {tree} is no usable number; set a finite one"


def _complaints_of_starts(scenario: Scenario) -> Iterable[str]:
    starts, count = scenario.starts, scenario.robots.count
    if starts.random:
        return
    if len(starts.poses_m) != count:
        yield _starts_given(scenario)
    (x_min, y_min), (x_max, y_max) = scenario.domain.min_m, scenario.domain.max_m
    for i, (x, y) in enumerate(starts.poses_m):
        if not (x_min <= x <= x_max and y_min <= y <= y_max):
            yield (
                f"starts.poses_m[{i}]: ({x:g}, {y:g}) is outside the domain; move it inside "
                f"[{x_min:g}, {x_max:g}] x [{y_min:g}, {y_max:g}]"
            )


POINT_FILES = frozenset({".csv", ".npy"})
IMAGE_FILES = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".tif", ".tiff", ".bmp"})


def is_image(name: str) -> bool:
    """Whether a file name stands for a grey-scale density."""
    return Path(name).suffix.lower() in IMAGE_FILES
