"""Integer weights, and how a robot publishes its weight vector (design: a keyframe or what changed).

One unit is 1/L of the whole mass, L = lcm(M, N): every sample starts with L/N units and every robot
point ships L/M, so that conservation is an equality and no residue keeps a sample alive.
"""

import math
import zlib

import msgspec
import numpy as np
import numpy.typing as npt

from kantor_protocol.base.kernels import kernel, typed
from kantor_protocol.base.varint import Pairs

Weights = npt.NDArray[np.signedinteger]

SAMPLES_MAX = 50_000_000
"""Samples of a mission, at most."""
_SIZES = (np.dtype("<u1"), np.dtype("<u2"), np.dtype("<u4"))


class Units(msgspec.Struct, frozen=True):
    """The mass of a run in exact integers (Kabir & Lee, section III: n_0 = 1/N, m = 1/M)."""

    whole: int
    """L = lcm(M, N): all mass."""
    sample: int
    """L / N: the initial weight of each sample."""
    point: int
    """L / M: the weight that one robot point ships."""

    @classmethod
    def of(cls, points: int, samples: int) -> "Units":
        """For M robot points and N samples."""
        whole = math.lcm(points, samples)
        return cls(whole=whole, sample=whole // samples, point=whole // points)


class WeightsMessage(msgspec.Struct, frozen=True, array_like=True, tag=20, gc=False):
    """On `<id>/weights`: a whole vector, or the entries that fell since the message before."""

    version: int
    sequence: int
    """Counts from 1 in an incarnation."""
    base: int
    """0: a keyframe. Otherwise the sequence that the changes apply to."""
    size: int
    """N."""
    content: bytes
    """Keyframe: zlib of little-endian unsigned integers. Changes: gaps between rising indices,
    each with its new value, as LEB128 pairs."""


@kernel
def _note(
    lowered: np.ndarray, changed: np.ndarray, count: int, noted_in: np.ndarray, message: int
) -> int:
    """Append to changed[:count] the indices that this message does not have yet; how many there are then."""
    for i in range(lowered.shape[0]):
        j = lowered[i]
        if noted_in[j] != message:
            noted_in[j] = message
            changed[count] = j
            count += 1
    return count


class WeightsPublisher:
    """Collects the entries that fell in a weight vector and encodes them as messages."""

    def __init__(self, weights: Weights, every: int, keyframe_every: int) -> None:
        """weights: (N,) the live vector in units; it is read, never written.

        every: steps in one message; keyframe_every: messages from one keyframe to the next.
        """
        self._weights = weights
        self._every = every
        self._keyframe_every = keyframe_every
        self._steps = 0
        self._sequence = 0
        self._changed = np.zeros(weights.shape[0], dtype=np.int32)
        self._count = 0
        self._noted_in = np.zeros(weights.shape[0], dtype=np.int32)
        self._pairs = Pairs()
        self._note = typed(_note, self._changed, self._changed, 0, self._noted_in, 1)

    def step(self, lowered: npt.NDArray[np.int32], *, last: bool) -> bytes:
        """Add the indices that fell in a step; the encoded message when one is due, else nothing.

        last: no entry will fall any more, so a message is due now.
        """
        if lowered.size:
            self._count = self._note(
                lowered, self._changed, self._count, self._noted_in, self._sequence + 1
            )
        due = self._steps % self._every == 0 or (last and self._count > 0)
        self._steps += 1
        if not due:
            return b""
        keyframe = self._sequence % self._keyframe_every == 0
        self._sequence += 1
        content = _keyframe(self._weights) if keyframe else self._changes()
        self._count = 0
        return msgspec.msgpack.encode(
            WeightsMessage(
                version=1,
                sequence=self._sequence,
                base=0 if keyframe else self._sequence - 1,
                size=self._weights.shape[0],
                content=content,
            )
        )

    def _changes(self) -> bytes:
        index = np.sort(self._changed[: self._count])
        return self._pairs.encode(index, self._weights[index], self._count)


class WeightsSubscriber:
    """Rebuilds a robot's exact weight vector from the messages on its weights key."""

    def __init__(self, size: int | None = None) -> None:
        """size: N, if it is known: a message about another number of samples is malformed."""
        self.weights: Weights | None = None
        """None until the first keyframe, and again after a gap until the next one."""
        self._size = size
        self._sequence = 0
        self._pairs = Pairs()
        self._decoder = msgspec.msgpack.Decoder(WeightsMessage)

    def apply(self, payload: bytes) -> bool:
        """Apply a message; False when it is malformed or does not follow the last one.

        A keyframe is inflated only once its size is known to be possible, and never beyond it.
        """
        try:
            message = self._decoder.decode(payload)
        except (msgspec.MsgspecError, RecursionError):
            return False
        if message.version != 1 or not self._is_possible(message.size):
            return False
        if message.base == 0:
            weights = _from_keyframe(message.content, message.size)
            if weights is None:
                return False
            self.weights = weights
        elif (
            self.weights is None
            or message.base != self._sequence
            or message.size != self.weights.shape[0]
            or not self._apply(self.weights, message.content)
        ):
            self.weights = None
            return False
        self._sequence = message.sequence
        return True

    def _is_possible(self, size: int) -> bool:
        return 0 < size <= SAMPLES_MAX and self._size in (None, size)

    def _apply(self, weights: Weights, content: bytes) -> bool:
        pairs = self._pairs.decode(content, weights.shape[0])
        if pairs is None or bool(np.any(pairs[1] > weights[pairs[0]])):
            return False
        weights[pairs[0]] = pairs[1]
        return True


def _keyframe(weights: Weights) -> bytes:
    top = int(weights.max(initial=0))
    kind = next(kind for kind in _SIZES if top < 256**kind.itemsize)
    return zlib.compress(weights.astype(kind).tobytes(), 6)


def weights_bytes_max(size: int) -> int:
    """No message about so many weights is longer: five bytes for an entry, or nine for one that changed."""
    return 16 * size + 1024


def _from_keyframe(content: bytes, size: int) -> Weights | None:
    """(size,) inflated weights, never more; None if it is malformed."""
    inflate = zlib.decompressobj()
    try:
        raw = inflate.decompress(content, 4 * size + 1)
    except zlib.error:
        return None
    for kind in _SIZES:
        if len(raw) == size * kind.itemsize:
            return np.frombuffer(raw, dtype=kind).astype(np.int64)
    return None
