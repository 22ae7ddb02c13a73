"""The rules beside a declared liar: what it says counts as its lies, and the others keep every rule in full."""

from collections.abc import Callable

import msgspec
import pytest

from kantor_protocol.base.machine import State
from kantor_worldsim.observers.checkers.checker import Checker, check
from kantor_worldsim.record.records import Record
from support.broken_records import (
    BrokenRecord,
    BrokenRecords,
    Change,
    gossip,
    outputs,
    put_step,
)
from support.checkers import rules
from support.records import Play, Records, gossip_of, pairs, step_records, uints
from support.variants import OUT_OF_RANGE, SPECTRAL, Overrides

BROKEN = BrokenRecords()
breaks = BROKEN.breaks


def beside(lie: str, who: str = "r2") -> Overrides:
    """A liar in a team of which nobody hears another, so that a change of a record breaks no further rule."""
    told = f"faults=[{{kind='byzantine', who=['{who}'], lie='{lie}', from_s=0.5, until_s=1.1}}]"
    return (*OUT_OF_RANGE, "trust=signed", told)


def judged(records: list[Record]) -> Checker:
    checker: Checker = check(records)
    return checker


# An end that comes too early.


@breaks("early", run=beside("teleport"))
def _finishes_while_mass_is_left(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[3], outputs(state=State.FINISHED))


@breaks("early", run=beside("overstate"))
def _finishes_with_more_left_than_a_false_log_could_take(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[0], outputs(state=State.FINISHED))


def test_what_liars_had_energy_for_may_be_gone(played: Play) -> None:
    """At the end two of three robots have shipped a third each: the last third is what r2 could have taken."""
    records = played(*beside("overstate"))
    last = step_records(records, "r1")[-1]

    assert rules(put_step(records, last, outputs(state=State.FINISHED))) == set()


def test_a_liar_may_finish_when_it_likes(played: Play) -> None:
    records = played(*beside("overstate"))
    step_record = step_records(records, "r2")[0]

    assert rules(put_step(records, step_record, outputs(state=State.FINISHED))) == set()


# Views beside false logs.


def losing(samples: int) -> Change:
    """A change of a step: so many samples are lost to its robot."""
    lost = pairs(*((sample, 0) for sample in range(samples)))
    return outputs(lowered=lost, weights=b"")


LOST = {"weights", "goal", "ledger"}
"""What follows: the robot goes on with what it has lost, and no log that it holds says why."""


def test_a_view_loses_no_more_than_a_false_log_could_take(played: Play) -> None:
    """Two thirds of the mass: r2 has energy for so much."""
    records = played(*beside("overstate"))
    step_record = step_records(records, "r1")[0]

    assert rules(put_step(records, step_record, losing(30))) <= LOST
    assert rules(put_step(records, step_record, losing(60))) - LOST == {"credit"}


def test_beside_an_honest_log_a_view_loses_nothing(played: Play) -> None:
    records = played(*beside("silence"))
    step_record = step_records(records, "r1")[0]

    assert rules(put_step(records, step_record, losing(30))) - LOST == {"credit"}


def test_a_view_holds_no_more_than_honest_logs_leave(played: Play) -> None:
    """A false log takes from a view, and gives it nothing back."""
    records = played("radio.drop=0.5", *beside("overstate")[2:])
    *_, forgotten = (each for each in step_records(records, "r1") if each.outputs.lowered)

    assert "ledger" in rules(put_step(records, forgotten, outputs(lowered=b"", weights=b"")))


# Logs, claims and registers.


def false_entry(origin: int) -> Change:
    """A change of a message: it tells of an entry that its origin never made."""
    log = uints(origin, 0, 1, 1) + pairs((59, 1))
    return lambda step_record: gossip(step_record, logs=log)(step_record)


@breaks("ledger", run=beside("overstate"))
def _passes_on_a_false_entry_of_an_honest_log(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[5], false_entry(2))


def test_a_false_log_is_passed_on_in_good_faith(played: Play) -> None:
    records = played(*beside("overstate"))
    changed = judged(put_step(records, step_records(records, "r1")[5], false_entry(1)))

    assert changed.violations == []
    assert changed.lies.keys() == {"r2"}


def test_a_robot_that_is_only_silent_has_an_honest_log(played: Play) -> None:
    records = played(*beside("silence"))

    assert rules(put_step(records, step_records(records, "r1")[5], false_entry(1))) == {"ledger"}


def claim(origin: int) -> Change:
    """A change of a message: it tells of a claim that its origin never made."""
    claims = uints(origin, 3, 7, 0)
    return lambda step_record: gossip(step_record, claims=gossip_of(step_record).claims + claims)(
        step_record
    )


@breaks("claim", run=beside("claim"))
def _passes_on_a_claim_that_was_never_made(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r1")[5], claim(2))


@breaks("claim", run=beside("claim"))
def _passes_on_a_claim_that_a_liar_never_made(records: Records) -> list[Record]:
    """In a signed mission nobody believes it."""
    return put_step(records, step_records(records, "r1")[5], claim(1))


@breaks("claim", run=(*beside("claim"), *SPECTRAL))
def _passes_on_a_register_that_was_never_written(records: Records) -> list[Record]:
    step_record = step_records(records, "r1")[5]
    registers = gossip_of(step_record).registers + uints(2, 2, 1, 8)
    return put_step(records, step_record, gossip(step_record, registers=registers))


def test_what_an_origin_has_said_is_passed_on(played: Play) -> None:
    records = played(*beside("claim"))
    earlier = gossip_of(step_records(records, "r3")[2]).claims
    step_record = step_records(records, "r1")[5]
    claims = gossip_of(step_record).claims + earlier

    assert rules(put_step(records, step_record, gossip(step_record, claims=claims))) == set()


# What is refused.


def refusing(records: Records, name: str, source: str) -> list[Record]:
    """The records with one more message refused, in a step in which one source alone was heard, and counted on."""
    first = next(
        step.outputs.step
        for step in step_records(records, name)
        if {heard for heard, _ in step.heard} == {source}
    )
    changed: list[Record] = list(records)
    for step in step_records(records, name)[first - 1 :]:
        more = outputs(refused=step.outputs.refused + 1)
        changed = put_step(changed, step, more)
    return changed


HEARD = ("radio.drop=0.5", "trust=signed", beside("silence")[-1])


def test_an_honest_robot_may_refuse_a_liar_and_nobody_else(played: Play) -> None:
    records = played(*HEARD)

    assert rules(refusing(records, "r1", "r2")) == set()
    assert rules(refusing(records, "r1", "r3")) == {"refusal"}


# The liar itself.


@breaks("order", run=beside("fork"))
def _a_liar_skips_a_step(records: Records) -> list[Record]:
    """Its body obeys the same rules as all."""
    last = step_records(records, "r2")[-1]
    return put_step(records, last, outputs(step=last.outputs.step + 1))


@breaks("energy", run=beside("overstate"))
def _a_liar_counts_less_than_it_ships(records: Records) -> list[Record]:
    return put_step(records, step_records(records, "r2")[5], outputs(energy_spent=0))


@pytest.mark.parametrize("name", BROKEN.cases)
def test_a_broken_record_breaks_its_rule(name: str, judge: Callable[[BrokenRecord], None]) -> None:
    judge(BROKEN.cases[name])


def test_without_liars_nobody_is_excused(played: Play) -> None:
    """The same record without its fault has violations where it had lies."""
    records = played(*beside("overstate"))
    first = records[0]
    honest = msgspec.structs.replace(first.scenario, faults=())  # type: ignore[union-attr]
    unexcused = [msgspec.structs.replace(first, scenario=honest), *records[1:]]

    assert judged(list(records)).lies.keys() == {"r2"}
    assert rules(unexcused) == {"ledger"}
    assert judged(unexcused).lies == {}
