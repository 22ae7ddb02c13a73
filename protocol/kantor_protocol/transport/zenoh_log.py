"""Zenoh's own log: silenced in clients, and read by a router for the reasons of refused connections."""

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterator

import zenoh

from kantor_protocol.transport import tls
from kantor_protocol.transport.credentials import Identity, Password
from kantor_protocol.transport.session import CLOSE_S


def init_log() -> None:
    """Zenoh's own log: silent, since kantor tells what a user can mend, unless RUST_LOG says more."""
    zenoh.init_log_from_env_or("off")


@contextlib.contextmanager
def host_log(identity: Identity, say: Callable[[str], None]) -> Iterator[None]:
    """`init_log` for a host; with certificates, also a line on whoever comes without a sound one.

    Zenoh tells of them in its log alone (zenoh#2712), without an address and with a misleading hint, and its log
    goes to standard output. In here its lines are read instead, while our own output goes on where it went.
    say: called from a thread.
    """
    if isinstance(identity, Password) or "RUST_LOG" in os.environ:
        init_log()
        yield
        return
    refusals = tls.Refusals(say)
    sys.stdout.flush()
    usual = sys.stdout
    reading, writing = os.pipe()
    kept = os.dup(1)
    os.dup2(writing, 1)
    os.close(writing)
    sys.stdout = os.fdopen(os.dup(kept), "w", encoding="utf-8", errors="replace", buffering=1)
    zenoh.init_log_from_env_or("zenoh_link_tls=warn")

    def read() -> None:
        with os.fdopen(reading, encoding="utf-8", errors="replace") as lines:
            for participant_session in lines:
                if reason := tls.logged_reason(participant_session):
                    refusals.tell(reason)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield
    finally:
        os.dup2(kept, 1)  # closes the pipe, unless somebody else holds it
        os.close(kept)
        reader.join(CLOSE_S)
        refusals.close()
        sys.stdout.flush()
        sys.stdout.close()
        sys.stdout = usual
