"""The barrier of lockstep: who is silent is not waited for, and is back as soon as it answers."""

from collections.abc import Callable
from typing import Any, cast

import pytest

from kantor_protocol.base.machine import Inputs, Observation, Outputs, Pose
from kantor_protocol.wire.messages import VERSION, Report, StepRequest
from kantor_worldsim.exchange.lobby import Lobby
from kantor_worldsim.exchange.lockstep import BARRIER_S, LockstepExchange
from kantor_worldsim.exchange.process_control import no_controller

HERE = Pose(0.0, 0.0)


class Team:
    """A lobby with participants that answer, or do not, and its clock."""

    def __init__(self, *roster: str) -> None:
        self.roster = roster
        self.mute: set[str] = set()
        self.now_s = 0.0
        self.reports: list[tuple[str, Report]] = []
        self.asked: list[tuple[str, bool]] = []
        """Who was asked, and whether that waited."""
        self.silences: list[str] = []
        self.left: set[str] = set()
        """Whose session has ended."""
        self.returns: dict[str, int] = {}
        self.lost: list[str] = []
        """Who was given up."""

    def monotonic(self) -> float:
        """The simulated time in seconds."""
        return self.now_s

    def is_expected(self, name: str) -> bool:
        """All that are there, or may come back."""
        return name in self.roster and name not in self.lost

    def is_ready(self, name: str) -> bool:
        """All that are there."""
        return self.is_expected(name) and name not in self.left

    def arrivals(self, name: str) -> int:
        """How often a participant came."""
        return self.returns.get(name, 1)

    def grant_reply(self, name: str) -> None:
        """Replies are not counted here."""

    def note_silence(self, name: str) -> None:
        """Keep the name."""
        self.silences.append(name)

    def has_left(self, name: str) -> bool:
        """Whether its session has ended."""
        return name in self.left

    def give_up(self, name: str) -> None:
        """It is not expected any more."""
        self.left.discard(name)
        self.lost.append(name)

    def forget_newcomers(self) -> None:
        """There are none."""

    def next(self, timeout_s: float) -> tuple[str, Report] | None:
        """The next report; without one, time passes."""
        if self.reports:
            return self.reports.pop(0)
        self.now_s += timeout_s
        return None

    def request(self, name: str, request: StepRequest, *, blocking: bool) -> None:
        """Answer at once, unless mute."""
        self.asked.append((name, blocking))
        if name not in self.mute:
            self.answer(name, request.inputs.observation.step + 1)

    def answer(self, name: str, step: int) -> None:
        """Report a step."""
        self.reports.append((name, Report(VERSION, "nonce", Outputs(step, HERE))))


@pytest.fixture
def team(monkeypatch: pytest.MonkeyPatch) -> Team:
    """Three participants."""
    team = Team("r1", "r2", "r3")
    monkeypatch.setattr("kantor_worldsim.exchange.lockstep.time", team)
    return team


def tick(exchange: LockstepExchange, steps: dict[str, int]) -> set[str]:
    """Have participants step once; who did."""
    inputs = {name: Inputs(0, Observation(step, HERE)) for name, step in steps.items()}
    outputs = exchange(inputs)
    for name in outputs:
        steps[name] += 1
    return set(outputs)


def test_a_silent_participant_is_waited_for_once(team: Team) -> None:
    """A thousand ticks later the barrier has cost its timeout once, and the silent one was asked now and then."""
    exchange = LockstepExchange(cast("Lobby", team), no_controller)
    steps = dict.fromkeys(team.roster, 0)
    assert tick(exchange, steps) == {"r1", "r2", "r3"}
    team.mute = {"r2"}
    for _ in range(1000):
        assert tick(exchange, steps) == {"r1", "r3"}

    assert BARRIER_S <= team.now_s <= BARRIER_S + 1.0
    assert len([name for name, _ in team.asked if name == "r2"]) <= 2 * BARRIER_S
    assert team.silences == ["r2"]
    assert all(blocking for name, blocking in team.asked if name != "r2")


@pytest.mark.parametrize("alone", [False, True], ids=["in-its-batch", "between-its-batches"])
def test_a_silent_participant_is_back_when_it_answers(team: Team, *, alone: bool) -> None:
    """Its late answer counts, also when it comes while only others are asked."""
    exchange = LockstepExchange(cast("Lobby", team), no_controller)
    steps = dict.fromkeys(team.roster, 0)
    team.mute = {"r2"}
    tick(exchange, steps)
    team.mute = set()
    team.answer("r2", 1)
    if alone:
        others = {name: step for name, step in steps.items() if name != "r2"}
        assert tick(exchange, others) == {"r1", "r3"}
        steps |= others

    assert tick(exchange, steps) == {"r1", "r2", "r3"}
    assert tick(exchange, steps) == {"r1", "r2", "r3"}


def test_who_answers_only_now_and_then_is_waited_for_less_and_less(team: Team) -> None:
    """Any number of relapses costs two timeouts together, and a little."""
    exchange = LockstepExchange(cast("Lobby", team), no_controller)
    steps = dict.fromkeys(team.roster, 0)
    for _ in range(30):
        team.mute = {"r2"}
        tick(exchange, steps)
        team.mute = set()
        team.answer("r2", steps["r2"] + 1)
        assert "r2" in tick(exchange, steps)

    assert team.now_s <= 2.5 * BARRIER_S


def test_all_silent_are_waited_for(team: Team) -> None:
    """Time does not run on while nobody is left who answers."""
    exchange = LockstepExchange(cast("Lobby", team), no_controller)
    steps = dict.fromkeys(team.roster, 0)
    team.mute = set(team.roster)
    for _ in range(3):
        assert tick(exchange, steps) == set()

    assert team.now_s >= 1.5 * BARRIER_S


def test_whose_session_expires_is_asked_again_when_it_is_back(team: Team) -> None:
    """On a busy machine a session ends and a live process connects again: no step is missed, and nobody is lost."""
    exchange = LockstepExchange(cast("Lobby", team), no_controller)
    steps = dict.fromkeys(team.roster, 0)
    tick(exchange, steps)
    team.left = {"r1", "r2", "r3"}
    comes_back_s = team.now_s + 0.9 * BARRIER_S

    def back_in_time(timeout_s: float, wait: Callable[[float], Any] = team.next) -> Any:
        if team.left and team.now_s > comes_back_s:
            team.left, team.returns = set(), dict.fromkeys(team.roster, 2)
        return wait(timeout_s)

    team.next = back_in_time  # type: ignore[method-assign]
    assert tick(exchange, steps) == {"r1", "r2", "r3"}
    assert team.lost == team.silences == []


def test_who_does_not_come_back_is_lost(team: Team) -> None:
    """A process that is gone is waited for once."""
    exchange = LockstepExchange(cast("Lobby", team), no_controller)
    steps = dict.fromkeys(team.roster, 0)
    team.left = {"r2"}
    for _ in range(3):
        assert tick(exchange, steps) == {"r1", "r3"}

    assert BARRIER_S <= team.now_s <= BARRIER_S + 1.0
    assert team.lost == ["r2"]
    assert team.silences == []


def test_who_is_silent_and_then_leaves_is_lost_at_once(team: Team) -> None:
    """A frozen process is silent first; then its session expires."""
    exchange = LockstepExchange(cast("Lobby", team), no_controller)
    steps = dict.fromkeys(team.roster, 0)
    team.mute = {"r2"}
    tick(exchange, steps)
    team.left, waited_s = {"r2"}, team.now_s
    assert tick(exchange, steps) == {"r1", "r3"}

    assert team.now_s == waited_s
    assert team.lost == ["r2"]
