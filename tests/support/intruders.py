"""Those who come to the bus with Zenoh alone, and keep to no manners of ours."""

import json
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from kantor_protocol.transport import zenoh_config


@contextmanager
def plain_session(
    endpoint: str, proof: zenoh_config.ZenohConfig, mode: str = "client", listen: str | None = None
) -> Iterator[zenoh.Session]:
    """Plain Zenoh without rules, with some proof of who it is or with none. It asks nobody whether it may."""
    config = zenoh.Config()
    known = zenoh_config.common_config(mode, endpoint, listen) | {"connect/timeout_ms": 1000}
    for key, value in (known | proof).items():
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()
