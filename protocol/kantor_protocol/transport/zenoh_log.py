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

_WITHOUT_SECRETS = "zenoh::api::session=info"


def init_log() -> None:
    """Silence Zenoh's own log, unless RUST_LOG is set: kantor reports the errors that a user can repair.

    Whatever RUST_LOG asks for, the configuration of a session is not printed: it has the password or the key.
    """
    if wanted := os.environ.get("RUST_LOG"):
        os.environ["RUST_LOG"] = f"{wanted},{_WITHOUT_SECRETS}"
    zenoh.init_log_from_env_or("off")


@contextlib.contextmanager
def host_log(identity: Identity, notify: Callable[[str], None]) -> Iterator[None]:
    """`init_log` for a router; with certificates, also a line about clients without a valid one.

    Zenoh reports them in its log alone (zenoh#2712), without an address and with a misleading hint, and its log goes
    to standard output. Within this context its lines are read instead, while kantor's own output goes where it went.
    notify: takes a line for the operator; called from a thread.
    """
    if isinstance(identity, Password) or "RUST_LOG" in os.environ:
        init_log()
        yield
        return
    refusals = tls.RefusalLog(notify)
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
            for line in lines:
                if reason := tls.logged_reason(line):
                    refusals.report(reason)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield
    finally:
        os.dup2(kept, 1)  # closes the pipe, unless another process holds it
        os.close(kept)
        reader.join(CLOSE_S)
        refusals.close()
        sys.stdout.flush()
        sys.stdout.close()
        sys.stdout = usual
