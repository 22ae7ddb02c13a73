"""Faults of processes that cannot go together are refused."""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.scenario.dump import to_tree
from kantor_protocol.scenario.errors import ScenarioError
from kantor_protocol.scenario.load import from_tree
from support.strategies import examples, mission

Entry = dict[str, Any]
"""A fault as a table."""


def process_fault(kind: str, who: str, *window: float, **more: Any) -> Entry:
    """A fault of one process within a window."""
    return {
        "kind": kind,
        "who": [who],
        **dict(zip(("from_s", "until_s"), window, strict=False)),
        **more,
    }


def kill(who: str, *window: float, **more: Any) -> Entry:
    return process_fault("kill", who, *window, **more)


TOGETHER = {
    "two kills": (
        (kill("r1", 1, 3), kill("r1", 2, 4)),
        "faults[1].who: r1 has a kill then already, by faults[0]; move one of the two",
    ),
    "two kills in reverse order": (
        (kill("r1", 2, 4), kill("r1", 1, 3)),
        "faults[1].who: r1 has a kill then already, by faults[0]; move one of the two",
    ),
    "kill of a process that is down": (
        (kill("r2", 1), kill("r1", 1), kill("r2", 9, 10)),
        "faults[2].who: r2 has a kill then already, by faults[0]; move one of the two",
    ),
    "pause of a process that is down": (
        (kill("r1", 1, 3), process_fault("pause", "r1", 2, 4)),
        "faults[1].who: r1 has a kill then already, by faults[0]; move one of the two",
    ),
    "kill of a late joiner": (
        (process_fault("late", "r1", 0, 2), kill("r1", 1, 3)),
        "faults[1].who: r1 has a late then already, by faults[0]; move one of the two",
    ),
    "paused and slow": (
        (process_fault("slow", "r1", every=2), process_fault("pause", "r1", 2, 4)),
        "faults[1].who: r1 has a slow then already, by faults[0]; move one of the two",
    ),
    "kill with a full disk": (
        (process_fault("full-disk", "r1", 1, 3), kill("r1", 2)),
        "faults[1].who: r1 has a full-disk then already, by faults[0]; move one of the two",
    ),
    "kill and pause of world-sim": (
        (kill("worldsim", 1, 3), process_fault("pause", "worldsim", 2, 4)),
        "faults[1].who: worldsim has a kill then already, by faults[0]; move one of the two",
    ),
    "kill while world-sim is down": (
        (kill("worldsim", 1, 3), kill("r1", 2, 4)),
        "faults[1]: world-sim is down at from_s of a kill, see faults[0]; move it",
    ),
    "restart while world-sim is paused": (
        (kill("r1", 1, 3), process_fault("pause", "worldsim", 2, 4)),
        "faults[1]: world-sim is down at until_s of a kill, see faults[0]; move it",
    ),
    "impostor of a process that is down": (
        (process_fault("impostor", "r1", 2), kill("r1", 1, 3)),
        "faults[1]: r1 is away when its impostor joins, which would be admitted, see faults[0]; move it",
    ),
}


def refusal_of(faults: Sequence[Entry], *overrides: str) -> str:
    """The refusal of a list of faults; empty if there is none."""
    try:
        from_tree({**to_tree(mission(*overrides)), "faults": list(faults)}, "small")
    except ScenarioError as error:
        return str(error).removeprefix("small: ")
    return ""


@pytest.mark.parametrize("name", TOGETHER)
def test_what_cannot_go_together_is_refused(name: str) -> None:
    faults, message = TOGETHER[name]

    assert refusal_of(faults) == message


@pytest.mark.parametrize(
    "faults",
    [
        (kill("r1", 1, 3), kill("r1", 3, 4)),
        (kill("r1", 1, 3), kill("r2", 2, 4)),
        (kill("r1", 1, 3), process_fault("clock", "r1", 2, 4, offset_s=1.0)),
        (kill("r1", 1, 3), process_fault("impostor", "r1", 3)),
        (kill("worldsim", 1, 3), kill("r1", 3, 4)),
        (kill("r1", 1, 5), process_fault("pause", "worldsim", 2, 4)),
        (process_fault("pause", "worldsim", 1, 3), process_fault("pause", "r1", 2, 4)),
    ],
)
def test_what_can_go_together_is_a_mission(faults: tuple[Entry, ...]) -> None:
    assert refusal_of(faults) == ""


WINDOWS = st.tuples(st.integers(0, 8), st.integers(1, 4)).map(lambda w: (w[0], w[0] + w[1]))


@examples(100)
@given(windows=st.lists(WINDOWS, min_size=1, max_size=4), pauses=st.sets(st.integers(0, 3)))
def test_no_process_is_stopped_twice_at_once(
    windows: list[tuple[int, int]], pauses: set[int]
) -> None:
    """Refused if, and only if, two windows share a moment."""
    faults = [
        process_fault("pause" if i in pauses else "kill", "r2", *window)
        for i, window in enumerate(windows)
    ]
    shared = any(one[0] < two[1] and two[0] < one[1] for one, two in combinations(windows, 2))

    assert bool(refusal_of(faults)) == shared
