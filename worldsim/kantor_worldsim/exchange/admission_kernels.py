"""The compiled kernels of admission: what an envelope says, number by number, against what can be.

The messages have passed the checks of every receiver (`MessageCheck`): they are well-formed, and what they name is
within bounds.
"""

import numpy as np

from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import read_int, read_pair, read_uint
from kantor_protocol.wire.version_vector import count_ids

POSSIBLE, NO_INCARNATION, HELD, OWN_LENGTH, FOREIGN, OWN, BELOW, STAMP = 0, 1, 2, 3, 4, 5, 6, 7

REASONS = {
    POSSIBLE: "",
    NO_INCARNATION: "an envelope about an incarnation that never was",
    HELD: "an envelope that holds more of a log than its origin has written",
    OWN_LENGTH: "an envelope with a longer log of its own than it can have",
    FOREIGN: "an envelope with entries of a log that their origin never made",
    OWN: "an envelope with entries of its own log that it never made",
    BELOW: "an envelope with a weight below what all spending leaves",
    STAMP: "an envelope with a stamp that its origin has not reached",
}
"""What is wrong with an envelope."""

# Entries of the settings.
ROSTER, LEDGER, BARE, CLAIMS, SAMPLE_UNITS, LENGTH_MAX = 0, 1, 2, 3, 4, 5

# Rows of the stamps.
OF_CLAIMS, OF_REGISTERS = 0, 1


@kernel
def _is_ahead(reached: np.ndarray, origin: int, stamp: int, own: int, step: int) -> bool:
    """Whether an origin has not reached a stamp; the sender may have, in this step. reached: (ids,)."""
    return bool(stamp > (step if origin == own else reached[origin]))


@kernel
def _check_version_vector(
    written: np.ndarray,
    stamps: np.ndarray,
    settings: np.ndarray,
    version_vector: bytes,
    own: int,
    own_length: int,
    step: int,
) -> int:
    """Nobody holds more than there is."""
    parts = 2 if settings[CLAIMS] else 1
    covered = count_ids(version_vector, settings[ROSTER], parts)
    if covered > written.shape[0]:
        return NO_INCARNATION
    at = 0
    for origin in range(covered):
        length, at = read_uint(version_vector, at)
        if origin == own and length > own_length:
            return OWN_LENGTH
        if origin != own and length > written[origin]:
            return HELD
    for origin in range(covered if parts == 2 else 0):
        stamp, at = read_uint(version_vector, at)
        if _is_ahead(stamps[OF_CLAIMS], origin, stamp, own, step):
            return STAMP
    return POSSIBLE


@kernel
def _check_entry(
    logs: np.ndarray,
    written: np.ndarray,
    consumed: np.ndarray,
    false_logs: np.ndarray,
    settings: np.ndarray,
    origin: int,
    own: int,
    position: int,
    index: int,
    value: int,
) -> int:
    """An entry of a log is what its origin has written there. written: with what the sender writes in this step."""
    if not settings[LEDGER]:
        return POSSIBLE if value >= settings[SAMPLE_UNITS] - consumed[index] else BELOW
    if origin != own and false_logs[origin % settings[ROSTER]]:
        return POSSIBLE
    if position < written[origin]:
        same = logs[origin, position, 0] == index
        if not settings[BARE]:
            same = same and logs[origin, position, 1] == value
        return POSSIBLE if same else OWN if origin == own else FOREIGN
    if origin != own:
        return FOREIGN
    return POSSIBLE if settings[BARE] else OWN


@kernel
def _check_logs(
    logs: np.ndarray,
    written: np.ndarray,
    consumed: np.ndarray,
    false_logs: np.ndarray,
    settings: np.ndarray,
    suffixes: bytes,
    own: int,
) -> int:
    at = 0
    while at < len(suffixes):
        origin, at = read_uint(suffixes, at)
        start, at = read_uint(suffixes, at)
        _span, at = read_uint(suffixes, at)
        count, at = read_uint(suffixes, at)
        if origin >= written.shape[0]:
            return NO_INCARNATION
        if settings[LEDGER] and start > written[origin]:
            return OWN if origin == own else FOREIGN
        index = 0
        for position in range(start, start + count):
            index, value, at = read_pair(suffixes, at, index, settings[BARE] == 0)
            code = _check_entry(
                logs, written, consumed, false_logs, settings, origin, own, position, index, value
            )
            if code != POSSIBLE:
                return code
    return POSSIBLE


@kernel
def _check_claims(stamps: np.ndarray, claimed: bytes, own: int, step: int) -> int:
    at = 0
    while at < len(claimed):
        origin, at = read_uint(claimed, at)
        stamp, at = read_uint(claimed, at)
        _sample, at = read_uint(claimed, at)
        _since_ns, at = read_uint(claimed, at)
        if _is_ahead(stamps[OF_CLAIMS], origin, stamp, own, step):
            return STAMP
    return POSSIBLE


@kernel
def _check_registers(
    stamps: np.ndarray, registers: bytes, covered: int, own: int, step: int
) -> int:
    at = 0
    for origin in range(covered if len(registers) else 0):
        stamp, at = read_uint(registers, at)
        if _is_ahead(stamps[OF_REGISTERS], origin, stamp, own, step):
            return STAMP
    while at < len(registers):
        origin, at = read_uint(registers, at)
        stamp, at = read_uint(registers, at)
        numbers, at = read_uint(registers, at)
        for _ in range(numbers):
            _number, at = read_int(registers, at)
        if _is_ahead(stamps[OF_REGISTERS], origin, stamp, own, step):
            return STAMP
    return POSSIBLE


@kernel
def judge(
    logs: np.ndarray,
    written: np.ndarray,
    consumed: np.ndarray,
    stamps: np.ndarray,
    false_logs: np.ndarray,
    settings: np.ndarray,
    version_vector: bytes,
    suffixes: bytes,
    claimed: bytes,
    registers: bytes,
    own: int,
    step: int,
) -> int:
    """Judge the parts of a message by its sender's incarnation id and step: POSSIBLE, or what is wrong.

    logs: (ids, rows, 2 or 1) entries as their origins wrote them; written: (ids,) how many. consumed: (N,) units.
    written and consumed include what the sender has spent in this step. stamps: (2, ids) of the newest claim and
    register of each origin. false_logs: (roster,) whose entries are not compared. settings: see the constants above.
    """
    exact = settings[LEDGER] and not settings[BARE]
    own_length = written[own] if exact else settings[LENGTH_MAX]
    code = _check_version_vector(written, stamps, settings, version_vector, own, own_length, step)
    if code == POSSIBLE:
        code = _check_logs(logs, written, consumed, false_logs, settings, suffixes, own)
    if code == POSSIBLE:
        code = _check_claims(stamps, claimed, own, step)
    if code == POSSIBLE:
        covered = count_ids(version_vector, settings[ROSTER], 2 if settings[CLAIMS] else 1)
        code = _check_registers(stamps, registers, covered, own, step)
    return code


@kernel
def learn(
    logs: np.ndarray,
    written: np.ndarray,
    stamps: np.ndarray,
    settings: np.ndarray,
    version_vector: bytes,
    suffixes: bytes,
    registers: bytes,
    own: int,
) -> None:
    """Note what an accepted message says of its sender's own log, claim and register. `logs` has room for it."""
    parts = 2 if settings[CLAIMS] else 1
    covered = count_ids(version_vector, settings[ROSTER], parts)
    at = 0
    for i in range(covered * parts):
        number, at = read_uint(version_vector, at)
        if i == own and not settings[LEDGER]:
            written[own] = max(written[own], number)
        if i == covered + own:
            stamps[OF_CLAIMS, own] = max(stamps[OF_CLAIMS, own], number)
    at = 0
    for origin in range(covered if len(registers) else 0):
        stamp, at = read_uint(registers, at)
        if origin == own:
            stamps[OF_REGISTERS, own] = max(stamps[OF_REGISTERS, own], stamp)
    at = 0
    while settings[BARE] and at < len(suffixes):
        origin, at = read_uint(suffixes, at)
        start, at = read_uint(suffixes, at)
        _span, at = read_uint(suffixes, at)
        count, at = read_uint(suffixes, at)
        index = 0
        for position in range(start, start + count):
            index, _value, at = read_pair(suffixes, at, index, False)
            if origin == own and position == written[own]:
                logs[own, position, 0] = index
                written[own] += 1


@kernel
def spend(
    logs: np.ndarray,
    written: np.ndarray,
    consumed: np.ndarray,
    ledger: bool,
    samples: np.ndarray,
    units: np.ndarray,
    own: int,
    back: bool,
) -> None:
    """Count what a step ships, or take it back: entries of its log, with a ledger, or what is consumed.

    samples, units: (n,) the entries. `logs` has room for them; what is taken back was counted last.
    """
    length = written[own]
    for i in range(samples.shape[0]):
        if not ledger:
            consumed[samples[i]] += -units[i] if back else units[i]
        elif not back:
            logs[own, length + i, 0] = samples[i]
            logs[own, length + i, 1] = units[i]
    if ledger:
        written[own] += -samples.shape[0] if back else samples.shape[0]
