"""The rules on the record of a mission on a map, beside the rules of every run.

`Checker` applies them when a mission has a map. The `MapTracker` follows what robots send and notes violations
as numbers; here they are put into words.
"""

from collections.abc import Callable

from kantor_protocol.base.grid import FREE, NOWHERE, free_way
from kantor_protocol.base.machine import SUPERVISOR, ParticipantId, State
from kantor_worldsim.observers.checkers.links import Links
from kantor_worldsim.observers.checkers.sight import Sight
from kantor_worldsim.observers.checkers.state import DROPPED
from kantor_worldsim.observers.metrics.map_tracker import MapTracker
from kantor_worldsim.observers.metrics.map_tracker_kernels import (
    FALSE_BUMP,
    FALSE_CELL,
    FAR_FRONTIER,
    FOREIGN,
    FORGETS,
    GAP,
    MORE,
    NEVER,
    NOT_GIVEN_UP,
    NOT_ITS_SCANS,
    SHORT,
    UNREADABLE,
)
from kantor_worldsim.record.columnar import DecodedRecord
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, StepRecord

Report = Callable[[str, ParticipantId, str], None]
"""Takes the rule, the participant and the text of a violation."""

_TEXTS = {
    UNREADABLE: ("map", "sends a message that does not decode"),
    NOT_ITS_SCANS: ("map", "its log from {b} on is not what its scans say"),
    FAR_FRONTIER: ("map", "declares a frontier dead where it never stood, in its log at {b}"),
    GAP: ("map", "sends its log from {b} on and has not sent what comes before"),
    SHORT: ("map", "its log has {a} entries, its scans gave {b}"),
    FORGETS: ("map", "holds {a} entries of a log of which it held {b}"),
    FOREIGN: ("union", "forwards an entry at {b} of {origin}'s log that {origin} never sent"),
    MORE: ("union", "holds {a} entries of a log that has {b}"),
    FALSE_BUMP: ("truth", "tells in its log at {b} of a wall where there is none"),
    NOT_GIVEN_UP: ("map", "tries a frontier again that nobody has given up, in its log at {b}"),
    FALSE_CELL: ("truth", "sees cell {a} as {kind}, which it is not"),
}
"""Rule and text of each violation."""


class MapChecker:
    """Follows the records of one mission on a map and reports violations.

    Rules
    -----
    wall        no robot is accepted in a cell that is not free, nor on a straight way through one
    map         what a robot sends of its log is what its scans say, entry for entry, but for frontiers that
                it declares dead where it stood, gives up after a pursuit or tries again, and for bumps; a
                version vector never falls, so that no cell is forgotten
    truth       no scan calls a cell free or occupied that is not (without noise), and no robot bumps where
                there is no wall
    union       what is forwarded of a log is what its robot sent, and no participant holds more of it than
                that; so that what robots hold by their version vectors is the union of these prefixes
    sight       nothing is delivered through walls that block the radio
    finish      a robot that reports that it has finished can reach no frontier by what it holds (without noise)
    """

    def __init__(
        self,
        map_tracker: MapTracker | None,
        report: Report,
        is_false: Callable[[int], bool] | None = None,
    ) -> None:
        """map_tracker: one that an earlier observer of the same run keeps; None: one of its own.

        is_false: whether the log of an incarnation id is a liar's, which others pass on in good faith; see `lies.py`.
        """
        self._own_tracker = map_tracker is None
        self._map_tracker = map_tracker or MapTracker()
        self._report, self._is_false = report, is_false

    def open(self, opening: Opening) -> None:
        """Begin with the first record."""
        if self._own_tracker:
            self._map_tracker.open(opening)
        exact = opening.scenario.sensor.noise_m == 0.0
        known = self._is_false is None or not any(
            map(self._is_false, range(len(opening.scenario.roster)))
        )
        self._shows_ends = exact and known
        """Whether it is known what robots hold, entry for entry."""
        self._names = opening.scenario.roster
        self._poses_m = dict(zip(self._names, self._map_tracker.poses_m, strict=False))
        self._senders_m = dict(self._poses_m)
        supervisor = opening.scenario.supervisor
        if supervisor.pose_m is not None:
            self._senders_m[SUPERVISOR] = supervisor.pose_m
        self._places = {name: place for place, name in enumerate(self._names)}
        self._links = Links(opening.scenario, opening.seed)
        self._sight = Sight(opening.scenario.radio, *self._map_tracker.ground)
        self._finished: set[ParticipantId] = set()
        for name in self._poses_m:
            if not self._is_free(name):
                self._report("wall", name, "starts where it is not free")

    def follow_event(self, event: ProcessEvent) -> None:
        """Follow an event of a process."""
        if self._own_tracker:
            self._map_tracker.follow_event(event)

    def check(self, batch: Batch, decoded: DecodedRecord) -> int:
        """Follow one batch; the number of violations beyond those that are kept as texts."""
        if self._sight.counts:
            self._check_sight(batch)
        if self._own_tracker:
            self._map_tracker.observe(decoded)
        noted, count = self._map_tracker.violations
        for kind, row, _, a, b in noted.tolist():
            self._describe(batch, kind, row, a, b)
        for step_record in batch.step_records:
            if (
                step_record.verdict is not None
                and step_record.outputs is not None
                and step_record.name in self._poses_m
            ):
                self._check_way(step_record)
                self._check_finish(step_record)
        return count - len(noted)

    def _describe(self, batch: Batch, kind: int, row: int, a: int, b: int) -> None:
        if kind == FOREIGN and self._is_false is not None and self._is_false(a):
            return
        rule, text = _TEXTS[kind]
        origin = self._names[a % len(self._names)] if kind == FOREIGN else ""
        seen = "occupied" if b else "free"
        self._report(
            rule, batch.step_records[row].name, text.format(a=a, b=b, origin=origin, kind=seen)
        )

    def _check_sight(self, batch: Batch) -> None:
        """By the poses before the batch moves them. Range alone is a rule of every run."""
        self._links.move_to(batch.now_ns)
        for decision in batch.decisions:
            here_m = self._senders_m.get(decision.source)
            there_m = self._senders_m.get(decision.target)
            if decision.due_ns == DROPPED or here_m is None or there_m is None:
                continue
            walls = self._sight.walls(here_m, there_m)
            ends = self._places[decision.source], self._places[decision.target]
            if not self._sight.reaches(here_m, there_m, self._links.range_m(*ends), walls):
                heard = f"{decision.source}#{decision.sequence}"
                self._report("sight", decision.target, f"hears {heard} through {walls} walls")

    def _check_way(self, step_record: StepRecord) -> None:
        assert step_record.verdict is not None
        before, now = (
            self._poses_m[step_record.name],
            (step_record.verdict.pose.x_m, step_record.verdict.pose.y_m),
        )
        if now == before:
            return
        self._poses_m[step_record.name] = self._senders_m[step_record.name] = now
        frame, cells = self._map_tracker.ground
        if not self._is_free(step_record.name):
            self._report(
                "wall", step_record.name, f"stands at {now[0]:.6g}, {now[1]:.6g} m in a wall"
            )
        elif free_way(cells, FREE, *frame.uv(*before), *frame.uv(*now)) < 1.0:
            self._report(
                "wall", step_record.name, f"went to {now[0]:.6g}, {now[1]:.6g} m through a wall"
            )

    def _is_free(self, name: ParticipantId) -> bool:
        """Whether a robot is in a free cell now."""
        cell = self._map_tracker.cell_of(self._map_tracker.places[name])
        return bool(cell != NOWHERE and self._map_tracker.ground.cells.flat[cell] == FREE)

    def _check_finish(self, step_record: StepRecord) -> None:
        assert step_record.outputs is not None
        if step_record.outputs.state is not State.FINISHED or step_record.name in self._finished:
            return
        self._finished.add(step_record.name)
        cell = self._map_tracker.reachable(step_record.name) if self._shows_ends else NEVER
        if cell != NEVER:
            self._report("finish", step_record.name, f"could go to the frontier in cell {cell}")
