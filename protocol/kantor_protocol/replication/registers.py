"""Registers: one vector of integers for every participant, held by everybody (design, part 4).

An origin writes its own register, or adds to it, and nobody else does. Everywhere else the newest value
wins, by the origin's stamp, which counts its writes. The sum over all origins is kept: integers make it
exact, so that it is the same wherever the same registers are held, whatever came first. An origin is one
incarnation of a participant (`slots.py`): what a dead one has added is not lost, and counts once.

Talking
-------
1. Every message carries a stamp for every slot that its sender knows, as many as its version vector
   has (`replica.py`), at once an acknowledgement. While nobody is heard that is all, or, with `beacon`,
   every register as well.
2. A register goes to neighbours of which one lacks it: its stamp once, and again only when the
   acknowledgement has not come within `patience` steps. Its origin and a relay send it at once. Others
   forward it when a neighbour lacks several writes, or has lacked the last one for several steps: most
   likely it hears the origin itself.
3. What does not fit into one message waits for the next; the own register goes first, then the others
   from a place that moves on with each step.
4. Receiving is idempotent. Loss, duplication, delay and reordering cost time, never truth.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.incarnations import known_to
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import MALFORMED, put_int, put_uint, read_int, read_uint
from kantor_protocol.wire.version_vector import raise_entries

Register = npt.NDArray[np.int64]

STAMP_MAX = 1 << 40
NUMBER_MAX = 1 << 52
"""Sums over a thousand origins stay within 64 bits."""
_BYTES_MAX = 48 * 1024
"""For one message; with the longest logs and claims a body still fits."""
_NUMBER_BYTES, _HEAD_BYTES, _STAMP_BYTES = 8, 15, 6
_STALE_STEPS = 6
"""How many writes, or steps, behind a neighbour may be before a robot forwards another's register."""
FRESH_STEPS = 4
"""A participant heard within so many steps beyond `patience` counts as a neighbour."""


@kernel
def add(
    values: np.ndarray, total: np.ndarray, stamps: np.ndarray, me: int, amounts: np.ndarray
) -> None:
    """Add amounts (width,) to the own register: one write."""
    for i in range(amounts.shape[0]):
        values[me, i] += amounts[i]
        total[i] += amounts[i]
    stamps[me] += 1


@kernel
def _read_head(
    content: bytes | np.ndarray, at: int, origins: int, width: int
) -> tuple[int, int, int, int]:
    """Read what precedes the numbers of a register: (origin, stamp, numbers, position), or MALFORMED."""
    origin, at = read_uint(content, at)
    stamp, at = read_uint(content, at)
    numbers, at = read_uint(content, at)
    if at < 0 or origin >= origins or stamp < 1 or stamp > STAMP_MAX or numbers > width:
        return 0, 0, 0, MALFORMED
    return origin, stamp, numbers, at


@kernel
def _sound(content: bytes, told: int, width: int, sums: bool) -> bool:
    """Whether content is stamps of as many origins as told, and then whole registers of theirs.

    sums: the first number of a register bounds the others, as the number of visits bounds every sum over
    visits of something within [-1, 1].
    """
    at = 0
    for _ in range(told):
        stamp, at = read_uint(content, at)
        if at < 0 or stamp > STAMP_MAX:
            return False
    while at < len(content):
        _origin, _stamp, numbers, at = _read_head(content, at, told, width)
        bound = NUMBER_MAX
        for i in range(numbers):
            number, at = read_int(content, at)
            if at < 0 or number > bound or number < (0 if sums and i == 0 else -bound):
                return False
            bound = number if sums and i == 0 else bound
        if at < 0:
            return False
    return True


@kernel
def _learn(
    values: np.ndarray,
    total: np.ndarray,
    stamps: np.ndarray,
    known: np.ndarray,
    learnt: np.ndarray,
    me: int,
    source: int,
    content: bytes,
    told: int,
    step: int,
) -> None:
    """Take in sound content of as many origins as told."""
    width = values.shape[1]
    at = raise_entries(content, 0, known[source, :told], STAMP_MAX)
    while 0 <= at < len(content):
        origin, stamp, numbers, at = _read_head(content, at, told, width)
        news = at >= 0 and origin != me and stamp > stamps[origin]
        for i in range(width if at >= 0 else 0):
            number = 0
            if i < numbers:
                number, at = read_int(content, at)
            if news:
                total[i] += number - values[origin, i]
                values[origin, i] = number
        if news:
            stamps[origin], learnt[origin] = stamp, step


@kernel
def _is_due(
    stamps: np.ndarray,
    known: np.ndarray,
    heard: np.ndarray,
    learnt: np.ndarray,
    sent: np.ndarray,
    settings: np.ndarray,
    origin: int,
    target: int,
    step: int,
) -> bool:
    """Whether a register belongs in a message to everybody (target < 0), or to one participant."""
    me, relay, beacon, patience = settings[0], settings[1], settings[2], settings[3]
    stamp = stamps[origin]
    if stamp == 0:
        return False
    least = -1
    for other in range(stamps.shape[0]):
        wanted = other not in (me, origin) and target in (-1, other)
        if wanted and heard[other] >= 0 and heard[other] + patience + FRESH_STEPS >= step:
            held = known[other, origin]
            least = held if least < 0 else min(least, held)
    if least < 0:
        return beacon != 0 and target < 0
    if least >= stamp or (stamp <= sent[0, origin] and step - sent[1, origin] < patience):
        return False
    stale = least + _STALE_STEPS < stamp or step - learnt[origin] > _STALE_STEPS
    return origin == me or relay != 0 or stale


@kernel
def _compose(
    values: np.ndarray,
    stamps: np.ndarray,
    known: np.ndarray,
    heard: np.ndarray,
    learnt: np.ndarray,
    sent: np.ndarray,
    settings: np.ndarray,
    out: np.ndarray,
    target: int,
    step: int,
) -> int:
    """Write stamps and registers; the bytes used."""
    origins, width = values.shape
    me = settings[0]
    at = 0
    for origin in range(origins):
        at = put_uint(out, at, stamps[origin])
    longest = _HEAD_BYTES + _NUMBER_BYTES * width
    for turn in range(origins + 1):
        origin = (step + turn) % origins if turn else me
        if (turn and origin == me) or at + longest > out.shape[0]:
            continue
        if _is_due(stamps, known, heard, learnt, sent, settings, origin, target, step):
            at = put_uint(out, at, origin)
            at = put_uint(out, at, stamps[origin])
            numbers = width  # zeros at the end are left out
            while numbers > 0 and values[origin, numbers - 1] == 0:
                numbers -= 1
            at = put_uint(out, at, numbers)
            for i in range(numbers):
                at = put_int(out, at, values[origin, i])
            sent[0, origin] = stamps[origin]
            sent[1, origin] = step
    return at


class Registers:
    """The registers that one participant holds, and what it tells others of them."""

    def __init__(
        self,
        me: int,
        origins: int,
        width: int,
        *,
        sums: bool = True,
        relay: bool = False,
        beacon: bool = False,
        patience_steps: int = 2,
    ) -> None:
        """width: integers in a register, or 0. origins: participants in the roster.

        me: its slot, which is its place in the roster unless it is a later incarnation. sums: registers
        are sums, the first number of which is the largest in size.
        """
        self.me = me
        self._roster = origins
        self._sums = sums
        self._settings = np.array([me, relay, beacon, max(1, patience_steps)], dtype=np.int64)
        self._step = 0
        self.total = np.zeros(width, dtype=np.int64)
        """(width,) the sum over origins."""
        self.values: Register
        """(slots, width) the newest known of each origin."""
        self.stamps: Register
        """(slots,) writes of each origin that `values` includes."""
        self._make_room(known_to(me, origins))

    def _make_room(self, slots: int) -> None:
        """Begin with registers of this many origins, of which nothing is known."""
        width = self.total.shape[0]
        self.values = np.zeros((slots, width), dtype=np.int64)
        self.stamps = np.zeros(slots, dtype=np.int64)
        self._known = np.zeros((slots, slots), dtype=np.int64)
        self._heard = np.full(slots, -1, dtype=np.int64)
        self._learnt = np.zeros(slots, dtype=np.int64)
        self._sent = np.zeros((2, slots), dtype=np.int64)
        longest = _HEAD_BYTES + _NUMBER_BYTES * width
        stamps = _STAMP_BYTES * slots
        room = max(stamps + longest, min(_BYTES_MAX, stamps + slots * longest))
        self._out = np.zeros(room if width else 0, dtype=np.uint8)

    def widen(self, slots: int) -> None:
        """Make room for this many origins: another incarnation was heard of."""
        if not self._out.size:
            return
        before = self.stamps.shape[0]
        old = (self.values, self.stamps, self._known, self._heard, self._learnt, self._sent)
        self._make_room(slots)
        self.values[:before], self.stamps[:before] = old[0], old[1]
        self._known[:before, :before] = old[2]
        self._heard[:before], self._learnt[:before] = old[3], old[4]
        self._sent[:, :before] = old[5]

    def add(self, amounts: Register) -> None:
        """Add (width,) integers to the own register; the first sum is the largest in size."""
        add(self.values, self.total, self.stamps, self.me, amounts)

    def write(self, numbers: Sequence[int]) -> None:
        """Replace the own register; at most `width` integers, the others become 0."""
        register = self.values[self.me]
        self.total -= register
        register[: len(numbers)] = numbers
        register[len(numbers) :] = 0
        self.total += register
        self.stamps[self.me] += 1

    def age_steps(self, origin: int) -> int:
        """Own steps since the register of an origin was last learnt anew; negative if never."""
        return self._step - int(self._learnt[origin]) if self.stamps[origin] else -1

    def newest(self, place: int) -> int:
        """The slot of the last incarnation of a participant that has written, as far as is known."""
        roster = self._roster
        if self.stamps.shape[0] == roster:
            return place
        if place == self.me % roster:
            return self.me
        written = range(self.stamps.shape[0] - roster + place, place, -roster)
        return next((slot for slot in written if self.stamps[slot]), place)

    def sound(self, content: bytes, told: int) -> bool:
        """Whether content is well-formed, whole; without registers none is.

        told: slots that its sender knows.
        """
        width = self.total.shape[0]
        return width > 0 and bool(_sound(content, told, width, self._sums))

    def learn(self, source: int, content: bytes, told: int) -> None:
        """Take in sound content from an origin. There must be room for as many origins as told."""
        self._heard[source] = self._step
        _learn(
            self.values,
            self.total,
            self.stamps,
            self._known,
            self._learnt,
            self.me,
            source,
            content,
            told,
            self._step,
        )

    def compose(self, target: int = -1) -> bytes:
        """What everybody in range, or one participant, lacks; empty without registers."""
        if not self._out.size:
            return b""
        used = _compose(
            self.values,
            self.stamps,
            self._known,
            self._heard,
            self._learnt,
            self._sent,
            self._settings,
            self._out,
            target,
            self._step,
        )
        return self._out[:used].tobytes()

    def end_step(self) -> None:
        """Begin the next step."""
        self._step += 1


@kernel
def _find(content: bytes, origins: int, wanted: int, register: np.ndarray) -> int:
    width = register.shape[0]
    at = 0
    for _ in range(origins):
        _stamp, at = read_uint(content, at)
    found = 0
    while 0 <= at < len(content):
        origin, stamp, numbers, at = _read_head(content, at, origins, width)
        for i in range(numbers):
            number, at = read_int(content, at)
            if at >= 0 and origin == wanted:
                register[i] = number
        if origin == wanted:
            found = stamp
    return found if at >= 0 else MALFORMED


def read_register(
    content: bytes, origins: int, width: int, origin: int
) -> tuple[int, Register] | None:
    """Stamp and numbers of an origin's register in a message; stamp 0 if absent, None if malformed."""
    register = np.zeros(width, dtype=np.int64)
    stamp = _find(content, origins, origin, register)
    return None if stamp < 0 else (stamp, register)
