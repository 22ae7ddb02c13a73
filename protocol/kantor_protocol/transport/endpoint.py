"""Endpoints of the bus: their syntax, whether one is free, and waiting for one to come up."""

import socket
import time
from collections.abc import Callable

from kantor_protocol.transport import tls
from kantor_protocol.transport.credentials import Certificate, CredentialsError, Identity, Password
from kantor_protocol.transport.session import BusError


def free_endpoint(protocol: str = "tcp") -> str:
    """A loopback endpoint on which nothing listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


def await_endpoint(
    connect: str,
    connect_timeout_s: float,
    identity: Identity | None = None,
    monotonic: Callable[[], float] = time.monotonic,
) -> None:
    """Return once a router accepts connections there.

    identity: if it is a certificate, a TLS handshake with it must succeed as well. Raises BusError after
    `connect_timeout_s`, and at once, with the reason, if either side refuses the other.
    """
    _, host, port = parse_endpoint(connect)
    give_up = monotonic() + connect_timeout_s
    pause_s = 0.02
    while True:
        try:
            reason = _probe(host, port, identity)
        except socket.gaierror:
            raise BusError(f"{connect}: no such host; check --connect") from None
        except OSError:
            if monotonic() >= give_up:
                raise BusError(
                    f"{connect}: nothing listens there after {connect_timeout_s:g} s; "
                    f"start `kantor worldsim` or check --connect"
                ) from None
        else:
            if reason:
                raise BusError(f"{connect}: {reason}")
            return
        time.sleep(pause_s)
        pause_s = min(0.2, 1.5 * pause_s)


def _probe(host: str, port: int, identity: Identity | None) -> str:
    """Why either side refuses the other; empty if neither does. Raises OSError if nothing listens there."""
    if isinstance(identity, Certificate):
        return tls.handshake_failure(host, port, identity)
    socket.create_connection((host, port), timeout=1.0).close()
    return ""


def is_crowded(connect: str) -> bool:
    """Whether the router closes new connections at once, because too many are about to prove who they are.

    False as well if nothing listens there.
    """
    _, host, port = parse_endpoint(connect)
    try:
        with socket.create_connection((host, port), timeout=1.0) as probe:
            probe.settimeout(_CLOSES_WITHIN_S)
            return probe.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionResetError:
        return True
    except OSError:
        return False


_CLOSES_WITHIN_S = 0.2


def parse_endpoint(endpoint: str) -> tuple[str, str, int]:
    """Protocol, host and port of an endpoint. Raises BusError."""
    protocol, _, place = endpoint.partition("/")
    host, _, port = place.rpartition(":")
    sound = protocol in {"tcp", "tls"} and host and port.isdecimal() and port.isascii()
    if not sound or not 0 < int(port[:6]) <= 65535:
        raise BusError(
            f"{endpoint}: not an endpoint; write it as tcp/HOST:PORT or tls/HOST:PORT, "
            "with a port from 1 to 65535"
        )
    return protocol, host.strip("[]"), int(port)


def is_tls(endpoint: str) -> bool:
    """Whether an endpoint is for certificates. Raises BusError if it is none."""
    return parse_endpoint(endpoint)[0] == "tls"


def check_endpoint(endpoint: str, identity: Identity | None = None) -> None:
    """Raise BusError unless it reads tcp/HOST:PORT or tls/HOST:PORT.

    identity: raise CredentialsError unless it is of the kind that the endpoint is for.
    """
    protocol, _, place = endpoint.partition("/")
    if is_tls(endpoint) and isinstance(identity, Password):
        raise CredentialsError(
            f"{endpoint}: {identity.user} has a password, and tls takes certificates; "
            f"make them with `kantor keys`, or use tcp/{place}"
        )
    if protocol == "tcp" and isinstance(identity, Certificate):
        raise CredentialsError(
            f"{endpoint}: {identity.user} has a certificate, and tcp takes passwords; use tls/{place}"
        )


def check_free(listen: str) -> None:
    """Raise BusError if another process listens there."""
    _, host, port = parse_endpoint(listen)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            reason = error.strerror or error
            raise BusError(f"cannot listen on {listen}: {reason}; choose another") from None
