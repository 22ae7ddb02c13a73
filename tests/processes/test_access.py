"""The radio cannot be gone around: real Zenoh clients that try, beside a legitimate run."""

import json
from datetime import UTC, datetime
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING

import msgpack
import msgspec
import pytest
import zenoh

from kantor_fleet.security.authority import Wanted, issue
from kantor_protocol.transport import credentials, zenoh_config
from kantor_protocol.transport.credentials import Certificate, Password
from kantor_protocol.transport.endpoint import free_endpoint
from support.limits import EVENT_LIMIT_S
from support.processes.intruders import plain_session

if TYPE_CHECKING:
    from support.processes.command import Kantor

ROOT = "kantor/v1/kantor"


def proof_of(folder: Path, user: str) -> zenoh_config.ZenohConfig:
    """The credentials of a user, as a configuration of Zenoh."""
    return zenoh_config.client_config(credentials.find(folder / "credentials", user))


def strangers(folder: Path) -> list[zenoh_config.ZenohConfig]:
    """Credentials that no client gets onto the bus with."""
    r2 = credentials.find(folder / "credentials", "r2")
    if isinstance(r2, Password):
        guesses = [Password("kantor", "r1", "guess"), Password("kantor", "r7", r2.password)]
    else:
        issue(folder / "foreign", Wanted("kantor", 1), datetime.now(UTC))
        foreign = credentials.find(folder / "foreign", "r1")
        assert isinstance(foreign, Certificate)
        guesses = [foreign, msgspec.structs.replace(foreign, authority=r2.authority)]
    short = {"connect/timeout_ms": 500}
    return [short, *(zenoh_config.client_config(guess) | short for guess in guesses)]


def hear(session: zenoh.Session, *keys: str) -> "SimpleQueue[tuple[str, bytes]]":
    """A queue of all that arrives on some keys."""
    heard: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
    for key in keys:
        session.declare_subscriber(
            key, lambda sample: heard.put((str(sample.key_expr), sample.payload.to_bytes()))
        )
    return heard


def drained(heard: "SimpleQueue[tuple[str, bytes]]") -> list[tuple[str, bytes]]:
    """All that has arrived so far."""
    return [heard.get() for _ in range(heard.qsize())]


def malformed() -> list[bytes]:
    """Payloads of a hostile or broken robot on its own tx; every one must be counted and dropped."""
    nan_pose = [1, [float("nan"), 0.0, 0.0, 0.0], None, b"", b"", b"", [], 0, 0, 0]
    sound_pose = [1, [0.0, 0.0, 0.0, 0.0], None, b"", b"", b"", [], 0, 0, 0]
    return [
        b"",
        b"\xc1",
        b"not msgpack at all",
        msgpack.packb([6, 0, "nonce", sound_pose]),  # an old version
        msgpack.packb([6, 2, "nonce", sound_pose]),  # a version to come
        msgpack.packb([6, 1, "nonce", nan_pose]),
        msgpack.packb([6, 1, "nonce", sound_pose]),  # sound, but from no process that plays r2
        msgpack.packb([99, 1]),
        b"\x91" * 100_000,  # nested too deep
        msgpack.packb([6, 1, "nonce", [1, [0.0] * 4, None, bytes(3_000_000)]]),
    ]


@pytest.mark.parametrize("kind", ["tcp", "tls"])
def test_no_client_reads_or_writes_past_the_radio(kantor: "Kantor", kind: str) -> None:
    """A stranger, and a robot that misbehaves, beside a legitimate run.

    Neither reads another robot's traffic, neither can publish as another, what is malformed is counted
    and dropped, and the run is the one that it is without them.
    """
    trust = ("--set", "trust=signed") if kind == "tls" else ()  # which is the default there
    alone = kantor("run", "paper-decentralized", "--seed", 3, "--exchange", "in-process", *trust)
    assert alone.code == 0
    endpoint = free_endpoint(kind)
    if kind == "tls":
        issue(kantor.folder / "credentials", Wanted("kantor", 2), datetime.now(UTC))
    world = kantor.start(
        "worldsim",
        "paper-decentralized",
        "--seed",
        3,
        "--exchange",
        "lockstep",
        "--listen",
        endpoint,
    )
    assert world.stdout is not None
    assert any(line.startswith("t=") for line in world.stdout)
    r2, observer_proof = proof_of(kantor.folder, "r2"), proof_of(kantor.folder, "observer")

    for proof in strangers(kantor.folder):
        with pytest.raises(zenoh.ZError), plain_session(endpoint, proof):
            pass  # pragma: no cover

    with (
        plain_session(endpoint, observer_proof) as observer,
        plain_session(endpoint, observer_proof) as scribe,
        plain_session(endpoint, r2) as rogue,
        plain_session(endpoint, r2) as eavesdropper,  # apart, since a session hears its own puts
    ):
        seen = hear(observer, f"{ROOT}/**")
        stolen = hear(
            eavesdropper,
            "**",
            f"{ROOT}/**",
            f"{ROOT}/r1/**",
            f"{ROOT}/r1/rx",
            f"{ROOT}/r1/tx",
            f"{ROOT}/*/pose",
            f"{ROOT}/door/**",
        )
        token = rogue.liveliness().declare_token(f"{ROOT}/r1/alive/forged")
        robots = [kantor.start("agent", name, "--connect", endpoint) for name in ("r1", "r2")]
        for payload in malformed():
            for key in ("r1/tx", "r1/rx", "r1/pose", "r1/weights", "r2/rx", "world/progress"):
                rogue.put(f"{ROOT}/{key}", b"forged" + payload[:100])
            rogue.put(f"{ROOT}/r2/tx", payload, congestion_control=zenoh.CongestionControl.BLOCK)
        scribe.put(f"{ROOT}/r1/tx", b"forged by an observer")
        for robot in robots:
            assert robot.wait(timeout=EVENT_LIMIT_S) == 0
        out, err = world.communicate(timeout=EVENT_LIMIT_S)
        traffic = drained(seen)
        token.undeclare()

        assert world.returncode == 0, out + err
        kinds = {key.removeprefix(f"{ROOT}/") for key, _ in traffic}
        assert {"r1/tx", "r1/rx", "r1/pose", "r1/weights", "r2/tx", "world/progress"} <= kinds
        assert not [key for key, payload in traffic if payload.startswith(b"forged")]
        assert drained(stolen) == []

    first, second = (json.loads((run / "result.json").read_text()) for run in kantor.runs())
    assert first["digest"] == second["digest"]
    assert second["messages_refused"] == len(malformed())
    assert second["violations"] == 0


def test_an_oversized_message_does_not_reach_world_sim(kantor: "Kantor") -> None:
    """The router drops what is larger than any message may be; the mission goes on."""
    endpoint = free_endpoint()
    world = kantor.start(
        "worldsim", "paper-single", "--exchange", "lockstep", "--listen", endpoint,
        "--set", "limit_s=20", "energy.points=150",
    )  # fmt: skip
    assert world.stdout is not None
    assert any(line.startswith("t=") for line in world.stdout)
    with plain_session(endpoint, proof_of(kantor.folder, "r1")) as rogue:
        rogue.put(
            f"{ROOT}/r1/tx", bytes(8_000_000), congestion_control=zenoh.CongestionControl.BLOCK
        )
        rogue.put(f"{ROOT}/r1/tx", b"small", congestion_control=zenoh.CongestionControl.BLOCK)
        robot = kantor.start("agent", "r1", "--connect", endpoint)
        out, err = world.communicate(timeout=EVENT_LIMIT_S)

    assert world.returncode == 0, out + err
    assert robot.wait(timeout=EVENT_LIMIT_S) == 0
    result = json.loads((kantor.runs()[0] / "result.json").read_text())
    assert result["messages_refused"] == 1
    assert result["energy_spent"] == 150
