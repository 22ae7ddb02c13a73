"""Truth, radio and record together: what each participant is given, and what follows from its act.

Both the virtual loop and the wall relay stand on this; they differ only in who waits for whom.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

from kantor_protocol.machine import Inputs, Outputs, ParticipantId, State
from kantor_protocol.messages import RefusedError, check_outputs
from kantor_protocol.scenario import Scenario
from kantor_worldsim.channel import Channel, Sent, Verdict
from kantor_worldsim.faults import LinkFaults
from kantor_worldsim.records import Act, Batch, Ending, Incident, Record, opening_of
from kantor_worldsim.world import Site, World

Listener = Callable[[Record], None]
"""Takes each record as it comes into being: journal, metrics, checker, progress."""


class Step(NamedTuple):
    """What a participant was given and what it returned; None if it returned nothing."""

    name: ParticipantId
    inputs: Inputs
    outputs: Outputs | None


class Stage:
    """A mission under way."""

    def __init__(
        self, scenario: Scenario, seed: int, site: Site, listeners: Iterable[Listener]
    ) -> None:
        self.scenario = scenario
        self.now_ns = 0
        self.limit_ns = scenario.limit_ns
        self._faults = LinkFaults.of(scenario, seed)
        self.channel = Channel(
            scenario, seed, site.ground, self._faults.rule if self._faults else None
        )
        self._robots = frozenset(scenario.robot_ids)
        self._world = World(scenario, seed, site)
        self._listeners = tuple(listeners)
        self._resting: set[ParticipantId] = set()
        self._acted: set[ParticipantId] = set()
        self.gone: set[ParticipantId] = set()
        """Participants that have left the bus; whoever runs them keeps this up to date."""
        for name in scenario.roster:
            self.channel.place(name, self._world.pose(name))
        self._tell(opening_of(scenario, seed, site, self._world.first_look()))

    def inputs(self, name: ParticipantId, now_ns: int) -> Inputs:
        """What has reached a participant by now. It is handed out once."""
        return Inputs(now_ns, self._world.observe(name), self.channel.take(name, now_ns))

    def acted(self, name: ParticipantId) -> bool:
        """Whether a participant has ever stepped in this mission."""
        return name in self._acted

    @property
    def over(self) -> str | None:
        """Why there is nothing more to do, or None.

        `done`: every robot rests, or has left while others rest. `deserted`: nobody is left.
        """
        robots = self._robots
        if len(self._resting) + len(self.gone) < len(robots) or not robots <= (
            self._resting | self.gone
        ):
            return None
        return "done" if robots - self.gone or robots <= self._resting else "deserted"

    def settle(self, now_ns: int, steps: Iterable[Step]) -> tuple[Verdict, ...]:
        """Let steps made at one moment happen: everybody is heard from where its step began, then moves.

        A robot answers from where it heard, before what it heard makes it turn away (Algorithm 3).
        """
        self.now_ns = max(self.now_ns, now_ns)
        sound = [(name, inputs, self._sound(name, outputs)) for name, inputs, outputs in steps]
        sent = [Sent(now_ns, e) for _, _, outputs in sound if outputs for e in outputs.outbox]
        ruled, out_of_range = self.channel.transmit(sent)
        verdicts = tuple(ruled)
        acts = tuple([self._act(name, inputs, outputs) for name, inputs, outputs in sound])
        absent = tuple([act.name for act in acts if act.outputs is None])
        tolls = self._faults.take_tolls() if self._faults else ()
        forged = self._faults.take_forged() if self._faults else ()
        self._tell(Batch(now_ns, acts, verdicts, out_of_range, absent, tolls, forged))
        return verdicts

    def note(self, incident: Incident) -> None:
        """Put on record what befell a process."""
        self._tell(incident)

    def end(self, reason: str) -> None:
        """Close the record."""
        self._tell(Ending(self.now_ns, reason))

    def _act(self, name: ParticipantId, inputs: Inputs, outputs: Outputs | None) -> Act:
        heard = tuple([(envelope.source, envelope.sequence) for envelope in inputs.inbox])
        if outputs is None:
            return Act(name, inputs.now_ns, inputs.observation, heard, None, None)
        ruling = self._world.accept(name, inputs.now_ns, outputs)
        self.channel.place(name, ruling.pose)
        self._acted.add(name)
        if outputs.state is not State.EXPLORING and name in self._robots:
            self._resting.add(name)
        return Act(name, inputs.now_ns, inputs.observation, heard, outputs, ruling)

    def _sound(self, name: ParticipantId, outputs: Outputs | None) -> Outputs | None:
        """The outputs, unless they have no place on the stage: bad numbers, a false sender."""
        if outputs is None:
            return None
        try:
            check_outputs(outputs)
        except RefusedError:
            return None
        for envelope in outputs.outbox:
            if envelope.source != name:
                return None
        return outputs

    def _tell(self, record: Record) -> None:
        for listener in self._listeners:
            listener(record)
