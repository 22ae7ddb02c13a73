"""The radio: who hears an envelope, when, and what gets lost. The only place that knows range.

Range is between true poses at the time of sending, which is when a step begins: after the inbox was
taken in, before the move. On a map walls between two poses may shorten it or end it. Every draw is keyed by (seed, purpose, link, sequence, copy): it depends on
nothing that happened before, so one more message or one more robot changes no other draw.
"""

import struct
from collections.abc import Callable, Iterable, Sequence
from heapq import heappop, heappush
from typing import Any, NamedTuple

import msgspec
import numpy as np

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Envelope, ParticipantId, Pose
from kantor_protocol.scenario.schema import RadioOptions, Scenario
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.sensors import walls_between

LINK_WIDTH = 4096
"""Links are numbered source * width + target; the roster is smaller, the supervisor comes last."""
DROPPED = -1

_SENT = struct.Struct("=qqqq")
"""A row of what the kernel reads; to write it so costs a fifth of making an array."""
_RULED = struct.Struct("=qqq")
"""A row of what it writes."""


class DeliveryDecision(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """What the channel decided on one copy of an envelope for one receiver within range."""

    source: ParticipantId
    sequence: int
    target: ParticipantId
    due_ns: int
    """When it arrives, or DROPPED."""


class Sent(NamedTuple):
    """An envelope on the air."""

    now_ns: int
    envelope: Envelope


class Field(NamedTuple):
    """What decides who can hear whom, for kernels; see `hears`."""

    left_m: float
    bottom_m: float
    resolution_m: float
    line_of_sight: bool
    loss_m: float
    cells: np.ndarray
    xy_m: np.ndarray
    """(n, 2) where everybody truly is, the unplaced at infinity."""
    supervisor: int
    """Its place in the roster, or -1."""
    supervisor_stands: bool
    """It has a place on the map, so that walls may stand before it."""


class Ruled(NamedTuple):
    """Verdicts as numbers."""

    rows: np.ndarray
    """(rows, 3): receiver (place in the roster), row of what is on the air, due_ns or DROPPED."""
    size: int
    """How many rows count."""


Interference = Callable[
    [Sequence[Sent], np.ndarray, Ruled, Field], tuple[Sequence[Sent], Ruled, int]
]
"""Rules on what the radio has ruled, given what was sent, also as numbers (rows, 4): now_ns, source,
sequence, target; and where everybody is. It returns what is on the air then, which is what was sent and
perhaps more; the verdicts on that; and how many receivers are no longer in range."""


_Flight = tuple[int, int, int, int, Envelope]
"""Of an envelope under way: due_ns, place of its source, sequence, number of the flight."""


class _ChannelConfig(NamedTuple):
    """The radio's parameters, for the kernel."""

    seed: int
    range_m: float
    supervisor_range_m: float
    drop: float
    delay_ns: int
    jitter_ns: int
    duplicate: float
    reorder: float
    reorder_ns: int


class Walls(NamedTuple):
    """What the radio minds of a map."""

    left_m: float
    bottom_m: float
    resolution_m: float
    line_of_sight: bool
    loss_m: float
    """Of range, for each wall."""
    cells: np.ndarray
    """(rows, columns), or nothing where walls do not matter."""

    @classmethod
    def of(cls, radio: RadioOptions, ground: Ground | None) -> "Walls":
        """Of a scenario's radio on a map, if there is one."""
        if ground is None or not (radio.line_of_sight or radio.wall_loss_m > 0.0):
            return OPEN
        frame, cells = ground
        return cls(
            *frame.origin_m, frame.resolution_m, radio.line_of_sight, radio.wall_loss_m, cells
        )


OPEN = Walls(0.0, 0.0, 1.0, False, 0.0, np.zeros((0, 0), dtype=np.uint8))
"""No walls."""


@kernel
def _in_range(
    left_m: float,
    bottom_m: float,
    resolution_m: float,
    line_of_sight: bool,
    loss_m: float,
    cells: np.ndarray,
    xy_m: np.ndarray,
    one: int,
    other: int,
    range_m: float,
    through: bool,
) -> bool:
    """Whether two participants hear each other. xy_m: (n, 2); through: whatever stands between."""
    dx = xy_m[other, 0] - xy_m[one, 0]
    dy = xy_m[other, 1] - xy_m[one, 1]
    if not dx * dx + dy * dy <= range_m * range_m:  # nor when a place is unknown
        return False
    if through or cells.shape[0] == 0:
        return True
    walls = walls_between(
        cells,
        (xy_m[one, 0] - left_m) / resolution_m,
        (xy_m[one, 1] - bottom_m) / resolution_m,
        (xy_m[other, 0] - left_m) / resolution_m,
        (xy_m[other, 1] - bottom_m) / resolution_m,
    )
    if line_of_sight and walls > 0:
        return False
    range_m -= walls * loss_m
    return range_m >= 0.0 and dx * dx + dy * dy <= range_m * range_m


@kernel
def hears(field: Field, one: int, other: int, range_m: float) -> bool:
    """Whether two participants (places in the roster) hear each other if their range is so many metres."""
    through = field.supervisor in (one, other) and not field.supervisor_stands
    heard: bool = _in_range(
        field.left_m,
        field.bottom_m,
        field.resolution_m,
        field.line_of_sight,
        field.loss_m,
        field.cells,
        field.xy_m,
        one,
        other,
        range_m,
        through,
    )
    return heard


@kernel
def link_of(source: int, target: int, supervisor: int) -> int:
    """The number of the link between two places in the roster."""
    here = LINK_WIDTH - 1 if source == supervisor else source
    there = LINK_WIDTH - 1 if target == supervisor else target
    return here * LINK_WIDTH + there


@kernel
def _delay(config: _ChannelConfig, link: int, sequence: int, copy: int) -> int:
    delay = config.delay_ns
    if config.jitter_ns > 0:
        draw = uniform(config.seed, Purpose.DELAY.value, link, sequence, copy)
        delay += int(draw * config.jitter_ns)
    if config.reorder > 0.0:
        draw = uniform(config.seed, Purpose.REORDER.value, link, sequence, copy)
        if draw < config.reorder:
            delay += int(draw / config.reorder * config.reorder_ns)
    return delay


@kernel
def _transmit(
    seed: int,
    robot_range_m: float,
    supervisor_range_m: float,
    drop: float,
    delay_ns: int,
    jitter_ns: int,
    duplicate: float,
    reorder: float,
    reorder_ns: int,
    left_m: float,
    bottom_m: float,
    resolution_m: float,
    line_of_sight: bool,
    loss_m: float,
    cells: np.ndarray,
    xy_m: np.ndarray,
    supervisor: int,
    supervisor_stands: bool,
    sent: np.ndarray,
    envelopes: int,
    ruled: np.ndarray,
) -> tuple[int, int]:
    """Rule on every envelope for every possible receiver.

    sent: (m, 4) now_ns, source, sequence, target or -1. Returns how many verdicts there are, in the
    rows of ruled (rows, 3): receiver, which (row of sent) and due_ns; and how many receivers were out of range.
    """
    config = _ChannelConfig(
        seed,
        robot_range_m,
        supervisor_range_m,
        drop,
        delay_ns,
        jitter_ns,
        duplicate,
        reorder,
        reorder_ns,
    )
    field = Field(
        left_m,
        bottom_m,
        resolution_m,
        line_of_sight,
        loss_m,
        cells,
        xy_m,
        supervisor,
        supervisor_stands,
    )
    receiver, which, due_ns = ruled[:, 0], ruled[:, 1], ruled[:, 2]
    count = 0
    out_of_range = 0
    for i in range(envelopes):
        source, sequence, target = sent[i, 1], sent[i, 2], sent[i, 3]
        for other in range(xy_m.shape[0]):
            if other == source or (target >= 0 and other != target):
                continue
            by_supervisor = supervisor in (other, source)
            range_m = config.supervisor_range_m if by_supervisor else config.range_m
            if not hears(field, source, other, range_m):
                out_of_range += 1
                continue
            link = link_of(source, other, supervisor)
            copies = 1
            if config.duplicate > 0.0:
                draw = uniform(config.seed, Purpose.DUPLICATE.value, link, sequence, 0)
                copies += draw < config.duplicate
            for copy in range(copies):
                receiver[count] = other
                which[count] = i
                draw = 1.0
                if config.drop > 0.0:
                    draw = uniform(config.seed, Purpose.DROP.value, link, sequence, copy)
                if draw < config.drop:
                    due_ns[count] = DROPPED
                else:
                    due_ns[count] = sent[i, 0] + _delay(config, link, sequence, copy)
                count += 1
    return count, out_of_range


class Channel:
    """Rules on transmissions and holds what is under way."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        ground: Ground | None = None,
        interference: Interference | None = None,
    ) -> None:
        radio = scenario.radio
        self._interference = interference
        self._roster = scenario.roster
        self._places = {name: i for i, name in enumerate(scenario.roster)}
        self._targets = {**self._places, EVERYBODY: -1}
        self._config = _ChannelConfig(
            seed,
            radio.range_m,
            scenario.supervisor.range_m,
            radio.drop,
            round(radio.delay_s * 1e9),
            round(radio.jitter_s * 1e9),
            radio.duplicate,
            radio.reorder,
            round(radio.reorder_s * 1e9),
        )
        self._xy_m = np.full((len(scenario.roster), 2), np.inf)
        self._field = Field(
            *Walls.of(radio, ground),
            self._xy_m,
            self._places.get(SUPERVISOR, -1),
            scenario.supervisor.pose_m is not None,
        )
        self._arguments: tuple[Any, ...] = (*self._config, *self._field)
        self._under_way: dict[ParticipantId, list[_Flight]] = {name: [] for name in scenario.roster}
        self._boxes = list(self._under_way.items())
        self._flights = 0
        self._sent = np.zeros((0, 4), dtype=np.int64)
        self._make_room(1)

    @property
    def lookahead_ns(self) -> int:
        """Nothing sent arrives sooner."""
        return self._config.delay_ns

    def place(self, name: ParticipantId, pose: Pose) -> None:
        """Note where a participant truly is."""
        row = self._places[name]
        self._xy_m[row, 0] = pose.x_m
        self._xy_m[row, 1] = pose.y_m

    def transmit(self, sent: Sequence[Sent]) -> tuple[list[DeliveryDecision], int]:
        """Rule on envelopes by the poses as they are now; also how many receivers were too far.

        Deliveries wait in the channel until `take`.
        """
        if not sent:
            return [], 0
        self._make_room(len(sent))
        places, targets, nowhere = self._places, self._targets, len(self._roster)
        for i, (now_ns, envelope) in enumerate(sent):
            source, sequence = places[envelope.source], envelope.sequence
            target = targets.get(envelope.target, nowhere)
            _SENT.pack_into(self._sent_bytes, _SENT.size * i, now_ns, source, sequence, target)
        count, out_of_range = _transmit(*self._arguments, self._sent, len(sent), self._ruled)
        ruled = Ruled(self._ruled, count)
        if self._interference is not None:
            sent, ruled, lost = self._interference(sent, self._sent, ruled, self._field)
            out_of_range += lost
        return self._send(sent, ruled), out_of_range

    def _send(self, on_air: Sequence[Sent], ruled: Ruled) -> list[DeliveryDecision]:
        """Let what arrives be under way; the verdicts."""
        places, boxes, flights, nowhere = (
            self._places,
            self._boxes,
            self._flights,
            len(self._roster),
        )
        decisions = []
        told = ruled.rows.data.cast("B")[: _RULED.size * ruled.size]
        for to, row, due_ns in _RULED.iter_unpack(told):
            envelope = on_air[row][1]
            speaker, sequence = envelope.source, envelope.sequence
            receiver, box = boxes[to]
            decisions.append(DeliveryDecision(speaker, sequence, receiver, due_ns))
            if due_ns != DROPPED:
                flights += 1
                place = places.get(speaker, nowhere)
                heappush(box, (due_ns, place, sequence, flights, envelope))
        self._flights = flights
        return decisions

    def collect(self, name: ParticipantId, now_ns: int) -> tuple[Envelope, ...]:
        """What has arrived at a participant by now, in order of (arrival, source, sequence)."""
        waiting = self._under_way[name]
        if not waiting or waiting[0][0] > now_ns:
            return ()
        arrived = []
        while waiting and waiting[0][0] <= now_ns:
            arrived.append(heappop(waiting)[4])
        return tuple(arrived)

    def collect_heard(
        self, name: ParticipantId, heard: Iterable[tuple[ParticipantId, int]]
    ) -> tuple[Envelope, ...]:
        """What a participant is known to have taken, by source and sequence, of several copies the first.

        Raises KeyError for what is not under way.
        """
        waiting = sorted(self._under_way[name])
        taken = []
        for reference in heard:
            places = (i for i, item in enumerate(waiting) if (item[4].source, item[2]) == reference)
            place = next(places, None)
            if place is None:
                raise KeyError(reference)
            taken.append(waiting.pop(place)[4])
        self._under_way[name][:] = waiting  # in order, it is a heap
        return tuple(taken)

    def lose(self, name: ParticipantId, from_ns: int, until_ns: int) -> None:
        """Throw away what arrives at a participant within a window, its end excluded."""
        box = self._under_way[name]
        box[:] = sorted(item for item in box if not from_ns <= item[0] < until_ns)

    def clear(self) -> None:
        """Throw away all that is under way."""
        for box in self._under_way.values():
            box.clear()

    def waits(self, name: ParticipantId, now_ns: int) -> bool:
        """Whether something has arrived at a participant that was not taken."""
        waiting = self._under_way[name]
        return bool(waiting) and waiting[0][0] <= now_ns

    def next_due_ns(self) -> int | None:
        """When the next delivery is due at anybody."""
        return min((box[0][0] for box in self._under_way.values() if box), default=None)

    def _make_room(self, envelopes: int) -> None:
        if self._sent.shape[0] < envelopes:
            self._sent = np.zeros((2 * envelopes, 4), dtype=np.int64)
            self._sent_bytes = self._sent.data
            self._ruled = np.zeros((4 * envelopes * len(self._roster), 3), dtype=np.int64)


def links(xy_m: np.ndarray, range_m: float, walls: Walls = OPEN) -> int:
    """Pairs of robots that hear each other. xy_m: (n, 2)."""
    return int(_links(*walls, xy_m, range_m))


@kernel
def _links(
    left_m: float,
    bottom_m: float,
    resolution_m: float,
    line_of_sight: bool,
    loss_m: float,
    cells: np.ndarray,
    xy_m: np.ndarray,
    range_m: float,
) -> int:
    walls = (left_m, bottom_m, resolution_m, line_of_sight, loss_m, cells)
    count = 0
    for i in range(xy_m.shape[0]):
        for j in range(i):
            count += _in_range(*walls, xy_m, i, j, range_m, False)
    return count
