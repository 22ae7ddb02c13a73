"""Bytes that a robot publishes in a tick, beside its whole weight vector as float64.

The paper's robots exchange their vectors; kantor's publish changes. Runs are in process and
exactly repeatable; over the bus the bytes are the same.
"""

from tables import Table, verdict

from kantor_fleet.execution.in_process_team import team
from kantor_fleet.scenarios.catalog import find
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup

SCENARIOS = (
    "paper-single",
    "paper-centralized",
    "paper-centralized-concurrent",
    "paper-decentralized",
    "paper-timeinvariant",
    "paper-timevarying",
    "fleet",
)
WEIGHTS_MAX = 8.0
"""Bytes on the weights key, per robot and tick."""


def measure(*, quick: bool) -> Table:
    """One seed each; three of the scenarios when quick."""
    rows, met = [], True
    for name in SCENARIOS[1:4] if quick else SCENARIOS:
        scenario = find(name)
        setup = WorldSetup.of(scenario, 0)
        recording = Recording(scenario, 0, "in-process")
        simulation = Simulation(scenario, 0, setup, [recording.observe])
        exchange = InProcessExchange(team(scenario, 0, setup))
        simulate(simulation, exchange, 0, lambda: False, exchange)
        wire = recording.finish().bytes_per_robot_tick
        whole = 8 * setup.samples_m.shape[0]
        reached = wire.weights <= WEIGHTS_MAX
        met = met and reached
        rows.append(
            (
                name,
                f"{setup.samples_m.shape[0]:,}",
                f"{wire.weights:.2f}",
                f"{WEIGHTS_MAX:g}",
                verdict(met=reached),
                f"{wire.total:.1f}",
                f"{whole:,}",
                f"{whole / wire.weights:,.0f}",
                f"{whole / wire.total:,.0f}",
            )
        )
    return Table(
        "wire: bytes per robot and tick",
        (
            "scenario",
            "N",
            "weights",
            "target",
            "verdict",
            "weights + radio",
            "float64 vector",
            "ratio",
            "ratio, all",
        ),
        rows,
        met=met,
    )
