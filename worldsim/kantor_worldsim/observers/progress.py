"""How a mission goes, for observers."""

from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import VERSION, Progress
from kantor_worldsim.observers.metrics.base import RunMetrics


def progress(metrics: RunMetrics, scenario: Scenario, phase: str, detail: str) -> Progress:
    """How a mission goes, for observers."""
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
