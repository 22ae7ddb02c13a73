"""Referees that read only the record. Each rule is one method; each can fail, and a test shows how.

A complaint is one line: rule, time, who, what. A run is clean when there is none.
"""

import math
from collections.abc import Iterable

import numpy as np

from kantor_protocol.kernels import kernel
from kantor_protocol.machine import EVERYBODY, SUPERVISOR, Envelope, Outputs, ParticipantId, Pose
from kantor_protocol.messages import RefusedError, decode_news
from kantor_protocol.modes import rectangle_of, visit_at
from kantor_protocol.packing import Pairs
from kantor_protocol.registers import read_register
from kantor_protocol.replica import read_have, read_logs
from kantor_protocol.weights import WeightsSubscriber
from kantor_worldsim.channel import DROPPED, Verdict
from kantor_worldsim.exact import ROUNDING
from kantor_worldsim.metrics import Row
from kantor_worldsim.records import Act, Batch, Ending, Opening, Record
from kantor_worldsim.world import SPEED_TOLERANCE

_COMPLAINTS_MAX = 100
"""A broken record is broken; further complaints only count."""


@kernel
def _fall(
    view: np.ndarray, consumed: np.ndarray, whole: int, sample: np.ndarray, left: np.ndarray
) -> bool:
    """Put entries into a view; whether each one fell, and none below what the truth leaves."""
    sound = True
    for i in range(sample.shape[0]):
        j = sample[i]
        sound = sound and left[i] < view[j] and left[i] >= whole - consumed[j]
        view[j] = left[i]
    return sound


class Checker:
    """Follows the records of one run and collects complaints.

    Rules
    -----
    range       no envelope is delivered to anybody beyond the range at the time of sending
    delivery    what is in an inbox was delivered to it, is due, and came as often as ruled
    weights     no entry of a weight vector ever rises or is negative, and what is published on the
                weights key rebuilds exactly this vector
    energy      nobody ships more points than its budget, or more units than a point holds
    ledger      consumed = sum of the ledgers: what a participant sends of its log is what it consumed,
                entry for entry, and at the end its vector is exactly what the logs it holds leave
    credit      no view is lower than the weights that all spending leaves (both merges)
    speed       no accepted move is longer than speed times time
    bound       where the bounds claim to hold, the exact distance is not above them (rows that have it)
    goal        a goal has weight in the robot's own view (transport with standing samples)
    register    the own register that a robot sends is the sum over the places from which it chose
                (spectral; not once an output is missing from the record)
    order       steps count up by one, time never runs back, an opening first, nothing after the end
    ruling      the world found no fault of its own
    """

    def __init__(self) -> None:
        self.complaints: list[str] = []
        self.count = 0
        """All complaints, also those beyond the ones that are kept."""
        self._opening: Opening | None = None
        self._ended = False
        self._now_ns = 0
        self._pairs = Pairs()

    def take(self, record: Record) -> None:
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
        elif isinstance(record, Ending):
            self._ended = True
            self._end()

    def take_row(self, row: Row) -> None:
        """Hold a row's bounds against its exact distance, if they claim to be bounds."""
        if row.w1_exact is None or row.w_ub_tight is None:
            return
        least = row.w1_exact * (1.0 - ROUNDING)
        for form, bound in (("tight", row.w_ub_tight), ("paper", row.w_ub_paper)):
            if not bound >= least:
                self._complain(
                    "bound", f"tick {row.tick}", f"{form} {bound:.6g} m below {row.w1_exact:.6g} m"
                )

    def _complain(self, rule: str, who: str, what: str) -> None:
        self.count += 1
        if len(self.complaints) < _COMPLAINTS_MAX:
            self.complaints.append(f"{rule}: t={self._now_ns * 1e-9:.3f} s: {who}: {what}")

    def _open(self, opening: Opening) -> None:
        scenario, site = opening.scenario, opening.site
        self._opening, self._scenario, self._units = opening, scenario, opening.units
        self._samples = site.samples_m.shape[0]
        names = scenario.roster
        self._places = {name: i for i, name in enumerate(names)}
        starts = [Pose(float(x), float(y)) for x, y in site.starts_m]
        if scenario.centralized:
            starts.append(Pose(*scenario.supervisor_m))
        self._poses = dict(zip(names, starts, strict=True))
        self._moved_ns = dict.fromkeys(names, 0)
        self._steps = dict.fromkeys(names, 0)
        self._points = dict.fromkeys(names, 0)
        self._views = np.full((len(names), self._samples), self._units.sample, dtype=np.int64)
        self._own_spent: dict[ParticipantId, list[list[int]]] = {name: [] for name in names}
        self._subscribers = {name: WeightsSubscriber() for name in names}
        self._have: dict[ParticipantId, list[int]] = {}
        self._consumed = np.zeros(self._samples, dtype=np.int64)
        self._absences = dict.fromkeys(names, 0)
        self._registers = np.zeros((len(names), scenario.register_width), dtype=np.int64)
        self._rectangle = rectangle_of(scenario.domain)
        self._said = dict(self._poses)
        self._missed: set[ParticipantId] = set()
        self._in_flight: dict[tuple[ParticipantId, int, ParticipantId], list[int]] = {}
        self._sent: dict[tuple[ParticipantId, int], ParticipantId] = {}

    def _check(self, batch: Batch) -> None:
        if batch.now_ns < self._now_ns:
            self._complain("order", "record", f"time runs back to {batch.now_ns * 1e-9:.3f} s")
        self._now_ns = batch.now_ns
        acts = [act for act in batch.acts if act.name in self._places]
        for stranger in (act.name for act in batch.acts if act.name not in self._places):
            self._complain("order", stranger, "not in the roster")
        for act in acts:
            self._check_inbox(act)
            for envelope in act.outputs.outbox if act.outputs else ():
                self._sent[envelope.source, envelope.sequence] = envelope.target
        for verdict in batch.verdicts:
            self._check_verdict(verdict)
        for act in acts:
            if act.outputs is None or act.ruling is None:
                self._absences[act.name] += 1
                self._missed.add(act.name)
            else:
                self._check_act(act)

    def _check_inbox(self, act: Act) -> None:
        for source, sequence in act.heard:
            key = (source, sequence, act.name)
            due = self._in_flight.get(key, [])
            arrived = [moment for moment in due if moment <= self._now_ns]
            if not arrived:
                self._complain(
                    "delivery", act.name, f"heard {source}#{sequence}, which was not delivered"
                )
                continue
            due.remove(min(arrived))
            if not due:
                del self._in_flight[key]

    def _check_act(self, act: Act) -> None:
        outputs, ruling = act.outputs, act.ruling
        assert outputs is not None
        assert ruling is not None
        for violation in ruling.violations:
            self._complain("ruling", act.name, f"the world refused its {violation}")
        expected = self._steps[act.name] + 1
        if not expected <= outputs.step <= expected + self._absences[act.name]:
            self._complain("order", act.name, f"step {outputs.step}, expected {expected}")
        self._check_speed(act.name, act.now_ns, ruling.pose)
        spent = self._check_energy(act.name, outputs.spent, outputs.energy_spent)
        self._check_weights(act.name, outputs.lowered)
        self._check_published(act.name, outputs.weights)
        self._check_goal(act.name, outputs.goal, spent)
        self._check_register(act, outputs, chose=bool(spent))
        self._steps[act.name], self._absences[act.name] = outputs.step, 0
        self._moved_ns[act.name] = act.now_ns
        self._poses[act.name] = ruling.pose
        for envelope in outputs.outbox:
            self._check_ledger(act.name, envelope)

    def _check_speed(self, name: ParticipantId, now_ns: int, pose: Pose) -> None:
        before, elapsed_ns = self._poses[name], now_ns - self._moved_ns[name]
        limit_m_s = 0.0 if name == SUPERVISOR else self._scenario.vehicle.speed_m_s
        limit_m = limit_m_s * elapsed_ns * 1e-9 * (1.0 + 2.0 * SPEED_TOLERANCE)
        way_m = math.hypot(pose.x_m - before.x_m, pose.y_m - before.y_m)
        if not way_m <= limit_m:
            self._complain("speed", name, f"moved {way_m:.6g} m, allowed {limit_m:.6g} m")

    def _check_weights(self, name: ParticipantId, lowered: bytes) -> None:
        pairs = self._pairs.decode(lowered, self._samples)
        if pairs is None:
            self._complain("weights", name, "entries that do not decode")
            return
        view = self._views[self._places[name]]
        before = view[pairs[0]]
        if _fall(view, self._consumed, self._units.sample, *pairs):
            return
        view[pairs[0]] = before  # something is wrong: once more, slowly, to say what
        for sample, left in zip(pairs[0].tolist(), pairs[1].tolist(), strict=True):
            if left >= view[sample]:
                self._complain(
                    "weights", name, f"sample {sample} from {view[sample]} to {left} units"
                )
            view[sample] = left
            if left < self._units.sample - self._consumed[sample]:
                self._complain("credit", name, f"its view of sample {sample} is below the truth")

    def _check_published(self, name: ParticipantId, weights: bytes) -> None:
        if not weights:
            return
        subscriber, view = self._subscribers[name], self._views[self._places[name]]
        if not subscriber.take(weights):
            self._complain("weights", name, "publishes a vector that cannot be rebuilt")
        elif subscriber.weights is None or not np.array_equal(subscriber.weights, view):
            self._complain("weights", name, "publishes a vector that is not its own")

    def _check_goal(
        self, name: ParticipantId, goal: tuple[float, float] | None, spent: dict[int, int]
    ) -> None:
        """The weight at the time of choosing: what is left now, and what it has shipped since."""
        scenario = self._scenario
        standing = scenario.samples.diffusion_m == 0.0
        if goal is None or not standing or scenario.planner.name != "transport":
            return
        if self._samples_by_place is None:
            self._samples_by_place = self._index_samples()
        samples = self._samples_by_place.get(goal)
        if samples is None:
            self._complain("goal", name, f"{goal} is no sample")
        elif not any(self._views[self._places[name], j] + spent.get(j, 0) > 0 for j in samples):
            self._complain("goal", name, f"{goal} has no weight left in its view")

    _samples_by_place: dict[tuple[float, float], list[int]] | None = None

    def _index_samples(self) -> dict[tuple[float, float], list[int]]:
        assert self._opening is not None
        places: dict[tuple[float, float], list[int]] = {}
        for j, (x, y) in enumerate(self._opening.site.samples_m.tolist()):
            places.setdefault((x, y), []).append(j)
        return places

    def _check_energy(self, name: ParticipantId, spent: bytes, energy_spent: int) -> dict[int, int]:
        """Check what a step shipped; it comes back as units by sample."""
        pairs = self._pairs.decode(spent, self._samples)
        if pairs is None:
            self._complain("energy", name, "spending that does not decode")
            return {}
        shipped = dict(zip(pairs[0].tolist(), pairs[1].tolist(), strict=True))
        if pairs[0].size:
            self._points[name] += 1
            units = int(pairs[1].sum())
            if units > self._units.point:
                self._complain("energy", name, f"{units} units in one point")
            np.add.at(self._consumed, pairs[0], pairs[1])
            if self._scenario.merge == "ledger":
                self._own_spent[name] += map(
                    list, zip(pairs[0].tolist(), pairs[1].tolist(), strict=True)
                )
        if self._points[name] > self._scenario.steps_per_robot:
            self._complain("energy", name, f"{self._points[name]} points shipped")
        if energy_spent < self._points[name] and name != SUPERVISOR:
            self._complain("energy", name, f"counts {energy_spent} of {self._points[name]} points")
        return shipped

    def _check_ledger(self, name: ParticipantId, envelope: Envelope) -> None:
        """Own entries that a participant sends are the ones it consumed, one for one."""
        if self._scenario.merge != "ledger":
            return
        try:
            news = decode_news(envelope.body)
        except RefusedError as error:
            self._complain("ledger", name, f"sends what nobody can read: {error}")
            return
        have, logs = read_have(news.have, len(self._places)), read_logs(news.logs)
        if have is None or logs is None:
            self._complain("ledger", name, "sends what nobody can read")
            return
        self._have[name] = have
        own = logs[logs[:, 0] == self._places[name]]
        if own.size:
            start = int(own[0, 1])
            consumed = self._own_spent[name][start : start + own.shape[0]]
            if own[:, 2:].tolist() != consumed:
                self._complain("ledger", name, f"its log from {start} on is not what it consumed")

    def _check_register(self, act: Act, outputs: Outputs, *, chose: bool) -> None:
        """It chooses where it was observed last, or where it went itself if that word is late."""
        name, place, width = act.name, self._places[act.name], self._scenario.register_width
        if not width or name in self._missed:
            return
        timely = act.observation.step == outputs.step - 1
        pose = act.observation.pose if timely else self._said[name]
        self._said[name] = outputs.pose
        if chose:
            modes = self._scenario.planner.modes
            self._registers[place] += visit_at(pose.x_m, pose.y_m, self._rectangle, modes)
        for envelope in outputs.outbox:
            try:
                content = decode_news(envelope.body).registers
            except RefusedError:
                content = b"\x80"
            sent = read_register(content, len(self._places), width, place)
            if sent is None:
                self._complain("register", name, "sends what nobody can read")
            elif sent[0] and not np.array_equal(sent[1], self._registers[place]):
                self._complain("register", name, "its sums are not those over its places")
            elif sent[0] and sent[0] != self._points[name]:
                self._complain("register", name, f"writes {sent[0]} of {self._points[name]}")

    def _check_verdict(self, verdict: Verdict) -> None:
        target = self._sent.get((verdict.source, verdict.sequence))
        if target is None or verdict.target not in self._places:
            self._complain(
                "delivery", verdict.target, f"{verdict.source}#{verdict.sequence} was never sent"
            )
            return
        if target not in (EVERYBODY, verdict.target):
            self._complain("delivery", verdict.target, "delivered what was for somebody else")
        if verdict.due_ns == DROPPED:
            return
        by_supervisor = SUPERVISOR in (verdict.source, verdict.target)
        scenario = self._scenario
        range_m = scenario.supervisor.range_m if by_supervisor else scenario.radio.range_m
        here, there = self._poses[verdict.source], self._poses[verdict.target]
        dx, dy = there.x_m - here.x_m, there.y_m - here.y_m
        if not dx * dx + dy * dy <= range_m * range_m:
            self._complain(
                "range",
                verdict.target,
                f"{verdict.source}#{verdict.sequence} over {math.hypot(dx, dy):.6g} m",
            )
        key = (verdict.source, verdict.sequence, verdict.target)
        self._in_flight.setdefault(key, []).append(verdict.due_ns)

    def _end(self) -> None:
        if self._scenario.merge == "ledger":
            for name, have in self._have.items():
                self._check_view(name, have)

    def _check_view(self, name: ParticipantId, have: list[int]) -> None:
        spent = np.zeros(self._samples, dtype=np.int64)
        for origin, length in zip(self._places, have, strict=True):
            log = self._own_spent[origin]
            if length > len(log):
                self._complain("ledger", name, f"holds {length} entries of {origin}'s {len(log)}")
                return
            entries = np.array(log[:length], dtype=np.int64).reshape(-1, 2)
            np.add.at(spent, entries[:, 0], entries[:, 1])
        wrong = np.flatnonzero(
            self._views[self._places[name]] != np.maximum(self._units.sample - spent, 0)
        )
        if wrong.size:
            self._complain(
                "ledger", name, f"its view of sample {wrong[0]} is not what its logs leave"
            )


def check(records: Iterable[Record]) -> Checker:
    """Check a whole record."""
    checker = Checker()
    for record in records:
        checker.take(record)
    return checker
