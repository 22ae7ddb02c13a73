"""Counter-based keyed randomness: a draw is a pure function of a key and a counter.

Nothing here has state, so a draw does not depend on the process that makes it, on order, or on repetition: every
process evaluates the same number alone, and a lost message never shifts the draws that follow.

The generator is Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC'11).
The key is the run's seed; the counter is (purpose, who, step, index).
"""

import enum

import numpy as np

from kantor_protocol.compilation import light_numba  # noqa: F401  before numba

# isort: split
from numba import uint32, uint64

from kantor_protocol.base.kernels import kernel

_MULTIPLIER_0 = np.uint64(0xD2511F53)
_MULTIPLIER_1 = np.uint64(0xCD9E8D57)
_WEYL_0 = np.uint64(0x9E3779B9)
_WEYL_1 = np.uint64(0xBB67AE85)
_LOW = np.uint64(0xFFFFFFFF)
_HIGH = np.uint64(32)
_TO_UNIT = 2.0**-53


class Purpose(enum.IntEnum):
    """The purpose of a draw; the first word of its counter, so that no two purposes share draws."""

    SAMPLE_WALK = 1
    TARGET_WALK = 2
    DROP = 3
    DELAY = 4
    DUPLICATE = 5
    REORDER = 6
    CLOCK_PERIOD = 7
    CLOCK_DRIFT = 8
    CLOCK_JITTER = 9
    SAMPLES = 10
    TARGETS = 11
    STARTS = 12
    SUBSET = 13
    MAP = 14
    SCAN = 15
    CENTROIDS = 16
    MARKET = 17
    FAULT_DROP = 18
    FAULT_BURST = 19
    FAULT_DELAY = 20
    FAULT_DUPLICATE = 21
    FAULT_REPLAY = 22
    FAULT_REORDER = 23
    FAULT_FLAP = 24
    FAULT_HOSTILE = 25
    FORGERY = 26
    CAMPAIGN = 27
    LIE = 28


@kernel
def philox(seed: int, purpose: int, who: int, step: int, index: int) -> tuple[int, int]:
    """One Philox4x32-10 block as two 64-bit words (uint64), from a seed below 2^63 and four 32-bit counters."""
    key_0 = uint64(seed) & _LOW
    key_1 = uint64(seed) >> _HIGH
    word_0 = uint64(uint32(purpose))
    word_1 = uint64(uint32(who))
    word_2 = uint64(uint32(step))
    word_3 = uint64(uint32(index))
    for _ in range(10):
        product_0 = _MULTIPLIER_0 * word_0
        product_1 = _MULTIPLIER_1 * word_2
        word_0 = (product_1 >> _HIGH) ^ word_1 ^ key_0
        word_1 = product_1 & _LOW
        word_2 = (product_0 >> _HIGH) ^ word_3 ^ key_1
        word_3 = product_0 & _LOW
        key_0 = (key_0 + _WEYL_0) & _LOW
        key_1 = (key_1 + _WEYL_1) & _LOW
    return (word_1 << _HIGH) | word_0, (word_3 << _HIGH) | word_2


@kernel
def to_unit(word: int) -> float:
    """A 64-bit word as a float in [0, 1), from its upper 53 bits."""
    return float(uint64(word) >> uint64(11)) * _TO_UNIT


@kernel
def uniform(seed: int, purpose: int, who: int, step: int, index: int) -> float:
    """A float in [0, 1) for this key and counter."""
    return to_unit(philox(seed, purpose, who, step, index)[0])


def generator(seed: int, purpose: Purpose) -> np.random.Generator:
    """Numpy's generator (Philox4x64) for draws that one process makes once, such as the samples."""
    return np.random.Generator(np.random.Philox(key=np.array([seed, purpose], dtype=np.uint64)))
