"""The clock of a participant in a realtime run: which of its steps is due, and what has arrived since the last."""

import time
from collections import deque

from kantor_protocol.base.machine import Envelope, Inputs
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.wire.messages import Mission, StartClock

INBOX_MAX = 4096
"""Envelopes that wait for a step of a participant that holds; the oldest make room."""


class WallClock:
    """A participant's own clock, and what has arrived since its last step."""

    def __init__(self, mission: Mission, name: str, go: StartClock) -> None:
        """The clock shows go.now_ns now."""
        assert go.observation is not None
        self.skew_ns = go.skew_ns
        self.inbox: deque[Envelope] = deque(maxlen=INBOX_MAX)
        self.said_ns = 0
        """When it last reported, by the monotonic clock."""
        self._observation = go.observation
        self._clock = step_clocks(mission.scenario, mission.seed)[name]
        self._speed = go.speed
        self._origin_ns = time.monotonic_ns() - round(go.now_ns / go.speed)
        self._ordinal = 1
        self._skip(go.now_ns)

    @property
    def now_ns(self) -> int:
        """True simulated time."""
        return round((time.monotonic_ns() - self._origin_ns) * self._speed)

    @property
    def accepted(self) -> int:
        """Its last step that the world has accepted, as far as it knows."""
        return self._observation.step

    @property
    def silent_s(self) -> float:
        """Real seconds since it last reported."""
        return (time.monotonic_ns() - self.said_ns) * 1e-9

    def until_due_s(self) -> float:
        """Real seconds until its next step."""
        return max(0.0, (self._clock.due_ns(self._ordinal) - self.now_ns) * 1e-9 / self._speed)

    def is_due(self, now_ns: int) -> bool:
        """Whether its next step is due; asked once for each. It does not catch up in a burst."""
        if now_ns < self._clock.due_ns(self._ordinal):
            return False
        self._skip(now_ns)
        return True

    def _skip(self, now_ns: int) -> None:
        while self._clock.due_ns(self._ordinal) <= now_ns:
            self._ordinal += 1

    def enqueue(self, inputs: Inputs) -> None:
        """Note what has arrived."""
        self.inbox += inputs.inbox
        if inputs.observation.step >= self._observation.step:
            self._observation = inputs.observation

    def inputs(self, now_ns: int) -> Inputs:
        """What it goes by in its next step. A clock shows no time before the start."""
        return Inputs(now_ns + self.skew_ns, self._observation, tuple(self.inbox))
