"""The pace of a participant in the realtime exchange: the steps it can have made, and when it needs what it hears. Pure.

A participant steps when its own clock says so, at most once for each of the clock's times, and does not make up for
steps that it has missed. World-sim knows the clock, so that whoever was silent has no steps saved up.
"""

from kantor_protocol.scenario.clocks import StepClock

_AT_ONCE = 3.0
"""Steps that may come together, for instance because reports of one and a half periods were under way."""
_LEAD = 0.2
"""Part of a period."""
_FASTER = 1.02
"""A real clock may run a little fast."""


class Pace:
    """The steps that one participant has left."""

    def __init__(self, clock: StepClock, now_ns: int) -> None:
        """clock: the participant's. now_ns: true simulated time."""
        self._clock = clock
        period_ns = clock.period_ns * (1.0 + clock.drift_ppm * 1e-6)
        self._steps_per_ns = _FASTER / max(1.0, period_ns)
        self._steps = _AT_ONCE
        self._filled_ns = now_ns
        self._due_before = 0
        """Times of its clock that were due when it made its last step."""
        self._asked_ns, self._due = -1, 0
        """A time, and how many times of its clock are due by then."""
        self._lead_ns = round(_LEAD * clock.period_ns)

    def restart(self) -> None:
        """Another process may have set its clock anew, a little earlier."""
        self._due_before = 0

    def permits(self, made_ns: int, now_ns: int) -> bool:
        """Whether a step is possible that was made at made_ns by the participant's clock. now_ns: true time."""
        return self._steps_at(now_ns) >= 1.0 and self._due_by(made_ns) > self._due_before

    def count(self, made_ns: int, now_ns: int) -> None:
        """Count a step that was accepted."""
        self._steps = max(0.0, self._steps_at(now_ns) - 1.0)
        self._filled_ns, self._due_before = now_ns, self._due_by(made_ns)

    def delivery_ns(self, now_ns: int) -> int:
        """The time from which on it needs what has arrived at it, for the next step that its clock has from now on."""
        return self._clock.due_ns(self._clock.steps_by(now_ns) + 1) - self._lead_ns

    def _due_by(self, made_ns: int) -> int:
        if made_ns != self._asked_ns:
            self._asked_ns, self._due = made_ns, self._clock.steps_by(made_ns)
        return self._due

    def _steps_at(self, now_ns: int) -> float:
        return min(_AT_ONCE, self._steps + (now_ns - self._filled_ns) * self._steps_per_ns)
