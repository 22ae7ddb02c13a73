"""Truth, radio and record together: what each participant is given, and what follows from its act.

Both the virtual loop and the wall relay stand on this; they differ only in who waits for whom.

A stage is a function of the records that it has told: whoever has them has the stage (`Stage.resumed`).
So world-sim needs no snapshot beside its journal.
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
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import RefusedError, check_outputs
from kantor_worldsim.radio.channel import Channel, DeliveryDecision, Sent
from kantor_worldsim.radio.link_faults import LinkFaults
from kantor_worldsim.record.records import (
    Batch,
    Ending,
    ProcessEvent,
    Record,
    StepRecord,
    opening_of,
)
from kantor_worldsim.world.world import World, WorldSetup

Observer = Callable[[Record], None]
"""Takes each record as it comes into being: journal, metrics, checker, progress."""


class Step(msgspec.Struct, frozen=True, gc=False):
    """What a participant was given and what it returned; None if it returned nothing."""

    name: ParticipantId
    inputs: Inputs
    outputs: Outputs | None
    skew_ns: int = 0
    """How far the clock in the inputs is ahead."""

    def answered(self, outputs: Outputs | None) -> "Step":
        """The same step with what was returned."""
        return Step(self.name, self.inputs, outputs, self.skew_ns)


class ForeignRecordError(ValueError):
    """Records that this version does not make of what participants did; the text says which."""


class Simulation:
    """A mission under way."""

    def __init__(
        self, scenario: Scenario, seed: int, site: WorldSetup, observers: Iterable[Observer]
    ) -> None:
        self.scenario = scenario
        self.seed = seed
        self.now_ns = 0
        self.done_ns = 0
        """Turn by turn: every step that was due before is done."""
        self.deeds = 0
        """So many of the scenario's deeds (see `outages`) are done."""
        self.limit_ns = scenario.limit_ns
        self._linger_ns = round(scenario.linger_s * 1e9)
        self._restless_ns = max((fault.until_ns or 0 for fault in scenario.faults), default=0)
        """Up to then somebody explored, or something could go wrong."""
        self._faults = LinkFaults.of(scenario, seed)
        self.channel = Channel(
            scenario, seed, site.ground, self._faults.rule if self._faults else None
        )
        self._robots = frozenset(scenario.robot_ids)
        self._site = site
        self._world = World(scenario, seed, site)
        self._observers = tuple(observers)
        self._resting: set[ParticipantId] = set()
        self._acted: set[ParticipantId] = set()
        self._unanswered: dict[ParticipantId, Step] = {}
        self._died_ns: dict[ParticipantId, int] = {}
        self._kept: list[Record] | None = [] if _may_be_killed(scenario) else None
        self.gone: set[ParticipantId] = set()
        """Participants that have left and will not come back. Who is killed for good is among them;
        whoever runs the others keeps this up to date."""
        for name in scenario.roster:
            self.channel.place(name, self._world.pose(name))
        self._tell(opening_of(scenario, seed, site, self._world.first_look()))

    @classmethod
    def resumed(
        cls,
        scenario: Scenario,
        seed: int,
        site: WorldSetup,
        records: Iterable[Record],
        observers: Iterable[Observer],
    ) -> "Simulation":
        """A stage as it was when it had told these records, all without an ending.

        What participants did happens once more, and no listener is told. Raises ForeignRecordError.
        """
        told: list[Record] = []
        simulation = cls(scenario, seed, site, [told.append])
        for number, record in enumerate(records):
            try:
                simulation._repeat(record)
            except KeyError as error:
                raise ForeignRecordError(f"record {number}: {error} is not under way") from None
            except IndexError:
                raise ForeignRecordError(f"record {number}: no such fault") from None
            if told != [record]:
                raise ForeignRecordError(f"record {number}: does not follow from those before it")
            told.clear()
        simulation._observers = tuple(observers)
        return simulation

    def rebuilt(self) -> "Simulation":
        """The same stage from its records; only where the scenario has world-sim killed."""
        assert self._kept is not None
        return Simulation.resumed(self.scenario, self.seed, self._site, self._kept, self._observers)

    def forget(self) -> None:
        """Keep no records: a process that is killed is not rebuilt in memory."""
        self._kept = None

    def _repeat(self, record: Record) -> None:
        if isinstance(record, Batch):
            self.settle(
                record.now_ns, [self._recalled(step_record) for step_record in record.step_records]
            )
        elif isinstance(record, ProcessEvent):
            self.note(record)

    def _recalled(self, step_record: StepRecord) -> Step:
        """The step that an act is the record of."""
        if step_record.outputs is None or step_record.name in self._unanswered:
            return self.turn(step_record.name, step_record.now_ns, step_record.skew_ns).answered(
                step_record.outputs
            )
        inbox = self.channel.collect_heard(step_record.name, step_record.heard)
        inputs = Inputs(
            step_record.now_ns + step_record.skew_ns, self._world.observe(step_record.name), inbox
        )
        return Step(step_record.name, inputs, step_record.outputs, step_record.skew_ns)

    def inputs(self, name: ParticipantId, now_ns: int) -> Inputs:
        """What has reached a participant by now. Its inbox is handed out once."""
        return Inputs(now_ns, self._world.observe(name), self.channel.collect(name, now_ns))

    def turn(self, name: ParticipantId, now_ns: int, skew_ns: int = 0) -> Step:
        """What to ask a participant now: the last turn again if it has not answered that."""
        asked = self._unanswered.get(name)
        if asked is not None:
            return asked
        inputs = Inputs(
            now_ns + skew_ns, self._world.observe(name), self.channel.collect(name, now_ns)
        )
        return Step(name, inputs, None, skew_ns)

    def unanswered(self, name: ParticipantId) -> Step | None:
        """The turn that a participant was given and has not answered."""
        return self._unanswered.get(name)

    def body(self, name: ParticipantId) -> Body:
        """What whoever takes a participant over has to know."""
        return self._world.body(name)

    def look(self, name: ParticipantId) -> Observation:
        """What the world tells a participant of itself."""
        return self._world.observe(name)

    def acted(self, name: ParticipantId) -> bool:
        """Whether a participant has ever stepped in this mission."""
        return name in self._acted

    @property
    def over(self) -> str | None:
        """Why there is nothing more to do, or None.

        `done`: every robot rests, or has left while others rest, for as long as the scenario has them
        linger. `deserted`: nobody is left.
        """
        reason = self._at_rest
        lingers = self.now_ns < self._restless_ns + self._linger_ns if self._linger_ns else False
        return None if lingers and reason == "done" else reason

    @property
    def _at_rest(self) -> str | None:
        robots = self._robots
        if len(self._resting) + len(self.gone) < len(robots) or not robots <= (
            self._resting | self.gone
        ):
            return None
        return "done" if robots - self.gone or robots <= self._resting else "deserted"

    def settle(self, now_ns: int, steps: Iterable[Step]) -> tuple[DeliveryDecision, ...]:
        """Let steps made at one moment happen: everybody is heard from where its step began, then moves.

        A robot answers from where it heard, before what it heard makes it turn away (Algorithm 3).
        """
        self.now_ns = max(self.now_ns, now_ns)
        self.done_ns = now_ns + 1
        if self._linger_ns and self._at_rest is None:
            self._restless_ns = max(self._restless_ns, now_ns)
        sound = [step if _is_sound(step) else step.answered(None) for step in steps]
        sent = [Sent(now_ns, e) for step in sound if step.outputs for e in step.outputs.outbox]
        ruled, out_of_range = self.channel.transmit(sent)
        decisions = tuple(ruled)
        step_records = tuple([self._act(step) for step in sound])
        absent = (
            [step_record.name for step_record in step_records if step_record.outputs is None]
            if self._unanswered
            else ()
        )
        fault_stats = self._faults.pop_stats() if self._faults else ()
        forged = self._faults.pop_forged() if self._faults else ()
        self._tell(
            Batch(now_ns, step_records, decisions, out_of_range, tuple(absent), fault_stats, forged)
        )
        return decisions

    def note(self, incident: ProcessEvent) -> None:
        """Put on record what befell a process, and let it have its effect on who is left, and where."""
        now_ns, who, what, index, _, incarnation = msgspec.structs.astuple(incident)
        self.now_ns, self.done_ns = max(self.now_ns, now_ns), now_ns
        if what == "kill":
            self._died_ns[who] = now_ns
        fault = self.scenario.faults[index] if index >= 0 else None
        self.deeds += fault is not None
        if isinstance(fault, Kill) and fault.until_ns is None:
            self.gone = self.gone | {who}
        if what in {"start", "join"} and who != WORLD_SIM:
            if isinstance(fault, OnProcesses):  # what reached nobody
                self.channel.lose(who, self._died_ns.get(who, fault.from_ns), now_ns)
            if self._world.begin(who, incarnation):
                self._resting.discard(who)
        self._tell(incident)

    def end(self, reason: str) -> None:
        """Close the record."""
        self._tell(Ending(self.now_ns, reason))

    def _act(self, step: Step) -> StepRecord:
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

    def _tell(self, record: Record) -> None:
        if self._kept is not None:
            self._kept.append(record)
        for listener in self._observers:
            listener(record)


def _is_sound(step: Step) -> bool:
    """Whether its outputs, if any, have a place on the stage: no bad numbers, no false sender."""
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
    """Whether world-sim is killed in a scenario, and has to go on from what it has told."""
    return any(isinstance(fault, Kill) and WORLD_SIM in fault.who for fault in scenario.faults)
