"""Certificates on the real bus: invalid ones are refused, and both sides log the reason."""

import queue
import signal
import socket
import ssl
import struct
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import pytest
import zenoh

from kantor_fleet.security.authority import Wanted, issue
from kantor_protocol.transport import credentials, tls, zenoh_config
from kantor_protocol.transport.client import participant_session
from kantor_protocol.transport.credentials import Certificate, Identity
from kantor_protocol.transport.endpoint import free_endpoint
from kantor_protocol.transport.events import Joined, Left, Received
from kantor_protocol.transport.router import HubRouter
from kantor_protocol.transport.session import BusError
from kantor_protocol.wire import keys
from support.limits import EVENT_LIMIT_S
from support.processes.fleets import await_line
from support.processes.intruders import plain_session

if TYPE_CHECKING:
    from support.processes.command import Kantor

FLEET, ROSTER = "demo", ("r1", "r2", "r3")
NOW = datetime.now(UTC)
BLOCK = zenoh.CongestionControl.BLOCK


def make(folder: Path, now: datetime = NOW, **wanted: object) -> None:
    """Issue identities as `kantor keys demo` does."""
    issue(folder, Wanted(FLEET, **wanted), now)  # type: ignore[arg-type]


def identity(folder: Path, user: str) -> Certificate:
    """The certificate of a user in a folder."""
    found = credentials.find(folder, user)
    assert isinstance(found, Certificate)
    return found


@contextmanager
def hosted(who: Certificate, endpoint: str, said: list[str]) -> Iterator[HubRouter]:
    """World-sim's end of the bus, or that of an impostor."""
    with HubRouter(who, endpoint, None, ROSTER, said.append) as host:
        yield host


def join(endpoint: str, who: Identity) -> None:
    """Join the bus and leave it."""
    with participant_session(endpoint, who, "nonce", EVENT_LIMIT_S):
        pass


def refusal(endpoint: str, who: Certificate) -> str:
    """The reason for which an identity is refused."""
    with pytest.raises(BusError) as caught:
        join(endpoint, who)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The certificates of a fleet of three."""
    make(tmp_path / "keys", robots=3)
    return tmp_path / "keys"


def test_world_sim_and_a_refused_client_both_say_why(kantor: "Kantor") -> None:
    """No certificate, a foreign authority, an expired one, one that was replaced or revoked, an unknown one."""
    folder = kantor.folder / "keys"
    make(folder, robots=1)
    make(folder, NOW - timedelta(days=3), renew=("r1",), days=1)
    expired = identity(folder, "r1")
    make(folder, renew=("r1",))
    replaced = identity(folder, "r1")
    make(folder, renew=("r1",))
    make(folder, robots=4)
    revoked = identity(folder, "r2")
    make(folder, revoke=("r2",))
    make(kantor.folder / "foreign", robots=1)
    foreign = identity(kantor.folder / "foreign", "r1")
    ours = identity(folder, "r1")
    mixed = msgspec.structs.replace(foreign, authority=ours.authority)
    endpoint = free_endpoint("tls")
    world = kantor.start(
        "worldsim",
        "paper-single",
        "--listen",
        endpoint,
        "--credentials",
        "keys",
        "--start-after",
        99,
    )
    await_line(world, "t=")

    with pytest.raises(zenoh.ZError), plain_session(endpoint, anonymous(ours)):
        pass  # pragma: no cover
    told = [
        refusal(endpoint, expired),
        refusal(endpoint, mixed),
        refusal(endpoint, foreign),
        refusal(endpoint, replaced),
        refusal(endpoint, revoked),
        refusal(endpoint, identity(folder, "r3")),
    ]
    join(endpoint, ours)
    world.send_signal(signal.SIGINT)
    out, err = world.communicate(timeout=EVENT_LIMIT_S)

    assert [text.removeprefix(f"{endpoint}: ") for text in told] == [
        "refuses r1: its certificate has expired; `kantor keys demo --renew r1` makes a new one",
        (
            "refuses r1: its certificate is from another authority; use the file that this fleet's "
            "`kantor keys` has made"
        ),
        (
            "what answers has a certificate from another authority (unable to get local issuer certificate); "
            "it is not the world-sim of this identity's fleet demo"
        ),
        (
            "refuses r1: the register names another certificate; use the newest r1.toml, or "
            "`kantor keys demo --renew r1` makes a new one"
        ),
        "refuses r2: its certificate has been revoked; `kantor keys demo --renew r2` makes a new one",
        "refuses r3: is not in the team; choose another id",
    ]
    for reason in (
        "refused a client: it showed no certificate",
        "refused a client: its certificate has expired",
        "refused a client: its certificate is from another authority",
        "refused a client: it trusts another authority than world-sim's",
        "refused r1: the register names another certificate",
        "refused r2: its certificate has been revoked",
        "refused r3: is not in the team",
    ):
        assert 1 <= out.count(reason) <= 2, (reason, out + err)  # at once, and how often at the end
    assert "handshake" not in out + err
    assert err.count("\n") <= 1


def anonymous(ours: Certificate) -> zenoh_config.ZenohConfig:
    """The settings of a client that trusts the authority and has no certificate."""
    own = zenoh_config.client_config(ours)
    authority = own["transport/link/tls"]["root_ca_certificate_base64"]
    return own | {
        "connect/timeout_ms": 500,
        "transport/link/tls": {"root_ca_certificate_base64": authority, "enable_mtls": False},
    }


@pytest.mark.parametrize("place", ["keys", "keys/worldsim.toml"])
def test_the_command_that_world_sim_prints_starts_a_robot(kantor: "Kantor", place: str) -> None:
    """Whether it was given a folder or its own file, and whatever addresses it listens on."""
    make(kantor.folder / "keys", robots=1)
    port = free_endpoint("tls").rpartition(":")[2]
    listen = ("--listen", f"tls/0.0.0.0:{port}", "--credentials", place)
    world = kantor.start("worldsim", "paper-single", *listen)
    said = await_line(world, "  kantor agent r1").replace("/HOST:", "/localhost:")

    robot = kantor.start(*said.split()[1:])

    await_line(robot, "r1: mission paper-single")


def test_a_revoked_robot_with_plain_zenoh_neither_sends_nor_receives(folder: Path) -> None:
    """Plain Zenoh with the key of a revoked robot: it may connect, and neither speaks, lives nor listens."""
    stolen = identity(folder, "r3")
    make(folder, revoke=("r3",))
    endpoint, said = free_endpoint("tls"), []
    with (
        hosted(identity(folder, "worldsim"), endpoint, said) as host,
        plain_session(endpoint, zenoh_config.client_config(stolen)) as rogue,
    ):
        heard: list[zenoh.Sample] = []
        rogue.declare_subscriber(f"{keys.everything(FLEET)}", heard.append)
        rogue.declare_subscriber(keys.rx(FLEET, "r3"), heard.append)
        token = rogue.liveliness().declare_token(keys.alive(FLEET, "r3", "forged"))
        for name in ROSTER:
            rogue.put(keys.tx(FLEET, name), b"forged", congestion_control=BLOCK)
        with participant_session(
            endpoint, identity(folder, "r1"), "nonce", EVENT_LIMIT_S
        ) as honest:
            assert host.next(EVENT_LIMIT_S) == Joined("r1", "nonce")
            for name in ROSTER:
                host.send(name, b"secret", blocking=True)
            assert honest.next(EVENT_LIMIT_S) == b"secret"
            honest.send(b"true", blocking=True)
            assert host.next(EVENT_LIMIT_S) == Received("r1", b"true")
        assert host.next(EVENT_LIMIT_S) == Left("r1", "nonce")
        token.undeclare()
        assert {sample.payload.to_bytes() for sample in heard} == {b"forged"}  # its own words

    assert said == [
        "refused r3: its certificate has been revoked; `kantor keys demo --renew r3` makes a new one"
    ]


def test_a_robot_that_is_revoked_during_a_run_gets_the_reason(folder: Path) -> None:
    """World-sim is started again with the newer register: r3 learns why it is out, r1 just goes on."""
    endpoint, said, lines = free_endpoint("tls"), [], queue.SimpleQueue[str]()
    with ExitStack() as robots:
        with hosted(identity(folder, "worldsim"), endpoint, said) as host:
            r1, r3 = (
                robots.enter_context(
                    participant_session(endpoint, identity(folder, name), name, EVENT_LIMIT_S)
                )
                for name in ("r1", "r3")
            )
            assert {host.next(EVENT_LIMIT_S), host.next(EVENT_LIMIT_S)} == {
                Joined("r1", "r1"), Joined("r3", "r3"),
            }  # fmt: skip
        make(folder, revoke=("r3",))
        renewed = identity(folder, "worldsim")
        with HubRouter(renewed, endpoint, None, ROSTER, lines.put) as host:
            assert host.next(EVENT_LIMIT_S) == Joined("r1", "r1")
            with pytest.raises(BusError, match="refuses r3: its certificate has been revoked"):
                r3.next(EVENT_LIMIT_S)
            host.send("r1", b"go on", blocking=True)
            assert r1.next(EVENT_LIMIT_S) == b"go on"
            line = lines.get(timeout=EVENT_LIMIT_S)

    assert line.partition(";")[0] == "refused r3: its certificate has been revoked"
    assert (said, lines.empty()) == ([], True)


def test_robots_refuse_a_false_world_sim(folder: Path, tmp_path: Path) -> None:
    """One with a foreign authority, with a robot's certificate, with an expired one, by another name."""
    make(tmp_path / "foreign", robots=3)
    r1, said = identity(folder, "r1"), []
    with hosted(identity(tmp_path / "foreign", "worldsim"), at := free_endpoint("tls"), said):
        assert "it is not the world-sim of this identity's fleet demo" in refusal(at, r1)
    with hosted(identity(folder, "r2"), at := free_endpoint("tls"), said):
        assert "a robot's certificate, not world-sim's; do not trust it" in refusal(at, r1)
    port = free_endpoint("tls").rpartition(":")[2]
    with hosted(identity(folder, "worldsim"), f"tls/0.0.0.0:{port}", said):
        join(f"tls/localhost:{port}", r1)
        told = refusal(f"tls/127.0.0.2:{port}", r1)
        assert "has no certificate for the name 127.0.0.2" in told
        assert "`kantor keys demo --host 127.0.0.2`" in told
        make(folder, hosts=("127.0.0.2",))
    with hosted(identity(folder, "worldsim"), f"tls/0.0.0.0:{port}", said):
        join(f"tls/127.0.0.2:{port}", r1)
    make(folder, NOW - timedelta(days=3), renew=("worldsim",), days=1)
    with hosted(identity(folder, "worldsim"), at := free_endpoint("tls"), said):
        told = refusal(at, r1)
        assert "world-sim's certificate is expired" in told
        assert "--renew worldsim" in told
    assert said == []


def test_tls_itself_refuses_a_false_world_sim(folder: Path) -> None:
    """TLS refuses: the bus itself, not only the look that comes before it."""
    own = zenoh_config.client_config(identity(folder, "r1")) | {"connect/timeout_ms": 500}
    with (
        hosted(identity(folder, "r2"), at := free_endpoint("tls"), []),
        pytest.raises(zenoh.ZError),
        plain_session(at, own),
    ):
        pass  # pragma: no cover


def test_a_certificate_is_valid_until_it_expires(folder: Path) -> None:
    """A robot that is on the bus when its certificate expires leaves it at that moment."""
    began = datetime.now(UTC)
    with hosted(identity(folder, "worldsim"), endpoint := free_endpoint("tls"), []):
        join(endpoint, identity(folder, "r1"))
    until = timedelta(seconds=3) + 5 * (datetime.now(UTC) - began)  # time enough to join here
    make(folder, datetime.now(UTC) - timedelta(days=1) + until, renew=("r1",), days=1)
    r1 = identity(folder, "r1")
    with (
        hosted(identity(folder, "worldsim"), endpoint := free_endpoint("tls"), []) as host,
        participant_session(endpoint, r1, "nonce", EVENT_LIMIT_S),
    ):
        assert host.next(EVENT_LIMIT_S) == Joined("r1", "nonce")
        assert host.next(EVENT_LIMIT_S) == Left("r1", "nonce")
        assert datetime.now(UTC) >= r1.until
        assert "its certificate has expired" in refusal(endpoint, r1)


def test_a_connection_that_is_reset_after_the_handshake_is_no_objection(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its handshake was sound, so it is a world-sim: the bus says what is wrong, if anything is."""
    who, chain = identity(folder, "worldsim"), tmp_path / "chain.pem"
    chain.write_text(who.certificate + who.key)
    theirs = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    theirs.load_cert_chain(chain)
    ours = tls.context(identity(folder, "r1"))

    def reset(listener: socket.socket) -> None:
        with theirs.wrap_socket(listener.accept()[0], server_side=True) as accepted:
            accepted.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    class Slow:
        """A context whose handshake is over when the other end has gone."""

        def wrap_socket(self, raw: socket.socket, server_hostname: str) -> ssl.SSLSocket:
            secured = ours.wrap_socket(raw, server_hostname=server_hostname)
            gone.result(EVENT_LIMIT_S)
            return secured

    monkeypatch.setattr(tls, "context", lambda _identity: Slow())
    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:
        gone = pool.submit(reset, listener)
        assert tls.handshake_failure(*listener.getsockname(), identity(folder, "r1")) == ""


def test_both_ends_need_the_same_kind_of_credentials(kantor: "Kantor") -> None:
    """Passwords for tls, certificates for tcp, folders that are of another kind: one line, exit 2."""
    folder = kantor.folder
    make(folder / "keys", robots=1)
    credentials.issue(folder / "passwords", "demo", ("r1",))
    before = contents(folder)

    def line_of(*arguments: object) -> str:
        finished = kantor(*arguments)
        assert finished.code == 2, finished
        assert finished.err.count("\n") == 1
        return finished.err.removeprefix("kantor: ")

    host = ("worldsim", "paper-single", "--listen")
    assert line_of(*host, "tls/127.0.0.1:1", "--credentials", "passwords").startswith(
        "tls/127.0.0.1:1: worldsim has a password, and tls takes certificates; make them with `kantor keys`"
    )
    assert line_of(*host, "tcp/127.0.0.1:1", "--credentials", "keys").startswith(
        "keys/worldsim.toml: a certificate; listen on tls/HOST:PORT"
    )
    assert line_of(*host, "tls/127.0.0.1:1", "--credentials", "nowhere").startswith(
        "nowhere: no credentials for worldsim"
    )
    assert line_of(*host, "tls/127.0.0.1:1", "--credentials", "keys", "--fleet", "other") == (
        "--fleet other: keys is of fleet demo; leave --fleet out\n"
    )
    assert line_of("worldsim", "fleet", "--listen", "tls/127.0.0.1:1", "--credentials", "keys") == (
        "keys: the register has no r2; `kantor keys demo --robots 5`\n"
    )
    assert line_of(
        "worldsim", "paper-centralized", "--set", "robots.count=1", "starts.random=true",
        "starts.poses_m=[]", "--listen", "tls/127.0.0.1:1",
        "--credentials", "keys",
    ) == "keys: the register has no supervisor; `kantor keys demo --supervisor`\n"  # fmt: skip
    agent = ("agent", "r1", "--connect")
    assert line_of(*agent, "tcp/127.0.0.1:1", "--credentials", "keys/r1.toml") == (
        "tcp/127.0.0.1:1: r1 has a certificate, and tcp takes passwords; use tls/127.0.0.1:1\n"
    )
    assert line_of(*agent, "tls/127.0.0.1:1", "--credentials", "passwords/r1.toml").startswith(
        "tls/127.0.0.1:1: r1 has a password"
    )
    assert contents(folder) == before


def contents(folder: Path) -> dict[Path, bytes]:
    """All the files below a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_certificate_is_refused_with_a_reason_where_passwords_are_used(folder: Path) -> None:
    """A robot with a certificate that meets world-sim without them, and something that does not answer at all."""
    r1 = identity(folder, "r1")
    passwords = credentials.issue(folder.parent / "passwords", FLEET, ROSTER)
    users = credentials.users_file(folder.parent / "passwords")
    plain = free_endpoint()
    with HubRouter(passwords["worldsim"], plain, users, ROSTER):
        assert "does not answer as one with certificates; check --connect" in refusal(
            plain.replace("tcp", "tls"), r1
        )


def test_world_sim_warns_of_certificates_that_expire(kantor: "Kantor") -> None:
    """A week ahead, a line for each certificate of the team, its own too, and for each that is revoked."""
    folder = kantor.folder / "keys"
    make(folder, robots=3, days=30)
    make(folder, renew=("worldsim", "r1"), days=7)
    make(folder, NOW - timedelta(days=3), renew=("r2",), days=1)
    make(folder, revoke=("r3",))
    world = kantor.start(
        "worldsim", "paper-single", "--set", "robots.count=3", "starts.random=true", "starts.poses_m=[]",
        "--listen", free_endpoint("tls"), "--credentials", "keys",
    )  # fmt: skip
    await_line(world, "t=")
    world.send_signal(signal.SIGINT)
    _, err = world.communicate(timeout=EVENT_LIMIT_S)

    warnings = [text for text in err.splitlines() if "warning" in text]
    assert len(warnings) == 4
    for text in (
        "r3 is revoked and will be refused",
        "worldsim's certificate expires on",
        "r1's certificate expires on",
        "r2's certificate expired on",
    ):
        assert sum(text in warning for warning in warnings) == 1


def test_a_robot_keeps_its_key_in_a_file_that_others_may_read(folder: Path) -> None:
    """Secrets that an engine mounts have modes and owners of their own."""
    (folder / "r1.toml").chmod(0o444)
    assert identity(folder / "r1.toml", "r1").user == "r1"
