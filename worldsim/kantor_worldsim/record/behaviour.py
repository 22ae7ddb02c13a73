"""Versions of behaviour: what missions do with the same scenario and seed.

A manifest has the version under which its run was recorded; manifests without one are of version 1. The record of an
earlier version can be read, measured and drawn as ever. Executed again it may differ where behaviour has changed since,
and `kantor verify` then says what has changed instead of calling the record broken.

Whoever changes what missions do adds a line to `CHANGES`: the next version, with what has changed in it.
"""

from collections.abc import Callable
from typing import NamedTuple

from kantor_protocol.scenario.schema import Scenario

FIRST = 1
"""The version of manifests that name none."""


def _every(_scenario: Scenario) -> bool:
    return True


class Change(NamedTuple):
    """A change of behaviour."""

    what: str
    """What is different, in a few words."""
    concerns: Callable[[Scenario], bool] = _every
    """Whether it can show in a mission."""


CHANGES: dict[int, Change] = {
    2: Change(
        "robots on a map give targets up by distance instead of steps, log bumps, and with noisy ranges look longer",
        lambda scenario: scenario.mapping,
    ),
    3: Change(
        "the mean of a mixture over a mode is rounded, so that all processors agree",
        lambda scenario: scenario.planner.name == "spectral",
    ),
}
"""By the version that came with it."""


def current() -> int:
    """The version of this code."""
    return max(CHANGES, default=FIRST)


def changes_since(version: int, scenario: Scenario) -> str:
    """What has changed for a mission since a version, as one line; empty if nothing has."""
    since = sorted(item for item in CHANGES.items() if item[0] > version)
    return "; ".join(
        f"({number}) {change.what}" for number, change in since if change.concerns(scenario)
    )
