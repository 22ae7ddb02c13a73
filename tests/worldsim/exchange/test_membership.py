"""Who plays whom: doubles, successors, predecessors that wake up."""

from hypothesis import given
from hypothesis import strategies as st

from kantor_worldsim.exchange.membership import REFUSALS, JoinDecision, Membership
from support.strategies import examples


def test_a_second_process_is_refused_while_the_first_is_there() -> None:
    admission = Membership(("r1", "r2"))
    assert admission.join("r1", "one") is JoinDecision.NEW
    assert admission.join("r1", "other") is JoinDecision.TAKEN
    assert not admission.leave("r1", "other")
    assert admission.player("r1") == "one"
    assert admission.join("r2", "two") is JoinDecision.NEW


def test_a_process_that_comes_back_with_nobody_in_between_goes_on() -> None:
    admission = Membership(("r1",))
    admission.join("r1", "one")
    assert admission.leave("r1", "one")
    assert admission.player("r1") is None
    assert admission.join("r1", "one") is JoinDecision.BACK


def test_a_frozen_predecessor_is_refused_for_ever() -> None:
    admission = Membership(("r1",))
    admission.join("r1", "one")
    admission.leave("r1", "one")
    assert admission.join("r1", "two") is JoinDecision.NEW
    assert admission.join("r1", "one") is JoinDecision.FENCED
    admission.leave("r1", "two")
    assert admission.join("r1", "one") is JoinDecision.FENCED
    assert admission.join("r1", "two") is JoinDecision.BACK


def test_nobody_plays_who_is_not_in_the_team() -> None:
    admission = Membership(("r1",))
    assert admission.join("r2", "one") is JoinDecision.UNKNOWN
    assert not admission.leave("r2", "one")
    assert admission.player("r1") is None
    assert set(REFUSALS) == set(JoinDecision) - {JoinDecision.NEW, JoinDecision.BACK}


EVENTS = st.lists(
    st.tuples(st.booleans(), st.sampled_from(["r1", "r2", "r3"]), st.sampled_from("abcd")),
    max_size=40,
)


@given(EVENTS)
@examples(300)
def test_one_plays_at_a_time_and_who_was_succeeded_never_again(
    events: list[tuple[bool, str, str]],
) -> None:
    """Against the rule in words: the history of those let in never returns to an earlier one."""
    admission = Membership(("r1", "r2"))
    history: dict[str, list[str]] = {"r1": [], "r2": [], "r3": []}
    here: dict[str, str] = {}
    for comes, name, letter in events:
        nonce = f"{name}{letter}"
        if not comes:
            assert admission.leave(name, nonce) == (here.get(name) == nonce)
            if here.get(name) == nonce:
                del here[name]
            continue
        entry = admission.join(name, nonce)
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
        assert admission.player(name) == here.get(name)
