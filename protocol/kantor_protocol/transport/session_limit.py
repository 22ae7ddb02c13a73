"""The limit of sessions that one certificate has at a router.

Zenoh limits sessions in all, and closes none on request: the connection under a link that is one too many is shut
down instead. Only certificates are limited, since a link does not tell the user of a password.
"""

import contextlib
import os
import socket
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import zenoh

from kantor_protocol.transport import tls
from kantor_protocol.transport.endpoint import parse_endpoint
from kantor_protocol.transport.zenoh_config import SESSIONS_MORE, SESSIONS_OF_EACH


class SessionLimit:
    """Keeps room for a few sessions of each certificate; the rest is common to all, such as observers.

    When the rest is used up, what a certificate opens beyond its few is shut down.
    """

    def __init__(self, session: zenoh.Session, notify: Callable[[str], None]) -> None:
        """session: the router's. notify: takes a line about each certificate with too many; called from a thread."""
        self._held: dict[str, set[str]] = {}
        """Remote addresses of the links of each certificate that are kept."""
        self._holding = threading.Lock()
        self._log = tls.RefusalLog(notify)
        self._listener = session.info.declare_link_events_listener(self._on_link)

    def close(self) -> None:
        """Report what has not been reported yet."""
        del self._listener
        self._log.close()

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        name, address = event.link.auth_identifier, str(event.link.dst)
        if not name:
            return
        with self._holding:
            held = self._held.setdefault(name, set())
            if event.kind != zenoh.SampleKind.PUT:
                held.discard(address)
            elif len(held) < SESSIONS_OF_EACH or self._more < SESSIONS_MORE:
                held.add(address)
            elif shut_down(address):
                user = name.partition(".")[0]
                self._log.report(f"{user} opens too many sessions, which are closed")

    @property
    def _more(self) -> int:
        """Sessions that certificates have beyond their few."""
        return sum(max(0, len(held) - SESSIONS_OF_EACH) for held in self._held.values())


def shut_down(address: str) -> bool:
    """Shut down the connection of this process to an address such as `tls/127.0.0.1:50000`; whether there was one."""
    _, host, port = parse_endpoint(address)
    for path in Path("/dev/fd").iterdir():
        with contextlib.suppress(OSError):  # it was closed meanwhile, or is not connected
            descriptor = os.dup(int(path.name))
            if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                os.close(descriptor)
                continue
            with socket.socket(fileno=descriptor) as connection:
                if connection.getpeername()[:2] == (host, port):
                    connection.shutdown(socket.SHUT_RDWR)
                    return True
    return False
