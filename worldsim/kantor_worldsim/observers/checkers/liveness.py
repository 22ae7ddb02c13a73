"""The referee of what must happen some day, read from the record alone.

Rules
-----
L1  when nothing has changed for long enough (no fault, nobody moves, nothing held up arrives), all who can hear one another, over
    others if need be, hold the same entries of all logs, and have the same view
L2  a mission comes to its end before the limit of time
L3  a robot that has not heard its supervisor for more than 9 of its own steps talks to everybody, and as
    soon as it hears it, to the supervisor alone
I8  with a ledger everybody who lives holds all that its own incarnation has consumed, and whoever is in
    touch with it holds that too (where L1 is judged)

A rule is judged only where a record can show it; `judged` says which were.
"""

import math
from collections.abc import Callable, Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Outputs, ParticipantId, Pose
from kantor_protocol.base.varint import Pairs
from kantor_protocol.replication.gossip import CONTACT_PERIODS, ack_timeout_steps
from kantor_protocol.scenario.faults.processes import Kill, OnProcesses
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import RefusedError, decode_gossip
from kantor_protocol.wire.version_vector import covered_ids, read_version_vector
from kantor_worldsim.observers.checkers.state import FORGED_FIRST
from kantor_worldsim.radio.channel import Field, Walls, hears
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.record.records import Batch, Ending, Opening, ProcessEvent, Record, StepRecord

_UNLUCKY = 1e-9
"""So unlikely may it be that a message is lost as often as it is said."""
_WITHIN_STEPS = CONTACT_PERIODS + 1


def settling_ns(scenario: Scenario, hops: int) -> int:
    """How long news may take over so many links, when nothing else changes."""
    radio = scenario.radio
    tries = (
        1 if radio.drop <= 0.0 else math.ceil(math.log(_UNLUCKY) / math.log(min(radio.drop, 0.99)))
    )
    patience = max(ack_timeout_steps(name, scenario) for name in scenario.roster)
    slowest_ns = round(scenario.period_ns * (1.0 + scenario.clock.spread)) + round(
        scenario.clock.jitter_s * 1e9
    )
    return (hops + 1) * (tries * (patience + 2) * slowest_ns + _way_ns(scenario))


def _way_ns(scenario: Scenario) -> int:
    """How long a message is under way at most, without faults."""
    radio = scenario.radio
    return round((radio.delay_s + radio.jitter_s + radio.reorder_s) * 1e9)


class _Known(NamedTuple):
    """What a participant has said of itself."""

    version_vector: list[int]
    view: npt.NDArray[np.int64]


class _Participant:
    """What is followed of one participant; its incarnation's."""

    def __init__(self, patience: int) -> None:
        self.slot = 0
        self.alive = True
        self.lowered: list[bytes] = []
        self.last: Outputs | None = None
        self.unheard = -patience
        """Own steps since it heard the supervisor."""


class LivenessChecker:
    """Follows the records of one run; complaints come with the ending."""

    def __init__(self) -> None:
        self.complaints: list[str] = []
        self.judged: set[str] = set()
        """The rules that this record could have broken."""
        self._opening: Opening | None = None

    def observe(self, record: Record) -> None:
        """Follow one record."""
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
            self._befall(record)
        else:
            self._end(record)

    def _open(self, opening: Opening) -> None:
        scenario = opening.scenario
        self._opening, self._scenario = opening, scenario
        self._names = scenario.roster
        self._states = {
            name: _Participant(ack_timeout_steps(name, scenario)) for name in self._names
        }
        for place, state in enumerate(self._states.values()):
            state.slot = place
        self._poses = {
            name: Pose(x, y)
            for name, (x, y) in zip(scenario.robot_ids, opening.site.starts_m.tolist(), strict=True)
        }
        self._changed_ns = 0
        self._late_ns: list[int] = []
        """When messages arrive that a fault has held up: they are news from before."""
        self._way_ns = _way_ns(scenario)
        self._spent: dict[int, list[bytes]] = {}
        """What each slot has shipped."""
        self._said: set[str] = set()

    def _complain(self, rule: str, now_ns: int, who: str, what: str) -> None:
        self.complaints.append(f"{rule}: t={now_ns * 1e-9:.3f} s: {who}: {what}")

    def _follow(self, step_record: StepRecord, now_ns: int) -> None:
        state = self._states.get(step_record.name)
        if state is None or step_record.outputs is None or step_record.verdict is None:
            return
        outputs, pose = step_record.outputs, step_record.verdict.pose
        state.last = outputs
        if outputs.lowered:
            state.lowered.append(outputs.lowered)
            self._changed_ns = now_ns if outputs.spent else self._changed_ns
        if outputs.spent:
            self._spent.setdefault(state.slot, []).append(outputs.spent)
        before = self._poses.get(step_record.name)
        if before is None or pose.x_m != before.x_m or pose.y_m != before.y_m:
            self._poses[step_record.name], self._changed_ns = pose, now_ns
        if step_record.name != SUPERVISOR and self._scenario.centralized:
            self._check_contact(state, step_record, outputs)

    def _note_late(self, batch: Batch) -> None:
        on_time_ns = batch.now_ns + self._way_ns
        self._late_ns += [each.due_ns for each in batch.decisions if each.due_ns > on_time_ns]

    def _check_contact(
        self, state: _Participant, step_record: StepRecord, outputs: Outputs
    ) -> None:
        """L3, for each step of a robot."""
        self.judged.add("L3")
        state.unheard += 1
        if any(
            source == SUPERVISOR and number < FORGED_FIRST for source, number in step_record.heard
        ):
            state.unheard = 0
        targets = {envelope.target for envelope in outputs.outbox}
        if state.unheard == 0 and EVERYBODY in targets:
            self._say_once("L3", step_record, "hears the supervisor and talks to everybody")
        elif state.unheard > _WITHIN_STEPS and targets - {EVERYBODY}:
            self._say_once(
                "L3", step_record, f"waits for the supervisor since {state.unheard} steps"
            )

    def _say_once(self, rule: str, step_record: StepRecord, what: str) -> None:
        """Of everybody once: what lasts would fill pages."""
        if f"{rule} {step_record.name}" not in self._said:
            self._said.add(f"{rule} {step_record.name}")
            self._complain(rule, step_record.now_ns, step_record.name, what)

    def _befall(self, incident: ProcessEvent) -> None:
        self._changed_ns = max(self._changed_ns, incident.now_ns)
        state = self._states.get(incident.who)
        if state is None:
            return
        if incident.what in {"kill", "leave"}:
            state.alive = False
        elif incident.what in {"start", "join"}:
            state.alive = True
            slot = incident.incarnation * len(self._names) + state.slot % len(self._names)
            if slot != state.slot:
                state.slot, state.last, state.lowered = slot, None, []
                state.unheard = -ack_timeout_steps(incident.who, self._scenario)

    def _end(self, ending: Ending) -> None:
        if ending.reason != "interrupted":
            self.judged.add("L2")
            if ending.reason == "limit":
                self._complain("L2", ending.now_ns, "record", "the mission came to no end")
        arrived_ns = (due_ns for due_ns in self._late_ns if due_ns <= ending.now_ns)
        self._changed_ns = max(self._changed_ns, *arrived_ns, 0)
        if not self._has_calmed_down(ending.now_ns):
            return
        known = {name: self._known(name) for name in self._names if self._states[name].alive}
        for component, diameter in self._components(ending.now_ns, list(known)):
            calm_ns = ending.now_ns - max(self._changed_ns, self._quiet_ns())
            if calm_ns < settling_ns(self._scenario, diameter):
                continue
            self.judged.add("L1")
            self._check_same(component, known, ending.now_ns)
            if self._has_ledger:
                self.judged.add("I8")
                self._check_whole(component, known, ending.now_ns)

    @property
    def _has_ledger(self) -> bool:
        return self._scenario.merge == "ledger" and not self._scenario.mapping

    def _quiet_ns(self) -> int:
        """When the last fault ends; whoever is killed for good has no part in what follows."""
        ends_ns = [0]
        for fault in self._scenario.faults:
            if isinstance(fault, Kill) and fault.until_ns is None:
                ends_ns.append(fault.from_ns)
            elif fault.until_ns is None:
                lasts = not isinstance(fault, OnProcesses) or fault.stops
                ends_ns.append(1 << 62 if lasts else fault.from_ns)
            else:
                ends_ns.append(fault.until_ns)
        return max(ends_ns)

    def _has_calmed_down(self, now_ns: int) -> bool:
        return now_ns - max(self._changed_ns, self._quiet_ns()) >= settling_ns(self._scenario, 1)

    def _known(self, name: ParticipantId) -> _Known | None:
        """What a participant holds by its last message, and its view; None if it has said nothing."""
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
            told = pairs.decode(packed, samples)
            if told is not None:
                view[told[0]] = told[1]
        return _Known(version_vector, view)

    def _components(
        self, now_ns: int, names: list[ParticipantId]
    ) -> Iterator[tuple[list[ParticipantId], int]]:
        """Who can hear one another, and over how many links at most."""
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
                    way = apart[one][via] + further
                    if way < apart[one].get(other, 1 << 30):
                        apart[one][other] = way
        left = list(names)
        while left:
            component = [other for other in left if other in apart[left[0]]]
            yield component, max(apart[one][other] for one in component for other in component)
            left = [name for name in left if name not in component]

    def _reach(self, now_ns: int) -> Callable[[ParticipantId, ParticipantId], bool]:
        """Whether two hear each other, by true poses, walls and faults that have no end.

        With a supervisor at hand robots talk to it alone.
        """
        assert self._opening is not None
        scenario, opening = self._scenario, self._opening
        faults = LinkFaults(scenario, opening.seed)
        places = {name: place for place, name in enumerate(self._names)}
        poses = {SUPERVISOR: Pose(*scenario.supervisor_m)} | self._poses
        xy_m = np.array([(poses[name].x_m, poses[name].y_m) for name in self._names])
        walls = Walls.of(scenario.radio, opening.site.ground)
        stands = scenario.supervisor.pose_m is not None
        field = Field(*walls, xy_m, places.get(SUPERVISOR, -1), stands)
        guided = scenario.centralized and self._states[SUPERVISOR].alive

        def reaches(one: ParticipantId, other: ParticipantId) -> bool:
            if guided and SUPERVISOR not in {one, other}:
                return False
            return all(
                not faults.cuts(now_ns, *way)
                and hears(field, *(places[end] for end in way), faults.reach_m(now_ns, *way))
                for way in ((one, other), (other, one))
            )

        return reaches

    def _check_same(
        self,
        component: list[ParticipantId],
        known: dict[ParticipantId, _Known | None],
        now_ns: int,
    ) -> None:
        """L1."""
        first, *others = component
        mine = known[first]
        for name in others:
            theirs = known[name]
            if mine is None or theirs is None:
                self._complain("L1", now_ns, name if theirs is None else first, "said nothing")
                return
            if self._scenario.merge == "ledger" or self._scenario.mapping:
                slots = max(len(mine.version_vector), len(theirs.version_vector))
                one, other = (
                    each.version_vector + [0] * (slots - len(each.version_vector))
                    for each in (mine, theirs)
                )
                if one != other:
                    what = f"holds {other} entries, {first} holds {one}"
                    self._complain("L1", now_ns, name, what)
            differing = int(np.count_nonzero(mine.view != theirs.view))
            if differing:
                what = f"its view differs from {first}'s in {differing} samples"
                self._complain("L1", now_ns, name, what)

    def _check_whole(
        self,
        component: list[ParticipantId],
        known: dict[ParticipantId, _Known | None],
        now_ns: int,
    ) -> None:
        """I8: the join of what they hold has all that living incarnations have consumed."""
        assert self._opening is not None
        pairs, samples = Pairs(), self._opening.samples_m.shape[0]
        for name in component:
            slot, entries = self._states[name].slot, 0
            for packed in self._spent.get(slot, []):
                told = pairs.decode(packed, samples)
                entries += 0 if told is None else told[0].shape[0]
            held = [
                state.version_vector[slot]
                for other in component
                if (state := known[other]) is not None and slot < len(state.version_vector)
            ]
            if max(held, default=0) != entries:
                what = f"has consumed {entries} entries, and {max(held, default=0)} are known"
                self._complain("I8", now_ns, name, what)


def _version_vector_of(outputs: Outputs | None, roster: int, *, claims: bool) -> list[int] | None:
    """The log lengths in the last message of a step."""
    if outputs is None or not outputs.outbox:
        return None
    try:
        version_vector = decode_gossip(outputs.outbox[-1].body).version_vector
    except RefusedError:
        return None
    slots = covered_ids(version_vector, roster, claims=claims)
    return None if slots is None else read_version_vector(version_vector, slots)
