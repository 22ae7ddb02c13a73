"""Origins of replicated state: incarnation e of place i in a roster of n is *slot* e n + i.

A participant that has lost what others may have of it goes on as a new incarnation, with a log, a claim
and a register of its own: two writers must never share one. Whoever was never reborn has the slot of its
place, and a team of such pays nothing. Slots come in blocks of n: who has heard of an incarnation knows
one block for it and for each before.
"""

from kantor_protocol.kernels import kernel
from kantor_protocol.packing import MALFORMED

EPOCHS_MAX = 15
"""The last incarnation that a participant may have; the first is 0."""


def known_to(slot: int, roster: int) -> int:
    """The slots that whoever has this one knows at least. Raises ValueError for an incarnation too many."""
    epoch = slot // roster
    if not 0 <= epoch <= EPOCHS_MAX:
        raise ValueError(
            f"incarnation {epoch}: the last that a participant may have is {EPOCHS_MAX}"
        )
    return (epoch + 1) * roster


@kernel
def count_slots(have: bytes, roster: int, parts: int) -> int:
    """For how many slots a version vector is, told by the last bytes of its numbers; or MALFORMED.

    parts: numbers for each slot.
    """
    numbers = 0
    length = 0
    for i in range(len(have)):
        length += 1
        if have[i] < 128:
            numbers += 1
            length = 0
        elif length >= 9:  # see `take_uint`
            return MALFORMED
    block = roster * parts
    if length > 0 or numbers == 0 or numbers % block or numbers > block * (EPOCHS_MAX + 1):
        return MALFORMED
    return numbers // parts


def slots_told(have: bytes, roster: int, *, claims: bool) -> int | None:
    """For how many slots a version vector of a mission (with claims or without) is; None if malformed."""
    told = count_slots(have, roster, 2 if claims else 1)
    return None if told < 0 else told
