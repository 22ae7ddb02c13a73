"""Planners on densities, by the name that `planner.name` has in a scenario.

To add one: a module of its own in this folder, with a class whose `choose` is that of `base.Planner`; an entry in
`PLANNERS`; its name in `PlannerName` in `kantor_protocol/scenario/schema.py`; and a test. Options are fields of
`PlannerOptions` there. No planner imports another (`docs/planners.md`).

Planners on maps are in `map_registry.py`, apart from these: a robot on a density loads none of them.
"""

from collections.abc import Callable

from kantor_agent.planners.base import Planner
from kantor_agent.planners.spectral import Spectral
from kantor_agent.planners.transport import Transport
from kantor_protocol.scenario.schema import Scenario

PLANNERS: dict[str, Callable[[Scenario], Planner]] = {
    "transport": lambda scenario: Transport(scenario.planner.horizon),
    "spectral": Spectral,
}
"""Makes the planner of one robot from the scenario, which has the options in `planner`."""
