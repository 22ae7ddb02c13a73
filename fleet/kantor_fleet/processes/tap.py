"""`kantor tap`: messages on the bus, decoded with plain msgpack, independently of kantor's codec."""

import sys
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import msgpack

from kantor_fleet.exits import Exit, fail
from kantor_fleet.interrupts import Interrupts
from kantor_fleet.output import is_lost
from kantor_protocol.transport import credentials
from kantor_protocol.transport.client import observer_session
from kantor_protocol.transport.endpoint import await_endpoint, check_endpoint
from kantor_protocol.transport.zenoh_log import init_log
from kantor_protocol.wire import keys

KINDS = frozenset({"pose", "weights", "tx", "rx", keys.WORLD})
_BYTES_SHOWN = 24
_ITEMS_SHOWN = 12
_TEXT_SHOWN = 80
"""Characters of a text."""
_DEPTH_SHOWN = 8
"""Nesting, of radio bodies too."""
_LINE_SHOWN = 1000
"""Characters of a line."""


class _Pairs(list[tuple[Any, Any]]):
    """A map as msgpack has it: any value can be a key."""


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
                if is_lost():
                    break
    return Exit.DONE


def describe(payload: bytes) -> str:
    """A message as one line of printable characters: its size, and its content as msgpack decodes it."""
    try:
        content = _unpacked(payload)
    except _UNDECODABLE as error:
        line = f"{len(payload)} B, not msgpack ({type(error).__name__}): {_shown(payload)}"
    else:
        line = f"{len(payload)} B  {_shown(content)}"
    line = line if len(line) <= _LINE_SHOWN else f"{line[:_LINE_SHOWN]}…"
    return "".join(letter if letter.isprintable() else _escaped(letter) for letter in line)


_UNDECODABLE = (ValueError, TypeError, OverflowError, msgpack.UnpackException, RecursionError)


def _unpacked(payload: bytes) -> Any:
    """The content of msgpack. Raises one of _UNDECODABLE."""
    return msgpack.unpackb(payload, strict_map_key=False, object_pairs_hook=_Pairs)


def _escaped(letter: str) -> str:
    return letter.encode("unicode_escape", "surrogatepass").decode("ascii")


def _shown(value: Any, depth: int = 0) -> str:
    """A value as text, shortened where it is long or deep; radio bodies are decoded too."""
    if depth == _DEPTH_SHOWN:
        return "…"
    if isinstance(value, bytes):
        inner = _radio_body(value)
        return _shown_bytes(value) if inner is None else f"<{_shown(inner, depth + 1)}>"
    if isinstance(value, _Pairs):
        pairs = (f"{_shown(key, depth + 1)}: {_shown(item, depth + 1)}" for key, item in value)
        return f"{{{_listed(pairs, len(value))}}}"
    if isinstance(value, list):
        return f"[{_listed((_shown(item, depth + 1) for item in value), len(value))}]"
    return _shown_leaf(value)


def _shown_leaf(value: Any) -> str:
    if isinstance(value, str):
        more = f"…({len(value)} characters)" if len(value) > _TEXT_SHOWN else ""
        return f"{value[:_TEXT_SHOWN]!r}{more}"
    if isinstance(value, msgpack.ExtType):
        return f"type {value.code}: {_shown_bytes(value.data)}"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def _listed(items: Iterator[str], count: int) -> str:
    """The first of some items."""
    more = [f"…({count})"] if count > _ITEMS_SHOWN else []
    return ", ".join([*islice(items, _ITEMS_SHOWN), *more])


def _shown_bytes(value: bytes) -> str:
    more = f"…({len(value)} B)" if len(value) > _BYTES_SHOWN else ""
    return f"0x{value[:_BYTES_SHOWN].hex()}{more}"


def _radio_body(value: bytes) -> list[Any] | None:
    """The decoded body of an envelope, an array that begins with a tag and a version; None for other bytes."""
    try:
        inner = _unpacked(value)
    except _UNDECODABLE:
        return None
    whole = isinstance(inner, list) and len(inner) > 2
    return inner if whole and inner[:2] == [1, 1] else None
