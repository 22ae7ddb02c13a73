"""An index of the deliveries that are under way to a participant, by source and sequence: a hash table of their rows.

It has twice as many slots as there is room for deliveries, a power of two. Each delivery is at the first free slot
from the hash of its source and sequence on; copies of one envelope have a slot each.
"""

import numpy as np

from kantor_protocol.base.kernels import kernel


@kernel
def first_slot(source: int, sequence: int, slots: np.ndarray) -> int:
    """The slot from which on a delivery is looked for."""
    mixed = sequence * 0x1E3779B97F4A7C15 + source * 0x2F58476D1CE4E5B9
    mixed ^= mixed >> 31
    mixed *= 0x14D049BB133111EB
    mixed ^= mixed >> 29
    return mixed & (slots.shape[0] - 1)


@kernel
def next_slot(slot: int, slots: np.ndarray) -> int:
    """The slot after one."""
    return (slot + 1) & (slots.shape[0] - 1)


@kernel
def add_to_index(deliveries: np.ndarray, slots: np.ndarray, row: int) -> None:
    """Add a row of the deliveries."""
    slot = first_slot(deliveries[row].source, deliveries[row].sequence, slots)
    while slots[slot] != 0:
        slot = next_slot(slot, slots)
    slots[slot] = row + 1


@kernel
def _slot_of(deliveries: np.ndarray, slots: np.ndarray, row: int) -> int:
    slot = first_slot(deliveries[row].source, deliveries[row].sequence, slots)
    while slots[slot] != row + 1:
        slot = next_slot(slot, slots)
    return slot


@kernel
def remove_row(deliveries: np.ndarray, slots: np.ndarray, row: int, last: int) -> None:
    """Remove a row; the last one takes its place, in the deliveries and in the index."""
    free = _slot_of(deliveries, slots, row)
    slot = free
    slots[free] = 0
    while True:  # what was put further on because this slot was taken moves up
        slot = next_slot(slot, slots)
        if slots[slot] == 0:
            break
        moved = slots[slot] - 1
        wanted = first_slot(deliveries[moved].source, deliveries[moved].sequence, slots)
        mask = slots.shape[0] - 1
        if ((slot - wanted) & mask) >= ((slot - free) & mask):
            slots[free] = slots[slot]
            slots[slot] = 0
            free = slot
    if row != last:
        slots[_slot_of(deliveries, slots, last)] = row + 1
        deliveries[row] = deliveries[last]


@kernel
def index_deliveries(deliveries: np.ndarray, slots: np.ndarray, count: int) -> None:
    """Index the first rows anew."""
    slots[:] = 0
    for row in range(count):
        add_to_index(deliveries, slots, row)
