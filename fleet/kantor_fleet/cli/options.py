"""Checks of options that several verbs have."""

from typing import TYPE_CHECKING

from kantor_fleet.exits import Exit, fail

if TYPE_CHECKING:
    from kantor_protocol.scenario.schema import Scenario


def check_seed(seed: int) -> None:
    """Refuse a seed that is not a whole number of 63 bits."""
    if not 0 <= seed < 2**63:
        fail(Exit.USAGE, f"--seed {seed}: give a whole number from 0 to 2^63 - 1")


def check_speed(speed: float) -> None:
    """Refuse a speed factor out of bounds."""
    if not 0.0 < speed <= 1000.0:
        fail(Exit.USAGE, f"--speed {speed:g}: give a factor above 0, at most 1000")


def exact_period(scenario: "Scenario", every: int, exchange: str, *, exact: bool) -> int | None:
    """Periods between exact distances, 0 for the end only, None for none."""
    from kantor_worldsim.observers.metrics.wasserstein_exact import AFFORDABLE, available  # noqa: PLC0415

    if not exact and not every:
        return None
    if every < 0:
        fail(Exit.USAGE, f"--exact-every {every}: give a number of periods")
    if every and exchange == "wall":
        fail(Exit.USAGE, "--exact-every: not on the wall, it would hold the relay up; use --exact")
    if not available():
        fail(Exit.USAGE, "--exact: needs POT; pip install 'kantor[exact]'")
    if scenario.energy.points * (scenario.samples.count or 1) > AFFORDABLE:
        fail(Exit.USAGE, "--exact: too many points and samples; at most 4e8 pairs")
    return every
