"""A rare situation is seen where it happens, and not where it does not."""

import pytest

from kantor_fleet.campaign.mission import attempt
from kantor_fleet.campaign.rare_events import RARE_EVENTS
from kantor_fleet.execution.experiment import Case
from support.strategies import mission

TEAM = ("energy.points=240", "samples.count=60")
CENTRALIZED = ("coordination=centralized",)
SIGNED = ("trust=signed",)


def seen(*overrides: str, seed: int = 1) -> dict[str, int]:
    trial = attempt(Case(mission(*TEAM, *overrides), seed))
    assert trial.violation is None
    return trial.seen


def faults(*tables: str) -> str:
    return f"faults=[{', '.join('{' + table + '}' for table in tables)}]"


def kill(who: str, more: str = "", from_s: float = 2.0, until_s: float = 3.0) -> str:
    return f'kind="kill", who=["{who}"], from_s={from_s}, until_s={until_s} {more}'


def lie(told: str) -> str:
    return f'kind="byzantine", who=["r2"], lie="{told}", from_s=1.0, until_s=5.0'


WHERE: dict[str, tuple[str, ...]] = {
    "merge that removes the current goal": ("claims=false",),
    "one goal of two, left to one by a claim": ("samples.count=6",),
    "partition healed after both sides consumed one sample": (
        faults('kind="partition", shape="isolate", robots=["r1", "r2"], from_s=1.0, until_s=7.0'),
        "samples.count=6",
    ),
    "death between note and answer": (faults(kill("r1", ", mid_step=true")),),
    "restart during a partition": (
        faults(kill("r1"), 'kind="partition", shape="halves", from_s=1.0, until_s=4.0'),
    ),
    "two dead at once": (faults(kill("r1"), kill("r2", from_s=2.5)),),
    "supervisor killed with its word under way": (
        *CENTRALIZED,
        "radio.delay_s=0.3",
        faults(kill("supervisor")),
    ),
    "world-sim restarted with messages under way": (
        "radio.delay_s=0.3",
        faults(kill("worldsim")),
    ),
    "heard twice": (faults('kind="duplicate", probability=0.5, delay_s=0.5, until_s=5.0'),),
    "heard out of order": (faults('kind="reorder", probability=0.5, hold_s=1.0, until_s=5.0'),),
    "stale word after a restart": (
        faults(kill("r1"), 'kind="reorder", probability=0.5, hold_s=1.0, from_s=3.0, until_s=6.0'),
    ),
    "word of a former incarnation": (
        "radio.delay_s=2.0",
        faults(kill("r1", ', disk="lost"', until_s=2.5)),
    ),
    "hostile message refused": (faults('kind="hostile", probability=0.3, until_s=5.0'),),
    "late joiner knows all that was known": (faults('kind="late", who=["r2"], until_s=3.0'),),
    "log of a former incarnation came back": (faults(kill("r1", ', disk="lost"')),),
    "energy ended in contact": ("energy.steps=40",),
    "clock jumped back": (
        faults('kind="clock", who=["r1"], offset_s=60.0, from_s=2.0, until_s=4.0'),
    ),
    "supervisor given up": (*CENTRALIZED, faults(kill("supervisor", until_s=5.0))),
    "supervisor heard again after it was given up": (
        *CENTRALIZED,
        faults(kill("supervisor", until_s=5.0)),
    ),
    "message of a liar refused": (*SIGNED, faults(lie("rewrite"))),
    "word of a liar passed on": (*SIGNED, "radio.drop=0.5", faults(lie("overstate"))),
    "finished beside a liar": (*SIGNED, "energy.steps=200", faults(lie("teleport"))),
    "L1 judged": ("linger_s=10.0",),
    "L2 judged": (),
    "L3 judged": CENTRALIZED,
    "I8 judged": ("linger_s=10.0",),
}

_MAY_HAPPEN_ANYWHERE = {
    "merge that removes the current goal",
    "one goal of two, left to one by a claim",
    "energy ended in contact",
    "L2 judged",
}


def test_all_have_a_place() -> None:
    assert set(WHERE) == set(RARE_EVENTS)


@pytest.mark.parametrize("name", RARE_EVENTS)
def test_is_seen_where_it_happens(name: str) -> None:
    assert any(seen(*WHERE[name], seed=seed).get(name) for seed in range(1, 6))


def test_a_quiet_mission_shows_nothing_rare() -> None:
    assert set(seen()) <= _MAY_HAPPEN_ANYWHERE
