"""The checker of what must happen in the end, read from the record alone.

Rules
-----
L1  when nothing has changed for long enough (no fault, no robot moves, nothing held up arrives, and no robot with
    noisy ranges adds to its log, as it may where it stands), all participants that hear one another, over others
    if need be, hold the same entries of all logs, and have the same view
    Of an origin that is not among them any more, in a signed mission without a supervisor, they need only hold the
    same of what it has attested to one of them: nobody passes on the rest
L2  a mission comes to its end before the limit of time
L3  a robot that has not heard its supervisor for more than 9 of its own steps talks to all robots, and as
    soon as it hears it, to the supervisor alone
I8  with a ledger every living participant holds all that its own incarnation has consumed, and those in
    touch with it hold that too (where L1 is judged)

A rule is judged only where a record can show it; `judged` names those that were. Of robots that lie by a fault none is
judged, and what the others hold of them does not count: a liar may show everybody something else.
"""

import math
from collections.abc import Callable, Iterator
from heapq import heappop, heappush
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.machine import (
    EVERYBODY,
    SUPERVISOR,
    Outputs,
    ParticipantId,
    Pose,
    State,
)
from kantor_protocol.base.varint import Pairs
from kantor_protocol.replication.attested import attested_every
from kantor_protocol.replication.gossip import CONTACT_PERIODS, ack_timeout_steps
from kantor_protocol.scenario.faults.liars import FALSE_LOGS, Byzantine, liars_of
from kantor_protocol.scenario.faults.processes import Kill, OnProcesses
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import RefusedError, attestations_of, decode_gossip
from kantor_worldsim.observers.checkers.links import Links
from kantor_worldsim.observers.checkers.sight import Sight
from kantor_worldsim.observers.checkers.state import FORGED_FIRST, has_ledger
from kantor_worldsim.observers.metrics.gossip_reader import read_lengths
from kantor_worldsim.record.columnar import DecodedRecord
from kantor_worldsim.record.process_events import TAKE_OVER, ProcessEventKind
from kantor_worldsim.record.records import Batch, Ending, Opening, ProcessEvent, StepRecord

_UNLUCKY = 1e-9
"""The probability that may remain of losing a message and all its repetitions."""
_WITHIN_STEPS = CONTACT_PERIODS + 1


def settling_ns(scenario: Scenario, hops: int) -> int:
    """The time that entries may take over so many links, when nothing else changes.

    Where who passes them on waits until they are attested, each link may wait for another attestation.
    """
    radio = scenario.radio
    tries = (
        1 if radio.drop <= 0.0 else math.ceil(math.log(_UNLUCKY) / math.log(min(radio.drop, 0.99)))
    )
    timeout_steps = max(ack_timeout_steps(name, scenario) for name in scenario.roster)
    slowest_ns = round(scenario.period_ns * (1.0 + scenario.clock.spread)) + round(
        scenario.clock.jitter_s * 1e9
    )
    passed_on = scenario.signed and (scenario.merge == "ledger" or scenario.mapping)
    attested_steps = attested_every(scenario) if passed_on else 0
    steps = tries * (timeout_steps + 2 + attested_steps)
    return (hops + 1) * (steps * slowest_ns + _way_ns(scenario))


def _way_ns(scenario: Scenario) -> int:
    """The longest time that a message is under way, without faults."""
    radio = scenario.radio
    return round((radio.delay_s + radio.jitter_s + radio.reorder_s) * 1e9)


class _Holding(NamedTuple):
    """The entries and the view of a participant, by its own messages."""

    version_vector: list[int]
    """The log lengths by incarnation id."""
    view: npt.NDArray[np.int64]
    """(N,) the units left on each sample."""


class _Participant:
    """The state of one participant's newest incarnation."""

    def __init__(self, place: int, timeout_steps: int) -> None:
        self.incarnation_id = place
        self.alive = True
        self.lowered: list[bytes] = []
        self.last: Outputs | None = None
        self.logged = 0
        """The length of its own log, followed where ranges are noisy."""
        self.unheard_steps = -timeout_steps
        """Own steps since it heard the supervisor."""


class LivenessChecker:
    """Follows the records of one run; most violations come with the ending."""

    def __init__(self) -> None:
        self.violations: list[str] = []
        self.judged: set[str] = set()
        """The rules that this record could have broken."""
        self._opening: Opening | None = None

    def observe(self, decoded: DecodedRecord, /) -> None:
        """Follow one record."""
        record = decoded.record
        if isinstance(record, Opening):
            self._open(record)
        elif self._opening is None:
            return
        elif isinstance(record, Batch):
            for step_record in record.step_records:
                self._follow(step_record, record.now_ns)
            if self._scenario.faults:
                self._note_late(record)
        elif isinstance(record, ProcessEvent):
            self._follow_event(record)
        elif isinstance(record, Ending):
            self._end(record)

    def _open(self, opening: Opening) -> None:
        scenario = opening.scenario
        self._opening, self._scenario = opening, scenario
        self._names = scenario.roster
        self._liars = liars_of(scenario.faults)
        self._forgers = liars_of(scenario.faults, *FALSE_LOGS)
        self._states = {
            name: _Participant(place, ack_timeout_steps(name, scenario))
            for place, name in enumerate(self._names)
        }
        self._poses = {
            name: Pose(x, y)
            for name, (x, y) in zip(
                scenario.robot_ids, opening.setup.starts_m.tolist(), strict=True
            )
        }
        self._changed_ns = 0
        self._late_ns: list[int] = []
        """When messages are still to arrive that a fault has held up, as a heap: they may change what participants hold."""
        self._way_ns = _way_ns(scenario)
        self._spent: dict[int, list[bytes]] = {}
        """The packed spending of each incarnation id."""
        self._attestations: dict[tuple[ParticipantId, int], list[tuple[int, int]]] = {}
        """Origins and the attested lengths of their logs, by source and sequence of the envelope; of signed missions."""
        self._attested: dict[ParticipantId, dict[int, int]] = {name: {} for name in self._names}
        """The longest such length of a log, or of its beginning, that each participant has heard of and holds."""
        self._reported: set[tuple[str, ParticipantId]] = set()
        """Rules and participants of violations that last from step to step."""

    def _report(self, rule: str, now_ns: int, who: str, what: str) -> None:
        self.violations.append(f"{rule}: t={now_ns * 1e-9:.3f} s: {who}: {what}")

    def _follow(self, step_record: StepRecord, now_ns: int) -> None:
        state = self._states.get(step_record.name)
        if state is None or step_record.outputs is None or step_record.verdict is None:
            return
        outputs, pose = step_record.outputs, step_record.verdict.pose
        state.last = outputs
        if self._scenario.signed:
            self._note_attested(step_record, outputs)
        if outputs.lowered:
            state.lowered.append(outputs.lowered)
            self._changed_ns = now_ns if outputs.spent else self._changed_ns
        if outputs.spent:
            self._spent.setdefault(state.incarnation_id, []).append(outputs.spent)
        before = self._poses.get(step_record.name)
        if before is None or pose.x_m != before.x_m or pose.y_m != before.y_m:
            self._poses[step_record.name], self._changed_ns = pose, now_ns
        if self._scenario.mapping and self._scenario.sensor.noise_m > 0.0:
            self._note_logging(state, outputs, now_ns)
        if step_record.name != SUPERVISOR and self._scenario.centralized:
            self._check_contact(state, step_record, outputs)

    def _note_attested(self, step_record: StepRecord, outputs: Outputs) -> None:
        """What is attested to one who does not hold all of it is of no use: it has nothing to pass on with it.

        What a liar brings may be forged, and does not count.
        """
        known = self._attested[step_record.name]
        heard = [each for key in step_record.heard for each in self._attestations.get(key, ())]
        lengths = self._lengths_of(outputs) if heard else []
        for origin, length in heard:
            if origin < len(lengths) and length <= lengths[origin]:
                known[origin] = max(known.get(origin, 0), length)
        for envelope in outputs.outbox if step_record.name not in self._liars else ():
            attested = [(each.origin, each.length) for each in attestations_of(envelope)]
            if attested:
                self._attestations[envelope.source, envelope.sequence] = attested

    def _lengths_of(self, outputs: Outputs) -> list[int]:
        """The log lengths that a participant holds by its last message; none if that does not say."""
        claims = self._scenario.claiming
        return _version_vector_of(outputs, len(self._names), claims=claims) or []

    def _note_logging(self, state: _Participant, outputs: Outputs, now_ns: int) -> None:
        version_vector = _version_vector_of(outputs, len(self._names), claims=False)
        if version_vector is None or state.incarnation_id >= len(version_vector):
            return
        if version_vector[state.incarnation_id] != state.logged:
            state.logged, self._changed_ns = version_vector[state.incarnation_id], now_ns

    def _note_late(self, batch: Batch) -> None:
        on_time_ns = batch.now_ns + self._way_ns
        for decision in batch.decisions:
            if decision.due_ns > on_time_ns:
                heappush(self._late_ns, decision.due_ns)
        self._note_arrived(batch.now_ns)

    def _note_arrived(self, now_ns: int) -> None:
        while self._late_ns and self._late_ns[0] <= now_ns:
            self._changed_ns = max(self._changed_ns, heappop(self._late_ns))

    def _check_contact(
        self, state: _Participant, step_record: StepRecord, outputs: Outputs
    ) -> None:
        """L3, for each step of a robot."""
        if step_record.name in self._liars:
            return
        self.judged.add("L3")
        state.unheard_steps += 1
        if any(
            source == SUPERVISOR and number < FORGED_FIRST for source, number in step_record.heard
        ):
            state.unheard_steps = 0
        targets = {envelope.target for envelope in outputs.outbox}
        if state.unheard_steps == 0 and EVERYBODY in targets:
            self._report_once("L3", step_record, "hears the supervisor and talks to all robots")
        elif state.unheard_steps > _WITHIN_STEPS and targets - {EVERYBODY}:
            self._report_once(
                "L3", step_record, f"waits for the supervisor since {state.unheard_steps} steps"
            )

    def _report_once(self, rule: str, step_record: StepRecord, what: str) -> None:
        """Report a violation that lasts from step to step once for each participant."""
        if (rule, step_record.name) not in self._reported:
            self._reported.add((rule, step_record.name))
            self._report(rule, step_record.now_ns, step_record.name, what)

    def _follow_event(self, event: ProcessEvent) -> None:
        self._changed_ns = max(self._changed_ns, event.now_ns)
        state = self._states.get(event.who)
        if state is None:
            return
        if event.kind in {ProcessEventKind.KILL, ProcessEventKind.LEAVE}:
            state.alive = False
        elif event.kind in TAKE_OVER:
            state.alive = True
            roster = len(self._names)
            incarnation_id = event.incarnation * roster + state.incarnation_id % roster
            if incarnation_id != state.incarnation_id:
                state.incarnation_id, state.last, state.lowered = incarnation_id, None, []
                state.unheard_steps = -ack_timeout_steps(event.who, self._scenario)

    def _end(self, ending: Ending) -> None:
        if ending.reason != "interrupted":
            self.judged.add("L2")
            if ending.reason == "limit" and self._is_open:
                self._report("L2", ending.now_ns, "record", "the mission came to no end")
        self._note_arrived(ending.now_ns)
        if not self._has_calmed_down(ending.now_ns):
            return
        held = {
            name: self._holding(name)
            for name in self._names
            if self._states[name].alive and name not in self._liars
        }
        for component, diameter in self._components(ending.now_ns, list(held)):
            calm_ns = ending.now_ns - max(self._changed_ns, self._quiet_ns())
            if calm_ns < settling_ns(self._scenario, diameter):
                continue
            self.judged.add("L1")
            self._check_same(component, held, ending.now_ns)
            if has_ledger(self._scenario):
                self.judged.add("I8")
                self._check_whole(component, held, ending.now_ns)

    @property
    def _is_open(self) -> bool:
        """Whether an honest robot that is alive does not rest; without liars: whether the mission was not over."""
        if not self._liars:
            return True
        honest = (
            self._states[name] for name in self._scenario.robot_ids if name not in self._liars
        )
        return any(
            state.alive and (state.last is None or state.last.state is State.EXPLORING)
            for state in honest
        )

    def _quiet_ns(self) -> int:
        """When the last fault ends; a process that is killed for good has no part in what follows."""
        ends_ns = [0]
        for fault in self._scenario.faults:
            if isinstance(fault, Kill) and fault.until_ns is None:
                ends_ns.append(fault.from_ns)
            elif fault.until_ns is None:
                lasts = not isinstance(fault, Byzantine)
                if isinstance(fault, OnProcesses):
                    lasts = fault.stops
                ends_ns.append(1 << 62 if lasts else fault.from_ns)
            else:
                ends_ns.append(fault.until_ns)
        return max(ends_ns)

    def _has_calmed_down(self, now_ns: int) -> bool:
        return now_ns - max(self._changed_ns, self._quiet_ns()) >= settling_ns(self._scenario, 1)

    def _holding(self, name: ParticipantId) -> _Holding | None:
        """The entries that a participant holds by its last message, and its view; None if it has sent none."""
        assert self._opening is not None
        state, samples = self._states[name], self._opening.samples_m.shape[0]
        version_vector = _version_vector_of(
            state.last, len(self._names), claims=self._scenario.claiming
        )
        if version_vector is None:
            return None
        view = np.full(samples, self._opening.units.sample, dtype=np.int64)
        pairs = Pairs()
        for packed in state.lowered:
            lowered = pairs.decode(packed, samples)
            if lowered is not None:
                view[lowered[0]] = lowered[1]
        return _Holding(version_vector, view)

    def _components(
        self, now_ns: int, names: list[ParticipantId]
    ) -> Iterator[tuple[list[ParticipantId], int]]:
        """Participants that hear one another, and over how many links at most."""
        reaches = self._reach(now_ns)
        apart = {
            one: {
                other: 0 if one == other else 1
                for other in names
                if one == other or reaches(one, other)
            }
            for one in names
        }
        for via, one in product(names, names):  # Floyd and Warshall, on what is sparse
            if via in apart[one]:
                for other, further in apart[via].items():
                    links = apart[one][via] + further
                    if links < apart[one].get(other, 1 << 30):
                        apart[one][other] = links
        left = list(names)
        while left:
            component = [other for other in left if other in apart[left[0]]]
            yield component, max(apart[one][other] for one in component for other in component)
            left = [name for name in left if name not in component]

    def _reach(self, now_ns: int) -> Callable[[ParticipantId, ParticipantId], bool]:
        """Whether two participants hear each other, by true poses, walls and faults that have no end.

        Robots talk to a supervisor alone while there is one.
        """
        assert self._opening is not None
        scenario = self._scenario
        links = Links(scenario, self._opening.seed)
        links.move_to(now_ns)
        sight = Sight(scenario.radio, *(self._opening.setup.ground or ()))
        places = {name: place for place, name in enumerate(self._names)}
        poses_m = {SUPERVISOR: scenario.supervisor_m} | {
            name: (pose.x_m, pose.y_m) for name, pose in self._poses.items()
        }
        without_walls = {SUPERVISOR} if scenario.supervisor.pose_m is None else set()
        guided = scenario.centralized and self._states[SUPERVISOR].alive

        def reaches(one: ParticipantId, other: ParticipantId) -> bool:
            if guided and SUPERVISOR not in {one, other}:
                return False
            walls = 0 if {one, other} & without_walls else sight.walls(poses_m[one], poses_m[other])
            return all(
                not links.is_cut(*ends)
                and sight.reaches(poses_m[one], poses_m[other], links.range_m(*ends), walls)
                for ends in ((places[one], places[other]), (places[other], places[one]))
            )

        return reaches

    def _check_same(
        self,
        component: list[ParticipantId],
        held: dict[ParticipantId, _Holding | None],
        now_ns: int,
    ) -> None:
        """L1: all of a component hold the same entries and have the same view."""
        first, *others = component
        mine = held[first]
        for name in others:
            theirs = held[name]
            if mine is None or theirs is None:
                self._report("L1", now_ns, name if theirs is None else first, "has sent nothing")
                return
            if self._scenario.merge == "ledger" or self._scenario.mapping:
                ids = max(len(mine.version_vector), len(theirs.version_vector))
                one, other = (
                    self._comparable(each.version_vector, ids, component) for each in (mine, theirs)
                )
                if one != other:
                    what = f"holds {other} entries, {first} holds {one}"
                    self._report("L1", now_ns, name, what)
            doubtful = self._liars or self._scenario.signed
            if self._forgers or (doubtful and mine.version_vector != theirs.version_vector):
                continue
            differing = int(np.count_nonzero(mine.view != theirs.view))
            if differing:
                what = f"its view differs from {first}'s in {differing} samples"
                self._report("L1", now_ns, name, what)

    def _comparable(
        self, version_vector: list[int], ids: int, component: list[ParticipantId]
    ) -> list[int]:
        """The log lengths in a version vector, padded to so many ids, that are the same for all of a component.

        Without those of liars, and of the absent only as far as they have attested.
        """
        lengths = version_vector + [0] * (ids - len(version_vector))
        names = self._names
        if self._scenario.signed and SUPERVISOR not in component:
            present = {self._states[name].incarnation_id for name in component}
            lengths = [
                length
                if origin in present
                else min(length, max(self._attested[name].get(origin, 0) for name in component))
                for origin, length in enumerate(lengths)
            ]
        return [n for i, n in enumerate(lengths) if names[i % len(names)] not in self._liars]

    def _check_whole(
        self,
        component: list[ParticipantId],
        held: dict[ParticipantId, _Holding | None],
        now_ns: int,
    ) -> None:
        """I8: what a component holds together has all that its living incarnations have consumed."""
        assert self._opening is not None
        pairs, samples = Pairs(), self._opening.samples_m.shape[0]
        for name in component:
            own, entries = self._states[name].incarnation_id, 0
            for packed in self._spent.get(own, []):
                spent = pairs.decode(packed, samples)
                entries += 0 if spent is None else spent[0].shape[0]
            lengths = [
                holding.version_vector[own]
                for other in component
                if (holding := held[other]) is not None and own < len(holding.version_vector)
            ]
            if max(lengths, default=0) != entries:
                what = f"has consumed {entries} entries, and {max(lengths, default=0)} are known"
                self._report("I8", now_ns, name, what)


def _version_vector_of(outputs: Outputs | None, roster: int, *, claims: bool) -> list[int] | None:
    """The log lengths in the last message of a step."""
    if outputs is None or not outputs.outbox:
        return None
    try:
        version_vector = decode_gossip(outputs.outbox[-1].body).version_vector
    except RefusedError:
        return None
    return read_lengths(version_vector, roster, claims=claims)
