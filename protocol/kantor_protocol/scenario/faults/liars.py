"""Faults of what robots say: a participant that has gone over to the enemy, with valid credentials.

Its body, its energy and its processes are as sound as ever; it lies in what it tells the others, from within its own
process (`kantor_agent/robots/byzantine.py`). So the same lies are told in every exchange.
"""

from collections.abc import Iterable
from typing import Annotated, Literal, get_args

from msgspec import Meta

from kantor_protocol.base.machine import ParticipantId
from kantor_protocol.scenario.faults.base import Fault, Names

Lie = Literal["overstate", "rewrite", "fork", "claim", "teleport", "silence"]
LIES: tuple[Lie, ...] = get_args(Lie)
FALSE_LOGS: tuple[Lie, ...] = ("overstate", "fork")
"""Lies by which the own log is not what was consumed, or seen."""


class Byzantine(Fault, frozen=True, kw_only=True, tag="byzantine"):
    """A robot that lies within the window. What it has written into its own log by then it stands by later."""

    who: Annotated[Names, Meta(min_length=1)]
    """Robots."""
    lie: Lie
    """overstate: each entry of its log ships a whole point to a sample that is drawn. rewrite: it changes the logs,
    claims and registers of others that it passes on, and invents more. fork: it shows some receivers another log of
    its own than the others, and later the other way round. claim: it claims the samples of others as if it had come
    first, and claims and writes registers in their names. teleport: it reports poses that it cannot have reached.
    silence: it sends nothing to some, now to these, then to those."""


def lies_of(who: ParticipantId, faults: Iterable[Fault]) -> tuple[Byzantine, ...]:
    """The lies that a participant tells."""
    return tuple(each for each in faults if isinstance(each, Byzantine) and who in each.who)


def liars_of(faults: Iterable[Fault], *lies: Lie) -> frozenset[ParticipantId]:
    """All participants that lie, or that tell one of these lies."""
    told = (each for each in faults if isinstance(each, Byzantine))
    return frozenset(name for each in told if not lies or each.lie in lies for name in each.who)
