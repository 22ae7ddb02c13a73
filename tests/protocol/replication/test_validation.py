"""`validate` asserts the sentence at each attribute: a replica that breaks one of them is found out."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from kantor_protocol.replication.registers import STAMP_MAX, Registers
from kantor_protocol.replication.replica import Replica
from kantor_protocol.replication.replica_kernels import (
    HOLDING,
    KNOWN_MAX,
    LOWERED,
    OFFERED,
    RECEIVED_STEP,
    SAMPLE,
    SENT,
    SHIPPED,
    SINCE_NS,
    STAMP,
    STAMP_STEP,
    STEP,
    spend,
)
from kantor_protocol.wire.weights import Units

N = 6
UNITS = Units.of(8, N)
"""Four units a sample, three a point."""
MODES = pytest.mark.parametrize("ledger", [True, False], ids=["ledger", "min"])


def replica(me: int, *, ledger: bool) -> Replica:
    """One of two, with registers."""
    registers = Registers(me, 2, 2)
    return Replica(me, 2, N, UNITS, ledger=ledger, claims=True, registers=registers)


def with_a_past(*, ledger: bool) -> Replica:
    """A replica that has spent, claimed, sent, and merged a message of a later incarnation."""
    one, other = replica(0, ledger=ledger), replica(3, ledger=ledger)
    for held in (one, other):
        spend(held.store, held.config, 2 + held.config.me, 2)
        held.claim(held.config.me, 7)
        held.registers.add(np.array([3, -1]))
    for held, source in ((one, other), (other, one), (one, other)):
        message = (*source.compose(), source.registers.compose())
        source.end_step()
        assert held.merge(source.config.me, *message)
    return one


Break = Callable[[Replica], Any]

BROKEN: dict[str, Break] = {
    "weight-above-the-initial": lambda r: r.store.weights.__setitem__(1, 5),
    "weight-below-0": lambda r: r.store.weights.__setitem__(1, -1),
    "weight-that-no-entry-explains": lambda r: r.store.weights.__setitem__(1, 3),
    "entry-of-no-sample": lambda r: r.store.logs.__setitem__((0, 0, 0), N),
    "entry-above-the-largest-value": lambda r: r.store.logs.__setitem__((0, 0, 1), 5),
    "entry-that-lowered-nothing": lambda r: r.store.logs.__setitem__((0, 0, 1), 1),
    "forgotten-entry": lambda r: r.store.length.__setitem__(0, 0),
    "log-beyond-its-room": lambda r: r.store.length.__setitem__(0, 257),
    "known-below-0": lambda r: r.store.known.__setitem__((3, 0), -1),
    "known-beyond-all": lambda r: r.store.known.__setitem__((3, 0), KNOWN_MAX + 1),
    "known-of-itself": lambda r: r.store.known.__setitem__((0, 0), 1),
    "known-of-the-silent": lambda r: r.store.known.__setitem__((1, 0), 1),
    "sent-more-than-there-is": lambda r: r.store.sending.__setitem__((SENT, 0), 9),
    "received-from-the-future": lambda r: r.store.sending.__setitem__((RECEIVED_STEP, 3), 9),
    "received-from-itself": lambda r: r.store.sending.__setitem__((RECEIVED_STEP, 0), 1),
    "claim-of-no-sample": lambda r: r.store.claims.__setitem__((SAMPLE, 3), N),
    "claim-before-time-began": lambda r: r.store.claims.__setitem__((SINCE_NS, 3), -1),
    "claim-without-a-stamp": lambda r: r.store.claims.__setitem__((SAMPLE, 1), 2),
    "own-claim-of-the-future": lambda r: r.store.claims.__setitem__((STAMP, 0), 9),
    "claim-received-in-the-future": lambda r: r.store.claims.__setitem__((STAMP_STEP, 3), 9),
    "fallen-twice": lambda r: r.store.counters.__setitem__(LOWERED, 2),
    "miscounted-units": lambda r: r.store.sending.__setitem__((SHIPPED, 3), 1),
    "more-offered-than-held": lambda r: r.store.sending.__setitem__((OFFERED, 3), 9),
    "mark-of-a-later-step": lambda r: r.store.mark.__setitem__(0, 9),
    "miscounted-weights": lambda r: r.store.counters.__setitem__(HOLDING, 1),
    "steps-apart": lambda r: r.store.counters.__setitem__(STEP, 9),
    "total-that-is-no-sum": lambda r: r.registers.total.__setitem__(1, 0),
    "stamp-beyond-reason": lambda r: r.registers.stamps.__setitem__(3, STAMP_MAX + 1),
    "register-without-a-write": lambda r: r.registers.stamps.__setitem__(3, 0),
    "sum-beyond-the-count": lambda r: r.registers.add(np.array([0, 9])),
    "register-offered-that-is-another": lambda r: setattr(
        r.registers, "offered", r.registers.values.copy()
    ),
    "register-known-of-itself": lambda r: r.registers._known.__setitem__((0, 0), 1),
    "register-sent-before-it-was-written": lambda r: r.registers._sent.__setitem__((0, 1), 1),
    "register-replaced-in-the-future": lambda r: r.registers._updated.__setitem__(3, 9),
    "register-received-from-itself": lambda r: r.registers._received.__setitem__(0, 1),
    "fewer-registers-than-origins": lambda r: r.registers._make_room(2),
}


@pytest.fixture(name="built_replicas_are_valid")
def _broken_replicas_are_not() -> None:
    """Nothing to validate on teardown here."""


@MODES
def test_a_replica_with_a_past_is_valid(*, ledger: bool) -> None:
    """Also one that has made room for an incarnation."""
    held = with_a_past(ledger=ledger)
    held.validate()

    assert held.origins == 4
    assert held.store.length.tolist() == [1, 0, 0, 1] if ledger else [2, 0, 0, 2]


@pytest.mark.parametrize("name", BROKEN)
@MODES
def test_each_broken_invariant_is_found(*, ledger: bool, name: str) -> None:
    """One number is wrong, and `validate` says so."""
    held = with_a_past(ledger=ledger)
    BROKEN[name](held)

    with pytest.raises(AssertionError):
        held.validate()
