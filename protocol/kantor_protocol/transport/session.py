"""Opening and closing of Zenoh sessions, and the error of a bus that cannot be reached."""

import contextlib
import json
import os
import threading
from typing import Any

import zenoh

from kantor_protocol.transport import zenoh_config

LEASE_MS, LOCKSTEP_LEASE_MS = zenoh_config.LEASE_MS, zenoh_config.LOCKSTEP_LEASE_MS


QUEUE_MAX = 16_384
"""Messages that wait for a reader; more are dropped."""


CLOSE_S = 5.0
"""Time to wait for a session to close."""


# One worker serves all of Zenoh in a participant: fewer threads, fewer wake-ups, less memory.
LIGHT_RUNTIME = (
    "(app: (worker_threads: 1), acc: (handover: app), tx: (handover: app), "
    "rx: (handover: app), net: (handover: app))"
)


class BusError(ConnectionError):
    """The bus cannot be reached, or refuses this process; the message is one line with the remedy."""


def be_light() -> None:
    """Have all of Zenoh in this process in one thread; before its first session, and not for a router."""
    os.environ.setdefault("ZENOH_RUNTIME", LIGHT_RUNTIME)


def open_session(
    mode: str,
    own: zenoh_config.ZenohConfig,
    *,
    connect: str | None = None,
    listen: str | None = None,
) -> zenoh.Session:
    """Open a session with the settings that all processes have and its own. Raises zenoh.ZError."""
    config = zenoh.Config()
    for key, value in (zenoh_config.common_config(mode, connect, listen) | own).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def close_session(session: zenoh.Session, declared: list[Any]) -> None:
    """Close within CLOSE_S: a close may block when the other side is gone. declared: on the session; it is cleared."""
    declared.clear()

    def close() -> None:
        with contextlib.suppress(zenoh.ZError):
            session.close()  # type: ignore[no-untyped-call]

    closing = threading.Thread(target=close, daemon=True)
    closing.start()
    closing.join(CLOSE_S)


def one_line(error: Exception) -> str:
    """The first line of one of Zenoh's errors, without the place in its source."""
    return str(error).splitlines()[0].partition(" at ")[0][:200]
