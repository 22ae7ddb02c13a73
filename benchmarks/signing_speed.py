"""The cost of `trust = "signed"`: bytes on the radio, CPU time, and the time of one signature and of one check.

Missions run in process, open and signed in turn, with the same seed. All participants of one process share what has
been checked; on the bus each of them checks for itself, and `checked` says how often that would be.
"""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from fleet_speed import crowd
from msgspec.structs import replace
from tables import Table, verdict

from kantor_fleet.execution.in_process_team import team, team_identities
from kantor_fleet.execution.preload import warm_up
from kantor_fleet.scenarios.catalog import find
from kantor_protocol.scenario.schema import Scenario
from kantor_protocol.wire import signatures
from kantor_protocol.wire.signatures import SigningKey
from kantor_protocol.wire.signing_keys import CertificateKey, Ed25519Key
from kantor_worldsim.engine.event_loop import simulate
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.in_process import InProcessExchange
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup

MORE_BYTES_MAX = 10.0
"""On the radio, per robot and tick, in `fleet`."""
STATEMENT = bytes(range(100))


class Cost(NamedTuple):
    """The cost of one run, per robot and tick."""

    cpu_us: float
    bytes: float
    checked: float
    """Signatures that a process of its own for each participant would check."""


def measure(*, quick: bool) -> Table:
    """Medians over runs of the same seed."""
    warm_up()
    missions = [("fleet", find("fleet"))]
    if not quick:
        missions += [
            ("fleet, 400 m", find("fleet", ("radio.range_m=400",))),
            ("fleet, 700 m, lossy", find("fleet", ("radio.range_m=700", "radio.drop=0.3"))),
            ("centralized", find("paper-centralized-concurrent", ("merge=ledger", "claims=true"))),
            ("100 robots", crowd(150)),
        ]
    rows, met = [], True
    for name, scenario in missions:
        row, reached = _compared(name, scenario, repeats=1 if quick else 3)
        rows.append(row)
        met = met and (reached or name != "fleet")
    return Table(
        'signing: trust = "signed" beside "open", per robot and tick, in process',
        (
            "scenario",
            "B open",
            "B signed",
            "B more",
            "target",
            "",
            "us open",
            "us signed",
            "ratio",
            "checked",
        ),
        rows,
        _notes(),
        met,
    )


def _compared(name: str, scenario: Scenario, *, repeats: int) -> tuple[tuple[str, ...], bool]:
    """The row of a mission, and whether it is within the target."""
    pairs = [(_run(scenario), _run(replace(scenario, trust="signed"))) for _ in range(repeats)]
    one, signed = pairs[0]
    more = signed.bytes - one.bytes
    reached, bounded = more <= MORE_BYTES_MAX, name == "fleet"
    row = (
        name,
        f"{one.bytes:.1f}",
        f"{signed.bytes:.1f}",
        f"{more:.1f}",
        f"{MORE_BYTES_MAX:g}" if bounded else "",
        verdict(met=reached) if bounded else "",
        f"{statistics.median(pair[0].cpu_us for pair in pairs):.0f}",
        f"{statistics.median(pair[1].cpu_us for pair in pairs):.0f}",
        f"{statistics.median(pair[1].cpu_us / pair[0].cpu_us for pair in pairs):.2f}",
        f"{signed.checked:.3f}",
    )
    return row, reached


def _run(scenario: Scenario) -> Cost:
    """One recorded run, without setting up its robots. Raises RuntimeError when it broke a rule."""
    signatures.is_signed.cache_clear()
    setup = WorldSetup.of(scenario, 0)
    recording = Recording(scenario, 0, "in-process")
    simulation = Simulation(scenario, 0, setup, [recording.observe], team_identities(scenario, 0))
    exchange = InProcessExchange(team(scenario, 0, setup))
    start_s = time.process_time()
    simulate(simulation, exchange, 0, lambda: False, exchange)
    cpu_s = time.process_time() - start_s
    result = recording.finish()
    if result.violations:
        raise RuntimeError(f"{scenario.name}: {result.complaints[0]}")
    robot_ticks = result.ticks * result.robots
    found = signatures.is_signed.cache_info()
    return Cost(
        1e6 * cpu_s / robot_ticks,
        result.bytes_per_robot_tick.total - result.bytes_per_robot_tick.weights,
        (found.hits + found.misses) / robot_ticks,
    )


def _notes() -> tuple[str, ...]:
    pem = ec.generate_private_key(ec.SECP256R1()).private_bytes(
        Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()
    )
    kinds: dict[str, SigningKey] = {
        "Ed25519 (passwords, in process)": Ed25519Key(bytes(32)),
        "P-256 (certificates)": CertificateKey(pem),
    }
    return tuple(_speed(kind, key) for kind, key in kinds.items())


def _speed(kind: str, key: SigningKey) -> str:
    signature, check = key.sign(STATEMENT), signatures.is_signed.__wrapped__
    sign_us = _microseconds(lambda: key.sign(STATEMENT))
    check_us = _microseconds(lambda: check(key.public, STATEMENT, signature))
    return f"{kind}: {sign_us:.0f} us to sign, {check_us:.0f} us to check"


def _microseconds(call: Callable[[], object], times: int = 200) -> float:
    """CPU time of a call."""
    start_s = time.process_time()
    for _ in range(times):
        call()
    return 1e6 * (time.process_time() - start_s) / times
