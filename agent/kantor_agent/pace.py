"""How far a robot may go in a step, by a clock that may be wrong."""

from kantor_protocol.machine import Body


class Pace:
    """The time that a robot moves for: what has passed since its last step, at most a period.

    Nothing has passed on a clock that stands or runs back. Who takes over a body on its way does not know
    when it last moved, and holds for a step.
    """

    def __init__(self, period_ns: int, body: Body) -> None:
        self._period_ns = period_ns
        self._before_ns = 0 if body.step == 0 else None

    def elapsed_s(self, now_ns: int) -> float:
        """Since the step before; asked once in a step."""
        before_ns = now_ns if self._before_ns is None else self._before_ns
        self._before_ns = now_ns
        return max(0, min(now_ns - before_ns, self._period_ns)) * 1e-9
