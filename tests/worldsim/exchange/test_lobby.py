"""Who is let in, with a bus of the test's own."""

from typing import cast

import pytest

from kantor_protocol.transport.events import Event, Joined
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.wire.messages import Mission, decode_to_participant
from kantor_worldsim.engine.simulation import Simulation
from kantor_worldsim.exchange.config import MissionConfig
from kantor_worldsim.exchange.lobby import AGAIN_S, Lobby
from kantor_worldsim.observers.recording import Recording
from kantor_worldsim.world.world import WorldSetup
from support.strategies import mission


class Bus:
    """World-sim's end of a bus, and its clock."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.sent: list[tuple[str, bytes]] = []
        self.now_s = 0.0

    def monotonic(self) -> float:
        """Seconds."""
        return self.now_s

    def next(self, timeout_s: float) -> Event | None:
        """The next event; without one time passes."""
        if self.events:
            return self.events.pop(0)
        self.now_s += timeout_s
        return None

    def send(self, name: str, payload: bytes, *, blocking: bool) -> None:
        """Note it."""
        assert blocking
        self.sent.append((name, payload))


def test_who_is_there_and_silent_is_told_its_mission_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a site's router a process may be seen before it can be reached: it is told once in AGAIN_S."""
    bus, scenario = Bus(), mission()
    monkeypatch.setattr("kantor_worldsim.exchange.lobby.time", bus)
    site = WorldSetup.of(scenario, 0)
    plan = MissionConfig(scenario, 0, site, "wall")
    lobby = Lobby(
        cast("HubRouter", bus),
        plan,
        Recording(scenario, 0, "wall"),
        lambda: False,
        lambda _progress: None,
        None,
        lambda _line: None,
    )
    lobby.simulation = Simulation(scenario, 0, site, [])
    bus.events.append(Joined("r1", "nonce"))
    while bus.now_s < 3.5 * AGAIN_S:
        lobby.next(0.1 * AGAIN_S)

    told = [decode_to_participant(payload) for _, payload in bus.sent]
    assert {name for name, _ in bus.sent} == {"r1"}
    assert len(told) == 4
    assert all(isinstance(message, Mission) and message.nonce == "nonce" for message in told)
