"""Contents of replicas and of their messages as plain values, and the validation of every replica that a test builds."""

import contextlib
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from kantor_protocol.replication import replica_kernels
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import LENGTH_MAX


@contextlib.contextmanager
def validating() -> Iterator[list[Replica]]:
    """Validate every replica that is built meanwhile, at the end; they are in the list."""
    built: list[Replica] = []
    build = Replica.__init__

    def build_and_note(self: Replica, *arguments: object, **named: object) -> None:
        build(self, *arguments, **named)
        built.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Replica, "__init__", build_and_note)
        yield built
    for held in built:
        held.validate()


def entries(held: Replica, origin: int) -> list[tuple[int, int]]:
    """The held log of an origin, as (sample, value); with min only the own log is held."""
    row, length = (origin if held.config.ledger else 0), int(held.store.length[origin])
    return [(index, value) for index, value in held.store.logs[row, :length].tolist()]


def claimed_by_others(held: Replica) -> list[int]:
    """Samples that others have claimed and this participant must leave, as its planner asks."""
    room = np.zeros(held.origins, dtype=np.int64)
    claims, counters, me = held.store.claims, held.store.counters, held.config.me
    return room[: replica_kernels.claimed_by_others(claims, counters, me, room)].tolist()


def read_logs(logs: bytes, *, valued: bool = True) -> npt.NDArray[np.int64] | None:
    """The entries in a message, as rows (origin, position, sample, value); None if malformed.

    valued: entries have values, see ReplicaConfig. With min, positions count the entries that were sent, which may be
    fewer than the span.
    """
    numbers, rows = _numbers(logs), []
    try:
        for origin in numbers:
            start, _span, count, index = next(numbers), next(numbers), next(numbers), 0
            if start > LENGTH_MAX or count > len(logs):
                return None
            for i in range(count):
                folded = next(numbers)
                index += -(folded >> 1) - 1 if folded & 1 else folded >> 1
                rows.append((origin, start + i, index, next(numbers) if valued else 0))
    except (StopIteration, ValueError):
        return None
    return np.array(rows, dtype=np.int64).reshape(-1, 4)


def _numbers(content: bytes) -> Iterator[int]:
    """LEB128. Raises ValueError for one that is cut off or takes more than 63 bits."""
    value = shift = 0
    for byte in content:
        value |= (byte & 127) << shift
        shift = shift + 7 if byte >= 128 else 0
        if shift == 63:
            raise ValueError("too long")
        if not shift:
            yield value
            value = 0
    if shift:
        raise ValueError("cut off")
