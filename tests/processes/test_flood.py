"""A robot with sound credentials floods the real bus: what reaches world-sim, and whether others wait.

`benchmarks/flood.py` measures what a flood costs the others' ticks; here is what must hold on any machine.
"""

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import zenoh

from kantor_protocol.transport import credentials
from kantor_protocol.transport.client import (
    ParticipantSession,
    observer_session,
    participant_session,
)
from kantor_protocol.transport.endpoint import free_endpoint
from kantor_protocol.transport.events import Flooded, Joined, Received
from kantor_protocol.transport.rate_limit import BURST_BYTES, BURST_MESSAGES, RateLimit
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.transport.zenoh_config import POSE_BYTES_MAX, SHOWN_PER_S
from kantor_protocol.wire import keys
from kantor_protocol.wire.messages import NONCE_MAX
from support.limits import EVENT_LIMIT_S

if TYPE_CHECKING:
    from support.processes.command import Kantor

FLEET, ROSTER = "kantor", ("r1", "r2")
MESSAGES, LARGE_MESSAGES = 5000, 40
MIB = 1 << 20
QUOTA = RateLimit(100.0, 1e6)


@contextmanager
def hosted(folder: Path) -> Iterator[tuple[HubRouter, ParticipantSession, ParticipantSession, str]]:
    """World-sim's end, two robots' ends, and where it listens."""
    identities = credentials.issue(folder, FLEET, ROSTER)
    endpoint = free_endpoint()
    with ExitStack() as stack:
        users = credentials.users_file(folder)
        host = stack.enter_context(HubRouter(identities[credentials.HOST], endpoint, users, ROSTER))
        host.limit(dict.fromkeys(ROSTER, QUOTA))
        robots = [
            stack.enter_context(
                participant_session(endpoint, identities[name], name, EVENT_LIMIT_S)
            )
            for name in ROSTER
        ]
        joined = {next_of(host, Joined).name for _ in ROSTER}
        assert joined == set(ROSTER)
        yield host, robots[0], robots[1], endpoint


def next_of(host: HubRouter, kind: type) -> Joined:
    """The next event, which is of a kind."""
    event = host.next(EVENT_LIMIT_S)
    assert isinstance(event, kind)
    return event  # type: ignore[return-value]


def until(host: HubRouter, payload: bytes) -> tuple[list[Received], list[Flooded]]:
    """What comes before a message."""
    heard, flooded = [], []
    while (event := host.next(EVENT_LIMIT_S)) is not None:
        if isinstance(event, Received):
            if event.payload == payload:
                return heard, flooded
            heard.append(event)
        elif isinstance(event, Flooded):
            flooded.append(event)
    raise AssertionError(f"{payload!r} did not come")


def test_other_robots_do_not_wait_behind_a_flood(tmp_path: Path) -> None:
    """Of 5000 messages few get in, the robot is named once, and what another says is heard at once."""
    with hosted(tmp_path) as (host, honest, hostile, _):
        start_s = time.monotonic()
        for _ in range(MESSAGES):
            hostile.send(b"flood", blocking=True)
        honest.send(b"news", blocking=True)
        before, flooded = until(host, b"news")
        ahead, elapsed_s = len(before), time.monotonic() - start_s
        while sum(excess.messages for excess in host.excess.values()) + len(before) < MESSAGES:
            event = host.next(0.02)  # what is beyond the quota is no event
            assert time.monotonic() < start_s + EVENT_LIMIT_S
            before += [event] if isinstance(event, Received) else []
            flooded += [event] if isinstance(event, Flooded) else []

        assert ahead <= BURST_MESSAGES + elapsed_s * QUOTA.messages_per_s
        assert flooded == [Flooded("r2")]
        assert set(host.excess) == {"r2"}
        assert host.excess["r2"].messages + len(before) == MESSAGES


def test_long_messages_beyond_the_quota_are_dropped(tmp_path: Path) -> None:
    """Of 40 MiB no more waits for a reader than the quota has room for."""
    with hosted(tmp_path) as (host, honest, hostile, _):
        start_s = time.monotonic()
        for _ in range(LARGE_MESSAGES):
            hostile.send(bytes(MIB), blocking=True)
        honest.send(b"news", blocking=True)
        before, _ = until(host, b"news")
        elapsed_s = time.monotonic() - start_s

        waiting = sum(len(event.payload) for event in before)
        assert waiting <= BURST_BYTES + elapsed_s * QUOTA.bytes_per_s


def test_a_token_with_a_longer_nonce_than_any_is_no_event(tmp_path: Path) -> None:
    """World-sim remembers nonces, and messages have none that is so long."""
    with hosted(tmp_path) as (host, _, hostile, _):
        liveliness = hostile._session.liveliness()
        tokens = [
            liveliness.declare_token(keys.alive(FLEET, "r2", nonce))
            for nonce in ((NONCE_MAX + 1) * "n", NONCE_MAX * "n")
        ]

        assert next_of(host, Joined).nonce == NONCE_MAX * "n"
        assert len(tokens) == 2


def test_what_observers_see_is_limited_by_the_router(tmp_path: Path) -> None:
    """No pose is longer than a pose, and there are no more than can be looked at; others' are untouched."""
    with hosted(tmp_path) as (_, honest, hostile, endpoint):
        observer = credentials.find(tmp_path, credentials.OBSERVER)
        with observer_session(endpoint, observer, keys.everything(FLEET), EVENT_LIMIT_S) as seen:
            start_s = time.monotonic()
            hostile.publish_pose(bytes(POSE_BYTES_MAX + 1))
            for _ in range(MESSAGES):
                hostile._session.put(
                    keys.pose(FLEET, "r2"),
                    b"pose",
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
            honest.publish_pose(bytes(POSE_BYTES_MAX))
            honest.send(b"end", blocking=True)
            hostile.send(b"end", blocking=True)
            counts: dict[tuple[str, bytes], int] = {}
            ends = 0
            while ends < len(ROSTER):
                message = seen.next(EVENT_LIMIT_S)
                assert message is not None
                ends += message[1] == b"end"
                counts[message] = counts.get(message, 0) + 1
            elapsed_s = time.monotonic() - start_s

    shown = counts[keys.pose(FLEET, "r2"), b"pose"]
    assert 0 < shown <= SHOWN_PER_S * elapsed_s + 2
    assert counts[keys.pose(FLEET, "r1"), bytes(POSE_BYTES_MAX)] == 1
    assert (keys.pose(FLEET, "r2"), bytes(POSE_BYTES_MAX + 1)) not in counts


def test_a_mission_after_a_flood_is_the_mission_without_it(kantor: "Kantor") -> None:
    """In lockstep: the same digest; the result and one line name the robot that flooded, and no checker complains."""
    alone = kantor("run", "paper-decentralized", "--seed", 3, "--exchange", "in-process")
    assert alone.code == 0
    endpoint = free_endpoint()
    world = kantor.start(
        "worldsim", "paper-decentralized", "--seed", 3, "--exchange", "lockstep", "--listen", endpoint,
    )  # fmt: skip
    assert world.stdout is not None
    assert any(text.startswith("t=") for text in world.stdout)
    identity = credentials.find(kantor.folder / "credentials", "r2")
    with participant_session(endpoint, identity, "flood", EVENT_LIMIT_S) as hostile:
        assert hostile.next(EVENT_LIMIT_S) is not None  # it is let in, and so is heard
        for _ in range(MESSAGES):
            hostile.send(b"flood", blocking=True)
    robots = [kantor.start("agent", name, "--connect", endpoint) for name in ("r1", "r2")]
    for robot in robots:
        assert robot.wait(timeout=EVENT_LIMIT_S) == 0
    out, err = world.communicate(timeout=EVENT_LIMIT_S)

    assert world.returncode == 0, out + err
    assert out.count("r2 floods the bus") == 1
    first, second = (json.loads((run / "result.json").read_text()) for run in kantor.runs())
    assert first["digest"] == second["digest"]
    assert second["violations"] == 0
    assert first["excess"] == {}
    counted = second["excess"]["r2"]["messages"] + second["messages_refused"]
    own = 2  # of the robot itself, which has the same quota: that it is ready may come too early, and is repeated
    assert MESSAGES <= counted <= MESSAGES + own
    assert second["messages_refused"] < MESSAGES / 2
