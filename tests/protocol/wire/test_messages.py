"""The wire: every message both ways, an independent decoder, and a door that only ever refuses.

The golden bytes pin the format. After a deliberate change of it, run this file as a program
(`PYTHONPATH=tests python tests/protocol/test_messages.py`), look at the difference, and paste what it prints.
"""

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import astuple

from kantor_protocol.base.grid import Frame
from kantor_protocol.base.machine import Body, Envelope, Inputs, Observation, Outputs, Pose, State
from kantor_protocol.wire.messages import (
    BODY_BYTES_MAX,
    MESSAGE_BYTES_MAX,
    VERSION,
    Array,
    GossipMessage,
    Mission,
    PoseMessage,
    Progress,
    Ready,
    Refusal,
    RefusedError,
    Report,
    StartClock,
    StepRequest,
    Stop,
    check_outputs,
    decode_from_participant,
    decode_gossip,
    decode_inputs,
    decode_progress,
    decode_to_participant,
    encode,
    encode_gossip,
)
from support.strategies import (
    COUNTS,
    FINITE,
    INPUTS,
    NEWS,
    OUTPUTS,
    POSES,
    UNUSABLE,
    examples,
    mission,
    scattered,
)

NAMES = st.text(max_size=12)
V = st.just(VERSION)
FROM_PARTICIPANT = st.one_of(
    st.builds(
        Report,
        version=V,
        nonce=NAMES,
        outputs=OUTPUTS,
        now_ns=COUNTS,
        heard=st.lists(st.tuples(NAMES, COUNTS), max_size=3).map(tuple),
        observed=COUNTS,
    ),
    st.builds(Ready, version=V, nonce=NAMES),
)
TO_PARTICIPANT = st.one_of(
    st.builds(
        Mission,
        version=V,
        nonce=NAMES,
        scenario=st.sampled_from([mission(), mission("radio.range_m=5.0", "limit_s=3.5")]),
        seed=COUNTS,
        starts=st.integers(0, 3).map(lambda n: Array.of(scattered(n))),
        samples=st.integers(0, 3).map(lambda n: Array.of(scattered(n))),
        exchange=st.sampled_from(["lockstep", "wall"]),
        frame=st.none() | st.just(Frame(0.5, (-1.0, 2.0), 8, 6)),
        run=NAMES,
        body=st.builds(Body, pose=POSES, step=COUNTS, energy_spent=COUNTS, incarnation=COUNTS),
    ),
    st.builds(Refusal, version=V, nonce=NAMES, reason=NAMES),
    st.builds(StartClock, version=V, nonce=NAMES, now_ns=COUNTS, speed=FINITE),
    st.builds(StepRequest, version=V, inputs=INPUTS),
    st.builds(Stop, version=V, reason=NAMES),
)
POSE_MESSAGES = st.builds(PoseMessage, version=V, step=COUNTS, now_ns=COUNTS, pose=POSES)
PROGRESS = st.builds(
    Progress,
    version=V,
    now_ns=COUNTS,
    phase=st.sampled_from(["waiting", "running", "over"]),
    detail=NAMES,
    energy_spent=COUNTS,
    energy_total=COUNTS,
    detected=COUNTS,
    targets=COUNTS,
    w_ub=FINITE,
    links=COUNTS,
    messages_per_s=FINITE,
    robots_done=COUNTS,
    robots=COUNTS,
)

GOLDEN_NEWS = GossipMessage(
    version=1,
    step=7,
    x_m=1.5,
    y_m=-2.0,
    version_vector=b"\x03\x00",
    logs=b"\x00\x02\x01\x01\x06\x02",
    claims=b"",
)
GOLDEN_NEWS_BYTES = bytes.fromhex(
    "98010107cb3ff8000000000000cbc000000000000000c4020300c406000201010602c400"
)
GOLDEN_REPORT = Report(
    version=1,
    nonce="n1",
    outputs=Outputs(
        step=7,
        pose=Pose(1.5, -2.0, 0.25, 100.0),
        goal=(3.0, 4.0),
        spent=b"\x06\x02",
        lowered=b"\x06\x03",
        weights=b"",
        outbox=(Envelope("r1", 7, "", b"\x01\x02"),),
        energy_spent=7,
        state=State.EXPLORING,
        refused=1,
    ),
    now_ns=700_000_000,
    heard=(("r2", 6),),
    observed=6,
)
GOLDEN_REPORT_BYTES = bytes.fromhex(
    "980601a26e319a0794cb3ff8000000000000cbc000000000000000cb3fd0000000000000cb405900"
    "000000000092cb4008000000000000cb4010000000000000c4020602c4020603c4009194a2723107"
    "a0c4020102070001ce29b927009192a27232060600"
)


@examples(60)
@given(news=NEWS)
def test_gossip_message_decodes_to_what_was_encoded(news: GossipMessage) -> None:
    """What one participant tells another survives the radio."""
    assert decode_gossip(encode_gossip(news)) == news
    assert decode_gossip(encode(news)) == news


@examples(60)
@given(message=FROM_PARTICIPANT)
def test_word_of_a_participant_comes_back_as_it_was(message: Report | Ready) -> None:
    """On `<id>/tx`: Report and Ready."""
    assert decode_from_participant(encode(message)) == message


@examples(60)
@given(message=TO_PARTICIPANT)
def test_word_to_a_participant_comes_back_as_it_was(
    message: Mission | Refusal | StartClock | StepRequest | Stop,
) -> None:
    """On `<id>/rx`: Mission, Refusal, Go, Turn and Stop."""
    assert decode_to_participant(encode(message)) == message


@examples(60)
@given(pose=POSE_MESSAGES, progress=PROGRESS)
def test_word_to_observers_comes_back_as_it_was(pose: PoseMessage, progress: Progress) -> None:
    """On `<id>/pose` and `world/progress`."""
    assert msgspec.msgpack.decode(encode(pose), type=PoseMessage) == pose
    assert decode_progress(encode(progress)) == progress


@examples(60)
@given(inputs=INPUTS)
def test_inputs_come_back_as_they_were(inputs: Inputs) -> None:
    """In process, too, everything passes the codec."""
    assert decode_inputs(encode(inputs)) == inputs


@examples(60)
@given(news=NEWS)
def test_independent_decoder_reads_gossip_messages(news: GossipMessage) -> None:
    """A record is a msgpack array: tag, version, fields in order. `msgpack` knows nothing more."""
    fields = [news.step, news.x_m, news.y_m, news.version_vector, news.logs, news.claims]
    attestations = [
        [list(value) if isinstance(value, tuple) else value for value in astuple(attestation)]
        for attestation in news.attestations
    ]
    further = [news.registers, news.incarnation, list(news.proofs), attestations]
    complete = [*fields, *further]
    while not news.proofs and further and not further[-1]:
        further.pop()

    assert msgpack.unpackb(encode_gossip(news)) == [1, VERSION, *fields, *further]
    assert msgpack.unpackb(encode(news)) == [1, VERSION, *complete]


@examples(100)
@given(message=st.one_of(NEWS, FROM_PARTICIPANT, TO_PARTICIPANT, POSE_MESSAGES, PROGRESS))
def test_independent_decoder_reads_every_message(message: msgspec.Struct) -> None:
    """Every message is an array of its tag, the version and as many items as it has fields."""
    plain = msgpack.unpackb(encode(message))

    assert plain[:2] == [message.__struct_config__.tag, VERSION]
    assert len(plain) == 1 + len(message.__struct_fields__)


def test_no_two_messages_share_a_tag() -> None:
    """A tag says what a message is, on any key."""
    kinds = (
        GossipMessage,
        Mission,
        Refusal,
        StartClock,
        StepRequest,
        Report,
        Ready,
        Stop,
        PoseMessage,
        Progress,
    )

    assert len({kind.__struct_config__.tag for kind in kinds}) == len(kinds)


def test_bytes_of_a_gossip_message_have_not_changed() -> None:
    """The golden bytes of a News, both ways."""
    assert encode_gossip(GOLDEN_NEWS) == GOLDEN_NEWS_BYTES
    assert decode_gossip(GOLDEN_NEWS_BYTES) == GOLDEN_NEWS


def test_registers_come_last() -> None:
    """Add-only: to a message without them the field is appended, to an array of nine items."""
    said = msgspec.structs.replace(GOLDEN_NEWS, registers=b"\x01\x02")

    assert encode_gossip(said) == b"\x99" + GOLDEN_NEWS_BYTES[1:] + b"\xc4\x02\x01\x02"


def test_report_has_not_drifted() -> None:
    """The golden bytes of a Report, both ways."""
    assert encode(GOLDEN_REPORT) == GOLDEN_REPORT_BYTES
    assert decode_from_participant(GOLDEN_REPORT_BYTES) == GOLDEN_REPORT


def test_a_shorter_report_is_read() -> None:
    """Fields that were added at the end have defaults: an older participant is understood."""
    shorter = b"\x97" + GOLDEN_REPORT_BYTES[1:-1]

    assert decode_from_participant(shorter) == GOLDEN_REPORT


@pytest.mark.parametrize("version", [0, 2, -1, 2**63])
def test_another_version_is_refused(version: int) -> None:
    """A change of meaning takes a new version, and an old reader does not guess."""
    news = msgpack.packb([1, version, 7, 0.0, 0.0, b"", b"", b""])
    ready = msgpack.packb([7, version, "n"])
    stop = msgpack.packb([8, version, "over"])
    for decode, payload in (
        (decode_gossip, news),
        (decode_from_participant, ready),
        (decode_to_participant, stop),
    ):
        with pytest.raises(RefusedError, match="version"):
            decode(payload)


@examples(60)
@given(news=NEWS, more=st.lists(st.none() | COUNTS | st.text(max_size=5), min_size=1, max_size=3))
def test_further_fields_of_a_gossip_message_are_ignored(
    news: GossipMessage, more: list[int | str | None]
) -> None:
    """Add-only: a newer sender may append fields that this reader does not know."""
    assert decode_gossip(msgpack.packb([*msgpack.unpackb(encode(news)), *more])) == news


@examples(60)
@given(message=FROM_PARTICIPANT)
def test_further_fields_of_a_report_are_ignored(message: Report | Ready) -> None:
    """Add-only, on the message and on the records in it."""
    plain = msgpack.unpackb(encode(message))
    if isinstance(message, Report):
        plain[3][1].append("a newer pose")
        plain[3].append({"newer": "outputs"})

    assert decode_from_participant(msgpack.packb([*plain, ["newer"]])) == message


def test_older_report_gets_the_defaults() -> None:
    """Add-only: fields at the end that an older sender leaves out have their defaults."""
    plain = msgpack.packb([6, 1, "n", [3, [1.0, 2.0]]])

    assert decode_from_participant(plain) == Report(1, "n", Outputs(3, Pose(1.0, 2.0)))


def test_a_mission_without_a_body_is_refused() -> None:
    """A participant has to know from where it goes on, and in which run."""
    nothing, body = Array.of(scattered(0)), Body(Pose(1.0, 2.0))
    told = Mission(VERSION, "n", mission(), 1, nothing, nothing, "wall", None, "run", body)
    plain = msgpack.unpackb(encode(told))

    assert decode_to_participant(msgpack.packb(plain)) == told
    with pytest.raises(RefusedError):
        decode_to_participant(msgpack.packb(plain[:-2]))


@examples(60)
@given(number=UNUSABLE, slot=st.integers(0, 5))
def test_outputs_with_a_number_that_is_none_are_refused(number: float, slot: int) -> None:
    """NaN and infinity never get past the door: pose (4 numbers) and goal (2)."""
    numbers = [1.0] * 6
    numbers[slot] = number
    outputs = Outputs(step=1, pose=Pose(*numbers[:4]), goal=(numbers[4], numbers[5]))
    with pytest.raises(RefusedError, match="finite"):
        decode_from_participant(encode(Report(VERSION, "n", outputs)))


@examples(20)
@given(number=UNUSABLE, axis=st.sampled_from(["x_m", "y_m"]))
def test_gossip_message_without_a_position_is_refused(number: float, axis: str) -> None:
    """The place of a speaker is finite."""
    with pytest.raises(RefusedError, match="finite"):
        decode_gossip(encode(msgspec.structs.replace(GOLDEN_NEWS, **{axis: number})))


def test_gossip_message_from_before_the_start_is_refused() -> None:
    """Steps count upwards from 0."""
    with pytest.raises(RefusedError):
        decode_gossip(encode(msgspec.structs.replace(GOLDEN_NEWS, step=-1)))


@pytest.mark.parametrize("count", [-1, 2**63, 2**64 - 1])
def test_count_beyond_64_bits_is_refused(count: int) -> None:
    """Counts are taken into int64 arrays by the radio; what does not fit is refused before."""
    sound = Outputs(step=1, pose=Pose(0.0, 0.0))
    for outputs in (
        msgspec.structs.replace(sound, step=count),
        msgspec.structs.replace(sound, energy_spent=count),
        msgspec.structs.replace(sound, refused=count),
        msgspec.structs.replace(sound, outbox=(Envelope("r1", count, "", b""),)),
    ):
        with pytest.raises(RefusedError):
            check_outputs(outputs)


def test_longest_body_is_taken_and_a_longer_one_refused() -> None:
    """A body has BODY_BYTES_MAX bytes at most, alone or in a report."""
    room = BODY_BYTES_MAX - len(encode(GOLDEN_NEWS)) - 3
    fits = encode(msgspec.structs.replace(GOLDEN_NEWS, claims=bytes(room)))
    longer = encode(msgspec.structs.replace(GOLDEN_NEWS, claims=bytes(room + 1)))
    pose = Pose(0.0, 0.0)

    assert len(fits) == BODY_BYTES_MAX
    assert decode_gossip(fits).step == 7
    check_outputs(Outputs(step=1, pose=pose, outbox=(Envelope("r1", 1, "", fits),)))
    with pytest.raises(RefusedError, match="bytes"):
        decode_gossip(longer)
    with pytest.raises(RefusedError, match="oversized"):
        check_outputs(Outputs(step=1, pose=pose, outbox=(Envelope("r1", 1, "", longer),)))


def test_oversized_message_is_refused() -> None:
    """A participant's message has MESSAGE_BYTES_MAX bytes at most."""
    with pytest.raises(RefusedError, match="bytes"):
        decode_from_participant(encode(Ready(VERSION, "n" * MESSAGE_BYTES_MAX)))


DOORS = (
    decode_gossip,
    decode_from_participant,
    decode_to_participant,
    decode_progress,
    decode_inputs,
)


@examples(300)
@given(payload=st.binary(max_size=80))
def test_any_bytes_are_refused_or_taken_at_every_door(payload: bytes) -> None:
    """No bytes raise anything but RefusedError."""
    for decode in DOORS:
        try:
            decode(payload)
        except RefusedError:
            continue


@examples(200)
@given(
    message=st.one_of(NEWS, FROM_PARTICIPANT, TO_PARTICIPANT, PROGRESS, INPUTS, OUTPUTS),
    at=st.integers(0, 10_000),
    byte=st.integers(0, 255),
    cut=st.integers(0, 3),
)
def test_damaged_messages_are_refused_or_taken_at_every_door(
    message: msgspec.Struct, at: int, byte: int, cut: int
) -> None:
    """One byte changed, the tail lost: nothing but RefusedError."""
    payload = bytearray(encode(message))
    payload[at % len(payload)] = byte
    for decode in DOORS:
        try:
            decode(bytes(payload[: len(payload) - cut]))
        except RefusedError:
            continue


def test_text_that_is_no_text_is_refused() -> None:
    """A string that is not UTF-8 is a malformed message, not an error of the reader."""
    with pytest.raises(RefusedError):
        decode_from_participant(b"\x93\x07\x01\xa1\xff")
    with pytest.raises(RefusedError):
        decode_to_participant(b"\x93\x08\x01\xa1\xff")


@pytest.mark.parametrize("level", [b"\x91", b"\x81\x01"])
def test_deep_nesting_is_refused(level: bytes) -> None:
    """A message of nothing but brackets is refused, in a known field or in an unknown one."""
    deep = level * 100_000 + b"\xc0"
    further = b"\x99" + GOLDEN_NEWS_BYTES[1:] + deep
    for decode in DOORS:
        with pytest.raises(RefusedError):
            decode(deep)
    with pytest.raises(RefusedError):
        decode_gossip(further)


@pytest.mark.parametrize(
    "head", [b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"]
)
def test_length_that_does_not_follow_is_refused(head: bytes) -> None:
    """An array, a map or bytes of four thousand million items that are not there take no room."""
    for decode in DOORS:
        with pytest.raises(RefusedError):
            decode(head)
    with pytest.raises(RefusedError):
        decode_gossip(b"\x98\x01\x01\x07" + head)


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<i4", ">i4", "|u1", "<i8"])
def test_array_of_any_byte_order_travels_little_endian(dtype: str) -> None:
    """An array comes back with its numbers, whatever its byte order was."""
    array = np.array([[1, 2, 3], [4, 5, 6]], dtype=dtype)
    packed = Array.of(array)

    assert packed.open(array.dtype.newbyteorder("<").str, 2).tolist() == array.tolist()
    assert packed.dtype[0] in "<|"


def test_array_that_is_not_contiguous_is_packed_by_rows() -> None:
    """A view is packed as what it shows."""
    array = scattered(6)[::2].T

    assert Array.of(array).open("<f8", 2).tolist() == array.tolist()


@pytest.mark.parametrize(
    "array",
    [
        Array("<f4", (2,), bytes(8)),
        Array("|O", (1,), bytes(8)),
        Array("<f8", (1, 1), bytes(8)),
        Array("<f8", (), bytes(8)),
        Array("<f8", (2,), bytes(8)),
        Array("<f8", (1,), bytes(7)),
        Array("<f8", (-1,), bytes(8)),
        Array("<f8", (2**61,), b""),
    ],
)
def test_array_that_is_not_what_was_expected_is_refused(array: Array) -> None:
    """Another dtype, another number of dimensions, a shape that the bytes do not fill."""
    with pytest.raises(RefusedError):
        array.open("<f8", 1)


@pytest.mark.parametrize("shape", [(0, 2**62), (0, 2**64 - 1), (2**62, 0)])
def test_empty_array_of_an_impossible_shape_is_refused(shape: tuple[int, int]) -> None:
    """No bytes fill a shape with a zero in it, but not every such shape exists."""
    with pytest.raises(RefusedError):
        Array("<f8", shape, b"").open("<f8", 2)


@examples(100)
@given(
    dtype=st.text(max_size=4) | st.just("<f8"),
    shape=st.lists(st.integers(-2, 3) | COUNTS, max_size=3).map(tuple),
    content=st.binary(max_size=24),
)
def test_any_array_opens_or_is_refused(dtype: str, shape: tuple[int, ...], content: bytes) -> None:
    """Opening is total."""
    try:
        array = Array(dtype, shape, content).open("<f8", 2)
    except RefusedError:
        return

    assert array.shape == shape
    assert array.tobytes() == content


def test_turn_carries_the_inbox_in_order_of_arrival() -> None:
    """What a participant is given is a value, down to the order of its inbox."""
    inbox = (Envelope("r2", 4, "", b"b"), Envelope("r3", 4, "r1", b"c"))
    turn = StepRequest(VERSION, Inputs(1, Observation(0, Pose(0.0, 0.0), (3, 5)), inbox))

    assert decode_to_participant(encode(turn)) == turn


if __name__ == "__main__":
    print(encode_gossip(GOLDEN_NEWS).hex())  # noqa: T201  to be pasted above
    print(encode(GOLDEN_REPORT).hex())  # noqa: T201
