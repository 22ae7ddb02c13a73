"""Referees that read only the record. Each rule can fail, and a test shows how.

A complaint is one line: rule, time, who, what. A run is clean when there is none.

Rules on numbers are kernels over the tables of a batch (`reading.py`). A fault is noted as a row of
numbers and put into words afterwards, with the record at hand: a sound run, which is nearly every run,
then costs little more than reading it.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import WORLD_SIM, Envelope, Outputs, ParticipantId
from kantor_protocol.replication.cosine_basis import rectangle_of, visit_at
from kantor_protocol.replication.registers import read_register
from kantor_protocol.scenario.faults.base import Fault
from kantor_protocol.scenario.faults.links import Hostile
from kantor_protocol.scenario.faults.processes import ClockFault, Kill, Late
from kantor_protocol.wire.messages import RefusedError, decode_gossip
from kantor_protocol.wire.version_vector import covered_ids
from kantor_protocol.wire.weights import WeightsSubscriber
from kantor_worldsim.engine.process_faults import ScheduledProcessFault, schedule_of
from kantor_worldsim.observers.checkers.conservation import (
    check_energy,
    check_goal,
    check_published,
    check_weights,
)
from kantor_worldsim.observers.checkers.delivery import (
    check_decision,
    check_inbox,
    post,
    post_forged,
)
from kantor_worldsim.observers.checkers.mapping import MapChecker
from kantor_worldsim.observers.checkers.motion import (
    check_incarnation,
    check_order,
    check_refusals,
    check_speed,
    check_verdict,
)
from kantor_worldsim.observers.checkers.replication import check_gossip
from kantor_worldsim.observers.checkers.state import (
    BOOK_COLUMNS,
    DIFFERING,
    ENTRIES,
    FAULTS,
    FLYING,
    FOREIGN_LOG,
    FORGED_FIRST,
    FORGETS,
    GROWING,
    KEYFRAME,
    KEYFRAMES,
    NO_SAMPLE,
    NO_WEIGHT,
    NOBODYS,
    NOT,
    NOT_ITS_OWN,
    NOT_REBUILT,
    OF_DECISIONS,
    OPEN,
    OUT_OF_TURN,
    REFUSALS_SO_FAR,
    REFUSED,
    SEQUENCE,
    SLOT,
    STARTS,
    STEPS,
    STOPPED_NS,
    STOPS,
    STRANGER,
    TOLD,
    UNHEARD,
    UNREADABLE,
    VIOLATIONS_MAX,
    WITHHELD,
    WORDS,
    WRITES,
    CheckerState,
    Limits,
    missing_capacity,
    note_violation,
)
from kantor_worldsim.observers.metrics.density import DensityRow
from kantor_worldsim.observers.metrics.map_tracker import MapTracker
from kantor_worldsim.observers.metrics.wasserstein_exact import ROUNDING
from kantor_worldsim.radio.fault_kernels import FaultTable
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.record import columnar as of
from kantor_worldsim.record.columnar import ColumnarBatch, ColumnarDecoder
from kantor_worldsim.record.records import Batch, Ending, Opening, ProcessEvent, Record, StepRecord


@kernel
def _check(
    payload: bytes,
    sizes: np.ndarray,
    step_records: np.ndarray,
    ruled_m: np.ndarray,
    heard: np.ndarray,
    sent: np.ndarray,
    decisions: np.ndarray,
    pairs: np.ndarray,
    injected: np.ndarray,
    book: np.ndarray,
    poses_m: np.ndarray,
    views: np.ndarray,
    published: np.ndarray,
    consumed: np.ndarray,
    shipped: np.ndarray,
    logs: np.ndarray,
    posted: np.ndarray,
    flights: np.ndarray,
    forged: np.ndarray,
    version_vector: np.ndarray,
    faults: np.ndarray,
    lengths_m: np.ndarray,
    found: np.ndarray,
    samples_m: np.ndarray,
    by_x: np.ndarray,
    sample_units: int,
    point_units: int,
    budget: int,
    ledger: bool,
    supervisor: int,
    speed_m_s: float,
    range_m: float,
    supervisor_range_m: float,
    transport: bool,
    claims: bool,
    virtual: bool,
    clocks: bool,
    patience_ns: int,
    seed: int,
    link_rules: np.ndarray,
    link_numbers: np.ndarray,
    link_names: np.ndarray,
    severed: np.ndarray,
    now_ns: int,
) -> int:
    """Follow one batch; how many faults and keyframes it has.

    Negative if an array has no room, and nothing has changed.
    """
    columns = ColumnarBatch(
        payload, sizes, step_records, ruled_m, heard, sent, decisions, pairs, injected
    )
    state = CheckerState(
        book,
        poses_m,
        views,
        published,
        consumed,
        shipped,
        logs,
        posted,
        flights,
        forged,
        version_vector,
        faults,
        lengths_m,
        found,
        samples_m,
        by_x,
    )
    limits = Limits(
        sample_units,
        point_units,
        budget,
        ledger,
        supervisor,
        speed_m_s,
        range_m,
        supervisor_range_m,
        transport,
        claims,
        virtual,
        clocks,
        patience_ns,
    )
    links = FaultTable(seed, link_rules, link_numbers, link_names, severed)
    lacking = missing_capacity(state, columns)
    if lacking < 0:
        return lacking
    found[FAULTS], found[KEYFRAMES] = 0, 0
    for row in range(sizes[of.ACTS]):
        if step_records[row, of.PLACE] >= 0:
            check_inbox(state, limits, columns, row, now_ns)
            post(state, columns, row)
    post_forged(state, columns)
    for row in range(sizes[of.VERDICTS]):
        check_decision(state, limits, links, columns, row, now_ns)
    for row in range(sizes[of.ACTS]):
        who = step_records[row, of.PLACE]
        if who < 0:
            note_violation(state, STRANGER, row, 0, 0, 0, 0.0, 0.0)
            continue
        if not step_records[row, of.PRESENT]:
            continue
        check_incarnation(state, limits, columns, row)
        check_order(state, columns, row)
        check_refusals(state, columns, row)
        check_speed(state, limits, columns, row)
        check_energy(state, limits, columns, row)
        check_weights(state, limits, columns, row)
        for item in range(step_records[row, of.SENT_COUNT]):
            check_gossip(state, limits, columns, row, item)
        check_verdict(state, limits, columns, row)
        if step_records[row, of.WEIGHTS_BYTES]:
            check_published(state, columns, row)
        if transport and step_records[row, of.HEADS]:
            check_goal(state, columns, row)
    return found[FAULTS] + found[KEYFRAMES]


class Checker:
    """Follows the records of one run and collects complaints.

    A mission with a map has no weights, energy or ledger; it has rules of its own, see `MapRules`.

    Rules
    -----
    range       no envelope is delivered to anybody beyond the range at the time of sending, nor beyond
                what a fault leaves of it
    cut         nothing is delivered over a link that a partition or a one-way fault cuts at that time
    delivery    what is in an inbox was delivered to it, is due, and came as often as ruled; nobody uses a
                number twice; what arrives where nobody lives is lost. In virtual time: who steps has heard
                all that had arrived, in order of arrival, source and number
    weights     no entry of a weight vector ever rises or is negative, and what is published on the
                weights key rebuilds exactly this vector
    energy      nobody ships more points than its budget, over all its incarnations, or more units than a
                point holds
    ledger      consumed = sum of the ledgers: what a participant sends of a log is what its origin
                consumed, entry for entry, it forgets no entry, and at its end its vector is exactly what the
                logs it holds leave
    credit      no view is lower than the weights that all spending leaves (both merges)
    speed       no accepted move is longer than speed times time
    bound       where the bounds claim to hold, the exact distance is not above them (rows that have it)
    goal        a goal has weight in the robot's own view (transport with standing samples)
    register    the own register that a robot sends is the sum over the places from which it chose
                (spectral)
    order       steps count up by one, whatever becomes of processes, time never runs back, an opening
                first, nothing after the end
    hold        a step is made by who has seen what became of the one before
    ruling      the world found no fault of its own, but for the speed of who has a clock that has gained on
                time since its last step
    incident    what befalls a process is what a fault says: of its kind, to whom it names, not too early,
                once, and not left out; without a fault processes only leave and join
    dead        who is dead, paused, not there yet or without a disk does not act, and nobody does while
                world-sim is down
    epoch       a new incarnation comes only after a lost or torn disk, or of itself; each counts one more,
                goes on from the last step, and says in its messages which it is; no impostor is let in
    refusal     a participant refuses what is forged, all of it and nothing else, and nothing is forged but
                where a hostile fault says so
    clock       the clock that a participant reads is as wrong as the faults of clocks say; on the wall no
                further than they have said by then
    """

    def __init__(
        self,
        decoder: ColumnarDecoder | None = None,
        map_tracker: MapTracker | None = None,
        *,
        virtual: bool = True,
    ) -> None:
        """reader, survey: those that another referee of the same run follows it by.

        virtual: not the wall exchange, so that all that had arrived is heard.
        """
        self.complaints: list[str] = []
        self.count = 0
        """All complaints, also those beyond the ones that are kept."""
        self._decoder = decoder or ColumnarDecoder()
        self._map_tracker = map_tracker
        self._virtual = virtual
        self._map_rules: MapChecker | None = None
        self._opening: Opening | None = None
        self._ended = False
        self._now_ns = 0

    def observe(self, record: Record) -> None:
        """Check one record."""
        if self._ended:
            self._complain("order", "record", "something follows the ending")
        elif isinstance(record, Opening):
            if self._opening is not None:
                self._complain("order", "record", "a second opening")
            self._open(record)
        elif self._opening is None:
            self._complain("order", "record", "no opening")
        elif isinstance(record, Batch):
            self._check(record)
        elif isinstance(record, ProcessEvent):
            self._befall(record)
        else:
            self._ended = True
            self._end(record)

    def observe_row(self, row: tuple[Any, ...]) -> None:
        """Hold a row's bounds against its exact distance, if they claim to be bounds."""
        if not isinstance(row, DensityRow) or row.w1_exact is None or row.w_ub_tight is None:
            return
        least = row.w1_exact * (1.0 - ROUNDING)
        for form, bound in (("tight", row.w_ub_tight), ("paper", row.w_ub_paper)):
            if not bound >= least:
                self._complain(
                    "bound", f"tick {row.tick}", f"{form} {bound:.6g} m below {row.w1_exact:.6g} m"
                )

    def _complain(self, rule: str, who: str, what: str) -> None:
        self.count += 1
        if len(self.complaints) < VIOLATIONS_MAX:
            self.complaints.append(f"{rule}: t={self._now_ns * 1e-9:.3f} s: {who}: {what}")

    def _open(self, opening: Opening) -> None:
        self._decoder.read(opening)
        scenario, site = opening.scenario, opening.site
        self._opening, self._scenario, self._units = opening, scenario, opening.units
        self._samples = site.samples_m.shape[0]
        names = scenario.roster
        self._names = names
        self._places = {name: i for i, name in enumerate(names)}
        self._subscriber = WeightsSubscriber()
        self._links = LinkFaults(scenario, opening.seed).table
        self._hostile = [fault for fault in scenario.faults if isinstance(fault, Hostile)]
        self._clocks = [fault for fault in scenario.faults if isinstance(fault, ClockFault)]
        self._clocks_of = {
            name: [fault for fault in self._clocks if name in fault.who] for name in names
        }
        self._deeds: dict[tuple[int, ParticipantId, str], ScheduledProcessFault] = {
            (deed.fault, deed.who, deed.what): deed for deed in schedule_of(scenario)
        }
        self._stopped: dict[ParticipantId, dict[str, int]] = {name: {} for name in names}
        self._stopped[WORLD_SIM] = {}
        """Who is stopped by what, and since when."""
        self._limits = Limits(
            sample_units=self._units.sample,
            point_units=self._units.point,
            budget=scenario.steps_per_robot,
            ledger=scenario.merge == "ledger" and not scenario.mapping,
            supervisor=scenario.robots.count,
            speed_m_s=scenario.vehicle.speed_m_s,
            range_m=scenario.radio.range_m,
            supervisor_range_m=scenario.supervisor.range_m,
            transport=scenario.planner.name == "transport" and scenario.samples.diffusion_m == 0.0,
            claims=scenario.claiming,
            virtual=self._virtual,
            clocks=bool(self._clocks),
            patience_ns=scenario.period_ns,
        )
        poses_m = np.zeros((len(names), 2))
        poses_m[-1] = scenario.supervisor_m
        poses_m[: scenario.robots.count] = site.starts_m
        self._state = CheckerState(
            book=np.zeros((len(names), BOOK_COLUMNS), dtype=np.int64),
            poses_m=poses_m,
            views=np.full((len(names), self._samples), self._units.sample, dtype=np.int64),
            published=np.zeros((len(names), self._samples), dtype=np.int64),
            consumed=np.zeros(self._samples, dtype=np.int64),
            shipped=np.zeros((len(names), 2), dtype=np.int64),
            logs=np.zeros((len(names), 256, 2), dtype=np.int64),
            posted=np.zeros((len(names), 256, 2), dtype=np.int64),
            flights=np.zeros((len(names), 64, 4), dtype=np.int64),
            forged=np.zeros((1, 64, 3), dtype=np.int64),
            version_vector=np.zeros((len(names), len(names)), dtype=np.int64),
            faults=np.zeros((VIOLATIONS_MAX, 5), dtype=np.int64),
            lengths_m=np.zeros((VIOLATIONS_MAX, 2)),
            found=np.zeros(3, dtype=np.int64),
            samples_m=site.samples_m.copy(),
            by_x=np.argsort(site.samples_m[:, 0]),
        )
        self._state.book[:, SLOT] = np.arange(len(names))
        self._state.book[:, STOPPED_NS] = NOT
        self._arguments = (*self._state, *self._limits, *self._links)
        self._visiting = scenario.planner.name == "spectral"
        self._registers = np.zeros((len(names), scenario.register_width), dtype=np.int64)
        self._rectangle = rectangle_of(scenario.domain)
        for fault in scenario.faults:
            for name in fault.who if isinstance(fault, Late) else ():
                self._stop(name, "kill", 0)
        if scenario.mapping:
            self._map_rules = MapChecker(
                self._map_tracker or MapTracker(self._decoder), self._complain
            )
            self._map_rules.open(opening)

    def _check(self, batch: Batch) -> None:
        self._pass_time(batch.now_ns)
        if self._stopped[WORLD_SIM]:
            self._complain("dead", WORLD_SIM, "judges what is done, and is stopped")
        if batch.injected:
            self._check_injected(batch)
        if self._clocks:
            self._check_clocks(batch)
        columns = self._decoder.read(batch)
        noted = _check(*columns, *self._arguments, batch.now_ns)
        while noted < 0:
            self._lengthen(GROWING[noted])
            noted = _check(*columns, *self._arguments, batch.now_ns)
        if noted:
            self._put_into_words(batch, self._state.found.item(FAULTS))
            self._check_keyframes(batch)
        if self._visiting:
            self._check_registers(batch)
        if self._map_rules is not None:
            unsaid = self._map_rules.check(batch)
            self.count += unsaid

    def _pass_time(self, now_ns: int) -> None:
        if now_ns < self._now_ns:
            self._complain("order", "record", f"time runs back to {now_ns * 1e-9:.3f} s")
        self._now_ns = now_ns

    def _check_injected(self, batch: Batch) -> None:
        if not any(_within(fault, batch.now_ns) for fault in self._hostile):
            self._complain("refusal", "record", "something is forged where no fault says so")
        for envelope in batch.injected:
            if envelope.sequence < FORGED_FIRST:
                number = f"{envelope.source}#{envelope.sequence}"
                self._complain("refusal", "record", f"{number} is forged, and may have been sent")

    def _check_clocks(self, batch: Batch) -> None:
        for step_record in batch.step_records:
            if step_record.skew_ns == 0 and not self._clocks_of.get(step_record.name):
                continue
            least_ns, most_ns = self._skews_ns(step_record.name, step_record.now_ns)
            if not least_ns <= step_record.skew_ns <= most_ns:
                what = f"its clock is {step_record.skew_ns} ns ahead, by its faults {most_ns}"
                self._complain("clock", step_record.name, what)

    def _skews_ns(self, name: ParticipantId, now_ns: int) -> tuple[int, int]:
        """The least and the most that a clock can be ahead. On the wall it hears of its faults later."""
        clocks = self._clocks_of.get(name, ())
        if self._virtual:
            skew_ns = sum(clock.skew_ns(now_ns) for clock in clocks if _within(clock, now_ns))
            skew_ns = max(skew_ns, -now_ns)  # no clock shows a time before 0
            return skew_ns, skew_ns
        least_ns = most_ns = 0
        for clock in clocks:
            if clock.from_ns <= now_ns:
                last_ns = now_ns if clock.until_ns is None else min(now_ns, clock.until_ns)
                said_ns = (0, clock.skew_ns(clock.from_ns), clock.skew_ns(last_ns))
                least_ns, most_ns = least_ns + min(said_ns), most_ns + max(said_ns)
        return least_ns, most_ns

    def _befall(self, incident: ProcessEvent) -> None:
        """Follow what befell a process."""
        self._pass_time(incident.now_ns)
        name, what = incident.who, incident.what
        if name not in self._stopped:
            self._complain("incident", name, "not in the roster")
            return
        self._check_cause(incident)
        if what in STOPS:
            self._stop(name, what, incident.now_ns)
        elif what in STARTS and name in self._places:
            self._take_over(incident, self._places[name])
        for cause in tuple(self._stopped[name]):
            if STOPS[cause] == what or what in STARTS:
                del self._stopped[name][cause]
        self._note_stopped(name)
        if self._map_rules is not None:
            self._map_rules.befall(incident)

    def _check_cause(self, incident: ProcessEvent) -> None:
        """Whether a fault says so, or nobody."""
        fault, name, what = incident.fault, incident.who, incident.what
        if what == "let in":
            self._complain("epoch", name, "an impostor was let in")
            what = "pretend"
        if fault < 0:
            if what not in {"leave", "join"}:
                self._complain("incident", name, f"{what}, and no fault says so")
            return
        deed = self._deeds.pop((fault, name, what), None)
        if deed is None:
            self._complain("incident", name, f"{what}, which fault {fault} does not say, or once")
        elif incident.now_ns < deed.at_ns:
            self._complain("incident", name, f"{what} before {deed.at_ns * 1e-9:.3f} s")

    def _stop(self, name: ParticipantId, what: str, now_ns: int) -> None:
        self._stopped[name].setdefault(what, now_ns)
        self._note_stopped(name)

    def _note_stopped(self, name: ParticipantId) -> None:
        if name in self._places:
            since_ns = min(self._stopped[name].values(), default=NOT)
            self._state.book[self._places[name], STOPPED_NS] = since_ns

    def _take_over(self, incident: ProcessEvent, place: int) -> None:
        """A process takes a body over: as who drove it before, or as a new incarnation."""
        book = self._state.book[place]
        steps, incarnation = book.item(STEPS), book.item(SLOT) // len(self._names)
        disk = self._disk_of(incident.fault)
        expected = {incarnation}
        if steps and disk != "kept":
            expected = {incarnation + 1} if disk == "lost" else {incarnation, incarnation + 1}
        if incident.incarnation not in expected:
            what = f"incarnation {incident.incarnation} after {incarnation}, its disk is {disk}"
            self._complain("epoch", incident.who, what)
        ahead = (
            1 if incident.incarnation == incarnation else 0
        )  # its last step may have been heard by nobody
        if not steps <= incident.step <= steps + ahead:
            what = f"goes on from step {incident.step}, its last was {steps}"
            self._complain("epoch", incident.who, what)
        self._lose_flights(place, incident.now_ns)
        if incident.incarnation > incarnation:
            self._be_reborn(incident, place)

    def _disk_of(self, fault: int) -> str:
        """What is left of the disk by a fault; nobody knows what a process finds that came of itself."""
        if fault < 0:
            return "unknown"
        faults = self._scenario.faults
        known = faults[fault] if fault < len(faults) else None
        return known.disk if isinstance(known, Kill) else "kept"

    def _lose_flights(self, place: int, now_ns: int) -> None:
        """What has arrived where nobody lived is lost, but for what came with a turn that is open."""
        book = self._state.book[place]
        if not self._stopped[self._names[place]]:
            return
        flights = self._state.flights[place]
        under_way = flights[: book[FLYING]]
        due_ns = under_way[:, 2]
        kept = under_way[
            (due_ns < book[STOPPED_NS]) | (due_ns >= now_ns) | (book[OPEN] & under_way[:, 3] > 0)
        ]
        flights[: kept.shape[0]] = kept
        book[FLYING] = kept.shape[0]

    def _be_reborn(self, incident: ProcessEvent, place: int) -> None:
        """All that it knew is gone: its vector is full, its logs are empty, its own is a new one."""
        if self._limits.ledger and self._state.book[place, TOLD]:
            self._check_view(incident.who, place)
        participants = len(self._names)
        slot = incident.incarnation * participants + place
        while slot >= self._state.shipped.shape[0]:
            self._add_slots(participants)
        state = self._state
        state.views[place], state.published[place] = self._units.sample, 0
        state.version_vector[place] = 0
        book = state.book[place]
        book[SLOT] = slot
        book[[SEQUENCE, DIFFERING, TOLD, REFUSALS_SO_FAR]] = 0

    def _add_slots(self, more: int) -> None:
        """Room for another incarnation of everybody."""
        state = self._state
        self._state = state._replace(
            shipped=np.pad(state.shipped, ((0, more), (0, 0))),
            logs=np.pad(state.logs, ((0, more), (0, 0), (0, 0))),
            version_vector=np.pad(state.version_vector, ((0, 0), (0, more))),
        )
        self._registers = np.pad(self._registers, ((0, more), (0, 0)))
        self._arguments = (*self._state, *self._limits, *self._links)

    def _lengthen(self, name: str) -> None:
        """Double one of the arrays that grow with the run."""
        rows = getattr(self._state, name)
        longer = np.concatenate((rows, np.zeros_like(rows)), axis=1)
        self._state = self._state._replace(**{name: longer})
        self._arguments = (*self._state, *self._limits, *self._links)

    def _put_into_words(self, batch: Batch, faults: int) -> None:
        noted = min(faults, VIOLATIONS_MAX)
        rows, lengths_m = self._state.faults[:noted], self._state.lengths_m[:noted]
        for (fault, row, item, a, b), (x, y) in zip(rows.tolist(), lengths_m.tolist(), strict=True):
            rule, text = WORDS[fault]
            who, what = self._concerned(batch, fault, row, item, a, b)
            self._complain(rule, who, text.format(what=what, item=item, a=a, b=b, x=x, y=y))
        self.count += faults - noted

    def _check_keyframes(self, batch: Batch) -> None:
        book, subscriber = self._state.book, self._subscriber
        for place in np.flatnonzero(book[:, KEYFRAME]).tolist():
            step_record = batch.step_records[book[place, KEYFRAME] - 1]
            assert step_record.outputs is not None
            rebuilt = subscriber.apply(step_record.outputs.weights)
            weights, view = subscriber.weights, self._state.views[place]
            if not rebuilt or weights is None or weights.shape != view.shape:
                book[place, SEQUENCE] = 0
                self._complain("weights", step_record.name, WORDS[NOT_REBUILT][1])
                continue
            self._state.published[place] = weights
            book[place, DIFFERING] = np.count_nonzero(weights != view)
            if book[place, DIFFERING]:
                self._complain("weights", step_record.name, WORDS[NOT_ITS_OWN][1])

    def _check_registers(self, batch: Batch) -> None:
        for step_record in batch.step_records:
            if (
                step_record.outputs is not None
                and step_record.verdict is not None
                and step_record.name in self._places
            ):
                self._check_register(step_record, step_record.outputs)

    def _check_register(self, step_record: StepRecord, outputs: Outputs) -> None:
        """It chooses where it was observed last."""
        name = step_record.name
        slot = self._state.book.item(self._places[name], SLOT)
        if outputs.spent:
            pose, modes = step_record.observation.pose, self._scenario.planner.modes
            self._registers[slot] += visit_at(pose.x_m, pose.y_m, self._rectangle, modes)
        points, sums = self._state.shipped.item(slot, WRITES), self._registers[slot].tobytes()
        for envelope in outputs.outbox:
            sent = self._sent_register(envelope, slot)
            if sent is None:
                self._complain("register", name, "sends what nobody can read")
            elif sent[0] and sent[1].tobytes() != sums:
                self._complain("register", name, "its sums are not those over its places")
            elif sent[0] and sent[0] != points:
                self._complain("register", name, f"writes {sent[0]} of {points}")

    def _sent_register(
        self, envelope: Envelope, slot: int
    ) -> tuple[int, npt.NDArray[np.int64]] | None:
        """Stamp and numbers of a register in a message; stamp 0 if absent, None if malformed."""
        try:
            news = decode_gossip(envelope.body)
        except RefusedError:
            return None
        slots = covered_ids(news.version_vector, len(self._names), claims=self._limits.claims)
        if slots is None:
            return None
        return read_register(news.registers, slots, self._scenario.register_width, slot)

    def _end(self, ending: Ending) -> None:
        if self._limits.ledger:
            for name, place in self._places.items():
                if self._state.book[place, TOLD]:
                    self._check_view(name, place)
        for deed in self._deeds.values():
            if deed.at_ns < ending.now_ns and self._virtual and not deed.mid_step:
                what = (
                    f"no {deed.what}, and fault {deed.fault} says so at {deed.at_ns * 1e-9:.3f} s"
                )
                self._complain("incident", deed.who, what)

    def _check_view(self, name: ParticipantId, place: int) -> None:
        state = self._state
        spent = np.zeros(self._samples, dtype=np.int64)
        for slot, length in enumerate(state.version_vector[place].tolist()):
            entries = state.shipped.item(slot, ENTRIES)
            if length > entries:
                origin = self._origin(slot)
                self._complain("ledger", name, f"holds {length} entries of {origin}'s {entries}")
                return
            log = state.logs[slot, :length]
            np.add.at(spent, log[:, 0], log[:, 1])
        wrong = np.flatnonzero(state.views[place] != np.maximum(self._units.sample - spent, 0))
        if wrong.size:
            self._complain(
                "ledger", name, f"its view of sample {wrong[0]} is not what its logs leave"
            )

    def _origin(self, slot: int) -> str:
        """A participant, and which incarnation if it is not the first."""
        incarnation, place = divmod(slot, len(self._names))
        return f"{self._names[place]}:{incarnation}" if incarnation else self._names[place]

    def _concerned(
        self, batch: Batch, fault: int, row: int, item: int, a: int, b: int
    ) -> tuple[str, str]:
        """Whom a fault is about; and which envelope, which origin, or what the codec says of it."""
        if fault in OF_DECISIONS:
            decision = batch.decisions[row]
            return decision.target, f"{decision.source}#{decision.sequence}"
        step_record = batch.step_records[row]
        if fault in (UNHEARD, OUT_OF_TURN):
            source, sequence = step_record.heard[item]
            return step_record.name, f"{source}#{sequence}"
        if fault == WITHHELD:
            return step_record.name, f"{self._names[a] if a >= 0 else 'a stranger'}#{b}"
        if fault in (FOREIGN_LOG, FORGETS, NOBODYS):
            return step_record.name, self._origin(item)
        if fault == REFUSED and step_record.verdict is not None:
            return step_record.name, step_record.verdict.violations[item]
        if fault in (NO_SAMPLE, NO_WEIGHT) and step_record.outputs is not None:
            return step_record.name, str(step_record.outputs.goal)
        if fault == UNREADABLE and step_record.outputs is not None:
            try:
                decode_gossip(step_record.outputs.outbox[item].body)
            except RefusedError as error:
                return step_record.name, f": {error}"
        return step_record.name, ""


def _within(fault: Fault, now_ns: int) -> bool:
    return fault.from_ns <= now_ns and (fault.until_ns is None or now_ns < fault.until_ns)


def check(records: Iterable[Record], *, virtual: bool = True) -> Checker:
    """Check a whole record. virtual: see Checker."""
    checker = Checker(virtual=virtual)
    for record in records:
        checker.observe(record)
    return checker
