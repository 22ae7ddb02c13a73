"""The clock of a participant in a realtime run: which of its steps is due, and what has arrived since the last."""

import time
from collections import deque

from kantor_protocol.base.machine import Envelope, Inputs
from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.wire.messages import (
    INBOX_BYTES_MAX,
    INBOX_MAX,
    Mission,
    StartClock,
    envelope_bytes,
)


class WallClock:
    """A participant's own clock, and what has arrived since its last step."""

    def __init__(self, mission: Mission, name: str, start: StartClock) -> None:
        """name: the participant. The clock shows `start.now_ns` now."""
        assert start.observation is not None
        self.skew_ns = start.skew_ns
        """The lead of the clock that the machine reads over this one."""
        self.inbox: deque[Envelope] = deque(maxlen=INBOX_MAX)
        """Envelopes since the last step, in order of arrival; the oldest are dropped for newer ones."""
        self.reported_ns = 0
        """Time of the last report, by the monotonic clock."""
        self._observation = start.observation
        self._clock = step_clocks(mission.scenario, mission.seed)[name]
        self._speed = start.speed
        self._origin_ns = time.monotonic_ns() - round(start.now_ns / start.speed)
        self._ordinal = 1
        self._skip(start.now_ns)

    @property
    def now_ns(self) -> int:
        """True simulated time."""
        return round((time.monotonic_ns() - self._origin_ns) * self._speed)

    @property
    def accepted_step(self) -> int:
        """The participant's last step that world-sim has accepted, as far as is known."""
        return self._observation.step

    @property
    def since_report_s(self) -> float:
        """Real seconds since the last report."""
        return (time.monotonic_ns() - self.reported_ns) * 1e-9

    def until_due_s(self) -> float:
        """Real seconds until the next step."""
        return max(0.0, (self._clock.due_ns(self._ordinal) - self.now_ns) * 1e-9 / self._speed)

    def is_due(self, now_ns: int) -> bool:
        """Whether the next step is due; True once for each. Missed steps are not made up for in a burst."""
        if now_ns < self._clock.due_ns(self._ordinal):
            return False
        self._skip(now_ns)
        return True

    def _skip(self, now_ns: int) -> None:
        while self._clock.due_ns(self._ordinal) <= now_ns:
            self._ordinal += 1

    def enqueue(self, inputs: Inputs) -> None:
        """Add envelopes and the observation that have arrived. Of too many, the oldest are dropped."""
        self.inbox += inputs.inbox
        excess = sum(map(envelope_bytes, self.inbox)) - INBOX_BYTES_MAX
        while excess > 0:
            excess -= envelope_bytes(self.inbox.popleft())
        if inputs.observation.step >= self._observation.step:
            self._observation = inputs.observation

    def inputs(self, now_ns: int) -> Inputs:
        """The inputs of the next step."""
        return Inputs(now_ns + self.skew_ns, self._observation, tuple(self.inbox))
