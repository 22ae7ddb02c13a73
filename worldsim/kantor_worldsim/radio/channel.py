"""The radio channel: which receivers an envelope reaches, when, and which copies are lost.

Range is measured between true poses at the time of sending, which is the beginning of a step: after the inbox was
processed, before the move. On a map, walls between two poses may shorten the range or block the link. Every draw is
keyed by (seed, purpose, link, sequence, copy) and independent of what happened before, so one more message or one
more robot changes no other draw.
"""

import math
import struct
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from heapq import heappop, heappush
from typing import Any, NamedTuple

import msgspec
import numpy as np

from kantor_protocol.base.counter_rng import Purpose, uniform
from kantor_protocol.base.kernels import kernel, typed
from kantor_protocol.base.machine import EVERYBODY, SUPERVISOR, Envelope, ParticipantId, Pose
from kantor_protocol.scenario.schema import RadioOptions, Scenario
from kantor_worldsim.radio.neighbours import Neighbourhood, candidates, sort_by_place
from kantor_worldsim.world.maps import Ground
from kantor_worldsim.world.sensors import walls_between

LINK_WIDTH = 4096
"""Links are numbered source * LINK_WIDTH + target; rosters are smaller, and the supervisor has the last number."""
DROPPED = -1
"""The due time of a copy that is lost."""

_MANY = 8
"""From so many envelopes on it pays to sort the participants by place first."""

_NOBODY = Neighbourhood.of(0)

_SENT = struct.Struct("=qqqq")
"""A row of the kernel's input; packing it costs a fifth of building an array."""
_PLACE = struct.Struct("=dd")
"""A row of positions."""
_DECIDED = struct.Struct("=qqq")
"""A row of the kernel's output."""


class DeliveryDecision(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The channel's decision on one copy of an envelope, for one receiver within range."""

    source: ParticipantId
    sequence: int
    target: ParticipantId
    due_ns: int
    """Time of arrival, or DROPPED."""


class Sent(msgspec.Struct, frozen=True, gc=False):
    """An envelope on the air."""

    now_ns: int
    envelope: Envelope


class LinkGeometry(NamedTuple):
    """Poses and walls, by which kernels decide whether a link is up; see `hears`."""

    left_m: float
    bottom_m: float
    resolution_m: float
    line_of_sight: bool
    loss_m: float
    cells: np.ndarray
    xy_m: np.ndarray
    """(n, 2) true positions in the world frame; infinity for participants without one."""
    supervisor: int
    """The supervisor's index in the roster, or -1."""
    supervisor_placed: bool
    """Whether the supervisor has a pose on the map, so that walls may block its links."""


class Decisions(NamedTuple):
    """Delivery decisions as numbers."""

    rows: np.ndarray
    """(rows, 3): receiver (index in the roster), row of the envelope on the air, due_ns or DROPPED."""
    size: int
    """Number of valid rows."""


Interference = Callable[
    [Sequence[Sent], np.ndarray, Decisions, LinkGeometry], tuple[Sequence[Sent], Decisions, int]
]
"""Changes the channel's decisions. Arguments: the envelopes sent, the same as numbers (rows, 4): now_ns, source,
sequence, target; the decisions; the geometry. Returns the envelopes on the air, which are those sent and perhaps
more; the decisions on them; and the number of receivers that are out of range now."""


_Flight = tuple[int, int, int, int, Envelope]
"""An envelope in flight: due_ns, index of its source, sequence, number of the flight, envelope."""


class _ChannelConfig(NamedTuple):
    """Parameters of the radio, for the kernel."""

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
    """Walls of a map, as far as they matter to the radio."""

    left_m: float
    bottom_m: float
    resolution_m: float
    line_of_sight: bool
    loss_m: float
    """Loss of range for each wall between."""
    cells: np.ndarray
    """(rows, columns); empty where walls do not matter."""

    @classmethod
    def of(cls, radio: RadioOptions, ground: Ground | None) -> "Walls":
        """Walls for a scenario's radio, on a map if there is one."""
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
    """Whether a link is up. xy_m: (n, 2); through: walls do not matter."""
    dx = xy_m[other, 0] - xy_m[one, 0]
    dy = xy_m[other, 1] - xy_m[one, 1]
    if not dx * dx + dy * dy <= range_m * range_m:  # also false for a participant without a pose
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
def hears(geometry: LinkGeometry, one: int, other: int, range_m: float) -> bool:
    """Whether the link between two participants (indices in the roster) is up at a range of range_m."""
    through = geometry.supervisor in (one, other) and not geometry.supervisor_placed
    is_up: bool = _in_range(
        geometry.left_m,
        geometry.bottom_m,
        geometry.resolution_m,
        geometry.line_of_sight,
        geometry.loss_m,
        geometry.cells,
        geometry.xy_m,
        one,
        other,
        range_m,
        through,
    )
    return is_up


@kernel
def link_of(source: int, target: int, supervisor: int) -> int:
    """Number of the link between two indices in the roster."""
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
def _possible(
    source: int, target: int, by_place: bool, geometry: LinkGeometry, around: Neighbourhood
) -> int:
    """Write into `near` who may receive an envelope, by index; their number.

    target: an index, -1 for all, or an index that nobody has. by_place: after `sort_by_place`.
    """
    participants: int = geometry.xy_m.shape[0]
    if target >= 0:
        around.near[0] = target
        return 1 if target < participants else 0
    if by_place:
        count: int = candidates(geometry.xy_m, source, around)
        return count
    for other in range(participants):
        around.near[other] = other
    return participants


@kernel
def _transmit(
    channel: tuple[Any, ...],
    links: tuple[Any, ...],
    neighbourhood: tuple[Any, ...],
    sent: np.ndarray,
    decided: np.ndarray,
    envelopes: int,
) -> tuple[int, int]:
    """Decide on every envelope for every possible receiver.

    channel, links, neighbourhood: the fields of a _ChannelConfig, a LinkGeometry and a Neighbourhood. sent: (m, 4)
    now_ns, source, sequence, target or -1. Writes rows of decided (rows, 3): receiver, row of sent,
    due_ns. Returns the number of decisions and the number of receivers out of range.
    """
    config = _ChannelConfig(*channel)
    geometry = LinkGeometry(*links)
    around = Neighbourhood(*neighbourhood)
    supervisor, participants = geometry.supervisor, geometry.xy_m.shape[0]
    by_place = envelopes >= _MANY and math.isfinite(config.range_m)
    if by_place:
        sort_by_place(geometry.xy_m, config.range_m, supervisor, around)
    receiver, which, due_ns = decided[:, 0], decided[:, 1], decided[:, 2]
    count = 0
    out_of_range = 0
    for i in range(envelopes):
        source, sequence, target = sent[i, 1], sent[i, 2], sent[i, 3]
        possible = _possible(source, target, by_place and source != supervisor, geometry, around)
        out_of_range += participants - 1 if target < 0 else min(possible, int(target != source))
        for j in range(possible):
            other = around.near[j]
            if other == source:
                continue
            by_supervisor = supervisor in (other, source)
            range_m = config.supervisor_range_m if by_supervisor else config.range_m
            if not hears(geometry, source, other, range_m):
                continue
            out_of_range -= 1
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
    """Decides on transmissions, and holds the envelopes in flight."""

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
        self._xy_bytes = self._xy_m.data
        self._geometry = LinkGeometry(
            *Walls.of(radio, ground),
            self._xy_m,
            self._places.get(SUPERVISOR, -1),
            scenario.supervisor.pose_m is not None,
        )
        self._around = Neighbourhood.of(len(scenario.roster))
        self._in_flight: dict[ParticipantId, list[_Flight]] = {name: [] for name in scenario.roster}
        """A heap of envelopes for each receiver, the next arrival first; no copy that is lost."""
        self._boxes = list(self._in_flight.items())
        self._flights = 0
        """Number of copies put in flight so far; each has a number of its own, up to this one."""
        self._sent = np.zeros((0, 4), dtype=np.int64)
        self._make_room(1)
        self._transmit = typed(_transmit, *self._arguments, 0)

    @property
    def lookahead_ns(self) -> int:
        """Least time from sending to arrival."""
        return self._config.delay_ns

    def place(self, name: ParticipantId, pose: Pose) -> None:
        """Set the true pose of a participant."""
        _PLACE.pack_into(self._xy_bytes, _PLACE.size * self._places[name], pose.x_m, pose.y_m)

    def transmit(self, sent: Sequence[Sent]) -> tuple[list[DeliveryDecision], int]:
        """Decide on envelopes by the present poses; returns the decisions and the number of receivers out of range.

        Copies stay in flight until they are collected.
        """
        if not sent:
            return [], 0
        self._make_room(len(sent))
        places, targets, nowhere = self._places, self._targets, len(self._roster)
        for i, each in enumerate(sent):
            envelope = each.envelope
            source, sequence = places[envelope.source], envelope.sequence
            target = targets.get(envelope.target, nowhere)
            _SENT.pack_into(self._sent_bytes, _SENT.size * i, each.now_ns, source, sequence, target)
        count, out_of_range = self._transmit(*self._arguments, len(sent))
        if self._interference is None:
            return self._send(sent, self._decided_bytes[: _DECIDED.size * count]), out_of_range
        decided = Decisions(self._decided, count)
        on_air, decided, lost = self._interference(sent, self._sent, decided, self._geometry)
        rows = decided.rows.data.cast("B")[: _DECIDED.size * decided.size]
        return self._send(on_air, rows), out_of_range + lost

    def _send(self, on_air: Sequence[Sent], rows: memoryview) -> list[DeliveryDecision]:
        """Put the copies that are not lost in flight; returns all decisions. rows: of `Decisions`, as bytes."""
        places, boxes, flights, nowhere = (
            self._places,
            self._boxes,
            self._flights,
            len(self._roster),
        )
        air = [
            (e, e.source, e.sequence, places.get(e.source, nowhere))
            for e in [sent.envelope for sent in on_air]
        ]
        decisions = []
        for to, row, due_ns in _DECIDED.iter_unpack(rows):
            envelope, source, sequence, place = air[row]
            receiver, box = boxes[to]
            decisions.append(DeliveryDecision(source, sequence, receiver, due_ns))
            if due_ns != DROPPED:
                flights += 1
                heappush(box, (due_ns, place, sequence, flights, envelope))
        self._flights = flights
        return decisions

    def collect(self, name: ParticipantId, now_ns: int) -> tuple[Envelope, ...]:
        """Remove and return the envelopes that have arrived by now, ordered by (arrival, source, sequence)."""
        waiting = self._in_flight[name]
        if not waiting or waiting[0][0] > now_ns:
            return ()
        arrived = []
        while waiting and waiting[0][0] <= now_ns:
            arrived.append(heappop(waiting)[4])
        return tuple(arrived)

    def collect_heard(
        self, name: ParticipantId, heard: Iterable[tuple[ParticipantId, int]]
    ) -> tuple[Envelope, ...]:
        """Remove and return the envelopes that a participant reported, by source and sequence; the first of several copies.

        Raises KeyError for an envelope that is not in flight.
        """
        references = tuple(heard)
        if not references:
            return ()
        waiting = sorted(self._in_flight[name])
        places: dict[tuple[ParticipantId, int], deque[int]] = {}
        for place, item in enumerate(waiting):
            places.setdefault((item[4].source, item[2]), deque()).append(place)
        collected = []
        for reference in references:
            if not places.get(reference):
                raise KeyError(reference)
            collected.append(places[reference].popleft())
        gone = frozenset(collected)
        # In order, it is a heap.
        self._in_flight[name][:] = [item for i, item in enumerate(waiting) if i not in gone]
        return tuple([waiting[place][4] for place in collected])

    def lose(self, name: ParticipantId, from_ns: int, until_ns: int) -> None:
        """Drop the envelopes that arrive at a participant within a window, its end excluded."""
        box = self._in_flight[name]
        box[:] = sorted(item for item in box if not from_ns <= item[0] < until_ns)

    def clear(self) -> None:
        """Drop all envelopes in flight."""
        for box in self._in_flight.values():
            box.clear()

    def arrivals(self) -> list[tuple[ParticipantId, int]]:
        """Each participant that envelopes are in flight to, or have arrived at, and when the first one does."""
        return [(name, box[0][0]) for name, box in self._boxes if box]

    def validate(self) -> None:
        """Assert the invariants that are stated at the attributes."""
        assert set(self._in_flight) == set(self._roster)
        for box in self._in_flight.values():
            assert all(box[(i - 1) // 2] <= box[i] for i in range(1, len(box)))
            assert all(item[0] != DROPPED and item[3] <= self._flights for item in box)
        flights = [item[3] for box in self._in_flight.values() for item in box]
        assert len(flights) == len(set(flights))

    def _make_room(self, envelopes: int) -> None:
        if self._sent.shape[0] < envelopes:
            self._sent = np.zeros((2 * envelopes, 4), dtype=np.int64)
            self._sent_bytes = self._sent.data
            self._decided = np.zeros((4 * envelopes * len(self._roster), 3), dtype=np.int64)
            self._decided_bytes = self._decided.data.cast("B")
            self._arguments: tuple[Any, ...] = (
                *map(tuple, (self._config, self._geometry, self._around)),
                *(self._sent, self._decided),
            )


def links(xy_m: np.ndarray, range_m: float, walls: Walls = OPEN) -> int:
    """Number of pairs of robots whose link is up. xy_m: (n, 2)."""
    around = Neighbourhood.of(xy_m.shape[0]) if xy_m.shape[0] >= _MANY else _NOBODY
    return int(_links(tuple(walls), tuple(around), xy_m, range_m))


@kernel
def _links(
    walls: tuple[Any, ...], neighbourhood: tuple[Any, ...], xy_m: np.ndarray, range_m: float
) -> int:
    """`links`. walls, neighbourhood: the fields of Walls and of a Neighbourhood."""
    around = Neighbourhood(*neighbourhood)
    by_place = xy_m.shape[0] >= _MANY and math.isfinite(range_m)
    if by_place:
        sort_by_place(xy_m, range_m, -1, around)
    count = 0
    for i in range(xy_m.shape[0]):
        possible = candidates(xy_m, i, around) if by_place else i
        for j in range(possible):
            other = around.near[j] if by_place else j
            if other < i:
                count += _in_range(*walls, xy_m, i, other, range_m, False)
    return count
