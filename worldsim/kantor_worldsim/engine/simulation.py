"""The simulation: truth, radio and record together; what each participant is given, and what follows from its step.

The event loop of virtual time and the realtime exchange both drive it; they differ only in which of them waits
for participants.

A simulation is a function of the records that it has emitted: it can be rebuilt from them (`Simulation.resumed`),
so world-sim needs no snapshot beside its journal.
"""

from collections.abc import Callable, Iterable

import msgspec

from kantor_protocol.base.machine import (
    WORLD_SIM,
    Body,
    Inputs,
    Observation,
    Outputs,
    ParticipantId,
    State,
)
from kantor_protocol.scenario.faults.processes import Kill, OnProcesses
from kantor_protocol.scenario.faults.schedule import AnyFault
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.attestations import Identities
from kantor_protocol.wire.messages import RefusedError, check_outputs
from kantor_worldsim.engine.process_faults import schedule_of
from kantor_worldsim.radio.channel import Channel, Sent
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.record.process_events import TAKE_OVER, ProcessEventKind
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    Opening,
    ProcessEvent,
    Record,
    StepRecord,
    opening_of,
)
from kantor_worldsim.world.world import World, WorldSetup

Observer = Callable[[Record], object]
"""Receives each record as it is emitted."""


class Step(msgspec.Struct, frozen=True, gc=False):
    """Inputs of a participant's step, and its outputs; None if it returned none."""

    name: ParticipantId
    inputs: Inputs
    outputs: Outputs | None
    skew_ns: int = 0
    """Skew of the clock that the inputs show, positive if it is ahead."""

    def answered(self, outputs: Outputs | None) -> "Step":
        """The same step with its outputs."""
        return Step(self.name, self.inputs, outputs, self.skew_ns)


class ForeignRecordError(ValueError):
    """Records that this version does not emit for the same steps; the text names the first."""


class Simulation:
    """A mission in progress. Steps and process events go in, records come out."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        setup: WorldSetup,
        observers: Iterable[Observer],
        identities: Identities | None = None,
    ) -> None:
        """identities: whose word counts, for the record of a mission with `trust = "signed"`."""
        self.scenario = scenario
        self.seed = seed
        self.now_ns = 0
        """Time of the last record, or later; it never falls."""
        self.done_ns = 0
        """Virtual time: every step that was due before is done. At most now_ns + 1."""
        self.faults_done = 0
        """Number of scheduled process faults that are done (see `process_faults.py`)."""
        self.limit_ns = scenario.limit_ns
        self._linger_ns = round(scenario.linger_s * 1e9)
        self._restless_ns = max((fault.until_ns or 0 for fault in scenario.faults), default=0)
        """The last time at which a robot explored, or a fault was to end."""
        self._faults = LinkFaults.of(scenario, seed)
        self.channel = Channel(
            scenario, seed, setup.ground, self._faults.rule if self._faults else None
        )
        self._robots = frozenset(scenario.robot_ids)
        self._setup = setup
        self._world = World(scenario, seed, setup)
        self._observers = tuple(observers)
        self._resting: set[ParticipantId] = set()
        """Robots that have come to rest; each of them has stepped."""
        self._acted: set[ParticipantId] = set()
        """Participants that have stepped."""
        self._unanswered: dict[ParticipantId, Step] = {}
        """Requests without outputs so far, none of them with outputs; their participants are asked again."""
        self._died_ns: dict[ParticipantId, int] = {}
        """Time of each process's last kill, not after now_ns."""
        self._left_ns: dict[ParticipantId, int] = {}
        """Time at which each process that no fault stopped left the bus, and is not back; not after now_ns."""
        self._kept: list[Record] | None = [] if _may_be_killed(scenario) else None
        """All records so far, the opening first, where the scenario kills world-sim."""
        self._gone: frozenset[ParticipantId] = frozenset()
        """Participants that are not on the bus and that the mission does not wait for: killed for good, or
        reported by the exchange (`leave`, `come_back`). All in the roster."""
        for name in scenario.roster:
            self.channel.place(name, self._world.pose(name))
        self._emit(opening_of(scenario, seed, setup, self._world.first_look()))
        if identities is not None:
            self._emit(identities)

    @classmethod
    def resumed(
        cls,
        scenario: Scenario,
        seed: int,
        setup: WorldSetup,
        records: Iterable[Record],
        observers: Iterable[Observer],
    ) -> "Simulation":
        """A simulation as it was when it had emitted these records, all without an ending.

        Their steps are settled once more, and no observer is called. Raises ForeignRecordError.
        """
        emitted: list[Record] = []
        simulation = cls(scenario, seed, setup, [emitted.append])
        for number, record in enumerate(records):
            try:
                simulation._repeat(record)
            except KeyError as error:
                raise ForeignRecordError(f"record {number}: {error} is not in flight") from None
            except IndexError:
                raise ForeignRecordError(f"record {number}: no such fault") from None
            if emitted != [record]:
                raise ForeignRecordError(f"record {number}: does not follow from those before it")
            emitted.clear()
        simulation._observers = tuple(observers)
        return simulation

    def rebuilt(self) -> "Simulation":
        """The same simulation from its records; only where the scenario kills world-sim."""
        assert self._kept is not None
        return Simulation.resumed(
            self.scenario, self.seed, self._setup, self._kept, self._observers
        )

    def forget(self) -> None:
        """Keep no records in memory: a process of its own is rebuilt from its journal."""
        self._kept = None

    def _repeat(self, record: Record) -> None:
        if isinstance(record, Batch):
            self.settle(record.now_ns, [self._step_of(made) for made in record.step_records])
        elif isinstance(record, ProcessEvent):
            self.note(record)
        elif isinstance(record, Identities):
            self._emit(record)

    def _step_of(self, made: StepRecord) -> Step:
        """The step that a record is of."""
        if made.outputs is None or made.name in self._unanswered:
            return self.request(made.name, made.now_ns, made.skew_ns).answered(made.outputs)
        inbox = self.channel.collect_heard(made.name, made.heard)
        inputs = Inputs(made.now_ns + made.skew_ns, self._world.observe(made.name), inbox)
        return Step(made.name, inputs, made.outputs, made.skew_ns)

    def inputs(self, name: ParticipantId, now_ns: int) -> Inputs:
        """Observation of a participant and the messages that have arrived by now, each handed out once."""
        return Inputs(now_ns, self._world.observe(name), self.channel.collect(name, now_ns))

    def request(self, name: ParticipantId, now_ns: int, skew_ns: int = 0) -> Step:
        """The step to ask a participant for now: the last one again if that is unanswered."""
        if (unanswered := self._unanswered.get(name)) is not None:
            return unanswered
        inbox = self.channel.collect(name, now_ns)
        inputs = Inputs(now_ns + skew_ns, self._world.observe(name), inbox)
        return Step(name, inputs, None, skew_ns)

    def unanswered(self, name: ParticipantId) -> Step | None:
        """The request that a participant has not answered."""
        return self._unanswered.get(name)

    def body(self, name: ParticipantId) -> Body:
        """State of a participant as a process that takes it over must know it."""
        return self._world.body(name)

    def look(self, name: ParticipantId) -> Observation:
        """Observation of a participant by itself."""
        return self._world.observe(name)

    def acted(self, name: ParticipantId) -> bool:
        """Whether a participant has ever stepped in this mission."""
        return name in self._acted

    def leave(self, names: Iterable[ParticipantId]) -> None:
        """Do not wait for these participants; they are not on the bus."""
        self._gone |= frozenset(names)

    def come_back(self, name: ParticipantId) -> None:
        """Wait for a participant again; it is back on the bus."""
        self._gone -= {name}

    @property
    def over(self) -> str | None:
        """Reason to end the mission, or None.

        `done`: every robot rests, or has left while others rest, for as long as the scenario lets it
        linger. `deserted`: no robot is left.
        """
        reason = self._at_rest
        lingers = self.now_ns < self._restless_ns + self._linger_ns if self._linger_ns else False
        return None if lingers and reason == "done" else reason

    @property
    def _at_rest(self) -> str | None:
        robots, resting, gone = self._robots, self._resting, self._gone
        if len(resting) + len(gone) < len(robots) or not robots <= resting | gone:
            return None
        return "done" if robots - gone or robots <= resting else "deserted"

    def settle(self, now_ns: int, steps: Iterable[Step]) -> None:
        """Settle steps made at one moment: messages are delivered from where steps began, then robots move.

        A robot answers from where it received, before what it received makes it turn away (Algorithm 3).
        """
        self.now_ns = max(self.now_ns, now_ns)
        self.done_ns = now_ns + 1
        if self._linger_ns and self._at_rest is None:
            self._restless_ns = max(self._restless_ns, now_ns)
        sound = [step if _is_sound(step) else step.answered(None) for step in steps]
        sent = [Sent(now_ns, e) for step in sound if step.outputs for e in step.outputs.outbox]
        decisions, out_of_range = self.channel.transmit(sent)
        made = tuple([self._accept(step) for step in sound])
        absent = [step.name for step in made if step.outputs is None] if self._unanswered else ()
        stats = self._faults.pop_stats() if self._faults else ()
        forged = self._faults.pop_forged() if self._faults else ()
        self._emit(
            Batch(now_ns, made, tuple(decisions), out_of_range, tuple(absent), stats, forged)
        )

    def note(self, event: ProcessEvent) -> None:
        """Record a process event, and apply what follows for positions, messages and who is waited for."""
        self.now_ns, self.done_ns = max(self.now_ns, event.now_ns), event.now_ns
        if event.kind == ProcessEventKind.KILL:
            self._died_ns[event.who] = event.now_ns
        elif event.kind == ProcessEventKind.LEAVE:
            self._left_ns.setdefault(event.who, event.now_ns)
        fault = self.scenario.faults[event.fault] if event.fault >= 0 else None
        self.faults_done += fault is not None
        if isinstance(fault, Kill) and fault.until_ns is None:
            self.leave((event.who,))
        if event.kind in TAKE_OVER and event.who != WORLD_SIM:
            self._take_over(event, fault)
        self._emit(event)

    def _take_over(self, event: ProcessEvent, fault: AnyFault | None) -> None:
        """A process takes over a body; messages that arrived while there was none are lost."""
        since_ns = self._left_ns.pop(event.who, None)
        if isinstance(fault, OnProcesses):
            since_ns = self._died_ns.get(event.who, fault.from_ns)
        if since_ns is not None:
            self.channel.lose(event.who, since_ns, event.now_ns)
        if self._world.begin(event.who, event.incarnation):
            self._resting.discard(event.who)

    def end(self, reason: str) -> None:
        """Record the end of the mission."""
        self._emit(Ending(self.now_ns, reason))

    def validate(self) -> None:
        """Assert the invariants that are stated at the attributes."""
        roster = frozenset(self.scenario.roster)
        processes = roster | {WORLD_SIM}
        assert 0 <= self.done_ns <= self.now_ns + 1
        assert 0 <= self.faults_done <= len(schedule_of(self.scenario))
        assert self._resting <= self._acted & self._robots
        assert self._acted <= roster
        assert self._gone <= processes
        assert set(self._unanswered) <= roster
        assert all(step.outputs is None for step in self._unanswered.values())
        assert all(0 <= died_ns <= self.now_ns for died_ns in self._died_ns.values())
        assert all(0 <= left_ns <= self.now_ns for left_ns in self._left_ns.values())
        assert set(self._died_ns) | set(self._left_ns) <= processes
        assert self._kept is None or isinstance(self._kept[0], Opening)
        self.channel.validate()
        self._world.validate()

    def _accept(self, step: Step) -> StepRecord:
        """The record of a step, with the world's verdict on it."""
        name, inputs, outputs, skew_ns = step.name, step.inputs, step.outputs, step.skew_ns
        now_ns = inputs.now_ns - skew_ns
        if outputs is None:
            self._unanswered[name] = step
            return StepRecord(name, now_ns, inputs.observation, (), None, None, skew_ns)
        if self._unanswered:
            self._unanswered.pop(name, None)
        heard = tuple([(envelope.source, envelope.sequence) for envelope in inputs.inbox])
        verdict = self._world.accept(name, now_ns, outputs)
        self.channel.place(name, verdict.pose)
        self._acted.add(name)
        if outputs.state is not State.EXPLORING and name in self._robots:
            self._resting.add(name)
        return StepRecord(name, now_ns, inputs.observation, heard, outputs, verdict, skew_ns)

    def _emit(self, record: Record) -> None:
        if self._kept is not None:
            self._kept.append(record)
        for observer in self._observers:
            observer(record)


def _is_sound(step: Step) -> bool:
    """Whether the outputs of a step, if any, can be settled: finite numbers, and no false sender."""
    outputs = step.outputs
    if outputs is None:
        return True
    try:
        check_outputs(outputs)
    except RefusedError:
        return False
    for envelope in outputs.outbox:  # noqa: SIM110  a generator for one envelope costs as much as the rest
        if envelope.source != step.name:
            return False
    return True


def _may_be_killed(scenario: Scenario) -> bool:
    """Whether a scenario kills world-sim, which is then rebuilt from its records."""
    return any(isinstance(fault, Kill) and WORLD_SIM in fault.who for fault in scenario.faults)
