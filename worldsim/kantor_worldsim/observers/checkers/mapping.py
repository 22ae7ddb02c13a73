"""What the referees hold against the record of a mapping run, beside the rules of every run.

`Checker` asks for these rules when a mission has a map. What robots send is followed by the `Survey`,
which notes faults as numbers; here they are put into words.
"""

import math
from collections.abc import Callable

from kantor_protocol.base.grid import FREE, NOWHERE, free_way
from kantor_protocol.base.machine import SUPERVISOR, ParticipantId, State
from kantor_worldsim.observers.metrics.map_tracker import MapTracker
from kantor_worldsim.observers.metrics.map_tracker_kernels import (
    FALSE_CELL,
    FAR_VOID,
    FOREIGN,
    FORGETS,
    GAP,
    MORE,
    NEVER,
    NOT_ITS_SCANS,
    SHORT,
    UNREADABLE,
)
from kantor_worldsim.radio.channel import DROPPED, DeliveryDecision
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, StepRecord
from kantor_worldsim.world.sensors import walls_between

Complain = Callable[[str, ParticipantId, str], None]
"""Takes rule, who and what."""

_WORDS = {
    UNREADABLE: ("map", "sends what nobody can read"),
    NOT_ITS_SCANS: ("map", "its log from {b} on is not what its scans say"),
    FAR_VOID: ("map", "calls a frontier none where it never stood, in its log at {b}"),
    GAP: ("map", "sends its log from {b} on and has not sent what comes before"),
    SHORT: ("map", "its log has {a} entries, its scans gave {b}"),
    FORGETS: ("map", "holds {a} entries of a log of which it held {b}"),
    FOREIGN: ("union", "forwards an entry at {b} of {origin}'s log that {origin} never sent"),
    MORE: ("union", "holds {a} entries of a log that has {b}"),
    FALSE_CELL: ("truth", "sees cell {a} as {kind}, which it is not"),
}
"""Rule and text of each fault."""


class MapChecker:
    """Follows the records of one mapping run and complains.

    Rules
    -----
    wall        no robot is accepted in a cell that is not free, nor on a straight way through one
    map         what a robot sends of its log is what its scans say, entry for entry, but for frontiers that
                it calls none where it stood; a version vector never falls, so that no cell is forgotten
    truth       no scan calls a cell free or occupied that is not (without noise)
    union       what is forwarded of a log is what its robot sent, and nobody holds more of it than that;
                so that what robots hold by their version vectors is the union of these prefixes
    sight       nothing is delivered through walls that the radio minds
    finish      who says that it has finished can reach no frontier by what it holds (without noise)
    """

    def __init__(self, map_tracker: MapTracker, complain: Complain) -> None:
        """survey: may be shared with other referees of the same run."""
        self._map_tracker = map_tracker
        self._complain = complain

    def open(self, opening: Opening) -> None:
        """Begin with the first record."""
        self._map_tracker.observe(opening)
        self._exact = opening.scenario.sensor.noise_m == 0.0
        self._names = opening.scenario.roster
        self._poses_m = dict(zip(self._names, self._map_tracker.poses_m, strict=False))
        self._radio = opening.scenario.radio
        self._senders_m = dict(self._poses_m)
        supervisor = opening.scenario.supervisor
        if supervisor.pose_m is not None:
            self._senders_m[SUPERVISOR] = supervisor.pose_m
        self._faults = LinkFaults(opening.scenario, opening.seed)
        self._finished: set[ParticipantId] = set()
        for name in self._poses_m:
            if not self._is_free(name):
                self._complain("wall", name, "starts where it is not free")

    def befall(self, incident: ProcessEvent) -> None:
        """Follow what befell a process."""
        self._map_tracker.observe(incident)

    def check(self, batch: Batch) -> int:
        """Follow one batch; how many faults went without a complaint, since there are too many."""
        if self._radio.line_of_sight or self._radio.wall_loss_m > 0.0:
            for decision in batch.decisions:
                self._check_sight(batch.now_ns, decision)
        self._map_tracker.observe(batch)
        faults, count = self._map_tracker.faults
        for fault, row, _, a, b in faults.tolist():
            self._put_into_words(batch, fault, row, a, b)
        for step_record in batch.step_records:
            if (
                step_record.verdict is not None
                and step_record.outputs is not None
                and step_record.name in self._poses_m
            ):
                self._check_way(step_record)
                self._check_finish(step_record)
        return count - len(faults)

    def _put_into_words(self, batch: Batch, fault: int, row: int, a: int, b: int) -> None:
        rule, text = _WORDS[fault]
        origin = self._names[a % len(self._names)] if fault == FOREIGN else ""
        kind = "occupied" if b else "free"
        self._complain(
            rule, batch.step_records[row].name, text.format(a=a, b=b, origin=origin, kind=kind)
        )

    def _check_sight(self, now_ns: int, decision: DeliveryDecision) -> None:
        """From where both were before anybody moved; range alone is a rule of every run."""
        if decision.due_ns == DROPPED:
            return
        here, there = (self._senders_m.get(name) for name in (decision.source, decision.target))
        if here is None or there is None:
            return
        frame, cells = self._map_tracker.ground
        walls = walls_between(cells, *frame.uv(*here), *frame.uv(*there))
        range_m = self._faults.reach_m(now_ns, decision.source, decision.target)
        hidden = self._radio.line_of_sight and walls > 0
        if hidden or not math.dist(here, there) <= range_m - walls * self._radio.wall_loss_m:
            heard = f"{decision.source}#{decision.sequence}"
            self._complain("sight", decision.target, f"hears {heard} through {walls} walls")

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
            self._complain(
                "wall", step_record.name, f"stands at {now[0]:.6g}, {now[1]:.6g} m in a wall"
            )
        elif free_way(cells, FREE, *frame.uv(*before), *frame.uv(*now)) < 1.0:
            self._complain(
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
        cell = self._map_tracker.reachable(step_record.name) if self._exact else NEVER
        if cell != NEVER:
            self._complain("finish", step_record.name, f"could go to the frontier in cell {cell}")
