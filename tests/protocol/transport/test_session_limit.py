"""The limit of sessions: connections are shut down by their remote address."""

import socket
from pathlib import Path

from kantor_protocol.transport.session_limit import shut_down
from support.limits import EVENT_LIMIT_S


def descriptors() -> int:
    """How many this process has open."""
    return len([*Path("/dev/fd").iterdir()])


def test_the_connection_to_an_address_is_shut_down_and_no_other() -> None:
    """The other end reads its end, another connection goes on, and no descriptor is left open."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        pairs = [
            (socket.create_connection(server.getsockname(), EVENT_LIMIT_S), server.accept()[0])
            for _ in range(2)
        ]
        (unwanted, _), (wanted, answering) = pairs
        before = descriptors()

        assert shut_down(f"tls/127.0.0.1:{unwanted.getsockname()[1]}")
        assert unwanted.recv(1) == b""
        answering.send(b"x")
        assert wanted.recv(1) == b"x"
        assert descriptors() == before
        for pair in pairs:
            for end in pair:
                end.close()


def test_an_address_without_a_connection_is_none() -> None:
    """Nothing is shut down."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert not shut_down(f"tcp/127.0.0.1:{server.getsockname()[1]}")
