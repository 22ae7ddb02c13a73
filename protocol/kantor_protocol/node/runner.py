"""The shell of a participant's process: it turns messages into steps and steps into messages.

It makes no decision. In the lockstep exchange it steps when world-sim requests a step. In the realtime exchange it
steps when its own clock says so, with what has arrived by then, and waits for no other participant; but only once
world-sim has accepted its last step. Until then it *holds*: it makes no move and spends nothing (the lost-link
failsafe, which needs no peer), and repeats its last report now and then.

It survives the end of its process (`recovery.py`): inputs are written to the write-ahead log ahead of each step.
While the log cannot be written it makes no step; it holds until the log can be written again.
"""

import contextlib
import secrets
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from kantor_protocol.base.machine import Body, Inputs, Outputs, StateMachine
from kantor_protocol.node import memory_trim
from kantor_protocol.node.recovery import RecoverableNode
from kantor_protocol.node.signing import Signing
from kantor_protocol.node.wal import WalFile
from kantor_protocol.node.wall_clock import WallClock
from kantor_protocol.storage import private_files
from kantor_protocol.transport.client import ParticipantSession, participant_session
from kantor_protocol.transport.credentials import Identity, signing_key
from kantor_protocol.wire.messages import (
    VERSION,
    Mission,
    PoseMessage,
    Ready,
    Refusal,
    RefusedError,
    Report,
    StartClock,
    StepRequest,
    Stop,
    ToParticipant,
    decode_to_participant,
    encode,
)

BuildForMission = Callable[[Mission, Body], StateMachine]
"""Builds the machine for a mission as it is when it takes a body over."""


RETRY_S = 0.2
"""A report that is not acknowledged is repeated after so long, and a write that failed is tried again."""


class RejectedError(RuntimeError):
    """World-sim does not let this process take part; the message says why."""


class StateError(RuntimeError):
    """No write-ahead log can be kept; the message is one line with the remedy."""


def participate(
    connect: str,
    identity: Identity,
    build: BuildForMission,
    connect_timeout_s: float,
    notify: Callable[[str], None],
    state: Path,
    lease_ms: int | None = None,
) -> str:
    """Take part in missions until world-sim sends Stop; the reason in it.

    connect_timeout_s: how long to wait for world-sim. notify: takes one line of text for the operator. state: folder
    of the write-ahead log. lease_ms: after which this process is missed. Raises BusError, RejectedError, StateError.
    """
    _check_writable(state)
    nonce = secrets.token_hex(8)
    with participant_session(connect, identity, nonce, connect_timeout_s, lease_ms) as session:
        notify(f"{identity.user}: on the bus at {connect}, waiting for a mission")
        return _Runner(session, identity, build, notify, state).run()


def _check_writable(state: Path) -> None:
    try:
        private_files.make_folder(state)
        tempfile.TemporaryFile(dir=state).close()
    except OSError as error:
        reason = error.strerror or error
        raise StateError(
            f"{state}: no write-ahead log can be kept there ({reason}); choose another --state"
        ) from None


class _Runner:
    def __init__(
        self,
        session: ParticipantSession,
        identity: Identity,
        build: BuildForMission,
        notify: Callable[[str], None],
        state: Path,
    ) -> None:
        self._session = session
        self._me = identity.user
        self._identity = identity
        self._build = build
        self._notify = notify
        self._path = state / f"{identity.user}.diary"
        self._mission: Mission | None = None
        self._wal: WalFile | None = None
        self._node: RecoverableNode | None = None
        self._requested: Inputs | None = None
        """Lockstep: the inputs of the step request that has not been answered."""
        self._clock: WallClock | None = None
        """Realtime: the own clock, once it is started."""
        self._unwritable = False
        """The write-ahead log could not be written when that was last tried."""
        self._published = 0
        """Steps of this process."""
        self.refused = 0
        """Messages from world-sim that could not be decoded."""

    def run(self) -> str:
        while True:
            message = self._next_message()
            if isinstance(message, Stop):
                return message.reason
            if message is not None:
                self._handle(message)
            try:
                self._make_due_step()
            except OSError as error:
                self._report_unwritable(error)

    def _next_message(self) -> ToParticipant | None:
        timeout_s = RETRY_S if self._unwritable else None
        if self._clock is not None:
            until_due_s = self._clock.until_due_s()
            timeout_s = until_due_s if timeout_s is None else min(timeout_s, until_due_s)
            timeout_s = min(timeout_s, RETRY_S) if self._unacknowledged else timeout_s
        payload = self._session.next(timeout_s)
        if payload is None:
            return None
        try:
            return decode_to_participant(payload)
        except RefusedError:
            self.refused += 1
            return None

    def _handle(self, message: ToParticipant) -> None:
        if isinstance(message, StepRequest):
            if self._clock is not None:
                self._clock.enqueue(message.inputs)
            else:
                self._requested = message.inputs
        elif isinstance(message, Stop) or message.nonce != self._session.nonce:
            return
        elif isinstance(message, Refusal):
            raise RejectedError(f"{self._me}: {message.reason}")
        elif isinstance(message, Mission):
            self._accept_mission(message)
        elif self._mission is not None and self._node is not None:
            self._set_clock(message, self._mission)

    def _accept_mission(self, mission: Mission) -> None:
        """Prepare for a mission; for the one that it has already, answer that it is ready."""
        ours = self._mission
        if ours is not None and ours.run == mission.run and self._covers(mission.body):
            self._send_ready()
            return
        self._check_key(mission)
        self._mission, self._node, self._clock, self._requested = mission, None, None, None
        self._notify(f"{self._me}: mission {mission.scenario.name}, seed {mission.seed}")

    def _check_key(self, mission: Mission) -> None:
        """Raise RejectedError if nobody would believe this participant."""
        if not mission.scenario.signed:
            return
        if mission.keys.get(self._me) != signing_key(self._identity).public:
            raise RejectedError(
                f"{self._me}: this mission knows it by another key; "
                "use the credentials that the mission began with, or begin another"
            )

    def _build_signing(self, mission: Mission, body: Body) -> StateMachine:
        """The machine for a mission; what it attests is signed on its way out, again after a recovery."""
        machine = self._build(mission, body)
        if not mission.scenario.signed:
            return machine
        return Signing(machine, mission.run, signing_key(self._identity))

    def _covers(self, body: Body) -> bool:
        """Whether the node is as far as world-sim's knowledge, or farther."""
        node = self._node
        return node is not None and (node.incarnation, node.step_count) >= (
            body.incarnation,
            body.step,
        )

    def _make_due_step(self) -> None:
        """Recover if that is due, and make the step that is. Raises OSError if it cannot be written ahead."""
        if self._mission is None:
            return
        if self._node is None:
            self._recover(self._mission)
        if self._requested is not None and self._node is not None:
            outputs, now_ns = self._node.step(self._requested), self._requested.now_ns
            self._requested = None
            self._session.send(encode(Report(VERSION, self._session.nonce, outputs)), blocking=True)
            self._publish(outputs, now_ns)
        if self._clock is not None:
            self._step_by_own_clock(self._clock)
        self._unwritable = False

    def _report_unwritable(self, error: OSError) -> None:
        if not self._unwritable:
            with contextlib.suppress(OSError):  # the output may be on the same disk
                self._notify(
                    f"{self._me}: holds, its write-ahead log cannot be written: {error.strerror}"
                )
        self._unwritable = True

    def _recover(self, mission: Mission) -> None:
        """Go on from the write-ahead log, or begin a new one."""
        if self._wal is not None:
            self._wal.close()
        self._wal = WalFile(self._path, mission.run)
        node = RecoverableNode(partial(self._build_signing, mission), self._wal, mission.body)
        self._node = node
        if node.step_count:
            how = "begins" if node.incarnation > mission.body.incarnation else "goes on as"
            self._notify(
                f"{self._me}: {how} incarnation {node.incarnation}, from step {node.step_count}"
            )
        self._send_ready()

    def _send_ready(self) -> None:
        node = self._node
        if node is not None:
            now_ns = 0 if self._clock is None else self._clock.now_ns
            ready = Ready(VERSION, self._session.nonce, node.incarnation, node.step_count, now_ns)
            self._session.send(encode(ready), blocking=True)

    # Realtime: steps by the own clock.

    def _set_clock(self, message: StartClock, mission: Mission) -> None:
        """Start the clock; or, if it runs, set the one that the machine reads."""
        if self._clock is None and message.observation is not None:
            self._clock = WallClock(mission, self._me, message)
        elif self._clock is not None:
            self._clock.skew_ns = message.skew_ns
            if message.observation is not None:
                self._clock.enqueue(Inputs(message.now_ns, message.observation))
            self._clock.reported_ns = 0

    @property
    def _unacknowledged(self) -> bool:
        """Whether world-sim has not yet accepted the last step, as far as is known."""
        node, clock = self._node, self._clock
        return node is not None and clock is not None and node.step_count > clock.accepted_step

    def _step_by_own_clock(self, clock: WallClock) -> None:
        node, wal = self._node, self._wal
        if node is None or wal is None:
            return
        now_ns = clock.now_ns
        if clock.is_due(now_ns) and clock.accepted_step == node.step_count:
            wal.skew_ns = clock.skew_ns
            outputs = node.step(clock.inputs(now_ns))
            clock.inbox.clear()
            self._report_last_step(wal.skew_ns, clock)
            self._publish(outputs, now_ns)
        elif self._unacknowledged and clock.since_report_s >= RETRY_S:
            self._report_last_step(wal.skew_ns, clock)

    def _report_last_step(self, skew_ns: int, clock: WallClock) -> None:
        """Send the report of the last step. skew_ns: of the clock when it was made."""
        if self._node is None or self._node.last_step is None:
            return
        inputs, outputs = self._node.last_step
        received = tuple((envelope.source, envelope.sequence) for envelope in inputs.inbox)
        report = Report(
            VERSION,
            self._session.nonce,
            outputs,
            inputs.now_ns - skew_ns,
            received,
            inputs.observation.step,
            skew_ns,
        )
        # It is repeated until it is acknowledged, so it need not wait for a world-sim that is slow to receive.
        self._session.send(encode(report), blocking=False)
        clock.reported_ns = time.monotonic_ns()

    def _publish(self, outputs: Outputs, now_ns: int) -> None:
        """Publish pose and weights for observers."""
        self._session.publish_pose(encode(PoseMessage(VERSION, outputs.step, now_ns, outputs.pose)))
        if outputs.weights:
            self._session.publish_weights(outputs.weights)
        self._published += 1
        # Kernels are loaded by the first steps, and now and then by a later one.
        if self._published.bit_count() == 1:
            memory_trim.release_file_pages()
