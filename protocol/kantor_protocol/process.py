"""The shell of a participant's process: it turns messages into steps and steps into messages.

It makes no decision. In the lockstep exchange it steps when world-sim says so; in the wall exchange it
steps when its own clock says so, with whatever has arrived by then, and waits for nobody.
"""

import secrets
import time
from collections.abc import Callable

from kantor_protocol import bus
from kantor_protocol.clock import clocks
from kantor_protocol.credentials import Identity
from kantor_protocol.machine import (
    SUPERVISOR,
    Body,
    Envelope,
    Inputs,
    Outputs,
    ParticipantId,
    Pose,
    StateMachine,
)
from kantor_protocol.messages import (
    VERSION,
    Go,
    Mission,
    PoseMessage,
    Ready,
    Refusal,
    RefusedError,
    Report,
    Stop,
    ToParticipant,
    Turn,
    decode_to_participant,
    encode,
)

Build = Callable[[Mission, Body], StateMachine]
"""Makes the machine for a mission, as it is when it takes a body over."""


class NotWantedError(RuntimeError):
    """World-sim does not let this process take part; the message says why."""


def participate(
    connect: str, identity: Identity, build: Build, patience_s: float, say: Callable[[str], None]
) -> str:
    """Take part in missions until world-sim says stop; the reason it gave.

    say: takes one line of news for a person. Raises BusError, NotWantedError.
    """
    nonce = secrets.token_hex(8)
    with bus.line(connect, identity, nonce, patience_s) as line:
        say(f"{identity.user}: on the bus at {connect}, waiting for a mission")
        return _Participant(line, identity, build, say).run()


class _Participant:
    def __init__(
        self, line: bus.Line, identity: Identity, build: Build, say: Callable[[str], None]
    ) -> None:
        self._line = line
        self._me = identity.user
        self._build = build
        self._say = say
        self._machine: StateMachine | None = None
        self._mission: Mission | None = None
        self.refused = 0
        """Messages from world-sim that could not be read."""

    def run(self) -> str:
        while True:
            message = self._next(None)
            if isinstance(message, Stop):
                return message.reason
            if isinstance(message, Go) and message.nonce == self._line.nonce:
                reason = self._free_run(message)
                if reason is not None:
                    return reason
            elif message is not None:
                self._take(message)

    def _next(self, timeout_s: float | None) -> ToParticipant | None:
        payload = self._line.next(timeout_s)
        if payload is None:
            return None
        try:
            return decode_to_participant(payload)
        except RefusedError:
            self.refused += 1
            return None

    def _take(self, message: ToParticipant) -> None:
        if isinstance(message, Mission) and message.nonce == self._line.nonce:
            self._prepare(message)
        elif isinstance(message, Refusal) and message.nonce == self._line.nonce:
            raise NotWantedError(f"{self._me}: {message.reason}")
        elif isinstance(message, Turn) and self._machine is not None:
            outputs = self._machine.step(message.inputs)
            self._send(Report(VERSION, self._line.nonce, outputs), message.inputs.now_ns)

    def _prepare(self, mission: Mission) -> None:
        self._mission = mission
        self._machine = self._build(mission, mission.body or _at_start(mission, self._me))
        self._say(f"{self._me}: mission {mission.scenario.name}, seed {mission.seed}")
        self._line.send(encode(Ready(VERSION, self._line.nonce)))

    def _send(self, report: Report, now_ns: int) -> None:
        outputs = report.outputs
        self._line.send(encode(report))
        self._line.publish_pose(encode(PoseMessage(VERSION, outputs.step, now_ns, outputs.pose)))
        if outputs.weights:
            self._line.publish_weights(outputs.weights)

    def _free_run(self, go: Go) -> str | None:
        """Step by the own clock until told to stop; the reason, or None for another mission."""
        mission, machine = self._mission, self._machine
        if mission is None or machine is None or go.observation is None:
            return None
        scenario = mission.scenario
        clock = clocks(scenario, mission.seed)[self._me]
        origin = time.monotonic_ns() - round(go.now_ns / go.speed)
        arrived: list[Envelope] = []
        observation = go.observation
        ordinal = 1
        while clock.due_ns(ordinal) <= go.now_ns:
            ordinal += 1
        while True:
            now_ns = round((time.monotonic_ns() - origin) * go.speed)
            due_ns = clock.due_ns(ordinal)
            if now_ns < due_ns:
                message = self._next((due_ns - now_ns) * 1e-9 / go.speed)
                if isinstance(message, Stop):
                    return message.reason
                if isinstance(message, Turn):
                    arrived += message.inputs.inbox
                    if message.inputs.observation.step >= observation.step:
                        observation = message.inputs.observation
                elif isinstance(message, Mission):
                    self._take(message)
                    return None
                continue
            inputs = Inputs(now_ns, observation, tuple(arrived))
            arrived = []
            self._send(self._report(machine.step(inputs), inputs), now_ns)
            # A step that came too late is left out; a robot does not catch up in a burst.
            while clock.due_ns(ordinal) <= now_ns:
                ordinal += 1

    def _report(self, outputs: Outputs, inputs: Inputs) -> Report:
        heard = tuple((envelope.source, envelope.sequence) for envelope in inputs.inbox)
        return Report(
            VERSION, self._line.nonce, outputs, inputs.now_ns, heard, inputs.observation.step
        )


def _at_start(mission: Mission, me: ParticipantId) -> Body:
    scenario = mission.scenario
    if me == SUPERVISOR:
        return Body(Pose(*scenario.supervisor_m))
    x_m, y_m = mission.starts.open("<f8", 2)[scenario.robot_ids.index(me)].tolist()
    return Body(Pose(x_m, y_m))
