"""`kantor tap`: messages on the bus, decoded with plain msgpack, independently of kantor's codec."""

import sys
import time
from pathlib import Path
from typing import Any

import msgpack

from kantor_fleet.exits import Exit, fail
from kantor_fleet.interrupts import Interrupts
from kantor_protocol.transport import credentials
from kantor_protocol.transport.client import observer_session
from kantor_protocol.transport.endpoint import await_endpoint, check_endpoint
from kantor_protocol.transport.zenoh_log import init_log
from kantor_protocol.wire import keys

KINDS = frozenset({"pose", "weights", "tx", "rx", keys.WORLD})
_BYTES_SHOWN = 24
_ITEMS_SHOWN = 12


def tap(
    connect: str, place: Path, only: frozenset[str], count: int, connect_timeout_s: float
) -> Exit:
    """Print messages until a signal arrives or `count` were printed. Raises BusError, CredentialsError."""
    if only - KINDS:
        known = ", ".join(sorted(KINDS))
        fail(Exit.USAGE, f"--only {', '.join(sorted(only - KINDS))}: use {known}")
    check_endpoint(connect)
    if not place.exists() or place.is_dir():
        await_endpoint(connect, connect_timeout_s)
    identity = credentials.find(place, credentials.OBSERVER)
    init_log()
    everything = keys.everything(identity.fleet)
    started, printed = time.monotonic(), 0
    with (
        Interrupts() as interrupts,
        observer_session(connect, identity, everything, connect_timeout_s) as watch,
    ):
        while not interrupts() and (not count or printed < count):
            message = watch.next(0.2)
            key = keys.parse(message[0]) if message is not None else None
            if message is None or key is None:
                continue
            kind = keys.WORLD if key.name == keys.WORLD else key.kind
            if not only or kind in only:
                printed += 1
                elapsed = time.monotonic() - started
                print(f"{elapsed:9.3f}  {key.name:<10} {key.kind:<8} {describe(message[1])}")
                sys.stdout.flush()
    return Exit.DONE


def describe(payload: bytes) -> str:
    """A message as one line: its size, and its content as msgpack decodes it."""
    try:
        content = msgpack.unpackb(payload, strict_map_key=False)
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        return f"{len(payload)} B, not msgpack ({type(error).__name__}): {_shown(payload)}"
    return f"{len(payload)} B  {_shown(content)}"


def _shown(value: Any) -> str:
    """A value as text, shortened where it is long; radio bodies are decoded too."""
    if isinstance(value, bytes):
        inner = _radio_body(value)
        if inner is not None:
            return f"<{_shown(inner)}>"
        more = f"…({len(value)} B)" if len(value) > _BYTES_SHOWN else ""
        return f"0x{value[:_BYTES_SHOWN].hex()}{more}"
    if isinstance(value, list):
        items = [_shown(item) for item in value[:_ITEMS_SHOWN]]
        items += [f"…({len(value)})"] if len(value) > _ITEMS_SHOWN else []
        return f"[{', '.join(items)}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_shown(item)}" for key, item in value.items()) + "}"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def _radio_body(value: bytes) -> list[Any] | None:
    """The decoded body of an envelope, an array that begins with a tag and a version; None for other bytes."""
    try:
        inner = msgpack.unpackb(value, strict_map_key=False)
    except (ValueError, msgpack.UnpackException, RecursionError):
        return None
    whole = isinstance(inner, list) and len(inner) > 2
    return inner if whole and inner[:2] == [1, 1] else None
