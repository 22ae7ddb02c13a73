"""The lobby: membership of processes, with a simulated bus."""

from typing import cast

import pytest

from kantor_protocol.base.machine import Outputs, Pose
from kantor_protocol.transport.events import Event, Joined, Left, Received
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.wire.messages import (
    VERSION,
    Mission,
    Ready,
    Report,
    decode_to_participant,
    encode,
)
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.lobby import RETRY_S, Lobby
from kantor_worldsim.observers.metrics.density import DensityMetrics
from kantor_worldsim.observers.progress import ProgressReporter
from kantor_worldsim.record.process_events import ProcessEventKind
from kantor_worldsim.record.records import ProcessEvent, Record
from kantor_worldsim.world.world import WorldSetup
from support.strategies import mission


class Bus:
    """World-sim's end of a bus, and its clock."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.sent: list[tuple[str, bytes]] = []
        self.now_s = 0.0

    def monotonic(self) -> float:
        """The simulated time in seconds."""
        return self.now_s

    def monotonic_ns(self) -> int:
        """The same in nanoseconds."""
        return round(self.now_s * 1e9)

    def next(self, timeout_s: float) -> Event | None:
        """The next event; without one, time passes."""
        if self.events:
            return self.events.pop(0)
        self.now_s += timeout_s
        return None

    def drain(self, timeout_s: float, _every_s: float) -> list[Event]:
        """All events; without one, time passes."""
        events = [event for event in [self.next(timeout_s)] if event] + self.events
        self.events = []
        return events

    def charge(self, _name: str, _work: float) -> bool:
        """Nobody has a quota."""
        return True

    def send(self, name: str, payload: bytes, *, blocking: bool) -> None:
        """Keep a message."""
        assert blocking
        self.sent.append((name, payload))


def lobby_on(bus: Bus, records: list[Record] | None = None, exchange: str = "wall") -> Lobby:
    """The lobby of a mission. records: what goes on record."""
    scenario = mission()
    setup = WorldSetup.of(scenario, 0)
    return Lobby(
        cast("HubRouter", bus),
        MissionConfig(scenario, 0, setup, exchange),
        "run",
        Simulation(scenario, 0, setup, [] if records is None else [records.append]),
        ProgressReporter(DensityMetrics(), scenario, lambda _progress: None),
        lambda: False,
        lambda _line: None,
    )


def test_a_silent_participant_is_sent_its_mission_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a site's router a process may be visible before it can be reached: the mission is sent once in RETRY_S."""
    bus = Bus()
    monkeypatch.setattr("kantor_worldsim.exchange.lobby.time", bus)
    lobby = lobby_on(bus)
    bus.events.append(Joined("r1", "nonce"))
    while bus.now_s < 3.5 * RETRY_S:
        lobby.next(0.1 * RETRY_S)

    received = [decode_to_participant(payload) for _, payload in bus.sent]
    assert {name for name, _ in bus.sent} == {"r1"}
    assert len(received) == 4
    assert all(isinstance(message, Mission) and message.nonce == "nonce" for message in received)


def test_clocks_run_on_while_world_sim_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """A resumed mission goes on at the time that the robots' clocks show when all are there, not when each came."""
    bus = Bus()
    monkeypatch.setattr("kantor_worldsim.exchange.lobby.time", bus)
    lobby = lobby_on(bus)
    assert lobby.running_ns(4.0) == 0
    for name, shows_s in (("r1", 5), ("r2", 1000)):
        ready = Ready(VERSION, name, 0, 0, shows_s * 10**9)
        bus.events += [Joined(name, name), Received(name, encode(ready))]
        lobby.next(1.0)
        lobby.next(1.0)
    bus.now_s += 2.5

    assert lobby.running_ns(4.0) == (5 + 4 * 2.5) * 10**9


@pytest.mark.parametrize("back", [False, True])
def test_in_lockstep_the_barrier_decides_who_has_left(*, back: bool) -> None:
    """Whoever left and is not back is expected until it is given up; then it is on record that it left."""
    bus, records = Bus(), list[Record]()
    lobby = lobby_on(bus, records, "lockstep")
    ready = Received("r1", encode(Ready(VERSION, "one")))
    bus.events += [Joined("r1", "one"), ready]
    lobby.next(1.0)
    lobby.next(1.0)
    lobby.open(lambda: 7)
    known = len(records)
    bus.events.append(Left("r1", "one"))
    lobby.next(1.0)
    assert lobby.is_expected("r1")
    assert not lobby.is_ready("r1")
    assert lobby.has_left("r1")
    if back:
        bus.events += [Joined("r1", "one"), ready]
        lobby.next(1.0)
        lobby.next(1.0)
        assert not lobby.has_left("r1")
    else:
        lobby.give_up("r1")
        assert not lobby.is_expected("r1")

    left = ProcessEvent(7, "r1", ProcessEventKind.LEAVE)
    assert records[known:] == ([] if back else [left])


def test_reports_before_a_departure_are_settled_before_it() -> None:
    """They come together, up to an arrival or departure, which is on record after the steps that came before it."""
    bus, records = Bus(), list[Record]()
    lobby = lobby_on(bus, records)
    for name in ("r1", "r2"):
        bus.events += [Joined(name, name), Received(name, encode(Ready(VERSION, name)))]
    while bus.events:
        lobby.next(1.0)
    lobby.open(lambda: 7)
    known = len(records)

    def reported(name: str) -> Received:
        return Received(name, encode(Report(VERSION, name, Outputs(0, Pose(0.0, 0.0)))))

    bus.events += [reported("r1"), reported("r2"), Left("r1", "r1"), reported("r1"), reported("r2")]
    assert [name for name, _ in lobby.reports(1.0, 0.0)] == ["r1", "r2"]
    assert len(records) == known
    assert [name for name, _ in lobby.reports(1.0, 0.0)] == ["r2"]
    assert [event.who for event in records[known:] if isinstance(event, ProcessEvent)] == ["r1"]
    assert lobby.reports(1.0, 0.0) == []
