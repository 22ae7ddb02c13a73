"""Options that several verbs have: their checks, and the exchange's name on record."""

from typing import TYPE_CHECKING, Literal

from kantor_fleet.exits import Exit, fail

if TYPE_CHECKING:
    from kantor_protocol.scenario.schema import Scenario

ProcessExchange = Literal["lockstep", "realtime", "wall"]
"""Exchanges with one process for each participant, as options name them; wall is an alias of realtime."""
AnyExchange = Literal["in-process", ProcessExchange]
_RECORDED = {"realtime": "wall"}


def recorded(exchange: AnyExchange) -> str:
    """The name of an exchange in records, manifests, messages and result.json, where realtime is `wall`.

    Everything behind the command line uses this name.
    """
    return _RECORDED.get(exchange, exchange)


def check_seed(seed: int) -> None:
    """Refuse a seed that is not a whole number of 63 bits."""
    if not 0 <= seed < 2**63:
        fail(Exit.USAGE, f"--seed {seed}: give a whole number from 0 to 2^63 - 1")


def check_speed(speed: float) -> None:
    """Refuse a speed factor out of bounds."""
    if not 0.0 < speed <= 1000.0:
        fail(Exit.USAGE, f"--speed {speed:g}: give a factor above 0, at most 1000")


def exact_period(
    scenario: "Scenario", every: int, exchange: AnyExchange, *, exact: bool
) -> int | None:
    """Periods between exact distances, 0 for the end only, None for none."""
    from kantor_worldsim.observers.metrics.wasserstein_exact import AFFORDABLE, available  # noqa: PLC0415

    if not exact and not every:
        return None
    if every < 0:
        fail(Exit.USAGE, f"--exact-every {every}: give a number of periods")
    if every and recorded(exchange) == "wall":
        fail(
            Exit.USAGE, "--exact-every: not in realtime, where it would delay messages; use --exact"
        )
    if not available():
        fail(Exit.USAGE, "--exact: needs POT; pip install 'kantor[exact]'")
    if scenario.energy.points * (scenario.samples.count or 1) > AFFORDABLE:
        fail(Exit.USAGE, "--exact: too many points and samples; at most 4e8 pairs")
    return every
