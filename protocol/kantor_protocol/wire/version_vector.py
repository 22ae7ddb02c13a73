"""Version vectors: how much of every incarnation's log, claim and register a participant has."""

from kantor_protocol.base.incarnations import INCARNATIONS_MAX
from kantor_protocol.base.kernels import kernel
from kantor_protocol.base.varint import MALFORMED


@kernel
def count_slots(version_vector: bytes, roster: int, parts: int) -> int:
    """For how many slots a version vector is, told by the last bytes of its numbers; or MALFORMED.

    parts: numbers for each slot.
    """
    numbers = 0
    length = 0
    for i in range(len(version_vector)):
        length += 1
        if version_vector[i] < 128:
            numbers += 1
            length = 0
        elif length >= 9:  # see `read_uint`
            return MALFORMED
    block = roster * parts
    if length > 0 or numbers == 0 or numbers % block or numbers > block * (INCARNATIONS_MAX + 1):
        return MALFORMED
    return numbers // parts


def slots_told(version_vector: bytes, roster: int, *, claims: bool) -> int | None:
    """For how many slots a version vector of a mission (with claims or without) is; None if malformed."""
    told = count_slots(version_vector, roster, 2 if claims else 1)
    return None if told < 0 else told
