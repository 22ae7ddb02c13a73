"""Origins of replicated state: incarnation e of place i in a roster of n is *slot* e n + i.

A participant that has lost what others may have of it goes on as a new incarnation, with a log, a claim
and a register of its own: two writers must never share one. Whoever was never reborn has the slot of its
place, and a team of such pays nothing. Slots come in blocks of n: who has heard of an incarnation knows
one block for it and for each before.
"""

INCARNATIONS_MAX = 15
"""The last incarnation that a participant may have; the first is 0."""


def known_to(slot: int, roster: int) -> int:
    """The slots that whoever has this one knows at least. Raises ValueError for an incarnation too many."""
    incarnation = slot // roster
    if not 0 <= incarnation <= INCARNATIONS_MAX:
        raise ValueError(
            f"incarnation {incarnation}: the last that a participant may have is {INCARNATIONS_MAX}"
        )
    return (incarnation + 1) * roster
