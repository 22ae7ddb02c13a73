"""The announcement of a trader in its register: its offer, its answers to other offers, and its tour."""

from collections.abc import Sequence
from typing import NamedTuple

from kantor_agent.planners.market.costs import NO_ROBOT
from kantor_protocol.base.grid import NOWHERE

HEAD = 4
"""Numbers before those of each robot."""


class Memo(NamedTuple):
    """An announcement of one robot; see `planner.py`. The latest counts."""

    clock: int
    """Number of the memo, rising with gaps; 0: the robot has announced nothing."""
    offered: int
    """The goal on offer, or NOWHERE."""
    price: int
    """A bid has to be below it; in 1/PER_CELL of a cell."""
    opened: int
    """The clock of the first memo with this offer."""
    acknowledged: tuple[int, ...]
    """(robots,) clocks of the memos of others that this one answers."""
    bids: tuple[int, ...]
    """(robots,) 1 + the bid for the offer in the acknowledged memo, or 0."""
    tour: tuple[tuple[int, int], ...]
    """Its goals in order, each with its successor or NO_ROBOT."""

    @property
    def firm(self) -> list[int]:
        """Goals without a successor."""
        return [goal for goal, successor in self.tour if successor == NO_ROBOT]


def packed(memo: Memo) -> tuple[int, ...]:
    """A memo as integers, in the order of `planner.py`."""
    answers = [number for pair in zip(memo.acknowledged, memo.bids, strict=True) for number in pair]
    tour = [number + 1 for pair in memo.tour for number in pair]
    return memo.clock, memo.offered + 1, memo.price, memo.opened, *answers, *tour


def unpacked(numbers: Sequence[int], robots: int, cells: int) -> Memo:
    """A memo from the numbers of a register: zeros at the end may be missing, values out of range are left out."""
    begin = HEAD + 2 * robots
    numbers = [*numbers, *[0] * (begin + 1)]
    clock, offered, price, opened = numbers[:HEAD]
    acknowledged, bids = numbers[HEAD:begin:2], numbers[HEAD + 1 : begin : 2]
    pairs = zip(numbers[begin::2], numbers[begin + 1 :: 2], strict=False)
    return Memo(
        max(0, clock),
        offered - 1 if 1 <= offered <= cells else NOWHERE,
        price,
        opened,
        tuple(acknowledged),
        tuple(bids),
        tuple(
            (cell - 1, successor - 1 if 1 <= successor <= robots else NO_ROBOT)
            for cell, successor in pairs
            if 1 <= cell <= cells
        ),
    )
