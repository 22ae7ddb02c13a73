"""A robot with sound credentials and a hostile program, on the real bus: what it cannot do to the others."""

import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import pytest

from kantor_fleet.security.authority import Wanted, issue
from kantor_protocol.base.machine import Envelope, Outputs, Pose
from kantor_protocol.transport import credentials, zenoh_config
from kantor_protocol.transport.client import ParticipantSession, client, participant_session
from kantor_protocol.transport.endpoint import free_endpoint, parse_endpoint
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.transport.session import BusError
from kantor_protocol.transport.zenoh_config import (
    ACCEPT_PENDING,
    SESSIONS_MORE,
    SESSIONS_OF_EACH,
)
from kantor_protocol.wire.messages import (
    VERSION,
    Mission,
    Ready,
    Report,
    StartClock,
    StepRequest,
    Stop,
    ToParticipant,
    decode_to_participant,
    encode,
)
from kantor_worldsim.record.journal import Journal
from kantor_worldsim.record.records import Batch
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import await_act, await_line, records_of, result_of
from support.processes.intruders import plain_session

if TYPE_CHECKING:
    from support.processes.command import Kantor, Process

SHORT = ("--seed", 3, "--set", "limit_s=12")


def await_message(hostile: ParticipantSession, kind: type[ToParticipant]) -> ToParticipant:
    """The next message of a kind."""
    give_up = time.monotonic() + EVENT_LIMIT_S
    while time.monotonic() < give_up:
        payload = hostile.next(1.0)
        message = None if payload is None else decode_to_participant(payload)
        if isinstance(message, kind):
            return message
    raise AssertionError(f"no {kind.__name__} came")


def host(kantor: "Kantor", endpoint: str, exchange: str) -> "Process":
    """World-sim, once it waits for robots."""
    world = kantor.start(
        "worldsim", "paper-decentralized", "--listen", endpoint, "--exchange", exchange, *SHORT
    )
    await_line(world, "t=")
    return world


@contextmanager
def ready_robot(kantor: "Kantor", endpoint: str) -> Iterator[tuple[ParticipantSession, "Process"]]:
    """The hostile r2, with its mission and ready, and the process of the honest r1."""
    identity = credentials.find(kantor.folder / "credentials", "r2")
    with participant_session(endpoint, identity, "hostile", EVENT_LIMIT_S) as hostile:
        await_message(hostile, Mission)
        honest = kantor.start("agent", "r1", "--connect", endpoint)
        hostile.send(encode(Ready(VERSION, "hostile")), blocking=True)
        yield hostile, honest


def unsound(pose: Pose) -> list[Outputs]:
    """Outputs of the first step of r2 that nobody may settle."""
    many = tuple(Envelope("r2", 1 + i, "", b"") for i in range(100_000))
    return [
        Outputs(1, pose, outbox=many),
        Outputs(1, pose, outbox=(Envelope("r1", 1, "", b""),)),
        Outputs(1, pose, outbox=(Envelope("r2", (1 << 62) + 5, "", b""),)),
        Outputs(1, pose, outbox=(Envelope("r2", 1, "", b"\xc1"),)),
        Outputs(1, Pose(pose.x_m + 1e6, pose.y_m)),
        Outputs(1, Pose(float("nan"), 0.0)),
        Outputs(7, pose),
    ]


def test_unsound_reports_touch_nobody_in_lockstep(kantor: "Kantor") -> None:
    """The mission goes on without waiting for their sender, who alone is named, and no rule is broken."""
    endpoint = free_endpoint()
    world = host(kantor, endpoint, "lockstep")
    with ready_robot(kantor, endpoint) as (hostile, honest):
        request = await_message(hostile, StepRequest)
        assert isinstance(request, StepRequest)
        for outputs in unsound(request.inputs.observation.pose):
            hostile.send(encode(Report(VERSION, "hostile", outputs)), blocking=True)
        await_message(hostile, Stop)
        assert honest.wait(timeout=EVENT_LIMIT_S) == 0
        out, err = world.communicate(timeout=EVENT_LIMIT_S)

    assert out.count("r2 sends what it cannot") == 1, out + err
    assert "r1 sends" not in out
    result = result_of(kantor.runs()[0])
    assert list(result["refused_reports"]) == ["r2"]
    assert result["violations"] == 0
    assert result["record"] == "whole"


def test_a_run_resumes_after_unsound_reports(kantor: "Kantor") -> None:
    """In real time: world-sim is killed after a forged report and a sound one, and goes on from its record."""
    endpoint = free_endpoint()
    world = host(kantor, endpoint, "realtime")
    with ready_robot(kantor, endpoint) as (hostile, _):
        clock = await_message(hostile, StartClock)
        assert isinstance(clock, StartClock)
        assert clock.observation is not None
        now_ns = clock.now_ns + 200_000_000
        pose = clock.observation.pose
        for outputs in (*unsound(pose), Outputs(1, pose)):
            hostile.send(encode(Report(VERSION, "hostile", outputs, now_ns)), blocking=True)
        run = kantor.runs()[0]
        assert await_act(run, "r2").outputs == Outputs(1, pose)
        await_act(run, "r1")
        world.kill()
        world.wait(EVENT_LIMIT_S)
        resumed = kantor.start("worldsim", "--resume", run, "--listen", endpoint)
        await_line(resumed, "t=")
        resumed.send_signal(signal.SIGINT)
        out, err = resumed.communicate(timeout=EVENT_LIMIT_S)

    assert "Traceback" not in out + err
    assert result_of(run)["violations"] == 0


def test_a_silent_robot_is_named(kantor: "Kantor") -> None:
    """In lockstep: it is ready and does not answer; the other one goes on without it, and is not blamed."""
    endpoint = free_endpoint()
    world = host(kantor, endpoint, "lockstep")
    with ready_robot(kantor, endpoint) as (hostile, honest):
        await_message(hostile, Stop)
        assert honest.wait(timeout=EVENT_LIMIT_S) == 0
        out, err = world.communicate(timeout=EVENT_LIMIT_S)

    assert out.count("r2 does not answer") == 1, out + err
    assert "r1 does not answer" not in out
    assert result_of(kantor.runs()[0])["silences"] == {"r2": 1}


def test_a_record_that_cannot_be_resumed_is_one_line(kantor: "Kantor") -> None:
    """Of another version, say: exit code 2, one line, and the folder is as it was."""
    kantor("run", "paper-single", "--exchange", "in-process", "--set", "limit_s=2")
    run = kantor.runs()[0]
    records = records_of(run)
    assert isinstance(records[3], Batch)
    (step_record,) = records[3].step_records
    strange = msgspec.structs.replace(step_record, heard=(("r1", 99),))
    records[3] = msgspec.structs.replace(records[3], step_records=(strange,))
    journal = Journal(run / "run.mcap")
    for record in records[:-1]:
        journal.append(record)
    journal.close()
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    resumed = kantor("worldsim", "--resume", run, "--listen", free_endpoint())

    assert resumed.code == 2
    assert resumed.err.startswith(f"kantor: {run}: cannot go on with this version (record 3: ")
    assert resumed.err.count("\n") == 1
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before


ROSTER = ("r1", "r2")


@pytest.mark.parametrize("idle", [101, ACCEPT_PENDING + 20])
def test_idle_connections_do_not_keep_others_from_joining(tmp_path: Path, idle: int) -> None:
    """A hundred are no obstacle; more than are let in at a time delay a join, which keeps trying."""
    identities = credentials.issue(tmp_path, "kantor", ROSTER)
    endpoint = free_endpoint()
    users = credentials.users_file(tmp_path)
    _, name, port = parse_endpoint(endpoint)
    held: list[socket.socket] = []
    with HubRouter(identities[credentials.HOST], endpoint, users, ROSTER):
        try:
            for _ in range(idle):
                held += [socket.create_connection((name, port), timeout=EVENT_LIMIT_S)]
            with participant_session(endpoint, identities["r1"], "n", EVENT_LIMIT_S):
                pass
        finally:
            for connection in held:
                connection.close()


def test_many_sessions_of_a_certificate_do_not_keep_others_from_joining(tmp_path: Path) -> None:
    """More than a router has room for; those that are too many are closed, and their holder is named."""
    issue(tmp_path / "keys", Wanted("demo", 2), datetime.now(UTC))
    hub, r1, r2 = (credentials.find(tmp_path / "keys", name) for name in ("worldsim", *ROSTER))
    endpoint = free_endpoint("tls")
    lines: list[str] = []
    with HubRouter(hub, endpoint, None, ROSTER, lines.append), ExitStack() as stack:
        for _ in range(SESSIONS_OF_EACH + SESSIONS_MORE + 10):
            stack.enter_context(plain_session(endpoint, zenoh_config.client_config(r1)))
        with participant_session(endpoint, r2, "n", EVENT_LIMIT_S):
            pass

    assert lines
    assert all(line.startswith("r1 opens too many sessions") for line in lines)


def test_wrong_credentials_are_still_told_at_once(tmp_path: Path) -> None:
    """Whoever has the wrong password need not wait for its patience to end."""
    identities = credentials.issue(tmp_path, "kantor", ROSTER)
    endpoint = free_endpoint()
    users = credentials.users_file(tmp_path)
    wrong = msgspec.structs.replace(identities["r1"], password="guess")
    with (
        HubRouter(identities[credentials.HOST], endpoint, users, ROSTER),
        pytest.raises(BusError, match="its credentials are not this world-sim's"),
        participant_session(endpoint, wrong, "n", 10 * EVENT_LIMIT_S),
    ):
        pass  # pragma: no cover


def test_no_password_is_in_zenoh_s_log(kantor: "Kantor") -> None:
    """Whatever RUST_LOG asks for."""
    endpoint = free_endpoint()
    world = kantor.start(
        "worldsim", "paper-single", "--listen", endpoint, "--exchange", "lockstep",
        "--set", "limit_s=1",
    )  # fmt: skip
    await_line(world, "t=")
    robot = kantor.start("agent", "r1", "--connect", endpoint, RUST_LOG="debug")
    out, err = robot.communicate(EVENT_LIMIT_S)
    identity = credentials.find(kantor.folder / "credentials", "r1")

    assert isinstance(identity, credentials.Password)
    assert "DEBUG" in out + err
    assert identity.password not in out + err
    world.communicate(EVENT_LIMIT_S)


def test_a_site_cannot_pose_as_world_sim(tmp_path: Path) -> None:
    """To a robot of another place its certificate says what it is; its own robots may connect to it."""
    issue(tmp_path / "keys", Wanted("demo", 2, sites=("north=r1",)), datetime.now(UTC))
    site, r1, r2 = (credentials.find(tmp_path / "keys", f"{n}") for n in ("site-north", "r1", "r2"))
    assert isinstance(site, credentials.Certificate)
    proof = zenoh_config.client_config(site)
    endpoint = free_endpoint("tls")
    with plain_session("", proof, mode="router", listen=endpoint):
        with pytest.raises(
            BusError, match="what answers is site-north, not worldsim; do not trust"
        ):
            client(endpoint, r2, EVENT_LIMIT_S)
        with pytest.raises(BusError, match="no world-sim of fleet demo answers"):
            client(endpoint, r1, EVENT_LIMIT_S)


def test_the_door_tells_nothing_of_other_members(tmp_path: Path) -> None:
    """Whoever guesses a name is answered in the same words, whether there is such a member or not."""
    issue(tmp_path / "keys", Wanted("demo", 2), datetime.now(UTC))
    issue(tmp_path / "keys", Wanted("demo", revoke=("r2",)), datetime.now(UTC))
    hub = credentials.find(tmp_path / "keys", "worldsim")
    assert isinstance(hub, credentials.Certificate)
    answers = {
        user: hub.answer(f"{user}.{'0' * 16}", ROSTER).replace(user, "?")
        for user in ("r1", "r2", "r9", "supervisor")
    }

    assert len(set(answers.values())) == 1
    assert hub.answer(hub.members["r1"].name, ROSTER) == ""
    assert "revoked" in hub.answer(hub.revoked[0], ROSTER)
