"""The result of a run, as `result.json` has it."""

from collections.abc import Sequence

import msgspec

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.transport.rate_limit import Excess


class Bounds(msgspec.Struct, frozen=True):
    """W_UB as printed, as a tight bound, and its part of the last tick."""

    paper: float
    tight: float | None
    final_instant: float


class BytesPerRobotTick(msgspec.Struct, frozen=True):
    """Bytes that a robot puts on the bus in one step, payload only."""

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
    """The result of exploring a map. Only cells that can ever be seen count; ticks are periods."""

    explored: float
    """Share of them that a robot has seen."""
    completed_tick: int | None
    """When no reachable free cell that a robot had seen had an unknown neighbour any more, or null."""
    t95_tick: int | None
    """When that share was seen by a robot."""
    t99_tick: int | None
    all_t99_tick: int | None
    """When every robot knew of that share, by itself or from others."""
    distance_m: float
    """Driven by all robots."""
    longest_m: float
    """By one of them, at most."""
    overlap: float
    """Cells that each robot has seen itself, summed, over cells that any robot has seen; minus 1."""
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
    unseen: int = 0
    """Free cells that robots could reach and that none has seen."""
    frontiers_left: int = 0
    """Free cells that robots have seen and could reach, with a neighbour that none has seen."""


class FaultCounts(msgspec.Struct, frozen=True, kw_only=True):
    """The effects of one fault of the scenario; all 0: it never took effect.

    A fault of links counts copies of messages, one of processes its events.
    """

    dropped: int = 0
    """For receivers that the radio alone would have let hear; one that several faults drop counts for each."""
    delayed: int = 0
    doubled: int = 0
    replayed: int = 0
    forged: int = 0
    """No participant sent them."""
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


STUCK = "stuck"
"""How a mission on a map ended whose record says `done`, and that has left ground unseen."""

LINK_COUNTERS = ("dropped", "delayed", "doubled", "replayed", "forged")


class Rejoining(msgspec.Struct, frozen=True, kw_only=True):
    """Times from a restart of a participant to its first step, in simulated seconds."""

    count: int
    median_s: float
    p99_s: float
    max_s: float

    @classmethod
    def of(cls, times_ns: Sequence[int]) -> "Rejoining | None":
        """The quantiles of some times, each of which is one of them; None if there are none."""
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


class RefusedReports(msgspec.Struct, frozen=True):
    """Reports of one participant that no honest one sends; none of them had an effect."""

    count: int
    reasons: tuple[str, ...]
    """The first different ones."""


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
    """The reason on record, or `stuck`: on a map, all robots rest and there is ground that they could reach and
    have not seen."""
    record: str
    """`whole`, or why it was cut."""
    violations: int
    complaints: tuple[str, ...]
    """Violations that checkers found, at most the first ten."""
    digest: str
    wall_s: float
    faults: dict[str, FaultCounts] = {}
    """By place in the scenario's list and kind, such as `0 partition`."""
    restarts: int = 0
    """How often a participant, or world-sim, started again after it was killed or had left."""
    incarnations: int = 0
    """New ones, of robots or the supervisor that came back without their logs."""
    rejoin_s: Rejoining | None = None
    """Real seconds in the realtime exchange at speed 1; in virtual time to the next step that is due."""
    map: MapResult | None = None
    """Of a mission that explores a map; bounds, energy and mass then mean nothing but mass_left, the share
    of cells that no robot has seen."""
    excess: dict[ParticipantId, Excess] = {}
    """Participants that flooded the bus, and how much was refused beyond their quota. It counts in no other
    figure."""
    refused_reports: dict[ParticipantId, RefusedReports] = {}
    """Participants that sent unsound or impossible reports."""
    lies: dict[ParticipantId, int] = {}
    """Robots that lie by a fault of the scenario, and how often checkers have found that; no violations."""
    silences: dict[ParticipantId, int] = {}
    """Lockstep: how often each participant that was on the bus did not answer until its time was over."""
