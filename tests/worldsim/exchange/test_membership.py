"""Membership: the process of each participant; doubles, successors, predecessors that wake up."""

from hypothesis import given
from hypothesis import strategies as st

from kantor_worldsim.exchange.membership import FENCED_MAX, REFUSALS, JoinDecision, Membership
from support.strategies import examples


def test_a_second_process_is_refused_while_the_first_is_there() -> None:
    membership = Membership(("r1", "r2"))
    assert membership.join("r1", "one") is JoinDecision.NEW
    assert membership.join("r1", "other") is JoinDecision.TAKEN
    assert not membership.leave("r1", "other")
    assert membership.player("r1") == "one"
    assert membership.join("r2", "two") is JoinDecision.NEW


def test_a_process_that_comes_back_without_a_successor_goes_on() -> None:
    membership = Membership(("r1",))
    membership.join("r1", "one")
    assert membership.leave("r1", "one")
    assert membership.player("r1") is None
    assert membership.join("r1", "one") is JoinDecision.BACK


def test_a_frozen_predecessor_is_refused_forever() -> None:
    membership = Membership(("r1",))
    membership.join("r1", "one")
    membership.leave("r1", "one")
    assert membership.join("r1", "two") is JoinDecision.NEW
    assert membership.join("r1", "one") is JoinDecision.FENCED
    membership.leave("r1", "two")
    assert membership.join("r1", "one") is JoinDecision.FENCED
    assert membership.join("r1", "two") is JoinDecision.BACK


def test_not_all_predecessors_are_remembered() -> None:
    """Who replaces itself again and again fills no memory; the newest predecessors are refused."""
    membership = Membership(("r1",))
    for i in range(FENCED_MAX + 10):
        assert membership.join("r1", f"{i}") is JoinDecision.NEW
        membership.leave("r1", f"{i}")

    assert len(membership._fenced) == FENCED_MAX
    assert membership.join("r1", f"{FENCED_MAX + 8}") is JoinDecision.FENCED
    assert membership.join("r1", "9") is JoinDecision.FENCED


def test_an_unknown_participant_is_refused() -> None:
    membership = Membership(("r1",))
    assert membership.join("r2", "one") is JoinDecision.UNKNOWN
    assert not membership.leave("r2", "one")
    assert membership.player("r1") is None
    assert set(REFUSALS) == set(JoinDecision) - {JoinDecision.NEW, JoinDecision.BACK}


EVENTS = st.lists(
    st.tuples(st.booleans(), st.sampled_from(["r1", "r2", "r3"]), st.sampled_from("abcd")),
    max_size=40,
)


@given(EVENTS)
@examples(300)
def test_one_process_at_a_time_and_never_one_that_was_succeeded(
    events: list[tuple[bool, str, str]],
) -> None:
    """Against the stated rule: the history of admitted processes never returns to an earlier one."""
    membership = Membership(("r1", "r2"))
    history: dict[str, list[str]] = {"r1": [], "r2": [], "r3": []}
    here: dict[str, str] = {}
    for comes, name, letter in events:
        nonce = f"{name}{letter}"
        if not comes:
            assert membership.leave(name, nonce) == (here.get(name) == nonce)
            if here.get(name) == nonce:
                del here[name]
            continue
        entry = membership.join(name, nonce)
        past = history[name]
        if entry is JoinDecision.NEW:
            assert name not in here
            assert nonce not in past
            past.append(nonce)
            here[name] = nonce
        elif entry is JoinDecision.BACK:
            assert nonce == past[-1]
            here[name] = nonce
        elif entry is JoinDecision.TAKEN:
            assert here[name] != nonce
            assert nonce not in past
        elif entry is JoinDecision.FENCED:
            assert nonce in past[:-1]
        else:
            assert name == "r3"
        assert membership.player(name) == here.get(name)
