"""Clients of plain Zenoh that keep to no rule of kantor."""

import json
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from kantor_protocol.transport import zenoh_config


@contextmanager
def plain_session(
    endpoint: str, proof: zenoh_config.ZenohConfig, mode: str = "client", listen: str | None = None
) -> Iterator[zenoh.Session]:
    """Open plain Zenoh, with some credentials or none, without asking for membership first."""
    config = zenoh.Config()
    known = zenoh_config.common_config(mode, endpoint, listen) | {"connect/timeout_ms": 1000}
    for key, value in (known | proof).items():
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()
