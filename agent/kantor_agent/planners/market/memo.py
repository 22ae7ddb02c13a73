"""What a trader tells in its register: its tour, and its offer."""

from collections.abc import Sequence
from typing import NamedTuple

from kantor_agent.planners.market.costs import NOBODY
from kantor_protocol.base.grid import NOWHERE

HEAD = 4


class Memo(NamedTuple):
    """What a robot announces; see the module."""

    clock: int
    """Counts its memos, with gaps; 0: no memo."""
    offered: int
    """The goal on offer, or NOWHERE."""
    price: int
    opened: int
    """The clock of the first memo with this offer."""
    seen: tuple[int, ...]
    """(robots,) clocks of the memos that it answers."""
    bids: tuple[int, ...]
    """(robots,) 1 + the bid for the offer in that memo, or 0."""
    tour: tuple[tuple[int, int], ...]
    """Its goals, and who is to take each over."""

    @property
    def firm(self) -> list[int]:
        """Goals that nobody is to take over."""
        return [goal for goal, heir in self.tour if heir == NOBODY]


def packed(memo: Memo) -> tuple[int, ...]:
    """A memo as integers."""
    answers = [number for pair in zip(memo.seen, memo.bids, strict=True) for number in pair]
    tour = [number + 1 for pair in memo.tour for number in pair]
    return memo.clock, memo.offered + 1, memo.price, memo.opened, *answers, *tour


def unpacked(numbers: Sequence[int], robots: int, cells: int) -> Memo:
    """A memo from whatever somebody announced; zeros at the end may be missing, nonsense is left out."""
    begin = HEAD + 2 * robots
    numbers = [*numbers, *[0] * (begin + 1)]
    clock, offered, price, opened = numbers[:HEAD]
    seen, bids = numbers[HEAD:begin:2], numbers[HEAD + 1 : begin : 2]
    pairs = zip(numbers[begin::2], numbers[begin + 1 :: 2], strict=False)
    return Memo(
        max(0, clock),
        offered - 1 if 1 <= offered <= cells else NOWHERE,
        price,
        opened,
        tuple(seen),
        tuple(bids),
        tuple(
            (cell - 1, heir - 1 if 1 <= heir <= robots else NOBODY)
            for cell, heir in pairs
            if 1 <= cell <= cells
        ),
    )
