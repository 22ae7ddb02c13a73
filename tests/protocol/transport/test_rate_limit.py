"""How much a participant may say."""

from hypothesis import given
from hypothesis import strategies as st

from kantor_protocol.scenario.clocks import step_clocks
from kantor_protocol.scenario.load import parse
from kantor_protocol.transport.rate_limit import (
    BURST_BYTES,
    BURST_MESSAGES,
    Excess,
    RateLimit,
    TokenBucket,
    rate_limits,
)
from kantor_protocol.wire.messages import MESSAGE_BYTES_MAX
from support.strategies import examples

SIZES = st.integers(0, 2 * MESSAGE_BYTES_MAX)
PAUSES_S = st.floats(0.0, 2.0)
SCENARIO = """
name = "turns"
coordination = "centralized"
domain = { min_m = [0, 0], max_m = [100, 100] }
robots = { count = 4 }
starts = { random = true }
clock = { period_s = 0.5, order = "turn" }
energy = { points = 40, steps = 100 }
samples = { count = 10 }
density = [{ mean_m = [50, 50], variance_m2 = [100, 100] }]
"""


@examples(200)
@given(st.floats(0.0, 500.0), st.lists(st.tuples(PAUSES_S, SIZES, st.booleans()), max_size=400))
def test_no_more_is_accepted_than_was_requested_and_earned(
    steps_per_s: float, said: list[tuple[float, int, bool]]
) -> None:
    """Messages and bytes are within the quota at any time, and what is not taken is counted."""
    quota = RateLimit.of(steps_per_s)
    bucket = TokenBucket(quota)
    now_s = 0.0
    asked = taken = taken_bytes = 0
    excess = Excess(0, 0)
    for pause_s, size, is_asked in said:
        now_s += pause_s
        if is_asked:
            bucket.grant_reply()
            asked += 1
        if bucket.admit(size, now_s):
            taken, taken_bytes = taken + 1, taken_bytes + size
        else:
            excess = Excess(excess.messages + 1, excess.bytes + size)
        earned, earned_bytes = now_s * quota.messages_per_s, now_s * quota.bytes_per_s
        assert taken <= BURST_MESSAGES + asked + earned + 1e-6
        assert taken_bytes <= BURST_BYTES + asked * MESSAGE_BYTES_MAX + earned_bytes + 1e-3
        assert bucket.excess == excess
        assert bucket.exceeded == (excess.messages > 0)


@examples(100)
@given(st.lists(st.integers(0, MESSAGE_BYTES_MAX), max_size=2000), st.integers(0, 5000))
def test_an_answer_is_always_taken(sizes: list[int], flood: int) -> None:
    """Turn by turn, however fast turns follow each other, and whatever was said before."""
    bucket = TokenBucket(RateLimit.of(0.0))
    for _ in range(flood):
        bucket.admit(MESSAGE_BYTES_MAX, 0.0)
    for size in sizes:
        bucket.grant_reply()
        assert bucket.admit(size, 0.0)


@examples(50)
@given(st.sampled_from((0.1, 1.0, 10.0, 100.0)), st.lists(st.floats(0.0, 10.0), max_size=5))
def test_a_sound_robot_is_within_its_quota(speed: float, frozen_s: list[float]) -> None:
    """It steps by its clock and says what is not heard again; frozen worlds find all of that at once."""
    period_s = 0.1 / speed
    bucket = TokenBucket(RateLimit.of(1.0 / period_s))
    now_s = 0.0
    for freeze_s in [*frozen_s, 0.0]:
        for _ in range(500):
            now_s += period_s
            assert bucket.admit(500, now_s)
        now_s += freeze_s
        assert all(bucket.admit(500, now_s) for _ in range(int(freeze_s / 0.2)))


def test_a_quota_follows_from_the_mission() -> None:
    """Who steps oftener may say more; who is asked for each step has that from being asked."""
    scenario = parse(SCENARIO, "test")
    wall = rate_limits(step_clocks(scenario, 0), "wall", 2.0)
    turns = rate_limits(step_clocks(scenario, 0), "lockstep", 2.0)

    assert list(wall) == list(scenario.roster)
    assert wall["r1"] == RateLimit.of(4.0)
    assert wall["supervisor"] == RateLimit.of(16.0)
    assert set(turns.values()) == {RateLimit.of(0.0)}


@examples(100)
@given(st.lists(st.tuples(PAUSES_S, st.floats(0.0, 12.0)), max_size=300))
def test_work_is_charged_as_messages_are(said: list[tuple[float, float]]) -> None:
    """A report that causes as much as eight costs as much as eight; what is not admitted is counted."""
    quota = RateLimit.of(10.0)
    bucket = TokenBucket(quota)
    now_s = taken = 0.0
    refused = 0
    for pause_s, work in said:
        now_s += pause_s
        if bucket.admit(100, now_s) and bucket.charge(work, now_s):
            taken += max(1.0, work)
        else:
            refused += 1
        assert taken <= BURST_MESSAGES + now_s * quota.messages_per_s + 1e-6
        assert bucket.excess.messages == refused


def test_work_beyond_the_quota_is_refused() -> None:
    """A report that causes as much as eight messages empties a full bucket eight times as fast."""
    bucket = TokenBucket(RateLimit.of(0.0))
    admitted = sum(bucket.admit(10, 0.0) and bucket.charge(8.0, 0.0) for _ in range(1000))

    assert admitted == BURST_MESSAGES // 8


def test_one_envelope_to_the_whole_team_costs_nothing_more() -> None:
    """So does a report without any: a full bucket is as empty as after as many messages."""
    bucket = TokenBucket(RateLimit.of(0.0))
    admitted = sum(bucket.admit(10, 0.0) and bucket.charge(1.0, 0.0) for _ in range(1000))

    assert admitted == BURST_MESSAGES
