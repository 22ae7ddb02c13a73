"""How a mission goes, for observers."""

from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire.messages import VERSION, Progress
from kantor_worldsim.observers.metrics.base import RunMetrics


def progress(metrics: RunMetrics, scenario: Scenario, phase: str, detail: str) -> Progress:
    """How a mission goes, for observers."""
    glance = metrics.glance()
    energy_total = 0 if scenario.mapping else scenario.steps_per_robot * scenario.robots.count
    return Progress(
        VERSION,
        now_ns=glance.now_ns,
        phase=phase,
        detail=detail,
        energy_spent=glance.energy_spent,
        energy_total=energy_total,
        detected=glance.detected,
        targets=glance.targets,
        w_ub=glance.w_ub,
        links=glance.links,
        messages_per_s=glance.messages_per_s,
        robots_done=glance.robots_done,
        robots=scenario.robots.count,
        mass_left=glance.mass_left,
        distance_m=glance.distance_m,
    )
