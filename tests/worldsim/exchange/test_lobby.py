"""The lobby: membership of processes, with a simulated bus."""

from typing import cast

import pytest

from kantor_protocol.transport.events import Event, Joined
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.wire.messages import Mission, decode_to_participant
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.lobby import RETRY_S, Lobby
from kantor_worldsim.observers.metrics.density import DensityMetrics
from kantor_worldsim.observers.progress import ProgressReporter
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

    def next(self, timeout_s: float) -> Event | None:
        """The next event; without one, time passes."""
        if self.events:
            return self.events.pop(0)
        self.now_s += timeout_s
        return None

    def send(self, name: str, payload: bytes, *, blocking: bool) -> None:
        """Keep a message."""
        assert blocking
        self.sent.append((name, payload))


def test_a_silent_participant_is_sent_its_mission_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a site's router a process may be visible before it can be reached: the mission is sent once in RETRY_S."""
    bus, scenario = Bus(), mission()
    monkeypatch.setattr("kantor_worldsim.exchange.lobby.time", bus)
    setup = WorldSetup.of(scenario, 0)
    simulation = Simulation(scenario, 0, setup, [])
    lobby = Lobby(
        cast("HubRouter", bus),
        MissionConfig(scenario, 0, setup, "wall"),
        "run",
        simulation,
        ProgressReporter(DensityMetrics(), scenario, lambda _progress: None),
        lambda: False,
        lambda _line: None,
    )
    bus.events.append(Joined("r1", "nonce"))
    while bus.now_s < 3.5 * RETRY_S:
        lobby.next(0.1 * RETRY_S)

    received = [decode_to_participant(payload) for _, payload in bus.sent]
    assert {name for name, _ in bus.sent} == {"r1"}
    assert len(received) == 4
    assert all(isinstance(message, Mission) and message.nonce == "nonce" for message in received)
