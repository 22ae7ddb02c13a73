"""The checker of every run. It reads only the record; each of its rules has a test that breaks it.

A violation is one line: rule, time, participant, text. A run is sound when there is none.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from kantor_protocol.base.machine import WORLD_SIM, ParticipantId
from kantor_protocol.scenario.faults.liars import liars_of
from kantor_protocol.scenario.faults.links import Hostile
from kantor_protocol.scenario.faults.processes import Kill, Late
from kantor_protocol.wire.attestations import Identities
from kantor_protocol.wire.weights import WeightsSubscriber
from kantor_worldsim.observers.checkers.batch_pass import check_batch
from kantor_worldsim.observers.checkers.delivery_index import index_deliveries
from kantor_worldsim.observers.checkers.lies import LiarChecker
from kantor_worldsim.observers.checkers.links import Links
from kantor_worldsim.observers.checkers.mapping import MapChecker
from kantor_worldsim.observers.checkers.outages import WrongClocks, caused_events
from kantor_worldsim.observers.checkers.registers import RegisterChecker
from kantor_worldsim.observers.checkers.state import (
    FORGED_FIRST,
    NOT_STOPPED,
    NOTED,
    CheckerState,
    Limits,
    logs_leave,
)
from kantor_worldsim.observers.checkers.violations import (
    FOREIGN_LOG,
    NOT_ITS_OWN,
    NOT_REBUILT,
    TEXTS,
    VIOLATIONS_MAX,
    describe,
    origin_of,
)
from kantor_worldsim.observers.metrics.density import DensityRow
from kantor_worldsim.observers.metrics.map_tracker import MapTracker
from kantor_worldsim.observers.metrics.wasserstein_exact import ROUNDING
from kantor_worldsim.observers.pipeline import Pipeline
from kantor_worldsim.record.columnar import DecodedRecord
from kantor_worldsim.record.process_events import (
    EVENTS,
    TAKE_OVER,
    WITHOUT_CAUSE,
    ProcessEventKind,
)
from kantor_worldsim.record.records import Batch, Ending, Opening, ProcessEvent, Record


class Checker:
    """Follows the records of one run and collects violations.

    A mission on a map has no weights, energy or ledger; it has rules of its own, see `MapChecker`. Where robots lie
    by a fault, what they say counts as their lies, and there are rules beside, see `LiarChecker`.

    Rules
    -----
    range       no envelope is delivered to a receiver beyond the range at the time of sending, nor beyond
                what a fault leaves of it
    cut         nothing is delivered over a link that a partition or a one-way fault cuts at that time
    delivery    what is in an inbox was delivered to it, is due, and came as often as decided; no participant
                uses a number twice; what arrives at a process that does not run is lost. In virtual time: a
                participant that steps has heard all that had arrived, in order of arrival, source and number
    weights     no entry of a weight vector ever rises or is negative, and what is published on the
                weights key rebuilds exactly this vector
    energy      no participant ships more points than its budget, over all its incarnations, or more units
                than a point holds
    ledger      consumed = sum of the ledgers: what a participant sends of a log is what its origin
                consumed, entry for entry, it forgets no entry, and at its end its vector is exactly what the
                logs it holds leave
    credit      no view is lower than the weights that all spending leaves (both merges)
    speed       no accepted move is longer than speed times time
    bound       where the bounds claim to hold, the exact distance is not above them (rows that have it)
    goal        a goal has weight in the robot's own view (transport with standing samples)
    register    the own register that a robot sends is the sum over the places from which it chose
                (spectral)
    order       steps count up by one, whatever happens to processes, time never runs back, an opening
                comes first, nothing after the end; with trust = "signed", and only then, the identities of
                the whole roster follow the opening
    hold        a step is made after the verdict on the one before
    ruling      world-sim refused nothing of a step, but the speed of a robot whose clock has gained on time
                since its last step
    incident    what happens to a process is what a fault causes: of its kind, to a process that it names, not
                too early, once, and not left out; without a fault processes only leave and join
    dead        a process that is dead, paused, late or without a disk does not act, and none acts while
                world-sim is down
    epoch       a new incarnation comes only after a lost or torn disk, or of itself; each counts one more,
                goes on from the last step, and names itself in its messages; no impostor is let in
    refusal     a participant refuses what is forged, all of it and nothing else, and nothing is forged but
                where a hostile fault allows it
    clock       the clock that a participant reads is as wrong as the clock faults make it; in real time no
                further than they have made it by then
    """

    def __init__(
        self,
        map_tracker: MapTracker | None = None,
        *,
        virtual: bool = True,
    ) -> None:
        """map_tracker: one that an earlier observer of the same run keeps; by default one of its own.

        virtual: virtual time, in which a participant hears all that has arrived; not the realtime exchange.
        """
        self.violations: list[str] = []
        """The first violations, as texts."""
        self.count = 0
        """All violations, also those beyond the ones that are kept."""
        self._map_tracker = map_tracker
        self._virtual = virtual
        self._map_checker: MapChecker | None = None
        self._register_checker: RegisterChecker | None = None
        self._liar_checker: LiarChecker | None = None
        self._opening: Opening | None = None
        self._unidentified = False
        """The opening is of a signed run, and the next record must be its identities."""
        self._ended = False
        self._now_ns = 0

    @property
    def lies(self) -> dict[ParticipantId, int]:
        """How often each declared liar has said what is against the rules."""
        return {} if self._liar_checker is None else dict(sorted(self._liar_checker.told.items()))

    def observe(self, decoded: DecodedRecord, /) -> None:
        """Check one record."""
        record = decoded.record
        if self._unidentified and not isinstance(record, Identities):
            self._unidentified = False
            self._report("order", "record", "signed, and no identities follow the opening")
        if self._ended:
            self._report("order", "record", "something follows the ending")
        elif isinstance(record, Opening):
            if self._opening is not None:
                self._report("order", "record", "a second opening")
            self._open(record)
        elif self._opening is None:
            self._report("order", "record", "no opening")
        elif isinstance(record, Identities):
            self._identify(record)
        elif isinstance(record, Batch):
            self._check(record, decoded)
        elif isinstance(record, ProcessEvent):
            self._follow_event(record)
        elif isinstance(record, Ending):
            self._ended = True
            self._end(record)

    def _identify(self, identities: Identities) -> None:
        if not self._unidentified:
            what = "identities that do not follow the opening of a signed run"
            self._report("order", "record", what)
        elif identities.keys.keys() != set(self._names):
            self._report("order", "record", "identities of another team")
        self._unidentified = False

    def observe_row(self, row: tuple[Any, ...]) -> None:
        """Compare a row's bounds with its exact distance, if they claim to be bounds."""
        if not isinstance(row, DensityRow) or row.w1_exact is None or row.w_ub_tight is None:
            return
        least = row.w1_exact * (1.0 - ROUNDING)
        for form, bound in (("tight", row.w_ub_tight), ("paper", row.w_ub_paper)):
            if not bound >= least:
                self._report(
                    "bound", f"tick {row.tick}", f"{form} {bound:.6g} m below {row.w1_exact:.6g} m"
                )

    def _report(self, rule: str, who: str, what: str) -> None:
        if self._liar_checker is not None and self._liar_checker.takes(rule, who):
            return
        self.count += 1
        if len(self.violations) < VIOLATIONS_MAX:
            self.violations.append(f"{rule}: t={self._now_ns * 1e-9:.3f} s: {who}: {what}")

    def _open(self, opening: Opening) -> None:
        scenario = opening.scenario
        self._opening, self._scenario, self._units = opening, scenario, opening.units
        self._names = scenario.roster
        self._unidentified = scenario.signed
        self._places = {name: i for i, name in enumerate(self._names)}
        self._subscriber = WeightsSubscriber(opening.samples_m.shape[0])
        self._hostile = [fault for fault in scenario.faults if isinstance(fault, Hostile)]
        self._clocks = WrongClocks(scenario, virtual=self._virtual)
        self._links = Links(scenario, opening.seed)
        if liars_of(scenario.faults):
            self._liar_checker = LiarChecker(opening, self._report)
        self._limits = Limits.of(
            opening,
            virtual=self._virtual,
            clocks=bool(self._clocks),
            false_logs=self._liar_checker is not None and bool(self._liar_checker.false_logs),
        )
        self._keep(CheckerState.of(opening))
        if self._liar_checker is not None:
            self._state.participants["lies"][self._liar_checker.liar_places] = 1
        if scenario.planner.name == "spectral":
            self._register_checker = RegisterChecker(scenario, self._report)
        self._due = {
            (event.fault, event.who, event.kind): event for event in caused_events(scenario)
        }
        """The events that faults cause and that have not happened yet."""
        self._stopped: dict[ParticipantId, dict[ProcessEventKind, int]] = {
            name: {} for name in self._names
        }
        self._stopped[WORLD_SIM] = {}
        """For each process the events that have stopped it, and since when."""
        for fault in scenario.faults:
            for name in fault.who if isinstance(fault, Late) else ():
                self._stop(name, ProcessEventKind.KILL, 0)
        if scenario.mapping:
            false = self._liar_checker.is_false if self._liar_checker is not None else None
            self._map_checker = MapChecker(self._map_tracker, self._report, false)
            self._map_checker.open(opening)

    def _keep(self, state: CheckerState) -> None:
        self._state = state
        self._arguments = tuple(state), tuple(self._limits), tuple(self._links.table)

    def _check(self, batch: Batch, decoded: DecodedRecord) -> None:
        self._pass_time(batch.now_ns)
        if self._stopped[WORLD_SIM]:
            self._report("dead", WORLD_SIM, "decides on steps, and is stopped")
        if batch.injected:
            self._check_injected(batch)
        if self._clocks:
            self._check_clocks(batch)
        self._links.move_to(batch.now_ns)
        noted = check_batch(decoded.columns, *self._arguments, batch.now_ns)
        while noted < 0:
            self._keep(self._state.lengthened(noted))
            noted = check_batch(decoded.columns, *self._arguments, batch.now_ns)
        if noted:
            self._report_noted(batch, self._state.counts.item(NOTED))
            self._check_keyframes(batch)
        if self._liar_checker is not None:
            self._check_beside_liars(batch, self._liar_checker)
        if self._register_checker is not None:
            self._check_registers(batch, self._register_checker)
        if self._map_checker is not None:
            beyond = self._map_checker.check(batch, decoded)  # it reports, which counts as well
            self.count += beyond

    def _pass_time(self, now_ns: int) -> None:
        if now_ns < self._now_ns:
            self._report("order", "record", f"time runs back to {now_ns * 1e-9:.3f} s")
        self._now_ns = now_ns

    def _check_injected(self, batch: Batch) -> None:
        if not any(fault.holds(batch.now_ns) for fault in self._hostile):
            self._report("refusal", "record", "a message is forged, which no fault allows")
        for envelope in batch.injected:
            if envelope.sequence < FORGED_FIRST:
                number = f"{envelope.source}#{envelope.sequence}"
                self._report("refusal", "record", f"{number} is forged, and may have been sent")

    def _check_clocks(self, batch: Batch) -> None:
        for step_record in batch.step_records:
            name, now_ns = step_record.name, step_record.now_ns
            least_ns, most_ns = self._clocks.skews_ns(name, now_ns, batch.now_ns)
            if not least_ns <= step_record.skew_ns <= most_ns:
                what = f"its clock is {step_record.skew_ns} ns ahead, by its faults {most_ns}"
                self._report("clock", name, what)

    def _follow_event(self, process_event: ProcessEvent) -> None:
        """Follow an event of a process."""
        self._pass_time(process_event.now_ns)
        name, kind = process_event.who, process_event.kind
        if name not in self._stopped:
            self._report("incident", name, "not in the roster")
            return
        self._check_cause(process_event)
        if EVENTS[kind].ended_by is not None:
            self._stop(name, kind, process_event.now_ns)
        elif kind in TAKE_OVER and name in self._places:
            self._check_start(process_event, self._places[name])
        for cause in tuple(self._stopped[name]):
            if EVENTS[cause].ended_by == kind or kind in TAKE_OVER:
                del self._stopped[name][cause]
        self._note_stopped(name)
        if self._map_checker is not None:
            self._map_checker.follow_event(process_event)

    def _check_cause(self, process_event: ProcessEvent) -> None:
        """A fault causes the event, or it is one that needs none."""
        fault, name, kind = process_event.fault, process_event.who, process_event.kind
        if kind is ProcessEventKind.IMPOSTOR_ADMITTED:
            self._report("epoch", name, "an impostor was let in")
            kind = ProcessEventKind.IMPOSTOR_REFUSED
        if fault < 0:
            if kind not in WITHOUT_CAUSE:
                self._report("incident", name, f"{kind}, which no fault causes")
            return
        caused = self._due.pop((fault, name, kind), None)
        if caused is None:
            self._report("incident", name, f"{kind}, which fault {fault} does not cause, or once")
        elif process_event.now_ns < caused.at_ns:
            self._report("incident", name, f"{kind} before {caused.at_ns * 1e-9:.3f} s")

    def _stop(self, name: ParticipantId, kind: ProcessEventKind, now_ns: int) -> None:
        self._stopped[name].setdefault(kind, now_ns)
        self._note_stopped(name)

    def _note_stopped(self, name: ParticipantId) -> None:
        if name in self._places:
            since_ns = min(self._stopped[name].values(), default=NOT_STOPPED)
            self._state.participants[self._places[name]]["stopped_ns"] = since_ns

    def _check_start(self, process_event: ProcessEvent, place: int) -> None:
        """A process starts to drive a body, as the incarnation before it or as the next one."""
        participant = self._state.participants[place]
        steps, incarnation = (
            int(participant["steps"]),
            int(participant["incarnation_id"]) // len(self._names),
        )
        disk = self._disk_of(process_event.fault)
        expected = {incarnation}
        if steps and disk != "kept":
            expected = {incarnation + 1} if disk == "lost" else {incarnation, incarnation + 1}
        if process_event.incarnation not in expected:
            what = (
                f"incarnation {process_event.incarnation} after {incarnation}, its disk is {disk}"
            )
            self._report("epoch", process_event.who, what)
        # The last step of an incarnation may be in its log and not in the record.
        ahead = 1 if process_event.incarnation == incarnation else 0
        if not steps <= process_event.step <= steps + ahead:
            what = f"goes on from step {process_event.step}, its last was {steps}"
            self._report("epoch", process_event.who, what)
        self._drop_undelivered(place, process_event.now_ns)
        if process_event.incarnation > incarnation:
            self._begin_incarnation(process_event, place)

    def _disk_of(self, fault: int) -> str:
        """The disk that a fault leaves; unknown for a process that came without one."""
        if fault < 0:
            return "unknown"
        faults = self._scenario.faults
        known = faults[fault] if fault < len(faults) else None
        return known.disk if isinstance(known, Kill) else "kept"

    def _drop_undelivered(self, place: int, now_ns: int) -> None:
        """What has arrived at a stopped process is lost, but for the inbox of a step request that is open."""
        participant = self._state.participants[place]
        if not self._stopped[self._names[place]]:
            return
        deliveries = self._state.deliveries[place]
        under_way = deliveries[: participant["under_way"]]
        due_ns, handed_over = (
            under_way["due_ns"],
            participant["asked"] & under_way["handed_over"] > 0,
        )
        kept = under_way[(due_ns < participant["stopped_ns"]) | (due_ns >= now_ns) | handed_over]
        deliveries[: kept.shape[0]] = kept
        participant["under_way"] = kept.shape[0]
        index_deliveries(deliveries, self._state.delivery_slots[place], kept.shape[0])

    def _begin_incarnation(self, process_event: ProcessEvent, place: int) -> None:
        """A new incarnation knows nothing: its vector is full, it holds no entry, its own log is empty."""
        if self._limits.ledger and self._state.participants[place]["vector_sent"]:
            self._check_view(process_event.who, place)
        roster = len(self._names)
        incarnation_id = process_event.incarnation * roster + place
        while incarnation_id >= self._state.shipped.shape[0]:
            self._keep(self._state.with_incarnations(roster))
        state = self._state
        state.views[place], state.published[place] = self._units.sample, 0
        state.version_vector[place] = 0
        participant = state.participants[place]
        participant["incarnation_id"] = incarnation_id
        for field in ("sequence", "differing", "vector_sent", "refusals_so_far"):
            participant[field] = 0

    def _report_noted(self, batch: Batch, count: int) -> None:
        noted = min(count, VIOLATIONS_MAX)
        for violation in self._state.violations[:noted].tolist():
            if not self._is_in_good_faith(violation):
                self._report(*describe(batch, self._names, violation))
        self.count += count - noted

    def _is_in_good_faith(self, noted: tuple[Any, ...]) -> bool:
        """Whether a noted violation is the log of a liar in the message of another, who cannot know it."""
        kind, _, origin, *_ = noted
        return (
            kind == FOREIGN_LOG
            and self._liar_checker is not None
            and self._liar_checker.is_false(origin)
        )

    def _check_beside_liars(self, batch: Batch, checker: LiarChecker) -> None:
        consumed = self._state.consumed
        checker.check(batch, consumed)
        for step_record in batch.step_records if checker.false_logs else ():
            place = self._places.get(step_record.name)
            if (
                place is not None
                and step_record.outputs is not None
                and step_record.outputs.lowered
            ):
                checker.check_view(place, self._state.views[place], consumed)

    def _check_keyframes(self, batch: Batch) -> None:
        participants, subscriber = self._state.participants, self._subscriber
        for place in np.flatnonzero(participants["keyframe"]).tolist():
            participant = participants[place]
            step_record = batch.step_records[participant["keyframe"] - 1]
            assert step_record.outputs is not None
            rebuilt = subscriber.apply(step_record.outputs.weights)
            weights, view = subscriber.weights, self._state.views[place]
            if not rebuilt or weights is None or weights.shape != view.shape:
                participant["sequence"] = 0
                self._report("weights", step_record.name, TEXTS[NOT_REBUILT][1])
                continue
            self._state.published[place] = weights
            participant["differing"] = np.count_nonzero(weights != view)
            if participant["differing"]:
                self._report("weights", step_record.name, TEXTS[NOT_ITS_OWN][1])

    def _check_registers(self, batch: Batch, checker: RegisterChecker) -> None:
        for step_record in batch.step_records:
            outputs, place = step_record.outputs, self._places.get(step_record.name)
            if outputs is not None and step_record.verdict is not None and place is not None:
                incarnation_id = int(self._state.participants[place]["incarnation_id"])
                points = int(self._state.shipped[incarnation_id]["writes"])
                checker.check(step_record, outputs, incarnation_id, points)

    def _end(self, ending: Ending) -> None:
        if self._limits.ledger:
            for name, place in self._places.items():
                if self._state.participants[place]["vector_sent"]:
                    self._check_view(name, place)
        for event in self._due.values():
            if event.at_ns < ending.now_ns and self._virtual and not event.mid_step:
                what = f"no {event.kind}, which fault {event.fault} causes"
                self._report("incident", event.who, f"{what} at {event.at_ns * 1e-9:.3f} s")

    def _check_view(self, name: ParticipantId, place: int) -> None:
        """A view is exactly what the entries leave that its participant says it holds; false logs may have taken more."""
        state, liars = self._state, self._liar_checker
        if liars is not None and place in liars.false_logs:
            return  # after a restart its own lies may come back to it
        false = np.zeros(state.shipped.shape[0], dtype=np.bool_)
        if liars is not None:
            false[:] = [liars.is_false(origin) for origin in range(false.shape[0])]
        left = np.full(state.consumed.shape[0], self._units.sample, dtype=np.int64)
        origin = logs_leave(tuple(state), place, false, left)
        if origin >= 0:
            length, entries = state.version_vector[place, origin], state.shipped[origin]["entries"]
            whose = origin_of(origin, self._names)
            self._report("ledger", name, f"holds {length} entries of {whose}'s {entries}")
            return
        holds_false = bool((state.version_vector[place, false] > 0).any())
        lost = np.maximum(left, 0) - state.views[place]
        if holds_false and liars is not None and lost.min(initial=0) >= 0:
            liars.check_lost(name, int(lost.sum()))
        elif lost.any():
            what = f"its view of sample {np.flatnonzero(lost)[0]} is not what its logs leave"
            self._report("ledger", name, what)


def check(records: Iterable[Record], *, virtual: bool = True) -> Checker:
    """Check a whole record. virtual: see Checker."""
    checker = Checker(virtual=virtual)
    pipeline = Pipeline(checker)
    for record in records:
        pipeline.observe(record)
    return checker
