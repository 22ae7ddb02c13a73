"""The shell of a participant's process: it turns messages into steps and steps into messages.

It makes no decision. In the lockstep exchange it steps when world-sim says so. In the wall exchange it
steps when its own clock says so, with whatever has arrived by then, and waits for nobody; but only from where
the world has accepted its last step. Until then it *holds*: it makes no move and spends nothing (the
lost-link failsafe, which needs no peer), and says again now and then what it did last.

It outlives its process (`life.py`): what it is given is noted in its diary ahead of each step. What cannot be
noted is not done; it holds until it can be.
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
from kantor_protocol.node.wal import WalFile
from kantor_protocol.node.wall_clock import WallClock
from kantor_protocol.transport.client import ParticipantSession, participant_session
from kantor_protocol.transport.credentials import Identity
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

Build = Callable[[Mission, Body], StateMachine]
"""Makes the machine for a mission as it is when it takes a body over."""


RETRY_S = 0.2
"""After so long, what has not been heard is said again, and what could not be noted is tried again."""


class RejectedError(RuntimeError):
    """World-sim does not let this process take part; the message says why."""


class StateError(RuntimeError):
    """There is nowhere to keep a diary; the message is one line with the remedy."""


def participate(
    connect: str,
    identity: Identity,
    build: Build,
    patience_s: float,
    say: Callable[[str], None],
    state: Path,
) -> str:
    """Take part in missions until world-sim says stop; the reason it gave.

    say: takes one line of news for a person. state: folder of the diary. Raises BusError, NotWantedError,
    StateError.
    """
    _check_writable(state)
    nonce = secrets.token_hex(8)
    with participant_session(connect, identity, nonce, patience_s) as line:
        say(f"{identity.user}: on the bus at {connect}, waiting for a mission")
        return _Node(line, identity, build, say, state).run()


def _check_writable(state: Path) -> None:
    try:
        state.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=state).close()
    except OSError as error:
        reason = error.strerror or error
        raise StateError(
            f"{state}: no diary can be kept there ({reason}); choose another --state"
        ) from None


class _Node:
    def __init__(
        self,
        line: ParticipantSession,
        identity: Identity,
        build: Build,
        say: Callable[[str], None],
        state: Path,
    ) -> None:
        self._line = line
        self._me = identity.user
        self._build = build
        self._say = say
        self._path = state / f"{identity.user}.diary"
        self._mission: Mission | None = None
        self._wal: WalFile | None = None
        self._life: RecoverableNode | None = None
        self._owed: Inputs | None = None
        """Lockstep: the turn that has not been answered."""
        self._wall: WallClock | None = None
        self._cannot = False
        """The diary could not be written when that was last tried."""
        self._shown = 0
        """Steps of this process."""
        self.refused = 0
        """Messages from world-sim that could not be read."""

    def run(self) -> str:
        while True:
            message = self._next()
            if isinstance(message, Stop):
                return message.reason
            if message is not None:
                self._handle(message)
            try:
                self._act()
            except OSError as error:
                self._hold(error)

    def _next(self) -> ToParticipant | None:
        timeout_s = RETRY_S if self._cannot else None
        if self._wall is not None:
            until_due_s = self._wall.until_due_s()
            timeout_s = until_due_s if timeout_s is None else min(timeout_s, until_due_s)
            timeout_s = min(timeout_s, RETRY_S) if self._unheard else timeout_s
        payload = self._line.next(timeout_s)
        if payload is None:
            return None
        try:
            return decode_to_participant(payload)
        except RefusedError:
            self.refused += 1
            return None

    def _handle(self, message: ToParticipant) -> None:
        if isinstance(message, StepRequest):
            if self._wall is not None:
                self._wall.enqueue(message.inputs)
            else:
                self._owed = message.inputs
        elif isinstance(message, Stop) or message.nonce != self._line.nonce:
            return
        elif isinstance(message, Refusal):
            raise RejectedError(f"{self._me}: {message.reason}")
        elif isinstance(message, Mission):
            self._prepare(message)
        elif self._mission is not None and self._life is not None:
            self._go(message, self._mission)

    def _prepare(self, mission: Mission) -> None:
        """Get ready for a mission; for the one that it has already, say so."""
        ours = self._mission
        if ours is not None and ours.run == mission.run and self._goes_as_far_as(mission.body):
            self._tell_ready()
            return
        self._mission, self._life, self._wall, self._owed = mission, None, None, None
        self._say(f"{self._me}: mission {mission.scenario.name}, seed {mission.seed}")

    def _goes_as_far_as(self, body: Body) -> bool:
        life = self._life
        return life is not None and (life.incarnation, life.step_count) >= (
            body.incarnation,
            body.step,
        )

    def _act(self) -> None:
        """Do what is due. Raises OSError if it cannot be noted."""
        if self._mission is None:
            return
        if self._life is None:
            self._live(self._mission)
        if self._owed is not None and self._life is not None:
            outputs, now_ns = self._life.step(self._owed), self._owed.now_ns
            self._owed = None
            self._line.send(encode(Report(VERSION, self._line.nonce, outputs)), patiently=True)
            self._show(outputs, now_ns)
        if self._wall is not None:
            self._act_by_own_clock(self._wall)
        self._cannot = False

    def _hold(self, error: OSError) -> None:
        if not self._cannot:
            with contextlib.suppress(OSError):  # the log may be on the same disk
                self._say(f"{self._me}: holds, its diary cannot be written: {error.strerror}")
        self._cannot = True

    def _live(self, mission: Mission) -> None:
        """Go on from the diary, or begin one."""
        if self._wal is not None:
            self._wal.close()
        self._wal = WalFile(self._path, mission.run)
        self._life = RecoverableNode(partial(self._build, mission), self._wal, mission.body)
        if self._life.step_count:
            came = (
                "new incarnation"
                if self._life.incarnation > mission.body.incarnation
                else "goes on"
            )
            self._say(
                f"{self._me}: {came}, epoch {self._life.incarnation}, step {self._life.step_count}"
            )
        self._tell_ready()

    def _tell_ready(self) -> None:
        life = self._life
        if life is not None:
            now_ns = 0 if self._wall is None else self._wall.now_ns
            ready = Ready(VERSION, self._line.nonce, life.incarnation, life.step_count, now_ns)
            self._line.send(encode(ready), patiently=True)

    # Wall: the own clock.

    def _go(self, go: StartClock, mission: Mission) -> None:
        """Start the clock; or, if it runs, set the one that the machine reads."""
        if self._wall is None and go.observation is not None:
            self._wall = WallClock(mission, self._me, go)
        elif self._wall is not None:
            self._wall.skew_ns = go.skew_ns
            if go.observation is not None:
                self._wall.enqueue(Inputs(go.now_ns, go.observation))
            self._wall.said_ns = 0

    @property
    def _unheard(self) -> bool:
        life, wall = self._life, self._wall
        return life is not None and wall is not None and life.step_count > wall.accepted

    def _act_by_own_clock(self, wall: "WallClock") -> None:
        life, wal = self._life, self._wal
        if life is None or wal is None:
            return
        now_ns = wall.now_ns
        if wall.is_due(now_ns) and wall.accepted == life.step_count:
            wal.skew_ns = wall.skew_ns
            inputs = wall.inputs(now_ns)
            outputs = life.step(inputs)
            wall.inbox.clear()
            self._report(wal.skew_ns, wall)
            self._show(outputs, now_ns)
        elif self._unheard and wall.silent_s >= RETRY_S:
            self._report(wal.skew_ns, wall)

    def _report(self, skew_ns: int, wall: "WallClock") -> None:
        """Say what it did last. skew_ns: of its clock when it did."""
        if self._life is None or self._life.unheard is None:
            return
        inputs, outputs = self._life.unheard
        heard = tuple((envelope.source, envelope.sequence) for envelope in inputs.inbox)
        report = Report(
            VERSION,
            self._line.nonce,
            outputs,
            inputs.now_ns - skew_ns,
            heard,
            inputs.observation.step,
            skew_ns,
        )
        # It is said again until it is heard, so it need not wait for a world that is slow to listen.
        self._line.send(encode(report), patiently=False)
        wall.said_ns = time.monotonic_ns()

    def _show(self, outputs: Outputs, now_ns: int) -> None:
        """Tell observers."""
        self._line.publish_pose(encode(PoseMessage(VERSION, outputs.step, now_ns, outputs.pose)))
        if outputs.weights:
            self._line.publish_weights(outputs.weights)
        self._shown += 1
        # Kernels are loaded by the first steps, and now and then by a later one.
        if self._shown.bit_count() == 1:
            memory_trim.release_file_pages()
