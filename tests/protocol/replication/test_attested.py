"""Authentic knowledge: who forwards cannot rewrite, who tells two stories is found out, and all else goes on."""

import copy
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from kantor_protocol.base.grid import Frame
from kantor_protocol.base.machine import SUPERVISOR, Envelope, Pose
from kantor_protocol.replication import attested
from kantor_protocol.replication.attested import attested_every
from kantor_protocol.replication.gossip import Gossip, MessageCheck
from kantor_protocol.replication.occupancy_log import entries as entries_on
from kantor_protocol.replication.replica_kernels import (
    BLOCK,
    ENTRIES_MAX,
    OFFERED,
    REST_BLOCKS_MAX,
    SHIPPED,
)
from kantor_protocol.wire.attestations import HASH_BYTES, UNSIGNED, Attestation, hash_of, signed
from kantor_protocol.wire.messages import BODY_BYTES_MAX
from kantor_protocol.wire.weights import Units
from support.missions import on_map
from support.replication.attesting import (
    RUN,
    Member,
    changed,
    claim_of,
    identities_of,
    key_of,
    message_of,
    talk,
)
from support.strategies import examples, mission

N = 12
UNITS = Units.of(30, N)
"""Five units a sample, two a point; twenty for each robot."""
OFTEN = 3
"""Steps from one attestation to the next in these tests."""
SIGNED, OPEN = ("trust=signed",), ()
SPECTRAL = ("planner=spectral", "planner.modes=1")


@pytest.fixture(autouse=True)
def _attestations_are_frequent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attested, "_EVERY_STEPS", OFTEN)
    monkeypatch.setattr(attested, "_EVERY_STEPS_ON_MAPS", OFTEN)


def team(*overrides: str) -> list[Member]:
    """Three robots of the small mission."""
    scenario = mission(*overrides)
    return [Member(name, scenario, N, UNITS) for name in scenario.robot_ids]


def acquainted(*overrides: str) -> list[Member]:
    """Three robots in a line: r2 has what r1 attested after its first words, r3 has heard of r2 alone."""
    made = one, two, three = team("trust=signed", *overrides)
    one.buy(0, 2)
    one.buy(1, 1)
    if overrides:
        one.write([3])
    else:
        one.claim(4)
    talk([one, two], 3 * OFTEN)
    two.hear(three.speak())
    return made


def forwarded(two: Member, three: Member) -> Envelope:
    """The message in which r2 brings r3 all that r1 has attested."""
    has_register = len(two.registers[0]) > 0
    for _ in range(20):
        word = two.speak()
        message = message_of(word)
        brings = any(each.origin == 0 for each in message.attestations) and message.proofs[0]
        if brings and len(message.registers) > (3 if has_register else -1):
            return word
        two.hear(three.speak())
    raise AssertionError("nothing is forwarded")


# The knowledge that all come to.

EVENTS = st.lists(
    st.one_of(
        st.tuples(st.just("buy"), st.integers(0, 3), st.integers(0, N - 1), st.integers(1, 2)),
        st.tuples(st.just("claim"), st.integers(0, 3), st.integers(-1, N - 1), st.just(0)),
        st.tuples(st.just("speak"), st.integers(0, 3), st.just(0), st.just(0)),
        st.tuples(st.just("speak"), st.integers(0, 3), st.just(0), st.just(0)),
        st.tuples(st.just("hear"), st.integers(0, 99), st.integers(0, 1), st.just(0)),
        st.tuples(st.just("hear"), st.integers(0, 99), st.integers(0, 1), st.just(0)),
        st.tuples(st.just("lose"), st.integers(0, 99), st.just(0), st.just(0)),
    ),
    max_size=60,
)


def played(events: list[tuple[str, int, int, int]], overrides: tuple[str, ...]) -> list[Member]:
    """Robots in a line under an arbitrary radio, then in good weather."""
    line = team(*overrides)
    air: list[tuple[int, Envelope]] = []
    for event, which, number, amount in events:
        who = which % len(line)
        if event == "buy":
            line[who].buy(number, amount)
        elif event == "claim":
            line[who].claim(number)
        elif event == "speak":
            word = line[who].speak()
            air += [(i, word) for i in (who - 1, who + 1) if 0 <= i < len(line)]
        elif air:
            receiver, word = air[which % len(air)]
            assert event == "lose" or not line[receiver].hear(word)
            if event == "lose" or number:
                del air[which % len(air)]
    talk(line, (len(line) + 1) * (OFTEN + 4))
    return line


def knowledge(member: Member) -> list[Any]:
    """The weights, and with a ledger the logs, that a member holds."""
    logs = [member.held_log(i) for i in range(3)] if member.replica.config.ledger else []
    return [member.replica.weights.tolist(), logs]


@given(events=EVENTS, rules=st.sampled_from([(), ("merge=min",), ("radio.beacon=state",)]))
@examples(120)
def test_signed_robots_come_to_know_what_open_ones_do(
    events: list[tuple[str, int, int, int]], rules: tuple[str, ...]
) -> None:
    """Whatever is lost, doubled, delayed and forwarded: in the end all hold what was spent, and nobody is blamed."""
    made = {trust: played(events, (*trust, *rules)) for trust in (SIGNED, OPEN)}

    for line in made.values():
        assert all(knowledge(member) == knowledge(line[0]) for member in line)
    assert [member.gossip.refused for member in made[SIGNED]] == [0, 0, 0]
    assert [dict(member.gossip.forked) for member in made[SIGNED]] == [{}, {}, {}]
    if made[SIGNED][0].replica.config.ledger:
        for line in made.values():
            spent = Counter[int]()
            for sample, units in (entry for member in line for entry in member.log):
                spent[sample] += units
            left = [max(0, UNITS.sample - spent[sample]) for sample in range(N)]
            assert line[0].replica.weights.tolist() == left
            assert line[0].held_log(2) == line[2].log


@given(writes=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 9)), max_size=12))
@examples(40)
def test_registers_travel_as_they_were_attested(writes: list[tuple[int, int]]) -> None:
    """In the end all hold every register."""
    line = team(*SIGNED, *SPECTRAL)
    for who, amount in writes:
        line[who].write([amount])
        talk(line, 1)
    talk(line, 4 * (OFTEN + 8))

    expected = [member.replica.registers.values[member.me].tolist() for member in line]
    assert all(member.replica.registers.values.tolist() == expected for member in line)


# Who forwards cannot rewrite.


def holds_only_the_truth(member: Member, origin: Member) -> None:
    """What is held of an origin is what it has written."""
    log, held, registers = member.held_log(origin.me), member.replica, member.replica.registers
    assert log == origin.log[: len(log)]
    assert claim_of(held, origin.me) in origin.claims
    stamp = int(registers.stamps[origin.me])
    if registers.total.size:
        assert registers.values[origin.me].tolist() == origin.registers[stamp]
    assert origin.me not in member.gossip.forked


def altered(content: bytes, place: int, value: int, kind: str) -> bytes:
    """Bytes with one of them changed, left out or put in."""
    at = place % (len(content) + 1)
    if kind == "insert":
        return content[:at] + bytes([value]) + content[at:]
    return content[:at] + (bytes([value]) if kind == "change" else b"") + content[at + 1 :]


FIELDS = ("logs", "claims", "registers", "version_vector", "proofs", "attestations")


@given(
    overrides=st.sampled_from([(), SPECTRAL]),
    changes=st.lists(
        st.tuples(
            st.sampled_from(FIELDS),
            st.integers(0, 200),
            st.integers(0, 255),
            st.sampled_from(["change", "insert", "leave out"]),
        ),
        min_size=1,
        max_size=3,
    ),
)
@examples(300)
def test_a_forwarder_cannot_rewrite(
    overrides: tuple[str, ...], changes: list[tuple[str, int, int, str]]
) -> None:
    """Whatever it changes in a message that brings another's word: of that other nothing false is believed."""
    one, two, three = acquainted(*overrides)
    message = message_of(forwarded(two, three))
    for field, place, value, kind in changes:
        before = getattr(message, field)
        after: Any
        if field == "proofs":
            after = tuple(altered(each, place, value, kind) for each in before)
        elif field == "attestations":
            after = tuple(_altered_attestation(each, place, value, kind) for each in before)
        else:
            after = altered(before, place, value, kind)
        message = replace(message, **{field: after})

    three.hear(changed(two.speak(), **msgspec.structs.asdict(message)))
    holds_only_the_truth(three, one)


def _altered_attestation(before: Attestation, place: int, value: int, kind: str) -> Attestation:
    """One field is another, or as long as before with one other byte."""
    name = Attestation.__struct_fields__[place % len(Attestation.__struct_fields__)]
    field = getattr(before, name)
    if name == "claim":
        return replace(before, claim=(field[0] + value % 3 - 1, value % (N + 1), field[2]))
    if isinstance(field, int):
        return replace(before, **{name: field + value % 5 - 2})
    return replace(before, **{name: altered(field, place, value, kind)})


def resigned(attestation: Attestation, **fields: Any) -> Attestation:
    """An attestation that r2 signs in the name of r1."""
    return signed(RUN, replace(attestation, **fields), key_of("r2"))


FALSE_WORDS = {
    "entries-without-attestation": lambda m: {"attestations": m.attestations[1:], "proofs": ()},
    "entries-without-proof": lambda m: {"proofs": (b"",)},
    "a-proof-too-short": lambda m: {"proofs": (m.proofs[0][:-1],)},
    "a-proof-too-many": lambda m: {"proofs": (*m.proofs, b"")},
    "another-first-hash": lambda m: {"proofs": (hash_of(b"x"),)},
    "signed-by-the-forwarder": lambda m: {"attestations": (resigned(m.attestations[0]),)},
    "unsigned": lambda m: {"attestations": (replace(m.attestations[0], signature=UNSIGNED),)},
    "of-another-run": lambda m: {
        "attestations": (signed("else", m.attestations[0], key_of("r1")),)
    },
    "another-claim": lambda m: {"claims": bytes([0, 9, 4, 1])},
    "twice": lambda m: {"attestations": m.attestations * 2, "proofs": m.proofs * 2},
    "of-nobody": lambda m: {"attestations": (resigned(m.attestations[0], origin=9),)},
    "negative": lambda m: {"attestations": (resigned(m.attestations[0], origin=-1),)},
}


@pytest.mark.parametrize("name", FALSE_WORDS)
def test_a_false_word_of_another_is_refused_whole(name: str) -> None:
    """It is counted, changes nothing, and world-sim refuses it as well."""
    one, two, three = acquainted()
    word = forwarded(two, three)
    false = changed(word, **FALSE_WORDS[name](message_of(word)))
    check = MessageCheck(two.scenario, UNITS, N, identities_of(two.scenario))

    assert check.passes(two.me, message_of(word))
    assert not check.passes(two.me, message_of(false))
    assert three.hear(false) == 1
    assert three.held_log(one.me) == []
    assert three.hear(word) == 0
    assert three.held_log(one.me) == one.log


def test_a_false_register_of_another_is_refused_whole() -> None:
    """Also one that is as it should be but for a number."""
    one, two, three = acquainted(*SPECTRAL)
    word = forwarded(two, three)
    content = message_of(word).registers

    assert content == bytes([1, 0, 0, 0, 1, 1, 2 * 3])  # stamps, then r1's
    assert three.hear(changed(word, registers=content[:-1] + bytes([2 * 4]))) == 1
    assert three.hear(changed(word, registers=content + content[3:])) == 1
    assert three.hear(word) == 0
    assert three.replica.registers.values[one.me].tolist() == [3]


def test_an_own_attestation_with_a_false_signature_is_refused_whole() -> None:
    """Nobody could pass it on."""
    one, two, _ = team(*SIGNED)
    one.hear(two.speak())
    word = one.speak()
    unsigned = [replace(each, signature=UNSIGNED) for each in message_of(word).attestations]

    assert len(unsigned) == 1
    assert two.hear(changed(word, attestations=tuple(unsigned))) == 1
    assert two.hear(word) == 0


def test_what_is_newer_than_an_attestation_is_taken_from_its_origin_alone() -> None:
    """r1 spends in every step: r2 knows of it at once, r3 once r1 has attested it."""
    one, two, three = acquainted()
    attested_entries, behind = 2, 0
    for sample in range(3, 3 + 3 * OFTEN):
        one.buy(sample, 1)
        word = one.speak()
        attested_entries = max(
            [attested_entries, *(a.length for a in message_of(word).attestations)]
        )
        two.hear(word)
        word = two.speak()
        one.hear(word)
        three.hear(word)
        two.hear(three.speak())
        behind += len(three.held_log(one.me)) < len(one.log)

        assert two.held_log(one.me) == one.log
        assert len(three.held_log(one.me)) <= attested_entries
    assert behind > OFTEN
    assert len(three.held_log(one.me)) > 2


def test_the_log_of_a_new_incarnation_is_forwarded_to_who_knows_the_first_alone() -> None:
    """r1 has lost its log and goes on; r3 makes room for it when it is brought its word."""
    one, two, three = acquainted()
    three.hear(forwarded(two, three))
    again = Member("r1", one.scenario, N, UNITS, incarnation=1)
    again.buy(7, 2)
    brought = []
    for _ in range(9):
        two.hear(again.speak())
        word = two.speak()
        again.hear(word)
        two.hear(three.speak())
        brought += (
            [word] if any(each.origin == again.me for each in message_of(word).attestations) else []
        )

    assert three.hear(brought[0]) == 0
    assert three.held_log(again.me) == again.log
    assert three.held_log(one.me) == one.log
    assert again.held_log(one.me) == one.log
    assert not three.gossip.forked


def test_claims_travel_in_attestations() -> None:
    """r3 heads for nothing that r1 has claimed; the claims of a message are its sender's."""
    one, two, three = acquainted()
    word = forwarded(two, three)
    three.hear(word)

    assert claim_of(three.replica, one.me)[1] == 4
    assert message_of(word).claims == b""  # r2 has claimed nothing


# Who tells two stories.


def twins(*, until: int) -> tuple[list[Member], Member]:
    """The team, and another r1 with the same key whose log differs from the first story from some entry on."""
    made = team(*SIGNED)
    other = Member("r1", made[0].scenario, N, UNITS)
    for i in range(until):
        made[0].buy(i, 1)
        other.buy(i, 1)
    made[0].buy(10, 1)
    other.buy(11, 1)
    return made, other


@pytest.mark.parametrize("until", [0, 1, 5])
@pytest.mark.parametrize("more", [1, 3])
def test_who_meets_both_stories_knows_the_fork(until: int, more: int) -> None:
    """r3 holds the first story and is brought the second by r2, which has met only the other; r2's own log is merged."""
    (one, two, three), other = twins(until=until)
    for i in range(more):
        other.buy(6 + i, 1)
    talk([one, three], 2)
    talk([other, two], 3 * OFTEN)
    two.buy(7, 1)
    before = three.held_log(0)
    for _ in range(2 * OFTEN):
        two.hear(three.speak())
        assert three.hear(two.speak()) == 0

    assert list(three.gossip.forked) == [0]
    assert three.held_log(0) == before == one.log
    assert three.held_log(1) == two.log
    assert not two.gossip.forked


def test_a_fork_before_what_is_brought_is_known_by_its_hash() -> None:
    """The stories differ in their first entry alone, long before the block that r2 brings."""
    scenario, bound = on_map(*SIGNED, "robots.count=3", "starts.random=true"), 600
    one, other = (Member("r1", scenario, bound) for _ in range(2))
    two, three = (Member(name, scenario, bound) for name in ("r2", "r3"))
    one.append([1, *range(100, 100 + BLOCK)])
    other.append([2, *range(100, 100 + 2 * BLOCK)])
    talk([one, three], 4)
    talk([other, two], 3 * OFTEN)
    for _ in range(2 * OFTEN):
        two.hear(three.speak())
        assert three.hear(two.speak()) == 0

    assert list(three.gossip.forked) == [0]
    assert three.held_log(0) == one.log


def test_two_stories_from_one_mouth_are_a_fork() -> None:
    """The attestation of the second contradicts what r1 itself has said."""
    (one, two, _), other = twins(until=2)
    talk([one, two], 2 * OFTEN)
    other.step = one.step
    other.hear(two.speak())

    assert two.hear(other.speak()) == 0
    assert list(two.gossip.forked) == [0]
    assert two.held_log(0) == one.log


def test_of_a_forked_origin_its_own_word_still_counts() -> None:
    """It can harm nobody with it but itself."""
    (one, two, three), other = twins(until=1)
    other.buy(6, 1)
    talk([one, three], 2)
    talk([other, two], 3 * OFTEN)
    for _ in range(2 * OFTEN):
        two.hear(three.speak())
        three.hear(two.speak())
    one.buy(3, 1)
    talk([one, three], OFTEN)

    assert list(three.gossip.forked) == [0]
    assert three.held_log(0) == one.log


def test_two_words_of_one_step_are_a_fork() -> None:
    """Also when they differ in a claim alone."""
    one, two, three = acquainted()
    word = forwarded(two, three)
    first = message_of(word).attestations[0]
    other = signed(RUN, replace(first, claim=(*first.claim[:2], 7)), key_of("r1"))

    assert three.hear(word) == 0
    assert three.hear(changed(word, attestations=(other,))) == 0
    assert list(three.gossip.forked) == [one.me]


def test_a_log_that_shrinks_is_a_fork() -> None:
    """A later attestation covers no less."""
    one, two, three = acquainted()
    word = forwarded(two, three)
    first = message_of(word).attestations[0]
    shorter = replace(first, step=first.step + 1, length=0, log=hash_of(b""))
    later = signed(RUN, shorter, key_of("r1"))

    assert three.hear(word) == 0
    assert three.hear(changed(word, logs=b"", proofs=(b"",), attestations=(later,))) == 0
    assert list(three.gossip.forked) == [one.me]


# Long logs.


@pytest.mark.parametrize("length", [ENTRIES_MAX, ENTRIES_MAX + 1, 3 * ENTRIES_MAX + 5 * BLOCK + 7])
def test_a_long_log_is_forwarded_part_by_part(length: int) -> None:
    """Each part ends with a block, and is proven with the hashes of the blocks after it."""
    scenario = on_map("trust=signed", "robots.count=3", "starts.random=true")
    bound = entries_on(Frame(1.0, (0.0, 0.0), 50, 60))
    one, two, three = (Member(name, scenario, bound) for name in scenario.robot_ids)
    one.append([(7 * i) % bound for i in range(length)])
    talk([one, two], 4 * OFTEN + 4)
    assert two.held_log(0) == one.log
    sizes = [0]
    for _ in range(6 * (length // ENTRIES_MAX + 2)):
        two.hear(three.speak())
        assert three.hear(two.speak()) == 0
        sizes.append(len(three.held_log(0)))

    assert three.held_log(0) == one.log
    assert all(size % BLOCK == 0 for size in sizes if size < length)


def test_a_log_that_is_too_far_behind_comes_from_its_origin_alone() -> None:
    """A message holds the hashes of so many blocks; what it brings is far below the longest body."""
    scenario = on_map(*SIGNED, "robots.count=3", "starts.random=true")
    bound = entries_on(Frame(1.0, (0.0, 0.0), 50, 60))
    names = (*scenario.robot_ids, "r3")
    one, two, three, late = (Member(name, scenario, bound) for name in names)
    most = REST_BLOCKS_MAX * BLOCK + ENTRIES_MAX
    one.append([(7 * i) % bound for i in range(most)])
    one.validates = two.validates = False
    talk([one, two], 3 * most // ENTRIES_MAX)
    assert two.held_log(0) == one.log
    for _ in range(5):
        two.hear(three.speak())
        word = two.speak()
        assert three.hear(word) == 0
        if three.held_log(0):
            break

    assert len(message_of(word).proofs[0]) == HASH_BYTES * (1 + REST_BLOCKS_MAX)
    assert len(word.body) < BODY_BYTES_MAX // 2
    assert len(three.held_log(0)) == ENTRIES_MAX

    one.append(range(BLOCK))
    talk([one, two], 4 * OFTEN)
    for _ in range(9):
        two.hear(late.speak())
        assert late.hear(two.speak()) == 0
    assert late.held_log(0) == []


# Energy.


def shipping(who: Member, values: list[tuple[int, int]], start: int = 0) -> Envelope:
    """The next message of a robot, with other entries of its own log."""
    word = who.speak()
    index, packed = 0, b""
    for sample, units in values:
        step, index = sample - index, sample
        packed += bytes([2 * step if step >= 0 else -2 * step - 1, units])
    lengths = [0] * 3
    lengths[who.me % 3] = start + len(values)
    head = bytes([who.me, start, len(values), len(values)])
    return changed(word, logs=head + packed, version_vector=bytes([*lengths, 0, 0, 0]))


@pytest.mark.parametrize("trust", [OPEN, SIGNED], ids=["open", "signed"])
def test_overspending_is_malformed(trust: tuple[str, ...]) -> None:
    """A robot has twenty units: the last one counts, the next one spoils the message."""
    one, two, _ = team(*trust)
    check = MessageCheck(one.scenario, UNITS, N, identities_of(one.scenario))
    all_it_has = shipping(one, [(i, 2) for i in range(10)])
    one_more = shipping(one, [*((i, 2) for i in range(10)), (11, 1)])

    assert not check.passes(0, message_of(one_more))
    assert two.hear(one_more) == 1
    assert check.passes(0, message_of(all_it_has))
    assert two.hear(all_it_has) == 0
    assert two.hear(shipping(one, [(11, 1)], start=10)) == 1
    assert two.replica.store.sending[SHIPPED].tolist() == [20, 0, 0]


def test_all_incarnations_together_have_one_budget() -> None:
    """The second life of r1 has what the first has left."""
    one, two, _ = team()
    two.hear(shipping(one, [(i, 2) for i in range(9)]))
    again = Member("r1", one.scenario, N, UNITS, incarnation=1)
    ids = bytes([0, 0, 0, 0, 0, 0])

    def words(count: int) -> Envelope:
        logs = bytes([3, 0, count, count, *([2, 1] * count)])
        return changed(again.speak(), logs=logs, version_vector=ids + ids)

    assert two.hear(words(3)) == 1
    assert two.hear(words(2)) == 0
    assert two.replica.store.sending[SHIPPED].tolist() == [18, 0, 0, 2, 0, 0]


def test_a_forwarder_is_not_blamed_for_what_another_overspends() -> None:
    """In an open run r1 has told r2 and r3 different things: r3 takes of r2's message what r1 can have shipped."""
    one, two, three = team()
    two.hear(shipping(one, [*((i, 1) for i in range(2)), *((i, 2) for i in range(2, 11))]))
    three.hear(shipping(one, [(0, 2), (1, 2)]))
    two.buy(11, 1)
    for _ in range(6):
        two.hear(three.speak())
        assert three.hear(two.speak()) == 0

    assert three.replica.store.sending[SHIPPED, 0] == 20
    assert three.held_log(two.me) == two.log


# The whole.


BROKEN: dict[str, Callable[[Member, Any], Any]] = {
    "own-word-as-another's": lambda m, a: a.newest.__setitem__(
        m.me, replace(a.newest[0], origin=m.me)
    ),
    "word-of-another": lambda _, a: a.newest.__setitem__(2, a.newest[0]),
    "unsigned": lambda _, a: a.newest.__setitem__(0, replace(a.newest[0], signature=UNSIGNED)),
    "word-of-more-than-is-held": lambda m, _: m.replica.store.length.__setitem__(0, 1),
    "more-offered-than-attested": lambda m, _: m.replica.store.sending.__setitem__((OFFERED, 2), 1),
    "less-offered-than-attested": lambda m, _: m.replica.store.sending.__setitem__((OFFERED, 0), 1),
    "another-entry": lambda m, _: m.replica.store.logs.__setitem__((0, 0, 0), 7),
    "another-claim": lambda _, a: a._claimed.__setitem__(0, 9),
    "claim-of-nobody": lambda _, a: a._claimed.__setitem__(2, 9),
    "fork-of-itself": lambda m, a: a.forked.__setitem__(m.me, a.newest[0]),
}


@pytest.mark.parametrize("name", BROKEN)
def test_each_broken_invariant_is_found(name: str) -> None:
    """One number is wrong, and `validate` says so."""
    _, two, _ = acquainted()
    two.gossip.validate(two.replica)
    held: Any = two.gossip._attested
    kept = copy.deepcopy(two.replica.store)
    BROKEN[name](two, held)

    with pytest.raises(AssertionError):
        two.gossip.validate(two.replica)
    for array, content in zip(two.replica.store, kept, strict=True):
        array[...] = content  # replicas are validated once more when the test is over


def test_an_offered_register_is_the_attested_one() -> None:
    """With the stamp and the numbers of the attestation."""
    _, two, _ = acquainted(*SPECTRAL)
    registers = two.replica.registers
    assert registers.offered[0].tolist() == [3]
    registers.offered[0] = 4

    with pytest.raises(AssertionError):
        two.gossip.validate(two.replica)


def test_a_signed_mission_needs_identities() -> None:
    """And an open one has none."""
    with pytest.raises(AssertionError, match="identities"):
        Gossip("r1", mission(*SIGNED))
    with pytest.raises(AssertionError, match="identities"):
        Gossip("r1", mission(), identities=identities_of(mission(*SIGNED)))


def test_an_open_mission_has_no_attestations() -> None:
    """Its messages are the same bytes as ever."""
    one, two, _ = team()
    one.buy(1, 1)
    for _ in range(4 * OFTEN):
        two.hear(word := one.speak())
        one.hear(two.speak())
        assert message_of(word).attestations == message_of(word).proofs == ()


def test_the_own_attestation_ends_the_body_unsigned() -> None:
    """So that the signature of whoever runs the machine fits in its place."""
    one, two, _ = team(*SIGNED)
    one.hear(two.speak())
    body = one.gossip.compose(one.replica, 1, Pose(0.0, 0.0)).body

    assert body.endswith(b"\xc4\x40" + bytes(64))


def test_a_robot_attests_when_its_state_becomes_final() -> None:
    """Once, and then as often as ever; never for nobody."""
    one, two, _ = team(*SIGNED)
    assert not message_of(one.speak(final=True)).attestations
    one.hear(two.speak())
    attests = [bool(message_of(one.speak(final=True)).attestations) for _ in range(2 * OFTEN)]

    assert attests == [True, *[False] * (OFTEN - 1)] * 2


def test_the_supervisor_is_believed() -> None:
    """It relays what robots told it themselves, with no proof; another's word without proof is refused."""
    scenario = mission("coordination=centralized", *SIGNED)
    one, two = (Member(name, scenario, N, UNITS) for name in ("r1", "r2"))
    relay = Member(SUPERVISOR, scenario, N, UNITS)
    one.buy(3, 2)
    relay.hear(one.speak(), two.speak())
    word = relay.speak()

    assert two.hear(word) == 0
    assert two.held_log(one.me) == one.log
    assert all(each.origin == relay.me for each in message_of(word).attestations)
    assert Member("r3", scenario, N, UNITS).hear(replace(word, source="r2")) == 1


@pytest.mark.parametrize(
    ("overrides", "steps"), [((), 20), (("merge=min", "claims=false"), 20), ("map", 7)]
)
def test_how_often(
    monkeypatch: pytest.MonkeyPatch, overrides: tuple[str, ...] | str, steps: int
) -> None:
    """On a map more often: others forward registers every seventh step, and rely on them for eight."""
    monkeypatch.undo()
    scenario = on_map("trust=signed") if overrides == "map" else mission(*SIGNED, *overrides)

    assert attested_every(scenario) == steps
