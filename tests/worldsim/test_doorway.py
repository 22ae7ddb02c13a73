"""Who is let in, with a bus of the test's own."""

from typing import cast

import pytest

from kantor_protocol.bus import Event, Host, Joined
from kantor_protocol.messages import Mission, decode_to_participant
from kantor_worldsim.doorway import AGAIN_S, Doorway
from kantor_worldsim.plan import Plan
from kantor_worldsim.recording import Recording
from kantor_worldsim.stage import Stage
from kantor_worldsim.world import Site
from strategies import mission


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

    def send(self, name: str, payload: bytes, *, patiently: bool) -> None:
        """Note it."""
        assert patiently
        self.sent.append((name, payload))


def test_who_is_there_and_silent_is_told_its_mission_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a site's router a process may be seen before it can be reached: it is told once in AGAIN_S."""
    bus, scenario = Bus(), mission()
    monkeypatch.setattr("kantor_worldsim.doorway.time", bus)
    site = Site.of(scenario, 0)
    plan = Plan(scenario, 0, site, "wall")
    doorway = Doorway(
        cast("Host", bus),
        plan,
        Recording(scenario, 0, "wall"),
        lambda: False,
        lambda _progress: None,
        None,
        lambda _line: None,
    )
    doorway.stage = Stage(scenario, 0, site, [])
    bus.events.append(Joined("r1", "nonce"))
    while bus.now_s < 3.5 * AGAIN_S:
        doorway.next(0.1 * AGAIN_S)

    told = [decode_to_participant(payload) for _, payload in bus.sent]
    assert {name for name, _ in bus.sent} == {"r1"}
    assert len(told) == 4
    assert all(isinstance(message, Mission) and message.nonce == "nonce" for message in told)
