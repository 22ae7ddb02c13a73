"""Rare situations, looked for in the record of a mission.

A campaign without violations proves little unless difficult situations have happened in it. This is the list of
those that must have been seen, after the "sometimes" assertions of Antithesis and of FoundationDB's tests.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from typing import ClassVar

from kantor_protocol.base.machine import (
    EVERYBODY,
    SUPERVISOR,
    WORLD_SIM,
    Outputs,
    ParticipantId,
    State,
)
from kantor_protocol.base.varint import Pairs
from kantor_protocol.scenario.faults.liars import liars_of
from kantor_protocol.scenario.faults.links import FORGED_SEQUENCE_MIN, OneWay, Partition
from kantor_protocol.scenario.faults.processes import ClockFault, Kill, Late
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import RefusedError, decode_gossip
from kantor_worldsim.observers.metrics.gossip_reader import read_lengths
from kantor_worldsim.radio.channel import DROPPED
from kantor_worldsim.record.records import Batch, Opening, ProcessEvent, Record, StepRecord

Pair = tuple[float, float]


class _Detector:
    """Looks for situations of one subject, and counts them under their names."""

    names: ClassVar[tuple[str, ...]] = ()

    def __init__(self, opening: Opening) -> None:
        self.scenario: Scenario = opening.scenario
        self.seen: Counter[str] = Counter()

    @classmethod
    def applies(cls, _scenario: Scenario) -> bool:
        """Whether a mission can have these situations."""
        return True

    def step_record(self, step_record: StepRecord, outputs: Outputs) -> None:
        """Follow a step."""

    def batch(self, batch: Batch) -> None:
        """Follow a batch, after its steps."""

    def process_event(self, event: ProcessEvent) -> None:
        """Follow an event of a process."""


class _Deliveries(_Detector):
    """Messages that arrive twice, late, from a former incarnation, or forged."""

    names = (
        "heard twice",
        "heard out of order",
        "stale word after a restart",
        "word of a former incarnation",
        "hostile message refused",
    )

    def __init__(self, opening: Opening) -> None:
        super().__init__(opening)
        self._newest: dict[ParticipantId, dict[ParticipantId, int]] = {
            name: {} for name in self.scenario.roster
        }
        """The highest number heard, for each receiver by source."""
        self._missing: dict[tuple[ParticipantId, ParticipantId], set[int]] = {}
        """Numbers below the newest of a link that were not heard."""
        self._restarted: set[ParticipantId] = set()
        self._born: dict[ParticipantId, int] = {}
        self._refused: dict[ParticipantId, int] = {}

    def step_record(self, step_record: StepRecord, outputs: Outputs) -> None:
        name, born = step_record.name, self._born
        newest = self._newest[name]
        for source, sequence in step_record.heard:
            if sequence >= FORGED_SEQUENCE_MIN:
                continue
            last = newest.get(source, -1)
            if sequence > last:
                newest[source] = sequence
                if sequence > last + 1:
                    skipped = range(last + 1, sequence)
                    self._missing.setdefault((name, source), set()).update(skipped)
            else:
                self._note_old((name, source), sequence, last)
            if born and sequence <= born.get(source, -1):
                self.seen["word of a former incarnation"] += 1
        if outputs.refused != self._refused.get(name, 0):
            self._note_refused(step_record, outputs.refused)

    def _note_refused(self, step_record: StepRecord, refused: int) -> None:
        if refused > self._refused.get(step_record.name, 0) and step_record.heard:
            forged = any(sequence >= FORGED_SEQUENCE_MIN for _, sequence in step_record.heard)
            self.seen["hostile message refused"] += forged
        self._refused[step_record.name] = refused

    def _note_old(
        self, link: tuple[ParticipantId, ParticipantId], sequence: int, newest: int
    ) -> None:
        missing = self._missing.get(link, set())
        self.seen["heard out of order" if sequence in missing else "heard twice"] += 1
        missing.discard(sequence)
        if sequence < newest and link[0] in self._restarted:
            self.seen["stale word after a restart"] += 1

    def process_event(self, event: ProcessEvent) -> None:
        if event.kind == "start" and event.step > 0:
            self._restarted.add(event.who)
            self._refused[event.who] = 0
            if event.incarnation:
                self._born[event.who] = event.step


class _Restarts(_Detector):
    """Kills and restarts at awkward moments."""

    names = (
        "death between note and answer",
        "restart during a partition",
        "two dead at once",
        "supervisor killed with its word under way",
        "world-sim restarted with messages under way",
    )

    def __init__(self, opening: Opening) -> None:
        super().__init__(opening)
        self._dead: set[ParticipantId] = set()
        self._due_ns: dict[bool, int] = {True: -1, False: -1}
        faults = self.scenario.faults
        killed = {name for fault in faults if isinstance(fault, Kill) for name in fault.who}
        self._looks = bool(killed & {SUPERVISOR, WORLD_SIM})
        self._cuts = [fault for fault in faults if isinstance(fault, Partition | OneWay)]

    def batch(self, batch: Batch) -> None:
        if not self._looks:
            return
        for decision in batch.decisions:
            if decision.due_ns != DROPPED:
                by_supervisor = decision.source == SUPERVISOR
                self._due_ns[by_supervisor] = max(self._due_ns[by_supervisor], decision.due_ns)

    def process_event(self, event: ProcessEvent) -> None:
        who, now_ns = event.who, event.now_ns
        if event.kind == "kill":
            fault = self.scenario.faults[event.fault]
            if isinstance(fault, Kill) and fault.mid_step:
                self.seen["death between note and answer"] += 1
            self.seen["two dead at once"] += bool(self._dead - {who})
            if who == SUPERVISOR and self._due_ns[True] > now_ns:
                self.seen["supervisor killed with its word under way"] += 1
            if who == WORLD_SIM and max(self._due_ns.values()) > now_ns:
                self.seen["world-sim restarted with messages under way"] += 1
            self._dead.add(who)
        elif event.kind == "start":
            self._dead.discard(who)
            if any(cut.from_ns <= now_ns < (cut.until_ns or 2**63) for cut in self._cuts):
                self.seen["restart during a partition"] += 1


class _Recoveries(_Detector):
    """Participants that were away, or lost all, and get it from the others."""

    names = ("late joiner knows all that was known", "log of a former incarnation came back")

    @classmethod
    def applies(cls, scenario: Scenario) -> bool:
        return any(isinstance(fault, Kill | Late) for fault in scenario.faults)

    def __init__(self, opening: Opening) -> None:
        super().__init__(opening)
        self._last_bodies: dict[ParticipantId, bytes] = {}
        self._wanted: dict[ParticipantId, list[int]] = {}
        self._lost: dict[ParticipantId, int] = {}
        self._names = self.scenario.roster

    def step_record(self, step_record: StepRecord, outputs: Outputs) -> None:
        if not outputs.outbox:
            return
        name, body = step_record.name, outputs.outbox[-1].body
        self._last_bodies[name] = body
        if name in self._wanted and _covers(self._version_vector(body), self._wanted[name]):
            self.seen["late joiner knows all that was known"] += 1
            del self._wanted[name]
        if name in self._lost and any(self._version_vector(body)[self._lost[name] :][:1]):
            self.seen["log of a former incarnation came back"] += 1
            del self._lost[name]

    def process_event(self, event: ProcessEvent) -> None:
        if event.kind != "start":
            return
        who = event.who
        if event.fault >= 0 and isinstance(self.scenario.faults[event.fault], Late):
            known = [
                self._version_vector(body)
                for name, body in self._last_bodies.items()
                if name != who
            ]
            width = max(map(len, known), default=0)
            most = [
                max(version_vector[i] for version_vector in known if i < len(version_vector))
                for i in range(width)
            ]
            if any(most):
                self._wanted[who] = most
        elif event.incarnation and who in self._last_bodies:
            count = len(self._names)
            self._lost[who] = (event.incarnation - 1) * count + self._names.index(who)

    def _version_vector(self, body: bytes) -> list[int]:
        """The log lengths that the sender of a message holds."""
        try:
            version_vector = decode_gossip(body).version_vector
        except RefusedError:
            return []
        claims = self.scenario.claiming
        return read_lengths(version_vector, len(self._names), claims=claims) or []


class _Goals(_Detector):
    """Goals that a message of another robot takes away."""

    names = ("merge that removes the current goal", "one goal of two, left to one by a claim")

    @classmethod
    def applies(cls, scenario: Scenario) -> bool:
        return scenario.planner.name == "transport" and scenario.samples.diffusion_m == 0.0

    def __init__(self, opening: Opening) -> None:
        super().__init__(opening)
        places = opening.setup.samples_m.tolist()
        self._samples = {(x, y): i for i, (x, y) in enumerate(places)}
        self._goals: dict[ParticipantId, Pair | None] = {}
        self._pairs = Pairs()

    def step_record(self, step_record: StepRecord, outputs: Outputs) -> None:
        before, now = self._goals.get(step_record.name), outputs.goal
        self._goals[step_record.name] = now
        if before is None or before == now or not step_record.heard:
            return
        sample = self._samples.get(before)
        if sample is None:
            return
        left = dict(self._decoded(outputs.lowered))
        if left.get(sample) == 0 and sample not in dict(self._decoded(outputs.spent)):
            self.seen["merge that removes the current goal"] += 1
        elif now is not None and sample not in left and self.scenario.claiming:
            shared = any(
                goal == before for name, goal in self._goals.items() if name != step_record.name
            )
            self.seen["one goal of two, left to one by a claim"] += shared

    def _decoded(self, content: bytes) -> Iterator[tuple[int, int]]:
        pairs = self._pairs.decode(content, len(self._samples)) if content else None
        if pairs is not None:
            yield from zip(pairs[0].tolist(), pairs[1].tolist(), strict=True)


class _Partitions(_Detector):
    """Spending of two sides of a partition that did not know of each other."""

    names = ("partition healed after both sides consumed one sample",)

    @classmethod
    def applies(cls, scenario: Scenario) -> bool:
        return any(isinstance(fault, Partition) for fault in scenario.faults)

    def __init__(self, opening: Opening) -> None:
        super().__init__(opening)
        roster = self.scenario.roster
        self._samples = opening.samples_m.shape[0]
        self._open = [
            (fault.from_ns, fault.until_ns, fault.severs(roster))
            for fault in self.scenario.faults
            if isinstance(fault, Partition) and fault.until_ns is not None
        ]
        self._open.sort(key=lambda window: window[1] or 0)
        self._from_ns = min((window[0] for window in self._open), default=2**63)
        self._consumed: dict[ParticipantId, dict[int, int]] = {}
        self._pairs = Pairs()

    def step_record(self, step_record: StepRecord, outputs: Outputs) -> None:
        if not outputs.spent or step_record.now_ns < self._from_ns or not self._open:
            return
        pairs = self._pairs.decode(outputs.spent, self._samples)
        if pairs is not None:
            latest = dict.fromkeys(pairs[0].tolist(), step_record.now_ns)
            self._consumed.setdefault(step_record.name, {}).update(latest)

    def batch(self, batch: Batch) -> None:
        while self._open and batch.now_ns >= (self._open[0][1] or 0):
            from_ns, _, severs = self._open.pop(0)
            within = {
                name: {sample for sample, at_ns in consumed.items() if at_ns >= from_ns}
                for name, consumed in self._consumed.items()
            }
            if any(
                one < other and severs(one, other) and within[one] & within[other]
                for one in within
                for other in within
            ):
                self.seen["partition healed after both sides consumed one sample"] += 1


class _Losses(_Detector):
    """Energy that ends, clocks that jump back, and a supervisor that is lost."""

    names = (
        "energy ended in contact",
        "clock jumped back",
        "supervisor given up",
        "supervisor heard again after it was given up",
    )

    def __init__(self, opening: Opening) -> None:
        super().__init__(opening)
        self._exhausted: set[ParticipantId] = set()
        self._read_ns: dict[ParticipantId, int] = {}
        self._alone: set[ParticipantId] = set()
        self._centralized = self.scenario.centralized
        self._misled = any(isinstance(fault, ClockFault) for fault in self.scenario.faults)

    def step_record(self, step_record: StepRecord, outputs: Outputs) -> None:
        name = step_record.name
        if outputs.state is State.EXHAUSTED and name not in self._exhausted:
            self._exhausted.add(name)
            self.seen["energy ended in contact"] += bool(step_record.heard)
        if self._misled:
            self._read_clock(step_record)
        if self._centralized and name != SUPERVISOR and outputs.outbox:
            alone = outputs.outbox[-1].target == EVERYBODY
            if alone and name not in self._alone:
                self._alone.add(name)
                self.seen["supervisor given up"] += 1
            elif not alone and name in self._alone:
                self._alone.discard(name)
                self.seen["supervisor heard again after it was given up"] += 1

    def _read_clock(self, step_record: StepRecord) -> None:
        read_ns = step_record.now_ns + step_record.skew_ns
        if read_ns < self._read_ns.get(step_record.name, 0):
            self.seen["clock jumped back"] += 1
        self._read_ns[step_record.name] = read_ns


class _Liars(_Detector):
    """What the honest do beside a robot that lies."""

    names = ("message of a liar refused", "word of a liar passed on", "finished beside a liar")

    @classmethod
    def applies(cls, scenario: Scenario) -> bool:
        return bool(liars_of(scenario.faults))

    def __init__(self, opening: Opening) -> None:
        super().__init__(opening)
        self._names, self._liars = self.scenario.roster, liars_of(self.scenario.faults)
        self._refused = dict.fromkeys(self._names, 0)
        self._finished: set[ParticipantId] = set()

    def step_record(self, step_record: StepRecord, outputs: Outputs) -> None:
        name = step_record.name
        if name in self._liars:
            return
        if outputs.refused > self._refused[name]:
            forged = any(number >= FORGED_SEQUENCE_MIN for _, number in step_record.heard)
            heard = any(source in self._liars for source, _ in step_record.heard)
            self.seen["message of a liar refused"] += heard and not forged
        self._refused[name] = outputs.refused
        for envelope in outputs.outbox:
            origins = [each.origin for each in decode_gossip(envelope.body).attestations]
            told = any(self._names[origin % len(self._names)] in self._liars for origin in origins)
            self.seen["word of a liar passed on"] += told
        if outputs.state is State.FINISHED and name not in self._finished:
            self._finished.add(name)
            self.seen["finished beside a liar"] += 1


_DETECTORS = (_Goals, _Partitions, _Restarts, _Deliveries, _Recoveries, _Losses, _Liars)

JUDGED = ("L1 judged", "L2 judged", "L3 judged", "I8 judged")
"""Missions in which a rule of liveness could have been broken; see `LivenessChecker`."""

RARE_EVENTS: tuple[str, ...] = (
    *(name for detector in _DETECTORS for name in detector.names),
    *JUDGED,
)
"""The situations that a campaign has to reach."""


class RareEvents:
    """Follows the records of one mission."""

    def __init__(self) -> None:
        self._detectors: list[_Detector] = []
        self._on_step: list[Callable[[StepRecord, Outputs], None]] = []
        self._on_batch: list[Callable[[Batch], None]] = []

    def observe(self, record: Record) -> None:
        """Follow one record."""
        if isinstance(record, Batch):
            for step_record in record.step_records:
                if step_record.outputs is not None:
                    for follow_step in self._on_step:
                        follow_step(step_record, step_record.outputs)
            for follow in self._on_batch:
                follow(record)
        elif isinstance(record, ProcessEvent):
            for detector in self._detectors:
                detector.process_event(record)
        elif isinstance(record, Opening):
            self._detectors = [
                detector(record) for detector in _DETECTORS if detector.applies(record.scenario)
            ]
            self._on_step = [
                each.step_record
                for each in self._detectors
                if type(each).step_record is not _Detector.step_record
            ]
            self._on_batch = [
                each.batch for each in self._detectors if type(each).batch is not _Detector.batch
            ]

    @property
    def counts(self) -> dict[str, int]:
        """How often each situation was seen; those that were not are left out."""
        return {
            name: detector.seen[name]
            for detector in self._detectors
            for name in detector.names
            if detector.seen[name]
        }


def _covers(version_vector: list[int], wanted: list[int]) -> bool:
    padded = version_vector + [0] * (len(wanted) - len(version_vector))
    return all(held >= entries for held, entries in zip(padded, wanted, strict=False))
