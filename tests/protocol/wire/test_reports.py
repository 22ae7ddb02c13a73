"""Reports of hostile participants: bounded in every dimension before anything in them is decoded."""

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.base.machine import Envelope, Outputs, Pose
from kantor_protocol.wire.messages import (
    BODY_BYTES_MAX,
    INBOX_MAX,
    NONCE_MAX,
    OUTBOX_MAX,
    VERSION,
    Ready,
    RefusedError,
    Report,
    decode_from_participant,
    encode,
)
from support.strategies import examples


def report(envelopes: int = 1, heard: int = 0, nonce: str = "n") -> Report:
    """A report with so many envelopes, which names so many that it heard."""
    outbox = tuple(Envelope("r1", 1 + i, "", b"") for i in range(envelopes))
    outputs = Outputs(1, Pose(0.0, 0.0), outbox=outbox)
    return Report(VERSION, nonce, outputs, heard=tuple(("r2", i) for i in range(heard)))


@given(
    envelopes=st.integers(0, 3 * OUTBOX_MAX),
    heard=st.integers(0, 3) | st.integers(INBOX_MAX - 1, INBOX_MAX + 1),
    letters=st.integers(0, NONCE_MAX + 2),
)
@examples(100)
def test_a_report_is_taken_exactly_if_it_is_within_all_bounds(
    envelopes: int, heard: int, letters: int
) -> None:
    """No count beyond its bound is taken, and every count within them is."""
    message = report(envelopes, heard, "n" * letters)
    sound = envelopes <= OUTBOX_MAX and heard <= INBOX_MAX and letters <= NONCE_MAX
    if sound:
        assert decode_from_participant(encode(message)) == message
    else:
        with pytest.raises(RefusedError, match="of length <="):
            decode_from_participant(encode(message))


@pytest.mark.parametrize(
    ("field", "count", "bound"),
    [("outbox", 300_000, OUTBOX_MAX), ("heard", 300_000, INBOX_MAX)],
)
def test_items_beyond_a_bound_are_not_even_looked_at(field: str, count: int, bound: int) -> None:
    """What would not decode is refused for its number, and not for what it is."""
    nonsense = [None] * count
    outbox, heard = (nonsense, []) if field == "outbox" else ([], nonsense)
    outputs = [1, [0.0, 0.0], None, b"", b"", b"", outbox, 0, 0, 0]
    payload = msgpack.packb([6, VERSION, "n", outputs, 0, heard])

    with pytest.raises(RefusedError, match=f"of length <= {bound}"):
        decode_from_participant(payload)


def test_a_nonce_is_bounded_in_every_message() -> None:
    with pytest.raises(RefusedError, match=f"of length <= {NONCE_MAX}"):
        decode_from_participant(encode(Ready(VERSION, "n" * (NONCE_MAX + 1))))


@pytest.mark.parametrize(("size", "sound"), [(BODY_BYTES_MAX, True), (BODY_BYTES_MAX + 1, False)])
def test_a_body_is_bounded(size: int, *, sound: bool) -> None:
    outputs = Outputs(1, Pose(0.0, 0.0), outbox=(Envelope("r1", 1, "", bytes(size)),))
    payload = encode(Report(VERSION, "n", outputs))
    if sound:
        assert decode_from_participant(payload)
    else:
        with pytest.raises(RefusedError, match="oversized body"):
            decode_from_participant(payload)
