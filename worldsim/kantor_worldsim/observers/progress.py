"""Progress of a mission, for people and for observers on the bus."""

import time
from collections.abc import Callable

from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import VERSION, Progress
from kantor_worldsim.observers.metrics.base import RunMetrics
from kantor_worldsim.record.records import Record

PROGRESS_S = 0.2
"""Real seconds from one report to the next, at least."""


def progress(metrics: RunMetrics, scenario: Scenario, phase: str, detail: str) -> Progress:
    """Progress of a mission as its metrics have it now."""
    snapshot = metrics.snapshot()
    energy_total = 0 if scenario.mapping else scenario.steps_per_robot * scenario.robots.count
    return Progress(
        VERSION,
        now_ns=snapshot.now_ns,
        phase=phase,
        detail=detail,
        energy_spent=snapshot.energy_spent,
        energy_total=energy_total,
        detected=snapshot.detected,
        targets=snapshot.targets,
        w_ub=snapshot.w_ub,
        links=snapshot.links,
        messages_per_s=snapshot.messages_per_s,
        robots_done=snapshot.robots_done,
        robots=scenario.robots.count,
        mass_left=snapshot.mass_left,
        distance_m=snapshot.distance_m,
    )


class ProgressReporter:
    """Reports progress a few times a second. An observer of the mission's records while it runs."""

    def __init__(
        self,
        metrics: RunMetrics,
        scenario: Scenario,
        publish: Callable[[Progress], None],
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        """metrics: called before this observer for each record."""
        self._metrics = metrics
        self._scenario = scenario
        self._publish = publish
        self._monotonic = monotonic
        self._reported_s = 0.0
        self.running = False
        """Whether records are those of a mission in progress, and not of the past of a resumed one."""

    def observe(self, _record: Record) -> None:
        """Report that the mission runs."""
        if self.running:
            self.report("running", "")

    def report(self, phase: str, detail: str, *, at_once: bool = False) -> None:
        """Report a phase, unless the last report was a moment ago. at_once: even then."""
        now_s = self._monotonic()
        if at_once or now_s - self._reported_s >= PROGRESS_S:
            self._reported_s = now_s
            self._publish(progress(self._metrics, self._scenario, phase, detail))
