"""Registers: one vector of integers for every participant, held by all (docs/decisions/010).

An origin writes its own register, or adds to it, and no other participant does. Everywhere else the newest value
wins, by the origin's stamp, which counts its writes. The sum over all origins is kept: integers make it exact, so
that it is the same wherever the same registers are held, in whatever order they came. An origin is one incarnation
of a participant (`base/incarnations.py`): what an ended one has added is not lost, and counts once.

Sending
-------
1. Every message carries a stamp for every incarnation id that its sender knows, as many as its version vector
   covers (`replica.py`), at once an acknowledgement. While nothing is received that is all, or, with `beacon`,
   every register as well.
2. A register goes to neighbours of which one lacks it: once for each stamp, and again only when the
   acknowledgement has not come within `ack_timeout_steps`. Its origin and a relay send it at once. Others forward
   it when a neighbour lacks several writes, or has lacked the last one for several steps: most likely it
   receives the origin's messages itself.
3. What does not fit into one message waits for the next; the own register goes first, then the others from a
   place that moves on with each step.
4. Merging is idempotent. Loss, duplication, delay and reordering cost time, never correctness.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kantor_protocol.base.incarnations import known_ids
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import MALFORMED, put_int, put_uint, read_int, read_uint
from kantor_protocol.wire.version_vector import raise_entries

Register = npt.NDArray[np.int64]

STAMP_MAX = 1 << 40
"""No register of any mission was written more often."""
NUMBER_MAX = 1 << 52
"""Sums over a thousand origins stay within 64 bits."""
_BYTES_MAX = 48 * 1024
"""For one message; with the longest logs and claims a body still fits."""
_NUMBER_BYTES, _HEAD_BYTES, _STAMP_BYTES = 8, 15, 6
OTHERS_MAX = 64
"""Logs of others, or registers of others, in one message with proofs, at most."""
STALE_STEPS = 6
"""Writes, or steps, by which a neighbour may be behind before a robot forwards another's register."""
FRESH_STEPS = 4
"""A participant of which a message was received within so many steps beyond `ack_timeout_steps` is a neighbour."""


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
def _is_well_formed(content: bytes, covered: int, width: int, sums: bool, stamp_max: int) -> bool:
    """Whether content is the stamps of `covered` origins, and then whole registers of theirs.

    sums: the first number of a register bounds the others, as the number of visits bounds every sum over
    visits of something within [-1, 1].
    """
    at = 0
    for _ in range(covered):
        stamp, at = read_uint(content, at)
        if at < 0 or stamp > stamp_max:
            return False
    while at < len(content):
        _origin, stamp, numbers, at = _read_head(content, at, covered, width)
        if stamp > stamp_max:
            return False
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
def _merge(
    values: np.ndarray,
    total: np.ndarray,
    stamps: np.ndarray,
    known: np.ndarray,
    updated: np.ndarray,
    me: int,
    source: int,
    content: bytes,
    covered: int,
    step: int,
) -> None:
    """Merge well-formed content of `covered` origins."""
    width = values.shape[1]
    at = raise_entries(content, 0, known[source, :covered], STAMP_MAX)
    while 0 <= at < len(content):
        origin, stamp, numbers, at = _read_head(content, at, covered, width)
        newer = at >= 0 and origin != me and stamp > stamps[origin]
        for i in range(width if at >= 0 else 0):
            number = 0
            if i < numbers:
                number, at = read_int(content, at)
            if newer:
                total[i] += number - values[origin, i]
                values[origin, i] = number
        if newer:
            stamps[origin], updated[origin] = stamp, step


@kernel
def _is_due(
    stamps: np.ndarray,
    known: np.ndarray,
    received: np.ndarray,
    updated: np.ndarray,
    sent: np.ndarray,
    settings: np.ndarray,
    origin: int,
    target: int,
    step: int,
) -> bool:
    """Whether a register belongs in a message to all in range (target < 0), or to one origin."""
    me, relay, beacon, ack_timeout_steps = settings[0], settings[1], settings[2], settings[3]
    stamp = stamps[origin]
    if stamp == 0:
        return False
    least = -1
    for other in range(stamps.shape[0]):
        wanted = other not in (me, origin) and target in (-1, other)
        fresh_until = received[other] + ack_timeout_steps + FRESH_STEPS
        if wanted and received[other] >= 0 and fresh_until >= step:
            held = known[other, origin]
            least = held if least < 0 else min(least, held)
    if least < 0:
        return beacon != 0 and target < 0
    if least >= stamp or (stamp <= sent[0, origin] and step - sent[1, origin] < ack_timeout_steps):
        return False
    stale = least + STALE_STEPS < stamp or step - updated[origin] > STALE_STEPS
    return origin == me or relay != 0 or stale


@kernel
def _compose(
    values: np.ndarray,
    stamps: np.ndarray,
    held: np.ndarray,
    known: np.ndarray,
    received: np.ndarray,
    updated: np.ndarray,
    sent: np.ndarray,
    settings: np.ndarray,
    out: np.ndarray,
    target: int,
    step: int,
) -> int:
    """Write the stamps `held`, and of the registers with `stamps` those that are due; the bytes used."""
    origins, width = values.shape
    me, others_left = settings[0], settings[4]
    at = 0
    for origin in range(origins):
        at = put_uint(out, at, held[origin])
    longest = _HEAD_BYTES + _NUMBER_BYTES * width
    for turn in range(origins + 1):
        origin = (step + turn) % origins if turn else me
        if (turn and (origin == me or others_left <= 0)) or at + longest > out.shape[0]:
            continue
        if _is_due(stamps, known, received, updated, sent, settings, origin, target, step):
            others_left -= origin != me
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
    """The registers that one participant holds, and the messages by which they are kept equal."""

    def __init__(
        self,
        me: int,
        roster: int,
        width: int,
        *,
        sums: bool = True,
        relay: bool = False,
        beacon: bool = False,
        ack_timeout_steps: int = 2,
        stamp_max: int = STAMP_MAX,
        proving: bool = False,
    ) -> None:
        """Registers without a write.

        me: its incarnation id. roster: participants in the roster. width: integers in a register, or 0. sums:
        registers are sums, the first number of which is the largest in size. stamp_max: no origin writes more often
        in this mission. proving: of others it sends only what they have attested, see `attested.py`.
        """
        self.me = me
        """One of the origins."""
        self._roster = roster
        self._sums = sums
        self._stamp_max = min(stamp_max, STAMP_MAX)
        self._proving = proving
        others = OTHERS_MAX if proving else STAMP_MAX
        self._settings = np.array(
            [me, relay, beacon, max(1, ack_timeout_steps), others], dtype=np.int64
        )
        self.step = 0
        """The current step."""
        self.total = np.zeros(width, dtype=np.int64)
        """(width,) the sum of `values` over origins."""
        self.values: Register
        """(n, width) the newest known register of each of n origins; 0 while its stamp is 0. With `sums` the first
        number is not negative, and no other is larger in size."""
        self.stamps: Register
        """(n,) writes of each origin that `values` includes; of others at most STAMP_MAX."""
        self.offered: Register
        """(n, width) the registers that may be sent: `values`; or when proving, of others what they have attested."""
        self.offered_stamps: Register
        """(n,) their stamps: `stamps`; or when proving, of others at most as large, 0 while nothing may be sent."""
        self._known: Register
        """(n, n) the stamps that each origin is known to hold, at most STAMP_MAX; 0 in the own row, and in rows of
        origins from which nothing was received."""
        self._received: Register
        """(n,) step at which content of each origin was last received, -1 for never and for the own id."""
        self._updated: Register
        """(n,) step at which `values` of an origin were last replaced; 0 for the own id, and while its stamp is 0."""
        self._sent: Register
        """(2, n) the stamp with which each register was last sent, at most the one in `stamps`, and the step. Steps
        are at most the current one."""
        self._make_room(known_ids(me, roster))

    def _make_room(self, origins: int) -> None:
        """Begin with registers of this many origins, of which nothing is known."""
        width = self.total.shape[0]
        self.values = np.zeros((origins, width), dtype=np.int64)
        self.stamps = np.zeros(origins, dtype=np.int64)
        self.offered = np.zeros_like(self.values) if self._proving else self.values
        self.offered_stamps = np.zeros_like(self.stamps) if self._proving else self.stamps
        self._known = np.zeros((origins, origins), dtype=np.int64)
        self._received = np.full(origins, -1, dtype=np.int64)
        self._updated = np.zeros(origins, dtype=np.int64)
        self._sent = np.zeros((2, origins), dtype=np.int64)
        longest = _HEAD_BYTES + _NUMBER_BYTES * width
        stamps = _STAMP_BYTES * origins
        room = max(stamps + longest, min(_BYTES_MAX, stamps + origins * longest))
        self._out = np.zeros(room if width else 0, dtype=np.uint8)

    def widen(self, origins: int) -> None:
        """Make room for this many origins: a message came from a participant that knows another incarnation."""
        if not self._out.size:
            return
        before = self.stamps.shape[0]
        old = (self.values, self.stamps, self._known, self._received, self._updated, self._sent)
        offered, offered_stamps = self.offered, self.offered_stamps
        self._make_room(origins)
        self.values[:before], self.stamps[:before] = old[0], old[1]
        self.offered[:before], self.offered_stamps[:before] = offered, offered_stamps
        self._known[:before, :before] = old[2]
        self._received[:before], self._updated[:before] = old[3], old[4]
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

    def offer(self, origin: int, stamp: int) -> None:
        """When proving: send others the register of an origin that has this stamp, or none if it is not known."""
        if not self._out.size or self.offered_stamps[origin] == stamp:
            return
        held = self.stamps[origin] == stamp
        self.offered[origin] = self.values[origin] if held else 0
        self.offered_stamps[origin] = stamp if held else 0

    def age_steps(self, origin: int) -> int:
        """Own steps since the register of an origin was last replaced; negative if never."""
        return self.step - int(self._updated[origin]) if self.stamps[origin] else -1

    def newest(self, place: int) -> int:
        """The id of the last incarnation of a participant that has written, as far as is known."""
        roster = self._roster
        if self.stamps.shape[0] == roster:
            return place
        if place == self.me % roster:
            return self.me
        ids = range(self.stamps.shape[0] - roster + place, place, -roster)
        return next((origin for origin in ids if self.stamps[origin]), place)

    def is_well_formed(self, content: bytes, covered: int) -> bool:
        """Whether content is well-formed, whole; without registers none is.

        covered: incarnation ids that its sender knows.
        """
        return are_registers(
            content, covered, self.total.shape[0], sums=self._sums, stamp_max=self._stamp_max
        )

    def merge(self, source: int, content: bytes, covered: int) -> None:
        """Merge well-formed content of an origin. There must be room for `covered` origins."""
        self._received[source] = self.step
        _merge(
            self.values,
            self.total,
            self.stamps,
            self._known,
            self._updated,
            self.me,
            source,
            content,
            covered,
            self.step,
        )

    def compose(self, target: int = -1) -> bytes:
        """The part of a message to all in range, or to one origin; empty without registers."""
        if not self._out.size:
            return b""
        if self._proving:
            self.offer(self.me, int(self.stamps[self.me]))
        used = _compose(
            self.offered,
            self.offered_stamps,
            self.stamps,
            self._known,
            self._received,
            self._updated,
            self._sent,
            self._settings,
            self._out,
            target,
            self.step,
        )
        return self._out[:used].tobytes()

    def end_step(self) -> None:
        """Begin the next step."""
        self.step += 1

    def validate(self) -> None:
        """Assert what the sentences at the attributes state. For tests: it takes long."""
        origins, width, me = self.stamps.shape[0], self.total.shape[0], self.me
        assert origins % self._roster == 0
        assert 0 <= me < origins
        assert self.values.shape == (origins, width)
        assert self._known.shape == (origins, origins)
        assert self._sent.shape == (2, origins)
        assert (self.total == self.values.sum(axis=0)).all()
        if self._proving:
            assert self.offered.shape == (origins, width)
            assert ((self.offered_stamps >= 0) & (self.offered_stamps <= self.stamps)).all()
        else:
            assert self.offered is self.values
            assert self.offered_stamps is self.stamps
        unwritten, others = self.stamps == 0, np.arange(origins) != me
        assert (self.stamps >= 0).all()
        assert (self.stamps[others] <= STAMP_MAX).all()
        assert not self.values[unwritten].any()
        if self._sums and width:
            assert (self.values[:, 0] >= 0).all()
            assert (np.abs(self.values) <= self.values[:, :1]).all()
        assert ((self._known >= 0) & (self._known <= STAMP_MAX)).all()
        assert not self._known[self._received < 0].any()
        assert ((self._received >= -1) & (self._received <= self.step)).all()
        assert self._received[me] == -1
        assert ((self._updated >= 0) & (self._updated <= self.step)).all()
        assert not self._updated[unwritten | ~others].any()
        assert ((self._sent[0] >= 0) & (self._sent[0] <= self.stamps)).all()
        assert ((self._sent[1] >= 0) & (self._sent[1] <= self.step)).all()


def are_registers(
    content: bytes, covered: int, width: int, *, sums: bool, stamp_max: int = STAMP_MAX
) -> bool:
    """Whether content is well-formed, whole; without registers (width 0) none is. See `Registers`.

    covered: incarnation ids that its sender knows.
    """
    return width > 0 and bool(_is_well_formed(content, covered, width, sums, stamp_max))


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
    """Stamp and numbers of an origin's register in a message; stamp 0 if absent, None if malformed.

    origins: incarnation ids that the sender knows. width: integers in a register.
    """
    register = np.zeros(width, dtype=np.int64)
    stamp = _find(content, origins, origin, register)
    return None if stamp < 0 else (stamp, register)
