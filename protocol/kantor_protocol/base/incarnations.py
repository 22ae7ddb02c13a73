"""Incarnation ids: incarnation e of place i in a roster of n has the id e n + i.

A participant that has lost what others may hold of it goes on as a new incarnation, with a log, a claim and a
register of its own: two writers must never share one. The first incarnation of a participant has the id of its
place, so that ids cost nothing in a team that has lost nothing. Ids come in blocks of n: a participant that knows
one incarnation knows one block for it and for each before.
"""

INCARNATIONS_MAX = 15
"""The last incarnation that a participant may have; the first is 0."""


def known_ids(incarnation_id: int, roster: int) -> int:
    """The number of ids that a participant knows at least when it knows this one.

    Raises ValueError for an incarnation too many.
    """
    incarnation = incarnation_id // roster
    if not 0 <= incarnation <= INCARNATIONS_MAX:
        raise ValueError(
            f"incarnation {incarnation}: the last that a participant may have is {INCARNATIONS_MAX}"
        )
    return (incarnation + 1) * roster
